"""The method of Dormand and Prince of order 5(4), whose steps are taken by the library of C (`rings/model_exchange.c`).

Owns the memory of the library, what its results mean, and the change to CVode where a model turns out to be stiff. The
method has no history, so an input that jumps costs one evaluation, and a state keeps little more than the step size.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from enum import IntEnum
from typing import Any, Final, cast

import numpy as np

from ....rings import native
from ....rings.library import why_no_library
from ....rings.native import Call, EquationsTable
from ....rings.ring import Ring
from ..clocks import unsettled
from ..fmu_values import SolverFailed
from ..step_options import SolverSettings
from .model_calls import LibraryCalls, ModelCalls
from .solver import CVodeSolver, ModelPlace, Solver

__all__ = ["NOT_SET", "AutoSolver", "DormandPrinceSolver", "HeldRow", "RowBytes", "Solved"]

_IS_STIFF: Final = 15
"""So many steps in a row at the limit of stability, with few others between them; see `count_stiff` in the library."""


class Solved(IntEnum):
    """Why the steps of the library have ended; `burst.h` has the same names."""

    AT_STOP, AT_EVENT, FAILED, TOO_SMALL, NOT_A_NUMBER, UNSETTLED, ENDS, GO_ON, TOO_STIFF, LEFT = range(10)


RowBytes = tuple[bytes | list[Any], ...]
NOT_SET: Final[RowBytes] = (b"not set yet",)

_GIVEN_UP: Final[dict[int, str]] = {Solved.TOO_SMALL: "makes no progress", Solved.NOT_A_NUMBER: "cannot go on"}

_DOUBLES: Final = ctypes.POINTER(ctypes.c_double)


class HeldRow:
    """The inputs of the last step that are held: the bytes of each part."""

    def __init__(self) -> None:
        self._row: RowBytes = ()

    def get(self) -> RowBytes:
        """The row."""
        return self._row

    def put(self, row: RowBytes) -> None:
        """Another row; one that no inputs have makes the next ones an event."""
        self._row = row


class SharedRow(HeldRow):
    """The same in memory that the library compares with the row of a ring, and changes."""

    def __init__(self, table: EquationsTable, inputs: Ring) -> None:
        first = min(inputs.offsets, default=inputs.stride)
        self._table = table
        self._bytes = np.zeros(inputs.stride, np.uint8)
        self._parts = [slice(at, at + part[0].nbytes) for at, part in zip(inputs.offsets, inputs.parts, strict=True)]
        size = inputs.stride - first if self._parts else 0
        table.note(row=inputs.address + first, held=self._bytes.ctypes.data + first, row_bytes=size)

    def get(self) -> RowBytes:
        """See `HeldRow.get`."""
        return tuple(self._bytes[part].tobytes() for part in self._parts) if self._table.is_held else NOT_SET

    def put(self, row: RowBytes) -> None:
        """See `HeldRow.put`."""
        is_held = row != NOT_SET and len(row) == len(self._parts)  # a state may be from before the first `bind`
        self._table.note(is_held=is_held)
        if is_held:
            for part, data in zip(self._parts, row, strict=True):
                self._bytes[part] = np.frombuffer(data, np.uint8)  # type: ignore[arg-type]  # text is not shared


class DormandPrinceSolver(Solver):
    """Variable steps of order 5, events on an interpolant of order 4; no step goes beyond ``stop``.

    One `step` takes steps until ``stop``, an event, or a completed step after which the FMU asks for something; if it
    ``tells`` the FMU of completed steps, it learns of each.
    """

    _advice = "`solver: {name: cvode}` can take longer ones"  # what to do about a stiff model

    def __init__(self, equations: ModelCalls, settings: SolverSettings, *, tells: bool) -> None:
        super().__init__(equations)
        if native.library is None:
            raise SolverFailed(f"it needs the library of C, which is {why_no_library()}")
        self._library = native.library
        n, m = equations.n_states, equations.n_indicators
        self._memory = np.zeros(12 * n + 4 * m)
        at = self._memory.ctypes.data
        states = [at + 8 * n * number for number in range(12)]
        indicators = [at + 8 * (12 * n + m * number) for number in range(4)]
        self._address = states[0]
        self._calls = LibraryCalls(
            equations,
            states=ctypes.cast(states[0], _DOUBLES),
            weights=states[1],
            ends=states[2],
            stage=states[3],
            sixth=states[4],
            slopes=states[5],
            indicators=ctypes.cast(indicators[0], _DOUBLES),
            first_indicators=indicators[1],
            last_indicators=indicators[2],
            next_indicators=indicators[3],
            tolerance=settings.relative_tolerance,
            longest=settings.maximum_step_size or np.inf,
            tells=tells,
        )
        self.table = self._calls.table
        self.at = cast("ModelPlace", self.table)

    @property
    def place(self) -> tuple[float, ...]:
        """See `Solver.place`."""
        own = self.table
        return own.step_size, own.steps, own.rejected, own.stiff, own.not_stiff

    def resume(self, place: tuple[float, ...]) -> None:
        """See `Solver.resume`."""
        if not place:  # the state is that of another solver
            return
        steps, rejected, stiff, not_stiff = map(int, place[1:])
        self.table.note(step_size=place[0], steps=steps, rejected=rejected, stiff=stiff, not_stiff=not_stiff)
        self.table.note(doubted=stiff >= _IS_STIFF)

    def doubt(self) -> str | None:
        """See `Solver.doubt`."""
        if not self.is_stiff or self.table.doubted:
            return None
        self.table.note(doubted=True)
        return f"the model is stiff: dopri5 needs steps of {self.table.step_size:.2g} s to stay stable. {self._advice}"

    @property
    def is_stiff(self) -> bool:
        """Whether the model has turned out to be stiff."""
        return bool(self.table.stiff >= _IS_STIFF)

    def share(self, setters: Sequence[Call], inputs: Ring) -> HeldRow:
        """Let the library set the held inputs of a ring with one row, and step up to the end of a step of the node."""
        own = self.table
        self._held = SharedRow(own, inputs)
        own.give(setters=setters)
        return self._held

    def restart(self) -> None:
        """See `Solver.restart`."""
        if self._library.equations_restart(ctypes.addressof(self.table)):
            raise self._calls.failure()

    def step(self, time: float, stop: float) -> tuple[float, bool]:
        """See `Solver.step`."""
        own = self.table
        own.note(time=time)
        self._calls.follow()
        result = self._library.equations_solve(ctypes.addressof(own), stop)
        self.check(result)
        return own.time, result == Solved.AT_EVENT

    def check(self, result: int) -> None:
        """Raise the error of a step of the library that has failed; see `Solver.step`."""
        if result == Solved.FAILED:
            raise self._calls.failure()
        if result == Solved.UNSETTLED:
            raise SolverFailed(unsettled(self.table.time))
        if result in _GIVEN_UP:
            time = self.table.time
            self._give_up(f"it {_GIVEN_UP[result]} at t = {time:.12g} s", time, self._address)

    def complete(self) -> tuple[bool, bool]:
        """See `Solver.complete`; `step` has told the FMU."""
        return bool(self.table.asks_event), bool(self.table.asks_end)


class AutoSolver(DormandPrinceSolver):
    """The same, until the model turns out to be stiff; from there on CVode, up to the end of the run.

    The counts of `place` say which of the two it is. So a state from before the change goes on with steps of order 5,
    and one from after it with CVode.
    """

    _advice = "cvode goes on from here"

    def __init__(self, equations: ModelCalls, settings: SolverSettings, *, tells: bool) -> None:
        super().__init__(equations, settings, tells=tells)
        self.table.note(leaves=True)
        self._settings = settings
        self._cvode: CVodeSolver | None = None
        self._by_cvode = False  # whether CVode has taken the last step, or takes the next one

    def goes_on_with_cvode(self, place: tuple[float, ...]) -> bool:
        """Whether CVode takes the steps from a `place` on."""
        return bool(place) and place[3] >= _IS_STIFF

    def restart(self) -> None:
        """See `Solver.restart`."""
        self._by_cvode = self.is_stiff
        if self._by_cvode:
            self._other().restart()
        else:
            super().restart()

    def step(self, time: float, stop: float) -> tuple[float, bool]:
        """See `Solver.step`."""
        if not self.is_stiff:
            return super().step(time, stop)
        if not self._by_cvode:
            self.restart()
        return self._other().step(time, stop)

    def check(self, result: int) -> None:
        """As that of `dopri5`; but where its steps get too small, the model is stiff."""
        if result != Solved.TOO_SMALL:
            super().check(result)
            return
        self._equations.set_point(self.table.time, self._address)
        self.table.note(stiff=_IS_STIFF)

    def complete(self) -> tuple[bool, bool]:
        """See `Solver.complete`."""
        return self._equations.completed_step() if self._by_cvode else super().complete()

    def close(self) -> None:
        """See `Solver.close`."""
        if self._cvode is not None:
            self._cvode.close()

    def _other(self) -> CVodeSolver:
        if self._cvode is None:
            own = self._settings
            self._cvode = CVodeSolver(self._equations, own.relative_tolerance, own.maximum_step_size)
        return self._cvode
