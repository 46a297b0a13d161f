"""`plot`: a result file as a picture. matplotlib is imported when something is drawn; it is an extra."""

from __future__ import annotations

import argparse
import csv
import importlib.util
import re
from array import array
from collections.abc import Mapping, Sequence
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigurationError
from ..files import replaced
from ..model.description import Variable
from ..model.findings import listed, nearest, nearest_file
from ..model.plan import Plan
from ..model.types import is_float
from .arguments import add_command

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Results", "add_commands", "check_plot", "draw", "plot_results", "read_results", "reduced"]

_TIME = "time"
_WORDS = {"true": 1.0, "false": 0.0, "": float("nan"), '""': float("nan")}
_QUOTED = re.compile(r'"(?:[^"]|"")*"')
_MAX_POINTS = 4000
"""Points drawn per line: more than twice the pixels of the picture's width would show nothing new."""


class Results(msgspec.Struct, frozen=True):
    """The columns of a result file.

    Attributes:
        times: the times in s.
        columns: the values by variable; true is 1 and false is 0.
        flags: the variables that hold nothing but true and false.
        whole: the variables that are Integer or Enumeration: a Real is never written without a point or an exponent.
    """

    times: NDArray[np.float64]
    columns: dict[str, NDArray[np.float64]]
    flags: frozenset[str]
    whole: frozenset[str]


def add_commands(commands: argparse._SubParsersAction[Any], common: argparse.ArgumentParser) -> None:
    """Add the command of this module."""
    plot = add_command(commands, "plot", "draw a result file", [common])
    plot.add_argument("results", type=Path, metavar="RESULTS.csv", help="the result file")
    plot.add_argument("--output", type=Path, metavar="FILE.png", help="default: beside the result file")
    plot.add_argument(
        "--variables", nargs="+", metavar="INSTANCE.VARIABLE", help="draw only these; default: all of the file"
    )
    plot.set_defaults(run_command=_plot)


def _plot(arguments: argparse.Namespace) -> int:
    _require_matplotlib()
    output = arguments.output if arguments.output is not None else arguments.results.with_suffix(".png")
    results = read_results(arguments.results, arguments.variables)
    draw(results, output, title=arguments.results.stem, variables={})
    print(f"plot: {output}")
    return 0


def check_plot(plot: Path, result: str | None) -> None:
    """Make sure that a plot can be drawn, before a run whose end is to be one.

    Args:
        plot: the picture.
        result: the result file to draw, or None where nothing is recorded.

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
    if Path(result).suffix == ".mcap":
        raise _is_mcap(Path(result))


def _is_mcap(path: Path) -> ConfigurationError:
    return ConfigurationError(f"'{path}' is an MCAP, and plots are drawn from CSV.", hint="Record into a .csv file.")


def _require_matplotlib() -> None:
    if importlib.util.find_spec("matplotlib") is None:
        raise ConfigurationError("plots need matplotlib.", hint="Install it with `pip install 'fmu-mesh[plot]'`.")


def plot_results(result: Path, plot: Path, plan: Plan | None) -> None:
    """Draw the result file of a run; with its plan, the units are known, and each has axes of its own.

    Raises:
        ConfigurationError: the result cannot be read, or the plot cannot be written.
    """
    results = read_results(result)
    if plan is None:
        draw(results, plot, title=result.stem, variables={})
        return
    variables = {}
    for instance, name in plan.system.recorded:
        variable = plan.system.instances[instance].description.variable_of(name)
        if variable is not None:
            variables[f"{instance}.{name}"] = variable
    draw(results, plot, title=plan.system.config.mesh, variables=variables)


def read_results(path: Path, wanted: Sequence[str] | None = None) -> Results:
    """Read a result file, whose last row may be cut off, as a run leaves it that was killed.

    Args:
        path: the result file.
        wanted: the variables to keep; default: all.

    Raises:
        ConfigurationError: there is no such file or variable, or it is no result file; says in which line.
    """
    if path.suffix == ".mcap":
        raise _is_mcap(path)
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
        suggestion = nearest(unknown[0], names)
        hint = f"Did you mean '{suggestion}'?" if suggestion is not None else f"There are: {listed(names)}."
        raise ConfigurationError(f"'{path}' has no variable {listed([repr(name) for name in unknown])}.", hint=hint)
    return wanted or names


def draw(results: Results, output: Path, *, title: str, variables: Mapping[str, Variable]) -> None:
    """Draw results into a file whose suffix says its format.

    Args:
        results: what to draw.
        output: the file; its folder is made.
        title: the line above all axes.
        variables: what is known of the variables, by name.

    Raises:
        ConfigurationError: the file cannot be written.
    """
    # The object interface: no window, no global state of pyplot. It is an extra, so it is imported late.
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  matplotlib is an extra, and slow to import
    from matplotlib.figure import Figure  # noqa: PLC0415  matplotlib is an extra, and slow to import

    groups: dict[str, list[str]] = {}
    for name in results.columns:
        groups.setdefault(_axis_of(name, results, variables), []).append(name)
    groups = groups or {"": []}
    figure = Figure(
        figsize=(10.0, 1.2 + 2.8 * len(groups) + (1.0 if len(groups) == 1 else 0.0)), dpi=120, layout="constrained"
    )
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontweight="bold")
    all_axes = figure.subplots(len(groups), 1, sharex=True, squeeze=False)[:, 0]
    for number, (axes, (label, names)) in enumerate(zip(all_axes, groups.items(), strict=True)):
        _draw_axes(axes, results, names, label)
        axes.label_outer()
        if number == len(groups) - 1:
            axes.set_xlabel("time in s")
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        picture = BytesIO()  # a backend that cannot write fails in ways of its own
        figure.savefig(picture, format=output.suffix.removeprefix(".") or None)
        with replaced(output) as draft:
            draft.write_bytes(picture.getvalue())
    except (OSError, ValueError) as error:  # a ValueError names the formats there are
        raise ConfigurationError(f"the plot '{output}' cannot be written: {error}.") from error


def _axis_of(name: str, results: Results, variables: Mapping[str, Variable]) -> str:
    """What stands at the axis on which a variable is drawn; one for each unit."""
    variable = variables.get(name)
    if name in results.flags or (variable is not None and variable.type == "Boolean"):
        return "true (1) or false (0)"
    if variable is None:
        return "value"
    if not is_float(variable.type):
        return "number"
    return f"value in {variable.unit}" if variable.unit else "value, no unit"


def _draw_axes(axes: Axes, results: Results, names: Sequence[str], label: str) -> None:
    colours = {name: f"C{number}" for number, name in enumerate(results.columns)}
    for name in names:
        steps = name in results.flags or name in results.whole
        times, values = reduced(results.times, results.columns[name], _MAX_POINTS)
        lone = "o" if len(times) == 1 else None  # a line of one point would show nothing
        axes.plot(
            times,
            values,
            label=name,
            color=colours[name],
            drawstyle="steps-post" if steps else "default",
            linewidth=1.4,
            marker=lone,
        )
    axes.set_ylabel(label)
    axes.grid(visible=True, alpha=0.35)
    axes.margins(x=0.01)
    if names and all(name in results.flags for name in names):
        axes.set_yticks([0, 1])
        axes.set_ylim(-0.1, 1.1)
    if not len(results.times):
        axes.text(0.5, 0.5, "no points were recorded", ha="center", va="center", transform=axes.transAxes)
    if names:
        # Beside the axes, where it hides no line.
        axes.legend(loc="upper left", bbox_to_anchor=(1.005, 1.0), borderaxespad=0.0, frameon=False)


def reduced(
    times: NDArray[np.float64], values: NDArray[np.float64], most: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """About ``most`` points that look like all of them: the least and the greatest of every stretch."""
    values = np.where(np.isinf(values), np.nan, values)
    if len(times) <= most:
        return times, values
    edges = np.linspace(0, len(times), most // 2 + 1).astype(int)
    kept = {0, len(times) - 1}
    for first, end in pairwise(edges):
        stretch = values[first:end]
        if np.isnan(stretch).all():
            kept.add(int(first))  # so that the gap shows
        else:
            kept.update((int(first + np.nanargmin(stretch)), int(first + np.nanargmax(stretch))))
    picked = np.array(sorted(kept))
    return times[picked], values[picked]
