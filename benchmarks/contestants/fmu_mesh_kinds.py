"""fmu_mesh: two instances of one kind, of which the first feeds the second, with `launch --local`; nothing is recorded.

It shows what a step of each kind costs: one instance has its outputs read, the other one has its inputs set. Option
`kind`: a key of `KINDS`; `checkout` as in `fmu_mesh_launch`. The FMUs are those of the tests, which need a C compiler.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.contestants.entry import main
from benchmarks.contestants.fmu_mesh_launch import launched
from benchmarks.task import Outcome, Task
from fmus.build import build
from tests.fmus.event_fmus import build_event_fmu

__all__ = ["BUILT", "KINDS", "STEP_SIZE", "run"]

_ROOT = Path(__file__).resolve().parents[2]
BUILT = _ROOT / "build" / "bench-programs"
STEP_SIZE = 0.001

KINDS: dict[str, tuple[str, ...]] = {
    "fmi1": ("real_out -> real_in", "integer_out -> integer_in", "boolean_out -> boolean_in"),
    "fmi2": ("real_out -> real_in",),
    "fmi2_types": (
        "real_out -> real_in",
        "integer_out -> integer_in",
        "boolean_out -> boolean_in",
        "enumeration_out -> enumeration_in",
    ),
    "fmi3": ("float64_out -> float64_in", "int32_out -> int32_in", "boolean_out -> boolean_in"),
    "model_exchange": ("x -> u",),
    "model_exchange_dopri5": ("x -> u",),
    "model_exchange_cvode": ("x -> u",),
    "component": ("y -> u",),
}
"""The connections between two instances of each kind."""

_MODELS = {"fmi1": "AllTypes1", "fmi2": "AllTypes", "fmi2_types": "AllTypes", "fmi3": "AllTypes3"}


def run(task: Task) -> Outcome:
    """Timed is what the summary line says."""
    kind = task.options["kind"]
    instance = _instance(kind)
    pairs = (connection.split(" -> ") for connection in KINDS[kind])
    config = {
        "mesh": "bench",
        "simulation": {"stop_time": task.points * STEP_SIZE, "step_size": STEP_SIZE},
        "instances": {"first": instance, "second": instance},
        "connections": [f"first.{source} -> second.{target}" for source, target in pairs],
        "record": {"file": None},
    }
    return launched(config, Task(task.system, task.points, {**task.options, "local": "yes"}))


def _instance(kind: str) -> dict[str, Any]:
    """The configuration of an instance of this kind."""
    if kind == "component":
        return {"python": f"{_ROOT / 'benchmarks' / 'models' / 'doubling.py'}:Doubling"}
    if kind.startswith("model_exchange"):
        solver = kind.removeprefix("model_exchange").removeprefix("_") or "auto"
        oscillator = str(build_event_fmu("Oscillator", 2, BUILT))
        return {"fmu": oscillator, "kind": "model_exchange", "solver": {"name": solver}}
    return {"fmu": str(build(_ROOT / "tests" / "fmus" / "src" / _MODELS[kind], BUILT))}


if __name__ == "__main__":
    main(run)
