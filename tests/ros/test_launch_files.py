"""The launch files of `examples/ros`: every node that they name starts, and comes to the state that they promise.

launch_ros cannot be installed here; `tests/ros/launching.py` stands in for it. ROS, the nodes and the FMUs are real.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import FMUS
from tests.ros.ros_peer import Ros, ros_or_skip

ros_or_skip()

from tests.ros.launching import Launch, described  # noqa: E402 only where ROS is installed

FILES = Path(__file__).parents[2] / "examples/ros"


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Ros]:
    with Ros(tmp_path / "log") as ros:
        yield ros


def float64() -> Any:  # noqa: ANN401 types of rclpy
    from std_msgs.msg import Float64  # noqa: PLC0415 only where ROS is installed

    return Float64


def parameter(ros: Ros, node: str, name: str) -> Any:  # noqa: ANN401 types of rclpy
    from rcl_interfaces.srv import GetParameters  # noqa: PLC0415 only where ROS is installed

    client = ros.peer("asking").create_client(GetParameters, f"{node}/get_parameters")
    return ros.called(client, GetParameters.Request(names=[name])).values[0]


def test_one_fmu_is_configured_and_activated_as_soon_as_it_is_there(
    ros: Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    description = described(FILES / "fmi_adapter_node.launch.py", monkeypatch)

    with Launch(ros, tmp_path, description, fmu_path=str(FMUS / "DampedPendulum.fmu")) as launch:
        launch.until([("fmi_adapter_node", "inactive"), ("fmi_adapter_node", "active")])

        subscription, angles = ros.collect(ros.peer(), float64(), "/a")
        ros.matched(subscription)
        ros.until(lambda: angles, "the angle")


def test_two_fmus_are_switched_together_and_the_delay_misses_nothing(
    ros: Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    description = described(FILES / "pendulum_delay.launch.py", monkeypatch)
    subscription, delayed = ros.collect(ros.peer(), float64(), "/example/y")

    with Launch(ros, tmp_path, description) as launch:
        launch.until(
            [
                ("transport_delay", "inactive"),
                ("damped_pendulum", "inactive"),
                ("transport_delay", "active"),
                ("damped_pendulum", "active"),
            ]
        )

        ros.matched(subscription)
        ros.until(lambda: delayed, "the delayed angle")
        readers = ros.peer("looking").get_subscriptions_info_by_topic("/example/a")
        assert "transport_delay" in {reader.node_name for reader in readers}
        assert parameter(ros, "/example/damped_pendulum", "l").double_value == 25.0
        assert parameter(ros, "/example/transport_delay", "d").double_value == 2.33


def test_path_filter_of_the_chapter_is_between_its_topics(
    ros: Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from geometry_msgs.msg import TwistStamped  # noqa: PLC0415 only where ROS is installed

    description = described(FILES / "path_filter/path_filter.launch.py", monkeypatch)
    peer = ros.peer()
    publisher = peer.create_publisher(TwistStamped, "/velDes", 10)
    subscription, filtered = ros.collect(peer, TwistStamped, "/velDesFil")

    with Launch(ros, tmp_path, description):  # it starts by itself, maybe before anybody sees its transitions
        ros.matched(publisher, subscription)
        message = TwistStamped()
        message.twist.linear.x = 0.5
        publisher.publish(message)
        ros.until(lambda: filtered and filtered[-1].twist.linear.x > 0.0, "a filtered velocity")

        assert filtered[-1].header.frame_id == "base_link"
        assert parameter(ros, "/path_filter", "slopeSpeed").double_value == 4.0
