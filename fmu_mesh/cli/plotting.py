"""`plot`: reads a result file and the units of its variables, and draws them with `drawing`."""

from __future__ import annotations

import argparse
import csv
import importlib.util
import re
from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

import numpy as np

from ..errors import ConfigurationError, FmuMeshError
from ..recorder.csv_file import CsvFile
from ..system.plan import Plan
from ..system.recording import result_format
from ..system.system import System
from ..text import listed, nearest, nearest_file
from ..variables.model_description import Variable
from ..variables.value_types import is_float
from .arguments import CommandParser, Parsers, add_quiet
from .output.drawing import FLAGS, VALUE, Curve, Results, draw

__all__ = ["PARSERS", "check_plot", "plot_results", "plotted_where_it_ends", "read_results"]

_TIME = "time"
_WORDS = {"true": 1.0, "false": 0.0, "": float("nan"), '""': float("nan")}
_QUOTED = re.compile(r'"(?:[^"]|"")*"')
_DIMENSIONLESS = ("1", "-")
"""Units that mean no unit."""


def _add_plot(parser: CommandParser) -> None:
    parser.add_argument("results", type=Path, metavar="RESULTS.csv", help="the result file")
    parser.add_argument(
        "--output", type=Path, metavar="FILE.png", help="file of the picture; default: beside the result file"
    )
    parser.add_argument(
        "--variables", nargs="+", metavar="INSTANCE.VARIABLE", help="plot only these; default: all of the file"
    )
    add_quiet(parser)
    parser.set_defaults(run_command=_plot)


def _plot(arguments: argparse.Namespace) -> int:
    _require_matplotlib()
    output = arguments.output if arguments.output is not None else arguments.results.with_suffix(".png")
    results = read_results(arguments.results, arguments.variables)
    draw(results, output, title=arguments.results.stem, curves={})
    print(f"plot: {output}")
    return 0


def check_plot(plot: Path, result: str | None) -> None:
    """Check before a run that its result can be plotted at its end.

    Args:
        plot: the file of the picture.
        result: the result file, or None if nothing is recorded.

    Raises:
        ConfigurationError: matplotlib is not installed, it has no such format, or the result cannot be drawn.
    """
    _require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  matplotlib is an extra, and slow to import

    formats = FigureCanvasAgg.get_supported_filetypes()
    if plot.suffix.removeprefix(".").lower() not in formats:
        raise ConfigurationError(f"a plot cannot be written as '{plot}'.", hint="Name it .png, .svg or .pdf.")
    if result is None:
        raise ConfigurationError("nothing is recorded, so there is nothing to plot.", hint="Name a file with --output.")
    _require_csv(Path(result))


def _require_csv(path: Path) -> None:
    if result_format(path) not in (CsvFile, None):
        raise ConfigurationError(f"'{path}' is no CSV, and plots are drawn from CSV.", hint="Record into a .csv file.")


def _require_matplotlib() -> None:
    if importlib.util.find_spec("matplotlib") is None:
        raise ConfigurationError("plots need matplotlib.", hint="Install it with `pip install 'fmu-mesh[plot]'`.")


def plot_results(result: Path, plot: Path, plan: Plan) -> None:
    """Draw the result file of a run, with one axes for each unit of its plan.

    Raises:
        ConfigurationError: the result cannot be read, or the plot cannot be written.
    """
    curves = {}
    for instance, name in plan.system.recorded:
        variable = plan.system.instances[instance].description.variable_of(name)
        if variable is not None:
            curves[f"{instance}.{name}"] = _curve(plan.system, instance, variable)
    draw(read_results(result), plot, title=plan.system.config.mesh, curves=curves)
    print(f"plot: {plot}")


@contextmanager
def plotted_where_it_ends(plan: Plan, plot: Path | None) -> Iterator[None]:
    """Inside, a run: if it ends early, what it recorded up to then is drawn, and never what an earlier run has left."""
    result = plan.system.result_file
    before = _state_of(result)
    try:
        yield
    except FmuMeshError:
        if plot is not None and result is not None and _state_of(result) != before:
            plot_results(Path(result), plot, plan)
        raise


def _state_of(result: str | None) -> tuple[int, int, int] | None:
    """What changes of a file when something is written into it."""
    if result is None or not Path(result).is_file():
        return None
    status = Path(result).stat()
    return status.st_ino, status.st_size, status.st_mtime_ns


def _curve(system: System, instance: str, variable: Variable) -> Curve:
    """On which axes a variable is drawn: one for each unit."""
    if variable.type == "Boolean":
        return Curve(FLAGS)
    if not is_float(variable.type):
        return Curve("number")
    unit = variable.unit or _unit_passed_on(system, instance, variable)
    if unit is None or unit in _DIMENSIONLESS:
        return Curve(VALUE)
    return Curve(f"value in {unit}", note="" if variable.unit else " (no unit)")


def _unit_passed_on(system: System, instance: str, variable: Variable) -> str | None:
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


def read_results(path: Path, wanted: Sequence[str] | None = None) -> Results:
    """Read a result file, whose last row may be cut off, as a run leaves it that was killed.

    Args:
        path: the result file.
        wanted: the variables to keep; default: all.

    Raises:
        ConfigurationError: there is no such file or variable, or it is no result file; says in which line.
    """
    _require_csv(path)
    try:
        with path.open(encoding="utf-8", newline="") as file:
            names, first, values = _read(path, file)
    except OSError as error:
        near = nearest_file(path) if isinstance(error, FileNotFoundError) else None
        hint = f"Did you mean '{near}'?" if near is not None else None
        raise ConfigurationError(f"the result file '{path}' cannot be read: {error.strerror}.", hint=hint) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigurationError(f"'{path}' is no result file: {error}.") from error
    chosen = _chosen(path, names[1:], wanted)
    table = np.frombuffer(values, np.float64).reshape(-1, len(names))
    quoted = {name for name, text in zip(names, first, strict=False) if text == '""'}
    columns = {name: table[:, names.index(name, 1)] for name in chosen if name not in quoted}
    texts = {name: text for name, text in zip(names, first, strict=False) if name in columns}
    flags = frozenset(name for name, text in texts.items() if text in ("true", "false"))
    whole = frozenset(name for name, text in texts.items() if text.removeprefix("-").isdecimal())
    return Results(table[:, 0], columns, flags, whole)


def _read(path: Path, file: TextIO) -> tuple[list[str], list[str], array[float]]:
    """The heading, the first row as text, and the values row by row."""
    heading = file.readline()
    names = next(csv.reader([heading]), [])
    if not names or names[0] != _TIME:
        found = f"its first column is '{names[0][:40]}'" if names else "it is empty"
        raise ConfigurationError(f"'{path}' is no result file: {found}, not '{_TIME}'.")
    values: array[float] = array("d")
    first: list[str] = []
    for number, line in enumerate(file, 2):
        text = line
        while text.count('"') % 2 and (more := next(file, "")):  # text with line ends in it
            text += more
        if not text.endswith("\n") or text.count('"') % 2:  # the last row, cut off perhaps within a number
            break
        row = _QUOTED.sub('""', text.rstrip("\r\n")).split(",")
        if len(row) != len(names):
            found = f"{len(row)} values where the heading has {len(names)}"
            raise ConfigurationError(f"'{path}' is no result file: line {number}: {found}.")
        first = first or row
        try:
            values.extend([_WORDS[text] if text in _WORDS else float(text) for text in row])
        except ValueError as error:
            raise ConfigurationError(f"'{path}' is no result file: line {number}: {error}.") from error
    return names, first, values


def _chosen(path: Path, names: list[str], wanted: Sequence[str] | None) -> Sequence[str]:
    unknown = [name for name in wanted or () if name not in names]
    if unknown:
        meant = [name for text in unknown for name in _meant(text, names)]
        hint = f"Did you mean {_either(meant)}?" if meant else f"There are: {listed(names)}."
        raise ConfigurationError(f"'{path}' has no variable {_either(unknown)}.", hint=hint)
    return wanted or names


def _meant(text: str, names: Sequence[str]) -> list[str]:
    """The columns that somebody may have meant: those of variables with this name, or else the nearest name."""
    alike = [name for name in names if name.partition(".")[2] == text]
    near = nearest(text, names) or nearest(text, {name.partition(".")[2]: name for name in names})
    if alike or near is None:
        return alike
    return [near] if near in names else [name for name in names if name.partition(".")[2] == near]


def _either(names: Sequence[str]) -> str:
    return " or ".join(filter(None, [listed([repr(name) for name in names[:-1]], nothing=""), repr(names[-1])]))


PARSERS: Parsers = {"plot": _add_plot}
