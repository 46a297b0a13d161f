"""Sweeps as pictures: the curves of all variants, a value over two parameters, and errors over the step size.

Owns which colours and scales a sweep has. Does not know where curves and values come from.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..errors import CallRefused
from ..printing import printable
from ..text import shown
from ..variables.value_types import PlainValue
from .drawing import (
    COLOURS,
    DASHES,
    FAINT,
    MAX_POINTS,
    PALETTE,
    add_legend,
    empty_figure,
    reduced,
    short,
    silently,
    style_axes,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.colors import Colormap, Normalize
    from matplotlib.figure import Figure

__all__ = ["VariantCurve", "convergence_figure", "curves_figure", "heat_map_figure"]

_POINTS = 1_000_000
"""Points of all curves together; more take seconds to draw and are not visible."""
_LEAST_POINTS = 200
_FEW = 8
"""Up to so many different numbers have a legend and not a colour bar, and ticks of their own."""
_INCHES = (8.4, 4.8)
_WIDE_INCHES = (10.4, 4.6)
_DARK = 0.92
"""The part of the colour map that lines can have: its brightest end is hardly visible on white."""
_DECADE = 10.0
"""A parameter has a logarithmic scale only if its largest value is at least so many times its smallest one."""
_DECADES = 100.0
"""The same for a result, whose values nobody has chosen."""
_LARGEST = 1e100
"""Larger numbers, infinite ones and NaN have no place on an axis: matplotlib adds and multiplies its limits."""

_Path = tuple[NDArray[np.float64], NDArray[np.float64]]
"""The times and the values of the corners of a curve."""


class VariantCurve(msgspec.Struct, frozen=True):
    """One variable of one variant over time."""

    times: NDArray[np.float64]  # the simulation times in s, shape `(rows,)`
    # one for each time. Values that are no floats hold until the next one. A variant that failed has no rows
    values: NDArray[Any]
    colour: PlainValue  # the value of the parameter that colours the curve


def curves_figure(title: str, y_label: str, colour_label: str, curves: Iterable[VariantCurve]) -> Figure:
    """All curves in one axes, coloured by a parameter; only the points that are drawn are kept in memory.

    Many numbers have a colour bar, which is logarithmic if they are spread over decades. Few numbers, texts and truth
    values have a legend. A note says how many variants have no rows.

    Example:
        >>> import numpy as np
        >>> times = np.linspace(0.0, 1.0, 50)
        >>> curves = (VariantCurve(times, np.exp(-d * times), d) for d in (0.5, 1.0, 2.0))
        >>> figure = curves_figure("decay", "y", "d in 1/s", curves)
        >>> [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
        ['0.5', '1', '2']
    """
    figure = empty_figure()
    figure.set_size_inches(*_INCHES)
    paths, colours, missing = _paths(y_label, curves)
    with silently():
        axes = figure.subplots()
        _draw_curves(axes, paths, colours, colour_label)
        axes.set_xlabel("time in s")
        style_axes(axes, y_label, is_empty=not paths)
        note = f"without rows, not shown: {missing} of {missing + len(paths)}" if missing else ""
        _add_title(figure, axes, title, note)
    return figure


def heat_map_figure(
    title: str,
    x: tuple[str, Sequence[PlainValue]],
    y: tuple[str, Sequence[PlainValue]],
    z: tuple[str, Sequence[float | None]],
) -> Figure:
    """A value over two parameters, each with its label: as cells for a grid, as points for what a sampler has chosen.

    An axis is logarithmic if its values are spread by ratio. Cells without a value are hatched; points without one are
    grey crosses.

    Example:
        >>> figure = heat_map_figure(
        ...     "k", ("a.k", [1, 1, 2, 2]), ("b.on", [True, False] * 2), ("y", [1.0, 2.0, 3.0, None])
        ... )
        >>> [text.get_text() for text in figure.axes[0].get_yticklabels()]
        ['false', 'true']
    """
    values = np.array([_finite(value, z[0]) for value in z[1]])
    figure = empty_figure()
    figure.set_size_inches(*_INCHES)
    with silently():
        horizontal, vertical = _Scale.of(*x), _Scale.of(*y)
        places = [*zip(horizontal.places(x[1]), vertical.places(y[1]), strict=True)]
        cells = dict(zip(places, values.tolist(), strict=True))
        is_grid = 2 * len(cells) > len(horizontal.marks) * len(vertical.marks)
        if is_grid and len(cells) < len(places):
            hint = f"Choose variants that differ only in '{x[0]}' and '{y[0]}'."
            raise CallRefused(f"several variants have the same '{x[0]}' and '{y[0]}'", hint=hint)
        axes, there = figure.subplots(), values[~np.isnan(values)]
        norm = _norm(there, logarithmic=_is_logarithmic(there, _DECADES))
        if is_grid:
            note = _draw_cells(axes, horizontal, vertical, cells, norm)
        else:
            note = _draw_points(axes, places, values, norm)
        horizontal.label(axes.xaxis)
        vertical.label(axes.yaxis)
        if len(there):
            _add_colour_bar(axes, norm, _colour_map(1.0), z[0])
        _add_title(figure, axes, title, note)
    return figure


def convergence_figure(
    title: str, step_sizes: Sequence[float], steps: Sequence[float], curves: Mapping[str, Sequence[float]]
) -> Figure:
    """Relative errors over the step size and over the number of steps, with the slopes of the orders 1 and 2.

    A curve has one value for each run, the coarsest first; or one fewer: then it has differences between two runs,
    which are dotted.
    """
    figure = empty_figure()
    figure.set_size_inches(*_WIDE_INCHES)
    names = {f"{name} (difference)" if len(own) < len(steps) else name: own for name, own in curves.items()}
    above = 2.0 * max((one for own in curves.values() for one in own), default=0.5)
    with silently():
        panels = figure.subplots(1, 2, sharey=True)
        for axes, places, side in ((panels[0], step_sizes, "left"), (panels[1], steps, "right")):
            axes.set(xscale="log", yscale="log")
            axes.set_xlabel("step size in s" if side == "left" else "steps of all instances")
            lines: list[Any] = []
            for number, errors in enumerate(curves.values()):
                values = [one or np.nan for one in errors]  # no difference has no place on the axis
                dashes = DASHES[number // COLOURS % len(DASHES)] if len(values) == len(places) else "dotted"
                style = {"color": PALETTE[number % COLOURS], "linestyle": dashes, "marker": "o", "markersize": 4}
                lines += axes.plot(places[: len(values)], values, **style)
            for order in (1, 2):
                last = above * (step_sizes[-1] / step_sizes[0]) ** order
                axes.plot([places[0], places[-1]], [above, last], color=FAINT, linewidth=1.0, linestyle=DASHES[1])
                axes.annotate(f"order {order}", (places[-1], last), color=FAINT, fontsize=9, va="top", ha=side)
            axes.set_xticks(places, [f"{place:.4g}" for place in places])
            axes.set_xticks([], minor=True)
            style_axes(axes, "error / largest value" if side == "left" else "", is_empty=False)
            if side == "right" and curves:
                add_legend(axes, lines, [short(name) for name in names])
        figure.suptitle(short(title), fontweight="bold", fontsize=12, parse_math=False)
    return figure


# --- curves


def _paths(name: str, curves: Iterable[VariantCurve]) -> tuple[list[_Path], list[PlainValue], int]:
    """The corners of each curve, its value of the parameter, and how many curves have no rows."""
    kept: list[_Path] = []
    colours: list[PlainValue] = []
    missing, most, steps = 0, MAX_POINTS, False
    for curve in curves:
        if not len(curve.times):
            missing += 1
            continue
        if curve.values.dtype == object:
            raise CallRefused(f"'{name}' has texts, which have no curve")
        steps = steps or curve.values.dtype.kind != "f"
        kept.append(reduced(curve.times, np.asarray(curve.values, np.float64), most))
        colours.append(curve.colour)
        if len(kept) * most > _POINTS and most > _LEAST_POINTS:
            # Fewer points of all curves; the extremes of extremes are those of the curve.
            most = max(most // 2, _LEAST_POINTS)
            kept = [reduced(times, values, most) for times, values in kept]
    if steps:
        kept = [(np.repeat(times, 2)[1:], np.repeat(values, 2)[:-1]) for times, values in kept]
    return kept, colours, missing


def _draw_curves(axes: Axes, paths: Sequence[_Path], colours: Sequence[PlainValue], colour_label: str) -> None:
    """Draw the curves in the colours of a bar, or in few colours that a legend explains."""
    from matplotlib.lines import Line2D  # noqa: PLC0415  matplotlib is an extra, and slow to import

    if not paths:
        return
    scale = _Scale.of(colour_label, colours)
    places, count = scale.places(colours), len(paths)
    if not scale.texts and len(scale.marks) > _FEW:
        norm, colour_map = _norm(np.array(places), logarithmic=scale.logarithmic), _colour_map(_DARK)
        _add_lines(axes, paths, [*colour_map(norm(places))], "solid", count)
        _add_colour_bar(axes, norm, colour_map, colour_label)
        return
    groups: dict[float, list[_Path]] = {mark: [] for mark in scale.marks}
    for path, place in zip(paths, places, strict=True):
        groups[place].append(path)
    shades = _colour_map(_DARK)(np.linspace(0.0, 1.0, len(groups)))
    lines = []
    for order, members in enumerate(groups.values()):
        # Numbers have an order, and so have their colours; categories have dashes as well.
        colour, dashes = shades[order], DASHES[0]
        if scale.texts:
            colour = PALETTE[order % COLOURS]
            dashes = DASHES[(order if count <= COLOURS else order // COLOURS) % len(DASHES)]
        _add_lines(axes, members, [colour] * len(members), dashes, count)
        lines.append(Line2D([], [], color=colour, linestyle=dashes, linewidth=1.8))
    labels = scale.texts or [f"{mark:.6g}" for mark in scale.marks]
    add_legend(axes, lines, [short(label) for label in labels], title=short(colour_label))


def _add_lines(axes: Axes, paths: Sequence[_Path], colours: Sequence[Any], dashes: object, among: int) -> None:
    """Add curves as one collection, which is drawn much faster than single lines."""
    from matplotlib.collections import LineCollection  # noqa: PLC0415  matplotlib is an extra, and slow to import

    # Many curves are thin and transparent: it is visible where they are dense.
    width = float(np.interp(np.log10(among), [1.0, 2.0, 3.5], [1.5, 0.9, 0.6]))
    alpha = float(np.interp(np.log10(among), [1.5, 3.5], [1.0, 0.4]))
    corners = [np.column_stack(path) for path in paths]
    axes.add_collection(LineCollection(corners, colors=colours, linestyles=[dashes], linewidths=width, alpha=alpha))
    for (times, values), colour in zip(paths, colours, strict=True):
        if len(times) == 1:  # a line of one point is invisible
            axes.plot(times, values, marker="o", color=colour, markersize=4)
    axes.autoscale_view()


# --- heat maps


def _draw_cells(
    axes: Axes, horizontal: _Scale, vertical: _Scale, values: Mapping[tuple[float, float], float], norm: Normalize
) -> str:
    """Draw a grid; returns the note about cells without a value."""
    table = np.array([[values.get((x, y), np.nan) for x in horizontal.marks] for y in vertical.marks])
    missing = int(np.isnan(table).sum())
    axes.patch.set(facecolor="0.95", edgecolor="0.6", hatch="////", linewidth=0.0)  # seen through cells without a value
    mesh = np.ma.masked_invalid(table)
    axes.pcolormesh(horizontal.edges(), vertical.edges(), mesh, norm=norm, cmap=_colour_map(1.0), rasterized=True)
    return f"hatched, without a value: {missing} of {table.size}" if missing else ""


def _draw_points(
    axes: Axes, places: Sequence[tuple[float, float]], values: NDArray[np.float64], norm: Normalize
) -> str:
    """Draw samples; returns the note about those without a value."""
    x, y = np.array(places, np.float64).reshape(-1, 2).T
    missing = np.isnan(values)
    size = float(np.clip(6000.0 / max(len(values), 1), 6.0, 60.0))
    edge = {"edgecolors": "0.25", "linewidths": 0.4} if size > 20.0 else {"linewidths": 0.0}
    axes.scatter(x[~missing], y[~missing], s=size, c=values[~missing], norm=norm, cmap=_colour_map(1.0), **edge)
    axes.scatter(x[missing], y[missing], s=max(size, 20.0), c="0.3", marker="x", linewidths=1.0)
    axes.grid(visible=True, alpha=0.35)
    axes.set_axisbelow(True)
    return f"crosses, without a value: {int(missing.sum())} of {len(values)}" if missing.any() else ""


# --- scales and colours


class _Scale(NamedTuple):
    """Where the values of a parameter lie: numbers where they are, all other values side by side."""

    title: str  # name and unit of the parameter
    marks: list[float]  # the different places, in increasing order
    texts: list[str]  # the value at each place; empty for numbers
    logarithmic: bool  # whether the numbers are spread by ratio

    @classmethod
    def of(cls, title: str, values: Sequence[PlainValue]) -> _Scale:
        if all(map(_is_number, values)):
            marks = sorted({float(value) for value in values if isinstance(value, int | float)})
            return cls(title, marks, [], _is_logarithmic(np.array(marks), _DECADE))
        texts = [*dict.fromkeys(_text(value) for value in values)]
        texts = sorted(texts) if all(isinstance(value, bool) for value in values) else texts
        return cls(title, [float(place) for place in range(len(texts))], texts, logarithmic=False)

    def places(self, values: Sequence[PlainValue]) -> list[float]:
        if not self.texts:
            return [float(value) for value in values if isinstance(value, int | float)]
        places = dict(zip(self.texts, self.marks, strict=True))
        return [places[_text(value)] for value in values]

    def edges(self) -> NDArray[np.float64]:
        """The borders of cells around the places, one more than there are places."""
        marks = np.array(self.marks)
        if self.logarithmic:
            marks = np.log(marks)
        if len(marks) == 1:
            half = 0.5 * abs(marks[0]) or 0.5
            return np.array([marks[0] - half, marks[0] + half])
        middles = (marks[1:] + marks[:-1]) / 2.0
        edges = np.concatenate(([2.0 * marks[0] - middles[0]], middles, [2.0 * marks[-1] - middles[-1]]))
        return np.exp(edges) if self.logarithmic else edges

    def label(self, axis: Axis) -> None:
        axis.set_label_text(short(self.title), parse_math=False)
        if self.texts:
            axis.set_ticks(self.marks, [short(text) for text in self.texts])
            for tick in axis.get_ticklabels():
                tick.set_parse_math(False)
            return
        if self.logarithmic:
            _set_logarithmic(axis)
        marks = np.log(self.marks) if self.logarithmic else np.array(self.marks)
        least = (marks[-1] - marks[0]) / (2.0 * _FEW)  # so that there is room for the number at each place
        if len(marks) <= _FEW and (np.diff(marks) >= least).all():
            axis.set_ticks(self.marks, [f"{mark:.4g}" for mark in self.marks])
            axis.set_ticks([], minor=True)


def _set_logarithmic(axis: Axis) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter  # noqa: PLC0415  as above

    axes = axis.axes
    (axes.set_xscale if axis is axes.xaxis else axes.set_yscale)("log")
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _LARGEST


def _finite(value: object, label: str) -> float:
    """A value as a number that can be drawn; NaN if there is none, or if it is too large."""
    if value is not None and not isinstance(value, int | float):
        raise CallRefused(f"'{label}' is {shown(value)} in a variant, and a heat map needs numbers")
    return float(value) if value is not None and abs(value) <= _LARGEST else math.nan


def _text(value: PlainValue) -> str:
    return ("false", "true")[value] if isinstance(value, bool) else printable(str(value))


def _is_logarithmic(numbers: NDArray[np.float64], ratio: float) -> bool:
    """Whether numbers lie more evenly on a logarithmic scale, and the largest is ``ratio`` times the smallest one."""
    numbers = np.unique(numbers)
    if len(numbers) < 3 or numbers[0] < 1.0 / _LARGEST or numbers[-1] < ratio * numbers[0]:
        return False
    return _unevenness(np.log(numbers)) < _unevenness(numbers)


def _unevenness(numbers: NDArray[np.float64]) -> float:
    """The largest distance of sorted numbers from equidistant ones, as a part of their range."""
    shares = (numbers - numbers[0]) / (numbers[-1] - numbers[0])
    return float(np.abs(shares - np.linspace(0.0, 1.0, len(numbers))).max())


def _norm(numbers: NDArray[np.float64], *, logarithmic: bool) -> Normalize:
    from matplotlib.colors import LogNorm, Normalize  # noqa: PLC0415  as above

    if not len(numbers):
        return Normalize(0.0, 1.0)
    return (LogNorm if logarithmic else Normalize)(float(numbers.min()), float(numbers.max()))


def _colour_map(end: float) -> Colormap:
    """Viridis up to ``end``: perceptually uniform, also for the colour-blind and in shades of grey."""
    from matplotlib import colormaps  # noqa: PLC0415  as above
    from matplotlib.colors import ListedColormap  # noqa: PLC0415  as above

    return ListedColormap(colormaps["viridis"](np.linspace(0.0, end, 256)))


def _add_colour_bar(axes: Axes, norm: Normalize, colour_map: Colormap, label: str) -> None:
    from matplotlib.cm import ScalarMappable  # noqa: PLC0415  as above
    from matplotlib.colors import LogNorm  # noqa: PLC0415  as above

    bar = axes.figure.colorbar(ScalarMappable(norm, colour_map), ax=axes, pad=0.02)
    bar.set_label(short(label), parse_math=False)
    if isinstance(norm, LogNorm):
        _set_logarithmic(bar.ax.yaxis)


def _add_title(figure: Figure, axes: Axes, title: str, note: str) -> None:
    figure.suptitle(short(title), fontweight="bold", fontsize=12, parse_math=False)
    if note:
        axes.set_title(note, loc="right", fontsize=9, color="0.35")
