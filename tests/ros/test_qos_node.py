"""Quality of service with rclpy: the gateway node of a mesh, and the node of one FMU."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest

from tests.helpers import FMUS, Place, wait_until, write_config
from tests.ros.ros_peer import Ros, built_types_or_skip, ros_or_skip

ros_or_skip()

URDF = '<robot name="arm"/>'


@pytest.fixture
def ros(place: Place, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ros]:
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(place.folder / "run"))
    with Ros(place.folder / "log") as ros:
        yield ros


def latched(deadline_s: float = 0.0) -> Any:
    from rclpy.duration import Duration  # noqa: PLC0415 only where ROS is installed
    from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: PLC0415 as above

    return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, deadline=Duration(seconds=deadline_s))


@pytest.mark.filterwarnings("ignore:Deprecated in favor of")  # rclpy warns of the QoS by a function that it deprecates
def test_late_nodes_get_latched_values_in_the_namespace_of_the_gateway(
    ros: Ros, place: Place, capfd: pytest.CaptureFixture[str]
) -> None:
    import rclpy  # noqa: PLC0415 only where ROS is installed
    from std_msgs.msg import Float64, String  # noqa: PLC0415 as above

    from fmu_mesh.ros.node import create_node  # noqa: PLC0415 as above

    (place.folder / "arm.urdf").write_text(URDF, encoding="utf-8")
    topics: list[Any] = [
        {"topic": "robot_description", "type": "std_msgs/msg/String", "constants": {"data": {"file": "arm.urdf"}}},
        {"topic": "/state", "variable": "gain.y", "durability": "transient_local", "depth": 1},
        {"topic": "/goal", "variable": "gain.u", "durability": "transient_local", "deadline": 0.3},
        "other.y",
    ]
    config = write_config(
        place.folder,
        name="one",
        instances={"gain": {"fmu": "Gain", "start_values": {"k": 2.0}}, "other": {"fmu": "Gain"}},
        connections=(),
        stop_time=3600.0,
        simulation={"step_size": 0.01, "real_time_factor": 1.0},
        ros={"profile": "rclpy", "topics": topics},
    )
    early = ros.peer("early")
    early.create_publisher(Float64, "/goal", latched(deadline_s=0.3)).publish(Float64(data=1.5))
    launched = place.start("launch", config)
    place.note()
    parameter = rclpy.Parameter("config", value=str(config))
    arguments = ["--ros-args", "-r", "__ns:=/robot"]
    node = ros.add(create_node(context=ros.context, parameter_overrides=[parameter], cli_args=arguments))
    ros.until(lambda: str(node.trigger_configure()).endswith("SUCCESS"), "the mesh")
    node.trigger_activate()
    wait_until_set(ros, place)
    place.run("pause", "one").wait()

    late = ros.peer("late")
    _, descriptions = ros.collect(late, String, "/robot/robot_description", latched())
    _, states = ros.collect(late, Float64, "/state", latched())
    ros.collect(late, Float64, "/robot/other/y", latched())

    ros.until(lambda: descriptions and states, "what was published before")
    assert [own.data for own in descriptions] == [URDF]
    assert states[-1].data == 3.0
    told = ""

    def refused() -> bool:
        nonlocal told
        told += capfd.readouterr().err
        return re.search(r"'/robot/other/y', requesting incompatible QoS.*DURABILITY", told) is not None

    ros.until(refused, "a warning that the late node asks for more than is offered")
    node.trigger_deactivate()
    place.run("stop", "one").wait()
    assert launched.wait() == 130, launched.errors


def test_late_node_gets_frames_that_never_change(ros: Ros, place: Place) -> None:
    built_types_or_skip()
    from tf2_msgs.msg import TFMessage  # noqa: PLC0415 only where it is built

    path = "transforms[child_frame_id=camera].transform"
    constants = {f"{path}.translation.z": 1.5, f"{path}.rotation.w": 1.0}
    config = write_config(
        place.folder,
        name="one",
        instances={"gain": {"fmu": "Gain"}},
        connections=(),
        stop_time=3600.0,
        simulation={"step_size": 0.01, "real_time_factor": 1.0},
        ros={
            "profile": "rclpy",
            "topics": [
                {"topic": "/tf_static", "type": "tf2_msgs/msg/TFMessage", "frame_id": "world", "constants": constants},
                "gain.y",
            ],
        },
    )
    place.start("launch", config)
    place.note()
    node = ros.fmu(config=str(config))
    ros.until(lambda: str(node.trigger_configure()).endswith("SUCCESS"), "the mesh")
    node.trigger_activate()

    late = ros.peer("late")
    static, frames = ros.collect(late, TFMessage, "/tf_static", latched())  # as the listener of tf2
    ros.matched(static)
    ros.until(lambda: frames, "the frames")

    [frame] = frames[0].transforms
    assert (frame.header.frame_id, frame.child_frame_id) == ("world", "camera")
    assert (frame.transform.translation.z, frame.transform.rotation.w) == (1.5, 1.0)
    assert len(frames) == 1


def test_node_that_asks_for_a_deadline_hears_that_a_mesh_pauses(ros: Ros, place: Place) -> None:
    from rclpy.event_handler import SubscriptionEventCallbacks  # noqa: PLC0415 only where ROS is installed
    from std_msgs.msg import Float64  # noqa: PLC0415 as above

    states: list[Any] = []
    missed: list[Any] = []
    peer = ros.peer()
    subscription = peer.create_subscription(
        Float64,
        "/state",
        states.append,
        latched(deadline_s=0.5),
        event_callbacks=SubscriptionEventCallbacks(deadline=missed.append),
    )
    qos = {"durability": "transient_local", "depth": 1, "deadline": 0.5}
    config = write_config(
        place.folder,
        name="one",
        instances={"gain": {"fmu": "Gain", "start_values": {"k": 2.0}}},
        connections=(),
        stop_time=3600.0,
        simulation={"step_size": 0.01, "real_time_factor": 1.0},
        ros={"profile": "rclpy", "topics": [{"topic": "/state", "variable": "gain.y", **qos}]},
    )
    launched = place.start("launch", config)
    place.note()
    node = ros.fmu(config=str(config))
    ros.until(lambda: str(node.trigger_configure()).endswith("SUCCESS"), "the mesh")
    node.trigger_activate()
    ros.matched(subscription)
    ros.until(lambda: len(states) > 10, "samples of a mesh that runs")

    place.run("pause", "one").wait()
    missed.clear()
    ros.until(lambda: len(missed) > 1, "a deadline that is missed again and again")
    place.run("resume", "one").wait()
    seen = len(states)
    ros.until(lambda: len(states) > seen + 10, "samples after the pause")

    place.run("stop", "one").wait()
    assert launched.wait() == 130, launched.errors


def wait_until_set(ros: Ros, place: Place) -> None:
    with place.session() as session:

        def is_set() -> bool:
            ros.turn()
            samples = [reply.ok for reply in session.get("fmu_mesh/one/gain/in/u") if reply.ok is not None]
            return [sample.payload.to_string() for sample in samples] == ["1.5"]

        wait_until(is_set, "the goal that was published before the gateway came")


def test_overrides_of_the_node_of_one_fmu_make_an_output_latched(ros: Ros) -> None:
    from rclpy.qos import DurabilityPolicy  # noqa: PLC0415 only where ROS is installed

    overrides = {"qos_overrides./y.publisher.durability": "transient_local", "qos_overrides./y.publisher.depth": 1}
    node = ros.fmu(fmu_path=str(FMUS / "Gain.fmu"), **overrides)
    peer = ros.peer()
    node.trigger_configure()

    def offered() -> bool:
        found = [own.qos_profile for own in peer.get_publishers_info_by_topic("/y")]
        return [own.durability for own in found] == [DurabilityPolicy.TRANSIENT_LOCAL]

    ros.until(offered, "a publisher that keeps its last value")
    assert node.get_parameter("qos_overrides./y.publisher.deadline").value >= 0
