"""What an FMU may do to the process that it runs in: nothing that another FMU, or the mesh, would notice.

Owns the deadline of every call outside the hot loop, and the state of the process that a call could change: working
directory, locale, floating-point environment, and the signal handlers that end a run. A `Guarded` instance sees to both
and hands `do_step` through as it is; the hot loop looks for a changed floating-point mode itself. What a call that met
its deadline means for the process is decided by who owns the process.
"""

from __future__ import annotations

import ctypes
import locale
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Final

import msgspec

from ..config.mesh import TimeoutsConfig
from ..errors import FmuError, InitializationFailed, LoadFailed, StepFailed
from ..rings.ring import Ring
from ..simtime import TimeGrid
from ..variables.model_description import ModelDescription, Value
from .contract import Instance

__all__ = [
    "DEFAULT_MODE",
    "CallWatch",
    "Guarded",
    "floating_point_changed",
    "kept_state",
    "restore_floating_point",
]

_LOOK_S: Final = 0.25
_SIGNALS: Final = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGPIPE") if hasattr(signal, name))

# In the default mode 1 + half an ulp is 1 (ties to even) and so is 1 - a quarter; each directed rounding changes one of
# them. The sum of two subnormal numbers is 0 where operands or results are flushed to zero. Variables, not literals:
# Python calculates with literals when it compiles.
DEFAULT_MODE: Final = (1.0, 2.0**-53, 2.0**-54, 5e-324)
_ONE, _HALF_ULP, _QUARTER_ULP, _TINY = DEFAULT_MODE

_libm = ctypes.CDLL(None)
_ENVIRONMENT_BYTES: Final = 512
"""More than a `fenv_t` has anywhere."""
_ACTION_BYTES: Final = 512
"""More than a `struct sigaction` has anywhere."""
_DEFAULT_ENVIRONMENT: Final = ctypes.c_void_p(-1)
"""`FE_DFL_ENV` of the C libraries on x86 and ARM."""


def floating_point_changed() -> bool:
    """Whether this thread rounds otherwise than to nearest, or flushes subnormal numbers to zero; costs some 50 ns."""
    return _ONE + _HALF_ULP - _QUARTER_ULP != _ONE or not _TINY + _TINY


def restore_floating_point() -> None:
    """Back to the default environment of C (C17, 7.6): round to nearest, subnormal numbers, no traps."""
    _libm.fesetenv(_DEFAULT_ENVIRONMENT)


@contextmanager
def kept_state(*, keep_mode: bool = False) -> Iterator[None]:
    """What a call inside does to the state of the process is undone at the end.

    Args:
        keep_mode: whether the floating-point mode is afterwards what it was before; else it is the default one.
    """
    folder, language = _working_directory(), locale.setlocale(locale.LC_ALL)
    actions = [(number, _action(number)) for number in _SIGNALS]
    environment = ctypes.create_string_buffer(_ENVIRONMENT_BYTES)
    if keep_mode:
        _libm.fegetenv(environment)
    try:
        yield
    finally:
        _libm.fesetenv(environment if keep_mode else _DEFAULT_ENVIRONMENT)
        if folder is not None and _working_directory() != folder:
            os.chdir(folder)
        if locale.setlocale(locale.LC_ALL) != language:
            locale.setlocale(locale.LC_ALL, language)
        for number, action in actions:
            _libm.sigaction(number, action, None)


def _action(number: int) -> ctypes.Array[ctypes.c_char]:
    """What happens at a signal, as C has it: Python does not know of handlers that others have installed."""
    action = ctypes.create_string_buffer(_ACTION_BYTES)
    _libm.sigaction(number, None, action)
    return action


def _working_directory() -> str | None:
    try:
        return os.getcwd()  # noqa: PTH109 `Path.cwd` is the same and slower
    except FileNotFoundError:  # it was removed
        return None


class _Call(msgspec.Struct, frozen=True):
    """A call that is under way; ``kind`` is the error that its failure is."""

    instance: str
    kind: type[FmuError]
    setting: str
    limit_s: float
    started: float


class CallWatch:
    """Watches the calls of one thread; a call that meets its deadline is handed to ``on_overrun`` on another thread.

    Args:
        on_overrun: gets the error that says which instance, call and point; should not return into the run.
    """

    def __init__(self, on_overrun: Callable[[FmuError], None]) -> None:
        self._on_overrun = on_overrun
        self._caller = threading.get_ident()
        self._changed = threading.Condition()
        self._call: _Call | None = None
        self._position: Callable[[], tuple[str, int]] | None = None
        self._step_limit_s = 0.0
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="call watch", daemon=True)
        self._thread.start()

    @contextmanager
    def calling(self, instance: str, kind: type[FmuError], setting: str, limit_s: float) -> Iterator[None]:
        """While inside, an FMU may be called, for ``limit_s`` at most; ``setting`` is where the limit comes from."""
        self._call = _Call(instance, kind, setting, limit_s, time.monotonic())
        self._notify()
        try:
            with kept_state():
                yield
        finally:
            self._call = None  # the thread finds out when it looks

    @contextmanager
    def stepping(self, position: Callable[[], tuple[str, int]], limit_s: float) -> Iterator[None]:
        """While inside, ``position`` (the instance that steps, and its point) must change every ``limit_s``."""
        self._position, self._step_limit_s = position, limit_s
        self._notify()
        try:
            yield
        finally:
            self._position = None

    def close(self) -> None:
        """Watch no more."""
        self._closed = True
        self._notify()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _notify(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _run(self) -> None:
        seen: tuple[tuple[str, int], float] = (("", -1), 0.0)
        while True:
            with self._changed:
                if self._closed:
                    return
                call, position = self._call, self._position
                self._changed.wait(self._patience(call, position))
                if call is not self._call:
                    continue
            now = time.monotonic()
            if call is not None:
                if now - call.started >= call.limit_s:
                    self._on_overrun(self._overrun(call, now))
                    return
            elif position is not None and position is self._position:
                place = position()
                if place != seen[0]:
                    seen = (place, now)
                elif now - seen[1] >= self._step_limit_s:
                    step = _Call(place[0], StepFailed, "step", self._step_limit_s, seen[1])
                    self._on_overrun(self._overrun(step, now))
                    return

    @staticmethod
    def _patience(call: _Call | None, position: object) -> float | None:
        """How long nothing can be late, in s; None: until something changes."""
        if call is not None:
            return max(0.0, call.started + call.limit_s - time.monotonic())
        return _LOOK_S if position is not None else None

    def _overrun(self, call: _Call, now: float) -> FmuError:
        function = current_function(self._caller) or ("doStep" if call.kind is StepFailed else "a call")
        return call.kind(
            f"the FMU has not returned for {now - call.started:.1f} s from {function}; its process is ended",
            instance=call.instance,
            hint=f"If it needs that long, raise `timeouts.{call.setting}` in the configuration.",
        )


def current_function(thread: int) -> str | None:
    """The FMI function that a thread is in through FMPy, read from its stack; None if it is in none."""
    frame = sys._current_frames().get(thread)  # noqa: SLF001 documented, for exactly this
    while frame is not None:
        if frame.f_code.co_name == "_call" and isinstance(name := frame.f_locals.get("fname"), str):
            return name
        frame = frame.f_back
    return None


class Guarded:
    """An instance whose calls outside the hot loop are watched, and leave the state of the process alone.

    Args:
        name: instance name.
        open_: instantiates it; a call like the others.
        watch: who watches.
        timeouts: the limits.

    Attributes:
        instance: the instance itself.
        do_step: that of the instance, without anything around it.
    """

    def __init__(self, name: str, open_: Callable[[], Instance], watch: CallWatch, timeouts: TimeoutsConfig) -> None:
        self._name = name
        self._watch = watch
        self._timeouts = timeouts
        self._running = False
        with watch.calling(name, LoadFailed, "call", timeouts.call):
            self.instance = open_()
        self.do_step: Callable[[int], None] = self.instance.do_step

    @property
    def description(self) -> ModelDescription:
        """The model description."""
        return self.instance.description

    def enter_initialization(
        self, start_time: float, stop_time: float | None, start_values: Mapping[str, Value]
    ) -> None:
        """Set ``start_values`` and enter Initialization Mode."""
        with self._calling():
            self.instance.enter_initialization(start_time, stop_time, start_values)

    def exit_initialization(self) -> None:
        """Leave Initialization Mode."""
        with self._calling():
            self.instance.exit_initialization()

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set variables by name."""
        with self._calling():
            self.instance.set_values(values)

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """Current values of variables by name."""
        with self._calling():
            return self.instance.get_values(names)

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Let `do_step` work on these rings."""
        with self._calling():
            self.instance.bind(inputs, outputs, grid, points, step)
        self._running = True

    def close(self) -> None:
        """Terminate if allowed, free the instance and remove its files; one limit for all of it."""
        with self._watch.calling(self._name, FmuError, "terminate", self._timeouts.terminate):
            self.instance.close()

    def _calling(self) -> AbstractContextManager[None]:
        if self._running:
            return self._watch.calling(self._name, StepFailed, "step", self._timeouts.step)
        return self._watch.calling(self._name, InitializationFailed, "call", self._timeouts.call)
