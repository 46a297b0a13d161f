"""Tables as plain text: columns in line, no colours, no dependence on the width of a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

__all__ = ["pairs", "table"]

_GAP = "  "


def table(rows: Iterable[Sequence[str]], *, heading: Sequence[str] | None = None, indent: int = 0) -> list[str]:
    """The lines of a table; every column is as wide as its widest cell, and empty columns are left out."""
    cells = [list(row) for row in rows]
    shown = [column for column in range(len(cells[0]) if cells else 0) if any(row[column] for row in cells)]
    if heading is not None and cells:
        cells.insert(0, list(heading))
    widths = {column: max(len(row[column]) for row in cells) for column in shown}
    return [" " * indent + _GAP.join(row[column].ljust(widths[column]) for column in shown).rstrip() for row in cells]


def pairs(items: Iterable[tuple[str, str]], *, indent: int = 0) -> list[str]:
    """The lines of a list of names with their values; those without a value are left out."""
    return table([[name, value] for name, value in items if value], indent=indent)
