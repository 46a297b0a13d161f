"""The quality of service and the constants of topics: what a file may say, and where the topics are listed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import fmu_mesh
from fmu_mesh.cli.main import main
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.ros_wire.cdr import MAX_MESSAGE_SIZE
from tests.helpers import Place, write_config
from tests.ros.test_gateway_topics import configured, planned

TEXT = "std_msgs/msg/String"
DESCRIPTION: dict[str, Any] = {
    "topic": "/robot_description",
    "type": TEXT,
    "constants": {"data": {"file": "urdf/arm.urdf"}},
}


def with_file(folder: Path, content: bytes) -> Path:
    (folder / "urdf").mkdir()
    (folder / "urdf" / "arm.urdf").write_bytes(content)
    return folder


def problem(folder: Path, *topics: Any) -> str:  # noqa: ANN401 what a file may hold
    with pytest.raises(ConfigurationError) as caught:
        planned(folder, topics=list(topics))
    [finding] = caught.value.findings
    return f"{finding.path}: {finding.found}; {finding.expected}"


def test_a_topic_of_constants_is_latched_and_has_its_text(tmp_path: Path) -> None:
    plan = planned(with_file(tmp_path, "<robot/> ü".encode()), topics=[DESCRIPTION])

    [topic] = plan.topics
    assert (topic.direction, topic.ports, dict(topic.constants)) == ("out", (), {"data": "<robot/> ü"})
    assert str(topic.qos) == "reliable, transient_local, depth 1"


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"\xff<robot/>", "which cannot be read ('utf-8' codec can't decode byte 0xff"),
        (b"x" * (MAX_MESSAGE_SIZE + 1), f"which cannot be read (it has more than {MAX_MESSAGE_SIZE} bytes)"),
        (b"x" * MAX_MESSAGE_SIZE, "are too many for a message"),
    ],
    ids=["not UTF-8", "a byte more than a message", "as long as a message"],
)
def test_a_file_that_no_message_can_hold_is_refused(tmp_path: Path, content: bytes, reason: str) -> None:
    found = problem(with_file(tmp_path, content), DESCRIPTION)

    assert found.startswith("ros.topics[0].")
    assert reason in found


def test_a_missing_file_is_named_with_the_nearest_one(tmp_path: Path) -> None:
    with_file(tmp_path, b"<robot/>")
    with pytest.raises(ConfigurationError, match=r"arm\.udf', which cannot be read.*No such file.*arm\.urdf"):
        planned(tmp_path, topics=[{**DESCRIPTION, "constants": {"data": {"file": "urdf/arm.udf"}}}])


@pytest.mark.parametrize(
    ("topic", "expected"),
    [
        ({**DESCRIPTION, "constants": {"data": "x"}, "durability": "volatile"}, "topics[0].durability: volatile for"),
        ({**DESCRIPTION, "constants": {"data": "x"}, "deadline": 1.0}, "topics[0].deadline: 1 for a topic that is"),
        ({"variable": "gain.y", "deadline": 0.0}, "topics[0].deadline: 0; a time > 0 in s"),
        ({"type": TEXT, "constants": {"data": "x"}}, "topics[0].topic: no `topic`"),
        ({"topic": "/x", "type": TEXT}, "topics[0]: neither `variable` nor `fields`"),
        ({"topic": "/x", "type": TEXT, "constants": {"data": 1}}, "topics[0].constants.data: 1 for 'data' of"),
    ],
)
def test_what_makes_no_sense_for_a_topic_is_refused(tmp_path: Path, topic: dict[str, Any], expected: str) -> None:
    assert f"ros.{expected}" in problem(tmp_path, topic)


def test_two_topics_of_constants_need_two_names(tmp_path: Path) -> None:
    topic = {**DESCRIPTION, "constants": {"data": "x"}}

    assert "ros.topics[1]: the topic '/robot_description' for constants" in problem(tmp_path, topic, topic)


def test_check_and_graph_list_every_topic(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    topics: list[Any] = [DESCRIPTION, "pendulum.a", {"topic": "/joy", "variable": "gain.u", "deadline": 0.5}]
    path = configured(with_file(tmp_path, b"<robot/>"), topics=topics)

    assert main(["check", str(path)]) == 0
    page = " ".join(capsys.readouterr().out.split())
    assert main(["check", str(path), "--json"]) == 0
    plan = json.loads(capsys.readouterr().out)["plan"]

    assert f"publishes /robot_description {TEXT} reliable, transient_local, depth 1 constants" in page
    assert "publishes /pendulum/a std_msgs/msg/Float64 reliable, volatile, depth 1000 pendulum.a" in page
    assert "subscribes to /joy std_msgs/msg/Float64 reliable, volatile, depth 1000, deadline 0.5 s gain.u" in page
    assert "publishes /clock rosgraph_msgs/msg/Clock reliable, volatile, depth 1000 simulation time" in page
    assert plan["topics"][2] == {
        "topic": "/joy",
        "direction": "in",
        "type": "std_msgs/msg/Float64",
        "qos": {"reliability": "reliable", "durability": "volatile", "depth": 1000, "deadline": 0.5},
        "sources": ["gain.u"],
    }
    text = fmu_mesh.load(path).graph().text()
    assert "ROS  subscribes to /joy, std_msgs/msg/Float64," in text
    assert max(map(len, text.splitlines())) <= 80


def test_a_running_mesh_lists_its_topics_in_info_and_graph(place: Place) -> None:
    path = write_config(
        place.folder,
        name="told",
        instances={"gain": {"fmu": "Gain"}},
        connections=[],
        stop_time=1e6,
        simulation={"step_size": 0.01, "real_time_factor": 1},
        ros={"profile": "rclpy", "topics": ["gain.y"], "clock_rate": None},  # no gateway needs to be there
    )
    launched = place.start("launch", path, "--no-progress", "--paused")
    place.note()
    info = place.run("info", "told")
    graph = place.run("graph", "told")

    line = "publishes /gain/y  std_msgs/msg/Float64  reliable, volatile, depth 1000  gain.y"
    assert (info.wait(), graph.wait()) == (0, 0), info.errors + graph.errors
    assert f"ROS               {line}" in info.output
    assert "ROS  publishes /gain/y, std_msgs/msg/Float64" in graph.output
    place.run("stop", "told").wait()
    assert launched.wait() == 130, launched.errors
