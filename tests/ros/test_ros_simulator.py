"""A mesh steps a simulator of ROS as an instance: another mesh of ours, and an independent one in Python."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml

import fmu_mesh
from fmu_mesh.ros_wire.simulation_types import SimulatorFeature
from tests.helpers import (
    DEADLINE_S,
    FMUS,
    Launched,
    Place,
    assert_readable,
    free_port,
    row_count,
    rows_of,
    wait_until,
    write_config,
)
from tests.ros.peers import Peer, need
from tests.ros.ros_peer import built_types_or_skip, environment, ros_or_skip

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
        stop_time=1000.0,
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


def test_result_with_a_mesh_as_simulator_is_that_of_one_mesh(place: Place, port: int) -> None:
    simulator = started(place, port)
    outer = controlled(place.folder, section(port))
    one = controlled(place.folder, {"python": "plant.py:Plant"}, "one")

    assert place.run("launch", outer, "--no-progress").wait() == 0
    assert place.run("launch", one, "--no-progress").wait() == 0
    simulator.signal(signal.SIGINT)
    simulator.wait()

    assert (place.folder / "outer.csv").read_bytes() == (place.folder / "one.csv").read_bytes()
    assert len(rows_of(place.folder / "outer.csv")) == 201


STEPPED = [SimulatorFeature.SIMULATION_STATE_PAUSE, SimulatorFeature.STEP_SIMULATION_SINGLE]
MANY = [*STEPPED, SimulatorFeature.STEP_SIMULATION_MULTIPLE, SimulatorFeature.SIMULATION_RESET]
STATE = {"topic": "state", "type": TWIST, "outputs": {"twist.linear.x": "position", "twist.angular.z": "velocity"}}
PUSH = {"topic": "push", "type": TWIST, "inputs": {"twist.linear.x": "force"}}


@contextmanager
def another(port: int, **orders: Any) -> Iterator[Peer]:  # noqa: ANN401 see simulator_peer.py
    """A simulator of others on rmw_zenoh."""
    need("zenoh_ros2_sdk")
    place = {"port": port, "domain": DOMAIN, "namespace": "/lab"}
    with Peer("simulator_peer.py", "rmw_zenoh", {"step": STEP_SIZE, "features": MANY, **place, **orders}) as peer:
        assert peer.answer(0) == {"declared": True}
        yield peer


@pytest.mark.parametrize("features", [MANY, [*STEPPED, SimulatorFeature.SIMULATION_RESET]], ids=["many", "single"])
def test_simulator_of_others_gives_the_result_of_one_mesh(place: Place, port: int, features: list[int]) -> None:
    (place.folder / "plant.py").write_text(PLANT)
    outer = controlled(place.folder, section(port, STATE, PUSH))
    one = controlled(place.folder, {"python": "plant.py:Plant"}, "one")

    with another(port, push=True, late=True, features=[int(own) for own in features]):
        assert place.run("launch", outer, "--no-progress").wait() == 0
        first = (place.folder / "outer.csv").read_bytes()
        assert place.run("launch", outer, "--no-progress").wait() == 0
    assert place.run("launch", one, "--no-progress").wait() == 0

    assert first == (place.folder / "one.csv").read_bytes()
    assert (place.folder / "outer.csv").read_bytes() == first, "it was reset"


SPEED = {"topic": "speed", "type": FLOAT, "outputs": {"data": "velocity"}, "match": "count"}
FORCE = {"topic": "force", "type": FLOAT, "inputs": {"data": "force"}}


def test_reset_of_a_mesh_resets_its_simulator(place: Place, port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(place.folder / "run"))
    started(place, port)
    outer = controlled(place.folder, section(port), stop_time=0.3)

    with fmu_mesh.load(outer).start(paused=True) as run:
        run.step(17)
        assert run.reset().point == 0
        run.resume()
        run.wait(DEADLINE_S)

    first, second = (rows_of(place.folder / name) for name in ("outer.csv", "outer-2.csv"))
    assert first == second[:18]
    assert len(second) == 31


def test_larger_step_and_topics_without_stamps_are_exact(place: Place, port: int) -> None:
    started(place, port)
    slow = {**STATE, "outputs": {"twist.linear.x": "position"}}
    outer = controlled(place.folder, section(port, slow, SPEED, FORCE), step_size=2 * STEP_SIZE)
    one = controlled(place.folder, {"python": "plant.py:Plant", "step_size": STEP_SIZE}, "one")
    held = yaml.safe_load(one.read_text())
    held["instances"]["controller"]["step_size"] = 2 * STEP_SIZE
    one.write_text(yaml.safe_dump(held))

    assert place.run("launch", outer, "--no-progress").wait() == 0
    assert place.run("launch", one, "--no-progress").wait() == 0

    assert rows_of(place.folder / "outer.csv") == rows_of(place.folder / "one.csv")[::2]


def test_slow_topic_holds_and_silent_one_has_start_values(place: Place, port: int) -> None:
    (place.folder / "plant.py").write_text(PLANT)
    slow = {"topic": "slow", "type": TWIST, "outputs": {"twist.linear.x": "slow"}, "every": 3}
    plant = section(port, STATE, slow, PUSH) | {"start_values": {"position": 1.0, "velocity": 0.0, "slow": 1.0}}
    outer = controlled(place.folder, plant, variables=("position", "slow"), stop_time=0.1)

    with another(port, push=True, late=True, silent=True):
        assert place.run("launch", outer, "--no-progress").wait() == 0

    rows = rows_of(place.folder / "outer.csv")
    assert [row[2] for row in rows] == [rows[point - point % 3][1] for point in range(11)]


def test_input_that_nobody_subscribes_to_is_a_warning(place: Place, port: int) -> None:
    (place.folder / "plant.py").write_text(PLANT)
    nowhere = {"topic": "nowhere", "type": FLOAT, "inputs": {"data": "force"}}
    outer = controlled(place.folder, section(port, STATE, nowhere), stop_time=0.1)

    with another(port):
        done = place.run("launch", outer, "--no-progress")

    assert done.wait() == 0
    assert "nobody subscribes to /lab/nowhere: these inputs have no effect" in done.errors


def test_example_of_the_page_drives_its_cart(place: Place, port: int) -> None:
    folder = Path(__file__).parents[2] / "examples/ros/simulator"

    def placed(name: str) -> str:
        text = (folder / name).read_text().replace("../../../results/", "").replace("../../../fmus", str(FMUS))
        config = yaml.safe_load(text)
        config.get("ros", config["instances"].get("cart", {}).get("ros_simulator"))["connect"] = [
            f"tcp/127.0.0.1:{port}"
        ]
        (place.folder / name).write_text(yaml.safe_dump(config))
        return name

    simulator = place.start("launch", placed("cart.yaml"), "--paused", "--no-progress")
    wait_until(lambda: row_count(place.folder / "cart.csv"), "point 0")

    assert place.run("launch", placed("controlled.yaml"), "--no-progress").wait() == 0
    simulator.signal(signal.SIGINT)
    simulator.wait()

    rows, cart = rows_of(place.folder / "controlled.csv"), rows_of(place.folder / "cart-2.csv")
    assert [row[1:3] for row in rows] == [row[1:3] for row in cart[::10]]
    assert len(rows) == 501
    assert abs(rows[-1][1] - 1.0) < abs(rows[0][1] - 1.0)


def failed(place: Place, port: int, *topics: dict[str, Any], plant: dict[str, Any] | None = None) -> str:
    """What a mesh says whose simulator fails."""
    (place.folder / "plant.py").write_text(PLANT)
    outer = controlled(place.folder, section(port, *topics, timeout=3.0, **(plant or {})))
    done = place.run("launch", outer, "--no-progress")
    assert done.wait() == 3
    assert_readable(done.message)
    return done.message


def test_failures_of_a_simulator_name_instance_point_and_reason(place: Place, port: int) -> None:
    said = failed(place, port)
    assert "instance plant: '/lab/get_simulator_features' did not answer within 3 s" in said
    assert "Start the simulator, which has to offer '/lab/step_simulation'" in said
    with another(port, features=[int(own) for own in STEPPED[:1]]):
        assert "does not offer STEP_SIMULATION_SINGLE" in failed(place, port)
    with another(port, push=True, refuse_at=5):
        said = failed(place, port, STATE, PUSH)
    assert "instance plant, point 4, t = 0.04 s: the simulator has refused 'step_simulation' (result 4)" in said
    assert "the solver has diverged" in said
    with another(port, push=True, end_at=7):
        said = failed(place, port, STATE, PUSH)
    assert "instance plant, point 6, t = 0.06 s: the server of '/lab/step_simulation' is gone" in said
    with another(port, push=True):
        every = {"topic": "slow", "type": TWIST, "outputs": {"twist.angular.z": "velocity"}}
        position = {**STATE, "outputs": {"twist.linear.x": "position"}}
        said = failed(place, port, position, every, PUSH)
        assert "point 0, t = 0 s: no message of this point on '/lab/slow'; the newest is at 0 s" in said
        assert "waited 3 s for that at 0.01 s. Does it publish there at every point?" in said
    with another(port, silent=True):
        said = failed(place, port, STATE, PUSH)
        assert "instance plant: no message of this point on '/lab/state'; waited 3 s for that at 0 s" in said
        assert "Otherwise give position, velocity start values" in said


def test_lost_router_ends_the_run_with_the_name_of_the_instance(place: Place) -> None:
    need("zenoh_ros2_sdk", "xxhash")
    number = free_port()
    router = place.start("router", "--listen", f"tcp/127.0.0.1:{number}")
    wait_until(lambda: router.output, "the router")
    (place.folder / "plant.py").write_text(PLANT)
    outer = controlled(place.folder, section(number, STATE, PUSH, timeout=3.0), stop_time=10_000.0)

    with another(number):
        launched = place.start("launch", outer, "--no-progress")
        wait_until(lambda: row_count(place.folder / "outer.csv") > 3, "some points")
        router.signal(signal.SIGKILL)
        assert launched.wait() == 3

    assert "instance plant, point" in launched.message
    assert "/lab/" in launched.message


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"ros_simulator": {"step": 0.004}}, "step_size: 0.01 s, no whole multiple of the 0.004 s"),
        ({"ros_simulator": {"step": -1.0}}, "ros_simulator.step: -1; expected a time > 0 in s"),
        ({"ros_simulator": {"timeout": 0.0}}, "ros_simulator.timeout: 0; expected a time > 0 in s"),
        ({"interpreter": "/usr/bin/python3"}, "has no fmu-mesh"),
        ({"interpreter": sys.executable}, "interpreter: with the profile rmw_zenoh; expected the profile rclpy"),
        ({"topics": [{**PUSH, "inputs": {"header.stamp.sec": "force"}}, STATE]}, "which is the simulation time"),
        ({"topics": [{**STATE, "type": "geometry_msgs/msg/Twists"}]}, "Did you mean 'geometry_msgs/msg/Twist'?"),
        ({"topics": [{**STATE, "outputs": {"twist.linear.w": "position"}}]}, "has no field 'twist.linear.w'"),
        ({"topics": [{**STATE, "outputs": {"twist.linear": "position"}}]}, "'twist.linear' of"),
        ({"topics": [STATE, PUSH, PUSH]}, "topics: force more than once"),
        ({"topics": [{**STATE, **PUSH}]}, "both `outputs` and `inputs`"),
        ({"topics": [{**SPEED, "match": "stamp"}]}, "topics[0]: 'std_msgs/msg/Float64', which has no header"),
        ({"topics": [{**STATE, "topic": "2d"}]}, "starts with a digit"),
    ],
)
def test_check_finds_what_is_wrong_in_a_section(place: Place, change: dict[str, Any], text: str) -> None:
    need("rosbags", "xxhash")
    (place.folder / "plant.py").write_text(PLANT)
    plant = section(17447, STATE, PUSH)
    config = controlled(
        place.folder, {**plant, **change, "ros_simulator": plant["ros_simulator"] | change.get("ros_simulator", {})}
    )

    done = place.run("check", config)

    assert done.wait() == 2
    assert text in done.errors


def test_check_warns_of_a_topic_whose_newest_message_counts(place: Place) -> None:
    need("rosbags", "xxhash")
    config = write_config(
        place.folder,
        instances={"plant": section(17447, {**SPEED, "match": "newest"}, step=0.001)},
        connections=(),
    )

    done = place.run("check", config)

    assert done.wait() == 0
    assert "instances.plant.ros_simulator: the newest message on speed: two runs may differ" in done.output


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a file to another user")
def test_interpreter_of_a_foreign_file_needs_permission(place: Place) -> None:
    need("rosbags", "xxhash")
    plant = section(17447, STATE, step=0.001, profile="rclpy") | {"interpreter": sys.executable}
    config = write_config(place.folder, instances={"plant": plant}, connections=())
    os.chown(config, 54321, 54321)

    refused, allowed = place.run("check", config), place.run("check", config, "--allow-code")

    assert refused.wait() == 2
    assert "instances.plant.ros_simulator: Python code, in a file of the user 54321" in refused.errors
    assert allowed.wait() == 0
    assert f"runs the ROS simulator in the namespace /lab with {sys.executable}" in allowed.errors


@pytest.fixture
def ros(place: Place) -> dict[str, str]:
    """The environment of ROS with its own types, which the test has, too."""
    ros_or_skip()
    place.environment |= built_types_or_skip() | environment(place.folder / "log")
    return dict(place.environment)


@contextmanager
def real(ros: dict[str, str], **orders: Any) -> Iterator[Peer]:  # noqa: ANN401 see simulator_peer.py
    """A simulator in rclpy."""
    whole = {"step": STEP_SIZE, "features": MANY, "namespace": "/lab", **orders}
    with Peer("simulator_peer.py", "rclpy", whole, environment=ros) as peer:
        assert peer.answer(0) == {"declared": True}
        yield peer


@pytest.mark.parametrize("interpreter", [None, sys.executable], ids=["own", "named"])
def test_simulator_in_rclpy_gives_the_result_of_one_mesh(
    place: Place, ros: dict[str, str], interpreter: str | None
) -> None:
    (place.folder / "plant.py").write_text(PLANT)
    plant = section(17447, {**STATE, "reliability": "reliable"}, FORCE, profile="rclpy", domain=None)
    outer = controlled(place.folder, plant | {"interpreter": interpreter})
    one = controlled(place.folder, {"python": "plant.py:Plant"}, "one")

    with real(ros, late=True):
        assert place.run("launch", outer, "--no-progress").wait() == 0
        first = (place.folder / "outer.csv").read_bytes()
        assert place.run("launch", outer, "--local", "--no-progress").wait() == 0
    assert place.run("launch", one, "--no-progress").wait() == 0

    assert first == (place.folder / "one.csv").read_bytes()
    assert (place.folder / "outer.csv").read_bytes() == first, "in one process, and after a reset"


def test_simulator_in_rclpy_that_ends_in_a_step_ends_the_run(place: Place, ros: dict[str, str]) -> None:
    (place.folder / "plant.py").write_text(PLANT)
    outer = controlled(place.folder, section(17447, STATE, FORCE, profile="rclpy", domain=None, timeout=5.0))

    with real(ros, end_at=7):
        done = place.run("launch", outer, "--no-progress")

    assert done.wait() == 3
    assert "instance plant, point 6, t = 0.06 s: " in done.message
    assert "/lab/step_simulation" in done.message
