"""Joints and frames by their names with real ROS: in the node of one FMU, and in the gateway of a mesh."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import pytest

from tests.helpers import FMUS, Place, write_config
from tests.ros.peers import need
from tests.ros.ros_peer import Ros, built_types_or_skip, ros_or_skip

ros_or_skip()
need("sensor_msgs")

JOINTS = "sensor_msgs/msg/JointState"
TF = "tf2_msgs/msg/TFMessage"


@pytest.fixture
def ros(place: Place, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ros]:
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(place.folder / "run"))
    with Ros(place.folder / "log") as ros:
        yield ros


def gateway(ros: Ros, place: Place, *topics: dict[str, Any]) -> Any:
    """The gateway of a mesh of two gains, `weak` and `bare`, that runs."""
    config = write_config(
        place.folder,
        name="arm",
        instances={"weak": {"fmu": "Gain"}, "bare": {"fmu": "Gain"}},
        connections=(),
        stop_time=3600.0,
        simulation={"step_size": 0.01, "real_time_factor": 1.0},
        ros={"profile": "rclpy", "topics": list(topics)},
    )
    place.start("launch", config)
    place.note()
    node = ros.fmu(config=str(config))
    ros.until(lambda: str(node.trigger_configure()).endswith("SUCCESS"), "the mesh")
    node.trigger_activate()
    return node


def test_joint_commands_reach_their_joints_through_the_gateway_in_any_order(
    ros: Ros, place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    from sensor_msgs.msg import JointState  # noqa: PLC0415 only where ROS is installed

    peer = ros.peer()
    states, messages = ros.collect(peer, JointState, "/joint_states")
    publisher = peer.create_publisher(JointState, "/joint_commands", 10)
    gateway(
        ros,
        place,
        {
            "topic": "/joint_commands",
            "type": JOINTS,
            "fields": {"position[name=weak]": "weak.u", "position[name=bare]": "bare.u"},
        },
        {
            "topic": "/joint_states",
            "type": JOINTS,
            "fields": {"position[name=weak]": "weak.y", "position[name=bare]": "bare.y", "effort[name=bare]": "bare.y"},
        },
    )
    ros.matched(states, publisher)

    def commanded(names: list[str], position: list[float], *expected: float) -> None:
        publisher.publish(JointState(name=names, position=position))
        ros.until(lambda: messages and list(messages[-1].position) == [*expected], f"{expected}")

    commanded(["weak", "bare"], [0.5, -0.5], 0.5, -0.5)
    commanded(["bare", "weak"], [-0.25, 0.25], 0.25, -0.25)
    commanded(["bare"], [1.0], 0.25, 1.0)
    commanded(["elbow", "weak"], [9.0, 2.0], 2.0, 1.0)
    commanded(["weak", "bare", "weak"], [9.0, 4.0, 3.0], 3.0, 4.0)
    publisher.publish(JointState(name=["weak"], velocity=[7.0]))
    publisher.publish(JointState(name=["weak", "bare"], position=[8.0]))
    commanded(["bare"], [5.0], 3.0, 5.0)

    assert {tuple(own.name) for own in messages} == {("weak", "bare")}
    assert math.isnan(messages[-1].effort[0])
    assert messages[-1].effort[1] == 5.0
    assert list(messages[-1].velocity) == []
    said = caplog.text
    assert said.count("elements that no variable has are ignored: elbow; variables have bare, weak") == 1
    assert "'position[name=weak]' is one of 1 elements for 2 texts in 'name'" in said
    status = place.run("status", "arm")
    assert "1 elements on /joint_commands were ignored: no variable has their keys" in status.output, status.story()
    assert place.run("stop", "arm").wait() == 0


def test_frames_are_read_and_published_by_their_names(ros: Ros, place: Place) -> None:
    built_types_or_skip()
    from geometry_msgs.msg import TransformStamped  # noqa: PLC0415 only where ROS is installed
    from tf2_msgs.msg import TFMessage  # noqa: PLC0415 as above

    def frames(**numbers: float) -> Any:
        made = [TransformStamped(child_frame_id=name) for name in numbers]
        for own, number in zip(made, numbers.values(), strict=True):
            own.transform.translation.x = number
        return TFMessage(transforms=made)

    peer = ros.peer()
    seen, messages = ros.collect(peer, TFMessage, "/tf")
    publisher = peer.create_publisher(TFMessage, "/tracked", 10)
    path = "transforms[child_frame_id={}].transform.translation.x"
    gateway(
        ros,
        place,
        {
            "topic": "/tracked",
            "type": TF,
            "fields": {path.format("tool"): "weak.u", path.format("cube"): "bare.u"},
        },
        {
            "topic": "/tf",
            "type": TF,
            "frame_id": "world",
            "fields": {path.format("cube_2"): "bare.y", path.format("tool_2"): "weak.y"},
        },
    )
    ros.matched(seen, publisher)

    def shows(cube: float, tool: float) -> bool:
        return bool(messages) and [
            (own.header.frame_id, own.child_frame_id, own.transform.translation.x) for own in messages[-1].transforms
        ] == [("world", "cube_2", cube), ("world", "tool_2", tool)]

    for sent, cube, tool in (
        (frames(base=9.0, tool=1.0, cube=2.0), 2.0, 1.0),
        (frames(cube=3.0), 3.0, 1.0),
        (frames(cube=5.0, tool=4.0), 5.0, 4.0),
    ):
        publisher.publish(sent)
        ros.until(partial(shows, cube, tool), f"{cube} and {tool}")
    assert place.run("stop", "arm").wait() == 0


def test_node_of_one_fmu_reads_and_publishes_by_name(ros: Ros, capfd: pytest.CaptureFixture[str]) -> None:
    from sensor_msgs.msg import JointState  # noqa: PLC0415 only where ROS is installed

    node = ros.fmu(
        fmu_path=str(FMUS / "Adder.fmu"),
        step_size=0.01,
        messages=[
            f"/given: {{type: {JOINTS}, fields: {{'position[name=weak]': u1, 'velocity[name=bare]': u2}}}}",
            f"/taken: {{type: {JOINTS}, fields: {{'effort[name=\"a]b\"]': y}}}}",
        ],
    )
    peer = ros.peer()
    publisher = peer.create_publisher(JointState, "/given", 10)
    subscription, messages = ros.collect(peer, JointState, "/taken")
    node.trigger_configure()
    node.trigger_activate()
    ros.matched(publisher, subscription)

    def given(message: Any, expected: float) -> None:
        publisher.publish(message)
        ros.until(lambda: messages and list(messages[-1].effort) == [expected], f"{expected}")

    given(JointState(name=["bare", "weak"], position=[8.0, 0.5], velocity=[0.25, 8.0]), 0.75)
    given(JointState(name=["other", "bare"], velocity=[8.0, 1.0]), 1.5)
    given(JointState(name=["weak"], position=[2.0]), 3.0)
    publisher.publish(JointState(name=["weak", "bare"], position=[9.0], velocity=[9.0, 9.0]))
    given(JointState(name=["weak", "bare"], position=[4.0, 9.0], velocity=[math.nan, 4.0]), 8.0)

    assert {tuple(own.name) for own in messages} == {("a]b",)}
    said = capfd.readouterr().err
    assert said.count("'/given': elements that no variable has are ignored: other; variables have bare, weak") == 1
    assert "a message on '/given' was left out: 'position[name=weak]' is one of 1 elements for 2 texts" in said


def test_index_where_a_key_is_possible_is_warned_of(ros: Ros, capfd: pytest.CaptureFixture[str]) -> None:
    fields = {"/given": "{'position[0]': u}", "/taken": "{'position[0]': y}"}
    messages = [f"{topic}: {{type: {JOINTS}, fields: {own}}}" for topic, own in fields.items()]
    node = ros.fmu(fmu_path=str(FMUS / "Gain.fmu"), messages=messages)

    node.trigger_configure()

    said = capfd.readouterr().err
    assert "'position[0]' of '/given', whose elements may come in any order; expected a key: position[name=…]" in said
    assert "of '/taken'" not in said


@pytest.mark.parametrize(
    ("field", "complaint"),
    [
        ("position[nam=elbow]", "has no field 'position[nam=elbow]': 'nam' is no text that tells its elements apart"),
        ("position[nam=elbow]", "did you mean 'position[name=elbow]'?"),
        ("header[name=elbow]", "it is no array"),
    ],
)
def test_key_that_is_none_keeps_the_node_unconfigured(
    ros: Ros, capfd: pytest.CaptureFixture[str], field: str, complaint: str
) -> None:
    node = ros.fmu(fmu_path=str(FMUS / "Gain.fmu"), messages=[f"/given: {{type: {JOINTS}, fields: {{'{field}': u}}}}"])

    node.trigger_configure()

    assert node._state_machine.current_state[1] == "unconfigured"
    assert complaint in capfd.readouterr().err
