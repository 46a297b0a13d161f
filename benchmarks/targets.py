"""What our own figures should be: what issues 17, 38 and 41 ask for, and what is aimed at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from benchmarks.jobs import OTHER

__all__ = ["TARGETS", "Figure", "Target"]

Figure = Literal["times as fast", "times as long", "times as long, each", "first point, s", "MB per node"]


@dataclass(frozen=True)
class Target:
    """What one figure should be.

    Attributes:
        what: the figure in words.
        job: name of the job.
        entry: label of our row.
        figure: how many times as fast as `against` the row is; how many times as long as `against` it takes, for a
            point (or a command), or for a point and instance; or a figure of the row alone.
        required: the least, of a speed; the most, of anything else.
        aim: what is better than required.
        against: label of the other row of this job.
    """

    what: str
    job: str
    entry: str
    figure: Figure
    required: float
    aim: float
    against: str = ""

    @property
    def more_is_better(self) -> bool:
        """Whether `required` is a lower limit."""
        return self.figure == "times as fast"

    def meets(self, value: float) -> bool:
        """Whether a figure is what is required."""
        return value >= self.required if self.more_is_better else value <= self.required


_FMPY = "FMPy loop, one process"
_FMI1 = "FMI 1.0: Real, Integer, Boolean"
_FMI2 = "FMI 2.0: Real, Integer, Boolean, Enumeration"
_COMMAND, _LOCAL = "fmu-mesh launch", "fmu-mesh launch --local"
_NO_FILE = "fmu_mesh, nothing recorded"
_EIGHT, _TWO = "fmu_mesh, chain of 8", "fmu_mesh, chain of 2"
_ROUND_TRIP = "shared memory, C: one round trip"
_STREAMS, _BY_ZENOH, _MEMORY = "fmu_mesh, row streams", "fmu_mesh, Zenoh", "fmu_mesh, shared memory"
_TCP, _ZENOH = "TCP, C, spinning: one round trip", "Zenoh in Python: one round trip"
_BATCH, _C_LOOP = "fmu_mesh, batch()", "C, a loop over copies"
_BATCH_TO_STATE, _C_STATE = "reset() of a batch to states", "C: fmi2SetFMUstate"
_DOPRI5, _C_SOLVER = "fmu_mesh, dopri5", "C, the solver of dopri5"
_SWEEP, _C_SWEEP = "fmu_mesh, from the call to the table", "C, two processes, new instances"
_WINE, _WINE_1 = "fmu_mesh, under Wine", "fmu_mesh, under Wine, window 1"
_WINDOW1 = "fmu_mesh, gauss_seidel"
_OPEN, _TO_STATE, _VALUES = "fmu_mesh, open()", "reset() to a state", "reset() with start values"

TARGETS = (
    Target("main job with its CSV, against the FMPy loop", "pendulum", "fmu_mesh", "times as fast", 25, 40, _FMPY),
    Target("main job, nothing recorded, against C", "limit", _NO_FILE, "times as long", 2, 1.3, "C, process per FMU"),
    Target("cycle in own processes, against the FMPy loop", "cycle2", "fmu_mesh", "times as fast", 8, 30, _FMPY),
    Target("cycle in one group, against the FMPy loop", "group", "fmu_mesh", "times as fast", 40, 80, _FMPY),
    Target("window 1: a point, against a round trip", "window1", _WINDOW1, "times as long", 25, 8, _ROUND_TRIP),
    Target("FMUs under Wine, against native ones", "windows", _WINE, "times as long", 3, 2, "fmu_mesh, native"),
    Target("window 1 under Wine, against a round trip", "windows", _WINE_1, "times as long", 15, 8, _ROUND_TRIP),
    Target("chain of 8 against chain of 2", "chain8", _EIGHT, "times as long, each", 1.0, 0.7, _TWO),
    Target(
        "cycle by streams, a point, against a TCP round trip", "apart_cycle", _STREAMS, "times as long", 3, 1.5, _TCP
    ),
    Target("the same, against HELICS", "apart_cycle", _STREAMS, "times as fast", 10, 20, "HELICS coupled, tcp"),
    Target("cycle by Zenoh, against its round trip", "apart_cycle", _BY_ZENOH, "times as long", 1.3, 1.1, _ZENOH),
    Target("window 1 by streams, against that round trip", "apart_window1", _STREAMS, "times as long", 10, 5, _TCP),
    Target("chain by streams, against shared memory", "apart_chain", _STREAMS, "times as fast", 0.5, 0.77, _MEMORY),
    Target("star by streams, against shared memory", "apart_star", _STREAMS, "times as fast", 0.5, 0.77, _MEMORY),
    Target("chain at a round trip of 50 ms, against 0 ms", "far_chain", "50 ms", "times as fast", 0.5, 0.83, "0 ms"),
    Target("FMI 1.0, against the other checkout", "kinds", _FMI1, "times as fast", 2, 4, _FMI1 + OTHER),
    Target("Boolean, Enumeration, against the other checkout", "kinds", _FMI2, "times as fast", 2, 4, _FMI2 + OTHER),
    Target("model exchange with dopri5, against C", "model_exchange", _DOPRI5, "times as long", 2.5, 1.2, _C_SOLVER),
    Target("sweep of short runs, against C", "sweep", _SWEEP, "times as long", 2, 1.3, _C_SWEEP),
    Target("open(): set, step and get, against C", "environment", _OPEN, "times as long", 15, 8, "C, one process"),
    Target("a batch, a copy and step, against C", "batch", _BATCH, "times as long", 1.5, 1.1, _C_LOOP),
    Target("reset() of a batch to states, against C", "resets", _BATCH_TO_STATE, "times as long", 5, 2, _C_STATE),
    Target("reset() to a state, against C", "resets", _TO_STATE, "times as long", 5, 2, "C: fmi2SetFMUstate"),
    Target("reset() with start values, against open()", "resets", _VALUES, "times as long", 0.05, 0.01, "a new open()"),
    Target(
        "main job with its CSV, --local, against C without it",
        "pendulum",
        "fmu_mesh, launch --local",
        "times as long",
        2.5,
        1.5,
        "C, one process",
    ),
    Target("main job, whole command, against --local", "command", _COMMAND, "times as long", 1.5, 1.2, _LOCAL),
    Target(
        "the same, against --local of the other checkout",
        "command",
        _COMMAND,
        "times as long",
        1.5,
        1.2,
        _LOCAL + OTHER,
    ),
    Target("64 nodes, from the command to the first point", "startup", "64: fmu_mesh", "first point, s", 3, 1.5),
    Target("private memory of a node, one of 64", "startup", "64: fmu_mesh", "MB per node", 15, 9),
)
