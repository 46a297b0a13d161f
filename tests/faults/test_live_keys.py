"""Whatever comes by a key: it is used, refused or lost, counted, told once, and the run goes on."""

from __future__ import annotations

import json
import math
import signal
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Self

import psutil
import pytest
import zenoh

from tests.helpers import DEADLINE_S, Launched, Place, row_count, wait_until
from tests.key_meshes import client, key_lines, put_values, status_of, stepped_router, written

FLOOD = """
import json, sys
import zenoh

endpoint, key, count, timed = sys.argv[1], sys.argv[2], int(sys.argv[3]), sys.argv[4] == "timed"
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("connect/endpoints", json.dumps([endpoint]))
with zenoh.open(config) as session:
    own = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
    payloads = [json.dumps({"value": k % 7, "time": 1e3 + k * 1e-6}) if timed else str(k % 7) for k in range(1000)]
    for number in range(count):
        own.put(payloads[number % 1000])
    print("sent", flush=True)
"""
"""Publishes as fast as it can, as a program of its own."""


@pytest.fixture
def endpoint(place: Place) -> Iterator[str]:
    with stepped_router(place) as (_, endpoint):
        yield endpoint


_FLOODS = 5


class Live:
    """A gain of 1 with a key, in a mesh that runs in real time without an end; and what is said of it."""

    def __init__(self, place: Place, endpoint: str, *entries: dict[str, Any], **sections: Any) -> None:  # noqa: ANN401  as the file has it
        self.place, self.endpoint = place, endpoint
        self.result = place.folder / "live.csv"
        simulation = {"real_time_factor": 1, "stop_time": None, **sections.pop("simulation", {})}
        instances = sections.pop("instances", {"gain": {"fmu": "Gain"}})
        connections = [{"key": "plant/u", "to": "gain.u", **entry} for entry in entries]
        section = {"connect": [endpoint], "mode": "client"}
        config = written(place, "live", instances, connections, zenoh=section, simulation=simulation, **sections)
        self.launched: Launched = place.start("launch", config, "--no-progress")
        self._around = ExitStack()
        self.session = self._around.enter_context(client(endpoint))
        wait_until(lambda: row_count(self.result) > 5, "rows")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._around.close()

    def put(self, *payloads: object, key: str = "plant/u") -> None:
        put_values(self.session, key, payloads)

    @property
    def keys(self) -> dict[str, Any]:
        """The status of the first key."""
        status = status_of(self.session, "live", "gain")
        return dict(status["keys"][0]) if status.get("keys") else {"received": 0}

    @property
    def value(self) -> float:
        [reply] = self.session.get("fmu_mesh/live/gain/in/u", timeout=DEADLINE_S)
        assert reply.ok is not None
        return float(json.loads(reply.ok.payload.to_bytes()))

    def has_handled(self, count: int) -> bool:
        """Whether so many values were used, refused or lost."""
        keys = self.keys
        return len(key_lines(self.result)) + int(keys["refused"]) + int(keys["lost"]) == count

    def has(self, **counts: int) -> dict[str, Any]:
        """The status, once these counts are reached."""

        def reached() -> dict[str, Any] | None:
            keys = self.keys
            return keys if all(keys[name] >= count for name, count in counts.items()) else None

        keys = wait_until(reached, f"{counts}")
        assert {name: keys[name] for name in counts} == counts, keys
        return keys

    def gets(self, value: float) -> None:
        wait_until(lambda: self.value == value, f"the value {value}")

    def goes_on(self) -> None:
        before = row_count(self.result)
        wait_until(lambda: row_count(self.result) > before + 10, "more rows")

    def stop(self) -> str:
        """Stop the run; what it has told."""
        assert self.place.run("stop", "live").wait() == 0
        assert self.launched.wait() in (0, 130), self.launched.story()  # 130 where it has a stop time
        assert "Traceback" not in self.launched.errors, self.launched.errors
        return self.launched.errors


def nodes_memory(launched: Launched) -> int:
    """Bytes of the node, without pages that others share."""
    return int(psutil.Process(launched.child("gain").pid).memory_full_info().uss)


# --- what is no value

WRONG: tuple[object, ...] = (
    "wet",
    None,
    True,
    [1.0],
    {"other": 1.0},
    b"",
    b"{",
    b"\xff\xfe",
    b"NaN",
    "NaN",
    "INF",
    b"1e400",
    b"9" * 5000,
    b"[" * 100_000,
    b"x" * 64 * 2**20,
)


def test_what_is_no_value_is_refused_counted_and_told_once(place: Place, endpoint: str) -> None:
    with Live(place, endpoint, {}) as live:
        live.put(2.5)
        live.has(received=1, refused=0)
        for number, payload in enumerate(WRONG, start=1):
            live.put(payload)
            live.has(received=number + 1, refused=number)
        live.session.delete("plant/u")
        live.has(refused=len(WRONG) + 1)
        live.goes_on()
        assert live.value == 2.5
        live.put({"value": 3.5})
        live.has(received=len(WRONG) + 3)
        wait_until(lambda: live.value == 3.5, "the right value")

        told = live.stop()

    assert told.count("a value of 'plant/u', which feeds 'gain.u', is refused: ") == 1, told
    assert [line[3] for line in key_lines(live.result)] == [2.5, 3.5]


@pytest.mark.parametrize("encoding", ["float64", "cdr", "text", "json"])
def test_wrong_payloads_of_each_encoding_are_refused(encoding: str, place: Place, endpoint: str) -> None:
    more = {"type": "std_msgs/msg/Float64"} if encoding == "cdr" else {}
    right = {"float64": struct.pack("<d", 1.5), "cdr": b"\0\1\0\0" + struct.pack("<d", 1.5), "text": b"1.5"}
    nan = {"float64": struct.pack("<d", math.nan), "cdr": b"\0\1\0\0" + struct.pack("<d", math.inf), "text": b"NaN"}
    wrong = [b"", b"wet", b"\0" * 5, b"\xff" * 4096, nan.get(encoding, b'{"value": "NaN"}')]
    with Live(place, endpoint, {"encoding": encoding, **more}) as live:
        for number, payload in enumerate(wrong, start=1):
            live.put(payload)
            live.has(refused=number)
        live.put(right.get(encoding, b'{"value": 1.5}'))
        live.has(received=len(wrong) + 1, refused=len(wrong))
        wait_until(lambda: live.value == 1.5, "the right value")
        live.stop()


# --- floods


@pytest.mark.parametrize("kind", ["arrival", "timed"])
def test_a_flood_neither_stops_the_run_nor_fills_its_memory(kind: str, place: Place, endpoint: str) -> None:
    (place.folder / "flood.py").write_text(FLOOD)
    count = 100_000
    with Live(place, endpoint, {"time": "time"} if kind == "timed" else {}) as live:
        sizes = [nodes_memory(live.launched)]
        keys: dict[str, Any] = {}
        for flood in range(1, _FLOODS + 1):
            command = [sys.executable, str(place.folder / "flood.py"), endpoint, "plant/u", str(count), kind]
            sender = place.start_command(command)
            live.goes_on()
            assert sender.wait() == 0, sender.story()
            keys = live.has(received=flood * count)
            live.goes_on()
            if kind == "timed":
                wait_until(partial(live.has_handled, flood * count), "nothing that waits to be decoded")
            sizes.append(nodes_memory(live.launched))
            if kind == "arrival":
                assert keys["refused"] == keys["lost"] == 0
                assert keys["replaced"] > 0
        told = live.stop()

    # As many samples as may wait, 65,536 of 0.9 kB, may have waited, and the allocator keeps their memory. If all that
    # came were left, it would be 450 MB.
    assert max(sizes) - sizes[0] < 128 * 2**20, sizes
    if kind == "arrival":
        assert len(key_lines(live.result)) == _FLOODS * count - keys["replaced"]
    else:
        used = len(key_lines(live.result))
        assert used + keys["refused"] + keys["lost"] == _FLOODS * count
        assert told.count("a value of 'plant/u', which feeds 'gain.u'") <= 3, told


def test_more_values_than_can_wait_end_a_run_that_waits_for_all(place: Place, endpoint: str) -> None:
    config = written(
        place,
        "live",
        {"gain": {"fmu": "Gain"}},
        [{"key": "plant/u", "to": "gain.u", "time": "arrival", "wait": True}],
        zenoh={"connect": [endpoint], "mode": "client"},
        simulation={"stop_time": 1e4, "real_time_factor": 1},
    )
    launched = place.start("launch", config, "--no-progress")
    with client(endpoint) as session:
        put_values(session, "plant/u", [1.0] * 70_000)
        assert launched.wait() == 4, launched.story()

    assert "a value of 'plant/u', which feeds 'gain.u' is lost" in launched.message
    assert "Its publisher has to wait for this run." in launched.message


# --- times


def test_a_silent_key_is_told_and_is_no_error(place: Place, endpoint: str) -> None:
    with Live(place, endpoint, {}, timeouts={"start": 4.0}) as live:
        told = live.launched.wait_for_error_line("'plant/u'")
        assert "has not come in 4 s: does somebody publish this key, on this network?" in told
        live.put(1.0)
        live.has(received=1)
        assert live.stop().count("'plant/u'") == 1


def test_a_clock_that_jumps_back_replaces_no_later_value(place: Place, endpoint: str) -> None:
    with Live(place, endpoint, {"time": "t", "field": "v"}) as live:
        live.put({"t": 0.02, "v": 1.0}, {"t": 0.03, "v": 2.0})
        live.has(received=2, late=2, disordered=0)
        live.put({"t": 0.01, "v": 3.0}, {"t": -1e6, "v": 4.0}, {"t": -1e299, "v": 5.0})
        live.has(received=5, disordered=3, late=5)
        live.goes_on()
        assert live.value == 2.0
        live.put({"t": 0.04, "v": 6.0})
        live.has(received=6)
        wait_until(lambda: live.value == 6.0, "the newest value")
        told = live.stop()

    assert told.count("is for an earlier time than the one before it") == 1
    assert told.count("has come after its time") == 1
    assert len(key_lines(live.result)) == 6


def test_values_after_the_end_are_refused(place: Place, endpoint: str) -> None:
    with Live(place, endpoint, {"time": "t", "field": "v"}, simulation={"stop_time": 1e3}) as live:
        live.put({"t": 1e3, "v": 1.0}, {"t": 1000.01, "v": 2.0}, {"t": 1e300, "v": 3.0}, {"t": 1.7e9, "v": 3.0})
        live.has(received=4, refused=3)
        told = live.stop()

    assert told.count("is later than 1000 s, the end of the simulation") == 1
    assert [line[2:] for line in key_lines(live.result)] == [(1e3, 1.0)]


def test_values_before_the_start_are_used_from_point_0_on(place: Place, endpoint: str) -> None:
    config = written(
        place,
        "live",
        {"gain": {"fmu": "Gain"}},
        [{"key": "plant/u", "to": "gain.u", "time": "t", "field": "v", "wait": True}],
        zenoh={"connect": [endpoint], "mode": "client"},
        simulation={"stop_time": 0.05},
    )
    launched = place.start("launch", config, "--no-progress")
    with client(endpoint) as session:
        put_values(session, "plant/u", [{"t": -3.0, "v": 1.0}, {"t": -0.001, "v": 2.0}, {"t": 0.03, "v": 3.0}])
        wait_until(lambda: row_count(place.folder / "live.csv") == 5, "the points that have values")
        put_values(session, "plant/u", [{"t": 7.0, "v": 9.0}, {"t": 0.05, "v": 4.0}])
        assert launched.wait() == 0, launched.story()

    assert [row.split(",")[1] for row in (place.folder / "live.csv").read_text().split()[1:]] == [
        "0.0",
        "2.0",
        "2.0",
        "2.0",
        "3.0",
        "3.0",
    ]


def test_a_first_value_that_was_missed_ends_a_run_that_waits(place: Place, endpoint: str) -> None:
    config = written(
        place,
        "live",
        {"gain": {"fmu": "Gain"}},
        [{"key": "plant/u", "to": "gain.u", "time": "t", "field": "v", "wait": True}],
        zenoh={"connect": [endpoint], "mode": "client"},
    )
    launched = place.start("launch", config, "--no-progress")
    with client(endpoint) as session:
        put_values(session, "plant/u", [{"t": 0.02, "v": 1.0}])
        assert launched.wait() == 4, launched.story()

    assert "is for 0.02 s: the one for 0 s is lost" in launched.message


# --- keys and routers


def test_the_newest_value_of_several_keys_counts(place: Place, endpoint: str) -> None:
    with Live(place, endpoint, {"key": "plant/*/u", "take": "newest"}) as live:
        for number, name in enumerate(("a", "b", "a", "c"), start=1):
            live.put(float(number), key=f"plant/{name}/u")
            live.has(received=number)
            live.gets(float(number))
        live.session.put("plant/u", "9.0")
        live.session.put("plant/a/b/u", "9.0")
        live.goes_on()
        assert live.value == 4.0
        live.stop()

    assert [line[3] for line in key_lines(live.result)] == [1.0, 2.0, 3.0, 4.0]


def test_a_router_that_comes_back_brings_the_values_again(place: Place) -> None:
    with stepped_router(place) as (router, endpoint), Live(place, endpoint, {}) as live:
        live.put(1.0)
        live.has(received=1)
        router.signal(signal.SIGKILL)
        router.wait()
        live.goes_on()
        with stepped_router(place, endpoint):
            live.put(2.0)
            live.has(received=2, lost=0)
            wait_until(lambda: live.value == 2.0, "the value after the cut")
            told = live.stop()

    assert "was lost" not in told


def test_a_slow_reader_loses_what_may_be_dropped(place: Place, endpoint: str) -> None:
    """The run goes on at its own pace; a reader that stands for a while gets the newest values again."""
    out: dict[str, Any] = {"key": "twin/y", "from": "gain.y"}
    out.pop("to", None)
    instances = {"gain": {"fmu": "Gain"}}
    config = written(
        place,
        "live",
        instances,
        [out],
        zenoh={"connect": [endpoint], "mode": "client"},
        simulation={"step_size": 0.001, "real_time_factor": 1, "stop_time": None},
    )
    launched = place.start("launch", config, "--no-progress")
    result: Path = place.folder / "live.csv"
    with client(endpoint) as session:
        own = session.declare_subscriber("twin/y", zenoh.handlers.RingChannel(5))
        next_of: Callable[[], int] = lambda: json.loads(own.recv().payload.to_bytes())["point"]  # noqa: E731  a name for what is called twice
        first = next_of()
        before = row_count(result)
        wait_until(lambda: row_count(result) > before + 2000, "rows")
        assert next_of() > first + 1000
        assert place.run("stop", "live").wait() == 0
        assert launched.wait() == 0, launched.story()
