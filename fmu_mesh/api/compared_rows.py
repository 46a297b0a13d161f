"""Two results side by side: which rows belong together, and where values differ.

Knows results only by their arrays and units.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..results.recording import Columns
from ..variables.units import BaseUnit, Linear, conversion
from .comparison import Comparison, FirstDifference, Rows, VariableDifference

__all__ = ["Side", "compared", "differences_of", "values_in_unit_of"]

_ROUNDING = 1e-6
"""Times that differ by less than this part of a step are the same time."""


class Side(NamedTuple):
    """One of the two results."""

    title: str  # what messages call it
    columns: Collection[str]  # the names of its variables; of thousands a collection that finds one at once
    pieces: Callable[[], Iterator[Columns]]  # its rows, piece by piece; times do not decrease
    all: Callable[[], Columns]
    unit: Callable[[str], str | None]  # the unit of a variable by its name; None if it is not known
    base_unit: Callable[[str], BaseUnit | None]  # the same in SI base units; None if it is not known
    point: Callable[[int, float], int]  # the number of the communication point of a row, by its number and time


class _Matching(NamedTuple):
    """Which rows belong together: how many, and their numbers here and there.

    Those here are None for all rows in their order, those there for interpolation. ``near`` is how far times may be
    apart that are the same.
    """

    how: Rows
    rows: int
    here: NDArray[np.intp] | None = None
    there: NDArray[np.intp] | None = None
    only_here: int = 0
    only_there: int = 0
    near: float = 0.0


def compared(here: Side, there: Side, names: Sequence[str], *, rtol: float = 0.0, atol: float = 0.0) -> Comparison:
    """Compare two results, as `Result.compare`; rows that belong together in their order are read piece by piece.

    Times and units are those of the first one; a variable that only one of them has is told.
    """
    both = [name for name in names if name in here.columns and name in there.columns]
    tallies = {name: _Tally(here, there, name, (rtol, atol)) for name in both}
    matching = _in_step(here, there, tallies)
    if matching is None:
        tallies = {name: _Tally(here, there, name, (rtol, atol)) for name in both}
        matching, own, other = _matched(here, there)
        for name, tally in tallies.items():
            values = values_in_unit_of(here, there, name, other.values[name])
            of_rows = _values_there(matching, own.times, other, values)
            tally.add(own.times[matching.here], own.values[name][matching.here], of_rows)
    found = {name: tally.difference for name, tally in tallies.items()}
    firsts = [(tally.first, name) for name, tally in tallies.items() if tally.first is not None]
    first = min(firsts, default=None, key=lambda own: own[0][0])  # of equal rows the first variable
    return Comparison(
        here.title,
        there.title,
        rtol,
        atol,
        matching.rows,
        matching.how,
        _first(here, there, matching, *first) if first is not None else None,
        {name: difference for name, difference in found.items() if difference is not None},
        tuple(both),
        tuple(name for name in names if name in here.columns and name not in there.columns),
        tuple(name for name in names if name not in here.columns and name in there.columns),
        matching.only_here,
        matching.only_there,
    )


def differences_of(
    here: Side, there: Side, names: Sequence[str]
) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """By variable that both have, the compared times in s, and the values here minus those there."""
    matching, one, other = _matched(here, there)
    times = one.times[matching.here]
    found = {}
    for name in names:
        if name in here.columns and name in there.columns and _conversion(here, there, name)[1] is not None:
            own = one.values[name][matching.here]
            values = _values_there(matching, one.times, other, values_in_unit_of(here, there, name, other.values[name]))
            if object not in (own.dtype, values.dtype):
                found[name] = times, own.astype(np.float64) - values.astype(np.float64)
    return found


# --- rows


class _Span:
    """The times of a result, from its first piece on: their number, the first, the last and the least distance in s."""

    def __init__(self) -> None:
        self.rows = 0
        self.first = self.last = 0.0
        self.step = np.inf
        self.rises = True

    def add(self, times: NDArray[np.float64]) -> None:
        self.first = self.first if self.rows else float(times[0])
        distances = np.diff(times, prepend=self.last if self.rows else times[0])
        self.step = min(self.step, float(distances.min(initial=np.inf, where=distances > 0.0)))
        self.rises = self.rises and bool((distances >= 0.0).all())
        self.rows, self.last = self.rows + len(times), float(times[-1])


def _in_step(here: Side, there: Side, tallies: Mapping[str, _Tally]) -> _Matching | None:
    """Compare the rows of both in their order; None if they do not belong together, and then tallies are useless."""
    one, two = _Span(), _Span()
    rows, apart, next_time = 0, 0.0, np.inf
    for own, other in _aligned(here.pieces(), there.pieces()):
        if own is not None:
            one.add(own.times)
        if other is not None:
            two.add(other.times)
        if own is None or other is None:
            rest = own or other
            assert rest is not None  # one of them has rows
            next_time = min(next_time, float(rest.times[0]))
            continue
        apart = max(apart, float(np.nan_to_num(np.abs(own.times - other.times), nan=np.inf).max()))
        if apart > _near(one, two):
            return None
        for name, tally in tallies.items():
            tally.add(own.times, own.values[name], values_in_unit_of(here, there, name, other.values[name]))
        rows += len(own.times)
    if one.rows and two.rows:
        near, shorter = _near(one, two), min(one, two, key=lambda span: span.rows)
        if not (one.rises and two.rises and apart <= near and next_time > shorter.last + _margin(shorter.step, near)):
            return None
    return _Matching("same", rows, only_here=one.rows - rows, only_there=two.rows - rows)


def _aligned(here: Iterator[Columns], there: Iterator[Columns]) -> Iterator[tuple[Columns | None, Columns | None]]:
    """Pieces with the same numbers of rows; where one result has ended, the rest of the other one with None."""
    pieces = [here, there]
    waiting: list[Columns | None] = [Columns(np.zeros(0), {})] * 2
    while True:
        for place, piece in enumerate(waiting):
            while piece is not None and not len(piece.times):
                piece = next(pieces[place], None)  # noqa: PLW2901  the next one that has rows
            waiting[place] = piece
        left = [len(piece.times) for piece in waiting if piece is not None]
        if not left:
            return
        own, other = (None if piece is None else _part(piece, slice(min(left))) for piece in waiting)
        yield own, other
        waiting = [None if piece is None else _part(piece, slice(min(left), None)) for piece in waiting]


def _part(columns: Columns, rows: slice) -> Columns:
    return Columns(columns.times[rows], {name: values[rows] for name, values in columns.values.items()})


def _near(here: _Span, there: _Span) -> float:
    """How far times may be apart that are the same."""
    largest = max(abs(time) for span in (here, there) for time in (span.first, span.last))
    step = min(here.step, there.step)
    return max(_ROUNDING * step if np.isfinite(step) else 0.0, 4.0 * float(np.spacing(largest)))


def _margin(step: float, near: float) -> float:
    """A time that is farther outside is outside: that of less than one step of the others is not."""
    return max(step - near, near) if np.isfinite(step) else near


def _matched(here: Side, there: Side) -> tuple[_Matching, Columns, Columns]:
    """The rows that belong together, and all rows of both."""
    one, two = here.all(), there.all()
    times, others = one.times, two.times
    if not len(times) or not len(others):
        nothing = np.zeros(0, np.intp)
        return _Matching("same", 0, nothing, nothing, len(times), len(others)), one, two
    spans = _Span(), _Span()
    spans[0].add(times)
    spans[1].add(others)
    near = _near(*spans)
    only_here, only_there = _outside(times, others, spans[1].step, near), _outside(others, times, spans[0].step, near)
    count = min(len(times), len(others))
    is_same = abs(len(times) - len(others)) == only_here + only_there
    if is_same and np.allclose(times[:count], others[:count], 0.0, near):
        rows = np.arange(count)
        return _Matching("same", count, rows, rows, only_here, only_there), one, two
    nearest = _nearest(times, others)
    is_common = np.abs(others[nearest] - times) <= near
    within_here = (times >= others[0] - near) & (times <= others[-1] + near)
    within_there = (others >= times[0] - near) & (others <= times[-1] + near)
    common = int(is_common.sum())
    if common and common in (int(within_here.sum()), int(within_there.sum())):
        rows = np.flatnonzero(is_common)
        return _Matching("common", common, rows, nearest[is_common], only_here, only_there), one, two
    rows = np.flatnonzero(within_here)
    return _Matching("interpolated", len(rows), rows, None, only_here, only_there, near), one, two


def _outside(times: NDArray[np.float64], others: NDArray[np.float64], step: float, near: float) -> int:
    """How many times are at least one step of the others before or after all of these."""
    margin = _margin(step, near)
    return int(((times < others[0] - margin) | (times > others[-1] + margin)).sum())


def _nearest(times: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.intp]:
    right = np.clip(np.searchsorted(others, times), 1, max(len(others) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(others) - 1)
    return np.where(np.abs(others[left] - times) <= np.abs(others[right] - times), left, right)


# --- values


class _Tally:
    """What differs in one variable, of the rows so far; ``first``: number, time and values of the first such row."""

    def __init__(self, here: Side, there: Side, name: str, tolerances: tuple[float, float]) -> None:
        self._titles, (self._rtol, self._atol) = (here.title, there.title), tolerances
        self._unit, (self._note, self._change) = here.unit(name), _conversion(here, there, name)
        self.first: tuple[int, float, Any, Any] | None = None
        self._rows = self._wrong = 0
        self._mismatch, self._is_unequal, self._are_texts = self._change is None, False, False
        self._largest = self._steepest = (-1.0, 0.0)

    def add(self, times: NDArray[np.float64], own: NDArray[Any], other: NDArray[Any]) -> None:
        if (own.dtype == object) != (other.dtype == object):
            here, there = self._titles
            self._note = self._note or f"{_kind(own)} in {here}, {_kind(other)} in {there}"
            self._mismatch = True
        wrong = np.ones(len(times), bool) if self._mismatch else self._beyond(times, own, other)
        self._wrong += int(wrong.sum())
        if self.first is None and wrong.any():
            row = int(np.argmax(wrong))
            self.first = self._rows + row, float(times[row]), _plain(own[row]), _plain(other[row])
        self._rows += len(times)

    def _beyond(self, times: NDArray[np.float64], own: NDArray[Any], other: NDArray[Any]) -> NDArray[np.bool_]:
        are_floats = own.dtype.kind == "f" or other.dtype.kind == "f"
        unequal: NDArray[np.bool_] = own != other
        if are_floats:
            unequal &= ~(np.isnan(own) & np.isnan(other))
        if not unequal.any():
            return unequal
        self._is_unequal, self._are_texts = True, own.dtype == object
        if own.dtype == object:
            return unequal
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            left, right = own.astype(np.float64), other.astype(np.float64)
            distance = np.where(unequal, np.abs(left - right), 0.0)
            larger = np.maximum(np.abs(left), np.abs(right))
            relative = np.where(unequal, distance / larger, 0.0)
            is_within = np.isfinite(distance) & (distance <= self._atol + self._rtol * larger)
        finite = np.isfinite(distance) & unequal
        if finite.any():
            largest = int(np.argmax(np.where(finite, distance, -1.0)))
            steepest = int(np.argmax(np.where(finite, relative, -1.0)))
            self._largest = max(self._largest, (float(distance[largest]), float(times[largest])), key=itemgetter(0))
            self._steepest = max(self._steepest, (float(relative[steepest]), float(times[steepest])), key=itemgetter(0))
        # Whole numbers beyond 2**53 may differ although their floats do not.
        has_tolerance = (self._rtol > 0.0 or self._atol > 0.0) and np.bool_ not in (own.dtype, other.dtype)
        return np.logical_and(unequal, ~is_within) if has_tolerance else unequal

    @property
    def difference(self) -> VariableDifference | None:
        """How the variable differs; None if not at all."""
        if self._mismatch:
            return VariableDifference(self._rows, unit=self._unit, note=self._note)
        if not self._is_unequal:
            return None
        if self._are_texts:
            return VariableDifference(self._wrong, unit=self._unit)
        if self._largest[0] < 0.0:
            return VariableDifference(self._wrong, unit=self._unit, note="infinite or NaN in one")
        return VariableDifference(self._wrong, *self._largest, *self._steepest, self._unit, self._note)


def _values_there(
    matching: _Matching, times: NDArray[np.float64], other: Columns, values: NDArray[Any]
) -> NDArray[Any]:
    if matching.there is not None:
        return values[matching.there]
    times = times[matching.here]
    before = np.clip(np.searchsorted(other.times, times + matching.near, "right") - 1, 0, None)
    held: NDArray[Any] = values[before]
    if values.dtype.kind != "f":
        return held
    is_same = np.abs(other.times[before] - times) <= matching.near
    return np.where(is_same, held, np.interp(times, other.times, values))


def values_in_unit_of(here: Side, there: Side, name: str, values: NDArray[Any]) -> NDArray[Any]:
    """Values of a variable there, in the unit that it has here; as they are if that is not known."""
    change = _conversion(here, there, name)[1] if name in here.columns else None
    if change is None or change.identity or values.dtype == object:
        return values
    converted: NDArray[Any] = change.factor * values + change.offset
    return converted


def _conversion(here: Side, there: Side, name: str) -> tuple[str, Linear | None]:
    """A note, and the conversion of the values there; None for units that cannot be converted."""
    unit, other = here.unit(name), there.unit(name)
    if unit is None or other is None or unit == other:
        return "", Linear()
    base, other_base = here.base_unit(name), there.base_unit(name)
    if base is None or other_base is None:
        return f"not converted: {other} in {there.title}", Linear()
    if (change := conversion(other_base, base)) is None:
        return f"{unit} in {here.title}, {other} in {there.title}", None
    return f"converted from {other}", change


def _first(
    here: Side, there: Side, matching: _Matching, first: tuple[int, float, Any, Any], name: str
) -> FirstDifference:
    row, time, own, other = first
    place = row if matching.here is None else int(matching.here[row])
    is_number = not any(isinstance(value, str | bytes) for value in (own, other))
    difference = float(own) - float(other) if is_number and _conversion(here, there, name)[1] is not None else None
    return FirstDifference(time, here.point(place, time), name, own, other, difference)


def _plain(value: Any) -> Any:  # noqa: ANN401  an element of any array
    return value.item() if isinstance(value, np.generic) else value


def _kind(values: NDArray[Any]) -> str:
    if values.dtype == object:
        return "text"
    return "true or false" if values.dtype == bool else "numbers"
