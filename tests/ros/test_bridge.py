"""The mesh, the real bridge, DDS and a real ROS 2 node: what one sends is what the other gets."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tests.helpers import Place, free_port, rows_of, wait_until, write_config
from tests.ros.peers import Peer, bridge, bridge_binary, need

COUNT = 1000
FLOAT = "std_msgs/msg/Float64"
TWIST = "geometry_msgs/msg/TwistStamped"
CLOCK = "rosgraph_msgs/msg/Clock"
LONG_S = 60.0


@pytest.fixture
def port(place: Place) -> Iterator[int]:
    """The port of a bridge that runs; without one, or without ROS, the test is skipped with the reason."""
    need("rclpy", "geometry_msgs", "rosgraph_msgs")
    bridge_binary()
    port = free_port()
    with bridge(place.folder, port):
        yield port


def test_a_thousand_samples_each_way_arrive_with_their_values_and_stamps(place: Place, port: int) -> None:
    config = write_config(
        place.folder,
        name="lab",
        instances={
            "pendulum": {"fmu": "DampedPendulum", "start_values": {"a": 1.3}},
            "gain": {"fmu": "Gain", "start_values": {"k": 1.0}},
            "held": {"fmu": "Gain", "start_values": {"k": 1.0}},
        },
        connections=[],
        stop_time=LONG_S,
        simulation={"step_size": 0.01, "real_time_factor": 1},
        ros={
            "connect": [f"tcp/127.0.0.1:{port}"],
            "distribution": "kilted",
            "topics": [
                {"topic": "/angle", "variable": "pendulum.a"},
                {
                    "topic": "/state",
                    "type": TWIST,
                    "fields": {"twist.linear.x": "pendulum.a", "twist.angular.z": "pendulum.der(a)"},
                    "frame_id": "base",
                },
                {"topic": "/command", "variable": "gain.u"},
                {"topic": "/held", "type": TWIST, "fields": {"twist.linear.x": "held.u"}},
            ],
        },
    )
    orders = {
        "subscribe": {"/angle": FLOAT, "/state": TWIST, "/clock": CLOCK},
        "publish": {"/command": FLOAT, "/held": TWIST},
        "sim_time": 0.2,
        "count": COUNT,
    }

    with Peer("rclpy_peer.py", orders) as peer:
        mesh = place.start("launch", config, "--no-progress")
        with _puts(place, "fmu_mesh/lab/*/set/u") as puts:
            peer.answer(0, 60.0)
            found = peer.answer(1, 60.0)
            wait_until(lambda: {len(values) for values in puts.values()} == {COUNT}, "every message as a setting")
        last = f",{0.1 * COUNT!r},"
        wait_until(lambda: last in (place.folder / "lab.csv").read_text("utf-8"), "the last setting in the result")
        mesh.signal(signal.SIGINT)
        mesh.wait()
    rows = rows_of(place.folder / "lab.csv")

    _assert_outputs(found["received"], rows)
    assert puts["fmu_mesh/lab/gain/set/u"] == [0.1 * number for number in range(1, COUNT + 1)]
    assert puts["fmu_mesh/lab/held/set/u"] == [0.5 * number for number in range(1, COUNT + 1)]
    assert rows[-1][4] == 0.1 * COUNT
    _assert_never_early([row[0] for row in rows], [row[5] for row in rows], found["stamps"])
    assert {topic: found["graph"][topic] for topic in ("/angle", "/state", "/command", "/held", "/clock")} == {
        "/angle": [FLOAT],
        "/state": [TWIST],
        "/command": [FLOAT],
        "/held": [TWIST],
        "/clock": [CLOCK],
    }
    assert {topic: len(hashes) for topic, hashes in found["hashes"].items()} == dict.fromkeys(found["hashes"], 1)
    assert "WARNING" not in mesh.errors


def test_loop_at_500_hz_gives_numbers_of_one_process_while_ros_watches(place: Place, port: int) -> None:
    def configured(name: str, **sections: Any) -> Path:  # noqa: ANN401 sections of a configuration
        return write_config(
            place.folder,
            name=name,
            instances={
                "body": {"fmu": "Integrator", "start_values": {"k": 1.0, "y": 1.0}},
                "controller": {"fmu": "Gain", "start_values": {"k": -3.7}},
            },
            connections=["body.y -> controller.u", "controller.y -> body.u"],
            stop_time=10.0,
            simulation={"step_size": 0.002, "real_time_factor": sections.pop("factor", 0)},
            **sections,
        )

    watched = configured(
        "watched",
        factor=1,
        ros={
            "connect": [f"tcp/127.0.0.1:{port}"],
            "distribution": "kilted",
            "topics": [
                {
                    "topic": "/loop",
                    "type": TWIST,
                    "fields": {"twist.linear.x": "body.y", "twist.angular.z": "controller.y"},
                }
            ],
        },
    )
    alone = configured("alone")

    with Peer("rclpy_peer.py", {"subscribe": {"/loop": TWIST}, "count": COUNT}) as peer:
        mesh = place.start("launch", watched, "--no-progress")
        seen = peer.answer(1, 60.0)["received"]["/loop"]
        code = mesh.wait()
    local = place.run("launch", alone, "--local", "--no-progress")
    rows = rows_of(place.folder / "watched.csv")

    assert (code, local.wait()) == (0, 0), mesh.errors
    assert (place.folder / "alone.csv").read_bytes().replace(b"alone", b"watched") == (
        place.folder / "watched.csv"
    ).read_bytes()
    first = round(_time(seen[0]) / 0.002)
    assert [(_time(own), own["twist"]["linear"]["x"], own["twist"]["angular"]["z"]) for own in seen] == [
        (round(time, 9), y, u) for time, y, u in rows[first : first + COUNT]
    ]


def _assert_outputs(received: dict[str, list[Any]], rows: list[tuple[float, ...]]) -> None:
    """Every sample is that of its point, and no point is missing; columns: time, a, der(a), der(a,2), gain, held."""
    states = received["/state"][:COUNT]
    first = round(_time(states[0]) / 0.01)
    assert [
        (_time(own), own["twist"]["linear"]["x"], own["twist"]["angular"]["z"], own["header"]["frame_id"])
        for own in states
    ] == [(round(row[0], 9), row[1], row[2], "base") for row in rows[first : first + COUNT]]
    angles = [own["data"] for own in received["/angle"][:COUNT]]
    column = [row[1] for row in rows]
    assert angles in [column[at : at + COUNT] for at, angle in enumerate(column) if angle == angles[0]]
    ticks = [own["clock"]["sec"] * 100 + own["clock"]["nanosec"] // 10**7 for own in received["/clock"][:COUNT]]
    assert ticks == list(range(ticks[0], ticks[0] + COUNT))


def _assert_never_early(times: list[float], held: list[float], stamps: list[int]) -> None:
    """A stamped value never holds before its stamp: the output at the end of the step that begins then is its first."""
    for number, stamp in enumerate(stamps, start=1):
        reached = next((time for time, value in zip(times, held, strict=True) if value >= 0.5 * number), None)
        assert reached is None or reached * 1e9 >= stamp + 10_000_000 - 1, (number, reached, stamp)


def _time(message: dict[str, Any]) -> float:
    stamp = message["header"]["stamp"]
    return float(f"{stamp['sec']}.{stamp['nanosec']:09d}")


@contextlib.contextmanager
def _puts(place: Place, key: str) -> Iterator[dict[str, list[float]]]:
    """What is put on the keys of inputs, by key; what the instances themselves say there has a point."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", f'["{place.note().endpoints[0]}"]')
    puts: dict[str, list[float]] = {}

    def keep(sample: zenoh.Sample) -> None:
        if sample.attachment is None or b"point" not in sample.attachment.to_bytes():
            puts.setdefault(str(sample.key_expr), []).append(float(sample.payload.to_string()))

    with zenoh.open(config) as session, session.declare_subscriber(key, keep):
        yield puts
