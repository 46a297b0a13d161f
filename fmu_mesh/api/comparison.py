"""What a comparison of two results has found: as values, as text and as a picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from ..pictures.tables import html_table, shortened, table
from ..printing import page
from ..text import counted, listed, short_number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Comparison", "FirstDifference", "Rows", "VariableDifference"]

Rows = Literal["same", "common", "interpolated"]

_NAME = 32
_SHOWN = 40
_DRAWN = 6
_HEADING = ("variable", "rows", "largest difference", "at", "relative", "at", "")


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
        (False, ['delay.y'], 0.502)
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
        note: why the machines may have calculated other last digits; empty if there is no reason.
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
    note: str = ""
    drawn: Callable[[Sequence[str]], Figure] | None = None

    @property
    def equal(self) -> bool:
        """Whether both have the same variables, the same span of time, and no difference beyond the tolerance."""
        alone = self.only_here or self.only_there or self.rows_only_here or self.rows_only_there
        return not (alone or any(difference.rows for difference in self.differences.values()))

    def __bool__(self) -> bool:
        return self.equal

    def __str__(self) -> str:
        return self.text

    def __repr__(self) -> str:
        return f"<Comparison: {self._head()}>"

    def _repr_html_(self) -> str:
        order, title = self._most_different, "; ".join([self._head(), *self._first_text()])
        rows = (_cells(name, self.differences[name], self.rows) for name in order)
        return html_table(title, _HEADING, rows, len(order))

    @property
    def text(self) -> str:
        """What is different, as a sentence and a table: the message of a test that failed."""
        lines = [self._head(), *self._first_text()]
        lines += [f"calculated on other machines: {self.note}"] if self.note else []
        lines += self._rows_text()
        if self.differences:
            order = self._most_different
            cells = [_cells(name, self.differences[name], self.rows) for name in order[:_SHOWN]]
            lines += ["", *table(cells, heading=_HEADING)]
            lines += [f"and {len(order) - _SHOWN} more"] if len(order) > _SHOWN else []
        for names, where in ((self.only_here, self.here), (self.only_there, self.there)):
            lines += [f"only in {where}: {listed(names)}"] if names else []
        return page(lines)

    def plot(self, *names: str) -> Figure:
        """Draw both results and their difference; without names, the variables that differ most.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> one = mesh.run(record="memory", stop_time=1.0)
            >>> other = mesh.run(record="memory", stop_time=1.0, start_values={"delay.d": 0.5})
            >>> one.compare(other).plot().savefig("difference.png")

        Raises:
            ConfigurationError: there is no such variable, or matplotlib is not installed.
        """
        assert self.drawn is not None  # `Result.compare` gives it
        drawable = [name for name in self._most_different if self.differences[name].largest is not None]
        return self.drawn(names or drawable[:_DRAWN] or self.compared[:_DRAWN])

    @property
    def _most_different(self) -> list[str]:
        return sorted(self.differences, key=lambda name: -self.differences[name].rows)

    def _first_text(self) -> list[str]:
        if (first := self.first) is None:
            return []
        values = f"{_shown(first.here)} in {self.here}, {_shown(first.there)} in {self.there}"
        return [f"first at t = {short_number(first.time)} s, point {first.point}: {first.variable}: {values}"]

    def _head(self) -> str:
        limits = ", ".join(f"{name} {own:g}" for name, own in (("rtol", self.rtol), ("atol", self.atol)) if own)
        variables = counted(len(self.compared), "variable")
        if self.equal:
            within = f" within {limits}" if limits else ""
            return f"{self.here} and {self.there} are equal{within}: {variables}, {counted(self.rows, 'row')}"
        differing = sum(difference.rows > 0 for difference in self.differences.values())
        alone = len(self.only_here) + len(self.only_there)
        parts = [f"{differing} of {variables}"] if differing else []
        parts += [f"{counted(alone, 'variable')} only in one"] if alone else []
        parts += ["the span of time"] if self.rows_only_here or self.rows_only_there else []
        beyond = f" beyond {limits}" if limits else ""
        return f"{self.here} and {self.there} differ{beyond}: {', '.join(parts)}"

    def _rows_text(self) -> list[str]:
        how = f"of {self.here}; {self.there} is interpolated: floats linearly, others held"
        lines = {
            "same": [],
            "common": [f"compared at the {counted(self.rows, 'time')} that both have"],
            "interpolated": [f"compared at {counted(self.rows, 'time')} {how}"],
        }[self.matching]
        for count, where in ((self.rows_only_here, self.here), (self.rows_only_there, self.there)):
            lines += [f"{counted(count, 'row')} of {where} before or after all of the other"] if count else []
        return lines


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


def _shown(value: object) -> str:
    return repr(value) if isinstance(value, float | str | bytes) else str(value)
