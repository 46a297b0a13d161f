"""Files that one process writes alone, and the hashes of files. Knows nothing of what is in them."""

from __future__ import annotations

import fcntl
import hashlib
import os
from functools import cache
from io import BufferedWriter, FileIO
from pathlib import Path

from .errors import ConfigurationError

__all__ = ["open_alone", "sha256_of"]

_BUFFER_BYTES = 1 << 16


def open_alone(path: Path) -> BufferedWriter:
    """Open a result file, empty, for one writer: two runs of one configuration would write into each other's rows.

    Args:
        path: the file; its folder is made, an older file is replaced.

    Raises:
        ConfigurationError: another run writes it, or it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Without O_TRUNC: an older file stays as it is until this one is ours.
        raw = FileIO(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o666), "wb")
    except OSError as error:
        raise ConfigurationError(f"the result file '{path}' cannot be written: {error.strerror}") from error
    if path.is_file():  # and not a device such as /dev/null
        _lock(raw, path)
        raw.truncate(0)
    return BufferedWriter(raw, _BUFFER_BYTES)


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file as hexadecimal digits; a process reads a file once, unless it changes."""
    status = path.stat()
    return _sha256(path, status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)


@cache
def _sha256(path: Path, *_version: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _lock(raw: FileIO, path: Path) -> None:
    try:
        fcntl.flock(raw, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raw.close()
        hint = "Wait for its end, or choose another file with --output."
        raise ConfigurationError(f"another run is writing the result file '{path}'", hint=hint) from error
    except OSError:
        return  # a file system without locks
