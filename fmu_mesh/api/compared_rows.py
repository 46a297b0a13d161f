"""Two results side by side: which rows belong together, and where values differ.

Knows results only by their arrays and units.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..variables.units import BaseUnit, Linear, conversion
from .comparison import Comparison, FirstDifference, Rows, VariableDifference

__all__ = ["Side", "compared", "differences_of", "values_in_unit_of"]

_ROUNDING = 1e-6
"""Times that differ by less than this part of a step are the same time."""


class Side(NamedTuple):
    """One of the two results.

    Attributes:
        title: what messages call it.
        times: the times in s, not decreasing.
        columns: the names of its variables.
        values: the array of a variable by its name.
        unit: the unit of a variable by its name; None if it is not known.
        base_unit: the same in SI base units; None if it is not known.
        point: the number of the communication point of a row.
    """

    title: str
    times: NDArray[np.float64]
    columns: Sequence[str]
    values: Callable[[str], NDArray[Any]]
    unit: Callable[[str], str | None]
    base_unit: Callable[[str], BaseUnit | None]
    point: Callable[[int], int]


class _Matching(NamedTuple):
    """Which rows belong together: numbers of rows here and there; those there are None for interpolation.

    ``near`` is how far times may be apart that are the same.
    """

    how: Rows
    here: NDArray[np.intp]
    there: NDArray[np.intp] | None
    only_here: int
    only_there: int
    near: float = 0.0


class _Pair(NamedTuple):
    """Both results, their rows that belong together, and the tolerances."""

    here: Side
    there: Side
    matching: _Matching
    rtol: float
    atol: float


def compared(here: Side, there: Side, names: Sequence[str], *, rtol: float = 0.0, atol: float = 0.0) -> Comparison:
    """Compare two results.

    Args:
        here: the one result, whose times and units hold.
        there: the other one.
        names: the variables; one that only one of them has is told.
        rtol: relative tolerance; two numbers are equal if `|a - b| <= atol + rtol * max(|a|, |b|)`.
        atol: absolute tolerance.
    """
    both = [name for name in names if name in here.columns and name in there.columns]
    pair = _Pair(here, there, _matched(here.times, there.times), rtol, atol)
    matching = pair.matching
    differences: dict[str, VariableDifference] = {}
    first: tuple[int, str] | None = None
    for name in both:
        found, row = _difference(pair, name)
        if found is not None:
            differences[name] = found
        if row is not None and (first is None or row < first[0]):
            first = row, name
    return Comparison(
        here.title,
        there.title,
        rtol,
        atol,
        len(matching.here),
        matching.how,
        _first(pair, *first) if first is not None else None,
        differences,
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
    pair = _Pair(here, there, _matched(here.times, there.times), 0.0, 0.0)
    rows = pair.matching.here
    found = {}
    for name in names:
        if name in here.columns and name in there.columns and _conversion(pair.here, pair.there, name)[1] is not None:
            own, other = here.values(name)[rows], _values_there(pair, name)
            if object not in (own.dtype, other.dtype):
                found[name] = here.times[rows], own.astype(np.float64) - other.astype(np.float64)
    return found


# --- rows


def _matched(here: NDArray[np.float64], there: NDArray[np.float64]) -> _Matching:
    """The rows that belong together."""
    if not len(here) or not len(there):
        nothing = np.zeros(0, np.intp)
        return _Matching("same", nothing, nothing, len(here), len(there))
    step_here, step_there = _step(here), _step(there)
    largest = max(abs(here[0]), abs(here[-1]), abs(there[0]), abs(there[-1]))
    near = max(_ROUNDING * min(step_here or step_there, step_there or step_here), 4.0 * float(np.spacing(largest)))
    only_here = _outside(here, there, step_there, near)
    only_there = _outside(there, here, step_here, near)
    count = min(len(here), len(there))
    if abs(len(here) - len(there)) == only_here + only_there and np.allclose(here[:count], there[:count], 0.0, near):
        rows = np.arange(count)
        return _Matching("same", rows, rows, only_here, only_there)
    nearest = _nearest(here, there)
    is_common = np.abs(there[nearest] - here) <= near
    within_here = (here >= there[0] - near) & (here <= there[-1] + near)
    within_there = (there >= here[0] - near) & (there <= here[-1] + near)
    common = int(is_common.sum())
    if common and common in (int(within_here.sum()), int(within_there.sum())):
        return _Matching("common", np.flatnonzero(is_common), nearest[is_common], only_here, only_there)
    return _Matching("interpolated", np.flatnonzero(within_here), None, only_here, only_there, near)


def _step(times: NDArray[np.float64]) -> float:
    """The smallest distance of two times; 0 for a single one."""
    distances = np.diff(times)
    distances = distances[distances > 0.0]
    return float(distances.min()) if len(distances) else 0.0


def _outside(times: NDArray[np.float64], others: NDArray[np.float64], step: float, near: float) -> int:
    """How many times are at least one step of the others before or after all of these."""
    margin = max(step - near, near)
    return int(((times < others[0] - margin) | (times > others[-1] + margin)).sum())


def _nearest(times: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.intp]:
    right = np.clip(np.searchsorted(others, times), 1, max(len(others) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(others) - 1)
    return np.where(np.abs(others[left] - times) <= np.abs(others[right] - times), left, right)


# --- values


def _difference(pair: _Pair, name: str) -> tuple[VariableDifference | None, int | None]:
    """How a variable differs, None if not at all; and the first of the compared rows beyond the tolerance."""
    here, matching = pair.here, pair.matching
    unit, (note, change) = here.unit(name), _conversion(pair.here, pair.there, name)
    times = here.times[matching.here]
    own, other = here.values(name)[matching.here], _values_there(pair, name)
    if change is None or (own.dtype == object) != (other.dtype == object):
        note = note or f"{_kind(own)} in {here.title}, {_kind(other)} in {pair.there.title}"
        return VariableDifference(len(times), unit=unit, note=note), 0 if len(times) else None
    if own.dtype == object:
        wrong = own != other
        return (VariableDifference(int(wrong.sum()), unit=unit), _first_of(wrong)) if wrong.any() else (None, None)
    are_floats = own.dtype.kind == "f" or other.dtype.kind == "f"
    unequal = ~((own == other) | (np.isnan(own) & np.isnan(other))) if are_floats else own != other
    if not unequal.any():
        return None, None
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        left, right = own.astype(np.float64), other.astype(np.float64)
        distance = np.where(unequal, np.abs(left - right), 0.0)
        larger = np.maximum(np.abs(left), np.abs(right))
        relative = np.where(unequal, distance / larger, 0.0)
        is_within = np.isfinite(distance) & (distance <= pair.atol + pair.rtol * larger)
    # Whole numbers beyond 2**53 may differ although their floats do not.
    has_tolerance = (pair.rtol > 0.0 or pair.atol > 0.0) and np.bool_ not in (own.dtype, other.dtype)
    wrong = unequal & ~is_within if has_tolerance else unequal
    finite = np.isfinite(distance) & unequal
    if not finite.any():
        return VariableDifference(int(wrong.sum()), unit=unit, note="infinite or NaN in one"), _first_of(wrong)
    largest = int(np.argmax(np.where(finite, distance, -1.0)))
    steepest = int(np.argmax(np.where(finite, relative, -1.0)))
    numbers = float(distance[largest]), float(times[largest]), float(relative[steepest]), float(times[steepest])
    return VariableDifference(int(wrong.sum()), *numbers, unit, note), _first_of(wrong)


def _values_there(pair: _Pair, name: str) -> NDArray[Any]:
    """The values of the other result at the compared times, in the unit of this one."""
    there, matching = pair.there, pair.matching
    values = values_in_unit_of(pair.here, there, name)
    if matching.there is not None:
        return values[matching.there]
    times = pair.here.times[matching.here]
    before = np.clip(np.searchsorted(there.times, times + matching.near, "right") - 1, 0, None)
    held: NDArray[Any] = values[before]
    if values.dtype.kind != "f":
        return held
    is_same = np.abs(there.times[before] - times) <= matching.near
    return np.where(is_same, held, np.interp(times, there.times, values))


def values_in_unit_of(here: Side, there: Side, name: str) -> NDArray[Any]:
    """The values of a variable there, in the unit that it has here; as they are if that is not known."""
    values = there.values(name)
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
    change = conversion(other_base, base)
    if change is None:
        return f"{unit} in {here.title}, {other} in {there.title}", None
    return f"converted from {other}", change


def _first(pair: _Pair, row: int, name: str) -> FirstDifference:
    here, matching = pair.here, pair.matching
    place = int(matching.here[row])
    other_place = matching.there[row : row + 1] if matching.there is not None else None
    one = pair._replace(matching=matching._replace(here=matching.here[row : row + 1], there=other_place))
    own, other = here.values(name)[place], _values_there(one, name)[0]
    is_number = not any(isinstance(value, str | bytes) for value in (own, other))
    has_difference = is_number and _conversion(pair.here, pair.there, name)[1] is not None
    return FirstDifference(
        float(here.times[place]),
        here.point(place),
        name,
        _plain(own),
        _plain(other),
        float(own) - float(other) if has_difference else None,
    )


def _first_of(wrong: NDArray[np.bool_]) -> int | None:
    return int(np.argmax(wrong)) if wrong.any() else None


def _plain(value: Any) -> Any:  # noqa: ANN401  an element of any array
    return value.item() if isinstance(value, np.generic) else value


def _kind(values: NDArray[Any]) -> str:
    if values.dtype == object:
        return "text"
    return "true or false" if values.dtype == bool else "numbers"
