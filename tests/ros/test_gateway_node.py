"""The gateway of a mesh as a ROS node: the founding story, with rclpy as the middleware's only door."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import Place, rows_of, write_config
from tests.ros.ros_peer import Ros, ros_or_skip

ros_or_skip()

LOOP: dict[str, dict[str, Any]] = {
    "plant": {"fmu": "Integrator", "start_values": {"y": 1.0}},
    "controller": {"fmu": "Gain", "start_values": {"k": -3.0}},
}
ROS = {
    "profile": "rclpy",
    "topics": [
        {
            "topic": "/loop",
            "type": "geometry_msgs/msg/TwistStamped",
            "fields": {"twist.linear.x": "plant.y", "twist.angular.z": "controller.y"},
        },
        "plant.y",
    ],
}


@pytest.fixture
def ros(place: Place, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ros]:
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(place.folder / "run"))
    with Ros(place.folder / "log") as ros:
        yield ros


def command(place: Place, *arguments: str | Path) -> None:
    done = place.run(*arguments)
    assert done.wait() == 0, done.errors


def test_a_feedback_loop_at_500_hz_gives_equal_floats_while_ros_watches(ros: Ros, place: Place) -> None:
    from geometry_msgs.msg import TwistStamped  # noqa: PLC0415 only where ROS is installed
    from rosgraph_msgs.msg import Clock  # noqa: PLC0415 as above

    simulation = {"step_size": 0.002, "real_time_factor": 1.0}
    config = write_config(
        place.folder,
        name="loop",
        instances=LOOP,
        connections=("plant.y -> controller.u", "controller.y -> plant.u"),
        stop_time=2.1,
        simulation=simulation,
        ros=ROS,
    )
    reference = place.folder / "reference.csv"
    command(place, "launch", config, "--local", "--output", reference)
    launched = place.start("launch", config, "--paused")
    place.note()
    node = ros.fmu(config=str(config))
    peer = ros.peer()
    watching, messages = ros.collect(peer, TwistStamped, "/loop")
    timing, clocks = ros.collect(peer, Clock, "/clock")
    # The mesh is there before it can answer for its instances.
    ros.until(lambda: str(node.trigger_configure()).endswith("SUCCESS"), "the mesh")
    node.trigger_activate()
    ros.matched(watching, timing)

    # It rests until everything has come: with the mesh ends what waits for a reader that is slow just then.
    command(place, "step", "loop", "1000")
    ros.until(lambda: messages and messages[-1].header.stamp.sec == 2, "the message of point 1000")
    ros.until(lambda: clocks and clocks[-1].clock.sec == 2, "its time")
    command(place, "resume", "loop")
    ros.until(lambda: node._state_machine.current_state[1] == "inactive", "the end of the mesh")

    assert launched.wait() == 0, launched.errors
    expected = rows_of(reference)
    assert rows_of(place.folder / "loop.csv") == expected
    # Point 0 may be over before somebody watches; from then on every point is there.
    points = [m.header.stamp.sec * 500 + m.header.stamp.nanosec // 2_000_000 for m in messages]
    up_to_the_rest = points[: points.index(1000) + 1]
    assert up_to_the_rest in (list(range(1001)), list(range(1, 1001)))
    assert [(m.twist.linear.x, m.twist.angular.z) for m in messages] == [expected[point][1:3] for point in points]
    times = [c.clock.sec * 1_000_000_000 + c.clock.nanosec for c in clocks]
    assert times == sorted(times)
    assert 2_000_000_000 in times


def test_an_input_and_a_tunable_parameter_of_mesh_are_set_from_ros(ros: Ros, place: Place) -> None:
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue  # noqa: PLC0415 only where ROS is installed
    from rcl_interfaces.srv import SetParameters  # noqa: PLC0415 as above
    from std_msgs.msg import Float64  # noqa: PLC0415 as above

    config = write_config(
        place.folder,
        name="one",
        instances={"gain": {"fmu": "Gain", "start_values": {"k": 2.0}}},
        connections=(),
        stop_time=3600.0,
        simulation={"step_size": 0.01, "real_time_factor": 1.0},
    )
    launched = place.start("launch", config)
    place.note()
    node = ros.fmu(config=str(config))
    peer = ros.peer()
    subscription, messages = ros.collect(peer, Float64, "/gain/y")
    publisher = peer.create_publisher(Float64, "/gain/u", 10)
    client = peer.create_client(SetParameters, "/fmi_adapter_node/set_parameters")
    ros.until(lambda: str(node.trigger_configure()).endswith("SUCCESS"), "the mesh")
    node.trigger_activate()
    ros.matched(subscription, publisher)

    publisher.publish(Float64(data=1.5))
    ros.until(lambda: messages and messages[-1].data == 3.0, "the input at the output")

    def set_k(value: ParameterValue) -> Any:
        request = SetParameters.Request(parameters=[Parameter(name="gain.k", value=value)])
        return ros.called(client, request).results[0]

    assert node.get_parameter("gain.k").value == 2.0
    assert set_k(ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=4.0)).successful
    ros.until(lambda: messages[-1].data == 6.0, "the new gain")
    refused = set_k(ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="much"))
    assert not refused.successful
    assert "gain.k" in refused.reason
    command(place, "stop", "one")
    launched.wait()


def test_without_its_mesh_gateway_stays_unconfigured_and_says_how_to_start_one(
    ros: Ros, place: Place, capfd: pytest.CaptureFixture[str]
) -> None:
    config = write_config(place.folder)
    node = ros.fmu(config=str(config))

    node.trigger_configure()

    assert node._state_machine.current_state[1] == "unconfigured"
    assert "Start one with `fmu-mesh launch CONFIG`" in capfd.readouterr().err
