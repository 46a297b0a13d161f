"""Protects a process from its FMUs: no call may run forever, and none may change the state of the process.

Owns the deadline of every call outside the stepping loop, and the state of the process that a call could change:
working directory, locale, floating-point environment, signals that end a run, umask and environment variables. A
`Guarded` instance does both for every call but most steps: those are checked one by one only if the model may change
the state, or has done so once. Whoever takes many steps of others checks the floating-point mode after each, and the
rest after many. The owner of the process decides what happens after a missed deadline.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from typing import Any, Final, TypeVar, cast

import msgspec

from ..awake import AwakeClock
from ..config.mesh import TimeoutsConfig
from ..errors import FmuError, InitializationFailed, LoadFailed, StepFailed
from ..rings.native import NativeStep, Stage
from ..rings.ring import Ring
from ..simtime import TimeGrid
from ..text import short_path
from ..variables.model_description import Value
from .contract import BeginsAgain, ChangesProcess, Instance, Prepares
from .instance_wrapper import AroundNativeSteps
from .process_end import surviving
from .process_state import in_kept_mode, kept_mode, kept_state

__all__ = [
    "ENDED",
    "CallWatch",
    "Guarded",
    "Unwatched",
    "call_named",
    "current_function",
    "doing",
    "lines_shown_of",
    "not_returned",
]

Result = TypeVar("Result")

# Who meets here: the thread that calls FMUs (of a node the main thread, in a program the thread that owns the system),
# and for each `CallWatch` one thread that waits for the deadlines of its calls. ADR 12 says what is guarded, ADR 56 how
# the line of a component is found, ADR 57 which steps are taken without Python.
#
# They share three attributes. Only the calling thread writes `_call` and `_position` (or the one that crashes in its
# last call), each with one assignment, and it never waits for the watching thread to look. That one reads both once in
# a round and compares them with those of the round before. To wake a thread takes longer than a short call, so it looks
# on its own four times a second. After a round in which nothing was called, it writes `_asleep`, looks once more, and
# sleeps until it is woken; whoever begins a call looks at `_asleep` after it has written the call. It holds the lock of
# the condition from there until it waits, so that a wake-up between the two is not lost.
#
# A call that hangs cannot be cancelled: no exception of Python reaches C, and a signal would interrupt the FMU
# anywhere, perhaps while it holds a lock of malloc. So an overrun is told on the watching thread, and whoever owns the
# process ends the process. Nothing may wait for the calling thread on that way, and nothing may call the FMU, `exit` or
# a destructor.
#
# Steps have no `calling` of their own: to wake a thread takes longer than a short step. Their owner gives a function
# that says who steps and from which point; if it still says the same after the limit, a step has overrun. The clock is
# `AwakeClock`: a process that stood (a debugger, swap, a suspended host) must not look like an FMU that hangs.
#
# Where a thread is, is asked after a missed deadline only, so that it costs nothing before. `_functions` has the FMI
# function of each call from Python; steps of the library have a stage in their tables instead. The frames of a
# component come from `sys._current_frames`: `faulthandler` tells the same only to a file.

_WATCH_S: Final = 0.25
"""How often a call or a step is compared with what it was: an overrun is told this much late at most."""
_DO_STEP: Final = "doStep"

_functions: dict[int, str] = {}
"""The FMI function that a thread is in, by the identifier of the thread."""

_shown_files: set[str] = set()
"""Files of users: what does not return from a function of such a file is told with its line."""

ENDED: Final = "; its process is ended"
"""What an error about a call that does not return ends with, where that is so."""


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

    ``on_overrun`` is called with the error, which says the instance, the call and the point, while the watched thread
    is still in the call. With ``survives`` it is also called after a crash at the end; see `surviving`.
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
        self._asleep = False
        self._crash: tuple[str, str] | None = None
        self._thread = threading.Thread(target=self._run, name="call watch", daemon=True)
        self._thread.start()

    @contextmanager
    def calling(self, instance: str, kind: type[FmuError], setting: str, limit_s: float) -> Iterator[None]:
        """Around one call of an FMU, of ``limit_s`` at most; ``setting`` is the key of `timeouts` with this limit."""
        self.begin(instance, kind, setting, limit_s)
        try:
            yield
        finally:
            self.end()

    def begin(self, instance: str, kind: type[FmuError], setting: str, limit_s: float) -> None:
        """As `calling`, in a place where it would take longer than the call; `end` has to follow."""
        self._call = _Call(instance, kind, setting, limit_s, time.monotonic())
        if self._asleep:
            self._notify()

    def end(self) -> None:
        """The call of `begin` has returned."""
        self._call = None  # the watching thread reads this when it wakes up

    def surviving(self, instance: str) -> AbstractContextManager[None]:
        """Around the last calls of FMUs: a crash is reported as a call that does not return."""

        def crashed(how: str) -> None:
            call = self._call
            name = call.instance if call is not None else instance
            self._crash = name, how
            self._call = _Call(instance, FmuError, "terminate", 0.0, time.monotonic())  # whose deadline is now
            self._notify()

        return surviving(crashed) if self._survives else nullcontext()

    @contextmanager
    def stepping(self, position: Callable[[], tuple[str, int, str]], limit_s: float) -> Iterator[None]:
        """Around many steps: ``position`` (who steps, from which point, and `doing`) changes every ``limit_s`` seconds.

        A step has the whole time for all that it does, so the last one is for the error only.
        """
        self._position, self._step_limit_s = position, limit_s
        if self._asleep:
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
        clock, since, watched = AwakeClock(), 0.0, cast("object", None)
        while True:
            with self._changed:
                if self._closed:
                    return
                call, position = self._call, self._position
                if call is None or call == watched:
                    left = since + call.limit_s - clock() if call is not None else _WATCH_S
                    if not self._changed.wait(min(_WATCH_S, max(0.0, left))):
                        self._rest()
                if call is not self._call or position is not self._position:
                    continue
            place: object = call
            otherwise = "a call"
            if call is None:
                if position is None:
                    continue
                instance, point, otherwise = position()
                place, call = (instance, point), _Call(instance, StepFailed, "step", self._step_limit_s, 0.0)
            now = clock()
            if place != watched:
                watched, since = place, now
            if now - since >= call.limit_s:
                self._on_overrun(self._overrun(call, now - since, otherwise))
                return

    def _rest(self) -> None:
        """If nothing is called, sleep until a call begins; it holds the lock of the condition."""
        self._asleep = True
        if self._call is None and self._position is None and not self._closed:
            self._changed.wait()
        self._asleep = False

    def _overrun(self, call: _Call, seconds: float, otherwise: str) -> FmuError:
        if self._crash is not None:
            (name, how), position = self._crash, self._position
            last = position()[2] if position is not None else "its last call"
            function = current_function(self._caller) or last
            return FmuError(f"the FMU ended its process in {function} ({how})", instance=name)
        return call.kind(
            not_returned(self._caller, seconds, otherwise),
            instance=call.instance,
            hint=f"If it needs that long, raise `timeouts.{call.setting}` in the configuration.",
        )


class Unwatched:
    """Takes the place of a `CallWatch` in a program that is not ours to end: no call has a deadline."""

    @contextmanager
    def calling(self, _instance: str, _kind: type[FmuError], _setting: str, _limit_s: float) -> Iterator[None]:
        """Around one call of an FMU."""
        yield

    def begin(self, _instance: str, _kind: type[FmuError], _setting: str, _limit_s: float) -> None:
        """Before one call of an FMU."""

    def end(self) -> None:
        """After it."""

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

    ``seconds`` in s; ``otherwise`` is the function of an FMU, if it is not known which one.
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
    """An instance whose calls have a deadline and leave the state of the process unchanged.

    ``open_`` makes the instance, which is a call with a deadline like the others.

    That a step leaves it is looked after only where a step may change it: it takes longer than many a step. Such an
    instance has no `native` steps. With ``is_harmless``, an instance before of the same model has changed nothing, and
    only the floating-point mode is looked after: who calls looks after the rest, once for many calls.
    """

    def __init__(
        self,
        name: str,
        open_: Callable[[], Instance],
        watch: CallWatch | Unwatched,
        timeouts: TimeoutsConfig,
        *,
        is_harmless: bool = False,
    ) -> None:
        self._name = name
        self._watch = watch
        self._timeouts = timeouts
        self._running = False
        self._careful = False
        self._trusted = is_harmless
        self._is_watched = not isinstance(watch, Unwatched)
        super().__init__(self._made(LoadFailed, "call", open_))
        if self.waits_for_program:
            self._is_watched = False
        self._again = self._instance if isinstance(self._instance, BeginsAgain) else None
        if isinstance(self._instance, ChangesProcess) and self._instance.changes_process:
            self._careful = True

    @property
    def native(self) -> NativeStep | None:
        """See `StepsNatively`."""
        return None if self._careful else super().native

    @property
    def do_step(self) -> Callable[[int], None]:
        """That of the inner instance: `CallWatch.stepping` watches the steps."""
        return self._step if self._careful else self._instance.do_step

    @property
    def runs_again(self) -> bool:
        """Whether `end_run` may be called where nobody looks after each call of the later runs."""
        return self._again is not None and self.is_harmless

    def end_run(self) -> bool:
        """See `BeginsAgain`; who ends several looks after crashes once for all of them."""
        if self._again is None:
            return False
        ended = self._made(FmuError, "terminate", self._again.end_run)
        self._running = False
        return ended

    def begin_again(self) -> None:
        """See `BeginsAgain`. What was harmless until now is taken for it."""
        assert self._again is not None
        self._trusted = self.is_harmless
        if self._is_watched:
            self._made(LoadFailed, "call", self._again.begin_again)
        else:
            self._forward(self._again.begin_again)

    @property
    def is_harmless(self) -> bool:
        """Whether no call has changed the state of the process so far, and none is known to do so."""
        return not self._careful

    def take_care(self) -> None:
        """See `AroundInstance`."""
        self._careful = True

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Let `do_step` work on these rings."""
        super().bind(inputs, outputs, grid, points, step)
        self._running = True

    def set_in_step(self, values: Mapping[str, Value]) -> None:
        """As `set_values`, as a part of a step: whoever watches the steps watches this, too, and it takes less time."""
        self._made(None, "step", self._instance.set_values, values)

    def setter(self, name: str) -> Callable[[Value], None] | None:
        """See `Prepares`; nothing is prepared where calls are watched."""
        own = self._preparing
        put = own.setter(name) if own is not None else None
        return partial(self._forward, put) if put is not None else None

    def getter(self, name: str) -> Callable[[], Value] | None:
        """See `setter`."""
        own = self._preparing
        get = own.getter(name) if own is not None else None
        return partial(self._forward, get) if get is not None else None

    def close(self) -> None:
        """Terminate if allowed, free the instance and remove its files; one deadline for all of it."""
        watch, name = self._watch, self._name
        ending = watch.calling(name, FmuError, "terminate", self._timeouts.terminate)
        with ending, watch.surviving(name), kept_mode() if self._trusted and not self._careful else kept_state():
            self._instance.close()

    def _step(self, step: int) -> None:
        self._made(None, "step", self._instance.do_step, step)

    @property
    def _preparing(self) -> Prepares | None:
        own = self._instance
        return own if isinstance(own, Prepares) and not self._is_watched else None

    def _forward(self, call: Callable[..., Result], *arguments: Any) -> Result:  # noqa: ANN401 those of any method
        if self._trusted and not (self._is_watched or self._careful):  # as `_made`, which takes longer
            return in_kept_mode(call, *arguments)
        if self._running:
            return self._made(StepFailed, "step", call, *arguments)
        return self._made(InitializationFailed, "call", call, *arguments)

    def _made(self, kind: type[FmuError] | None, setting: str, call: Callable[..., Result], *arguments: Any) -> Result:  # noqa: ANN401 as above
        """Make a call, and restore the state of the process, between steps only where they may change it.

        That it has missed its deadline is an error of this ``kind``; None: somebody else watches it.
        """
        is_watched = self._is_watched and kind is not None
        if is_watched:
            self._watch.begin(self._name, cast("type[FmuError]", kind), setting, getattr(self._timeouts, setting))
        try:
            if (self._running or self._trusted) and not self._careful:
                return in_kept_mode(call, *arguments)
            with kept_state() as state:
                result = call(*arguments)
            if state.changed:
                self._careful = True
            return result
        finally:
            if is_watched:
                self._watch.end()
