"""The arm of `examples/ros` under ros2_control, at the level of messages: a node plays the hardware interface.

ros2_control cannot be installed here. The node publishes what JointStateTopicSystem publishes (a stamp, all names in
the order of its own URDF, positions and nothing else), and reads as it does (best effort, position and velocity at the
index of each name). ROS, the gateway, MuJoCo and the FMUs are real.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.helpers import DEADLINE_S, Place
from tests.ros.ros_peer import Ros, ros_or_skip

ros_or_skip()
pytest.importorskip("mujoco")
pytest.importorskip("sensor_msgs", reason="pip install '.[test-ros]'")

ARM = Path(__file__).parents[2] / "examples/ros/ros2_control_arm.yaml"
NEAR = 0.02
"""How near a joint has to come to its target, in rad and rad/s. Every other target is at least 0.4 rad away."""


class Hardware:
    """The part of JointStateTopicSystem."""

    def __init__(self, ros: Ros) -> None:
        from rclpy.parameter import Parameter  # noqa: PLC0415 only where ROS is installed
        from rclpy.qos import qos_profile_sensor_data  # noqa: PLC0415 as above
        from sensor_msgs.msg import JointState  # noqa: PLC0415 as above

        self._ros = ros
        self._message = JointState
        self._node = ros.peer("hardware", parameter_overrides=[Parameter("use_sim_time", value=True)])
        self.commands = self._node.create_publisher(JointState, "/arm/joint_commands", 1)
        self.states: list[Any] = []
        self.reader = self._node.create_subscription(
            JointState, "/arm/joint_states", self.states.append, qos_profile_sensor_data
        )

    def write(self, **targets: float) -> None:
        """One cycle."""
        command = self._message(name=list(targets), position=list(targets.values()))
        command.header.stamp = self._node.get_clock().now().to_msg()
        self.commands.publish(command)

    def read(self) -> dict[str, tuple[float, float]]:
        """Position and velocity of each joint."""
        latest = self.states[-1]
        return dict(zip(latest.name, zip(latest.position, latest.velocity, strict=True), strict=True))

    def move(self, **targets: float) -> None:
        """Write in every cycle of 50 Hz until the arm is there."""
        end = time.monotonic() + DEADLINE_S
        while not self._there(targets):
            assert time.monotonic() < end, f"not at {targets} within {DEADLINE_S:g} s, but {self.read()}"
            self.write(**targets)
            self._ros.turn(0.02)

    def _there(self, targets: dict[str, float]) -> bool:
        return all(
            abs(position - targets[name]) < NEAR and abs(velocity) < NEAR
            for name, (position, velocity) in self.read().items()
            if name in targets
        )


@pytest.fixture
def hardware(place: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hardware]:
    """The hardware, with the arm and its gateway behind it."""
    config = yaml.safe_load(ARM.read_text(encoding="utf-8"))
    for instance in config["instances"].values():
        for kind in {"fmu", "mujoco"} & set(instance):
            instance[kind] = str(ARM.parent / instance[kind])
    config["record"]["file"] = str(tmp_path / "arm.csv")
    file = tmp_path / "arm.yaml"
    file.write_text(yaml.safe_dump(config), encoding="utf-8")
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(place.folder / "run"))
    with Ros(tmp_path / "log") as ros:
        hardware = Hardware(ros)
        commands = (
            ("-Pm", "fmu_mesh", "launch", str(file), "--no-progress"),
            ("-Pm", "fmu_mesh.ros.node", "--ros-args", "-p", f"config:={file}", "-p", "autostart:=true"),
        )
        processes = [subprocess.Popen([sys.executable, *command], env=os.environ) for command in commands]
        try:
            ros.matched(hardware.commands, hardware.reader)
            ros.until(lambda: hardware.states, "a state of the joints")
            yield hardware
        finally:
            for process in processes:
                process.terminate()
            for process in processes:
                process.wait(DEADLINE_S)


def test_joints_go_where_commands_send_them_in_any_order(hardware: Hardware) -> None:
    state = hardware.states[-1]
    assert state.name == ["joint1", "joint2"]
    assert len(state.position) == len(state.velocity) == len(state.effort) == 2

    hardware.move(joint2=-0.5, joint1=0.8)
    hardware.move(joint1=-0.3, joint2=0.4)
    hardware.move(joint2=0.9)  # a controller of one joint; the other one keeps its target

    assert hardware.read()["joint1"][0] == pytest.approx(-0.3, abs=NEAR)
