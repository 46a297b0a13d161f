"""`SweepResult`: the rows of a sweep, their curves, and pictures of both."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, overload

import msgspec
import numpy as np

from ..api.result import Result, imported_pandas
from ..errors import CallRefused, UnknownName
from ..pictures.result_drawing import in_unit
from ..pictures.sweep_drawing import VariantCurve, curves_figure, heat_map_figure
from ..pictures.tables import html_table
from ..results.column_names import chosen_names
from ..system.system import ResolvedSystem
from ..text import did_you_mean, listed
from .sweep_folder import SweepFolder, Wanted, cells_of
from .variant_run import Cell, Row, curves_of
from .variants import Parameters

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

__all__ = ["SweepResult", "SweepRow"]


class SweepRow(msgspec.Struct, frozen=True):
    """One run of a sweep.

    Attributes:
        variant: its number, from 0 on.
        parameters: its parameters by name.
        exit_code: 0, or that of `fmu-mesh launch` for the same error.
        message: why it failed, or what its result warns of.
        values: what was calculated from its curves, by the name of the column; None where there was nothing.
        seconds: wall-clock time of the run in s.
        worker: host and process id of its worker.
        file: its curves; None if they were not kept.
    """

    variant: int
    parameters: Parameters
    exit_code: int
    message: str
    values: dict[str, Cell]
    seconds: float
    worker: str
    file: Path | None


class SweepResult(Sequence[SweepRow]):
    """What a sweep has found: a sequence of rows in the order of the variants; those that did not run are left out.

    Example:
        >>> import fmu_mesh
        >>> vary = {"pendulum.d": [0.1, 0.2]}
        >>> options = {"reduce": ["max(pendulum.a)"], "stop_time": 1.0, "folder": "results/two"}
        >>> with fmu_mesh.sweep("configs/pendulum_delay.yaml", vary, **options) as running:
        ...     result = running.wait()
        >>> [row.parameters["pendulum.d"] for row in result], [len(row.values) for row in result]
        ([0.1, 0.2], [1, 1])
        >>> result.curves(1)["pendulum.a"].shape
        (501,)

    Attributes:
        folder: the folder of the sweep.
        names: names of the parameters.
        columns: names of what was calculated from the curves.
    """

    def __init__(
        self,
        wanted: Wanted,
        folder: SweepFolder,
        rows: Sequence[Row | None],
        columns: Sequence[str],
        system: ResolvedSystem | None = None,
    ) -> None:
        self.folder = folder.path
        self.names = wanted.names
        self.columns = tuple(columns)
        self._wanted = wanted
        self._folder = folder
        self._system = system
        self._found = [(number, row) for number, row in enumerate(rows) if row is not None]

    @classmethod
    def read(cls, folder: str | Path) -> Self:
        """Read the folder of a sweep, which may still go on.

        Example:
            >>> options = {"stop_time": 1.0, "folder": "results/to_read"}
            >>> with fmu_mesh.sweep("configs/pendulum_delay.yaml", {"pendulum.d": [0.1, 0.2]}, **options) as running:
            ...     result = running.wait()
            >>> list(fmu_mesh.SweepResult.read("results/to_read")) == list(result)
            True

        Raises:
            ConfigurationError: there is no sweep in it, or another version has written it.
        """
        own = SweepFolder(Path(folder).absolute())
        wanted, rows = own.wanted(), own.rows()
        found = [rows.get(identity) for identity in wanted.identities]
        columns = dict.fromkeys([*wanted.reductions, *(name for row in found if row for name in row.values)])
        return cls(wanted, own, found, tuple(columns))

    @overload
    def __getitem__(self, index: int) -> SweepRow: ...
    @overload
    def __getitem__(self, index: slice) -> list[SweepRow]: ...
    def __getitem__(self, index: int | slice) -> SweepRow | list[SweepRow]:
        if isinstance(index, slice):
            return [self._row(*found) for found in self._found[index]]
        return self._row(*self._found[index])

    def __iter__(self) -> Iterator[SweepRow]:
        return (self._row(*found) for found in self._found)

    def __len__(self) -> int:
        return len(self._found)

    def __repr__(self) -> str:
        return f"<SweepResult of '{self._wanted.mesh}': {self.summary}>"

    def _repr_html_(self) -> str:
        cells = (cells_of(self._wanted, number, row, self.columns) for number, row in self._found)
        shown = ["variant", *self.columns, *self.names, "exit_code", "message"]
        rows = ([own[name] for name in shown] for own in cells)
        return html_table(f"{self._wanted.mesh}: {self.summary}", shown, rows, len(self))

    @property
    def table(self) -> Path:
        """The CSV file of the table."""
        return self._folder.table

    @property
    def variables(self) -> tuple[str, ...]:
        """The recorded variables, of which `curves` has the values and `plot` draws one."""
        return self._wanted.recorded

    @property
    def failed(self) -> list[SweepRow]:
        """The rows of the runs that have failed."""
        return [self._row(*found) for found in self._found if found[1].exit_code]

    @property
    def summary(self) -> str:
        """One line: how many runs there are, and how many have failed."""
        total, failed = len(self._wanted.variants), sum(1 for _, row in self._found if row.exit_code)
        return f"{len(self)} of {total} runs, {failed} failed"

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why the rows may differ from those of one machine: the last digits of results depend on it."""
        machines = sorted({row.machine for _, row in self._found} - {""})
        if len(machines) < 2:
            return ()
        return (f"the runs were on machines whose results may differ in the last digits: {'; '.join(machines)}",)

    def to_pandas(self) -> pd.DataFrame:
        """The table as a data frame, with the columns of the CSV.

        Raises:
            ConfigurationError: pandas is not installed.
        """
        rows = [cells_of(self._wanted, number, row, self.columns) for number, row in self._found]
        frame = imported_pandas().DataFrame(rows)
        frame.attrs["units"] = {name: self._wanted.units.get(name) for name in self.names}
        return frame

    def curves_to_pandas(self, *names: str) -> pd.DataFrame:
        """The curves of all runs as one data frame, with `variant` and `time` as its index; not of those that failed.

        Example:
            >>> options = {"stop_time": 1.0, "folder": "results/frame"}
            >>> with fmu_mesh.sweep("configs/pendulum_delay.yaml", {"pendulum.d": [0.1, 0.2]}, **options) as running:
            ...     frame = running.wait().curves_to_pandas("pendulum.a")
            >>> frame.loc[1].shape, frame.attrs["units"]
            ((501, 1), {'pendulum.a': 'rad'})

        Args:
            names: names of variables, or patterns such as `motor.*`; default: all.

        Raises:
            CallRefused: no curves were kept.
            ConfigurationError: there is no such variable, or pandas is not installed.
        """
        pd = imported_pandas()
        chosen = [*chosen_names(self.folder.name, self.variables, names)]
        frames = {
            number: self.curves(place).to_pandas()[chosen]
            for place, (number, row) in enumerate(self._found)
            if not row.exit_code and self._curves_of(row) is not None
        }
        if not frames:
            raise CallRefused("no run of the sweep has curves", hint="See `curves` of `sweep`.")
        frame = pd.concat(frames, names=["variant"])
        frame.attrs["units"] = {name: self._wanted.units.get(name) for name in chosen}
        return frame

    def values(self, name: str) -> list[Any]:
        """A parameter or a column of all rows, in their order.

        Raises:
            UnknownName: there is no such parameter or column; suggests the nearest one.
        """
        if name in self.names:
            place = self.names.index(name)
            return [self._wanted.variants[number][place] for number, _ in self._found]
        if name in self.columns:
            return [row.values.get(name) for _, row in self._found]
        there = [*self.names, *self.columns]
        hint = did_you_mean(name, there, f"There are {listed(there)}.")
        raise UnknownName(f"the sweep has no parameter or column '{name}'", hint=hint)

    def curves(self, index: int) -> Result:
        """What a run has recorded.

        Args:
            index: place of its row.

        Raises:
            CallRefused: the curves were not kept, or it recorded nothing.
        """
        number, row = self._found[index]
        file = self._curves_of(row)
        if file is None:
            why = "the curves were not kept" if not self._wanted.curves else "it has recorded nothing"
            raise CallRefused(f"there are no curves of variant {number}: {why}", hint="See `curves` of `sweep`.")
        if self._system is None:
            return Result.read(file)
        return Result(f"{self._wanted.mesh}, variant {number}", file=file, system=self._system)

    def plot(self, name: str, *, colour: str | None = None, title: str | None = None) -> Figure:
        """Draw one variable of all runs over time, each curve in the colour of a parameter.

        Args:
            name: the variable, as `instance.variable`.
            colour: the parameter or column that gives the colours; by default the first parameter.
            title: title of the picture; by default the name of the mesh.

        Raises:
            UnknownName: there is no such parameter or column.
            ConfigurationError: there is no such variable, or matplotlib is not installed.
        """
        chosen_names(self.folder.name, self.variables, [name])
        by = colour if colour is not None else self.names[0]
        curves = (self._curve(place, name, value) for place, value in enumerate(self.values(by)))
        return curves_figure(title or self._wanted.mesh, self._axis(name), self._axis(by), curves)

    def heat_map(self, column: str, *, x: str | None = None, y: str | None = None, title: str | None = None) -> Figure:
        """Draw a column over two parameters: cells for a grid, points for samples.

        Args:
            column: what is calculated from the curves.
            x: parameter of the horizontal axis; by default the first one.
            y: parameter of the vertical axis; by default the second one.
            title: title of the picture; by default the name of the mesh.

        Raises:
            CallRefused: there is one parameter only.
            UnknownName: there is no such parameter or column.
            ConfigurationError: matplotlib is not installed.
        """
        if len(self.names) < 2 and (x is None or y is None):
            text = "a heat map needs two parameters, and this sweep has one"
            raise CallRefused(text, hint="`plot` draws its curves.")
        axes = [(self._axis(name), self.values(name)) for name in (x or self.names[0], y or self.names[1])]
        values = [None if value is None or isinstance(value, str) else float(value) for value in self.values(column)]
        return heat_map_figure(title or self._wanted.mesh, axes[0], axes[1], (column, values))

    def _curve(self, place: int, name: str, colour: Any) -> VariantCurve:  # noqa: ANN401  any value
        """One variable of a run; no rows if it has failed."""
        row = self._found[place][1]
        if colour is None or row.exit_code or self._curves_of(row) is None:
            return VariantCurve(np.zeros(0), np.zeros(0), 0)
        result = self.curves(place)
        return VariantCurve(result.times, result[name], colour)

    def _axis(self, name: str) -> str:
        return in_unit(name, self._wanted.units.get(name) or "")

    def _row(self, number: int, row: Row) -> SweepRow:
        return SweepRow(
            variant=number,
            parameters=self._wanted.parameters(number),
            file=self._curves_of(row),
            **{name: getattr(row, name) for name in ("exit_code", "message", "values", "seconds", "worker")},
        )

    def _curves_of(self, row: Row) -> Path | None:
        file = curves_of(self._folder.curves, row.id)
        return file if self._wanted.curves and file.is_file() else None
