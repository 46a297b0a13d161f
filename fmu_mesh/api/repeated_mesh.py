"""`RepeatedMesh`: many runs of one mesh in this process, with the models kept loaded; `Mesh.repeated` makes it."""

from __future__ import annotations

import sys
import threading
import weakref
from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ..config.call_options import takes
from ..errors import CallRefused, FmuError, FmuMeshError
from ..files import Kept, remove_tree
from ..results.record_files import open_result
from ..results.recording import Columns, ResultFile, joined
from ..run.options import PlanOptions
from ..run.outcome import Outcome
from ..run.overriding import memory_of
from ..run.repeated import RepeatedRuns
from ..run.resetting import OtherStartValues
from ..run.run_plan import RunPlan
from ..variables.value_types import DTYPES, VariableType
from ..wire.runtime import fmu_folder, remove_stale_folders, run_folder, run_name
from .result import Result, types_of
from .run_thread import check_memory

__all__ = ["RepeatedMesh"]

_IN_MEMORY = Path()
"""The path of rows that have no file."""


class RepeatedMesh:
    """Runs of one mesh, one after another, in this process and on one thread.

    Models are unpacked and loaded once. Each run makes new instances, and its floats are those of any run of the mesh.
    A call that hangs in an FMU cannot be ended, and an FMU that crashes takes the program with it: `fmu_mesh.sweep`
    puts its runs into processes of their own.

    Example:
        >>> import fmu_mesh
        >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
        >>> with mesh.repeated() as runs:
        ...     ends = [
        ...         float(runs.run(start_values={"pendulum.d": d}, stop_time=10.0)["pendulum.a"][-1])
        ...         for d in (0.1, 0.5, 0.1)
        ...     ]
        >>> ends[0] == ends[2] != ends[1]
        True

    Args:
        mesh: the mesh in words; ``plan`` plans a run of it, as `Mesh.plan`.
        reset: as in `Mesh.repeated`, and so is ``on_hang``.
        alone: whether nothing else in this process changes its working directory, locale or the like between runs.
        before_close: called with the result of a run, or why it failed, before its instances are closed. With it,
            ``on_hang`` is also called if an FMU crashes then; the thread of the runs never goes on.
    """

    def __init__(  # noqa: PLR0913  what a caller may want to hear of
        self,
        mesh: str,
        plan: Callable[..., RunPlan],
        *,
        reset: bool,
        on_hang: Callable[[FmuError], None],
        alone: bool = False,
        before_close: Callable[[Result | BaseException], None] | None = None,
    ) -> None:
        self._mesh, self._plan = mesh, plan
        self._thread = threading.get_ident()
        self._before_close = before_close
        self._rows: _CollectedRows | None = None
        self._key: Hashable = None
        self._planned: _Planned | None = None
        told = self._tell_end if before_close is not None else None
        self._make = partial(RepeatedRuns, on_hang=on_hang, reset=reset, alone=alone, before_close=told)
        self._loaded: list[tuple[RepeatedRuns, Path]] = []
        self._release = weakref.finalize(self, _release, self._loaded, self._thread)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<RepeatedMesh of {self._mesh}>"

    @takes(PlanOptions)
    def run(self, options: PlanOptions) -> Result:
        """Run the mesh to its end, and return what it has recorded.

        The result stays in memory, unless `output` names a file: then it is in both.

        Args:
            options: see `PlanOptions`.

        Raises:
            ConfigurationError: the configuration, a model or an option is wrong; carries all findings.
            CallRefused: this is not the thread that made this object, or it is closed.
            FmuMeshError: the run ended early; its `result` has what was recorded up to then.
        """
        if options.output is None and options.record is None:
            options = replace(options, record="memory")
        values = dict(options.start_values or {})
        # A copy: what was given may change.
        key = msgspec.json.encode((list(values), replace(options, start_values=None).given()), enc_hook=repr)
        return self.run_planned(key, values, options.given)

    def run_planned(
        self, key: Hashable, start_values: Mapping[str, Any], options: Callable[[], Mapping[str, Any]]
    ) -> Result:
        """As `run`, for a program that knows which of its runs have equal options.

        Args:
            key: equal for runs whose ``options`` differ in the start values only, of the same variables.
            start_values: those of the options.
            options: returns the options as `Mesh.plan` takes them; called where the run has to be planned.
        """
        if not self._release.alive or threading.get_ident() != self._thread:
            why = "it belongs to the thread that made it" if self._release.alive else "it is closed"
            raise CallRefused(f"run is not possible, because {why}.")
        others = self._planned.others.taken(start_values) if self._planned is not None and key == self._key else None
        if others is None or self._planned is None:
            self._key, self._planned, others = key, None, {}
            self._planned = _Planned.of(self._plan(**options()))
        plan = self._planned.run
        self._rows = rows = _CollectedRows(self._planned)
        runs = self._runs(plan.mesh)
        try:
            outcome = runs.run(plan, rows.open, others)
        except FmuMeshError as error:
            point = runs.point
            time, warnings = plan.plan.grid.time(point), runs.warnings
            outcome = Outcome("failed", point, time, 0.0, rows.rows, None, error.report(), warnings=warnings)
            raise error.with_result(rows.result(outcome)) from error.__cause__
        return rows.result(outcome)

    def close(self) -> None:
        """Free all models, and remove their files. May be called twice."""
        self._release()

    def _tell_end(self, end: Outcome | BaseException) -> None:
        assert self._rows is not None
        assert self._before_close is not None
        self._before_close(self._rows.result(end) if isinstance(end, Outcome) else end)

    def _runs(self, mesh: str) -> RepeatedRuns:
        """What runs a plan; made for the first one, whose configuration is right."""
        if not self._loaded:
            remove_stale_folders()
            folder = run_folder(mesh, run_name())
            models = fmu_folder(folder)
            models.mkdir(parents=True)
            self._loaded.append((self._make(models), folder))
        return self._loaded[0][0]


class _Planned(NamedTuple):
    """What runs share that differ in start values only."""

    run: RunPlan
    others: OtherStartValues
    types: dict[str, VariableType]
    in_memory: bool

    @classmethod
    def of(cls, run: RunPlan) -> _Planned:
        check_memory(run, sys.maxsize, to_its_end=True)
        return cls(run, OtherStartValues(run), types_of(run.plan.system) or {}, memory_of(run) is not None)


class _CollectedRows:
    """The rows of a run in memory, and in its result file if it has one; see `ResultFile`."""

    def __init__(self, planned: _Planned) -> None:
        self._plan, self._types, self._in_memory = planned.run, planned.types, planned.in_memory
        self._file: ResultFile | None = None
        self._pieces: list[Columns] = []
        self.rows = 0
        self._made: tuple[Outcome, Result] | None = None

    def open(self) -> list[ResultFile]:
        """This object, whose file is open now."""
        if not self._in_memory:
            self._file = open_result(self._plan.loaded, self._plan.plan.system)
        return [self]

    @property
    def path(self) -> Path:
        return self._file.path if self._file is not None else _IN_MEMORY

    @property
    def kept(self) -> Kept:
        return self._file.kept if self._file is not None else Kept()

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        values = {name: np.array(column) for name, column in zip(self._types, columns, strict=True)}
        self._pieces.append(Columns(np.array(times), values))
        self.rows += len(times)
        if self._file is not None:
            self._file.write(times, columns)

    def note(self, entry: Mapping[str, Any]) -> None:
        if self._file is not None:
            self._file.note(entry)

    def flush(self) -> None:
        if self._file is not None:
            self._file.flush()

    def close(self) -> None:
        if self._file is not None:
            self._file.close()

    def result(self, outcome: Outcome) -> Result:
        """The result of a run that has ended in this way; the same one for the same outcome."""
        if self._made is None or self._made[0] is not outcome:
            self._made = outcome, self._result(outcome)
        return self._made[1]

    def _result(self, outcome: Outcome) -> Result:
        system, file = self._plan.plan.system, self._file.path if self._file is not None else None
        files = ((str(file), outcome.rows),) if file is not None else ()
        outcome = replace(outcome, file=str(file) if file is not None else None, files=files)
        if len(self._pieces) == 1:
            (columns,) = self._pieces
        else:
            nothing = Columns(np.zeros(0), {name: np.zeros(0, DTYPES[type_]) for name, type_ in self._types.items()})
            columns = joined([nothing, *self._pieces])
        return Result(self._plan.mesh, file=file, outcome=outcome, system=system, columns=columns)


def _release(loaded: list[tuple[RepeatedRuns, Path]], thread: int) -> None:
    """Free everything. On another thread only the files: an FMU is only called on its own."""
    for runs, folder in loaded:
        if threading.get_ident() == thread:
            runs.close()
        remove_tree(folder)
    loaded.clear()
