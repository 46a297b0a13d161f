"""Results as a picture: axes by unit, distinguishable lines, and a legend beside them.

Owns how a picture looks. matplotlib is optional, so it is imported when something is drawn.
"""

from __future__ import annotations

import importlib.util
import math
import warnings
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigurationError
from ..files import replaced
from .result_reading import Columns

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.legend import Legend
    from matplotlib.lines import Line2D

__all__ = [
    "COLOURS",
    "DASHES",
    "FLAGS",
    "MAX_POINTS",
    "VALUE",
    "Curve",
    "add_legend",
    "draw",
    "empty_figure",
    "figure_of",
    "reduced",
    "require_matplotlib",
    "short",
]

FLAGS = "true (1) or false (0)"
"""Label of the axis of Booleans."""
VALUE = "value"
"""Label of the axis of numbers whose unit is unknown or that have none."""

MAX_POINTS = 4000
"""Points per line: more than twice the width of the picture in pixels would not be visible."""
COLOURS = 10
DASHES: tuple[Any, ...] = (
    "solid",
    (0, (5, 2)),
    (0, (1, 1.2)),
    (0, (7, 2, 1.2, 2)),
    (0, (7, 2, 1.2, 2, 1.2, 2)),
    (0, (2.5, 1.2)),
    (0, (10, 3)),
    (0, (3, 1.2, 1, 1.2)),
)
"""With ten colours each: 80 distinguishable lines."""
_OVER = (4.0, 2.0, 1.0)
"""Lengths of the dashes, with a period of 8, of lines that cover another one, so that all are visible."""
_SAME = 1 / 400
"""Two lines look like one if their distance is nowhere larger than this fraction of the height of the axes."""
_GREATEST = 1e300
"""Largest value that is drawn: matplotlib adds and subtracts the limits of its axes."""
_ROWS = 40
"""Lines of one column of a legend."""
_NAMES = 100
"""Largest number of names in a legend."""
_CHARACTERS = 60
_AXES_INCHES = (8.4, 2.8)
"""Width, and least height, of axes with their labels in inches."""
_FEW_AXES = 40
"""More axes than this are lower."""


class Curve(msgspec.Struct, frozen=True):
    """How one variable is drawn.

    Attributes:
        axis: label of its axis; variables with the same label share one.
        note: added to its name in the legend.
    """

    axis: str
    note: str = ""


def require_matplotlib() -> None:
    """Check that matplotlib is installed.

    Raises:
        ConfigurationError: it is not.
    """
    if importlib.util.find_spec("matplotlib") is None:
        raise ConfigurationError("plots need matplotlib.", hint="Install it with `pip install 'fmu-mesh[plot]'`.")


def draw(figure: Figure, output: Path) -> None:
    """Write a figure into a file; its suffix gives the format.

    Raises:
        ConfigurationError: the file cannot be written.
    """
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        picture = BytesIO()  # a failed write to a file raises errors that depend on the backend
        with warnings.catch_warnings():
            # For example a character that is not in the font: it is drawn as a box.
            warnings.simplefilter("ignore")
            figure.savefig(picture, format=output.suffix.removeprefix(".") or None)
        with replaced(output) as draft:
            draft.write_bytes(picture.getvalue())
    except (OSError, ValueError) as error:  # a ValueError names the formats there are
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigurationError(f"the plot '{output}' cannot be written: {reason}.") from error


def figure_of(results: Columns, title: str, curves: Mapping[str, Curve]) -> Figure:
    """The matplotlib figure: one axes below the other, each as high as its legend.

    Args:
        results: the columns; those of texts are left out.
        title: the title of the picture.
        curves: by name of a variable, how to draw it if more than its values is known.

    Raises:
        ConfigurationError: matplotlib is not installed.
    """
    groups: dict[str, list[str]] = {}
    for name, values in results.values.items():
        if values.dtype == object:
            continue
        curve = curves.get(name)
        axis = curve.axis if curve is not None else FLAGS if values.dtype == bool else VALUE
        groups.setdefault(axis, []).append(name)
    groups = groups or {VALUE: []}
    figure = empty_figure()
    # A character that is not in the font is drawn as a box, without a word.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _lay_out(figure, results, title, curves, groups)
    return figure


def empty_figure() -> Figure:
    """A figure without axes, as all pictures begin.

    Raises:
        ConfigurationError: matplotlib is not installed.
    """
    require_matplotlib()
    # The object interface: no window, no global state of pyplot.
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  matplotlib is an extra, and slow to import
    from matplotlib.figure import Figure  # noqa: PLC0415  matplotlib is an extra, and slow to import

    figure = Figure(dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _lay_out(
    figure: Figure, results: Columns, title: str, curves: Mapping[str, Curve], groups: Mapping[str, Sequence[str]]
) -> None:
    least = _AXES_INCHES[1] * min(1.0, _FEW_AXES / len(groups))
    heights = [max(least, 0.4 + 0.18 * _legend_rows(len(names))) for names in groups.values()]
    all_axes = figure.subplots(len(groups), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    all_axes[0].set_title(short(title), fontweight="bold", parse_math=False)
    legend_width = 0.0
    for axes, (label, names) in zip(all_axes, groups.items(), strict=True):
        _draw_axes(axes, results, names, label)
        axes.label_outer()
        if names:
            labels = [short(name) + (curves[name].note if name in curves else "") for name in names]
            legend = add_legend(axes, axes.lines, labels)
            legend_width = max(legend_width, legend.get_window_extent().width / figure.dpi)
    all_axes[-1].set_xlabel("time in s")
    figure.set_size_inches(_AXES_INCHES[0] + legend_width, 1.2 + sum(heights) + (1.0 if len(groups) == 1 else 0.0))


def _draw_axes(axes: Axes, results: Columns, names: Sequence[str], label: str) -> None:
    lone = "o" if len(results.times) == 1 else None  # a line of one point is invisible
    for number, (name, below) in enumerate(zip(names, _lines_below(results, names), strict=True)):
        times, values = reduced(results.times, results.values[name].astype(np.float64), MAX_POINTS)
        dashes = DASHES[number // COLOURS % len(DASHES)]
        if below:
            on = _OVER[min(below, len(_OVER)) - 1]
            dashes = (0, (on, 8.0 - on))
        axes.plot(
            times,
            values,
            color=f"C{number % COLOURS}",
            linestyle=dashes,
            drawstyle="default" if results.values[name].dtype.kind == "f" else "steps-post",
            linewidth=1.8 if below else 1.4,
            marker=lone,
        )
    axes.set_ylabel(short(label), parse_math=False)
    axes.grid(visible=True, alpha=0.35)
    axes.margins(x=0.01)
    if names and all(results.values[name].dtype == bool for name in names):
        axes.set_yticks([0, 1])
        axes.set_ylim(-0.1, 1.1)
    if not len(results.times):
        axes.text(0.5, 0.5, "no points were recorded", ha="center", va="center", transform=axes.transAxes)


def _lines_below(results: Columns, names: Sequence[str]) -> list[int]:
    """For each variable, how many earlier ones look like the same line.

    All 0 if the lines differ in their dashes anyway.
    """
    if not 1 < len(names) <= COLOURS or len(results.times) < 2:
        return [0] * len(names)
    stride = 1 + len(results.times) // MAX_POINTS
    table = np.array([results.values[name][::stride].astype(np.float64) for name in names]).clip(-_GREATEST, _GREATEST)
    near = _SAME * float(np.nan_to_num(table).max() - np.nan_to_num(table).min())
    return [
        sum(np.allclose(table[before], row, rtol=0.0, atol=near, equal_nan=True) for before in range(number))
        for number, row in enumerate(table)
    ]


def _legend_columns(count: int) -> int:
    """Number of columns of a legend with this number of names."""
    return math.ceil(min(count, _NAMES + 1) / _ROWS) or 1


def _legend_rows(count: int) -> int:
    return math.ceil(min(count, _NAMES + 1) / _legend_columns(count))


def add_legend(axes: Axes, lines: Sequence[Line2D], labels: Sequence[str], title: str | None = None) -> Legend:
    """Add a legend beside the axes, where it covers no line; of very many lines it names the first ones."""
    from matplotlib.lines import Line2D  # noqa: PLC0415  matplotlib is an extra, and slow to import

    lines, shown = list(lines)[: len(labels)], list(labels)
    if len(shown) > _NAMES:
        lines, shown = (
            [*lines[:_NAMES], Line2D([], [], linestyle="none")],
            [*shown[:_NAMES], f"and {len(shown) - _NAMES} more"],
        )
    legend = axes.legend(
        lines,
        # matplotlib omits a name that begins with an underscore; an invisible word joiner before it prevents that.
        [f"\N{WORD JOINER}{text}" if text.startswith("_") else text for text in shown],
        loc="upper left",
        bbox_to_anchor=(1.005, 1.0),
        borderaxespad=0.0,
        frameon=False,
        ncols=_legend_columns(len(labels)),
        fontsize=9 if len(shown) > 2 * COLOURS else 10,
        labelspacing=0.35,
        handlelength=2.6,
        title=title,
        alignment="left",
    )
    for text in (*legend.get_texts(), legend.get_title()):
        text.set_parse_math(False)  # a dollar sign in a name does not start a formula
    return legend


def short(text: str) -> str:
    """A name as a picture shows it: a long one without its middle: both ends of a structured name matter."""
    half = _CHARACTERS // 2
    return text if len(text) <= _CHARACTERS else f"{text[: half - 1]}…{text[-half:]}"


def reduced(
    times: NDArray[np.float64], values: NDArray[np.float64], most: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """About ``most`` points that look like all of them: the minimum and maximum of every section."""
    values = np.clip(np.where(np.isinf(values), np.nan, values), -_GREATEST, _GREATEST)
    if len(times) <= most:
        return times, values
    size = -(-len(times) // (most // 2))
    sections = np.pad(values, (0, -len(values) % size), constant_values=np.nan).reshape(-1, size)
    first = np.arange(len(sections)) * size
    # Of a section without any value the first row is taken, which keeps the gap visible.
    lowest = first + np.where(np.isnan(sections), np.inf, sections).argmin(axis=1)
    highest = first + np.where(np.isnan(sections), -np.inf, sections).argmax(axis=1)
    picked = np.unique(np.concatenate(([0, len(times) - 1], lowest, highest)))
    return times[picked], values[picked]
