"""Tables of values over time as a kind of instances: every column of a CSV file is an output.

In a configuration: `wave: {table: wave.csv, between: linear, start_values: {factor: 2.0}}`.
"""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, cast

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from fmu_mesh.config.base import Base
from fmu_mesh.config.instance_sections import KIND, Group, Host, InstanceSection, NotFinitePolicy, StartValues, StepSize
from fmu_mesh.config.mesh import LimitsConfig
from fmu_mesh.errors import LoadFailed
from fmu_mesh.instances.contract import Instance, Kind, Opening
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.variables.model_description import ModelDescription, Value, Variable

__all__ = ["KIND_OF_TABLES", "TableConfig"]

Columns = dict[str, NDArray[np.float64]]


class TableConfig(Base, InstanceSection, frozen=True, kw_only=True, tag_field=KIND, tag="table"):
    """A table of values over time."""

    table: Annotated[str, Meta(description="Path of a CSV file with a column `time` in s, relative to this file.")]
    between: Annotated[
        Literal["hold", "linear"],
        Meta(description="Between two rows a value is held, or changes linearly. Outside of the rows it is held."),
    ] = "hold"
    start_values: StartValues = {}
    step_size: StepSize = None
    group: Group = None
    host: Host = None
    not_finite: NotFinitePolicy = None


class TableKind(Kind[TableConfig]):
    """Tables of values over time."""

    section = TableConfig
    expected = "a CSV file whose first column is `time`"

    def describe(
        self, path: Path, section: TableConfig, limits: LimitsConfig, tell: Callable[[str], None]
    ) -> ModelDescription:
        """One output for each column, and the parameter `factor`."""
        names = [name for name in columns_of(path) if name != "time"]
        factor = Variable("factor", 0, "Float64", "parameter", "tunable", "exact", start=1.0, description="gain")
        outputs = (
            Variable(name, number, "Float64", "output", "continuous", "calculated", dependencies=())
            for number, name in enumerate(names, 1)
        )
        return ModelDescription(
            model_name=path.stem,
            model_identifier="table",
            fmi_version="",
            kind="source",
            guid=self.content(path)[:32],
            variables=(factor, *outputs),
            generation_tool="a table",
        )

    def content(self, path: Path) -> str:
        """The SHA-256 of the file."""
        return hashlib.sha256(path.read_bytes()).hexdigest()

    def open(self, opening: Opening[TableConfig]) -> Instance:
        """Read the table."""
        return TableInstance(opening.description, columns_of(opening.path), linear=opening.section.between == "linear")


KIND_OF_TABLES = TableKind()
"""What the entry point `table` names."""


class TableInstance:
    """One table; see `fmu_mesh.instances.contract.Instance` for the call sequence."""

    def __init__(self, description: ModelDescription, columns: Columns, *, linear: bool) -> None:
        self.description = description
        self._columns = columns
        self._linear = linear
        self._factor = 1.0
        self._time = 0.0

    def enter_initialization(
        self, start_time: float, stop_time: float | None, start_values: Mapping[str, Value]
    ) -> None:
        """Set the start values; the table is read at the start time."""
        self._time = start_time
        self.set_values(start_values)

    def exit_initialization(self) -> None:
        """There is nothing to do."""

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set the factor, the only variable that can be set."""
        self._factor = cast("float", values.get("factor", self._factor))

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """Values at the current time."""
        return [self._factor if name == "factor" else self._factor * self._value(name) for name in names]

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Choose the rings of `do_step`, and write the current outputs to row ``step``."""
        self._outputs, self._grid, self._points = outputs, grid, points
        self._write(step)

    def do_step(self, step: int) -> None:
        """Write the outputs at the end of own step ``step`` to the next row."""
        self._time = self._grid.time((step + 1) * self._points)
        self._write(step + 1)

    def close(self) -> None:
        """There is nothing to free."""

    def _write(self, row: int) -> None:
        for ring in self._outputs:
            for name in ring.layout.names:
                ring.put(row, name, self.get_values([name])[0])

    def _value(self, name: str) -> float:
        times, values = self._columns["time"], self._columns[name]
        if self._linear:
            return float(np.interp(self._time, times, values))
        row = max(int(np.searchsorted(times, self._time, side="right")) - 1, 0)
        return float(values[row])


def columns_of(path: Path) -> Columns:
    """The columns of a CSV file by name.

    Raises:
        LoadFailed: it cannot be read, or is no such table.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            names, *rows = csv.reader(file)
        values = np.array(rows, dtype=np.float64).reshape(-1, len(names))
    except (OSError, ValueError) as error:
        raise LoadFailed(f"the table '{path}' cannot be read: {error}") from error
    if names[:1] != ["time"] or not len(values) or np.any(np.diff(values[:, 0]) <= 0.0):
        raise LoadFailed(f"the table '{path}' has no first column 'time' whose values rise")
    return dict(zip(names, values.T, strict=True))
