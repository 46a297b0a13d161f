"""Opening a result file: one run at a time writes into it."""

from __future__ import annotations

import fcntl
import logging
import os
import stat
from pathlib import Path
from typing import BinaryIO

from ..errors import ConfigurationError

__all__ = ["open_result_file"]

log = logging.getLogger(__name__)

_BUFFER_BYTES = 1 << 16


def open_result_file(path: Path) -> BinaryIO:
    """Open a file for results; its folder is made, an older file is emptied.

    Raises:
        ConfigurationError: it cannot be written, or another run writes into it.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except OSError as error:
        raise ConfigurationError(f"the result file '{path}' cannot be written: {error.strerror}") from error
    file = open(descriptor, "wb", buffering=_BUFFER_BYTES)  # noqa: PTH123, SIM115  a descriptor; the caller closes it
    if stat.S_ISREG(os.fstat(descriptor).st_mode):  # a device or a pipe takes what comes from everybody
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.close()
            raise ConfigurationError(
                f"another run writes the result file '{path}'", hint="Choose another one with --output."
            ) from error
        except OSError as error:  # a file system without locks
            log.info("result_file_not_locked", extra={"path": str(path), "error": str(error)})
        os.ftruncate(descriptor, 0)
    return file
