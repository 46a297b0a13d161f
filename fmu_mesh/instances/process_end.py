"""The end of a process that ends with its run: what an FMU does then is a warning, not a failure.

An FMU may have left a thread or a timer that needs its library, and it may crash in its last functions or call `exit`.
So such a process unloads no library, and leaves without the destructors of libraries. Whoever closes an instance inside
`surviving` is told of a crash, and ends the process in order, on another thread.

A handler of Python's `signal` would run after the call into the FMU, and a crash never returns. So the handler is a C
function that ctypes makes. It runs Python on the thread that has crashed, and this thread never leaves it. A runtime
that an FMU brings may have handlers of its own and need them, as that of Java does: these stay.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Final

__all__ = ["end_process", "ends_with_run", "process_ends", "surviving"]

# Who meets here: the thread that closes an instance; threads and timers that the FMU has left, which may crash while
# the other one closes; the watching thread of `call_guard`, which reports and ends the process; and forks of the FMU.
# ADR 12.
#
# A crash is a signal on the thread that crashes, perhaps with a damaged stack and with locks that are held. `on_crash`
# runs on that thread, so it only notes what happened and wakes the watching thread. Then the thread waits for ever: to
# return from a SIGSEGV would run the same instruction again.
#
# `exit` is no signal. It calls what `__cxa_atexit` has registered last, so it is told (with the number 0) before the
# destructors of the libraries. That is taken back before Python finalizes itself, because nothing of Python can be
# called after that.
#
# Only a default handler is replaced, and only while an instance is closing: a virtual machine in the FMU needs its own
# handler of SIGSEGV to run at all, and a crash at any other time has to be one.
#
# Given up: a handler of `signal.signal`, which Python runs between two of its own instructions, and a call that has
# crashed never returns to them; and to unload the library in a process that ends anyway, which crashed FMUs with
# threads.

_SIGNALS: Final = (signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGABRT)
_ACTION_BYTES: Final = 512
"""More than the size of `struct sigaction` on any platform; the handler is its first field."""

_libc = ctypes.CDLL(None)
_exit_codes: list[Callable[[], int]] = []
"""Returns the exit code of this process; empty if the process goes on after its runs."""

_closing: dict[int, tuple[int, Callable[[str], None]]] = {}
"""By the identifier of the thread that closes an instance: the process, and what is called after a crash."""


_handled: set[int] = set()
"""The signals that have the handler of this module."""


def ends_with_run(exit_code: Callable[[], int]) -> None:
    """Note that this process ends with its run, and with the code that ``exit_code`` returns then."""
    _exit_codes.append(exit_code)


def process_ends() -> bool:
    """Whether this process ends with its run."""
    return bool(_exit_codes)


def end_process() -> None:
    """From any thread: end this process with its exit code, without any destructor."""
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(_exit_codes[-1]())


@contextmanager
def surviving(on_crash: Callable[[str], None]) -> Iterator[None]:
    """Inside, a crash or `exit` of an FMU calls ``on_crash`` with its name, on the thread that never goes on.

    It must not do more than wake another thread: `exit` has destroyed what other libraries keep for this one.
    """
    _handle_exit()
    for number in _SIGNALS:
        action = ctypes.create_string_buffer(_ACTION_BYTES)
        _libc.sigaction(number, _own_action(), action)  # one call of the system for most, and not two
        if ctypes.c_void_p.from_buffer(action).value is None:  # the default
            _handled.add(number)
        elif number not in _handled:
            _libc.sigaction(number, action, None)
    thread = threading.get_ident()
    before = _closing.get(thread)  # who looks after all calls looks after the others again
    _closing[thread] = os.getpid(), on_crash
    try:
        yield
    finally:
        del _closing[thread]
        if before is not None:
            _closing[thread] = before
        while _handled and not _closing:
            _libc.signal(_handled.pop(), None)


def _crashed(number: int) -> None:
    """Called by the C library at a signal, and with 0 in `exit`."""
    closing = _closing.get(threading.get_ident()) or next(iter(_closing.values()), None)
    if closing is None:  # another call than the last one: a crash comes again, and is one
        if number:
            _libc.signal(number, None)
        return
    process, on_crash = closing
    if process != os.getpid():  # the FMU has forked it
        os._exit(128 + number)
    on_crash(signal.Signals(number).name if number else "exit")
    threading.Event().wait()


_handler = ctypes.CFUNCTYPE(None, ctypes.c_int)(_crashed)


@cache
def _own_action() -> ctypes.Array[ctypes.c_char]:
    """The `struct sigaction` of the handler, as `signal` of the C library fills it in."""
    action, before = (ctypes.create_string_buffer(_ACTION_BYTES) for _ in range(2))
    _libc.sigaction(signal.SIGFPE, None, before)
    _libc.signal(signal.SIGFPE, _handler)
    _libc.sigaction(signal.SIGFPE, before, action)
    return action


@cache
def _handle_exit() -> None:
    """Call the handler in `exit`, which glibc offers to other languages than C++ by no other name."""
    _libc["__cxa_atexit"](_handler, None, _handler)
    atexit.register(_libc["__cxa_finalize"], _handler)  # not after Python has finalized itself
