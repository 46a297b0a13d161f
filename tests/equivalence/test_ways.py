"""Shared memory, row streams or Zenoh: whichever way messages take, the result is the same in every float."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

import pytest
import yaml

from fmu_mesh.rings.host_memory import can_share
from fmu_mesh.rings.library import LIBRARY_VARIABLE
from fmu_mesh.run.options import PlanOptions
from tests.equivalence.test_equivalence import CHAIN, CYCLE, GAUSS_SEIDEL, JACOBI, PENDULUM, rewritten, shortened
from tests.helpers import BY_STREAMS, BY_ZENOH, Place, wait_until, write_config
from tests.plain_run import PlainRun
from tests.planning import prepare

shares = pytest.mark.skipif(not can_share(), reason="needs Linux with memfd_create, and the library")


def local_result(place: Place, config: Path) -> bytes:
    output = place.folder / "local.csv"
    PlainRun(prepare(config, PlanOptions(output=output))).run()
    return output.read_bytes()


@pytest.mark.parametrize(
    ("name", "points", "window", "algorithm"),
    [
        (PENDULUM, 1500, "auto", GAUSS_SEIDEL),
        (PENDULUM, 200, 1, JACOBI),
        (CHAIN, 600, "auto", GAUSS_SEIDEL),
        (CYCLE, 300, "auto", GAUSS_SEIDEL),
    ],
)
@pytest.mark.parametrize("way", [BY_STREAMS, BY_ZENOH], ids=["streams", "zenoh"])
def test_between_hosts_the_floats_are_those_of_one_process(
    way: Mapping[str, bool], name: str, points: int, window: int | str, algorithm: str, place: Place
) -> None:
    config = rewritten(name, place.folder, shortened(points, algorithm, window))
    content = yaml.safe_load(config.read_text(encoding="utf-8"))
    content["zenoh"] = dict(way)
    config.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    output = place.folder / "result.csv"

    launched = place.run("launch", config, "--no-progress", "--output", output)

    assert launched.wait() == 0, launched.errors
    assert output.read_bytes() == local_result(place, config)


@shares
@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("unshare") is None, reason="needs root and unshare")
def test_a_node_in_a_container_of_its_own_joins_through_zenoh(place: Place) -> None:
    config = write_config(place.folder, stop_time=3.0)
    inside = ("unshare", "--pid", "--fork", "--mount-proc", "--kill-child")

    by_hand = [
        place.start("master", config, "--paused"),
        place.start("node", config, "pendulum"),
        place.start("node", config, "delay", prefix=inside),
    ]
    place.note()

    def shared() -> list[str]:
        asked = place.run("info", "mesh", "--json")
        found: list[str] = json.loads(asked.output)["shared_memory"] if asked.wait() == 0 else []
        return found

    assert wait_until(shared, "a mesh that is there") == [
        "pendulum",
        "@record",
        "@mesh",
    ]  # it is another memory that the container has at this place
    wait_until(lambda: place.run("resume", "pair").wait() == 0, "a mesh that runs")
    assert [launched.wait() for launched in by_hand] == [0, 0, 0]
    assert config.with_suffix(".csv").read_bytes() == local_result(place, config)


@pytest.mark.parametrize(
    ("name", "points", "window", "algorithm"),
    [(PENDULUM, 800, "auto", GAUSS_SEIDEL), (CHAIN, 200, 1, JACOBI), (CYCLE, 200, "auto", GAUSS_SEIDEL)],
)
def test_without_the_library_the_floats_are_those_of_one_process(
    name: str, points: int, window: int | str, algorithm: str, place: Place
) -> None:
    """Then each process steps in Python, and they exchange frames."""
    config = rewritten(name, place.folder, shortened(points, algorithm, window))
    place.environment[LIBRARY_VARIABLE] = "none"
    output = place.folder / "result.csv"

    launched = place.run("launch", config, "--no-progress", "--output", output)

    assert launched.wait() == 0, launched.errors
    assert output.read_bytes() == local_result(place, config)
    place.assert_nothing_left()


@shares
@pytest.mark.parametrize("without", ["pendulum", "gain", "delay", "master"])
def test_where_one_process_has_no_library_the_floats_are_the_same(place: Place, without: str) -> None:
    """The others share the memory, unless it is the master, which makes it."""
    config = write_config(
        place.folder,
        instances={
            "pendulum": {"fmu": "DampedPendulum", "start_values": {"a": 1.3}},
            "gain": {"fmu": "Gain", "start_values": {"k": 0.5}},
            "delay": {"fmu": "TransportDelay", "start_values": {"d": 0.1}},
        },
        connections=["pendulum.a -> gain.u", "gain.y -> delay.x"],
        stop_time=0.8,
    )

    by_hand = [
        place.start(*command, config, *which, prefix=("env", f"{LIBRARY_VARIABLE}=none") if role == without else ())
        for role, command, which in [
            ("master", ["master"], []),
            *((node, ["node"], [node]) for node in ("pendulum", "gain", "delay")),
        ]
    ]

    assert [launched.wait() for launched in by_hand] == [0, 0, 0, 0], place.story()
    assert config.with_suffix(".csv").read_bytes() == local_result(place, config)
    place.assert_nothing_left()
