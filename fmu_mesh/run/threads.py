"""Numeric libraries use one thread in every process of a run.

With several threads, a library adds up in another order, so the last digits of a matrix product differ from host to
host. Processes that each use all processors would also hinder one another. This module imports nothing, because the
variables have to be set before numpy is imported.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

__all__ = ["ONE_THREAD", "one_thread_from_now_on", "one_thread_meanwhile"]

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


@contextmanager
def one_thread_meanwhile() -> Iterator[None]:
    """In the block, let the libraries that this process has loaded use one thread."""
    from threadpoolctl import threadpool_limits  # noqa: PLC0415 it takes 10 ms, and only a run in this process needs it

    with threadpool_limits(1):
        yield
