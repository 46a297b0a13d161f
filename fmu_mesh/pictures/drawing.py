"""What all pictures have in common: the style of the house (colours, dashes, sizes), the figure, legends, files.

matplotlib is optional, so it is imported when something is drawn.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigurationError
from ..files import replaced
from ..installing import require
from ..printing import printable
from ..results.recording import Columns, joined

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.legend import Legend
    from matplotlib.lines import Line2D

__all__ = [
    "COLOURS",
    "CYCLE_COLOURS",
    "DASHES",
    "FAINT",
    "FONT",
    "GROUP",
    "GROUP_BORDER",
    "INK",
    "MAX_POINTS",
    "PALETTE",
    "STATE_COLOURS",
    "WIRE",
    "add_legend",
    "draw",
    "empty_figure",
    "legend_rows",
    "limited",
    "reduced",
    "short",
    "silently",
    "style_axes",
    "thinned",
]

MAX_POINTS = 4000
"""Points per line: more than twice the width of the picture in pixels would not be visible."""
PALETTE = (
    "#0057a0",
    "#e8890c",
    "#7a1f6b",
    "#29a3a3",
    "#222222",
    "#d1495b",
    "#56b4e9",
    "#6b4a1f",
    "#9a9a9a",
    "#3d6b35",
)
"""Colours that are told apart by the colour-blind; neighbours differ in their brightness as well."""
COLOURS = len(PALETTE)
CYCLE_COLOURS = ("#d55e00", "#0072b2", "#aa3377", "#007a5a")
"""Told apart also by the colour-blind; wires of a cycle are thick as well, for shades of grey."""
STATE_COLOURS = {"running": "#007a5a", "done": "#0072b2", "failed": "#d55e00"}
INK, FAINT, WIRE = "#1a1a1a", "#5f6368", "#4a4f55"
GROUP, GROUP_BORDER = "#eef1f5", "#9aa0a6"
FONT = "Helvetica, Arial, 'DejaVu Sans', sans-serif"
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
_GREATEST = 1e300
"""Largest value that is drawn: matplotlib adds and subtracts the limits of its axes."""
_KEPT = 1 << 20
"""Numbers of a long result that are kept for its picture: many more than are visible."""
_ROWS = 40
"""Lines of one column of a legend."""
_NAMES = 100
"""Largest number of names in a legend."""
_CHARACTERS = 60


def draw(figure: Figure, output: Path) -> None:
    """Write a figure into a file; its suffix gives the format.

    Raises:
        ConfigurationError: the file cannot be written.
    """
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        picture = BytesIO()  # a failed write to a file raises errors that depend on the backend
        with silently():
            figure.savefig(picture, format=output.suffix.removeprefix(".") or None)
        with replaced(output) as draft:
            draft.write_bytes(picture.getvalue())
    except (OSError, ValueError) as error:  # a ValueError names the formats there are
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigurationError(f"the plot '{output}' cannot be written: {reason}.") from error


@contextmanager
def silently() -> Iterator[None]:
    """In the block, a character that is not in the font is drawn as a box, without a word."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def style_axes(axes: Axes, label: str, *, is_empty: bool) -> None:
    """Give axes for curves the look of the house, and the label of their values; say so if there is nothing in them."""
    axes.set_ylabel(short(label), parse_math=False)
    axes.grid(visible=True, alpha=0.35)
    axes.margins(x=0.01)
    if is_empty:
        axes.text(0.5, 0.5, "no points were recorded", ha="center", va="center", transform=axes.transAxes)


def empty_figure() -> Figure:
    """A figure without axes, as all pictures begin.

    Raises:
        ConfigurationError: matplotlib is not installed.
    """
    require("matplotlib")
    # The object interface: no window, no global state of pyplot.
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  matplotlib is an extra, and slow to import

    from .shown_figure import ShownFigure  # noqa: PLC0415  as above

    figure = ShownFigure(dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _legend_columns(count: int) -> int:
    return math.ceil(min(count, _NAMES + 1) / _ROWS) or 1


def legend_rows(count: int) -> int:
    """Number of rows of a legend with this number of names."""
    return math.ceil(min(count, _NAMES + 1) / _legend_columns(count))


def add_legend(axes: Axes, lines: Sequence[Line2D], labels: Sequence[str], title: str | None = None) -> Legend:
    """Add a legend beside the axes, where it covers no line; of very many lines it names the first ones."""
    from matplotlib.lines import Line2D  # noqa: PLC0415  matplotlib is an extra, and slow to import

    lines, shown = list(lines)[: len(labels)], list(labels)
    if len(shown) > _NAMES:
        lines = [*lines[:_NAMES], Line2D([], [], linestyle="none")]
        shown = [*shown[:_NAMES], f"and {len(shown) - _NAMES} more"]
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
    text, half = printable(text), _CHARACTERS // 2
    return text if len(text) <= _CHARACTERS else f"{text[: half - 1]}…{text[-half:]}"


def reduced(
    times: NDArray[np.float64], values: NDArray[np.float64], most: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """About ``most`` points that look like all of them: the minimum and maximum of every section."""
    values = limited(values)
    if len(times) <= most:
        return times, values
    size = -(-len(times) // (most // 2))
    sections = np.pad(values, (0, -len(values) % size), constant_values=np.nan).reshape(-1, size)
    extremes = _extremes(sections) + (np.arange(len(sections)) * size)[:, None]
    picked = np.unique(np.concatenate(([0, len(times) - 1], extremes.ravel())))
    return times[picked], values[picked]


def thinned(pieces: Iterable[Columns], names: Sequence[str], *, in_order: bool = False) -> Columns:
    """These variables of a result; of a long one, about as many rows as memory is there for.

    Of a section of rows two remain, with the minimum and the maximum of each variable in their order; or two rows as
    they are, if the values of a row belong together (``in_order``).
    """
    most = max(_KEPT // (1 + len(names)), 2 * MAX_POINTS)
    kept, waiting, size = [Columns(np.zeros(0), {name: np.zeros(0, bool) for name in names})], [], 1
    for piece in pieces:
        waiting.append(Columns(piece.times, {name: piece.values[name] for name in names}))
        if sum(len(own.times) for own in waiting) < min(64 * size, most):
            continue
        kept += waiting if size == 1 else [_halved(joined(waiting), 2 * size, in_order=in_order)]
        waiting = []
        if sum(len(own.times) for own in kept) > most:
            kept, size = [_halved(joined(kept), 4, in_order=in_order)], 2 * size
    return joined([*kept, *waiting])


def _halved(columns: Columns, rows: int, *, in_order: bool) -> Columns:
    """Two rows of each section with this number of rows; what is left at the end stays."""
    end = len(columns.times) // rows * rows

    def picked(values: NDArray[Any], *, is_plain: bool) -> NDArray[Any]:
        sections = values[:end].reshape(-1, rows)
        places = np.broadcast_to([0, rows // 2], (len(sections), 2))
        if not is_plain and values.dtype != object:
            places = np.sort(_extremes(limited(sections.astype(np.float64))), axis=1)
        return np.concatenate([np.take_along_axis(sections, places, axis=1).ravel(), values[end:]])

    times = picked(columns.times, is_plain=True)
    return Columns(times, {name: picked(values, is_plain=in_order) for name, values in columns.values.items()})


def _extremes(sections: NDArray[np.float64]) -> NDArray[np.intp]:
    """Where each section has its minimum and maximum, shape `(sections, 2)`.

    Of a section without any value it is the first row, which keeps the gap visible.
    """
    lowest = np.where(np.isnan(sections), np.inf, sections).argmin(axis=1)
    highest = np.where(np.isnan(sections), -np.inf, sections).argmax(axis=1)
    return np.stack([lowest, highest], axis=1)


def limited(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values as they can be drawn: infinite ones are gaps, and very large ones are smaller."""
    return np.clip(np.where(np.isinf(values), np.nan, values), -_GREATEST, _GREATEST)
