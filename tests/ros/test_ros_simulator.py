"""A mesh steps a simulator of ROS as an instance: another mesh of ours, and an independent one in Python."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import Launched, Place, row_count, rows_of, wait_until, write_config
from tests.ros.peers import free_port, need

DOMAIN = 7
STEP_SIZE = 0.01
TWIST = "geometry_msgs/msg/TwistStamped"
FLOAT = "std_msgs/msg/Float64"

PLANT = '''
import fmu_mesh


class Plant(fmu_mesh.Component):
    """A mass on a spring."""

    force = fmu_mesh.Input(0.1)
    position = fmu_mesh.Output(1.0)
    velocity = fmu_mesh.Output(0.0)

    def step(self, time, step_size):
        self.velocity += (self.force - self.position) * step_size
        self.position += self.velocity * step_size


class Controller(fmu_mesh.Component):
    """A force against the position and the velocity."""

    position = fmu_mesh.Input()
    velocity = fmu_mesh.Input()
    force = fmu_mesh.Output(0.1)

    def step(self, time, step_size):
        self.force = -0.3 * self.position - 0.7 * self.velocity + 0.01 * time
'''


@pytest.fixture
def port(place: Place) -> Iterator[int]:
    """The port of a router of ROS."""
    need("rosbags", "xxhash")
    number = free_port()
    router = place.start("router", "--listen", f"tcp/127.0.0.1:{number}")
    wait_until(lambda: router.output, "the router")
    yield number
    router.signal(signal.SIGTERM)
    router.wait()


def started(place: Place, port: int, step_size: float = STEP_SIZE, **ros: Any) -> Launched:  # noqa: ANN401 keys of the section
    """A mesh with the plant that other programs of ROS step."""
    (place.folder / "plant.py").write_text(PLANT)
    topics = [
        {
            "topic": "state",
            "type": TWIST,
            "fields": {"twist.linear.x": "plant.position", "twist.angular.z": "plant.velocity"},
        },
        {"topic": "speed", "variable": "plant.velocity"},
        {"topic": "force", "variable": "plant.force"},
    ]
    config = write_config(
        place.folder,
        name="lab",
        instances={"plant": {"python": "plant.py:Plant"}},
        connections=(),
        stop_time=100.0,
        simulation={"step_size": step_size},
        ros={
            "profile": "rmw_zenoh",
            "domain": DOMAIN,
            "distribution": "kilted",
            "connect": [f"tcp/127.0.0.1:{port}"],
            "namespace": "/lab",
            "simulation_interfaces": True,
            "topics": topics,
            **ros,
        },
    )
    launched = place.start("launch", config, "--paused", "--no-progress")
    wait_until(lambda: row_count(place.folder / "lab.csv"), "point 0")
    return launched


def section(port: int, *topics: dict[str, Any], step: float = STEP_SIZE, **more: Any) -> dict[str, Any]:  # noqa: ANN401 keys of the section
    """A simulator as an instance."""
    state = {
        "topic": "state",
        "type": TWIST,
        "outputs": {"twist.linear.x": "position", "twist.angular.z": "velocity"},
    }
    return {
        "ros_simulator": {
            "namespace": "/lab",
            "step": step,
            "connect": [f"tcp/127.0.0.1:{port}"],
            "domain": DOMAIN,
            "distribution": "kilted",
            **more,
        },
        "topics": [*topics] or [state, {"topic": "force", "type": FLOAT, "inputs": {"data": "force"}}],
    }


def controlled(
    folder: Path,
    plant: dict[str, Any],
    name: str = "outer",
    variables: tuple[str, ...] = ("position", "velocity"),
    **simulation: Any,  # noqa: ANN401 keys of the section
) -> Path:
    """A mesh with a plant and its controller."""
    return write_config(
        folder,
        name=name,
        instances={"plant": plant, "controller": {"python": "plant.py:Controller"}},
        connections=(
            "plant.position -> controller.position",
            "plant.velocity -> controller.velocity",
            "controller.force -> plant.force",
        ),
        stop_time=2.0,
        simulation={"step_size": STEP_SIZE, "algorithm": "jacobi", **simulation},
        record={
            "file": f"{name}.csv",
            "variables": [*(f"plant.{variable}" for variable in variables), "controller.force"],
        },
    )


@pytest.mark.parametrize("_", range(4))
def test_result_with_a_mesh_as_simulator_is_that_of_one_mesh(place: Place, port: int, _: int) -> None:
    simulator = started(place, port)
    outer = controlled(place.folder, section(port))
    one = controlled(place.folder, {"python": "plant.py:Plant"}, "one")

    assert place.run("launch", outer, "--no-progress").wait() == 0
    assert place.run("launch", one, "--no-progress").wait() == 0
    simulator.signal(signal.SIGINT)
    simulator.wait()

    assert (place.folder / "outer.csv").read_bytes() == (place.folder / "one.csv").read_bytes()
    assert len(rows_of(place.folder / "outer.csv")) == 201
