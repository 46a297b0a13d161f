"""The rows of the nodes that play after a loss, in a file: as they are in their rings, each with its stamp (ADR 92).

The file is a head and then chunks. A chunk has the rows of so many points: those of one instance side by side, then
those of the next one. So a row is written and read as it is, many at once, and a node reads only its own ones.
"""

# Who meets here: the recorder's thread writes; the main thread of the master asks for `error`, and another one gives
# the file to the disk (`fmu_mesh.run.run_directory`). Nodes of a later attempt read it, when its writer is gone.
#
# What may go wrong: the writer is killed within a row. So the number of points at the begin of the file is written
# after their rows, and nobody reads more. The disk is full: each chunk is reserved before it is written, so this is an
# error of one call. Then nothing more is written, and the run goes on. The results are worth more than this file: it
# leaves some room on the disk. After a power cut, rows may be missing that the number promises: the directory of the
# run says how many there are for sure (ADR 91), and each row has its stamp.

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
import numpy as np

from ..errors import FmuMeshError
from ..rings.ring import Ring

__all__ = ["PLAYED_ROWS", "MemoryOf", "PlayedRows", "RowsToPlay", "cut_rows", "rows_to_play"]

PLAYED_ROWS: Final = "played.rows"
"""Its name."""

MemoryOf = Callable[[int, int], Iterator[memoryview]]
"""Returns the bytes of own rows of an instance, from one to before another, in pieces."""

_START: Final = struct.Struct("<8sqq")
"""Letters, the number of complete points, and the size of the head."""

_LETTERS: Final = b"FMUPLAYS"
_COUNT: Final = struct.Struct("<q")
_COUNT_AT: Final = 8
_PAGE: Final = 4096
_CHUNK_BYTES: Final = 1 << 20
_FREE_PARTS: Final = 50
"""One part in so many of its disk stays free."""


class _Region(NamedTuple):
    """The rows of one instance: where they begin in a chunk, the size of one in bytes, and its points."""

    first: int
    stride: int
    step_points: int


class _Head(msgspec.Struct, frozen=True):
    chunk_points: int
    chunk_bytes: int
    regions: dict[str, _Region]

    @classmethod
    def of(cls, rows: Mapping[str, tuple[int, int]]) -> _Head:
        points = max(1, int(_CHUNK_BYTES / max(1, sum(stride / own for stride, own in rows.values()))))
        regions, end = {}, 0
        for name, (stride, own) in rows.items():
            regions[name] = _Region(end, stride, own)
            end += stride * -(-points // own)
        return cls(points, end, regions)

    def pieces(self, name: str, first: int, end: int) -> Iterator[tuple[int, int, int]]:
        """Where own rows ``first .. end - 1`` of an instance are: first row, row after the last one, place in bytes."""
        region = self.regions[name]
        while first < end:
            chunk = first * region.step_points // self.chunk_points
            begin, stop = (-(-own * self.chunk_points // region.step_points) for own in (chunk, chunk + 1))
            yield first, min(end, stop), chunk * self.chunk_bytes + region.first + (first - begin) * region.stride
            first = min(end, stop)


class PlayedRows:
    """Writes the rows of the instances that may have to play them; goes on with a file that is there.

    After its first error it writes nothing.

    Args:
        path: the file.
        rows: of each instance, the size of a row in bytes, and its base points per own step.

    Attributes:
        path: the file.
        points: so many points, from the first one on, are in the file.
        error: why there are no more; empty: there are.
    """

    def __init__(self, path: Path, rows: Mapping[str, tuple[int, int]]) -> None:
        self.path, self.points, self.error, self._reserved = path, 0, "", 0
        self._head = _Head.of(rows)
        data = msgspec.msgpack.encode(self._head)
        self._begin = _begin_of(len(data))
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            if os.pread(self._file, len(data), _START.size) == data:
                self.points = rows_to_play(path)
                self._reserved = -(-self.points // self._head.chunk_points)
            else:
                os.ftruncate(self._file, 0)
                os.posix_fallocate(self._file, 0, self._begin)
                _write_all(self._file, memoryview(_START.pack(_LETTERS, 0, len(data)) + data), 0)
        except OSError as error:
            self._fail(error)

    def write(self, first: int, end: int, memory: Mapping[str, MemoryOf]) -> None:
        """Write the rows of the points first to end - 1; ``memory`` has those of each instance."""
        try:
            while not self.error and (begin := max(first, self.points)) < end:
                chunk = begin // self._head.chunk_points
                stop = min(end, (chunk + 1) * self._head.chunk_points)
                if chunk >= self._reserved:
                    self._reserve(chunk)
                for name, region in self._head.regions.items():
                    low, high = (-(-point // region.step_points) for point in (begin, stop))
                    for start, after, place in self._head.pieces(name, low, high):
                        to = self._begin + place
                        for piece in memory[name](start, after):
                            to = _write_all(self._file, piece, to)
                _write_all(self._file, memoryview(_COUNT.pack(stop)), _COUNT_AT)
                self.points = stop
        except OSError as error:
            self._fail(error)

    def _reserve(self, chunk: int) -> None:
        room, size = os.fstatvfs(self._file), self._head.chunk_bytes
        if room.f_bavail * room.f_frsize - size < room.f_blocks * room.f_frsize // _FREE_PARTS:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        os.posix_fallocate(self._file, self._begin + chunk * size, size)
        self._reserved = chunk + 1

    def _fail(self, error: OSError) -> None:
        self.error = f"the rows for a restart ('{self.path}') cannot be written: {error.strerror}"

    def close(self) -> None:
        """Close the file, which stays for a further attempt."""
        with suppress(OSError, AttributeError):  # it could not be opened
            os.close(self._file)


class RowsToPlay:
    """Reads the rows that `PlayedRows` has written, for one process.

    Raises:
        FmuMeshError: the file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            with path.open("rb") as file:
                *_, size = _START.unpack(file.read(_START.size))
                self._head = msgspec.msgpack.decode(file.read(size), type=_Head)
        except (OSError, struct.error, msgspec.MsgspecError) as error:
            raise self._unreadable(str(error)) from error
        self._begin = _begin_of(size)

    def read(self, name: str, ring: Ring, first: int, end: int) -> None:
        """Read own rows ``first .. end - 1`` of an instance into its ring, with their stamps.

        Raises:
            FmuMeshError: they cannot be read, or are not these.
        """
        if not ring.layout.columns:
            ring.stamps[np.arange(first, end) & ring.mask] = np.arange(first + 1, end + 1)
            return
        try:
            with self._path.open("rb", buffering=0) as file:
                for start, stop, place in self._head.pieces(name, first, end):
                    file.seek(self._begin + place)
                    for _, slots in ring.pieces(start, stop):
                        file.readinto(ring.memory(slots))
        except OSError as error:
            raise self._unreadable(str(error)) from error
        for start, slots in ring.pieces(first, end):
            if (ring.stamps[slots] != np.arange(start + 1, start + 1 + slots.stop - slots.start)).any():
                raise self._unreadable(f"rows of '{name}' are missing from row {start} on")

    def _unreadable(self, why: str) -> FmuMeshError:
        text = f"the rows for a restart ('{self._path}') cannot be read: {why}"
        return FmuMeshError(text, hint="Run it without checkpoints: `recovery: {checkpoint_s: null}`.")


def rows_to_play(path: Path) -> int:
    """How many points the file has, from the first one on; 0 if there is none."""
    try:
        with path.open("rb") as file:
            letters, points, _ = _START.unpack(file.read(_START.size))
    except (OSError, struct.error):
        return 0
    return int(points) if letters == _LETTERS else 0


def cut_rows(path: Path, points: int) -> None:
    """After a power cut: the file has so many points at most; nothing happens if there is none.

    Raises:
        OSError: it cannot be written.
    """
    if rows_to_play(path) > points:
        with path.open("r+b") as file:
            file.seek(_COUNT_AT)
            file.write(_COUNT.pack(points))


def _begin_of(head_bytes: int) -> int:
    """Where the first chunk begins."""
    return -(-(_START.size + head_bytes) // _PAGE) * _PAGE


def _write_all(file: int, data: memoryview, place: int) -> int:
    """Write all at a place in bytes; returns that behind it."""
    while data:
        written = os.pwrite(file, data, place)
        data, place = data[written:], place + written
    return place
