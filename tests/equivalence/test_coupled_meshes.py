"""Meshes that are coupled by Zenoh keys with `wait: true` give every float of one mesh, and repeat alone."""

from __future__ import annotations

import csv
import signal
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import pytest
import yaml

import fmu_mesh
from tests.helpers import BY_STREAMS, BY_ZENOH, Launched, Place, free_port, row_count, wait_until
from tests.key_meshes import key_lines, stepped_router, written

VECTOR = """
import fmu_mesh

class Vector(fmu_mesh.Component):
    u = fmu_mesh.Input([0.0, 0.0, 0.0], shape=3)
    y = fmu_mesh.Output([0.0, 0.0, 0.0], shape=3)
    word = fmu_mesh.Output("none", type="String")
    heard = fmu_mesh.Input("none", type="String")

    def step(self, time, step_size):
        self.y = 0.9 * self.y + step_size * (self.u[[1, 2, 0]] + time)
        self.word = f"{self.heard[-5:]}{self.y[0]:.3g}"
"""


class Split(NamedTuple):
    """One system, and which mesh each instance belongs to if it is split."""

    instances: Mapping[str, tuple[str, Mapping[str, Any]]]
    connections: Sequence[tuple[str, str, Mapping[str, Any]]]


OSCILLATOR = Split(
    {"x": ("left", {"fmu": "Integrator", "start_values": {"y": 1.0}}), "v": ("right", {"fmu": "Integrator"})},
    [("v.y", "x.u", {}), ("x.y", "v.u", {"factor": -1.0})],
)

MULTI_RATE = Split(
    {
        "x": ("left", {"fmu": "Integrator", "start_values": {"y": 1.0}, "step_size": 0.03}),
        "fast": ("left", {"fmu": "TransportDelay", "start_values": {"d": 0.05}}),
        "v": ("right", {"fmu": "Integrator", "step_size": 0.02}),
        "slow": ("right", {"fmu": "Integrator", "step_size": 0.06}),
    },
    [("v.y", "x.u", {}), ("x.y", "v.u", {"factor": -1.0}), ("x.y", "fast.x", {}), ("fast.y", "slow.u", {})],
)

GROUPS = Split(
    {
        "x": ("left", {"fmu": "Integrator", "start_values": {"y": 1.0}, "group": "one"}),
        "old": ("left", {"fmu": "TransportDelay", "start_values": {"d": 0.1}, "group": "one"}),
        "half": ("right", {"fmu": "Integrator", "start_values": {"k": 0.5}, "group": "two"}),
        "v": ("right", {"fmu": "Integrator", "group": "two"}),
        "other": ("right", {"fmu": "DampedPendulum"}),
    },
    [
        ("x.y", "old.x", {}),
        ("old.y", "half.u", {"factor": -2.0, "offset": 0.125}),
        ("half.y", "v.u", {}),
        ("v.y", "x.u", {}),
    ],
)

ARRAYS = Split(
    {"a": ("left", {"python": "vector.py:Vector"}), "b": ("right", {"python": "vector.py:Vector"})},
    [("a.y", "b.u", {}), ("b.y", "a.u", {}), ("a.word", "b.heard", {}), ("b.word", "a.heard", {})],
)

RING = Split(
    {
        "x": ("left", {"fmu": "Integrator", "start_values": {"y": 1.0}}),
        "y": ("middle", {"fmu": "Integrator", "start_values": {"y": -0.5}}),
        "z": ("right", {"fmu": "Integrator", "start_values": {"k": -3.0}}),
    },
    [("x.y", "y.u", {}), ("y.y", "z.u", {}), ("z.y", "x.u", {})],
)

SYSTEMS = {"oscillator": OSCILLATOR, "multi-rate": MULTI_RATE, "groups": GROUPS, "arrays": ARRAYS, "ring": RING}


def whole(place: Place, split: Split, **sections: Any) -> Path:  # noqa: ANN401  as the file has them
    connections = [{"from": source, "to": target, **more} for source, target, more in split.connections]
    instances = {name: section for name, (_, section) in split.instances.items()}
    return written(place, "whole", instances, connections, **sections)


def parts(
    place: Place,
    split: Split,
    wait: Mapping[str, Any] = MappingProxyType({"time": "time"}),
    **sections: Any,  # noqa: ANN401  as the file has them
) -> dict[str, Path]:
    """A file for each mesh; a connection between two of them is a key."""
    (place.folder / "vector.py").write_text(VECTOR)
    files = {}
    for mesh in dict.fromkeys(mesh for mesh, _ in split.instances.values()):
        connections: list[dict[str, Any]] = []
        sent: set[str] = set()
        for source, target, more in split.connections:
            here = [split.instances[end.partition(".")[0]][0] == mesh for end in (source, target)]
            key = f"split/{source.replace('.', '/')}"
            if all(here):
                connections.append({"from": source, "to": target, **more})
            elif here[0] and source not in sent:
                sent.add(source)
                connections.append({"from": source, "key": key, "congestion": "block"})
            elif here[1]:
                connections.append({"key": key, "to": target, "wait": True, **wait, **more})
        instances = {name: section for name, (own, section) in split.instances.items() if own == mesh}
        files[mesh] = written(place, mesh, instances, connections, **sections)
    return files


def columns_of(config: Path) -> dict[str, list[str]]:
    """The columns of a result file, as text: shortest numbers that are the same float."""
    header, *rows = csv.reader((config.with_suffix(".csv")).read_text().splitlines())
    return dict(zip(header, map(list, zip(*rows, strict=True)), strict=True))


def assert_ended(launched: Sequence[Launched]) -> None:
    for own in launched:
        assert own.wait() == 0, own.story()


def assert_equals_one_mesh(one: Path, files: Sequence[Path]) -> None:
    fmu_mesh.load(one).run(processes=False)
    expected = columns_of(one)
    for config in files:
        columns = columns_of(config)
        assert columns == {name: expected[name] for name in columns}, config
        assert len(columns["time"]) == 201
        assert any(len(set(column)) > 20 for name, column in columns.items() if name != "time"), columns
        fmu_mesh.rerun(config.with_suffix(".csv"), allow_code=True)
        assert config.with_suffix(".rerun.csv").read_bytes() == config.with_suffix(".csv").read_bytes()


@pytest.mark.parametrize("name", SYSTEMS)
def test_coupled_meshes_equal_one_mesh_in_every_float(name: str, place: Place) -> None:
    with stepped_router(place) as (_, endpoint):
        files = parts(place, SYSTEMS[name], zenoh={"mode": "client", "connect": [endpoint]})
        assert_ended([place.start("launch", config, "--no-progress") for config in files.values()])

    assert_equals_one_mesh(whole(place, SYSTEMS[name]), list(files.values()))
    for config in files.values():
        assert all(kept[2] is not None for kept in key_lines(config.with_suffix(".csv")))


@pytest.mark.parametrize("ways", [BY_STREAMS, BY_ZENOH], ids=["by streams", "by Zenoh"])
@pytest.mark.parametrize("mode", ["client", "peer"])
def test_the_way_between_processes_changes_no_float(ways: Mapping[str, bool], mode: str, place: Place) -> None:
    with stepped_router(place) as (_, endpoint):
        files = parts(place, GROUPS, zenoh={"mode": mode, "connect": [endpoint], **ways})
        assert_ended([place.start("launch", config, "--no-progress") for config in files.values()])

    assert_equals_one_mesh(whole(place, GROUPS), list(files.values()))


@pytest.mark.parametrize("listening", ["left", "right"])
def test_one_mesh_may_listen_and_the_other_connect(listening: str, place: Place) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    files = parts(place, OSCILLATOR)
    for mesh, config in files.items():
        text = yaml.safe_load(config.read_text())
        text["zenoh"] = {"listen": [endpoint]} if mesh == listening else {"connect": [endpoint]}
        config.write_text(yaml.safe_dump(text))
    first = place.start("launch", files.pop(listening), "--no-progress")
    wait_until(lambda: "tcp/" in first.errors, "a mesh that listens")
    [other] = files.values()

    assert_ended([first, place.start("launch", other, "--no-progress")])

    assert_equals_one_mesh(whole(place, OSCILLATOR), [place.folder / "left.yaml", place.folder / "right.yaml"])


def test_values_without_times_are_taken_one_for_each_point(place: Place) -> None:
    with stepped_router(place) as (_, endpoint):
        section = {"mode": "client", "connect": [endpoint]}
        files = parts(place, OSCILLATOR, {"time": "arrival"}, zenoh=section)
        assert_ended([place.start("launch", config, "--no-progress") for config in files.values()])

    assert_equals_one_mesh(whole(place, OSCILLATOR), list(files.values()))


def test_a_mesh_that_begins_again_catches_up(place: Place) -> None:
    with stepped_router(place) as (_, endpoint):
        section = {"mode": "client", "connect": [endpoint]}
        files = parts(place, OSCILLATOR, zenoh=section, simulation={"real_time_factor": 1})
        left = place.start("launch", files["left"], "--no-progress")
        right = place.start("launch", files["right"], "--no-progress")
        wait_until(lambda: row_count(files["right"].with_suffix(".csv")) > 60, "60 rows")
        right.signal(signal.SIGKILL)
        right.wait()
        wait_until(lambda: not place.processes("node") or len(place.processes("node")) == 1, "the end of its node")

        assert_ended([left, place.start("launch", files["right"], "--no-progress")])

    assert_equals_one_mesh(whole(place, OSCILLATOR), list(files.values()))
