"""Text for messages: the nearest right name, names in a list, a value as a reader would write it."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from pathlib import Path

__all__ = ["listed", "nearest", "nearest_file", "shown"]

_LISTED_NAMES = 8
_SHOWN_CHARACTERS = 60


def nearest(name: str, names: Iterable[str]) -> str | None:
    """The one of ``names`` that ``name`` is most likely a slip of, or None."""
    folded: dict[str, str] = {}
    for candidate in names:
        folded.setdefault(candidate.casefold(), candidate)
    wanted = name.casefold()
    close = difflib.get_close_matches(wanted, folded, n=1)
    if not close and len(wanted) > 1:  # a beginning that fits one name only
        longer = [candidate for candidate in folded if candidate.startswith(wanted)]
        close = longer if len(longer) == 1 else []
    return folded[close[0]] if close else None


def nearest_file(path: Path) -> str | None:
    """The existing file in the folder of ``path`` that has the nearest name, or None."""
    try:
        name = nearest(path.name, sorted(entry.name for entry in path.parent.iterdir() if entry.is_file()))
    except OSError:
        return None
    return str(path.with_name(name)) if name is not None else None


def listed(names: Sequence[str], *, nothing: str = "none") -> str:
    """``names`` as text, cut where it gets long."""
    if not names:
        return nothing
    rest = len(names) - _LISTED_NAMES
    return ", ".join(names[:_LISTED_NAMES]) + (f" and {rest} more" if rest > 0 else "")


def shown(value: object) -> str:
    """A value of the file as a reader would write it, cut where it gets long."""
    match value:
        case None:
            return "nothing (null)"
        case bool():
            return "true" if value else "false"
        case str():
            text = repr(value)
        case dict():
            return "a mapping"
        case list():
            return "a list"
        case _:
            text = str(value)
    return text if len(text) <= _SHOWN_CHARACTERS else f"{text[: _SHOWN_CHARACTERS - 3]}..."
