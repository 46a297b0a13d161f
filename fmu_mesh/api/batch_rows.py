"""What a batch records: the values of its copies at each point, in memory, and the `Result` of one of them.

Owns the arrays and their limit. Knows no copies: it gets values from whoever steps them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ..errors import CallRefused, FmuMeshError, TerminationRequested
from ..results.recording import Columns
from ..run.outcome import outcome_at
from ..run.run_plan import RunPlan
from ..variables.value_types import DTYPES
from .result import Result

__all__ = ["BatchRows"]

Get = Callable[[str], NDArray[Any]]
"""The values of a variable of all copies, shape (copies, dimensions of the variable)."""


class BatchRows:
    """The rows of all copies, from the last `begin` of each to its point.

    Args:
        run: the plan of each copy; its first record says what is recorded.
        copies: how many.
        limit: the most bytes that the rows may take; texts are not counted, as their size is not known.
    """

    def __init__(self, run: RunPlan, copies: int, limit: int) -> None:
        self._run, self._copies, self._limit = run, copies, limit
        self._columns: dict[str, tuple[str, int]] = {}
        self._rows: dict[str, NDArray[Any]] = {}
        instances = run.plan.system.instances
        for instance, name in run.plan.system.records[0].variables:
            variable = instances[instance].description.variable_of(name)
            assert variable is not None  # the plan is valid
            whole = f"{instance}.{variable.name}"
            self._columns[f"{instance}.{name}"] = whole, variable.elements.index(name) if variable.shape else 0
            self._rows[whole] = np.zeros((0, copies, variable.size), DTYPES[variable.type])
        numbers = [own for own in self._rows.values() if not own.dtype.hasobject]
        self._point_bytes = copies * sum(own.shape[2] * own.itemsize for own in numbers)
        self._first = np.zeros(copies, np.int64)
        self._at = np.full(copies, -1)

    def make_room(self, point: int) -> None:
        """Before a step: let there be room for the rows up to a point.

        Raises:
            CallRefused: they would take more memory than they may.
        """
        room, needed = self.points, point + 1
        if needed <= room:
            return
        if needed * self._point_bytes > self._limit:
            text = f"the rows of {self._copies} copies up to point {point} take {needed * self._point_bytes} bytes"
            hint = "Raise `memory_limit`, record fewer variables, or reset the batch."
            raise CallRefused(f"{text} of memory; the limit is {self._limit} bytes", hint=hint)
        most = self._limit // self._point_bytes if self._point_bytes else 2 * needed
        more = max(needed, min(2 * room, most)) - room
        for name, own in self._rows.items():
            self._rows[name] = np.concatenate([own, np.zeros((more, *own.shape[1:]), own.dtype)])

    @property
    def points(self) -> int:
        """For how many points there is room."""
        return next(iter(self._rows.values())).shape[0] if self._rows else 0

    def begin(self, which: NDArray[np.bool_], points: NDArray[np.int64]) -> None:
        """Copies are at a point to which no step has led: their rows begin there."""
        self._first[which] = points[which]
        self._at[which] = -1

    def take(self, points: NDArray[np.int64], get: Get) -> None:
        """Note the values of all copies that have reached another point."""
        self.make_room(int(points.max()))
        which = np.flatnonzero(points != self._at)
        for name, rows in self._rows.items() if len(which) else ():
            rows[points[which], which] = get(name).reshape(self._copies, -1)[which]
        self._at[which] = points[which]

    def result(self, copy: int, error: FmuMeshError | None) -> Result:
        """The result of a copy, which has ended in this way, if it has."""
        plan, first, last = self._run.plan, int(self._first[copy]), int(self._at[copy])
        record = plan.system.records[0]
        at = np.arange(first, last + 1)[record.rows_within(first, last + 1)]
        values = {name: self._rows[whole][at, copy, index] for name, (whole, index) in self._columns.items()}
        times = plan.grid.start_time + at.astype(np.float64) * plan.grid.step_size
        asked = error if isinstance(error, TerminationRequested) else None
        outcome = outcome_at(plan, last, error=error if asked is None else None, ended_by=asked)
        outcome = replace(outcome, rows=len(at), file=None)
        return Result(self._run.mesh, outcome=outcome, system=plan.system, columns=Columns(times, values))
