"""The ROS examples: the chapter's integrated node gives the floats of the same system as a mesh."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fmu_mesh.cli.main import main
from tests.helpers import DEADLINE_S, rows_of
from tests.ros.ros_peer import Ros, ros_or_skip

ros_or_skip()

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Ros]:
    with Ros(tmp_path / "log") as ros:
        yield ros


def test_the_integrated_node_publishes_the_floats_of_the_mesh_with_both_fmus(ros: Ros, tmp_path: Path) -> None:
    from rosgraph_msgs.msg import Clock  # noqa: PLC0415 only where ROS is installed
    from std_msgs.msg import Float64  # noqa: PLC0415 as above

    config = str(ROOT / "configs" / "chapter_library_example.yaml")
    reference = tmp_path / "reference.csv"
    assert main(["launch", config, "--local", "--no-progress", "--output", str(reference)]) == 0
    expected = rows_of(reference)
    command = [sys.executable, str(ROOT / "examples" / "ros" / "integrated_node.py"), "--ros-args"]
    command += ["-p", "use_sim_time:=true", "-p", "pendulum.l:=2"]
    peer = ros.peer()
    clock = peer.create_publisher(Clock, "/clock", 10)
    angle, angles = ros.collect(peer, Float64, "angle")
    delayed, delayed_angles = ros.collect(peer, Float64, "delayed_angle")
    process = subprocess.Popen(command, env={**os.environ, **ros.environment})
    try:
        ros.matched(clock, angle, delayed)
        ros.known_to("/fmi_adapter_examples_integrated_node", peer)

        ticks = itertools.count()

        def one_more_step() -> bool:
            """Tell the next 20 ms, and look whether all is there; the node starts at a time that it hears."""
            message = Clock()
            message.clock.sec, message.clock.nanosec = divmod(10_000_000_000 + next(ticks) * 20_000_000, 1_000_000_000)
            clock.publish(message)
            return min(len(angles), len(delayed_angles)) >= 500

        ros.until(one_more_step, "10 s of steps")
    finally:
        process.terminate()
        assert process.wait(DEADLINE_S) == 0

    assert [message.data for message in angles][:500] == [row[1] for row in expected[1:501]]
    assert [message.data for message in delayed_angles][:500] == [row[2] for row in expected[1:501]]
