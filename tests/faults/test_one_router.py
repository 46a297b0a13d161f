"""Meshes and nodes that meet on one router: who comes second is refused and changes nothing; a lost link is named."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType

import pytest

from tests.helpers import BY_STREAMS, BY_ZENOH, Launched, Place, row_count, rows_of, wait_until, write_config

POINTS = 10_000


@pytest.fixture
def router(place: Place) -> Iterator[Launched]:
    """A router that runs as long as the test."""
    launched = place.start("router", "--listen", "tcp/127.0.0.1:0")
    wait_until(lambda: "router at " in launched.output, "a router")
    yield launched
    if launched.running:
        launched.signal(signal.SIGTERM)
        launched.wait()


def endpoint_of(router: Launched) -> str:
    return router.output.split("router at ")[1].split()[0].rstrip(",")


def through(
    router: Launched,
    place: Place,
    mode: str,
    name: str = "pair.yaml",
    zenoh: Mapping[str, bool] = MappingProxyType({}),
    link_s: float = 30.0,
) -> Path:
    """A mesh of some seconds whose processes meet on the router, or on this host and the router."""
    config = write_config(
        place.folder,
        stop_time=POINTS * 0.001,
        simulation={"real_time_factor": 1},
        timeouts={"link": link_s},
        zenoh={"mode": mode, "connect": [endpoint_of(router)], **zenoh},
    )
    return config.rename(place.folder / name)


def assert_ends_well(first: Launched, result: Path) -> None:
    assert first.wait() == 0, first.story()
    assert "refused" not in first.errors
    assert len(rows_of(result)) == POINTS + 1


def test_a_second_launch_of_a_mesh_is_refused_without_disturbing_the_first(place: Place, router: Launched) -> None:
    config = through(router, place, "client")
    result = place.folder / "pair.csv"
    first = place.start("launch", config, "--no-progress")
    wait_until(lambda: row_count(result) > 100, "100 rows")

    second = place.start("launch", config, "--no-progress", "--output", "second.csv")

    assert second.wait() == 2
    assert second.message.startswith(
        "fmu-mesh: mesh 'pair' is already running where this master connects. Stop it first"
    )
    assert not (place.folder / "second.csv").exists()
    assert_ends_well(first, result)


def test_two_launches_of_a_mesh_that_router_makes_meet_do_not_mix(place: Place, router: Launched) -> None:
    """A router passes nothing on between peers; they meet when it has told them of each other, which takes its time."""
    config = through(router, place, "peer")
    result = place.folder / "pair.csv"
    first = place.start("launch", config, "--no-progress")
    wait_until(lambda: row_count(result) > 100, "100 rows")

    second = place.start("launch", config, "--no-progress", "--output", "second.csv")

    assert second.wait() in (0, 2), second.story()
    assert_ends_well(first, result)
    if second.wait() == 0:
        assert (place.folder / "second.csv").read_bytes() == result.read_bytes()


def test_a_second_process_for_a_node_is_refused_without_disturbing_the_first(place: Place, router: Launched) -> None:
    config = through(router, place, "client")
    result = place.folder / "pair.csv"
    # Each in a runtime folder of its own, as on hosts of their own: on one host its socket tells.
    by_hand = [
        place.start("master", config),
        place.start("node", config, "pendulum"),
        place.start("node", config, "delay"),
    ]
    wait_until(lambda: row_count(result) > 100, "100 rows")

    with Place() as elsewhere:
        second = elsewhere.start("node", config, "pendulum")
        assert second.wait() == 4
        assert "node 'pendulum' is there already; two processes run it" in second.message

    assert [launched.wait() for launched in by_hand] == [0, 0, 0]
    assert len(rows_of(result)) == POINTS + 1


def test_router_that_is_gone_is_named_and_what_was_recorded_is_kept(place: Place, router: Launched) -> None:
    config = through(router, place, "client", link_s=2.0)
    result = place.folder / "pair.csv"
    first = place.start("launch", config, "--no-progress")
    wait_until(lambda: row_count(result) > 100, "100 rows")

    router.signal(signal.SIGKILL)

    assert first.wait() == 4
    assert f"the link to the router at {endpoint_of(router)} was lost" in first.message
    assert len(rows_of(result)) > 100


@pytest.mark.parametrize("zenoh", [{}, BY_STREAMS, BY_ZENOH], ids=["by rings", "by streams", "by Zenoh"])
def test_a_router_that_comes_back_costs_nothing(place: Place, router: Launched, zenoh: Mapping[str, bool]) -> None:
    config = through(router, place, "client", zenoh=zenoh)
    result = place.folder / "pair.csv"
    first = place.start("launch", config, "--no-progress")
    wait_until(lambda: row_count(result) > 100, "100 rows")

    endpoint = endpoint_of(router)
    router.signal(signal.SIGKILL)
    router.wait()
    end = time.monotonic() + 3.0
    wait_until(lambda: time.monotonic() > end, "a while without a router")
    again = place.start("router", "--listen", endpoint)

    assert_ends_well(first, result)
    assert "was lost" not in first.errors
    again.signal(signal.SIGTERM)
    assert again.wait() == 0
    expected = place.run("launch", config, "--local", "--output", "local.csv", "--no-progress")
    assert expected.wait() == 0
    assert result.read_bytes() == (place.folder / "local.csv").read_bytes()


def test_every_run_has_an_id_of_its_own(place: Place) -> None:
    config = write_config(place.folder, stop_time=0.01)

    def run_id() -> str:
        launched = place.start("launch", config, "--paused", "--no-progress")
        asked = wait_until(lambda: json.loads(place.run("info", "mesh", "--json").output or "null"), "a mesh")
        assert wait_until(lambda: place.run("resume", "pair").wait() == 0, "a mesh that runs")
        assert launched.wait() == 0
        return str(asked["run"])

    first, second = run_id(), run_id()

    assert first != second
    assert len(first) == 16
