"""Files that one process writes alone, and that stay as they were until there is something to write; hashes of files.

Knows nothing of their format. A run opens and locks its result file at the start, so that a path that cannot be
written and a second run are refused before anything happens, and writes to it from its first point on:

* A file that exists is opened and locked, and emptied by the first bytes. It stays the same file: its permissions,
  its owner, links to it and a `tail -f` keep working, and a folder that is read-only does not matter.
* A file that does not exist begins as an empty `<name>.starting` beside it, which is locked as well, and gets its name
  with the first bytes. A run that ends before them removes it; if the run was killed, the next one does.
* A device or a pipe is just written.

`docs/adr/0050-a-result-replaces-the-last-one-at-its-first-point.md` says why.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader, FileIO
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from .errors import ConfigurationError

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

__all__ = ["Kept", "OwnFile", "exists", "is_file", "is_folder", "open_alone", "replaced", "sha256_of", "sha256_of_open"]

_DRAFT = ".starting"
_TRIES = 10
"""How often to look again for a file that others rename or remove at the same moment."""

_hashes: dict[tuple[int, ...], str] = {}
"""The SHA-256 of files that this process has read."""


class Kept(NamedTuple):
    """What of a file survives the end of its process, however it ends: ``rows`` in the first ``size`` bytes."""

    rows: int = 0
    size: int = 0


def exists(path: Path) -> bool:
    """Whether something is there.

    Unlike `Path.exists`, this and the two below say no where nobody can look, because a name is too long or a folder
    is closed to this user; who then opens the path is told why.
    """
    return os.path.exists(path)  # noqa: PTH110 see above


def is_file(path: Path) -> bool:
    """Whether a file is there."""
    return os.path.isfile(path)  # noqa: PTH113 see `exists`


def is_folder(path: Path) -> bool:
    """Whether a folder is there."""
    return os.path.isdir(path)  # noqa: PTH112 see `exists`


def open_alone(path: Path) -> OwnFile:
    """Open a result file for one writer: two runs of one configuration would write into each other's rows.

    Args:
        path: the file; its folder is made, what is in it stays until the first bytes are written.

    Raises:
        ConfigurationError: another run writes it, or it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return OwnFile(path)
    except BlockingIOError as error:
        hint = "Wait for its end, or choose another file with --output."
        raise ConfigurationError(f"another run is writing the result file '{path}'", hint=hint) from error
    except OSError as error:
        raise ConfigurationError(f"the result file '{path}' cannot be written: {error.strerror}") from error


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Inside, where to write a file that is of no use until it is complete; it gets its name at the end.

    If that fails, an older file stays as it was. A device or a pipe is written itself.
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        yield path
        return
    draft = target.with_name(f"{target.stem}.unfinished{path.suffix}")
    try:
        yield draft
        draft.replace(target)
    finally:
        draft.unlink(missing_ok=True)


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file in hexadecimal digits; it is calculated once per process, unless the file changes."""
    if (known := _hashes.get(_version(path.stat()))) is not None:
        return known
    with path.open("rb") as file:
        return sha256_of_open(file)


def sha256_of_open(file: BufferedReader, *, again: bool = False) -> str:
    """As `sha256_of`, for a file that is open; ``again``: read it even if its hash is known. Moves its position."""
    version = _version(os.fstat(file.fileno()))
    if again or version not in _hashes:
        file.seek(0)
        _hashes[version] = hashlib.file_digest(file, "sha256").hexdigest()
    return _hashes[version]


class OwnFile(FileIO):
    """An open file that nobody else writes; made by `open_alone`.

    A write that failed is not the last word of a full disk: all writes after it fail as well, so that there is never a
    gap in the file.

    Attributes:
        size: bytes written so far.
    """

    def __init__(self, path: Path) -> None:
        descriptor, self._draft = _open_locked(path)
        super().__init__(descriptor, "wb")
        self._path = path
        self._untouched = stat.S_ISREG(os.fstat(descriptor).st_mode)
        self._failure: OSError | None = None
        self.size = 0

    def write(self, data: ReadableBuffer, /) -> int:
        """Write bytes; returns how many, which may be fewer than there are."""
        if self._failure is not None:
            raise self._failure
        try:
            if self._untouched:
                self._begin()
            written = super().write(data)
        except OSError as error:
            self._failure = error
            raise
        self.size += written
        return written

    def close(self) -> None:
        """Close the file; without a byte written, nothing has changed."""
        if not self.closed and self._untouched and self._draft is not None:
            with suppress(OSError):
                self._draft.unlink()
        super().close()

    def _begin(self) -> None:
        self._untouched = False
        if self._draft is not None:
            self._draft.rename(os.path.realpath(self._path))
        self.truncate(0)


def _version(status: os.stat_result) -> tuple[int, ...]:
    """What changes if a file changes."""
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def _open_locked(path: Path) -> tuple[int, Path | None]:
    """The descriptor of a file, and its draft if there is no such file yet.

    Raises:
        BlockingIOError: somebody else has locked it.
        OSError: it cannot be opened.
    """
    draft = Path(f"{os.path.realpath(path)}{_DRAFT}")
    for _ in range(_TRIES):
        try:
            descriptor, is_draft = os.open(path, os.O_WRONLY | os.O_CLOEXEC), False
        except FileNotFoundError:
            flags = os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
            descriptor, is_draft = os.open(draft, flags, 0o666), True
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                return descriptor, None
            _lock(descriptor)
            if _is_at(draft if is_draft else path, descriptor):
                if not is_draft:
                    _remove(draft)
                    return descriptor, None
                if not path.exists():
                    return descriptor, draft
                draft.unlink()  # between the two looks another run has begun, and given its file the name
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
    raise BlockingIOError


def _lock(descriptor: int) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:
        return  # a file system without locks


def _is_at(path: Path, descriptor: int) -> bool:
    """Whether what is open is what the path leads to, and not something that was renamed or removed since."""
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _remove(draft: Path) -> None:
    """Remove a draft that a run has left that was killed."""
    with suppress(OSError), draft.open("r+b") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        draft.unlink()
