"""Which message of a simulator belongs to a point: by stamp, by number, or the newest."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from fmu_mesh.instances.registry import KINDS
from fmu_mesh.instances.ros_simulator.output_topic import OutputTopic, SimulatorTime, WrongMessage
from fmu_mesh.instances.ros_simulator.simulator_topics import SimulatorTopics
from fmu_mesh.ros_wire.cdr import Codec
from fmu_mesh.ros_wire.stamp import to_stamp
from tests.ros.peers import need

STEP = 0.1


class Published:
    """A topic, and what a simulator publishes there."""

    def __init__(self, start_s: float | None = 0.0, **keys: Any) -> None:  # noqa: ANN401 keys of a topic
        need("rosbags")
        written = {
            "ros_simulator": {"step": STEP},
            "topics": [
                {"topic": "a", "type": "geometry_msgs/msg/TwistStamped", "outputs": {"twist.linear.x": "x"}, **keys}
            ],
        }
        section: Any = msgspec.convert({"@kind": "ros_simulator", **written}, KINDS.section("ros_simulator"))
        made = SimulatorTopics.of(section)
        (topic, own) = made.topics[0]
        self.time = SimulatorTime(STEP)
        self.time.begin(start_s)
        self.topic = OutputTopic(topic, own, made.types, self.time)
        self.topic.begin(silent=False)
        self._codec = Codec(made.types, topic.message)

    def publish(self, step: float, value: float, start_s: float = 0.0) -> None:
        message = self._codec.empty()
        message["header"]["stamp"] = to_stamp(start_s + step * STEP)
        message["twist"]["linear"]["x"] = value
        self.topic.take(self._codec.encode(message))

    def value_at(self, step: int) -> object:
        """The value at a step; None if no message has come for it."""
        return self.topic.values["x"] if self.topic.is_at(step) else None


def test_message_of_a_point_is_found_by_its_stamp() -> None:
    simulator = Published()
    simulator.publish(42, 9.0)  # from before the reset

    assert simulator.value_at(0) is None
    simulator.publish(0, 0.5)
    assert simulator.value_at(0) == 0.5
    simulator.publish(0, 0.5)
    simulator.publish(1, 1.5)
    assert simulator.value_at(2) is None
    simulator.publish(2.0000001, 2.5)
    simulator.publish(3, 3.5)
    assert [simulator.value_at(2), simulator.value_at(2), simulator.value_at(3)] == [2.5, 2.5, 3.5]
    simulator.publish(5, 5.5)
    with pytest.raises(WrongMessage, match=r"'/a' is at 0\.5 s already: does another program step the simulator\?"):
        simulator.value_at(4)
    assert simulator.topic.missing() == "no message of this point on '/a'; the newest is at 0.5 s"


def test_time_of_point_0_is_given_or_that_of_the_first_stamp() -> None:
    given, found = Published(7.0), Published(None)

    given.publish(0, 1.0)
    assert given.value_at(0) is None
    for simulator in (given, found):
        simulator.publish(0, 2.0, start_s=7.0)
        assert simulator.value_at(0) == 2.0
        simulator.publish(3, 3.0, start_s=7.0)
        assert simulator.value_at(3) == 3.0
        assert simulator.time.at(3) == 7.0 + 3 * STEP


def test_slow_topic_holds_between_its_messages() -> None:
    simulator = Published(every=3)
    simulator.publish(0, 0.5)

    assert [simulator.value_at(step) for step in range(4)] == [0.5, 0.5, 0.5, None]
    simulator.publish(3, 3.5)
    assert [simulator.value_at(step) for step in range(3, 6)] == [3.5, 3.5, 3.5]


def test_messages_without_stamps_are_counted() -> None:
    simulator = Published(match="count", every=2)
    for number in range(4):
        simulator.publish(0, 0.5 + number)

    assert [simulator.value_at(step) for step in (0, 1, 2, 6)] == [0.5, 0.5, 1.5, 3.5]
    assert simulator.value_at(8) is None


@pytest.mark.parametrize("match", ["stamp", "count", "newest"])
def test_silent_topic_has_no_message_of_point_0(match: str) -> None:
    simulator = Published(match=match)
    simulator.topic.begin(silent=True)

    assert simulator.topic.is_at(0)
    simulator.publish(1, 1.5)
    assert simulator.value_at(1) == 1.5


def test_newest_message_counts_where_the_user_says_so() -> None:
    simulator = Published(match="newest")

    assert simulator.value_at(0) is None
    simulator.publish(0, 0.5)
    simulator.publish(0, 0.75)
    assert [simulator.value_at(0), simulator.value_at(5)] == [0.75, 0.75]


def test_what_is_no_message_of_the_type_is_told() -> None:
    simulator = Published()
    simulator.topic.take(b"nothing")

    with pytest.raises(WrongMessage, match="a message on '/a' cannot be used: it does not start as CDR does"):
        simulator.value_at(0)


def test_messages_of_a_long_pause_do_not_matter() -> None:
    simulator = Published()
    for _ in range(1200):
        simulator.publish(0, 0.5)
    simulator.publish(1, 1.5)

    assert simulator.value_at(1) == 1.5


def test_more_messages_than_can_wait_end_the_run() -> None:
    simulator = Published(match="count")
    for _ in range(1200):
        simulator.topic.take(b"")

    with pytest.raises(
        WrongMessage, match=r"1,000 messages on '/a' wait, and more are lost: raise `depth` of the topic"
    ):
        simulator.value_at(0)
