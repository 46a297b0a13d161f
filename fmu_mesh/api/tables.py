"""Tables as plain text with aligned columns and without colours."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ..text import printable

__all__ = ["pairs", "shortened", "table", "width_of"]

_GAP = "  "
_ELLIPSIS = "\N{HORIZONTAL ELLIPSIS}"


def table(rows: Iterable[Sequence[str]], *, heading: Sequence[str] | None = None, indent: int = 0) -> list[str]:
    """The lines of a table; every column is as wide as its widest cell, and empty columns are left out."""
    cells = [list(map(printable, row)) for row in rows]
    shown = [column for column in range(len(cells[0]) if cells else 0) if any(row[column] for row in cells)]
    if heading is not None and cells:
        cells.insert(0, list(heading))
    widths = {column: max(len(row[column]) for row in cells) for column in shown}
    return [" " * indent + _GAP.join(row[column].ljust(widths[column]) for column in shown).rstrip() for row in cells]


def width_of(rows: Iterable[Sequence[str]], heading: Sequence[str]) -> int:
    """The width of a table in columns of a terminal."""
    return max(map(len, table(rows, heading=heading)), default=0)


def shortened(name: str, width: int) -> str:
    """A name in at most ``width`` columns, without its middle: names differ mostly at their ends."""
    name = printable(name)
    if len(name) <= width:
        return name
    kept = max(width - len(_ELLIPSIS), 0)
    return f"{name[: kept - kept // 2]}{_ELLIPSIS}{name[len(name) - kept // 2 :]}"


def pairs(items: Iterable[tuple[str, str]], *, indent: int = 0) -> list[str]:
    """The lines of a list of names and values, without the pairs whose value is empty."""
    return table([[name, value] for name, value in items if value], indent=indent)
