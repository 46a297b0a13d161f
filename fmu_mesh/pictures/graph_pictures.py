"""The shapes of a system graph as the text of an SVG, or as a figure of matplotlib: the same at the same places."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Literal

from ..printing import printable
from .drawing import FONT, GROUP, GROUP_BORDER, empty_figure
from .graph_drawing import Box, Drawing, DrawnWire, Label
from .graph_layout import Dot
from .tables import escaped

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["figure_of_drawing", "svg_of_drawing"]


def _moves(path: Sequence[Dot]) -> Iterator[tuple[Literal["M", "L", "Q", "C"], tuple[Dot, ...]]]:
    """The commands of a path with their points: curves between columns, and round corners between straight lines."""
    yield "M", (path[0],)
    for number, (before, here) in enumerate(pairwise(path), 1):
        if before[0] != here[0] and before[1] != here[1]:
            middle = 0.5 * (before[0] + here[0])
            yield "C", ((middle, before[1]), (middle, here[1]), here)
            continue
        after = path[number + 1] if number + 1 < len(path) else here
        turns = (before[0] == here[0]) != (after[0] == here[0]) and (before[1] == here[1]) != (after[1] == here[1])
        if not turns:
            yield "L", (here,)
            continue
        radius = min(7.0, 0.5 * _distance(before, here), 0.5 * _distance(here, after))
        yield "L", (_towards(here, before, radius),)
        yield "Q", (here, _towards(here, after, radius))


def _distance(first: Dot, second: Dot) -> float:
    return abs(first[0] - second[0]) + abs(first[1] - second[1])


def _towards(here: Dot, there: Dot, length: float) -> Dot:
    whole = _distance(here, there) or 1.0
    return here[0] + (there[0] - here[0]) * length / whole, here[1] + (there[1] - here[1]) * length / whole


def _arrow(end: Dot) -> tuple[Dot, Dot, Dot]:
    x, y = end
    return (x, y), (x - 8.0, y - 4.0), (x - 8.0, y + 4.0)


def _ring(end: Dot) -> Dot:
    """The middle of a ring behind the arrow."""
    return end[0] - 13.0, end[1]


# --- SVG


def svg_of_drawing(drawing: Drawing) -> str:
    """The text of an SVG file."""
    width, height = f"{drawing.width:.0f}", f"{drawing.height:.0f}"
    size = f'width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="{FONT}">',
        '<rect width="100%" height="100%" fill="#ffffff"/>',
    ]
    for box, label in drawing.groups:
        lines += [_rect(box, GROUP, GROUP_BORDER, 1.0, 8.0), _svg_text(label)]
    by_edge: dict[int, list[DrawnWire]] = {}
    for wire in drawing.wires:
        by_edge.setdefault(wire.edge, []).append(wire)
    for edge, wires in by_edge.items():
        source, target = drawing.edges[edge]
        lines.append(f'<g class="edge" data-source="{escaped(source)}" data-target="{escaped(target)}">')
        for wire in wires:
            dashes = ' stroke-dasharray="6 4"' if wire.dashed else ""
            moves = ((command, " ".join(f"{x:.1f} {y:.1f}" for x, y in dots)) for command, dots in _moves(wire.path))
            commands = "".join(chain.from_iterable(moves))
            x, y = _ring(wire.path[-1])
            ring = f'<circle class="ring" cx="{x:.1f}" cy="{y:.1f}" r="4" fill="#ffffff" stroke="{wire.colour}"/>'
            tip = "\n".join(map(escaped, wire.tip.split("\n")))
            lines.append(
                f'<g><path d="{commands}" fill="none" stroke="{wire.colour}" stroke-width="{wire.width}"{dashes}/>'
                f'<polygon points="{" ".join(f"{x:.1f},{y:.1f}" for x, y in _arrow(wire.path[-1]))}" '
                f'fill="{wire.colour}"/>{ring if wire.has_ring else ""}<title>{tip}</title></g>'
            )
        lines.append("</g>")
    for instance in drawing.instances:
        lines.append(f'<g class="instance" data-instance="{escaped(instance.name)}">')
        lines.append(_rect(instance.box, "#ffffff", instance.border, 2.4 if instance.is_in_cycle else 1.2, 5.0))
        lines.append(f"<title>{escaped(instance.name)}</title>")
        if instance.dot is not None:
            x, y, colour = instance.dot
            lines.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}"/>')
        lines += [*map(_svg_text, instance.labels), "</g>"]
    return "\n".join([*lines, *map(_svg_text, drawing.labels), "</svg>", ""])


def _rect(box: Box, fill: str, stroke: str, width: float, radius: float) -> str:
    return (
        f'<rect x="{box.x:.1f}" y="{box.y:.1f}" width="{box.width:.1f}" height="{box.height:.1f}" rx="{radius}" '
        f'fill="{fill}" stroke="{stroke}" stroke-width="{width}"/>'
    )


def _svg_text(label: Label) -> str:
    bold = ' font-weight="bold"' if label.bold else ""
    anchor = ' text-anchor="end"' if label.anchor == "end" else ""
    return (
        f'<text x="{label.x:.1f}" y="{label.y:.1f}" font-size="{label.size:g}" fill="{label.colour}"{bold}{anchor}>'
        f"{escaped(label.text)}</text>"
    )


# --- matplotlib


def figure_of_drawing(drawing: Drawing) -> Figure:
    """The figure of matplotlib, which writes PNG and PDF."""
    figure = empty_figure()
    figure.set_layout_engine("none")
    from matplotlib.patches import Circle, FancyBboxPatch, PathPatch, Polygon  # noqa: PLC0415  an extra, and slow to import
    from matplotlib.path import Path  # noqa: PLC0415  as above

    figure.set_size_inches(drawing.width / 96.0, drawing.height / 96.0)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, drawing.width), ylim=(drawing.height, 0.0))
    axes.axis("off")

    def rectangle(box: Box, fill: str, border: str, width: float, radius: float) -> None:
        style = f"round,pad=0,rounding_size={radius}"
        axes.add_patch(
            FancyBboxPatch(
                (box.x, box.y), box.width, box.height, style, facecolor=fill, edgecolor=border, linewidth=0.75 * width
            )
        )

    def write(label: Label) -> None:
        axes.text(
            label.x,
            label.y,
            printable(label.text),
            fontsize=0.75 * label.size * 0.93,  # the font of matplotlib is wide
            color=label.colour,
            fontweight="bold" if label.bold else "normal",
            ha="right" if label.anchor == "end" else "left",
            va="baseline",
            parse_math=False,
        )

    codes = {"M": [Path.MOVETO], "L": [Path.LINETO], "Q": [Path.CURVE3] * 2, "C": [Path.CURVE4] * 3}
    for box, label in drawing.groups:
        rectangle(box, GROUP, GROUP_BORDER, 1.0, 8.0)
        write(label)
    for wire in drawing.wires:
        moves = [*_moves(wire.path)]
        path = Path(
            [dot for _, dots in moves for dot in dots], [code for command, _ in moves for code in codes[command]]
        )
        axes.add_patch(
            PathPatch(
                path,
                fill=False,
                edgecolor=wire.colour,
                linewidth=0.75 * wire.width,
                linestyle=(0, (4.5 / wire.width, 3.0 / wire.width)) if wire.dashed else "solid",
                capstyle="butt",
            )
        )
        axes.add_patch(Polygon(_arrow(wire.path[-1]), facecolor=wire.colour, edgecolor="none"))
        if wire.has_ring:
            axes.add_patch(Circle(_ring(wire.path[-1]), 4.0, facecolor="white", edgecolor=wire.colour, linewidth=0.75))
    for instance in drawing.instances:
        rectangle(instance.box, "white", instance.border, 2.4 if instance.is_in_cycle else 1.2, 5.0)
        if instance.dot is not None:
            x, y, colour = instance.dot
            axes.add_patch(Circle((x, y), 4.0, color=colour))
        for label in instance.labels:
            write(label)
    for label in drawing.labels:
        write(label)
    return figure
