"""The metadata of a run beside its result file, for formats that have no place for them: `<file>.json`.

The file is valid JSON at every moment: an entry is added by one write, which also writes the closing brackets again.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from ..files import opened, replaced
from .recording import metadata_in

__all__ = ["NotesFile", "read_notes"]

_ENDING = ".json"


class NotesFile:
    """Writes the metadata of a run, and what happens in it.

    Args:
        path: the result file.
        metadata: what is known when the run starts; not empty.
    """

    def __init__(self, path: Path, metadata: Mapping[str, Any]) -> None:
        self._path = _beside(path)
        self._metadata = dict(metadata)
        self._waiting: list[Mapping[str, Any]] = []
        self._members: dict[str, Any] = {}
        self._descriptor: int | None = None
        self._size = self._end_of_list = 0
        self._empty = True

    def begin(self) -> None:
        """Replace the file of an earlier run; the first rows will follow.

        Raises:
            OSError: it cannot be written.
        """
        metadata = msgspec.json.format(msgspec.json.encode(self._metadata), indent=2)
        start = metadata.removesuffix(b"\n}") + b',\n  "set": ['
        with replaced(self._path) as draft:
            draft.write_bytes(start + b"]\n}\n")
            self._descriptor = os.open(draft, os.O_WRONLY | os.O_CLOEXEC)
        self._end_of_list, self._size = len(start), len(start) + len(b"]\n}\n")
        waiting, self._waiting = self._waiting, []
        for entry in waiting:
            self.note(entry)

    def note(self, entry: Mapping[str, Any]) -> None:
        """Add an entry; it is in the file at once, or after `begin`.

        Raises:
            OSError: it cannot be written.
        """
        if self._descriptor is None:
            self._waiting.append(entry)
            return
        added = b""
        if "variable" in entry:
            added = (b"\n    " if self._empty else b",\n    ") + msgspec.json.encode(entry)
            self._empty = False
        else:
            self._members |= entry
        members = b"".join(
            b",\n  " + msgspec.json.encode(key) + b": " + msgspec.json.encode(value)
            for key, value in self._members.items()
        )
        text = added + (b"]" if self._empty else b"\n  ]") + members + b"\n}\n"
        text = text.ljust(self._size - self._end_of_list)  # a shorter one would leave some of the last end behind it
        _write_all(self._descriptor, text, self._end_of_list)
        self._size = self._end_of_list + len(text)
        self._end_of_list += len(added)

    def close(self) -> None:
        """Close the file; may be called twice."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def read_notes(path: Path) -> dict[str, Any]:
    """The metadata beside a result file; empty if there are none."""
    try:
        with opened(_beside(path)) as file:
            found = metadata_in(file.read())
    except (OSError, ValueError):
        return {}
    if not found.get("set", True):
        del found["set"]
    return found


def _beside(path: Path) -> Path:
    return path.with_name(path.name + _ENDING)


def _write_all(descriptor: int, text: bytes, offset: int) -> None:
    left = memoryview(text)
    while left:
        written = os.pwrite(descriptor, left, offset)
        left, offset = left[written:], offset + written
