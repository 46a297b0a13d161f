"""Memory with the rings and counters of a run: shared by the processes of one host, or private to one process.

Shared memory is anonymous: the master makes it, and other processes of the same user open it through `/proc`.
"""

from __future__ import annotations

import ctypes
import fcntl
import mmap
import os
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Final, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..system.memory_map import MemoryMap, RingPlace
from . import native
from .ring import Ring

__all__ = ["ONE_CORE", "Counter", "HostMemory", "Offer", "Wish", "can_share"]

# Processes: the master makes the memory; nodes and the recorder open it; each is one participant with a number and a
# bell. Threads: the one that sleeps (of a node its main thread) may use everything here; any other thread of the
# process may only read counters and call `ring_bell`. A counter has one thread that raises it.
#
# What may go wrong, and what then happens:
# * A participant is killed, anywhere. The kernel frees the memory with its last user, because there is no file; who
#   slept for the dead one wakes up by the limit of its sleep and looks again (docs/rings.md has the cases).
# * An offer reaches a process that cannot mean the same memory: on another host, in a container with process ids of
#   its own, as another user. Then /proc/<pid>/fd is not there, or leads elsewhere: the size, the seals and the token
#   are compared, and the process gets frames instead.
# * Somebody shrinks the memory: each access would be SIGBUS. So it is sealed, and memory without the seal is not
#   opened.
# * The library is missing. Python has no acquire and release, so nothing is shared then: `private` memory has a
#   condition in the place of the bell, and values of numpy in the place of atomic ones.
#
# Tried and given up: a file in /dev/shm (left behind by a killed process), the shared memory of Zenoh (it keeps
# sockets and threads, and waking those is what takes the time), one buffer of messages for each sender, with
# semaphores (ADR 5). Now: ADR 58.

_NAME: Final = "fmu_mesh"
_TOKEN_BYTES: Final = 16
_ZERO: Final = bytes(8)
_LINE: Final = 64
_PRIVATE: Final = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS

ONE_CORE: Final = not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) == 1
"""Whether the process that somebody waits for cannot run meanwhile."""

Wish = tuple["Counter", int]
"""A counter, and the value that somebody waits for."""


class Offer(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where shared memory is: a process that has it open, its descriptor there, and its first bytes in hexadecimal."""

    pid: int
    descriptor: int
    token: str


def can_share() -> bool:
    """Whether processes can share memory here: Linux, and the library with the burst."""
    return native.library is not None and hasattr(os, "memfd_create") and Path("/proc/self/fd").is_dir()


class HostMemory:
    """One piece of memory, as one participant uses it.

    Make it with `create`, `opened` or `private`.
    """

    def __init__(
        self, memory: mmap.mmap | memoryview, map_: MemoryMap, process: str, descriptor: int | None = None
    ) -> None:
        self.map = map_
        self._memory = memory
        self._descriptor = descriptor
        self._view = memoryview(memory)
        self.address = ctypes.addressof(ctypes.c_char.from_buffer(memory))
        number = map_.number_of(process)
        self.place = native.Participant(self.address + map_.bells, len(map_.processes), number)
        self.grant, self.sent, self.finish = map(self.counter, (map_.grant, map_.sent, map_.finish))
        self.progress = {
            name: self.counter(offset) for name, offset in zip(map_.processes, map_.progress, strict=False)
        }
        self._beside = self._view[map_.size :]
        self._lock = threading.Condition()
        self._rung = False

    @classmethod
    def create(cls, map_: MemoryMap, process: str) -> Self:
        """Make shared memory.

        Raises:
            OSError: the system has none.
        """
        descriptor = os.memfd_create(_NAME, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(descriptor, map_.size)
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
        memory = mmap.mmap(descriptor, map_.size, mmap.MAP_SHARED)
        memory[:_TOKEN_BYTES] = secrets.token_bytes(_TOKEN_BYTES)
        made = cls(memory, map_, process, descriptor)
        made._prepare()
        return made

    @classmethod
    def private(cls, map_: MemoryMap, process: str, room: memoryview | None = None) -> Self:
        """Make memory for this process alone, in a room of zeros if there is one; untouched pages take no space."""
        made = cls(mmap.mmap(-1, map_.size, _PRIVATE) if room is None else room, map_, process)
        made._prepare()
        return made

    @staticmethod
    def rooms(map_: MemoryMap, count: int, beside: int) -> list[memoryview]:
        """Rooms for so many memories with one map, side by side, with so many bytes for `beside`.

        With pages of their own, the same counter of all would be in the same few lines of the processor's caches. The
        distance of two is an odd number of lines, so that they use all of these.
        """
        size = (-(-(map_.size + beside) // _LINE) | 1) * _LINE
        memory = memoryview(mmap.mmap(-1, count * size, _PRIVATE))
        return [memory[first : first + size] for first in range(0, count * size, size)]

    @classmethod
    def opened(cls, offer: Offer, map_: MemoryMap, process: str, open_: Callable[[int, int], int]) -> Self | None:
        """The memory of an offer; None if it cannot be reached from here: another host, or another user.

        ``open_`` opens a descriptor of another process.
        """
        if not can_share():
            return None
        try:
            descriptor = open_(offer.pid, offer.descriptor)
        except OSError:
            return None
        try:
            if os.fstat(descriptor).st_size != map_.size:
                return None
            seals = fcntl.fcntl(descriptor, fcntl.F_GET_SEALS)
            memory = mmap.mmap(descriptor, map_.size, mmap.MAP_SHARED)
            if not seals & fcntl.F_SEAL_SHRINK or memory[:_TOKEN_BYTES].hex() != offer.token:
                return None
            return cls(memory, map_, process, os.dup(descriptor))
        except OSError:
            return None
        finally:
            os.close(descriptor)

    @property
    def offer(self) -> Offer:
        """Where others find this shared memory."""
        assert self._descriptor is not None
        return Offer(os.getpid(), self._descriptor, self._memory[:_TOKEN_BYTES].hex())

    @property
    def path(self) -> Path | None:
        """Where a child of this process finds this memory; None if it is private."""
        return Path(f"/proc/{os.getpid()}/fd/{self._descriptor}") if self._descriptor is not None else None

    def participant(self, process: str) -> HostMemory:
        """The same memory for another participant of this process."""
        return HostMemory(self._memory, self.map, process)

    def counter(self, offset: int) -> Counter:
        """The counter at an offset."""
        return Counter(self, offset)

    def number(self, offset: int) -> NDArray[np.int64]:
        """The eight bytes at an offset."""
        return np.frombuffer(self._memory, np.int64, 1, offset)

    def ring(self, place: RingPlace) -> Ring:
        """The ring of an instance; text is beside it, in this process."""
        return Ring(place.layout, place.rows, self._view[place.offset :])

    def beside(self, size: int) -> memoryview:
        """Zeros for a table or a row that nobody shares: in the room of this memory, while there is some left."""
        size = -(-size // _LINE) * _LINE
        if size > len(self._beside):
            return memoryview(bytearray(size))
        taken, self._beside = self._beside[:size], self._beside[size:]
        return taken

    def withdraw_grant(self) -> int:
        """Of shared memory: take the grant back, and return a point that no node passes before the next grant."""
        assert native.library is not None
        nodes = (ctypes.c_void_p * len(self.progress))(*(counter.address for counter in self.progress.values()))
        return int(native.library.grant_withdraw(self.grant.address, nodes, len(nodes)))

    # --- waiting

    def seen(self) -> int:
        """What `sleep` needs: ask for it, then look for reasons to stay awake, then sleep."""
        if native.library is not None:
            return int(native.library.bell_seen(ctypes.byref(self.place)))
        with self._lock:
            self._rung = False
        return 0

    def sleep(self, seen: int, timeout_s: float, wishes: Sequence[Wish] = ()) -> None:
        """Wait until a wish is granted, the bell of this participant was rung since ``seen``, or the time is over."""
        if native.library is not None:
            items = native.table(native.Wish, [native.Wish(counter.address, need) for counter, need in wishes])
            limit_ns = max(0, int(timeout_s * 1e9))
            native.library.sleep_for(ctypes.byref(self.place), seen, items, len(wishes), limit_ns, None)
            return
        end = time.monotonic() + timeout_s
        with self._lock:
            while not self._rung and not any(counter.value >= need for counter, need in wishes):
                left = end - time.monotonic()
                if left <= 0 or not self._lock.wait(left):
                    return

    def ring_bell(self) -> None:
        """From any thread: wake this participant."""
        if native.library is not None:
            native.library.ring_bell(self.place.bells + 64 * self.place.own)
            return
        with self._lock:
            self._rung = True
            self._lock.notify_all()

    def begin_at(self, point: int, rings: Iterable[RingPlace]) -> None:
        """The run begins at this point: of all before it, everything is known, and nothing is waited for."""
        for place in rings:
            for counter in (place.counter, place.text_counter):
                self.counter(counter).raise_to(point // place.step_points)
        for progress in self.progress.values():
            progress.raise_to(point)

    def begin_again(self) -> None:
        """Of private memory: all counters are 0, as at the start; the rings have their rows."""
        for counter in (self.map.grant, self.map.sent, self.map.finish, *self.map.progress, *self.map.rings):
            self._view[counter : counter + 8] = _ZERO
            self._view[counter + 16 : counter + 24] = _ZERO  # what is claimed

    def close(self) -> None:
        """Close the descriptor: from now on no other process can open this memory."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def _prepare(self) -> None:
        """Nobody sleeps: no counter wakes anybody."""
        for counter in (self.map.grant, self.map.sent, self.map.finish, *self.map.progress, *self.map.rings):
            self.number(counter + 8)[:] = native.NEVER


class Counter:
    """A number in a `HostMemory` that has one writer and only grows; only a pause lowers the grant."""

    def __init__(self, memory: HostMemory, offset: int) -> None:
        self.address = memory.address + offset
        self._memory = memory
        self._plain = memory.number(offset)

    @property
    def value(self) -> int:
        """The number; what its writer wrote before it can be read."""
        if native.library is not None:
            return int(native.library.counter_value(self.address))
        return int(self._plain[0])

    def raise_to(self, value: int) -> None:
        """Set the number, and wake who waits for it."""
        if native.library is not None:
            native.library.counter_raise(ctypes.byref(self._memory.place), self.address, value)
        else:
            self._plain[0] = value
