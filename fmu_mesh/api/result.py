"""The result of a run: arrays by name, with times and units."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import cached_property
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from msgspec import convert
from msgspec.structs import replace
from numpy.typing import NDArray

from ..config.call_options import checked
from ..errors import CallRefused, ConfigurationError, UnknownName
from ..files import unwritable
from ..installing import importing
from ..instances.python.unit_names import base_unit_of
from ..pictures.drawing import thinned
from ..pictures.result_drawing import FLAGS, NUMBERS, Curve, Curves, PictureOptions, figure_of
from ..pictures.tables import html_table
from ..results.column_names import chosen_names, of_one_instance
from ..results.csv_file import CsvFile
from ..results.formats import read_result, result_pieces
from ..results.parquet_file import ParquetFile
from ..results.recording import Columns, ResultFile, joined
from ..run.outcome import Outcome
from ..run.run_plan import RunPlan
from ..system.defect import Defect
from ..system.run_metadata import machine_difference
from ..system.system import ResolvedSystem
from ..text import listed, short_path
from ..variables.model_description import Variable
from ..variables.units import BaseUnit
from ..variables.value_types import DTYPES, VariableType, is_float
from .compared_rows import Side, compared, differences_of, values_in_unit_of
from .comparison import Comparison

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

__all__ = ["Result", "imported_pandas", "recorded_variables", "result_of", "summary_of", "types_of"]

_HELD = ("constant", "fixed", "tunable", "discrete")
"""Variabilities of variables whose values hold between two events."""


class Result(Mapping[str, NDArray[Any]]):
    """What a run has recorded, and how it ended.

    A mapping from `instance.variable` to an array with one value per row. Arrays belong to the caller: to change one
    changes nothing else. They are read from the result file when they are first used.

    Example:
        >>> import fmu_mesh
        >>> result = fmu_mesh.load("configs/pendulum_delay.yaml").run(stop_time=1.0, record="memory")
        >>> list(result)
        ['pendulum.a', 'delay.y']
        >>> result["pendulum.a"].shape, float(result.times[-1]), result.units["pendulum.a"]
        ((501,), 1.0, 'rad')

    Attributes:
        title: name of the mesh, or of the file.
        file: the result file; None if the rows are only in memory, or if nothing was recorded.
        outcome: how the run ended; None for a file that was read.
    """

    def __init__(  # noqa: PLR0913  what a result is made of
        self,
        title: str,
        *,
        file: Path | None = None,
        outcome: Outcome | None = None,
        system: ResolvedSystem | None = None,
        columns: Columns | None = None,
        record: int = 0,
    ) -> None:
        self.title = title
        self.file = file
        self.outcome = outcome
        self._system = system
        self._step_size = system.grid.step_size if system is not None else 0.0
        self._given = columns
        self._record = record

    @classmethod
    @checked
    def read(cls, path: str | Path) -> Self:
        """Read the result file of an earlier run, such as `launch` writes: CSV, Parquet or MCAP.

        Of a Parquet file whose run goes on or was killed, the rows are read that are complete in its stream.

        Example:
            >>> run = fmu_mesh.load("configs/pendulum_delay.yaml").run(stop_time=0.1, output="results/short.csv")
            >>> fmu_mesh.Result.read("results/short.csv")["delay.y"].tolist() == run["delay.y"].tolist()
            True

        Raises:
            ConfigurationError: there is no such file, it is no result file, or the package for its format is not
                installed.
        """
        path = Path(path)
        return cls(path.stem, file=path, columns=read_result(path))

    @property
    def times(self) -> NDArray[np.float64]:
        """The simulation time of each row in s, shape `(rows,)`."""
        return self._columns.times

    @property
    def names(self) -> list[str]:
        """The recorded variables, in the order of the columns."""
        return list(self)

    @property
    def units(self) -> dict[str, str | None]:
        """The unit of each variable, as FMI writes it; None without one, or if a file that was read does not say it."""
        return {name: self._unit(name) for name in self}

    @property
    def metadata(self) -> dict[str, Any]:
        """What the result file says about its run; empty if it says nothing.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> mesh.run(stop_time=0.1, record="memory").metadata
            {}
        """
        return dict((self._columns if "_columns" in self.__dict__ else self._head).metadata)

    @property
    def all(self) -> tuple[Result, ...]:
        """The results of all files that the run wrote, in the order of the configuration; this one is among them.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> mesh.configure(record=[{"file": "fast.csv"}, {"file": "slow.csv", "every": 100}])
            >>> fast, slow = mesh.run(stop_time=1.0).all
            >>> len(fast.times), len(slow.times), slow.file.name
            (501, 6, 'slow.csv')
        """
        files = self.outcome.files if self.outcome is not None and self._given is None else ()
        if len(files) < 2:
            return (self,)
        return tuple(self if number == self._record else self._of_file(number) for number in range(len(files)))

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is wrong although nothing failed, such as a value that grows without a limit; empty for a file.

        Example:
            >>> fmu_mesh.load("configs/pendulum_delay.yaml").run(stop_time=1.0, record="memory").warnings
            ()
        """
        return self.outcome.warnings if self.outcome is not None else ()

    @property
    def defects(self) -> dict[str, Defect]:
        """By connection, how far what came was from what was assumed: it points to a connection, and is no error.

        Empty for a run without `defects=True`.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> result = mesh.run(stop_time=1.0, record="memory", defects=True)
            >>> {name: round(defect.maximum, 4) for name, defect in result.defects.items()}
            {'pendulum.a -> delay.x': 0.0074}
        """
        if self.outcome is not None and self.outcome.state == "done":
            return dict(self.outcome.defects)
        return convert(self.metadata.get("defects", {}), dict[str, Defect])

    @property
    def summary(self) -> str:
        """One line: points, wall-clock time, speed, and why the run ended early if it did."""
        if self.outcome is None:
            return f"{len(self.times)} rows of {listed(self.names)}"
        early = self.outcome.ended_by or self.outcome.error
        return summary_of(self.outcome, self._step_size) + (f"; {early.message}" if early is not None else "")

    def to_pandas(self) -> pd.DataFrame:
        """The result as a data frame: one column per variable, with the time in s as the index.

        Raises:
            ConfigurationError: pandas is not installed.
        """
        pd = imported_pandas()
        frame = pd.DataFrame(dict(self), index=pd.Index(self.times, name="time"))
        frame.attrs["units"] = self.units
        return frame

    @checked
    def to_csv(self, path: str | Path) -> None:
        """Write the result as `launch` writes it: a CSV, and `<path>.json` with the units and what is known of the run.

        Every float has the digits that give the same bits again.

        Example:
            >>> result = fmu_mesh.load("configs/pendulum_delay.yaml").run(stop_time=0.1, record="memory")
            >>> result.to_csv("results/angles.csv")
            >>> fmu_mesh.Result.read("results/angles.csv").compare(result).equal
            True

        Raises:
            CallRefused: it has no rows.
            ConfigurationError: the file cannot be written.
        """
        self._write(lambda types, columns: CsvFile(Path(path), [*types.items()], columns.metadata))

    @checked
    def to_parquet(self, path: str | Path) -> None:
        """As `to_csv`, into one Parquet file.

        Raises:
            CallRefused: it has no rows.
            ConfigurationError: the file cannot be written, or pyarrow is not installed.
        """
        self._write(lambda types, columns: ParquetFile.of_columns(Path(path), types, columns))

    @checked
    def plot(
        self,
        *names: str,
        title: str | None = None,
        x: str | None = None,
        others: Sequence[Result] = (),
        difference: bool = False,
        annotate: Mapping[tuple[float, str], str] = MappingProxyType({}),
    ) -> Figure:
        """Draw variables over time, with one axes for each unit; all of them if none is named.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> result = mesh.run(stop_time=1.0, record="memory")
            >>> result.plot("pendulum.a", "delay.y").savefig("angles.png")
            >>> longer = mesh.run(stop_time=1.0, record="memory", start_values={"pendulum.l": 3.0})
            >>> picture = result.plot("*.a", others=[longer], difference=True, annotate={(0.0, "pendulum.a"): "start"})
            >>> [axes.get_ylabel() for axes in picture.axes]
            ['a in rad', 'difference in rad']

        Args:
            names: names of variables, or patterns such as `motor.*`.
            title: the title; default: the name of the mesh, or of the file.
            x: the variable on the horizontal axis, for a phase plot; default: time.
            others: other results: a variable has one colour, and a result one kind of line.
            difference: whether axes show the differences of the others to this result.
            annotate: texts at points of this result, by time in s and variable.

        Raises:
            ConfigurationError: there is no such variable, or matplotlib is not installed.
            CallRefused: there is no other result to show the difference to; or ``x`` has texts.
        """
        if difference and not others:
            raise CallRefused("a difference needs another result", hint="Name two results.")
        if difference and x is not None:
            raise CallRefused("a difference is drawn over time only", hint="Leave the horizontal axis out.")
        results = (self, *others)
        there = [*dict.fromkeys(name for result in results for name in result)]
        chosen = [*chosen_names(self.title, there, names)]
        x = chosen_names(self.title, there, [x])[0] if x is not None else None
        annotate = {(time, chosen_names(self.title, there, [name])[0]): text for (time, name), text in annotate.items()}
        drawn: list[Curves] = []
        curves: dict[str, Curve] = {}
        for label, result in zip(_titles(results), results, strict=True):
            drawn.append(self._drawn(result, label, chosen, x, difference=difference))
            curves = self._curves_of(result, drawn[-1].values) | curves
        meshes = dict.fromkeys(str(result.metadata.get("mesh", result.title)) for result in results)
        title = title if title is not None else " and ".join(meshes)
        return figure_of(drawn, PictureOptions(title, curves, x, difference, annotate))

    @checked
    def compare(
        self, other: Result, *, rtol: float = 0.0, atol: float = 0.0, variables: Sequence[str] = ()
    ) -> Comparison:
        """Compare with another result, by default bit for bit; NaN equals NaN, and -0.0 equals 0.0.

        Two numbers are equal if `|a - b| <= atol + rtol * max(|a|, |b|)`. If the results have different times, the rows
        at times that both have are compared. If not all times of one are in the other, the other result is interpolated
        at the times of this one. Values in other units are converted, if both units are known.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> one = mesh.run(record="memory", stop_time=1.0)
            >>> print(one.compare(mesh.run(record="memory", stop_time=1.0, processes=False)))
            this result and the other one are equal: 2 variables, 501 rows
            >>> assert one.compare(one, variables=["pendulum.*"])

        Args:
            other: the other result.
            rtol: relative tolerance.
            atol: absolute tolerance, in the unit of each variable.
            variables: names, or patterns such as `motor.*`; default: all of both.

        Returns:
            The comparison, which is true if the results are equal.

        Raises:
            ConfigurationError: neither of them has such a variable.
            CallRefused: a tolerance is no number of 0 or more.
        """
        for name, tolerance in (("rtol", rtol), ("atol", atol)):
            if not tolerance >= 0.0:
                raise CallRefused(f"{name} is {tolerance!r}, and a tolerance is a number of 0 or more")
        here, there = self._side, other._side
        if here.title == there.title:
            here, there = here._replace(title="this result"), there._replace(title="the other one")
        names = chosen_names(f"{here.title}' or '{there.title}", [*dict.fromkeys([*self, *other])], variables)
        comparison = compared(here, there, names, rtol=rtol, atol=atol)
        note = machine_difference(self.metadata.get("versions", {}), other.metadata.get("versions", {}))
        return replace(comparison, note=note, drawn=lambda chosen: self.plot(*chosen, others=(other,), difference=True))

    def __getitem__(self, name: str) -> NDArray[Any]:
        """The values of one variable, one per row; elements of arrays are variables of their own, such as `a.y[1,2]`.

        In a result of one instance, its name may be left out.

        Raises:
            UnknownName: it was not recorded; suggests the nearest name. Or it means several.
        """
        columns = self._columns.values
        try:
            return columns[name]
        except (KeyError, TypeError):  # no name of a column, or no name at all
            return columns[self._meant(name)]

    @checked
    def _meant(self, name: str) -> str:
        """The only column that a name means."""
        try:
            found = chosen_names(self.title, list(self._columns.values), [name])
        except ConfigurationError as error:
            raise UnknownName(error.message, hint=error.hint) from None
        if len(found) > 1:
            raise UnknownName(f"'{name}' means {len(found)} columns of '{self.title}': {listed(found)}")
        return found[0]

    def __contains__(self, name: object) -> bool:
        names = self._variables or self._head.values
        return name in names or ((instance := of_one_instance(names)) is not None and f"{instance}.{name}" in names)

    def __iter__(self) -> Iterator[str]:
        return iter(self._variables or self._head.values)

    def __len__(self) -> int:
        return len(self._variables or self._head.values)

    def __repr__(self) -> str:
        known = self.outcome is not None or self._is_here
        return f"<Result of '{self.title}': {self.summary if known else listed([*self._variables], nothing='unread')}>"

    def _repr_html_(self) -> str:
        """The variables, with the least and the largest value of those that are in memory already."""
        columns = self._columns.values if self._is_here else dict.fromkeys(self._variables)
        rows = ((name, self._unit(name), *_ends_of(values)) for name, values in columns.items())
        return html_table(repr(self)[1:-1], ["variable", "unit", "least", "largest"], rows, len(columns))

    @property
    def _is_here(self) -> bool:
        return self._given is not None or "_columns" in self.__dict__

    @cached_property
    def _variables(self) -> dict[str, tuple[str, Variable]]:
        return recorded_variables(self._system, self._record)

    @cached_property
    def _columns(self) -> Columns:
        return joined(self._pieces()) if self._given is None else self._given

    @cached_property
    def _head(self) -> Columns:
        """The beginning of the result, with its names, units and metadata; if it is all of it, it is kept."""
        pieces = self._pieces()
        first = next(pieces)
        if next(pieces, None) is None:
            self._columns = first
        return first

    def _pieces(self) -> Iterator[Columns]:
        """The rows, piece by piece; those of a file that was not read yet are not kept."""
        if self._is_here:
            return iter([self._columns])
        if self.file is None or (self.outcome is not None and not self.outcome.rows):
            return iter([Columns(np.zeros(0), {name: np.zeros(0) for name in self._variables})])
        return result_pieces(self.file, types_of(self._system, self._record))

    def _write(self, opened: Callable[[dict[str, VariableType], Columns], ResultFile]) -> None:
        """Write a whole result file; ``opened`` gets the types of the columns, and what is known of all of them."""
        if not len(self.times):
            raise CallRefused(f"the result of '{self.title}' has no rows")
        units = {name: unit for name, unit in self.units.items() if unit is not None}
        types = types_of(self._system, self._record) or {name: _type_of(array) for name, array in self.items()}
        about = {name: {"type": type_, "unit": units.get(name)} for name, type_ in types.items()}
        metadata = self.metadata or {"mesh": self.title, "variables": about}
        noted = metadata.pop("set", ())
        file = opened(types, self._columns._replace(units=units, metadata=metadata))
        try:
            with closing(file):
                file.write(self.times, [*self.values()])
                for entry in noted:
                    file.note(entry)
        except OSError as error:
            raise unwritable(file.path, error) from error

    def _of_file(self, number: int) -> Result:
        assert self.outcome is not None  # it has files
        file, rows = self.outcome.files[number]
        outcome = replace(self.outcome, file=file, rows=rows)
        return Result(self.title, file=Path(file), outcome=outcome, system=self._system, record=number)

    def _drawn(self, other: Result, label: str, names: Sequence[str], x: str | None, *, difference: bool) -> Curves:
        here, there = self._side, other._side
        wanted = [name for name in dict.fromkeys([*names, *([x] if x is not None else [])]) if name in other]
        rows = thinned(other._pieces(), wanted, in_order=x is not None)
        values = {name: values_in_unit_of(here, there, name, rows.values[name]) for name in wanted}
        has_difference = difference and other is not self
        return Curves(label, rows.times, values, differences_of(here, there, names) if has_difference else {})

    def _curves_of(self, other: Result, names: Iterable[str]) -> dict[str, Curve]:
        return {name: other._curve(name) for name in names}

    @property
    def _side(self) -> Side:
        return Side(
            str(short_path(self.file)) if self.file is not None else self.title,
            dict.fromkeys(self),
            self._pieces,
            lambda: self._columns,
            self._unit,
            self._base_unit,
            self._point,
        )

    def _base_unit(self, name: str) -> BaseUnit | None:
        """The unit of a variable in SI base units: as its model defines it, or by its usual name."""
        if name in self._variables and (defined := self._variables[name][1].base_unit) is not None:
            return defined
        unit = self._unit(name)
        return base_unit_of(unit) if unit is not None else None

    def _point(self, row: int, time: float) -> int:
        """The communication point of a row; its number, counted from 0, where a file does not say more."""
        if self._system is None:
            said = self._head.metadata
            return int(said.get("first", 0)) + row * int(said.get("every", 1))
        grid = self._system.grid
        return round((time - grid.start_time) / grid.step_size)

    def _unit(self, name: str) -> str | None:
        return self._variables[name][1].unit if name in self._variables else self._head.units.get(name)

    def _curve(self, name: str) -> Curve:
        """How a variable is drawn: one axes for each unit, and steps for what holds between two points."""
        if name not in self._variables:
            values, said = self._head.values[name], self._head.metadata.get("variables", {}).get(name, {})
            held = values.dtype.kind != "f" or said.get("variability") in _HELD
            axis = FLAGS if values.dtype == bool else NUMBERS if said and values.dtype.kind in "iu" else ""
            return Curve(self._unit(name) or "", axis=axis, held=held)
        instance, variable = self._variables[name]
        held = not is_float(variable.type) or variable.variability in _HELD
        if variable.type == "Boolean":
            return Curve(axis=FLAGS, held=True)
        if not is_float(variable.type):
            return Curve(axis=NUMBERS, held=True)
        assert self._system is not None
        unit = variable.unit or _unit_passed_on(self._system, instance, variable)
        return Curve(unit or "", note="" if variable.unit or not unit else " (no unit)", held=held)


def imported_pandas() -> ModuleType:
    """The module pandas.

    Raises:
        LibraryMissing: it is not installed.
    """
    with importing("pandas"):
        import pandas as pd  # noqa: PLC0415  an extra, and slow to import
    module: ModuleType = pd
    return module


def _ends_of(values: NDArray[Any] | None) -> tuple[object, object]:
    if values is None or not len(values) or values.dtype.kind not in "fiub":
        return None, None
    return values.min().item(), values.max().item()


def _type_of(array: NDArray[Any]) -> VariableType:
    """The type of an array of which nothing else is known; it has an element."""
    if array.dtype == object:
        return "Binary" if isinstance(array[0], bytes) else "String"
    return next(type_ for type_, dtype in DTYPES.items() if dtype == array.dtype)


def summary_of(outcome: Outcome, step_size: float) -> str:
    """One line about speed, with the step size in s: `20000 points in 1.234 s: 16207 points/s, real-time factor 32`."""
    point, seconds = outcome.point - outcome.first, outcome.seconds
    rate = point / seconds if seconds > 0.0 else 0.0
    factor = rate * step_size
    return f"{point} points in {seconds:.3f} s: {rate:.0f} points/s, real-time factor {factor:.3g}"


def types_of(system: ResolvedSystem | None, record: int = 0) -> dict[str, VariableType] | None:
    """The types of the variables in one of the result files by name; None without a system."""
    if system is None:
        return None
    return {name: variable.type for name, (_, variable) in recorded_variables(system, record).items()}


def _titles(results: Sequence[Result]) -> list[str]:
    """Names of results that tell them apart: those of their files, or of their meshes with a number."""
    for names in (
        [result.file.name if result.file is not None else result.title for result in results],
        [str(short_path(result.file)) if result.file is not None else result.title for result in results],
    ):
        if len({*names}) == len(names):
            return names
    return [f"{result.title} ({number})" for number, result in enumerate(results, 1)]


def recorded_variables(system: ResolvedSystem | None, record: int = 0) -> dict[str, tuple[str, Variable]]:
    """Instance and variable of each column of a result file, by its name."""
    columns: dict[str, tuple[str, Variable]] = {}
    if system is None:
        return columns
    own = system.records[record].variables if record < len(system.records) else ()
    for instance, name in own:
        variable = system.instances[instance].description.variable_of(name)
        assert variable is not None  # the system is valid
        columns[f"{instance}.{name}"] = instance, variable
    return columns


def _unit_passed_on(system: ResolvedSystem, instance: str, variable: Variable) -> str | None:
    """The unit of what comes out of an output again that declares none, such as that of a transport delay.

    It depends on a single input, which declares no unit either, and on nothing else that could have one.
    """
    for _ in system.instances:  # a cycle of such outputs ends here
        match variable.dependencies:
            case (name,):
                ends = [c for c in system.connections if (c.target_instance, c.target.name) == (instance, name)]
            case _:
                return None
        if len(ends) != 1 or ends[0].target.unit or (ends[0].factor, ends[0].offset) != (1.0, 0.0):
            return None
        instance, variable = ends[0].source_instance, ends[0].source
        if variable.unit:
            return variable.unit
    return None


def result_of(plan: RunPlan, outcome: Outcome | None) -> Result:
    """The result of a run that wrote a file, or nothing; without an outcome it has not begun."""
    if outcome is None:
        return Result(plan.mesh, system=plan.plan.system)
    file = Path(outcome.file) if outcome.file is not None else None
    return Result(plan.mesh, file=file, outcome=outcome, system=plan.plan.system)
