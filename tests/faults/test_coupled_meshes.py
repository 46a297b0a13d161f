"""Two meshes coupled by keys, one of which stands, ends or is cut off: the other waits, says for what, and ends."""

from __future__ import annotations

import csv
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import psutil
import pytest

import fmu_mesh
from tests.helpers import Launched, Place, on_a_busy_machine, row_count, wait_until
from tests.key_meshes import client, status_of, stepped_router, written

X = {"fmu": "Integrator", "start_values": {"y": 1.0}}
V = {"fmu": "Integrator"}
ENDLESS_S = 1e4


class Pair(NamedTuple):
    """Two meshes that run, and what reaches them."""

    left: Launched
    right: Launched
    files: Sequence[Path]
    endpoint: str


@pytest.fixture
def router(place: Place) -> Iterator[tuple[Launched, str]]:
    with stepped_router(place) as router:
        yield router


def has_rows(file: Path) -> bool:
    return row_count(file) > 50


def started(place: Place, endpoint: str, *, step_s: float, stop_time: float = ENDLESS_S, factor: float = 0.0) -> Pair:
    """An oscillator of two meshes, both of which have made some points."""
    sections = {
        "zenoh": {"mode": "client", "connect": [endpoint]},
        "timeouts": {"step": step_s},
        "simulation": {"stop_time": stop_time, "real_time_factor": factor},
    }
    wait = {"time": "time", "wait": True}
    into_x, into_v = {"key": "pair/v", "to": "x.u", **wait}, {"key": "pair/x", "to": "v.u", "factor": -1.0, **wait}
    left = written(
        place, "left", {"x": X}, [into_x, {"from": "x.y", "key": "pair/x", "congestion": "block"}], **sections
    )
    right = written(
        place, "right", {"v": V}, [into_v, {"from": "v.y", "key": "pair/v", "congestion": "block"}], **sections
    )
    runs = [place.start("launch", config, "--no-progress") for config in (left, right)]
    for config in (left, right):
        wait_until(partial(has_rows, config.with_suffix(".csv")), f"50 rows of {config.stem}")
    return Pair(runs[0], runs[1], (left, right), endpoint)


def everyone(launched: Launched) -> list[psutil.Process]:
    own = psutil.Process(launched.pid)
    return [own, *own.children(recursive=True)]


def waits(endpoint: str, mesh: str, instance: str) -> str:
    """What an instance waits for, once it stands at a point."""
    with client(endpoint) as session:

        def activity() -> str | None:
            first = status_of(session, mesh, instance)
            second = status_of(session, mesh, instance)
            said = str(second.get("activity"))
            return said if "pair/" in said and first.get("point") == second.get("point") else None

        return wait_until(activity, f"a wait of {instance}")


def rows_of(config: Path) -> list[dict[str, str]]:
    with config.with_suffix(".csv").open() as file:
        return list(csv.DictReader(file))


def assert_equals_one_mesh(place: Place, pair: Pair, stop_time: float) -> None:
    connections: list[str | dict[str, Any]] = ["v.y -> x.u", {"from": "x.y", "to": "v.u", "factor": -1.0}]
    one = written(place, "one", {"x": X, "v": V}, connections, simulation={"stop_time": stop_time})
    fmu_mesh.load(one).run(processes=False)
    expected = rows_of(one)
    for config in pair.files:
        rows = rows_of(config)
        assert rows == [{name: row[name] for name in rows[0]} for row in expected]


WORDS = "no value for this point has come in"


def assert_ends_with_words(launched: Launched, what: str) -> None:
    assert launched.wait() == 4, launched.story()
    assert WORDS in launched.message
    assert what in launched.message
    assert "Is its publisher running, and connected?" in launched.message


@pytest.mark.parametrize("fault", ["stopped", "killed", "paused", "ended"])
def test_the_other_mesh_ends_with_words_after_its_deadline(
    fault: str, place: Place, router: tuple[Launched, str]
) -> None:
    pair = started(place, router[1], step_s=3.0)
    stood = everyone(pair.right)
    match fault:
        case "stopped":
            for process in stood:
                process.suspend()
        case "killed":
            for process in stood:
                process.kill()
        case "paused":
            assert place.run("pause", "right").wait() == 0
        case "ended":
            assert place.run("stop", "right").wait() == 0
            assert pair.right.wait() == 130, pair.right.story()  # before its stop time
    began = time.monotonic()

    said = waits(pair.endpoint, "left", "x")

    assert "a value of 'pair/v', which feeds 'x.u'" in said
    assert_ends_with_words(pair.left, "'pair/v', which feeds 'x.u'")
    assert time.monotonic() - began < on_a_busy_machine(10.0)
    if fault in ("stopped", "paused"):
        for process in stood:
            with suppress(psutil.NoSuchProcess):
                process.resume()
        pair.right.signal(signal.SIGINT)
        pair.right.wait()


@pytest.mark.parametrize("fault", ["stopped", "paused"])
def test_a_mesh_that_goes_on_costs_no_float(fault: str, place: Place, router: tuple[Launched, str]) -> None:
    stop_time = 8.0
    pair = started(place, router[1], step_s=60.0, stop_time=stop_time, factor=2.0)
    stood = everyone(pair.right)
    if fault == "stopped":
        for process in stood:
            process.suspend()
    else:
        assert place.run("pause", "right").wait() == 0

    waits(pair.endpoint, "left", "x")
    end = time.monotonic() + 1.0
    wait_until(lambda: time.monotonic() > end, "a while")
    if fault == "stopped":
        for process in stood:
            process.resume()
    else:
        assert place.run("resume", "right").wait() == 0

    for launched in (pair.left, pair.right):
        assert launched.wait() == 0, launched.story()
    assert_equals_one_mesh(place, pair, stop_time)


def test_a_router_that_comes_back_costs_no_float(place: Place, router: tuple[Launched, str]) -> None:
    stop_time = 12.0
    pair = started(place, router[1], step_s=60.0, stop_time=stop_time, factor=2.0)
    router[0].signal(signal.SIGKILL)
    router[0].wait()
    end = time.monotonic() + 2.0
    wait_until(lambda: time.monotonic() > end, "a while without a router")

    with stepped_router(place, router[1]):
        for launched in (pair.left, pair.right):
            assert launched.wait() == 0, launched.story()

    assert_equals_one_mesh(place, pair, stop_time)


@pytest.mark.parametrize("how", ["Ctrl-C", "stop"])
def test_a_wait_for_a_key_ends_at_once(how: str, place: Place, router: tuple[Launched, str]) -> None:
    pair = started(place, router[1], step_s=60.0)
    pair.right.signal(signal.SIGINT)
    assert pair.right.wait() == 130
    waits(pair.endpoint, "left", "x")

    began = time.monotonic()
    if how == "Ctrl-C":
        pair.left.signal(signal.SIGINT)
    else:
        assert place.run("stop", "left").wait() == 0

    assert pair.left.wait() == 130, pair.left.story()
    assert time.monotonic() - began < on_a_busy_machine(4.0)
    assert WORDS not in pair.left.errors
    router[0].signal(signal.SIGTERM)
    assert router[0].wait() == 0
    place.assert_nothing_left(within_s=20.0)
