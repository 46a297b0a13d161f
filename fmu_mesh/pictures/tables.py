"""Tables: as plain text with aligned columns and without colours, and as the HTML that notebooks show."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from itertools import islice
from typing import Final

from ..system.defect import Defect, largest_defects
from ..text import counted, printable

__all__ = [
    "DEFECT_COLUMNS",
    "defect_rows",
    "escaped",
    "html_table",
    "pairs",
    "shortened",
    "table",
    "titled",
    "wrapped",
]

DEFECT_COLUMNS: Final = ("connection", "largest", "of its range", "RMS", "at t in s")

_GAP = "  "
_ELLIPSIS = "\N{HORIZONTAL ELLIPSIS}"
_ROWS, _COLUMNS, _CELL = 20, 10, 120
"""The size of a table in a notebook; what is left out is counted."""


def table(rows: Iterable[Sequence[str]], *, heading: Sequence[str] | None = None, indent: int = 0) -> list[str]:
    """The lines of a table; every column is as wide as its widest cell, and empty columns are left out."""
    cells = [list(map(printable, row)) for row in rows]
    shown = [column for column in range(len(cells[0]) if cells else 0) if any(row[column] for row in cells)]
    if heading is not None and cells:
        cells.insert(0, list(heading))
    widths = {column: max(len(row[column]) for row in cells) for column in shown}
    return [" " * indent + _GAP.join(row[column].ljust(widths[column]) for column in shown).rstrip() for row in cells]


def titled(sections: Iterable[tuple[str, Sequence[str]]]) -> list[str]:
    """The lines of a page: sections with their titles, an empty line between them; empty sections are left out."""
    lines: list[str] = []
    for title, content in sections:
        if content:
            lines += [*([""] if lines else []), *([title] if title else []), *content]
    return lines


def shortened(name: str, width: int) -> str:
    """A name in at most ``width`` columns, without its middle: names differ mostly at their ends."""
    name = printable(name)
    if len(name) <= width:
        return name
    kept = max(width - len(_ELLIPSIS), 0)
    return f"{name[: kept - kept // 2]}{_ELLIPSIS}{name[len(name) - kept // 2 :]}"


def wrapped(parts: Sequence[str], width: int, front: str = "") -> list[str]:
    """Parts with commas between them after a front, in lines of at most ``width`` columns, unless a part is longer."""
    lines = [front + parts[0]]
    for part in parts[1:]:
        lines[-1] += ","
        if len(lines[-1]) + len(f" {part},") > width:
            lines.append(" " * len(front) + part)
        else:
            lines[-1] += f" {part}"
    return lines


def pairs(items: Iterable[tuple[str, str]], *, indent: int = 0) -> list[str]:
    """The lines of a list of names and values, without the pairs whose value is empty."""
    return table([[name, value] for name, value in items if value], indent=indent)


def defect_rows(defects: Mapping[str, Defect]) -> list[tuple[str, ...]]:
    """The five that are largest relative to the range of their inputs, as rows of `DEFECT_COLUMNS`."""
    return [
        (name, f"{own.maximum:.3g}", f"{own.relative:.3g}", f"{own.rms:.3g}", f"{own.time:.12g}")
        for name, own in largest_defects(defects, 5).items()
    ]


def escaped(text: str) -> str:
    """A text as a part of a page of HTML, or of an SVG."""
    return html.escape(printable(text), quote=True)


def html_table(title: str, heading: Sequence[str], rows: Iterable[Sequence[object]], count: int) -> str:
    """A title, and the first of ``count`` rows; without colours of its own, so it is readable in light and in dark."""

    def line(tag: str, cells: Sequence[object]) -> str:
        texts = [f"{cell:.6g}" if isinstance(cell, float) else "" if cell is None else str(cell) for cell in cells]
        style = ' style="text-align: left"'
        return "".join(f"<{tag}{style}>{escaped(shortened(text, _CELL))}</{tag}>" for text in texts[:_COLUMNS])

    parts = [f"<p>{escaped(title)}</p>"]
    if count:
        body = "".join(f"<tr>{line('td', row)}</tr>" for row in islice(rows, _ROWS))
        parts.append(f"<table><thead><tr>{line('th', heading)}</tr></thead><tbody>{body}</tbody></table>")
    left_out = [(count - _ROWS, "row"), (len(heading) - _COLUMNS, "column")]
    parts += [f"<p>and {counted(number, f'more {what}')}</p>" for number, what in left_out if number > 0]
    return f"<div>{''.join(parts)}</div>"
