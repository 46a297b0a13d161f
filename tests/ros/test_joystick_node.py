"""A joystick that dies, with real ROS: the input falls back at its exact point, and the deadline is missed."""

from __future__ import annotations

import json
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import Launched, Place, rows_of, wait_until, write_config
from tests.ros.ros_peer import Ros, ros_or_skip

ros_or_skip()

JOYSTICK = """
import sys
import rclpy
from geometry_msgs.msg import TwistStamped
from rclpy.duration import Duration
from rclpy.qos import QoSProfile

speed, deadline_s = map(float, sys.argv[1:])
rclpy.init()
node = rclpy.create_node("joystick")
quality = QoSProfile(depth=10, deadline=Duration(seconds=deadline_s))
publisher = node.create_publisher(TwistStamped, "/cmd_vel", quality)

def send():
    message = TwistStamped()
    message.header.stamp = node.get_clock().now().to_msg()
    message.twist.linear.x = speed
    publisher.publish(message)

node.create_timer(0.02, send)
rclpy.spin(node)
"""
"""Without `use_sim_time`, as joysticks are."""

STEP_SIZE, AFTER_S = 0.01, 2.0
POINTS = round(AFTER_S / STEP_SIZE)


@pytest.fixture
def ros(place: Place, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ros]:
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(place.folder / "run"))
    with Ros(place.folder / "log") as ros:
        place.environment = {**place.environment, **ros.environment}
        yield ros


class Vehicle:
    """A paused mesh that takes `/cmd_vel` and publishes `/speed`, and its gateway."""

    def __init__(self, ros: Ros, place: Place, then: str | float) -> None:
        from std_msgs.msg import Float64  # noqa: PLC0415 only where ROS is installed

        self._ros, self._place = ros, place
        timeout = {"after": AFTER_S, "then": then}
        command = {
            "topic": "/cmd_vel",
            "type": "geometry_msgs/msg/TwistStamped",
            "fields": {"twist.linear.x": "gain.u"},
        }
        config = write_config(
            place.folder,
            name="vehicle",
            instances={"gain": {"fmu": "Gain", "start_values": {"u": 0.25}, "inputs": {"u": {"timeout": timeout}}}},
            connections=(),
            stop_time=3600.0,
            simulation={"step_size": STEP_SIZE, "real_time_factor": 1.0},
            record={"file": "vehicle.csv", "variables": ["gain.y"]},
            ros={
                "profile": "rclpy",
                "topics": [{**command, "deadline": 0.5}, {"topic": "/speed", "variable": "gain.y"}],
            },
        )
        self.launched = place.start("launch", config, "--paused", "--no-progress")
        place.note()
        subscription, self._speeds = ros.collect(ros.peer(), Float64, "/speed")
        self.gateway = ros.fmu(config=str(config))
        ros.until(lambda: str(self.gateway.trigger_configure()).endswith("SUCCESS"), "the mesh")
        self.gateway.trigger_activate()
        ros.matched(subscription)

    def joystick(self, speed: float, deadline_s: float) -> Launched:
        """A process that says where to go, 50 times a second."""
        return self._place.start_command([sys.executable, "-c", JOYSTICK, str(speed), str(deadline_s)])

    def goes(self, speed: float) -> None:
        """Wait until the vehicle has this speed."""
        self._ros.until(lambda: self._speeds and self._speeds[-1].data == speed, f"a speed of {speed}")

    def resume(self) -> None:
        assert self._place.run("resume", "vehicle").wait() == 0

    def status(self) -> dict[str, Any]:
        done = self._place.run("status", "vehicle", "--json")
        assert done.wait() == 0, done.errors
        found: dict[str, Any] = json.loads(done.output)
        return found


def fell_back(errors: str, file: Path) -> tuple[float, list[float]]:
    """The output after the point at which the input fell back, and those of all points without a value before it."""
    found = re.search(r"input 'u' has had no value since point (\d+): it gets", errors)
    assert found is not None, errors
    last = int(found[1])
    speeds = [row[1] for row in rows_of(file)]
    return speeds[last + POINTS + 1], speeds[last + 1 : last + POINTS + 1]


def test_vehicle_falls_back_without_its_joystick_and_obeys_the_next(
    ros: Ros, place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    vehicle = Vehicle(ros, place, "start")
    joystick = vehicle.joystick(2.0, 0.1)
    ros.until(lambda: vehicle.gateway.count_publishers("/cmd_vel"), "the joystick")
    vehicle.resume()
    vehicle.goes(2.0)

    joystick.signal(signal.SIGKILL)
    vehicle.goes(0.25)

    assert "no simulation time of this run" in vehicle.launched.wait_for_error_line("'ros /cmd_vel'")
    wait_until(lambda: "'/cmd_vel': no message for 0.5 s, which is its deadline" in caplog.text, "the missed deadline")
    [link] = vehicle.status()["ros"]
    assert link["activity"] == "the node '/fmi_adapter_node' is the gateway"
    assert {own["topic"]: own["matched"] for own in link["topics"]}["/speed"]
    assert link["missed"]["/cmd_vel"] >= 1
    vehicle.joystick(-1.0, 0.1)
    vehicle.goes(-1.0)
    place.run("stop", "vehicle").wait()
    assert vehicle.launched.wait() == 130, vehicle.launched.errors
    assert fell_back(vehicle.launched.errors, place.folder / "vehicle.csv") == (0.25, [2.0] * POINTS)


def test_run_ends_where_its_joystick_is_lost_for_good(ros: Ros, place: Place) -> None:
    vehicle = Vehicle(ros, place, "stop")
    joystick = vehicle.joystick(2.0, 0.1)
    ros.until(lambda: vehicle.gateway.count_publishers("/cmd_vel"), "the joystick")
    vehicle.resume()
    vehicle.goes(2.0)

    joystick.signal(signal.SIGKILL)
    ros.until(lambda: not vehicle.launched.running, "the end of the run")

    assert vehicle.launched.wait() == 0, vehicle.launched.errors
    errors = vehicle.launched.errors
    found = re.search(r"gain\.u, point \d+, .*: there was no value since point (\d+), and it ends", errors)
    assert found is not None, errors
    speeds = [row[1] for row in rows_of(place.folder / "vehicle.csv")]
    assert len(speeds) == int(found[1]) + POINTS + 1
    assert speeds[-POINTS:] == [2.0] * POINTS
    ros.until(lambda: vehicle.gateway._state_machine.current_state[1] == "inactive", "the end of the gateway")


@pytest.mark.filterwarnings("ignore:Deprecated in favor of")  # rclpy warns of the QoS by a function that it deprecates
def test_joystick_that_promises_no_deadline_is_not_connected_and_named(
    ros: Ros, place: Place, capfd: pytest.CaptureFixture[str]
) -> None:
    vehicle = Vehicle(ros, place, "start")
    told = ""

    def refused() -> bool:
        nonlocal told
        told += capfd.readouterr().err
        return re.search(r"'/cmd_vel', offering incompatible QoS.*DEADLINE", told) is not None

    vehicle.joystick(2.0, 0.0)
    ros.until(refused, "a warning that the joystick promises less than is asked for")
    [link] = vehicle.status()["ros"]
    there = {own["topic"]: own["matched"] for own in link["topics"]}
    assert (there["/speed"], there["/cmd_vel"]) == (True, False)
    vehicle.resume()
    vehicle.joystick(3.0, 0.5)
    vehicle.goes(3.0)

    place.run("stop", "vehicle").wait()
    assert vehicle.launched.wait() == 130, vehicle.launched.errors
    assert 2.0 not in {row[1] for row in rows_of(place.folder / "vehicle.csv")}
