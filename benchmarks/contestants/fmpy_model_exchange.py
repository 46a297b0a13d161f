"""FMPy's `simulate_fmu` with its CVode: one oscillator, and then another one whose input is the result of the first.

FMPy couples no model-exchange FMUs, so this is what its users do. Its input is interpolated, and ours is held.
"""

from __future__ import annotations

import shutil
from time import perf_counter
from typing import Any

import fmpy
import numpy as np

from benchmarks.contestants.c_model_exchange import TOLERANCE
from benchmarks.contestants.entry import main, versions
from benchmarks.contestants.fmu_mesh_kinds import BUILT, STEP_SIZE
from benchmarks.task import Outcome, Task
from tests.fmus.event_fmus import build_event_fmu

__all__ = ["run"]


def run(task: Task) -> Outcome:
    """Timed are both calls; the FMU is unpacked before."""
    path = str(build_event_fmu("Oscillator", 2, BUILT))
    folder = fmpy.extract(path)
    description = fmpy.read_model_description(path)
    options: dict[str, Any] = {
        "model_description": description,
        "fmi_type": "ModelExchange",
        "stop_time": task.points * STEP_SIZE,
        "set_stop_time": False,  # it goes a little beyond it, which FMI forbids, and so does this FMU
        "output_interval": STEP_SIZE,
        "relative_tolerance": TOLERANCE,
        "output": ["x"],
    }
    try:
        started = perf_counter()
        first = fmpy.simulate_fmu(folder, **options)
        given = np.zeros(len(first), dtype=[("time", np.float64), ("u", np.float64)])
        given["time"], given["u"] = first["time"], first["x"]
        second = fmpy.simulate_fmu(folder, input=given, **options)
        seconds = perf_counter() - started
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    last = {"first.x": float(first["x"][-1]), "second.x": float(second["x"][-1])}
    return Outcome(seconds, last, versions("fmpy"))


if __name__ == "__main__":
    main(run)
