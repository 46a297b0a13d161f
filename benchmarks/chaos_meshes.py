"""The meshes of `python -m benchmarks.chaos all`: one for each kind of system, and the ways in which each may run."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import pytest
import yaml

from tests.all_systems import written_system
from tests.fmus.event_fmus import build_event_fmu
from tests.helpers import FMUS

__all__ = ["ALL", "LASTS_S", "Mesh", "chain", "mesh_of", "written_meshes"]

LASTS_S: Final = 2.5
"""An undisturbed run of a paced mesh, so that there is time for faults."""

_WINDOWS: Final = ("1", "16", "auto")

_FILES: Final = ("result.csv", "result.parquet", "result.mcap")

_SLOW: Final = """
import time

import fmu_mesh


class Slow(fmu_mesh.Component):
    u = fmu_mesh.Input()
    y = fmu_mesh.Output()

    def step(self, now, step_size):
        time.sleep(2e-5)
        self.y = 3.0 * self.u
"""


@dataclass(frozen=True)
class Mesh:
    """A mesh that is disturbed.

    Attributes:
        name: in the tables.
        config: its file; all that it needs is in its folder, or has an absolute path.
        lasts_s: at least so long an undisturbed run takes by the wall clock; 0: as fast as possible.
        variants: options of `launch` in each of the ways in which it runs; the values of all results are the same.
        files: the results beside the file, a CSV file first; empty: there is one, whose name `launch` is told.
    """

    name: str
    config: Path
    lasts_s: float = LASTS_S
    variants: Sequence[Sequence[str]] = ((),)
    files: Sequence[str] = ()


def mesh_of(config: Path, lasts_s: float) -> Mesh:
    """The mesh of a file that somebody has written: it runs as the file says."""
    return Mesh(config.stem, config.resolve(), lasts_s)


def written_meshes(folder: Path) -> Iterator[Mesh]:
    """Write all meshes into a folder; one that cannot run here is left out, and the reason is printed."""
    memory = ("true", "false")
    ways = [
        ["--window", window, "--set-config", f"zenoh.shared_memory={shared}"]
        for window, shared in itertools.product(_WINDOWS, memory)
    ]
    for number, (name, write) in enumerate(ALL.items()):
        try:
            config = write(folder / str(number))
        except (pytest.skip.Exception, RuntimeError) as reason:
            print(f"left out: {name}: {reason}", flush=True)
        else:
            yield Mesh(name, config, 0.0 if "fast" in name else LASTS_S, ways, _FILES if "formats" in name else ())


def _fmu(name: str, **start_values: float) -> dict[str, Any]:
    return {"fmu": str(FMUS / f"{name}.fmu"), "start_values": start_values}


def chain() -> dict[str, Any]:
    """Four FMUs in a row, without a name and a file."""
    return {
        "simulation": {"stop_time": 2.0, "step_size": 0.001},
        "instances": {
            "pendulum": _fmu("DampedPendulum", a=1.3),
            "gain": _fmu("Gain", k=3.0),
            "integral": _fmu("Integrator"),
            "delay": _fmu("TransportDelay", d=0.1),
        },
        "connections": ["pendulum.a -> gain.u", "gain.y -> integral.u", "integral.y -> delay.x"],
    }


def _fast(folder: Path) -> dict[str, Any]:
    """The chain with no pace: what makes it last is an instance that sleeps in each step."""
    (folder / "slow.py").write_text(_SLOW, encoding="utf-8")
    content = chain()
    content["simulation"]["stop_time"] = 25.0
    content["instances"]["gain"] = {"python": "slow.py:Slow"}
    return content


def _formats(_: Path) -> dict[str, Any]:
    return {**chain(), "record": [{"file": name} for name in _FILES]}


def _stateless(folder: Path) -> Mapping[str, Any]:
    """An FMU that cannot give its state away, between two that can."""
    none = build_event_fmu("Ball", 2, folder, canGetAndSetFMUstate="false", canSerializeFMUstate="false")
    return {
        "simulation": {"stop_time": 2.0, "step_size": 0.001},
        "instances": {
            "pendulum": _fmu("DampedPendulum", a=1.3),
            "ball": {"fmu": none.name, "kind": "co_simulation"},
            "gain": _fmu("Gain"),
        },
        "connections": ["pendulum.a -> ball.u", "ball.h -> gain.u"],
    }


def _model_exchange(folder: Path) -> Mapping[str, Any]:
    oscillator = {"fmu": build_event_fmu("Oscillator", 2, folder).name, "kind": "model_exchange"}
    return {
        "simulation": {"stop_time": 2.0, "step_size": 0.001},
        "instances": {"first": oscillator, "second": oscillator, "gain": _fmu("Gain")},
        "connections": ["first.x -> second.u", "second.x -> gain.u"],
    }


def _own(content: Callable[[Path], Mapping[str, Any]]) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        folder.mkdir()
        path = folder / "system.yaml"
        path.write_text(yaml.safe_dump({"mesh": "system", **content(folder)}, sort_keys=False), encoding="utf-8")
        return path

    return write


def _known(name: str) -> Callable[[Path], Path]:
    return lambda folder: written_system(name, folder)


ALL: Final[Mapping[str, Callable[[Path], Path]]] = {
    "chain of 4": _own(lambda _: chain()),
    "chain of 4, as fast as possible": _own(_fast),
    "chain of 4, in three formats": _own(_formats),
    "cycle of 2": _known("cycle2"),
    "star of 5": _known("star"),
    "groups": _known("groups"),
    "rates": _known("rates"),
    "an FMU without state": _own(_stateless),
    "model exchange": _own(_model_exchange),
    "components in Python": _known("arm"),
    "MuJoCo": _known("fluid_body"),
    "text and arrays": _known("text and arrays"),
    "a scenario": _known("set"),
}
"""Writes each mesh into a folder that is not there yet."""
