"""What came from outside while a run went on, in a file that survives its writer: it is given again after a restart.

One line of JSON for each entry, in the folder of the run. Who reads it leaves out a last line that is cut off.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

import msgspec

from ..errors import ConfigurationError
from ..system.live_keys import KeyValue
from .messages import SetValue

__all__ = ["JOURNAL", "Journal", "NodeJournal"]

JOURNAL: Final = ".journal"
"""How the names of these files end."""

Entry = TypeVar("Entry")


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

    def entries(self) -> Iterator[Entry]:
        """What was written before, in its order.

        Raises:
            ConfigurationError: it cannot be read.
        """
        try:
            data = Path(self._path).read_bytes() if self._path else b""
        except FileNotFoundError:
            return
        except OSError as error:
            raise ConfigurationError(f"'{self._path}' cannot be read: {error.strerror}") from error
        yield from (self._decode(line) for line in data.split(b"\n")[:-1])

    def add(self, *entries: Entry) -> None:
        """Append entries.

        Raises:
            ConfigurationError: they cannot be written, such as on a full disk.
        """
        if not self._path:
            return
        try:
            if self._descriptor is None:
                self._descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
                whole = os.pread(self._descriptor, os.fstat(self._descriptor).st_size, 0).rfind(b"\n") + 1
                os.ftruncate(self._descriptor, whole)
                os.lseek(self._descriptor, whole, os.SEEK_SET)
            left = memoryview(b"".join(msgspec.json.encode(entry) + b"\n" for entry in entries))
            while left:
                left = left[os.write(self._descriptor, left) :]
        except OSError as error:
            text = f"what is set cannot be kept for a restart: '{self._path}' cannot be written: {error.strerror}"
            raise ConfigurationError(text, hint="Free some disk space, or run without `recovery`.") from error

    def close(self) -> None:
        """Close the file; may be called twice."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


class NodeJournal(Journal[SetValue | list[KeyValue]]):
    """What the instances of a node got from outside; ``path`` as for `Journal`."""

    def __init__(self, path: str) -> None:
        super().__init__(path, SetValue | list[KeyValue])

    def keep(self, news: object) -> None:
        """Append what a node tells the recorder, if an instance got a value; the errors are those of `add`."""
        if isinstance(news, SetValue | list):
            self.add(news)

    def given(self) -> Mapping[str, Sequence[KeyValue]]:
        """What each instance got before a restart, in its order; the errors are those of `entries`."""
        given: dict[str, list[KeyValue]] = {}
        for entry in self.entries():
            own = entry
            if isinstance(own, SetValue):
                own = [(f"{own.instance}.{own.variable}", own.point, own.time, own.value)]
            for value in own:
                given.setdefault(value[0].partition(".")[0], []).append(value)
        return given
