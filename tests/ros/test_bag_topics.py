"""Topics of a bag that a mesh does not publish at each point: subscribed ones, and those of constants."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

import fmu_mesh
from tests.helpers import write_config
from tests.ros.test_bag import messages_of

pytest.importorskip("mcap", reason="the package mcap is not installed; pip install '.[test]'")

TWIST = "geometry_msgs/msg/TwistStamped"
TOPICS: list[Any] = [
    {"topic": "/description", "type": "std_msgs/msg/String", "constants": {"data": {"file": "arm.urdf"}}},
    {
        "topic": "/velDes",
        "type": TWIST,
        "fields": {"twist.linear.x": "one.u", "twist.angular.z": "two.u"},
        "frame_id": "base",
    },
    {
        "topic": "/joints",
        "type": "sensor_msgs/msg/JointState",
        "fields": {"position[name=elbow]": "three.u", "position[name=wrist]": "four.u"},
    },
    {"topic": "/count", "type": "std_msgs/msg/Int32", "fields": {"data": "five.u"}},
]


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    (tmp_path / "arm.urdf").write_text("<robot/>", encoding="utf-8")
    names = ("one", "two", "three", "four", "five")
    config = write_config(
        tmp_path,
        name="bag",
        instances={name: {"fmu": "Gain", "start_values": {"k": 2.0}} for name in names},
        connections=[],
        stop_time=0.1,
        simulation={"step_size": 0.01},
        record={"file": "bag.mcap", "variables": [f"{name}.u" for name in names]},
        scenario={"values": {"one.u": {"times": [0.0, 0.05], "values": [1.0, 1.5]}, "four.u": 4.0, "five.u": 0.5}},
        ros={"topics": TOPICS},
    )
    fmu_mesh.load(config).run(processes=False)
    return tmp_path / "bag.mcap"


def test_subscribed_topics_have_the_message_type_of_the_configuration(bag: Path) -> None:
    found = messages_of(bag)

    assert sorted(found) == ["/clock", "/description", "/five/u", "/joints", "/velDes"]
    assert len(found["/velDes"]) == 11
    at, twist = found["/velDes"][6]
    assert (twist.twist.linear.x, twist.twist.angular.z, twist.header.frame_id) == (1.5, 0.0, "base")
    assert twist.header.stamp.nanosec == at == 60_000_000
    _, joints = found["/joints"][0]
    assert (list(joints.name), list(joints.position)) == (["elbow", "wrist"], [0.0, 4.0])
    # An Int32 cannot hold every value of the input, which is 0.5 here.
    assert {message.data for _, message in found["/five/u"]} == {0.5}


def test_a_constant_is_one_latched_message_that_rosbags_reads(bag: Path) -> None:
    from mcap.reader import make_reader  # noqa: PLC0415 an optional dependency
    from rosbags.highlevel import AnyReader  # noqa: PLC0415 as above
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 as above

    with bag.open("rb") as file:
        [(_, channel, message)] = make_reader(file).iter_messages(topics=["/description"])
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        connections = [own for own in reader.connections if own.topic == "/description"]
        [text] = [reader.deserialize(data, own.msgtype) for own, _, data in reader.messages(connections)]

    assert (message.log_time, text.data) == (0, "<robot/>")  # type: ignore[attr-defined]  # of the bag's own type
    [quality] = yaml.safe_load(channel.metadata["offered_qos_profiles"])
    assert {key: quality[key] for key in ("durability", "reliability", "depth", "history")} == {
        "durability": "transient_local",
        "reliability": "reliable",
        "depth": 1,
        "history": "keep_last",
    }


def test_a_bag_with_subscribed_topics_is_read_back_and_played(bag: Path, tmp_path: Path) -> None:
    result = fmu_mesh.Result.read(bag)
    config = write_config(
        tmp_path,
        name="again",
        instances={"one": {"fmu": "Gain"}},
        connections=[],
        stop_time=0.1,
        simulation={"step_size": 0.01},
        record={"file": "again.csv", "variables": ["one.u"]},
        scenario={"values": {"one.u": {"file": "bag.mcap", "topic": "/velDes:twist.linear.x"}}},
    )

    again = fmu_mesh.load(config).run(processes=False)

    assert result["four.u"].tolist() == [4.0] * 11
    # What is recorded of an input at a point is what the step to that point has used.
    assert result["one.u"].tolist() == [1.0] * 6 + [1.5] * 5
    assert again["one.u"].tolist()[1:] == result["one.u"].tolist()[:-1]
