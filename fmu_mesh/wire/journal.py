"""What came from outside while a run went on, in a file that survives its writer: it is given again after a restart.

One line for each entry: a CRC-32 in eight digits, and JSON. It is in the folder of the run, or in the directory of
`recovery`, where it may also have to survive a power cut. A last line that is cut off or damaged counts as not written;
a damaged line before others is an error.
"""

from __future__ import annotations

import fcntl
import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Generic, NamedTuple, TypeVar

import msgspec

from ..errors import ConfigurationError
from ..system.live_keys import KeyValue
from .messages import SetValue

__all__ = ["IN_USE", "JOURNAL", "JOURNALS", "Journal", "NodeJournal", "Whole", "line_of", "whole_lines"]

JOURNAL: Final = ".journal"
"""How the names of these files end."""
JOURNALS: Final = "journals"
"""A folder for them, where they are not in that of the run."""
IN_USE: Final = "in_use"
"""A file beside journals; if it is there, each process with a journal has a shared lock on it as long as it lives."""

Entry = TypeVar("Entry")


class Whole(NamedTuple):
    """What is whole of a file of lines: the JSON of each, their bytes in all, and how many others follow these."""

    lines: list[bytes]
    size: int
    torn: int


def line_of(entry: object) -> bytes:
    """An entry with its checksum, as a line."""
    data = msgspec.json.encode(entry)
    return b"%08x %b\n" % (zlib.crc32(data), data)


def whole_lines(path: Path) -> Whole:
    """What is whole in a file of such lines; nothing if there is no file.

    Raises:
        ConfigurationError: it cannot be read, or a damaged line has whole ones after it.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        data = b""
    except OSError as error:
        raise ConfigurationError(f"'{path}' cannot be read: {error.strerror}") from error
    found = [line[9:] if line[:8] == b"%08x" % zlib.crc32(line[9:]) else None for line in data.split(b"\n")[:-1]]
    whole = found.index(None) if None in found else len(found)
    if any(line is not None for line in found[whole:]):
        raise ConfigurationError(f"'{path}' is damaged in line {whole + 1}", hint="The run cannot be given it again.")
    lines = [line for line in found[:whole] if line is not None]
    size = sum(len(line) + 10 for line in lines)
    return Whole(lines, size, len(data) - size)


class Journal(Generic[Entry]):
    """The entries of one node, or of the master. The operating system has an entry before it takes effect.

    Args:
        path: the file; empty: nothing is written.
        type_: what an entry is.
    """

    def __init__(self, path: str, type_: Any) -> None:  # noqa: ANN401  may be a union
        self._path = path
        self._decode: Callable[[bytes], Entry] = msgspec.json.Decoder(type_).decode
        self._descriptor: int | None = None
        self._in_use: int | None = None
        if path:
            with suppress(OSError):  # there is none, or the file system has no locks
                self._in_use = os.open(Path(path).with_name(IN_USE), os.O_RDWR | os.O_CLOEXEC)
                fcntl.flock(self._in_use, fcntl.LOCK_SH | fcntl.LOCK_NB)

    def entries(self) -> Iterator[Entry]:
        """What was written before, in its order.

        Raises:
            ConfigurationError: it cannot be read, or is damaged.
        """
        if self._path:
            yield from map(self._decode, whole_lines(Path(self._path)).lines)

    def add(self, *entries: Entry) -> None:
        """Append entries.

        Raises:
            ConfigurationError: they cannot be written, such as on a full disk.
        """
        if not self._path:
            return
        try:
            if self._descriptor is None:
                whole = whole_lines(Path(self._path)).size
                self._descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
                os.ftruncate(self._descriptor, whole)
                os.lseek(self._descriptor, whole, os.SEEK_SET)
            left = memoryview(b"".join(map(line_of, entries)))
            while left:
                left = left[os.write(self._descriptor, left) :]
        except OSError as error:
            text = f"what is set cannot be kept for a restart: '{self._path}' cannot be written: {error.strerror}"
            raise ConfigurationError(text, hint="Free some disk space, or run without `recovery`.") from error

    def close(self) -> None:
        """Close the file; may be called twice."""
        for descriptor in (self._descriptor, self._in_use):
            if descriptor is not None:
                os.close(descriptor)
        self._descriptor = self._in_use = None


class NodeJournal(Journal[SetValue | list[KeyValue]]):
    """What the instances of a node got from outside; ``path`` as for `Journal`.

    Attributes:
        last_point: after `given`, the last point with a value: a node may have been ahead of all rows that were seen.
    """

    def __init__(self, path: str) -> None:
        super().__init__(path, SetValue | list[KeyValue])
        self.last_point = 0

    def keep(self, news: object) -> None:
        """Append what a node tells the recorder, if an instance got a value; the errors are those of `add`."""
        if isinstance(news, SetValue | list):
            self.add(news)

    def given(self) -> Mapping[str, Sequence[KeyValue]]:
        """What each instance got before a restart, by point and in its order; the errors are those of `entries`."""
        given: dict[str, list[KeyValue]] = {}
        for entry in self.entries():
            own = entry
            if isinstance(own, SetValue):
                own = [(f"{own.instance}.{own.variable}", own.point, own.time, own.value)]
            for value in own:
                given.setdefault(value[0].partition(".")[0], []).append(value)
        for values in given.values():
            values.sort(key=lambda value: value[1])
            self.last_point = max(self.last_point, values[-1][1])
        return given
