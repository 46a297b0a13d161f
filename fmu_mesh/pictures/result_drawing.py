"""Results as a picture: axes by unit, lines that can be told apart in colour and in grey, a legend beside them.

Owns how curves of results look. What belongs together is said by whoever calls.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..errors import CallRefused
from .drawing import (
    COLOURS,
    DASHES,
    MAX_POINTS,
    PALETTE,
    add_legend,
    empty_figure,
    legend_rows,
    limited,
    reduced,
    short,
    silently,
    style_axes,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

__all__ = ["FLAGS", "NUMBERS", "Curve", "Curves", "PictureOptions", "figure_of", "in_unit"]

FLAGS = "true (1) or false (0)"
"""The axes of Booleans, and their label."""
NUMBERS = "number"
"""The axes of whole numbers."""

_OVER = (4.0, 2.0, 1.0)
"""Lengths of the dashes, with a period of 8, of lines that cover another one, so that all are visible."""
_SAME = 1 / 400
"""Two lines look like one if their distance is nowhere larger than this fraction of the height of the axes."""
_AXES_INCHES = (8.4, 2.8)
"""Width, and least height, of axes with their labels in inches."""
_FEW_AXES = 40
"""More axes than this are lower."""
_NOTE_POINTS = 9.0
"""Size of the font of an annotation."""
_FRAME = 4.0
"""How far the frame of an annotation, and what is free around it, is from its text in points."""
_BESIDE = tuple((across * x, up * y) for x, y in ((16.0, 9.0), (8.0, 20.0)) for across in (1, -1) for up in (1, -1))
"""Where an annotation may stand, in points from its place; or several times as far."""
_PHASE_POINTS = 20_000
"""Points of a line over another variable, of which no section can be left out."""
_LABEL_NAMES, _LABEL_CHARACTERS = 2, 28
_SUPERSCRIPTS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
_UNIT_NAMES = {"degC": "°C", "degF": "°F", "deg": "°", "Ohm": "Ω"}
_DIMENSIONLESS = ("", "1", "-")
"""Units that mean no unit."""


class Curve(msgspec.Struct, frozen=True):
    """How one variable is drawn."""

    unit: str = ""  # its unit; variables of one unit share axes
    axis: str = ""  # `FLAGS` or `NUMBERS` for values without a unit that have axes of their own
    note: str = ""  # added to its name in the legend
    held: bool = False  # whether its values hold until the next one, so that it is drawn in steps

    @property
    def key(self) -> str:
        """What variables on the same axes have in common."""
        return self.axis or ("" if self.unit in _DIMENSIONLESS else self.unit)


class Curves(NamedTuple):
    """What is drawn of one result."""

    title: str  # its name in the legend
    times: NDArray[np.float64]  # the times in s, shape `(rows,)`
    values: Mapping[str, NDArray[Any]]  # an array of this shape for each variable, by name; those of texts are left out
    # by name, the times of the first result and its values minus those of this one
    differences: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}


class PictureOptions(NamedTuple):
    """What a picture shows beside its curves."""

    title: str
    curves: Mapping[str, Curve] = {}  # by name of a variable, how to draw it, if more than its values is known
    x: str | None = None  # the variable that is the horizontal axis; None: time
    difference: bool = False  # whether there are axes with the differences of the results below those of the curves
    # by time in s and variable, a text at this place of the first result
    annotations: Mapping[tuple[float, str], str] = {}


class _Panel(NamedTuple):
    """One axes: its variables, and whether it shows their differences."""

    names: list[str]
    label: str
    is_difference: bool = False


def in_unit(name: str, unit: str) -> str:
    """The label of an axis: `a in rad`, `T in °C`; a number has no unit.

    Example:
        >>> in_unit("v", "m/s2"), in_unit("T", "degC"), in_unit("k", "1")
        ('v in m/s²', 'T in °C', 'k')
    """
    if unit in _DIMENSIONLESS:
        return name
    parts: list[str] = []
    for number, side in enumerate(unit.split("/")):
        factors = [_factor(text) for text in side.replace("*", ".").split(".")]
        parts.append(("/" if number else "") + "·".join(factors))
    return f"{name} in {''.join(parts)}"


def _factor(text: str) -> str:
    """One factor of a unit, with its exponent above the line."""
    name = text.rstrip("0123456789").rstrip("-").rstrip("^")
    exponent = text[len(name) :].lstrip("^")
    return f"{_UNIT_NAMES.get(name, name)}{exponent.translate(_SUPERSCRIPTS)}" if name else text


def figure_of(results: Sequence[Curves], picture: PictureOptions) -> Figure:
    """The matplotlib figure: one axes below the other, each as high as its legend.

    A variable has one colour, and of several results each one kind of line.
    """
    figure = empty_figure()
    with silently():
        _Drawer(figure, results, picture).draw()
    return figure


class _Drawer:
    def __init__(self, figure: Figure, results: Sequence[Curves], picture: PictureOptions) -> None:
        self._figure, self._results, self._picture = figure, results, picture
        self._names = [
            name
            for name in dict.fromkeys(name for result in results for name in result.values)
            if name != picture.x and all(r.values[name].dtype != object for r in results if name in r.values)
        ]
        x = picture.x
        if x is not None and any(r.values[x].dtype == object for r in results if x in r.values):
            raise CallRefused(f"'{x}' has texts, which are no horizontal axis", variable=x)

    def draw(self) -> None:
        panels = self._panels()
        least = _AXES_INCHES[1] * min(1.0, _FEW_AXES / len(panels))
        several = len(self._results) if len(self._results) > 1 else 0
        heights = [max(least, 0.4 + 0.18 * legend_rows(len(panel.names) + several)) for panel in panels]
        heights = [0.7 * h if panel.is_difference else h for h, panel in zip(heights, panels, strict=True)]
        heights[0] += (1.0 if len(panels) == 1 else 0.0) + (1.6 if self._picture.x is not None else 0.0)
        all_axes = self._figure.subplots(len(panels), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
        all_axes[0].set_title(short(self._picture.title), fontweight="bold", parse_math=False)
        legend_width = 0.0
        for axes, panel, own_height in zip(all_axes, panels, heights, strict=True):
            lines = self._draw_panel(axes, panel, own_height)
            axes.label_outer()
            if lines:
                legend = add_legend(axes, *self._legend(panel, lines))
                legend_width = max(legend_width, legend.get_window_extent().width / self._figure.dpi)
        x = self._picture.x
        all_axes[-1].set_xlabel(
            short(in_unit(x, self._curve(x).unit)) if x is not None else "time in s", parse_math=False
        )
        width = _AXES_INCHES[0] if x is None else 0.75 * _AXES_INCHES[0]
        self._figure.set_size_inches(width + legend_width, 1.2 + sum(heights))

    # --- panels

    def _panels(self) -> list[_Panel]:
        groups: dict[str, list[str]] = {}
        for name in self._names:
            groups.setdefault(self._curve(name).key, []).append(name)
        panels = []
        for key, names in (groups or {"": []}).items():
            panels.append(_Panel(names, self._label(key, names)))
            if self._picture.difference and key != FLAGS:
                panels.append(_Panel(names, in_unit("difference", "" if key == NUMBERS else key), is_difference=True))
        return panels

    def _label(self, key: str, names: Sequence[str]) -> str:
        """What the vertical axis is: the variables, if one or two names say it, and their unit."""
        if key == FLAGS:
            return FLAGS
        of_instances = [name.partition(".")[2] or name for name in names]
        last = [name if "(" in name else name.rpartition(".")[2] for name in of_instances]
        for found in (dict.fromkeys(of_instances), dict.fromkeys(last)):
            if 0 < len(found) <= _LABEL_NAMES and len(text := ", ".join(found)) <= _LABEL_CHARACTERS:
                return in_unit(text, "" if key == NUMBERS else key)
        return in_unit("value", "" if key == NUMBERS else key)

    def _curve(self, name: str) -> Curve:
        """How a variable is drawn; without more knowledge, as its type says."""
        if name in self._picture.curves:
            return self._picture.curves[name]
        values = next((r.values[name] for r in self._results if name in r.values), np.zeros(0))
        return Curve(axis=FLAGS if values.dtype == bool else "", held=values.dtype.kind != "f")

    # --- lines

    def _draw_panel(self, axes: Axes, panel: _Panel, height: float) -> list[Line2D]:
        """Draw the lines of one axes, ``height`` inches high; returns one for each variable."""
        first: dict[str, Line2D] = {}
        below = self._lines_below(panel) if len(self._results) == 1 else []
        for order, result in enumerate(self._results):
            for number, name in enumerate(panel.names):
                data = self._data(result, name, is_difference=panel.is_difference)
                if data is None:
                    continue
                dashes: Any = DASHES[(number + number // COLOURS) % len(DASHES)]
                if len(self._results) > 1:
                    dashes = DASHES[order % len(DASHES)]
                if below and below[number]:
                    on = _OVER[min(below[number], len(_OVER)) - 1]
                    dashes = (0, (on, 8.0 - on))
                (line,) = axes.plot(
                    *data,
                    color=PALETTE[number % COLOURS],
                    linestyle=dashes,
                    drawstyle="steps-post" if self._curve(name).held and self._picture.x is None else "default",
                    linewidth=1.8 if below and below[number] else 1.4,
                    marker="o" if len(data[0]) == 1 else None,  # a line of one point is invisible
                )
                first.setdefault(name, line)
        is_empty = not any(len(result.times) for result in self._results)
        style_axes(axes, panel.label, is_empty=is_empty)
        if panel.label == FLAGS:
            axes.set_yticks([0, 1])
            axes.set_ylim(-0.1, 1.1)
        if not is_empty and not panel.is_difference:
            self._annotate(axes, panel, height)
        return [first[name] for name in panel.names if name in first]

    def _data(
        self, result: Curves, name: str, *, is_difference: bool
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """The corners of a line; None if there is nothing to draw."""
        if is_difference:
            return reduced(*result.differences[name], MAX_POINTS) if name in result.differences else None
        x = self._picture.x
        if name not in result.values or (x is not None and x not in result.values):
            return None
        values = result.values[name].astype(np.float64)
        if x is None:
            return reduced(result.times, values, MAX_POINTS)
        stride = 1 + len(values) // _PHASE_POINTS
        return limited(result.values[x][::stride].astype(np.float64)), limited(values[::stride])

    def _legend(self, panel: _Panel, lines: Sequence[Line2D]) -> tuple[list[Line2D], list[str]]:
        from matplotlib.lines import Line2D as Line  # noqa: PLC0415  matplotlib is an extra, and slow to import

        texts = [short(name) + self._curve(name).note for name in panel.names]
        if len(self._results) == 1:
            return [*lines], texts
        colours = [Line([], [], color=line.get_color(), linewidth=2.4) for line in lines]
        if panel.is_difference:
            first, *others = self._results
            results = [(order, f"{short(first.title)} - {short(one.title)}") for order, one in enumerate(others, 1)]
        else:
            results = [(order, short(result.title)) for order, result in enumerate(self._results)]
        kinds = [Line([], [], color="0.2", linestyle=DASHES[order % len(DASHES)]) for order, _ in results]
        return [*colours, *kinds], [*texts, *(text for _, text in results)]

    def _lines_below(self, panel: _Panel) -> list[int]:
        """For each variable, how many earlier ones look like the same line; nothing if there are many."""
        (result,), names = self._results, panel.names
        if not 1 < len(names) <= COLOURS or len(result.times) < 2 or self._picture.x is not None:
            return []
        stride = 1 + len(result.times) // MAX_POINTS
        table = limited(np.array([result.values[name][::stride].astype(np.float64) for name in names]))
        near = _SAME * float(np.nan_to_num(table).max() - np.nan_to_num(table).min())
        return [
            sum(np.allclose(table[before], row, rtol=0.0, atol=near, equal_nan=True) for before in range(number))
            for number, row in enumerate(table)
        ]

    def _annotate(self, axes: Axes, panel: _Panel, height: float) -> None:
        """Write texts at places of the first result, where they cover few lines."""
        result, x = self._results[0], self._picture.x
        room = _Room(axes, (_AXES_INCHES[0] if x is None else 0.75 * _AXES_INCHES[0]) - 0.8, height - 0.3)
        for (time, name), text in self._picture.annotations.items():
            if name not in panel.names or name not in result.values or not len(result.times):
                continue
            row = int(np.abs(result.times - time).argmin())
            place = (
                float(result.times[row] if x is None else result.values[x][row]),
                float(result.values[name].astype(np.float64)[row]),
            )
            offset = room.offset(place, text)
            axes.plot(*place, marker="o", markersize=4.5, color="black", linestyle="none", zorder=4)
            axes.annotate(
                text,
                place,
                xytext=offset,
                textcoords="offset points",
                ha="left" if offset[0] > 0.0 else "right",
                va="bottom" if offset[1] > 0.0 else "top",
                fontsize=_NOTE_POINTS,
                parse_math=False,
                bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "0.6", "linewidth": 0.6},
                arrowprops={"arrowstyle": "-", "color": "0.3", "linewidth": 0.8},
                zorder=5,
            )


class _Room:
    """Where a text beside a point covers few lines; lengths are in points, from the lower left corner of the axes."""

    def __init__(self, axes: Axes, width: float, height: float) -> None:
        self._limits = axes.get_xlim(), axes.get_ylim()
        self._size = 72.0 * width, 72.0 * height
        self._taken: list[tuple[float, float, float, float]] = []
        self._lines = [
            self._placed(np.asarray(line.get_xdata(), np.float64), np.asarray(line.get_ydata(), np.float64))
            for line in axes.lines
        ]
        axes.set(xlim=self._limits[0], ylim=self._limits[1])

    def _placed(self, x: Any, y: Any) -> Any:  # noqa: ANN401  numbers or arrays
        (left, right), (low, high) = self._limits
        return np.stack([(x - left) / (right - left) * self._size[0], (y - low) / (high - low) * self._size[1]])

    def offset(self, place: tuple[float, float], text: str) -> tuple[float, float]:
        """From the point to the nearest corner of its text, in points."""
        x, y = self._placed(*place)
        width, height = 0.62 * _NOTE_POINTS * len(text) + 6.0, 1.6 * _NOTE_POINTS
        rectangles = {}
        for distance in (1.0, 2.0, 3.5, 5.0):
            for across, up in _BESIDE:
                dx, dy = distance * across, distance * up
                left, low = x + dx - (width if dx < 0.0 else 0.0), y + dy - (height if dy < 0.0 else 0.0)
                rectangles[dx, dy] = left, low, left + width, low + height
        best = min(rectangles, key=lambda offset: self._cost(rectangles[offset]))
        self._taken.append(rectangles[best])
        return best

    def _cost(self, rectangle: tuple[float, float, float, float]) -> int:
        """How much a text covers there; the first and so nearest place of several with the same cost is taken."""
        left, low = rectangle[0] - _FRAME, rectangle[1] - _FRAME
        right, high = rectangle[2] + _FRAME, rectangle[3] + _FRAME
        is_outside = left < 0.0 or low < 0.0 or right > self._size[0] or high > self._size[1]
        cost = 10_000 * is_outside
        cost += 1_000 * sum(
            left < other[2] and other[0] < right and low < other[3] and other[1] < high for other in self._taken
        )
        for xs, ys in self._lines:
            across = (np.minimum(xs[1:], xs[:-1]) < right) & (np.maximum(xs[1:], xs[:-1]) > left)
            up = (np.minimum(ys[1:], ys[:-1]) < high) & (np.maximum(ys[1:], ys[:-1]) > low)
            cost += int((across & up).any())
        return cost
