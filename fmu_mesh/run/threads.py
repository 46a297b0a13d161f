"""Numeric libraries use one thread in every process of a run.

With several threads, a library adds up in another order, so the last digits of a matrix product differ from host to
host. Processes that each use all processors would also hinder one another. This module imports nothing, because the
variables have to be set before numpy is imported.
"""

from __future__ import annotations

import os
import sys
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

    # That there are new ones is told by who loads them: imports of Python, and models. The dynamic linker counts them
    # as well (dl_iterate_phdr), but it calls back under its lock, and the callback would wait for the interpreter,
    # whose lock another thread has that waits for the linker, as `ctypes.CDLL` does.

    def __init__(self) -> None:
        self._stack = ExitStack()
        self._seen = -1, -1

    def limit(self, models: int) -> None:
        """Limit all libraries that are loaded by now, if there are new ones; ``models`` have been loaded so far."""
        if (len(sys.modules), models) != self._seen:
            self._stack.enter_context(one_thread_meanwhile())
            self._seen = len(sys.modules), models

    def close(self) -> None:
        """Lift the limits."""
        self._stack.close()
        self._seen = -1, -1
