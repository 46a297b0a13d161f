"""Numeric libraries use one thread in every process of a run.

With several threads, a library adds up in another order, so the last digits of a matrix product differ from host to
host. Processes that each use all processors would also hinder one another. This module imports nothing, because the
variables have to be set before numpy is imported.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from threading import Lock
from typing import Any, Final

__all__ = ["ONE_THREAD", "LimitedThreads", "one_thread_from_now_on", "one_thread_meanwhile"]

ONE_THREAD: Final = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "BLIS_NUM_THREADS",
        "NUMEXPR_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
    ),
    "1",
)
"""The environment of a process whose numeric libraries use one thread."""


def one_thread_from_now_on() -> None:
    """Let the libraries that this process loads later use one thread, and those of its child processes."""
    os.environ.update(ONE_THREAD)


_lock = Lock()
_running: list[object] = []
"""The runs of this process that have limited the libraries; blocks of threads may overlap."""

_limits: list[Any] = []
"""What they have limited; it is lifted when the last of them ends."""


@contextmanager
def one_thread_meanwhile() -> Iterator[None]:
    """In the block, let the libraries that this process has loaded use one thread; blocks of threads may overlap."""
    from threadpoolctl import threadpool_limits  # noqa: PLC0415 slow, and only a run in this process needs it

    run = object()
    with _lock:
        _running.append(run)
        _limits.append(threadpool_limits(1))
    try:
        yield
    finally:
        with _lock:
            _running.remove(run)
            while _limits and not _running:
                _limits.pop().restore_original_limits()


class LimitedThreads:
    """As `one_thread_meanwhile`, from the first `limit` to `close`, for many runs: to look for libraries takes long."""

    def __init__(self) -> None:
        self._stack = ExitStack()
        self._seen = -1

    def limit(self) -> None:
        """Limit all libraries that are loaded by now, if there are new ones."""
        if _libraries_loaded() != self._seen:
            self._stack.enter_context(one_thread_meanwhile())
            self._seen = _libraries_loaded()

    def close(self) -> None:
        """Lift the limits."""
        self._stack.close()
        self._seen = -1


class _Library(ctypes.Structure):
    """The first fields of `dl_phdr_info` (dl_iterate_phdr(3))."""

    _fields_ = (
        ("address", ctypes.c_void_p),
        ("name", ctypes.c_char_p),
        ("headers", ctypes.c_void_p),
        ("n_headers", ctypes.c_uint16),
        ("loaded", ctypes.c_ulonglong),
    )


_Look = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.POINTER(_Library), ctypes.c_size_t, ctypes.c_void_p)


def _libraries_loaded() -> int:
    """How many libraries this process has loaded since its start: the dynamic linker counts them."""
    found: list[int] = []

    def look(library: Any, _size: int, _data: int | None) -> int:  # noqa: ANN401  a pointer of ctypes
        found.append(library.contents.loaded)
        return 1  # the first one is enough: the count is that of the process

    ctypes.CDLL(None).dl_iterate_phdr(_Look(look), None)
    return found[0]
