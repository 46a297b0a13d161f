"""How the error of a mesh falls with its step size, and what that costs, as one picture.

Owns its axes and colours. Does not know where errors come from.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .drawing import COLOURS, DASHES, FAINT, PALETTE, add_legend, empty_figure, short, silently, style_axes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["convergence_figure"]

_INCHES = (10.4, 4.6)


def convergence_figure(
    title: str, step_sizes: Sequence[float], steps: Sequence[float], curves: Mapping[str, Sequence[float]]
) -> Figure:
    """Relative errors over the step size and over the number of steps, with the slopes of the orders 1 and 2.

    A curve has one value for each run, the coarsest first; or one fewer: then it has differences between two runs,
    which are dotted.
    """
    figure = empty_figure()
    figure.set_size_inches(*_INCHES)
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
