"""The other processes of this host: whether they run, and what they have open; a process in a sandbox asks outside.

A process in a sandbox sees no others. It asks its launcher, which answers at a socket that both have (ADR 84).
"""

from __future__ import annotations

import os
import signal
import socket
import threading
from errno import ENOENT
from pathlib import Path
from typing import Final

import msgspec

__all__ = [
    "OR_CUT",
    "STATES",
    "STOPPED",
    "Answered",
    "Asked",
    "ask_outside",
    "is_alive",
    "is_stopped",
    "opened_of",
    "own_pid",
]

STOPPED = "is stopped (state T)"
OR_CUT = ", or the link between it and the master is cut"
"""What a message says of such a process; see `is_stopped`."""


STATES: Final = ("gone", "running", "stopped")
_ANSWER_BYTES: Final = 1024

# Threads of a node in a sandbox ask its launcher one after another: the lock is held from a question to its answer, and
# the launcher answers whatever it is doing, on a thread of its own (ADR 84).
_outside: list[tuple[socket.socket, threading.Lock]] = []
"""To the launcher of a process in a sandbox, which sees no other processes; empty in others."""

_PF_EXITING = 0x4
_KILLED = 1 << (signal.SIGKILL - 1)
"""Bits of a process in /proc."""


class Asked(msgspec.Struct, frozen=True):
    """What a process in a sandbox asks its launcher: how a process is, and for the memory that it has open."""

    pid: int
    descriptor: int | None = None


class Answered(msgspec.Struct, frozen=True):
    """The process id of who asks, as others see it, and the state of the other one, of `STATES`."""

    own: int
    state: str


def ask_outside(descriptor: int) -> None:
    """From now on, ask for other processes at this socket: this one is in a sandbox (`fmu_mesh.run.sandbox`)."""
    _outside.append((socket.socket(fileno=descriptor), threading.Lock()))


def _told(asked: Asked) -> tuple[Answered, list[int]]:
    connection, lock = _outside[0]
    with lock:
        connection.send(msgspec.msgpack.encode(asked))
        data, descriptors, *_ = socket.recv_fds(connection, _ANSWER_BYTES, 1)
    return msgspec.msgpack.decode(data, type=Answered), descriptors


def own_pid() -> int:
    """The process id of this process, as others see it."""
    return _told(Asked(0))[0].own if _outside else os.getpid()


def opened_of(pid: int, descriptor: int) -> int:
    """A descriptor of the memory that another process has open.

    Raises:
        OSError: it cannot be opened from here: another host, or another user.
    """
    if not _outside:
        return os.open(f"/proc/{pid}/fd/{descriptor}", os.O_RDWR | os.O_CLOEXEC)
    for own in _told(Asked(pid, descriptor))[1]:
        os.set_inheritable(own, False)  # noqa: FBT003  it takes no keyword
        return own
    raise FileNotFoundError(ENOENT, "the launcher does not hand it out")


def is_alive(pid: int) -> bool:
    """Whether this process still runs; one that has ended, or is about to end because it was killed, does not."""
    if _outside:
        return _told(Asked(pid))[0].state != STATES[0]
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    try:
        # Its children are told that it was killed before its state says so.
        status = Path(f"/proc/{pid}/status").read_text(encoding="ascii", errors="replace")
        pending = int(status.partition("SigPnd:")[2].split()[0], 16)
        state, *_, flags = _stat(pid)[:7]
    except (OSError, IndexError, ValueError):  # it has ended meanwhile, or the system has no /proc
        return not Path("/proc/self/stat").exists()
    return state not in {"Z", "X"} and not int(flags) & _PF_EXITING and not pending & _KILLED


def is_stopped(pid: int) -> bool:
    """Whether a process is stopped by a signal, such as SIGSTOP or Ctrl-Z; False if it is gone."""
    if _outside:
        return _told(Asked(pid))[0].state == STATES[2]
    try:
        return _stat(pid)[0] == "T"
    except (OSError, IndexError):
        return False


def _stat(pid: int) -> list[str]:
    """The fields of a process in /proc from its state on (proc(5))."""
    return Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
