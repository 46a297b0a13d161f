"""Protects a process from its FMUs: no call may run forever, and none may change the state of the process.

Owns the deadline of every call outside the stepping loop, and the state of the process that a call could change:
working directory, locale, floating-point environment, and the signal handlers that end a run. A `Guarded` instance does
both for every call but `do_step`; the stepping loop itself checks the floating-point mode. The owner of the process
decides what happens after a missed deadline.
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
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, Final, TypeVar

import msgspec

from ..config.mesh import TimeoutsConfig
from ..errors import FmuError, InitializationFailed, LoadFailed, StepFailed
from ..rings.native import Stage
from ..rings.ring import Ring
from ..simtime import TimeGrid
from ..text import short_path
from ..variables.model_description import Value
from .contract import Instance
from .instance_wrapper import AroundNativeSteps
from .process_end import surviving

__all__ = [
    "DEFAULT_MODE",
    "ENDED",
    "FOLDER",
    "CallWatch",
    "Guarded",
    "Unwatched",
    "call_named",
    "current_function",
    "doing",
    "floating_point_changed",
    "kept_state",
    "lines_shown_of",
    "not_returned",
    "restore_floating_point",
]

Result = TypeVar("Result")

_LOOK_S: Final = 0.25
_SIGNALS: Final = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGPIPE") if hasattr(signal, name))

# In the default mode, 1 + half an ulp is 1 (ties to even) and so is 1 - a quarter; each directed rounding mode changes
# one of the two. The sum of two subnormal numbers is 0 if operands or results are flushed to zero. These are variables,
# because Python evaluates expressions of literals when it compiles.
DEFAULT_MODE: Final = (1.0, 2.0**-53, 2.0**-54, 5e-324)
_ONE, _HALF_ULP, _QUARTER_ULP, _TINY = DEFAULT_MODE

_DO_STEP: Final = "doStep"

_functions: dict[int, str] = {}
"""The FMI function that a thread is in, by the identifier of the thread."""

_shown_files: set[str] = set()
"""Files of users: what does not return from a function of such a file is told with its line."""

FOLDER: Final = threading.Lock()
"""Held by who changes the working directory and goes back: all threads of the process have the same one."""

_libm = ctypes.CDLL(None)
_ENVIRONMENT_BYTES: Final = 512
"""More than the size of `fenv_t` on any platform."""
_ACTION_BYTES: Final = 512
"""More than the size of `struct sigaction` on any platform."""
ENDED: Final = "; its process is ended"
"""What an error about a call that does not return ends with, where that is so."""

_DEFAULT_ENVIRONMENT: Final = ctypes.c_void_p(-1)
"""`FE_DFL_ENV` of the C libraries on x86 and ARM."""


def floating_point_changed() -> bool:
    """Whether this thread does not round to nearest, or flushes subnormal numbers to zero; takes about 50 ns."""
    return _ONE + _HALF_ULP - _QUARTER_ULP != _ONE or not _TINY + _TINY


def restore_floating_point() -> None:
    """Restore the default environment of C (C17, 7.6): round to nearest, subnormal numbers, no traps."""
    _libm.fesetenv(_DEFAULT_ENVIRONMENT)


@contextmanager
def kept_state(*, keep_mode: bool = False) -> Iterator[None]:
    """Restore the state of the process at the end of the block.

    Args:
        keep_mode: True restores the floating-point mode of before; False sets the default mode.
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
            with FOLDER:
                os.chdir(folder)
        if locale.setlocale(locale.LC_ALL) != language:
            locale.setlocale(locale.LC_ALL, language)
        for number, action in actions:
            _libm.sigaction(number, action, None)


def _action(number: int) -> ctypes.Array[ctypes.c_char]:
    """The action of C at a signal: Python does not know of handlers that a library has installed."""
    action = ctypes.create_string_buffer(_ACTION_BYTES)
    _libm.sigaction(number, None, action)
    return action


def _working_directory() -> str | None:
    try:
        with FOLDER:
            return os.getcwd()  # noqa: PTH109 `Path.cwd` is the same and slower
    except FileNotFoundError:  # the folder was removed
        return None


class _Call(msgspec.Struct, frozen=True):
    """A call that has not returned; ``kind`` is the error to report if it misses its deadline."""

    instance: str
    kind: type[FmuError]
    setting: str
    limit_s: float
    started: float


class CallWatch:
    """Watches the calls of one thread; reports a call that misses its deadline on another thread.

    Example:
        >>> reported = threading.Event()
        >>> watch = CallWatch(lambda error: reported.set())
        >>> with watch.calling("pendulum", StepFailed, "step", 0.01):
        ...     reported.wait(10)  # as long as a call of an FMU that does not return
        True
        >>> watch.close()

    Args:
        on_overrun: called with the error, which says the instance, the call and the point. The watched thread is still
            in the call.
        survives: whether ``on_overrun`` is also called after a crash at the end; see `surviving`.
    """

    def __init__(self, on_overrun: Callable[[FmuError], None], *, survives: bool = False) -> None:
        self._on_overrun = on_overrun
        self._survives = survives
        self._caller = threading.get_ident()
        self._changed = threading.Condition()
        self._call: _Call | None = None
        self._position: Callable[[], tuple[str, int, str]] | None = None
        self._step_limit_s = 0.0
        self._closed = False
        self._crash: FmuError | None = None
        self._thread = threading.Thread(target=self._run, name="call watch", daemon=True)
        self._thread.start()

    @contextmanager
    def calling(self, instance: str, kind: type[FmuError], setting: str, limit_s: float) -> Iterator[None]:
        """Around one call of an FMU, of ``limit_s`` at most; ``setting`` is the key of `timeouts` with this limit."""
        self._call = _Call(instance, kind, setting, limit_s, time.monotonic())
        self._notify()
        try:
            with kept_state():
                yield
        finally:
            self._call = None  # the watching thread reads this when it wakes up

    def surviving(self, instance: str) -> AbstractContextManager[None]:
        """Around the last call of an FMU: a crash is reported as a call that does not return."""

        def crashed(how: str) -> None:
            function = current_function(self._caller) or "its last call"
            self._crash = FmuError(f"the FMU ended its process in {function} ({how})", instance=instance)
            self._call = _Call(instance, FmuError, "terminate", 0.0, time.monotonic())  # whose deadline is now
            self._notify()

        return surviving(crashed) if self._survives else nullcontext()

    @contextmanager
    def stepping(self, position: Callable[[], tuple[str, int, str]], limit_s: float) -> Iterator[None]:
        """Around many steps: ``position`` (who steps, from which point, and `doing`) changes every ``limit_s`` seconds.

        A step has the whole time for all that it does, so the last one is for the error only.
        """
        self._position, self._step_limit_s = position, limit_s
        self._notify()
        try:
            yield
        finally:
            self._position = None

    def close(self) -> None:
        """Stop watching."""
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
                    self._on_overrun(self._overrun(call, now, "a call"))
                    return
            elif position is not None and position is self._position:
                instance, point, call_of_step = position()
                place = instance, point
                if place != seen[0]:
                    seen = (place, now)
                elif now - seen[1] >= self._step_limit_s:
                    step = _Call(instance, StepFailed, "step", self._step_limit_s, seen[1])
                    self._on_overrun(self._overrun(step, now, call_of_step))
                    return

    @staticmethod
    def _patience(call: _Call | None, position: object) -> float | None:
        """Time in s until the next deadline can be missed; None: no call is watched."""
        if call is not None:
            return max(0.0, call.started + call.limit_s - time.monotonic())
        return _LOOK_S if position is not None else None

    def _overrun(self, call: _Call, now: float, otherwise: str) -> FmuError:
        return self._crash or call.kind(
            not_returned(self._caller, now - call.started, otherwise),
            instance=call.instance,
            hint=f"If it needs that long, raise `timeouts.{call.setting}` in the configuration.",
        )


class Unwatched:
    """Takes the place of a `CallWatch` in a program that is not ours to end: no call has a deadline.

    Between two steps this restores only the floating-point mode: the rest takes longer than a step.
    """

    @contextmanager
    def calling(self, _instance: str, kind: type[FmuError], _setting: str, _limit_s: float) -> Iterator[None]:
        """Around one call of an FMU."""
        if kind is not StepFailed:
            with kept_state():
                yield
            return
        try:
            yield
        finally:
            if floating_point_changed():
                restore_floating_point()

    def surviving(self, _instance: str) -> AbstractContextManager[None]:
        """The process goes on after the last call, so a crash is one."""
        return nullcontext()


def current_function(thread: int) -> str | None:
    """The FMI function that a thread is in; None if it is in none, or in a step that the library takes."""
    return _functions.get(thread)


def doing(stage: int) -> str:
    """In words what a step is doing in this `Stage`."""
    return {Stage.SETTING: "setting the inputs", Stage.GETTING: "reading the outputs"}.get(Stage(stage), _DO_STEP)


def lines_shown_of(file: str | None) -> None:
    """From now on, a call that does not return from a function in ``file`` is told with its line."""
    if file is not None:
        _shown_files.add(file)


def not_returned(thread: int, seconds: float, otherwise: str) -> str:
    """In words where a thread has been for too long.

    Args:
        thread: its identifier.
        seconds: for how long, in s.
        otherwise: the function of an FMU, if it is not known which one.
    """
    if (line := _line_of_user(thread)) is not None:
        return f"the component has not returned for {seconds:.1f} s from {line}{ENDED}"
    function = current_function(thread) or otherwise
    return f"the FMU has not returned for {seconds:.1f} s from {function}{ENDED}"


def _line_of_user(thread: int) -> str | None:
    """The function of a component that a thread is in, and the line in the file of the component."""
    frame = sys._current_frames().get(thread)  # noqa: SLF001 documented, and there is no other way
    line = function = None
    while frame is not None:
        if frame.f_code.co_filename in _shown_files:
            line = line or f"{short_path(frame.f_code.co_filename)}:{frame.f_lineno}"
            function = frame.f_code.co_name
        frame = frame.f_back
    return f"{function} ({line})" if line is not None else None


def call_named(name: str, function: Callable[..., Result], *arguments: Any, **keywords: Any) -> Result:  # noqa: ANN401 those of any function
    """Call ``function``, which `current_function` gives the name ``name`` until it returns."""
    thread = threading.get_ident()
    _functions[thread] = name
    try:
        return function(*arguments, **keywords)
    finally:
        _functions.pop(thread, None)


class Guarded(AroundNativeSteps):
    """An instance whose calls have a deadline and leave the state of the process unchanged; steps are as they were.

    Args:
        name: instance name.
        open_: makes the instance; a call with a deadline like the others.
        watch: watches the deadlines, or does not.
        timeouts: the deadlines.

    Attributes:
        do_step: that of the inner instance: `CallWatch.stepping` watches the steps.
    """

    def __init__(
        self, name: str, open_: Callable[[], Instance], watch: CallWatch | Unwatched, timeouts: TimeoutsConfig
    ) -> None:
        self._name = name
        self._watch = watch
        self._timeouts = timeouts
        self._running = False
        with watch.calling(name, LoadFailed, "call", timeouts.call):
            super().__init__(open_())
        self.do_step: Callable[[int], None] = self._instance.do_step

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Let `do_step` work on these rings."""
        super().bind(inputs, outputs, grid, points, step)
        self._running = True

    def set_in_step(self, values: Mapping[str, Value]) -> None:
        """As `set_values`, as a part of a step: whoever watches the steps watches this, too, and it takes less time."""
        self._instance.set_values(values)

    def close(self) -> None:
        """Terminate if allowed, free the instance and remove its files; one deadline for all of it."""
        watch = self._watch
        with watch.calling(self._name, FmuError, "terminate", self._timeouts.terminate), watch.surviving(self._name):
            self._instance.close()

    def _forward(self, call: Callable[..., Result], *arguments: Any) -> Result:  # noqa: ANN401 those of any method
        if self._running:
            watched = self._watch.calling(self._name, StepFailed, "step", self._timeouts.step)
        else:
            watched = self._watch.calling(self._name, InitializationFailed, "call", self._timeouts.call)
        with watched:
            return call(*arguments)
