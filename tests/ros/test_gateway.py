"""The gateway as a process: what it carries from the first point to the last, and what its end means."""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import struct
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import psutil
import pytest
import zenoh

from fmu_mesh.ros_wire.cdr import Codec
from fmu_mesh.ros_wire.definitions import MessageTypes, Nested
from fmu_mesh.ros_wire.ros_names import dds_type
from tests.helpers import DEADLINE_S, Launched, Place, free_port, row_count, rows_of, wait_until, write_config

COMMANDS = 5000
JOINTS = "sensor_msgs/msg/JointState"
FLOAT = struct.Struct("<4xd")
TIME = struct.Struct("<4xiI")


class Ros:
    """The side of ROS: a router that gets what is published; keys are those of the bridge."""

    def __init__(self, session: zenoh.Session, port: int) -> None:
        self.session = session
        self.port = port
        self.samples: dict[str, list[bytes]] = {}
        self._subscriber = session.declare_subscriber("*", self._keep)

    def _keep(self, sample: zenoh.Sample) -> None:
        self.samples.setdefault(str(sample.key_expr), []).append(sample.payload.to_bytes())

    def floats(self, topic: str) -> list[float]:
        return [FLOAT.unpack(data)[0] for data in self.samples.get(topic, [])]

    def ticks(self) -> list[float]:
        return [sec + nanosec / 1e9 for sec, nanosec in map(TIME.unpack, self.samples.get("clock", []))]

    def wait_for(self, rows: list[tuple[float, ...]]) -> None:
        """Until as many samples have come as there are rows, and the tick of the last one."""
        wait_until(lambda: len(self.floats("angle")) >= len(rows), "every sample")
        wait_until(lambda: round(self.ticks()[-1], 9) == round(rows[-1][0], 9), "the last tick")


@pytest.fixture
def ros() -> Iterator[Ros]:
    port = free_port()
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{port}"]')
    with zenoh.open(config) as session:
        yield Ros(session, port)


def configured(
    place: Place,
    ros: Ros,
    *,
    factor: float,
    stop_time: float = 3.0,
    timeouts: dict[str, float] | None = None,
    inputs: dict[str, Any] | None = None,
    **more: Any,  # noqa: ANN401 keys of the section
) -> Path:
    return write_config(
        place.folder,
        name="lab",
        instances={
            "pendulum": {"fmu": "DampedPendulum", "start_values": {"a": 1.3}},
            "gain": {"fmu": "Gain", "inputs": inputs or {}},
        },
        connections=[],
        stop_time=stop_time,
        simulation={"step_size": 0.01, "real_time_factor": factor},
        timeouts=timeouts or {},
        ros={
            "connect": [f"tcp/127.0.0.1:{ros.port}"],
            "topics": [{"topic": "/angle", "variable": "pendulum.a"}, {"topic": "/command", "variable": "gain.u"}],
            **more,
        },
    )


@contextlib.contextmanager
def resting(place: Place, ros: Ros, config: Path) -> Iterator[tuple[Launched, psutil.Process, zenoh.Session]]:
    """A mesh that rests at point 150, its gateway, which has carried everything so far, and a session in the mesh."""
    mesh = place.start("launch", config, "--no-progress", "--paused")
    with place.session() as session:
        wait_until(lambda: commanded(session, "step", 150), "a mesh that has started")
        wait_until(lambda: len(ros.floats("angle")) == 151, "samples")
        [gateway] = place.processes("gateway")
        yield mesh, gateway, session


def commanded(session: zenoh.Session, command: str, points: int = 0) -> bool:
    """Whether the mesh does what it is told; at once, where the command line takes half a second."""
    payload = json.dumps({"command": command, "points": points})
    return any(reply.ok is not None for reply in session.get("fmu_mesh/lab/mesh/command", payload=payload))


def test_every_sample_arrives_and_the_clock_shows_every_point(place: Place, ros: Ros) -> None:
    config = configured(place, ros, factor=3)

    mesh = place.run("launch", config, "--no-progress")

    rows = rows_of(place.folder / "lab.csv")
    # Whoever takes longer than 3 s to start is told, rightly, that a router is there and no bridge.
    said = [line for line in mesh.errors.splitlines() if "no bridge to DDS is there" not in line]
    assert (mesh.wait(), len(said)) == (0, 1), mesh.errors
    assert len(rows) == 301
    ros.wait_for(rows)
    assert ros.floats("angle") == [row[1] for row in rows]
    assert [round(tick, 9) for tick in ros.ticks()] == [round(row[0], 9) for row in rows]
    place.assert_nothing_left()


def test_a_gateway_that_had_no_processor_at_end_still_carries_every_sample(place: Place, ros: Ros) -> None:
    with resting(place, ros, configured(place, ros, factor=3)) as (mesh, gateway, session):
        nodes = [mesh.child("pendulum"), mesh.child("gain")]
        gateway.suspend()
        assert commanded(session, "resume")
        wait_until(lambda: row_count(place.folder / "lab.csv") == 301, "the last point")
        assert psutil.wait_procs(nodes, DEADLINE_S)[1] == []

        gateway.resume()

        assert mesh.wait() == 0, mesh.errors
    rows = rows_of(place.folder / "lab.csv")
    ros.wait_for(rows)
    assert ros.floats("angle") == [row[1] for row in rows]
    ticks = [round(tick, 9) for tick in ros.ticks()]  # a clock that stood for a second tells its time again
    assert [tick for tick, _ in groupby(ticks)] == [round(row[0], 9) for row in rows]
    place.assert_nothing_left()


@pytest.mark.parametrize(
    ("away", "says"),
    [
        (False, "a gateway did not receive its last samples within 1 s"),
        (True, "a gateway was lost before the last point; ROS did not get the samples after it"),
    ],
    ids=["at the end", "for longer than Zenoh's lease"],
)
def test_a_gateway_that_never_comes_back_ends_with_mesh_and_is_told(
    place: Place, ros: Ros, *, away: bool, says: str
) -> None:
    config = configured(place, ros, factor=3, timeouts={"stop": 1.0, "link": 4.0})
    with resting(place, ros, config) as (mesh, gateway, session):
        gateway.suspend()
        if away:
            key = "fmu_mesh/lab/@sync/*/follower/*"
            wait_until(lambda: not list(session.liveliness().get(key, timeout=1.0)), "the end of its lease")
        assert commanded(session, "resume")

        assert mesh.wait() == 0, mesh.errors

    assert says in mesh.errors
    assert len(rows_of(place.folder / "lab.csv")) == 301
    place.assert_nothing_left()


def test_the_clock_stands_in_a_pause_and_goes_on_by_steps(place: Place, ros: Ros) -> None:
    mesh = place.start("launch", configured(place, ros, factor=1, stop_time=60.0, clock_rate=50), "--no-progress")
    wait_until(lambda: len(ros.ticks()) > 3, "the clock")

    assert place.run("pause", "lab").wait() == 0
    wait_until(lambda: len(ticks := ros.ticks()) > 2 and ticks[-1] == ticks[-2], "the same time a second time")
    stands = ros.ticks()[-1]
    with contextlib.suppress(StopIteration):
        ros.session.put("command", b"no message at all")
    assert place.run("step", "lab", "10").wait() == 0
    wait_until(lambda: ros.ticks()[-1] > stands + 0.09, "the clock after the step")
    wait_until(lambda: len(ticks := ros.ticks()) > 2 and ticks[-1] == ticks[-2], "the same time a second time")
    moved = ros.ticks()[-1]

    assert {round(late - early, 9) for early, late in zip(ros.ticks(), ros.ticks()[1:], strict=False)} <= {0.0, 0.02}
    assert stands + 0.08 <= moved <= stands + 0.1 + 0.02
    assert mesh.wait_for_error_line("a message of 17 bytes is no 'std_msgs/msg/Float64'")
    mesh.signal(signal.SIGINT)
    mesh.wait()


def test_after_a_reset_the_clock_jumps_back_and_every_sample_comes_again(place: Place, ros: Ros) -> None:
    with resting(place, ros, configured(place, ros, factor=3)) as (mesh, _, session):
        assert commanded(session, "reset")
        wait_until(lambda: commanded(session, "resume"), "the first point again")
        assert mesh.wait() == 0, mesh.errors

    before, rows = rows_of(place.folder / "lab.csv"), rows_of(place.folder / "lab-2.csv")
    assert (len(before), len(rows)) == (151, 301)
    ros.wait_for([*before, *rows])
    assert ros.floats("angle") == [row[1] for row in [*before, *rows]]
    ticks = [round(tick, 9) for tick in ros.ticks()]
    assert [tick for tick, _ in groupby(ticks)] == [round(row[0], 9) for row in [*before, *rows]]
    place.assert_nothing_left()


def test_gateway_that_dies_ends_run_with_its_name_and_what_was_recorded(place: Place, ros: Ros) -> None:
    mesh = place.start("launch", configured(place, ros, factor=1, stop_time=60.0), "--no-progress")
    wait_until(lambda: len(ros.floats("angle")) > 20, "samples")
    [gateway] = place.processes("gateway")

    gateway.kill()

    assert mesh.wait() == 4
    assert "the gateway to ROS was lost: its process was ended by SIGKILL" in mesh.message
    assert len(rows_of(place.folder / "lab.csv")) > 20
    place.assert_nothing_left(2.0)


def test_a_gateway_that_was_stopped_too_long_ends_the_run_by_name(place: Place, ros: Ros) -> None:
    config = configured(place, ros, factor=1, stop_time=600.0, timeouts={"link": 5.0})
    mesh = place.start("launch", config, "--no-progress")
    wait_until(lambda: len(ros.floats("angle")) > 20, "samples")
    [gateway] = place.processes("gateway")
    links = len(mesh.child("master").net_connections(kind="unix"))
    gateway.suspend()
    wait_until(lambda: len(mesh.child("master").net_connections(kind="unix")) <= links - 2, "the end of both its links")

    gateway.resume()

    assert mesh.wait() == 4
    assert "the gateway to ROS was lost: its process ended" in mesh.message
    place.assert_nothing_left(2.0)


def test_a_mesh_runs_on_where_somebody_accepts_and_says_nothing(place: Place, ros: Ros) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        endpoint = f"tcp/127.0.0.1:{silent.getsockname()[1]}"

        assert place.run("launch", configured(place, ros, factor=0, stop_time=1.0, connect=[endpoint])).wait() == 0

    assert len(rows_of(place.folder / "lab.csv")) == 101
    place.assert_nothing_left()


def test_a_mesh_runs_on_where_nobody_of_ros_is_there(place: Place, ros: Ros) -> None:
    config = configured(place, ros, factor=0, stop_time=1.0, connect=[f"tcp/127.0.0.1:{free_port()}"])

    assert place.run("launch", config, "--no-progress").wait() == 0

    assert len(rows_of(place.folder / "lab.csv")) == 101
    assert ros.samples == {}


def test_transforms_go_out_an_element_comes_in_and_none_changes_nothing(place: Place, ros: Ros) -> None:
    store = MessageTypes("jazzy").store
    poses = Codec(MessageTypes("jazzy"), "geometry_msgs/msg/PoseArray")
    empty = poses.empty()
    there = empty | {"poses": [poses.empty_field(Nested("geometry_msgs/msg/Pose")) for _ in range(2)]}
    there["poses"][1]["position"]["x"] = 2.5
    config = configured(
        place,
        ros,
        factor=1,
        stop_time=1000.0,
        topics=[
            {
                "topic": "/tf",
                "type": "tf2_msgs/msg/TFMessage",
                "fields": {"transforms[1].transform.rotation.w": "gain.y"},
                "constants": {"transforms[1].child_frame_id": "tool"},
                "frame_id": "world",
            },
            {"topic": "/poses", "type": "geometry_msgs/msg/PoseArray", "fields": {"poses[1].position.x": "gain.u"}},
        ],
    )

    def newest() -> Any:  # noqa: ANN401 a message of rosbags
        return store.deserialize_cdr(ros.samples["tf"][-1], "tf2_msgs/msg/TFMessage")

    mesh = place.start("launch", config, "--no-progress")
    wait_until(lambda: "tf" in ros.samples, "the first transform")
    ros.session.put("poses", poses.encode(there))
    wait_until(lambda: newest().transforms[1].transform.rotation.w == 2.5, "the element at the output")
    ros.session.put("poses", poses.encode(empty))
    wait_until(lambda: "that can be used: it has no 'poses[1].position.x'" in mesh.errors, "the warning")
    seen = len(ros.samples["tf"])
    wait_until(lambda: len(ros.samples["tf"]) > seen + 10, "a mesh that runs on")

    transforms = newest().transforms
    assert [own.child_frame_id for own in transforms] == ["", "tool"]
    assert [own.header.frame_id for own in transforms] == ["world", "world"]
    assert [own.transform.rotation.w for own in transforms] == [0.0, 2.5]
    stamps = [own.header.stamp.sec + own.header.stamp.nanosec / 1e9 for own in transforms]
    assert stamps[0] == stamps[1] > 0.1
    assert place.run("stop", "lab").wait() == 0
    assert mesh.wait() == 130, mesh.errors


@pytest.mark.parametrize("stop_time", [1000.0, None])
def test_commands_with_unix_times_take_effect_at_once(stop_time: float, place: Place, ros: Ros) -> None:
    """As a node without `use_sim_time` stamps them; a mesh without a stop time ignored all of them."""
    twists = Codec(MessageTypes("jazzy"), "geometry_msgs/msg/TwistStamped")
    command = {"topic": "/cmd", "type": "geometry_msgs/msg/TwistStamped", "fields": {"twist.linear.x": "gain.u"}}
    topics = [command, {"topic": "/angle", "variable": "gain.y"}]
    config = configured(place, ros, factor=1, stop_time=stop_time, topics=topics)

    mesh = place.start("launch", config, "--no-progress")
    wait_until(lambda: ros.floats("angle"), "the first output")
    sent: list[int] = []
    for number in (1, 2):
        sent.append(number)
        message = twists.empty()
        message["header"]["stamp"] = {"sec": 1_700_000_000 + number, "nanosec": 0}
        message["twist"]["linear"]["x"] = float(number)
        ros.session.put("cmd", twists.encode(message))
        wait_until(lambda: float(sent[-1]) in ros.floats("angle"), "the command at the output")

    assert place.run("stop", "lab").wait() == 0
    mesh.wait()
    assert mesh.errors.count("that 'ros /cmd' sends is no simulation time of this run") == 1, mesh.errors
    assert "Does it run with use_sim_time?" in mesh.errors


def test_a_joystick_that_dies_does_not_steer_for_ever(place: Place, ros: Ros) -> None:
    inputs = {"u": {"timeout": {"after": 0.5, "then": "start"}}}
    topics = [{"topic": "/command", "variable": "gain.u"}, {"topic": "/angle", "variable": "gain.y"}]
    config = configured(place, ros, factor=1, stop_time=1000.0, inputs=inputs, topics=topics)

    mesh = place.start("launch", config, "--no-progress")
    wait_until(lambda: ros.floats("angle"), "the first output")
    for _ in range(3):
        seen = len(ros.floats("angle"))
        ros.session.put("command", struct.pack("<4xd", 2.0).replace(bytes(4), b"\0\1\0\0", 1))
        wait_until(lambda: len(ros.floats("angle")) > seen + 30, "less than the timeout")  # noqa: B023  it waits here
    wait_until(lambda: ros.floats("angle")[-1] == 0.0, "the start value")

    values = [value for value, _ in groupby(ros.floats("angle"))]
    assert values == [0.0, 2.0, 0.0]
    assert place.run("stop", "lab").wait() == 0
    mesh.wait()


def test_all_fields_of_a_message_take_effect_at_one_point(place: Place, ros: Ros) -> None:
    points = Codec(MessageTypes("jazzy"), "geometry_msgs/msg/Point")
    pair = {"topic": "/pair", "type": "geometry_msgs/msg/Point"}
    config = write_config(
        place.folder,
        name="lab",
        instances={"adder": {"fmu": "Adder"}, "gain": {"fmu": "Gain", "step_size": 0.02}},
        connections=[],
        stop_time=1e4,
        simulation={"step_size": 1e-4, "real_time_factor": 1},
        record={"file": "lab.csv", "variables": ["adder.u1", "adder.y"]},
        ros={
            "connect": [f"tcp/127.0.0.1:{ros.port}"],
            "topics": [
                {**pair, "fields": {"x": "adder.u1", "y": "adder.u2", "z": "gain.u"}},
                {"topic": "/angle", "variable": "gain.y"},
            ],
        },
    )

    mesh = place.start("launch", config, "--no-progress")
    wait_until(lambda: ros.floats("angle"), "the first output")
    for number in map(float, range(1, 101)):
        ros.session.put("pair", points.encode({"x": number, "y": -number, "z": number}))
        wait_until(lambda: number in ros.floats("angle")[-1000:], "the message")  # noqa: B023  it waits here
    assert place.run("stop", "lab").wait() == 0
    mesh.wait()

    rows = rows_of(place.folder / "lab.csv")
    assert max(first for _, first, _ in rows) == 100.0
    assert {total for *_, total in rows} == {0.0}


@pytest.mark.parametrize("profile", ["ros2dds", "rmw_zenoh"])
def test_commands_go_to_their_joints_in_any_order_and_none_is_lost(place: Place, ros: Ros, profile: str) -> None:
    types = MessageTypes("jazzy")
    codec = Codec(types, JOINTS)
    key = "{}" if profile == "ros2dds" else f"0/{{}}/{dds_type(JOINTS)}/{types.type_hash(JOINTS)}"
    joints = {f"position[name={name}]": f"{name}.y" for name in ("weak", "bare")}
    config = write_config(
        place.folder,
        name="lab",
        instances={"weak": {"fmu": "Gain"}, "bare": {"fmu": "Gain"}},
        connections=[],
        stop_time=1000.0,
        simulation={"step_size": 0.01, "real_time_factor": 1},
        ros={
            "connect": [f"tcp/127.0.0.1:{ros.port}"],
            "profile": profile,
            "topics": [
                {"topic": "/command", "type": JOINTS, "fields": {own: f"{joints[own][:-2]}.u" for own in joints}},
                {"topic": "/states", "type": JOINTS, "fields": joints},
            ],
        },
    )

    def send(names: list[str], position: list[float]) -> None:
        data = codec.encode(codec.empty() | {"name": names, "position": position})
        ros.session.put(key.format("command"), data, congestion_control=zenoh.CongestionControl.BLOCK)

    def newest() -> tuple[list[str], list[float]]:
        message = codec.decode(states[-1].payload.to_bytes())
        return message["name"], message["position"].tolist()

    states: list[zenoh.Sample] = []
    puts: dict[str, list[float]] = {}

    def keep(sample: zenoh.Sample) -> None:
        if sample.attachment is not None and b"point" not in sample.attachment.to_bytes():
            puts.setdefault(str(sample.key_expr).split("/")[2], []).append(float(sample.payload.to_string()))

    def subscribed() -> bool:
        send(["bare", "weak"], [0.0, 0.0])
        return len(puts) == 2

    ros.session.declare_subscriber(key.format("states"), states.append)
    mesh = place.start("launch", config, "--no-progress")
    wait_until(lambda: bool(states), "the first state")
    send(["weak", "bare"], [0.5, -0.5])
    wait_until(lambda: newest() == (["weak", "bare"], [0.5, -0.5]), "both commands at their joints")
    send(["bare", "weak"], [-0.25, 0.25])
    wait_until(lambda: newest() == (["weak", "bare"], [0.25, -0.25]), "both in the other order")
    with place.session() as session, session.declare_subscriber("fmu_mesh/lab/*/set/u", keep):
        wait_until(subscribed, "a subscriber that the gateway knows")
        for number in range(1, COMMANDS + 1):
            own = {"weak": float(number), "bare": -float(number), "stranger": 0.0}
            send([*own][:: 1 if number % 2 else -1], [*own.values()][:: 1 if number % 2 else -1])
        numbers = [float(number) for number in range(1, COMMANDS + 1)]
        wait_until(lambda: {abs(own[-1]) for own in puts.values()} == {COMMANDS}, "the last command")
    send(["weak", "bare", "weak"], [7.0, 8.0])
    send(["bare"], [3.0])
    wait_until(lambda: newest() == (["weak", "bare"], [numbers[-1], 3.0]), "the command of one joint")

    assert [value for value in puts["weak"] if value] == numbers
    assert [-value for value in puts["bare"] if value] == numbers
    assert mesh.errors.count("elements that no variable has are ignored: stranger; variables have bare, weak") == 1
    assert "'position[name=weak]' is one of 2 elements for 3 texts in 'name'" in mesh.errors
    status = place.run("status", "lab")
    assert status.wait() == 0
    assert f"{COMMANDS} elements on /command were ignored: no variable has their keys" in status.output
    assert place.run("stop", "lab").wait() == 0
    assert mesh.wait() == 130, mesh.errors


def test_the_kept_configuration_with_topics_runs(place: Place) -> None:
    config = Path(__file__).resolve().parents[2] / "configs" / "pendulum_ros.yaml"

    assert place.run("launch", config, "--output", place.folder / "ros.csv", "--no-progress").wait() == 0

    assert len(rows_of(place.folder / "ros.csv")) == 1001


def test_the_gateway_by_hand_says_what_is_missing(place: Place) -> None:
    gateway = place.run("gateway", write_config(place.folder))

    assert gateway.wait() == 2
    assert "there is no section `ros`" in gateway.message


def test_an_instance_that_has_failed_is_in_diagnostics(place: Place, ros: Ros, faulty: Path) -> None:
    config = write_config(
        place.folder,
        name="lab",
        instances={"pump": {"fmu": str(faulty), "start_values": {"fail_at": 0.3}, "on_failure": "hold"}},
        connections=[],
        simulation={"step_size": 0.01, "stop_time": None, "real_time_factor": 1.0},
        ros={"connect": [f"tcp/127.0.0.1:{ros.port}"], "topics": []},
    )
    launched = place.start("launch", config)
    codec = Codec(MessageTypes(), "diagnostic_msgs/msg/DiagnosticArray")

    def failed() -> Any:  # noqa: ANN401  a message
        told = [codec.decode(data)["status"][0] for data in ros.samples.get("diagnostics", [])]
        return next((status for status in told if status["level"]), None)

    status = wait_until(failed, "a level that is not OK")

    assert (status["level"], status["name"]) == (2, "lab/pump")
    assert status["message"].startswith("held since point 30: fmi2DoStep returned error")
    assert place.run("stop", "lab").wait() == 0
    assert launched.wait() == 0
