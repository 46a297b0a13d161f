"""The state of a process that its FMUs could change: folder, locale, signals, umask, environment, floating-point mode.

Owns what is looked at and how it is restored. Who looks when is `call_guard` and those who take many steps.
"""

from __future__ import annotations

import ctypes
import itertools
import locale
import os
import signal
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Final, NamedTuple, TypeVar

__all__ = [
    "FOLDER",
    "LOOK_STEPS",
    "ProcessState",
    "floating_point_changed",
    "in_kept_mode",
    "kept_mode",
    "kept_state",
    "restore_floating_point",
]

Result = TypeVar("Result")

# Who meets here: every thread of the process. Working directory, locale, umask, environment and signal handlers are
# those of all threads; the locale of `uselocale`, the blocked signals and the floating-point mode are those of one. So
# the thread that called the FMU looks, and two threads that look at once may each undo what the FMU of the other one
# did. Our own threads change only the working directory, while a library is loaded: `FOLDER` is the lock for that
# (ADR 12).
#
# C is asked, not Python: `os.environ` is a copy, and `signal` and `locale` know what Python itself has set. An FMU
# changes what C has.
#
# A look takes longer than most steps. So steps are looked after one by one only where a step may change something, or
# has done so, and otherwise every `LOOK_STEPS` steps or at the end of a burst. The floating-point mode changes results,
# and three additions tell it: it is looked at after every step. To look at the rest after each burst, in a model that
# is known to change it, would make the result depend on timing.

_SIGNALS: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGPIPE", "SIGCHLD") if hasattr(signal, name)
)
"""Those that end a run, and those that Python needs for its files and processes."""

# In the default mode, 1 + half an ulp is 1 (ties to even) and so is 1 - a quarter; each directed rounding mode changes
# one of the two. The sum of two subnormal numbers is 0 if operands or results are flushed to zero. These are variables,
# because Python evaluates expressions of literals when it compiles.
_ONE, _HALF_ULP, _QUARTER_ULP, _TINY = 1.0, 2.0**-53, 2.0**-54, 5e-324

LOOK_STEPS: Final = 1 << 14
"""After so many steps of a model that is not known to change the state, it is looked whether one has changed it."""

FOLDER: Final = threading.Lock()
"""Held by who changes the working directory and goes back: all threads of the process have the same one."""

_libc = ctypes.CDLL(None)
_OF_SIGNALS: Final = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
_sigaction = _OF_SIGNALS(("sigaction", _libc))
_pthread_sigmask = _OF_SIGNALS(("pthread_sigmask", _libc))
_uselocale = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(("uselocale", _libc))
_environ = ctypes.c_void_p.in_dll(_libc, "environ")
_last_variables = 0, b""
_ENVIRONMENT_BYTES: Final = 512
"""More than the size of `fenv_t` on any platform."""
_SIGNAL_BYTES: Final = 512
"""More than the size of `struct sigaction` and of `sigset_t` on any platform."""
_DEFAULT_ENVIRONMENT: Final = ctypes.c_void_p(-1)
"""`FE_DFL_ENV` of the C libraries on x86 and ARM."""


def floating_point_changed() -> bool:
    """Whether this thread does not round to nearest, or flushes subnormal numbers to zero; takes about 50 ns."""
    return _ONE + _HALF_ULP - _QUARTER_ULP != _ONE or not _TINY + _TINY


def restore_floating_point() -> None:
    """Restore the default environment of C (C17, 7.6): round to nearest, subnormal numbers, no traps."""
    _libc.fesetenv(_DEFAULT_ENVIRONMENT)


class ProcessState:
    """What an FMU could change of its process and of this thread, as it is now; the floating-point mode is not in it.

    Handlers of other signals are left to the FMU: a timer or a virtual machine in it may need them.
    """

    def __init__(self) -> None:
        self.changed = False  # whether `restore` has found anything changed
        self._signals, signals = _signals(None)
        self._before = _Seen.now(signals)

    def restore(self) -> bool:
        """Restore it; whether there was anything to restore."""
        _, signals = _signals(self._signals)  # first of all: a signal that comes while it is ignored is lost
        before, now = self._before, _Seen.now(signals)
        if now == before:
            return False
        changed = now[:-1] != before[:-1]
        if now.folder != before.folder and before.folder is not None:
            with FOLDER, suppress(OSError):  # it may have been removed
                os.chdir(before.folder)
        _uselocale(before.thread_locale)
        if now.locale != before.locale:
            locale.setlocale(locale.LC_ALL, before.locale)
        os.umask(before.umask)
        if now.environment != before.environment:
            changed |= _restore_environment(before.environment, now.environment)
        self._before = _Seen.now(before.signals)
        self.changed |= changed
        return changed


class _Seen(NamedTuple):
    """What is compared."""

    folder: str | None
    locale: str
    thread_locale: int
    # the handlers in C, of which Python does not know all, and the signals that this thread blocks
    signals: list[bytes]
    umask: int
    environment: bytes  # the addresses of the variables

    @classmethod
    def now(cls, signals: list[bytes]) -> _Seen:
        """The state now."""
        umask = os.umask(0o077)  # nothing else reads it as fast; a file that another thread makes meanwhile is private
        os.umask(umask)
        language, own_language = locale.setlocale(locale.LC_ALL), _uselocale(None)
        return cls(_working_directory(), language, own_language, signals, umask, _variables())


def _signals(actions: ctypes.Array[ctypes.c_char] | None) -> tuple[ctypes.Array[ctypes.c_char], list[bytes]]:
    """The actions at `_SIGNALS` and the blocked signals, one after the other; and of these what can be compared.

    ``actions`` is what to set instead; None: all stay.
    """
    found = ctypes.create_string_buffer((len(_SIGNALS) + 1) * _SIGNAL_BYTES)
    to, wanted = ctypes.addressof(found), ctypes.addressof(actions) if actions is not None else None
    for number in _SIGNALS:
        _sigaction(number, wanted, to)
        to, wanted = to + _SIGNAL_BYTES, wanted and wanted + _SIGNAL_BYTES
    _pthread_sigmask(signal.SIG_SETMASK, wanted, to)
    raw = found.raw
    # A `struct sigaction` begins with the handler; the C library leaves parts of the rest as they happen to be.
    return found, [raw[place : place + 8] for place in range(0, len(raw), _SIGNAL_BYTES)]


def _variables() -> bytes:
    """The addresses of the environment variables, as in C, with the zero at the end; empty if there is no environment.

    To count them takes longer than to see that they are those of the last time.
    """
    global _last_variables  # noqa: PLW0603 threads may write it at once: whoever reads it compares
    start, (last_start, last) = _environ.value, _last_variables
    if not start:
        return b""
    if start == last_start and ctypes.string_at(start, len(last)) == last:
        return last
    pointers = ctypes.cast(start, ctypes.POINTER(ctypes.c_void_p))
    count = next(number for number in itertools.count() if not pointers[number])
    _last_variables = start, ctypes.string_at(start, 8 * (count + 1))
    return _last_variables[1]


@contextmanager
def kept_state(*, keep_mode: bool = False) -> Iterator[ProcessState]:
    """Restore the state of the process at the end of the block.

    With ``keep_mode``, the floating-point mode of before is restored; without, the default mode is set.
    """
    environment = ctypes.create_string_buffer(_ENVIRONMENT_BYTES)
    if keep_mode:
        _libc.fegetenv(environment)
    state = ProcessState()
    try:
        yield state
    finally:
        _libc.fesetenv(environment if keep_mode else _DEFAULT_ENVIRONMENT)
        state.restore()


@contextmanager
def kept_mode() -> Iterator[None]:
    """Restore the default floating-point mode at the end of the block, unless it was another one before."""
    is_own = floating_point_changed()
    try:
        yield
    finally:
        if not is_own and floating_point_changed():
            restore_floating_point()


def in_kept_mode(call: Callable[..., Result], *arguments: Any) -> Result:  # noqa: ANN401 those of any function
    """Make a call as in a block of `kept_mode`, in half the time."""
    is_own = floating_point_changed()
    try:
        return call(*arguments)
    finally:
        if not is_own and floating_point_changed():
            restore_floating_point()


def _restore_environment(before: bytes, now: bytes) -> bool:
    """Restore what Python does not know of; whether there was something.

    The C library frees no variable, so those of before can still be read.
    """
    old, new = (
        dict(ctypes.string_at(place).partition(b"=")[::2] for (place,) in struct.iter_unpack("N", every[:-8]))
        for every in (before, now)
    )
    changed = {name for name, _ in old.items() ^ new.items() if os.environb.get(name) != new.get(name)}
    for name in changed:
        if name in old:
            _libc.setenv(name, old[name], 1)
        else:
            _libc.unsetenv(name)
    if changed:
        time.tzset()
    return bool(changed)


def _working_directory() -> str | None:
    try:
        with FOLDER:
            return os.getcwd()  # noqa: PTH109 `Path.cwd` is the same and slower
    except FileNotFoundError:  # the folder was removed
        return None
