"""Copies of a system on several threads: each steps a part of them, with a library of its own of each FMU.

Owns which thread has which copies. What a copy does is `fmu_mesh.run.copies`.
"""

# Threads (ADR 12, 82): each part has one thread, which makes all calls of its FMUs, from the first to the last. The
# thread that made this object gives all of them the same thing to do, and waits until all are done; so two calls never
# overlap, and nothing here is locked. FMUs are extracted for each part, so the variables of a library belong to one
# thread. What instances share beyond that, such as a library that several FMUs bring, or Python, is a claim on the
# process: then there is one part only.
#
# What changes a whole process (the working directory, umask) is looked after by the thread that waits, and while FMUs
# are opened or closed, one part follows the other: two threads that look after it at a time undo each other's work.

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import CallRefused, FmuMeshError
from ..instances.contract import LogMessage
from .copies import Copies, Truths
from .copy_pieces import Pieces
from .one_process import claims_in
from .run_plan import RunPlan
from .system_copy import Overrides, SavedCopy

__all__ = ["ThreadedCopies"]

T = TypeVar("T")


class ThreadedCopies:
    """As `Copies`, on so many ``threads``; arrays are those of all copies."""

    def __init__(self, run: RunPlan, count: int, folder: Path, log: Callable[[LogMessage], None], threads: int) -> None:
        claims_of = claims_in(run.plan)
        why = [reason for name in run.plan.system.instances for reason in claims_of(name)]
        if why:
            raise CallRefused(f"copies cannot be stepped by several threads, where {why[0]}", hint="Use one thread.")
        ends = np.linspace(0, count, threads + 1).astype(int).tolist()
        self._where = [slice(first, end) for first, end in pairwise(ends)]
        self._parts: list[Copies] = []
        for number, where in enumerate(self._where):
            (own := folder / f"thread{number}").mkdir()
            self._parts.append(Copies(run, where.stop - where.start, own, log))
        self._hosts = [ThreadPoolExecutor(1, f"copies {number}") for number in range(threads)]
        self._pieces = Pieces()

    def start(self, ready: Callable[[int], None] = lambda _count: None) -> None:
        """See `Copies`."""
        for host, part, where in self._each():
            host.submit(part.start, partial(_ready, ready, where.start)).result()
        if any(part.changes_process for part in self._parts):
            text = "copies cannot be stepped by several threads, because a step of an FMU may change the process"
            raise CallRefused(text, hint="Use one thread.")

    @property
    def points(self) -> NDArray[np.int64]:
        """See `Copies`."""
        return np.concatenate([part.points for part in self._parts])

    @property
    def ended(self) -> Truths:
        """See `Copies`."""
        return np.concatenate([part.ended for part in self._parts])

    @property
    def errors(self) -> dict[int, FmuMeshError]:
        """See `Copies`."""
        return {own.start + number: error for _, part, own in self._each() for number, error in part.errors.items()}

    def step(self, points: int, is_asked: Callable[[], bool] = lambda: False) -> None:
        """See `Copies`; all threads take a piece before one takes the next."""
        if self._pieces.step(points, is_asked, lambda piece: self._all(lambda part, _: part.step_piece(piece))):
            self._all(lambda part, _: part.take_care())

    def set(self, instance: str, name: str, values: NDArray[Any], wanted: Truths) -> None:
        """See `Copies`."""
        self._all(lambda part, own: part.set(instance, name, values[own], wanted[own]))

    def get(self, instance: str, names: Sequence[str], out: NDArray[Any]) -> None:
        """See `Copies`."""
        self._all(lambda part, own: part.get(instance, names, out[own]))

    @property
    def why_not_saved(self) -> str | None:
        """See `Copies`."""
        return self._parts[0].why_not_saved

    def save(self) -> list[SavedCopy]:
        """See `Copies`."""
        return [own for host, part, _ in self._each() for own in host.submit(part.save).result()]

    def restore(self, saved: Sequence[SavedCopy], wanted: Truths) -> None:
        """See `Copies`."""
        for host, part, own in self._each():
            host.submit(part.restore, saved[own], wanted[own]).result()

    def free(self, saved: Sequence[SavedCopy]) -> None:
        """See `Copies`."""
        for host, part, own in self._each():
            host.submit(part.free, saved[own]).result()

    def reset(self, wanted: Truths, overrides: Callable[[int], Overrides] | None = None) -> None:
        """See `Copies`."""
        for host, part, own in self._each():
            of_part = partial(_overrides, overrides, own.start) if overrides is not None else None
            host.submit(part.reset, wanted[own], of_part).result()

    def close(self) -> None:
        """See `Copies`."""
        for host, part, _ in self._each():
            with suppress(RuntimeError):  # the interpreter ends, and has ended the threads
                host.submit(part.close).result()
            host.shutdown()

    def _each(self) -> Sequence[tuple[ThreadPoolExecutor, Copies, slice]]:
        return list(zip(self._hosts, self._parts, self._where, strict=True))

    def _all(self, call: Callable[[Copies, slice], T]) -> list[T]:
        """Make a call for all parts at once; when all are done, raise what the first one has raised."""
        done = [host.submit(call, part, own) for host, part, own in self._each()]
        errors = [future.exception() for future in done]
        for error in errors:
            if error is not None:
                raise error
        return [future.result() for future in done]


def _ready(ready: Callable[[int], None], first: int, count: int) -> None:
    ready(first + count)


def _overrides(overrides: Callable[[int], Overrides], first: int, number: int) -> Overrides:
    return overrides(first + number)
