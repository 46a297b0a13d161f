"""The threads of many copies: each calls the FMUs of a part of them, from the first call to the last.

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
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from threading import Thread
from typing import Any

import numpy as np

from ..rings import native
from ..rings.host_memory import HostMemory
from ..rings.native import WorkKind
from ..system.memory_map import map_memory

__all__ = ["CopyThreads"]


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
        self._copies, self._work = copies, native.WorkTable(copies=ctypes.addressof(copies))
        places = [
            native.WorkerTable(own.place, memory.grant.address, done.address, ctypes.addressof(self._work), first, end)
            for own, done, (first, end) in zip(self._members, self._done, self.parts, strict=True)
        ]
        self._workers = native.table(native.WorkerTable, places)
        self._call: Callable[[], object] | None = None
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
        self._call = call
        self.work(WorkKind.HAND_OVER, size=thread)
        error, self._call, self._error = self._error, None, None
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
            call = self._call
            try:
                if call is not None:
                    call()
            except BaseException as error:  # noqa: BLE001  it is raised on the first thread
                self._error = error
            done.raise_to(done.value + 1)
            if call is None:
                return


def _in_turn(copies: Sequence[int], call: Callable[[int], object]) -> None:
    for number in copies:
        call(number)
