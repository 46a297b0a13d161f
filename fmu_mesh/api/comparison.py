"""Two results side by side: where they differ, and by how much.

Owns which rows belong together, and when two values are equal. It knows results only by their arrays and units.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..text import listed, short_number
from ..variables.units import BaseUnit, Linear, conversion
from .tables import shortened, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "Comparison",
    "FirstDifference",
    "Side",
    "VariableDifference",
    "compared",
    "differences_of",
    "values_in_unit_of",
]

Rows = Literal["same", "common", "interpolated"]

_ROUNDING = 1e-6
"""Times that differ by less than this part of a step are the same time."""
_NAME = 32
_SHOWN = 40
_DRAWN = 6


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


class FirstDifference(msgspec.Struct, frozen=True):
    """The first row with a difference, and the variable.

    Attributes:
        time: simulation time in s.
        point: the communication point; the number of the row if a file does not tell its points.
        variable: `instance.variable`.
        here: the value in the result that was compared; ``there``: that in the other one.
        difference: here - there; None where that is no number, as for texts.
    """

    time: float
    point: int
    variable: str
    here: Any
    there: Any
    difference: float | None


class VariableDifference(msgspec.Struct, frozen=True):
    """How one variable differs.

    Attributes:
        rows: number of rows with a difference beyond the tolerance.
        largest: the largest absolute difference, in the unit of the first result; None where no row has one, as for
            texts, and where one value is infinite or NaN only on one side.
        at: its time in s.
        relative: the largest difference relative to the larger one of both values; ``relative_at``: its time in s.
        unit: the unit of the first result; None if it is not known.
        note: what was converted, or cannot be compared.
    """

    rows: int
    largest: float | None = None
    at: float | None = None
    relative: float | None = None
    relative_at: float | None = None
    unit: str | None = None
    note: str = ""


class Comparison(msgspec.Struct, frozen=True):
    """What `Result.compare` has found.

    Example:
        >>> import fmu_mesh
        >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
        >>> one = mesh.run(record="memory", stop_time=1.0)
        >>> other = mesh.run(record="memory", stop_time=1.0, start_values={"delay.d": 0.5})
        >>> comparison = one.compare(other)
        >>> comparison.equal, list(comparison.differences), comparison.first.time
        (False, ['delay.y'], 0.504)
        >>> one.compare(other, atol=10.0).equal
        True

    Attributes:
        here: the name of the result that was compared; ``there``: that of the other one.
        rtol: the relative tolerance; ``atol``: the absolute one.
        rows: number of rows that were compared.
        matching: "same": both have the same times; "common": the rows at times that both have; "interpolated": the
            other result at the times of this one.
        first: the first difference beyond the tolerance; None if there is none.
        differences: by variable, those with any difference; also within the tolerance, where ``rows`` is 0.
        compared: the variables that were compared.
        only_here: variables that only this result has; ``only_there``: only the other one.
        rows_only_here: rows before or after all rows of the other result; ``rows_only_there`` likewise.
    """

    here: str
    there: str
    rtol: float
    atol: float
    rows: int
    matching: Rows
    first: FirstDifference | None
    differences: dict[str, VariableDifference]
    compared: tuple[str, ...]
    only_here: tuple[str, ...] = ()
    only_there: tuple[str, ...] = ()
    rows_only_here: int = 0
    rows_only_there: int = 0
    drawn: Callable[[Sequence[str]], Figure] | None = None

    @property
    def equal(self) -> bool:
        """Whether both have the same variables, the same span of time, and no difference beyond the tolerance."""
        return not (
            any(difference.rows for difference in self.differences.values())
            or self.only_here
            or self.only_there
            or self.rows_only_here
            or self.rows_only_there
        )

    def __bool__(self) -> bool:
        return self.equal

    def __str__(self) -> str:
        return self.text

    @property
    def text(self) -> str:
        """What is different, as a sentence and a table: the message of a test that failed."""
        lines = [self._head()]
        if self.first is not None:
            first = self.first
            values = f"{_shown(first.here)} in {self.here}, {_shown(first.there)} in {self.there}"
            lines.append(f"first at t = {short_number(first.time)} s, point {first.point}: {first.variable}: {values}")
        lines += self._rows_text()
        if self.differences:
            order = sorted(self.differences, key=lambda name: -self.differences[name].rows)
            cells = [_cells(name, self.differences[name], self.rows) for name in order[:_SHOWN]]
            heading = ["variable", "rows", "largest difference", "at", "relative", "at", ""]
            lines += ["", *table(cells, heading=heading)]
            lines += [f"and {len(order) - _SHOWN} more"] if len(order) > _SHOWN else []
        for names, where in ((self.only_here, self.here), (self.only_there, self.there)):
            lines += [f"only in {where}: {listed(names)}"] if names else []
        return "\n".join(lines)

    def plot(self, *names: str) -> Figure:
        """Draw both results and their difference; without names, the variables that differ most.

        Example:
            >>> import fmu_mesh
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> one = mesh.run(record="memory", stop_time=1.0)
            >>> other = mesh.run(record="memory", stop_time=1.0, start_values={"delay.d": 0.5})
            >>> one.compare(other).plot().savefig("difference.png")

        Raises:
            ConfigurationError: there is no such variable, or matplotlib is not installed.
        """
        assert self.drawn is not None  # `Result.compare` gives it
        order = sorted(self.differences, key=lambda name: -self.differences[name].rows)
        drawable = [name for name in order if self.differences[name].largest is not None]
        return self.drawn(names or drawable[:_DRAWN] or self.compared[:_DRAWN])

    def _head(self) -> str:
        limits = [f"{name} {value:g}" for name, value in (("rtol", self.rtol), ("atol", self.atol)) if value]
        within = f" within {', '.join(limits)}" if limits else ""
        what = f"{_count(len(self.compared), 'variable')}, {_count(self.rows, 'row')}"
        if self.equal:
            return f"{self.here} and {self.there} are equal{within}: {what}"
        differing = sum(difference.rows > 0 for difference in self.differences.values())
        parts = [f"{differing} of {_count(len(self.compared), 'variable')}"] if differing else []
        parts += [f"{_count(len(self.only_here) + len(self.only_there), 'variable')} only in one"] * bool(
            self.only_here or self.only_there
        )
        parts += ["the span of time"] * bool(self.rows_only_here or self.rows_only_there)
        beyond = f" beyond {', '.join(limits)}" if limits else ""
        return f"{self.here} and {self.there} differ{beyond}: {', '.join(parts)}"

    def _rows_text(self) -> list[str]:
        lines = []
        if self.matching == "common":
            lines.append(f"compared at the {_count(self.rows, 'time')} that both have")
        if self.matching == "interpolated":
            how = "floats linearly, others held"
            lines.append(f"compared at {_count(self.rows, 'time')} of {self.here}; {self.there} is interpolated: {how}")
        for count, where in ((self.rows_only_here, self.here), (self.rows_only_there, self.there)):
            lines += [f"{_count(count, 'row')} of {where} before or after all of the other"] if count else []
        return lines


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


# --- text


def _cells(name: str, difference: VariableDifference, rows: int) -> list[str]:
    unit = f" {difference.unit}" if difference.unit else ""

    def at(time: float | None) -> str:
        return f"{short_number(time)} s" if time is not None else ""

    return [
        shortened(name, _NAME),
        f"{difference.rows} of {rows}" if difference.rows else "within",
        f"{difference.largest:.6g}{unit}" if difference.largest is not None else "",
        at(difference.at),
        f"{difference.relative:.3g}" if difference.relative is not None else "",
        at(difference.relative_at),
        difference.note,
    ]


def _kind(values: NDArray[Any]) -> str:
    if values.dtype == object:
        return "text"
    return "true or false" if values.dtype == bool else "numbers"


def _shown(value: object) -> str:
    return repr(value) if isinstance(value, float | str | bytes) else str(value)


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
