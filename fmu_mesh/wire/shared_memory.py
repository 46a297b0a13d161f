"""Messages between processes of one host through shared memory: bounded buffers, and a semaphore to wait for.

A receiver owns anonymous memory with one buffer for each of its senders. An `Offer` contains its process id and file
descriptor, with which processes of the same user can open it; a random token proves that it is the same host. There is
no file, so nothing is left behind if a process is killed.

Each buffer is Dijkstra's bounded buffer: the semaphore ``items`` counts messages that are written, ``spaces`` messages
that are read. These semaphores determine the order of all memory accesses between processes, on every processor. The
receiver waits on one more semaphore, the doorbell, which a sender posts after every message.
"""

from __future__ import annotations

import ctypes
import fcntl
import mmap
import os
import secrets
import struct
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import msgspec

from ..errors import DeadlineExceeded, FmuMeshError
from .messages import ABORT, MAX_MESSAGE_SIZE
from .runtime import is_alive

__all__ = ["Arrived", "Offer", "SharedInbox", "SharedOutlet", "available"]

Arrived = tuple[str, bytes]
"""The sender of a message, and the message."""

_NAME: Final = "fmu_mesh"
_ABORT: Final = bytes((ABORT,))
_TOKEN_SIZE: Final = 16
_DOORBELL: Final = 64
_CHANNELS: Final = 128
_ITEMS: Final = 0
_SPACES: Final = 64
_DATA: Final = 128
_MIN_SIZE: Final = 64 * 1024
_MAX_SIZE: Final = 16 * 2**20
_AT_ONCE_SIZE: Final = 16 * 2**20
"""Up to this size all pages are allocated when the memory is created, so that the first write to a page is fast."""

_LENGTH: Final = struct.Struct("<I")
_MORE: Final = 1 << 31
"""Set in the length of a record if the message continues in the next record, because it is too long for one."""

_LOOK_S: Final = 0.05
_SPIN_S: Final = 50e-6
"""How long in s a receiver polls before it sleeps: about the time that a wake-up on another core takes."""

_PATIENCE: Final = 3
_REST: Final = 30
_ONE_CORE: Final = not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) == 1


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


def _functions() -> tuple[Any, Any, Any, Any] | None:
    """sem_init, sem_post, sem_trywait and sem_clockwait; None if the C library does not have all of them.

    Functions that cannot block keep the interpreter's lock: releasing it takes longer than the call.
    """
    quick, slow = ctypes.PyDLL(None), ctypes.CDLL(None)
    if not hasattr(slow, "sem_clockwait"):
        return None
    return quick.sem_init, quick.sem_post, quick.sem_trywait, slow.sem_clockwait


_SEMAPHORES: Final = _functions()


def available() -> bool:
    """Whether this system supports shared memory: Linux, and a C library with `sem_clockwait` (glibc 2.30)."""
    return _SEMAPHORES is not None and hasattr(os, "memfd_create") and Path("/proc/self/fd").is_dir()


class Offer(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where the memory of a receiver is.

    Attributes:
        pid: the process that has the memory open.
        descriptor: its file descriptor there.
        token: hexadecimal; the first bytes of the memory.
        size: total size in bytes.
        channels: (offset, bytes of data) of the buffer of each sender.
    """

    pid: int
    descriptor: int
    token: str
    size: int
    channels: dict[str, tuple[int, int]]


class _Memory:
    """A mapping and its address; it exists as long as an object refers to it."""

    def __init__(self, descriptor: int, size: int) -> None:
        populate = getattr(mmap, "MAP_POPULATE", 0) if size <= _AT_ONCE_SIZE else 0
        self.map = mmap.mmap(descriptor, size, mmap.MAP_SHARED | populate)
        self.view = memoryview(self.map)
        self.address = ctypes.addressof(ctypes.c_char.from_buffer(self.map))

    def semaphore(self, offset: int) -> ctypes.c_void_p:
        return ctypes.c_void_p(self.address + offset)


class SharedInbox:
    """The receiving end: all messages to one process; messages of one sender keep their order.

    Args:
        senders: size of the buffer in bytes, by sender; a sender waits when its buffer is full.
        spins: whether to poll for a moment before sleeping, for receivers whose delay slows down the mesh.

    Raises:
        OSError: the system has no memory.

    One thread receives; `wake` may be called by any thread.
    """

    def __init__(self, senders: Mapping[str, int], *, spins: bool = True) -> None:
        assert _SEMAPHORES is not None
        init, post, self._trywait, self._clockwait = _SEMAPHORES
        channels: dict[str, tuple[int, int]] = {}
        end = _CHANNELS
        for sender, wanted in senders.items():
            size = -(-min(max(wanted, _MIN_SIZE), _MAX_SIZE) // 64) * 64
            channels[sender] = (end, size)
            end += _DATA + size
        token = secrets.token_bytes(_TOKEN_SIZE)
        self._descriptor = os.memfd_create(_NAME, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(self._descriptor, end)
        # A sender cannot shrink the memory of the others.
        fcntl.fcntl(self._descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
        self._memory = memory = _Memory(self._descriptor, end)
        memory.view[:_TOKEN_SIZE] = token
        self._doorbell = memory.semaphore(_DOORBELL)
        for offset in (_DOORBELL, *(start + part for start, _ in channels.values() for part in (_ITEMS, _SPACES))):
            init(memory.semaphore(offset), 1, 0)
        self._channels = [_Incoming(memory, sender, *place) for sender, place in channels.items()]
        self._arrived: deque[Arrived] = deque()
        self._post = post
        self.offer = Offer(os.getpid(), self._descriptor, token.hex(), end, channels)
        self._woken = False
        self._spins = spins and not _ONE_CORE
        self._patience = 0

    def take(self) -> Arrived | None:
        """The next message if one is there."""
        if not self._arrived and self._trywait(self._doorbell) == 0:
            self._collect()
        return self._arrived.popleft() if self._arrived else None

    def take_within(self, timeout_s: float) -> Arrived | None:
        """The next message; None after ``timeout_s`` seconds or a `wake`."""
        arrived = self._arrived
        if arrived:
            return arrived.popleft()
        until = None
        while not arrived and not self._woken:
            if self._trywait(self._doorbell) != 0:
                # The doorbell may be posted for a message that was already taken; then wait again.
                until = until or _after(timeout_s)
                if (
                    not self._rings_soon()
                    and self._clockwait(self._doorbell, time.CLOCK_MONOTONIC, ctypes.byref(until)) != 0
                ):
                    return None
            self._collect()
        self._woken = False
        return arrived.popleft() if arrived else None

    def stash(self) -> bool:
        """Make space for senders to this process, while it waits for space itself; return whether the run is over."""
        if self._trywait(self._doorbell) == 0:
            self._collect()
            # The messages that were taken here must not wait until the next doorbell.
            self._post(self._doorbell)
        return any(message[:1] == _ABORT for _, message in self._arrived)

    def wake(self) -> None:
        """From any thread: let `take_within` return."""
        self._woken = True
        self._post(self._doorbell)

    def close(self) -> None:
        """From now on no sender can open the memory; it is freed when the last sender has closed it."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _rings_soon(self) -> bool:
        """Poll for a moment, if polling was successful recently.

        If it was not, other processes may need the processor: then the next waits do not poll.
        """
        if not self._spins:
            return False
        if self._patience < 0:
            self._patience += 1
            return False
        trywait, doorbell = self._trywait, self._doorbell
        end = time.perf_counter() + _SPIN_S
        while time.perf_counter() < end:
            if trywait(doorbell) == 0:
                self._patience = min(self._patience + 1, _PATIENCE)
                return True
        self._patience = self._patience - 1 if self._patience else -_REST
        return False

    def _collect(self) -> None:
        """Take all messages; the doorbell was posted for at least one of them."""
        while self._trywait(self._doorbell) == 0:
            continue
        arrived = self._arrived
        for channel in self._channels:
            channel.collect(arrived)


class _Incoming:
    """The reader of one buffer."""

    def __init__(self, memory: _Memory, sender: str, offset: int, size: int) -> None:
        assert _SEMAPHORES is not None
        _, self._post, self._trywait, _ = _SEMAPHORES
        self._memory = memory
        self._sender = sender
        self._items = memory.semaphore(offset + _ITEMS)
        self._spaces = memory.semaphore(offset + _SPACES)
        self._data = memory.view[offset + _DATA : offset + _DATA + size]
        self._size = size
        self._read = 0
        self._parts: list[bytes] = []

    def collect(self, arrived: deque[Arrived]) -> None:
        """Append all messages that are written."""
        trywait, items, size, data = self._trywait, self._items, self._size, self._data
        while trywait(items) == 0:
            (length,) = _LENGTH.unpack_from(data, self._read)
            more, length = length & _MORE, length & ~_MORE
            start = self._read + 4
            end = start + length
            message = bytes(data[start:end])
            if end > size:
                message += bytes(data[: end - size])
            self._read = (self._read + _space(length)) % size
            self._post(self._spaces)
            if more or self._parts:
                self._parts.append(message)
                if more:
                    continue
                message = b"".join(self._parts)
                self._parts.clear()
            arrived.append((self._sender, message))


class SharedOutlet:
    """The sending end of one buffer; only one process and one thread at a time may use it.

    Args:
        offer: where the memory of the receiver is.
        sender: which of its buffers is ours.
        target: who the receiver is, for errors.
        own: the sender's own inbox, if it has one. It is read while this buffer is full, so that two processes that
            send to each other do not block each other.
        deadline_s: how long to wait for space, in s.
    """

    def __init__(
        self, offer: Offer, sender: str, target: str, own: Callable[[], bool] | None, deadline_s: float
    ) -> None:
        assert _SEMAPHORES is not None
        _, self._post, self._trywait, self._clockwait = _SEMAPHORES
        offset, size = offer.channels[sender]
        if offset % 64 or size % 64 or not (_CHANNELS <= offset < offset + _DATA + size <= offer.size):
            msg = f"the buffer of '{sender}' does not lie in the memory of {target}"
            raise ValueError(msg)
        self._memory = memory = _open(offer)
        self._doorbell = memory.semaphore(_DOORBELL)
        self._items = memory.semaphore(offset + _ITEMS)
        self._spaces = memory.semaphore(offset + _SPACES)
        self._data = memory.view[offset + _DATA : offset + _DATA + size]
        self._size = self._free = size
        self._written = 0
        self._sent: deque[int] = deque()
        self._pid = offer.pid
        self._target = target
        self._own = own
        self._deadline_s = deadline_s

    @classmethod
    def open(
        cls, offer: Offer | None, sender: str, target: str, own: Callable[[], bool] | None, deadline_s: float
    ) -> SharedOutlet | None:
        """The sending end, or None if the offer's memory cannot be reached from here: another host, or another user."""
        if offer is None or not available() or sender not in offer.channels:
            return None
        try:
            return cls(offer, sender, target, own, deadline_s)
        except (OSError, ValueError):
            return None

    def put(self, message: bytes) -> None:
        """Send a message.

        Raises:
            DeadlineExceeded: the receiver does not read.
            FmuMeshError: the message is larger than the limit.
        """
        size = len(message)
        if size <= self._size // 4:
            self._write(message, size)
            return
        if size > MAX_MESSAGE_SIZE:
            raise FmuMeshError(f"a message of {size} bytes for {self._target} is larger than {MAX_MESSAGE_SIZE} bytes")
        view, part = memoryview(message), self._size // 4
        for first in range(0, size, part):
            piece = view[first : first + part]
            self._write(piece, len(piece) | (_MORE if first + part < size else 0))

    def _write(self, piece: bytes | memoryview, length: int) -> None:
        needed = _space(len(piece))
        if self._free < needed and not self._make_room(needed):
            return
        data, size = self._data, self._size
        _LENGTH.pack_into(data, self._written, length)
        start = self._written + 4
        end = start + len(piece)
        if end <= size:
            data[start:end] = piece
        else:
            data[start:size] = piece[: size - start]
            data[: end - size] = piece[size - start :]
        self._written = (self._written + needed) % size
        self._free -= needed
        self._sent.append(needed)
        self._post(self._items)
        self._post(self._doorbell)

    def _make_room(self, needed: int) -> bool:
        """Wait until the receiver has read enough; return False if no process reads any more.

        Raises:
            DeadlineExceeded: it has read nothing for as long as a step may take.
        """
        started = time.monotonic()
        while True:
            while self._sent and self._trywait(self._spaces) == 0:
                self._free += self._sent.popleft()
                started = time.monotonic()
            if self._free >= needed:
                return True
            if self._clockwait(self._spaces, time.CLOCK_MONOTONIC, ctypes.byref(_after(_LOOK_S))) == 0:
                self._free += self._sent.popleft()
            elif (self._own is not None and self._own()) or not is_alive(self._pid):
                return False
            elif time.monotonic() - started > self._deadline_s:
                raise DeadlineExceeded(f"{self._target} has taken no message for {self._deadline_s:g} s")


def _after(seconds: float) -> _Timespec:
    """The time after this number of seconds, for `sem_clockwait`."""
    end = time.monotonic() + seconds
    return _Timespec(int(end), int(end % 1.0 * 1e9))


def _space(length: int) -> int:
    """Size of a record in bytes: length word and message, a multiple of 8, so that a length word is never divided."""
    return (length + 11) & ~7


def _open(offer: Offer) -> _Memory:
    """Map the memory of an offer.

    Raises:
        OSError: it cannot be opened from here.
        ValueError: it is not the memory that was offered.
    """
    path = Path(f"/proc/{offer.pid}/fd/{offer.descriptor}")
    if not str(path.readlink()).startswith(f"/memfd:{_NAME}"):  # opening a device may have side effects
        msg = f"descriptor {offer.descriptor} of process {offer.pid} is no such memory"
        raise ValueError(msg)
    descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    try:
        if os.fstat(descriptor).st_size != offer.size or os.pread(descriptor, _TOKEN_SIZE, 0).hex() != offer.token:
            msg = f"descriptor {offer.descriptor} of process {offer.pid} is something else"
            raise ValueError(msg)
        return _Memory(descriptor, offer.size)
    finally:
        os.close(descriptor)
