"""A mesh is paused, stepped and stopped by the services of `simulation_interfaces`, with ROS's own types."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import fmu_mesh
from fmu_mesh.ros_wire.definitions import MessageTypes
from fmu_mesh.ros_wire.simulation_types import (
    SIMULATION_SERVICES,
    ResultCode,
    SimulationStates,
    SimulatorFeature,
    define_simulation_types,
)
from tests.helpers import Launched, Place, free_port, row_count, rows_of, wait_until, write_config
from tests.ros.peers import Peer, need
from tests.ros.ros_peer import Ros, built_types_or_skip, ros_or_skip

ros_or_skip()
SHARED = Path(built_types_or_skip()["LD_LIBRARY_PATH"].split(os.pathsep)[0]).parent / "share/simulation_interfaces/srv"
need("mujoco")

WORLD = Path(__file__).parents[2] / "configs/worlds/fluid_body.xml"
PENDULUM = WORLD.with_name("damped_pendulum.xml")
STEP_SIZE = 0.001


@pytest.fixture
def ros(place: Place, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ros]:
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(place.folder / "run"))
    with Ros(place.folder / "log") as ros:
        yield ros


def configured(
    place: Place,
    *,
    factor: float = 0.0,
    stop_time: float = 1000.0,
    instances: dict[str, Any] | None = None,
    **ros: Any,  # noqa: ANN401 keys of the section
) -> Path:
    return write_config(
        place.folder,
        name="lab",
        instances={"world": {"mujoco": str(WORLD), "keyframe": "moving"}, **(instances or {})},
        connections=(),
        stop_time=stop_time,
        simulation={"step_size": STEP_SIZE, "real_time_factor": factor},
        record={"file": "lab.csv", "variables": ["world.cube.position_x"]},
        ros={"profile": "rclpy", "simulation_interfaces": True, "topics": [], **ros},
    )


class Simulator:
    """A client of each service of the mesh."""

    def __init__(self, ros: Ros, node: Any, peer: Any) -> None:  # noqa: ANN401 types of rclpy
        import simulation_interfaces.srv as services  # noqa: PLC0415 only where it is built

        self.node = node
        self._ros = ros
        self._services = services
        self._clients = {
            kind: peer.create_client(getattr(services, kind), f"/{name}")
            for kind, name in {
                "GetSimulatorFeatures": "get_simulator_features",
                "GetSimulationState": "get_simulation_state",
                "SetSimulationState": "set_simulation_state",
                "StepSimulation": "step_simulation",
                "ResetSimulation": "reset_simulation",
                "GetEntities": "get_entities",
                "GetEntityState": "get_entity_state",
                "SetEntityState": "set_entity_state",
            }.items()
        }

    def __call__(self, kind: str, **fields: Any) -> Any:  # noqa: ANN401 messages
        """The response to a request with these fields."""
        request = self.request(kind, **fields)
        return self._ros.called(self._clients[kind], request, once=True)

    def request(self, kind: str, **fields: Any) -> Any:  # noqa: ANN401 messages
        return getattr(self._services, kind).Request(**fields)

    def sent(self, kind: str, **fields: Any) -> Any:  # noqa: ANN401 messages
        """The future of a request."""
        return self._clients[kind].call_async(self.request(kind, **fields))

    @property
    def state(self) -> int:
        answer = self("GetSimulationState")
        assert answer.result.result == ResultCode.OK, answer.result.error_message
        return int(answer.state.state)

    def set(self, state: SimulationStates) -> tuple[int, str]:
        request = self.request("SetSimulationState")
        request.state.state = int(state)
        answer = self._ros.called(self._clients["SetSimulationState"], request, once=True)
        return answer.result.result, answer.result.error_message


@pytest.fixture
def started(request: pytest.FixtureRequest, ros: Ros, place: Place) -> tuple[Simulator, Launched, Any]:
    """A paused mesh with its gateway, and the clients of a peer; the parameter is for `configured`."""
    config = configured(place, **getattr(request, "param", {}))
    launched = place.start("launch", config, "--paused", "--no-progress")
    place.note()
    node = ros.fmu(config=str(config))
    peer = ros.peer()
    simulator = Simulator(ros, node, peer)
    ros.until(lambda: str(node.trigger_configure()).endswith("SUCCESS"), "the mesh")
    node.trigger_activate()
    ros.known_to("/fmi_adapter_node", peer)
    return simulator, launched, peer


def test_type_hashes_are_those_of_the_generator_of_ros() -> None:
    types = MessageTypes("kilted")
    define_simulation_types(types)

    for kind in SIMULATION_SERVICES:
        described = json.loads((SHARED / f"{kind}.json").read_text(encoding="utf-8"))["type_hashes"]
        hashes = {own["type_name"]: own["hash_string"] for own in described}
        for name in (own for own in hashes if own.startswith("simulation_interfaces/")):
            assert types.type_hash(name) == hashes[name], name


@pytest.mark.parametrize("started", [{"factor": 1.0}], indirect=True, ids=["paced"])
def test_mesh_is_paused_stepped_played_and_quit_from_ros(started: tuple[Simulator, Launched, Any]) -> None:
    simulator, launched, _peer = started

    assert {*simulator("GetSimulatorFeatures").features.features} >= {
        SimulatorFeature.STEP_SIMULATION_MULTIPLE,
        SimulatorFeature.STEP_SIMULATION_ACTION,
        SimulatorFeature.ENTITY_STATE_GETTING,
        SimulatorFeature.ENTITY_STATE_SETTING,
        SimulatorFeature.SIMULATION_RESET,
    }
    assert simulator.state == SimulationStates.PAUSED
    assert simulator.set(SimulationStates.PAUSED)[0] == ResultCode.ALREADY_IN_TARGET_STATE
    assert simulator("StepSimulation", steps=250).result.result == ResultCode.OK
    assert simulator.state == SimulationStates.PAUSED
    moved = simulator("GetEntityState", entity="world.cube").state
    assert (moved.header.stamp.sec, moved.header.stamp.nanosec) == (0, 250_000_000)
    assert simulator.set(SimulationStates.PLAYING) == (ResultCode.OK, "")
    assert simulator.state == SimulationStates.PLAYING
    refused = simulator("StepSimulation").result
    assert refused.result == ResultCode.OPERATION_FAILED
    assert "playing" in refused.error_message
    assert simulator.set(SimulationStates.LOADING_WORLD)[0] == ResultCode.INCORRECT_TRANSITION
    assert simulator.set(SimulationStates.PAUSED) == (ResultCode.OK, "")
    assert simulator.set(SimulationStates.QUITTING) == (ResultCode.OK, "")
    assert launched.wait() == 130, "a mesh with a stop time was stopped before"


def test_bodies_of_world_are_entities_with_pose_and_twist(
    started: tuple[Simulator, Launched, Any], place: Place
) -> None:
    simulator, _launched, _peer = started
    assert simulator("StepSimulation", steps=100).result.result == ResultCode.OK

    assert simulator("GetEntities").entities == ["world.cube", "world.free_cube"]
    request = simulator.request("GetEntities")
    request.filters.filter = "free"
    assert simulator._ros.called(simulator._clients["GetEntities"], request).entities == ["world.free_cube"]
    request.filters.filter = "(?i)^WORLD.f"
    assert simulator._ros.called(simulator._clients["GetEntities"], request).entities == ["world.free_cube"]
    request.filters.filter = "("
    assert (
        simulator._ros.called(simulator._clients["GetEntities"], request).result.result == ResultCode.OPERATION_FAILED
    )
    request.filters.tags.tags = ["red"]
    assert (
        simulator._ros.called(simulator._clients["GetEntities"], request).result.result
        == ResultCode.FEATURE_UNSUPPORTED
    )
    state = simulator("GetEntityState", entity="world.cube").state
    wait_until(lambda: len(rows_of(place.folder / "lab.csv")) > 100, "the row of the point")
    assert state.pose.position.x == rows_of(place.folder / "lab.csv")[100][1] != 0.0
    assert (state.pose.orientation.w, state.twist.linear.x, state.header.frame_id) == (1.0, 1.0, "world")
    assert simulator("GetEntityState", entity="world.nobody").result.result == ResultCode.NOT_FOUND


@pytest.mark.parametrize("started", [{"instances": {"arms": {"mujoco": str(PENDULUM)}}}], indirect=True, ids=["arms"])
def test_free_body_is_placed_exactly_and_results_list_it(
    started: tuple[Simulator, Launched, Any], place: Place
) -> None:
    simulator, launched, _peer = started
    pose = {"position": (1.0, -2.0, 3.0), "orientation": (0.0, 1.0, 0.0, 0.0)}  # w, x, y, z: a half turn
    twist = {"linear": (0.5, 0.25, -1.5), "angular": (2.0, -3.0, 0.125)}

    def asked(entity: str = "world.cube", frame: str = "world", **flags: bool) -> tuple[int, str]:
        request = simulator.request("SetEntityState", entity=entity, **flags)
        request.state.header.frame_id = frame
        put(request.state.pose.position, pose["position"])
        put(request.state.pose.orientation, pose["orientation"])
        put(request.state.twist.linear, twist["linear"])
        put(request.state.twist.angular, twist["angular"])
        answer = simulator._ros.called(simulator._clients["SetEntityState"], request, once=True).result
        return answer.result, answer.error_message

    def placed() -> list[float]:
        state = simulator("GetEntityState", entity="world.cube").state
        vectors = (state.pose.position, state.pose.orientation, state.twist.linear, state.twist.angular)
        return [number for vector in vectors for number in got(vector)]

    assert simulator("StepSimulation", steps=10).result.result == ResultCode.OK
    before = placed()
    assert asked() == (ResultCode.OK, ""), "nothing is to be set"
    assert placed() == before
    assert asked(set_twist=True) == (ResultCode.OK, "")
    assert placed() == [*before[:7], *twist["linear"], *twist["angular"]]
    assert asked(set_pose=True, set_twist=True, frame="") == (ResultCode.OK, "")
    assert placed() == [*pose["position"], *pose["orientation"], *twist["linear"], *twist["angular"]]
    assert simulator("StepSimulation", steps=5).result.result == ResultCode.OK
    after = placed()
    code, text = asked("arms.damped_by_fmu", set_pose=True)
    assert (code, "'arms.damped_by_fmu' has no free joint of MuJoCo" in text) == (ResultCode.OPERATION_FAILED, True)
    code, text = asked(set_pose=True, frame="map")
    assert (code, "the frame 'map'" in text) == (ResultCode.OPERATION_FAILED, True)
    pose["orientation"] = (0.0, 0.0, 0.0, 0.0)
    assert asked(set_pose=True)[0] == ResultCode.INVALID_POSE
    assert asked("world.nobody")[0] == ResultCode.NOT_FOUND
    assert placed() == after
    assert simulator.set(SimulationStates.QUITTING) == (ResultCode.OK, "")
    assert launched.wait() == 130

    state = [*pose["position"], 0.0, 1.0, 0.0, 0.0, *twist["linear"], *twist["angular"]]
    with fmu_mesh.load(place.folder / "lab.yaml").open() as system:
        system.step(10)
        system.set("world.cube.state", state)
        system.step(5)
        assert system.get("world.cube.state").tolist() == after
    result = fmu_mesh.Result.read(place.folder / "lab.csv")
    listed = [(own["instance"], own["variable"], own["point"]) for own in result.metadata["set"]]
    assert listed == [("world", "cube.twist", 10), ("world", "cube.state", 10)]
    assert result.metadata["set"][1]["value"] == state


def put(vector: Any, numbers: tuple[float, ...]) -> None:  # noqa: ANN401 a message
    for letter, number in zip("wxyz"[-len(numbers) :], numbers, strict=True):
        setattr(vector, letter, number)


def got(vector: Any) -> list[float]:  # noqa: ANN401 a message
    return [getattr(vector, letter) for letter in "wxyz" if hasattr(vector, letter)]


@pytest.mark.parametrize("started", [{"factor": 1.0}], indirect=True, ids=["paced"])
def test_reset_begins_again_at_first_point_with_equal_values(started: tuple[Simulator, Launched, Any]) -> None:
    simulator, _launched, _peer = started

    def cube() -> tuple[int, float, float]:
        state = simulator("GetEntityState", entity="world.cube").state
        return state.header.stamp.nanosec, state.pose.position.x, state.twist.linear.x

    assert simulator("ResetSimulation", scope=1).result.result == ResultCode.FEATURE_UNSUPPORTED, "the time alone"
    first = cube()
    assert simulator("StepSimulation", steps=100).result.result == ResultCode.OK
    moved = cube()
    assert simulator("ResetSimulation").result.result == ResultCode.OK
    assert simulator.state == SimulationStates.PAUSED
    assert cube() == first != moved
    assert simulator("StepSimulation", steps=100).result.result == ResultCode.OK
    assert cube() == moved
    assert simulator.set(SimulationStates.PLAYING) == (ResultCode.OK, "")
    assert simulator.set(SimulationStates.STOPPED) == (ResultCode.OK, "")
    assert (simulator.state, cube()) == (SimulationStates.STOPPED, first)
    assert simulator("StepSimulation").result.result == ResultCode.OPERATION_FAILED, "a stopped one is no paused one"
    assert simulator.set(SimulationStates.PAUSED) == (ResultCode.OK, "")
    assert (simulator.state, cube()) == (SimulationStates.PAUSED, first)


@pytest.mark.parametrize(
    "started", [{"topics": [{"topic": "/x", "variable": "world.cube.position_x"}]}], indirect=True, ids=["topic"]
)
def test_reset_is_a_jump_back_in_time_for_nodes_of_ros(started: tuple[Simulator, Launched, Any], ros: Ros) -> None:
    from rclpy.clock import JumpThreshold  # noqa: PLC0415 only where ROS is installed
    from rclpy.duration import Duration  # noqa: PLC0415 as above
    from rclpy.parameter import Parameter  # noqa: PLC0415 as above
    from std_msgs.msg import Float64  # noqa: PLC0415 as above

    simulator, _launched, _peer = started
    node = ros.peer("simulated", parameter_overrides=[Parameter("use_sim_time", value=True)])
    clock, jumps = node.get_clock(), list[int]()
    backward = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False)
    handle = clock.create_jump_callback(backward, post_callback=lambda jump: jumps.append(jump.delta.nanoseconds))
    subscription, places = ros.collect(node, Float64, "/x")
    ros.matched(subscription)
    ros.until(lambda: node.count_publishers("/clock"), "a clock")

    def stepped() -> list[float]:
        """The samples of the 100 points that are stepped now, once `/clock` says that they are over."""
        assert simulator("StepSimulation", steps=100).result.result == ResultCode.OK
        last = simulator("GetEntityState", entity="world.cube").state.pose.position.x
        ros.until(lambda: clock.now().nanoseconds == 100_000_000, "the time of the last point")
        ros.until(lambda: places and places[-1].data == last, "the sample of the last point")
        return [own.data for own in places[-100:]]

    first = stepped()
    assert jumps == []
    assert simulator("ResetSimulation").result.result == ResultCode.OK
    ros.until(lambda: jumps, "a jump")

    assert jumps == [-100_000_000]
    assert clock.now().nanoseconds == 0
    assert stepped() == first
    handle.unregister()


@pytest.mark.parametrize("started", [{"factor": 1.0}], indirect=True)
def test_state_is_told_and_mesh_pauses_during_a_long_step(started: tuple[Simulator, Launched, Any], ros: Ros) -> None:
    simulator, _launched, _peer = started

    long_step = simulator.sent("StepSimulation", steps=600_000)  # ten minutes: it is paced
    ros.until(lambda: simulator.state == SimulationStates.PLAYING, "the step")
    second = simulator("StepSimulation", steps=1).result
    assert simulator.set(SimulationStates.PAUSED) == (ResultCode.OK, "")

    ros.until(long_step.done, "the end of the step")
    assert second.result == ResultCode.OPERATION_FAILED
    ended = long_step.result().result
    assert ended.result == ResultCode.OPERATION_FAILED
    assert "before point 600000: another program controls it too" in ended.error_message
    assert simulator.state == SimulationStates.PAUSED


@pytest.mark.parametrize("started", [{"factor": 1.0}], indirect=True)
def test_node_that_is_deactivated_answers_a_waiting_step_and_comes_back(
    started: tuple[Simulator, Launched, Any], ros: Ros
) -> None:
    simulator, _launched, peer = started
    services = [own.srv_name for own in simulator.node.services]
    long_step = simulator.sent("StepSimulation", steps=600_000)
    ros.until(lambda: simulator.state == SimulationStates.PLAYING, "the step")

    simulator.node.trigger_deactivate()
    ros.until(long_step.done, "its answer")
    ros.until(lambda: len([*simulator.node.services]) == len(services) - len(SIMULATION_SERVICES), "no services")

    assert long_step.result().result.result == ResultCode.OPERATION_FAILED
    simulator.node.trigger_activate()
    ros.known_to("/fmi_adapter_node", peer)
    again = Simulator(ros, simulator.node, ros.peer("later"))
    assert again.set(SimulationStates.PLAYING)[0] == ResultCode.OK


@pytest.mark.parametrize(
    "started", [{"factor": 0.001, "simulation_interfaces": {"paced": False}}], indirect=True, ids=["unpaced"]
)
def test_steps_that_are_not_paced_are_faster_than_real_time_factor(
    started: tuple[Simulator, Launched, Any],
) -> None:
    simulator, _launched, _peer = started

    assert simulator("StepSimulation", steps=1000).result.result == ResultCode.OK  # paced, it would take 1000 s
    assert simulator.set(SimulationStates.PLAYING) == (ResultCode.OK, "")
    assert simulator.set(SimulationStates.PAUSED) == (ResultCode.OK, "")
    assert simulator("GetEntityState", entity="world.cube").state.header.stamp.sec == 1, "playing is paced again"


@pytest.mark.parametrize("started", [{"factor": 1.0}], indirect=True, ids=["paced"])
def test_action_steps_with_feedback_and_can_be_cancelled(started: tuple[Simulator, Launched, Any], ros: Ros) -> None:
    from rclpy.action import ActionClient  # noqa: PLC0415 only where ROS is installed
    from simulation_interfaces.action import SimulateSteps  # noqa: PLC0415 only where it is built

    simulator, _launched, peer = started
    client = ActionClient(peer, SimulateSteps, "/simulate_steps")
    ros.until(client.server_is_ready, "the action")
    told: list[tuple[int, int]] = []

    def take(message: Any) -> None:  # noqa: ANN401 a message
        told.append((message.feedback.completed_steps, message.feedback.remaining_steps))

    def accepted(steps: int) -> Any:  # noqa: ANN401 a handle of rclpy
        future = client.send_goal_async(SimulateSteps.Goal(steps=steps), feedback_callback=take)
        ros.until(future.done, "the goal")
        return future.result()

    def result(goal: Any) -> Any:  # noqa: ANN401 a handle, and a message of rclpy
        future = goal.get_result_async()
        ros.until(future.done, "the result")
        return future.result().result.result

    assert result(accepted(5)).result == ResultCode.OK
    assert told == [(done, 5 - done) for done in range(1, 6)]
    long_goal = accepted(1_000_000)
    ros.until(lambda: len(told) > 7, "feedback")
    long_goal.cancel_goal_async()
    cancelled = result(long_goal)
    assert cancelled.result == ResultCode.OPERATION_FAILED
    stamp = simulator("GetEntityState", entity="world.cube").state.header.stamp
    steps = round(stamp.nanosec * 1e-9 / STEP_SIZE)
    assert cancelled.error_message == f"cancelled after {steps - 5} steps"
    assert simulator.set(SimulationStates.PLAYING)[0] == ResultCode.OK
    refused = result(accepted(1))
    assert refused.result == ResultCode.OPERATION_FAILED
    assert "playing" in refused.error_message
    client.destroy()


def test_services_on_keys_of_rmw_zenoh_answer_an_independent_client(place: Place) -> None:
    need("zenoh_ros2_sdk")
    port = free_port()
    router = place.start("router", "--listen", f"tcp/127.0.0.1:{port}")
    wait_until(lambda: router.output, "the router")
    at: dict[str, Any] = {
        "profile": "rmw_zenoh",
        "domain": 7,
        "connect": [f"tcp/127.0.0.1:{port}"],
        "namespace": "/lab",
    }
    config = configured(place, distribution="kilted", **at)
    launched = place.start("launch", config, "--paused", "--no-progress")
    services = ["GetSimulatorFeatures", "GetSimulationState", "SetSimulationState", "StepSimulation", "GetEntityState"]
    orders = {"port": port, "domain": 7, "namespace": "/lab", "types": str(SHARED), "services": services}
    wait_until(lambda: row_count(place.folder / "lab.csv"), "point 0")

    with Peer("rmw_zenoh_peer.py", "simulation", orders) as peer:
        peer.answer(0)
        number = 0

        def asked(kind: str, **fields: object) -> dict[str, Any]:
            nonlocal number
            number += 1
            peer.say(order=[kind, fields])
            answer: dict[str, Any] = peer.answer(number)["answer"]
            return answer

        features = asked("GetSimulatorFeatures")["features"]["features"]
        before = asked("GetSimulationState")["state"]["state"]
        stepped = asked("StepSimulation", steps=100)["result"]
        moved = asked("GetEntityState", entity="world.cube")["state"]
        refused = asked("GetEntityState", entity="nobody")["result"]
        ended = asked("SetSimulationState", state=int(SimulationStates.QUITTING))["result"]
    launched.wait()
    router.signal(signal.SIGTERM)
    router.wait()

    assert SimulatorFeature.STEP_SIMULATION_MULTIPLE in features
    assert SimulatorFeature.STEP_SIMULATION_ACTION not in features, "actions are there through rclpy only"
    assert before == SimulationStates.PAUSED
    assert (stepped["result"], stepped["error_message"]) == (ResultCode.OK, "")
    assert moved["pose"]["position"]["x"] == rows_of(place.folder / "lab.csv")[100][1] != 0.0
    assert refused == {**refused, "result": ResultCode.NOT_FOUND, "error_message": "there is no entity 'nobody'"}
    assert ended["result"] == ResultCode.OK


def test_profile_of_a_bridge_is_refused_with_a_way_out(place: Place) -> None:
    config = configured(place, profile="ros2dds")

    done = place.run("check", config)

    assert done.wait() == 2
    assert "ros.simulation_interfaces" in done.errors
    assert "the profile rmw_zenoh or rclpy" in done.errors
