"""How calls for many copies are divided: among threads, of which each has a part of the copies, and into pieces.

Owns which thread has which copies, and how a call is given to all of them. What a copy does is `fmu_mesh.run.copies`.
"""

# Threads (ADR 12, 82): the first is the one that made the copies. It gives all others the same thing to do, does its
# own part, and waits until all are done; so two calls never overlap, and nothing here is locked. The others are in
# `copies_serve` of the library, without the lock of the interpreter: awake for some 50 us after a call, because the
# next one often follows at once, and then asleep. What Python has to do on one of them is handed over by the same
# counters: that thread leaves the library, and the first one waits meanwhile. So one part follows the other while FMUs
# are opened or closed, and what changes a whole process (the working directory, umask) is changed by one thread.
#
# Tried and given up: a `ThreadPoolExecutor` for each part. A call woke two threads, and each then waited for the lock
# of the interpreter: 75 us a call, which is more than to set or to read 1,024 copies.
#
# The others are daemons: at its end, the interpreter would wait for them before it closes a batch that was left open.

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from threading import Thread
from typing import Any, Final

import numpy as np

from ..instances.process_state import ProcessState
from ..node.engine import STATE_CHECK_S
from ..rings import native
from ..rings.host_memory import HostMemory
from ..rings.native import WorkKind
from ..system.memory_map import map_memory

__all__ = ["CopyThreads", "Pieces"]

_PIECE_S: Final = 0.05
"""About how long in s a piece takes: then somebody may end the call."""

_MANY_POINTS: Final = 4096


@native.declared("Work")
class WorkTable(native.Changed):
    """What is done with many copies."""


@native.declared("Worker")
class WorkerTable(ctypes.Structure):
    """A thread of copies."""


class CopyThreads:
    """So many threads for copies; without the library there is one.

    Args:
        copies: the tables of all copies.
        threads: how many.

    Attributes:
        parts: the first copy of each thread, and the one after its last.
    """

    def __init__(self, copies: Any, threads: int) -> None:  # noqa: ANN401  an array of ctypes
        threads = 1 if native.library is None else threads
        self.parts = list(pairwise(np.linspace(0, len(copies), threads + 1).astype(int).tolist()))
        names = [f"thread {number}" for number in range(threads)]
        map_ = map_memory(names, {})[0]
        memory = HostMemory.private(map_, names[0])
        self._members = [memory.participant(name) for name in names]
        self._done = [memory.progress[name] for name in names]
        self._copies, self._work = copies, WorkTable(copies=ctypes.addressof(copies))
        places = [
            WorkerTable(own.place, memory.grant.address, done.address, ctypes.addressof(self._work), first, end)
            for own, done, (first, end) in zip(self._members, self._done, self.parts, strict=True)
        ]
        self._workers = native.table(WorkerTable, places)
        self._handed_over: list[Callable[[], object]] = []
        self._error: BaseException | None = None
        self._others = [Thread(target=self._serve, args=[number], daemon=True) for number in range(1, threads)]
        for thread in self._others:
            thread.start()

    def part_of(self, copy: int) -> int:
        """The thread of a copy, by its number."""
        return next(number for number, (_, end) in enumerate(self.parts) if copy < end)

    def work(self, kind: WorkKind, **given: int | None) -> int:
        """Let the library do the same with all copies; how many of them need Python then.

        Args:
            kind: what.
            given: fields of `Work` in `burst.h`; those that are not given are as in the call before.
        """
        assert native.library is not None
        self._work.note(kind=kind, **given)
        return int(native.library.copies_work(ctypes.addressof(self._workers), len(self.parts)))

    def each(self, copies: Sequence[int], call: Callable[[int], object]) -> None:
        """Make a call for each of these copies on its thread, one after another, in ascending order.

        What one of them raises ends this.
        """
        for thread, (first, end) in enumerate(self.parts):
            own = copies if len(self.parts) == 1 else [number for number in copies if first <= number < end]
            if len(own):
                self.on(thread, partial(_in_turn, own, call))

    def on(self, thread: int, call: Callable[[], object]) -> None:
        """Make a call on a thread, and raise what it raises."""
        if thread == 0:
            call()
            return
        self._handed_over.append(call)
        self.work(WorkKind.HAND_OVER, size=thread)
        error, self._error = self._error, None
        if error is not None:
            raise error

    def close(self) -> None:
        """End all threads but the first. From any thread, when no call is under way; may be called twice."""
        while self._others:
            self.work(WorkKind.HAND_OVER, size=len(self._others))  # without a call
            self._others.pop().join()
            self.parts.pop()

    def _serve(self, number: int) -> None:
        assert native.library is not None
        own, done = ctypes.addressof(self._workers[number]), self._done[number]
        while True:
            native.library.copies_serve(own)
            goes_on = bool(self._handed_over)
            try:
                if goes_on:
                    self._handed_over.pop()()
            except BaseException as error:  # noqa: BLE001  it is raised on the first thread
                self._error = error
            done.raise_to(done.value + 1)
            if not goes_on:
                return


def _in_turn(copies: Sequence[int], call: Callable[[int], object]) -> None:
    for number in copies:
        call(number)


class Pieces:
    """Takes long calls in pieces of about 50 ms, and looks after the state of the process after them."""

    def __init__(self) -> None:
        self._points = 1
        self._looked_after: ProcessState | None = None
        self._look_at = 0.0

    def step(self, points: int, is_asked: Callable[[], bool], take: Callable[[int], object]) -> bool:
        """Take a step over so many points; whether it has changed the state of the process, which is restored."""
        self._looked_after = self._looked_after or ProcessState()
        try:
            self.take(points, is_asked, take)
        finally:
            is_changed = False
            if (now := time.perf_counter()) >= self._look_at:
                self._look_at = now + STATE_CHECK_S
                is_changed = self._looked_after.restore()
        return is_changed

    def take(self, points: int, is_asked: Callable[[], bool], take: Callable[[int], object]) -> None:
        """Take a step over so many points in pieces, which change nothing of this process."""
        while points > 0 and not is_asked():
            piece, began = min(points, self._points), time.perf_counter()
            take(piece)
            points -= piece
            took_s = time.perf_counter() - began
            if took_s < _PIECE_S / 2 and piece == self._points:
                self._points = min(2 * piece, _MANY_POINTS)
            elif took_s > _PIECE_S:
                self._points = max(1, self._points // 2)
