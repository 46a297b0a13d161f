"""One FMU that follows the time of a ROS node, and the thread that calls it; without ROS.

Owns the `FMIAdapter`, the limit on catching up, pauses, the stop time and jumps back of time. Knows nothing of topics,
ROS parameters and rclpy. All times are in ns of the clock of the node.
"""

# Threads: an FMU is only called by the thread of its `FmuThread`. The executor of rclpy, with any number of threads,
# submits calls: from its timer, its subscriptions and its services, which answer while the FMU computes. An FMU that
# does not return cannot be stopped: `close` gives it 5 s, then its files are removed, and the process ends without it
# (ADR 0031).

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeout
from pathlib import Path
from typing import ParamSpec, TypeVar

import msgspec

from ...adapter import FMIAdapter, Nanoseconds
from ...adapter.argument_checks import Arguments
from ...errors import DeadlineExceeded, FmuError, FmuMeshError
from ...simtime import steps_between
from ...variables.model_description import Value

__all__ = ["DriveSettings", "FmuDriver", "FmuThread", "Update"]

_ANSWER_S = 60.0
# As long as `FmuNode` waits for the FMU itself: the thread ends when its FMU has.
_THREAD_END_S = 5.0

Result = TypeVar("Result")
Parameters = ParamSpec("Parameters")


class DriveSettings(msgspec.Struct, frozen=True, kw_only=True):
    """How an FMU is driven.

    Attributes:
        step_size: communication step size in s; None takes the default experiment's.
        stop_time: end of the last step at the latest, in s of the FMU's time; None: no end.
        max_steps: largest number of steps in one update.
    """

    fmu_path: Path
    step_size: float | None = None
    stop_time: float | None = None
    max_steps: int = 1000


class Update(msgspec.Struct, frozen=True, kw_only=True):
    """The result of one update.

    Attributes:
        time: the time of the outputs, in ns.
        behind: how far the FMU is behind after the largest number of steps, in s; else 0.
        jumped_back: how far time had jumped back before this update, in s; else 0.
        ended: whether the stop time is reached.
    """

    time: int
    values: dict[str, Value]
    steps: int = 0
    behind: float = 0.0
    jumped_back: float = 0.0
    ended: bool = False


class FmuDriver:
    """One FMU that follows a clock, which may pause, jump ahead and jump back. All calls come from one thread.

    Call sequence: `set_value` as often as needed, then `resume`, then `update` and `set_input` while time runs;
    `resume` again after each pause; `close` at the end.

    The time of the FMU is 0.0 at the first update, and stands still between the last update before a pause and
    `resume`.

    Attributes:
        adapter: the FMU; another one after a restart. Only its `remove_files` is for other threads.
        started: whether the FMU has left Initialization Mode, so that only tunable parameters can change.

    Raises:
        CallRefused: a setting is out of range.
        LoadFailed: the FMU cannot be read, extracted or instantiated.
    """

    def __init__(self, settings: DriveSettings) -> None:
        self._settings = settings
        self._kept: dict[str, Value] = {}
        self.adapter = self._load()
        self._arguments = Arguments(settings.fmu_path.stem, self.adapter.description)
        self.started = False
        self._shift = 0
        self._start = 0
        self._steps = 0

    def check_value(self, name: str, value: Value) -> Value:
        """Convert a value to the type of its variable, as `set_value` would do now. Any thread may call this.

        Raises:
            CallRefused: the variable cannot be set now, or the value has a wrong type or range.
        """
        variable = self._arguments.tunable(name) if self.started else self._arguments.settable(name)
        return self._arguments.value(variable, value)

    def set_value(self, name: str, value: Value) -> None:
        """Set a start value before the first update, or a tunable parameter later; a restart keeps it.

        Raises:
            CallRefused: the variable cannot be set now, or the value has a wrong type or range.
            FmuError: the FMU refuses it.
        """
        if self.started:
            self.adapter.set_parameter_value(name, value)
        else:
            self.adapter.set_initial_value(name, value)
        self._kept[name] = value

    def set_input(self, name: str, time: int, value: Value) -> None:
        """Give an input a value that holds from ``time`` in ns on.

        Raises:
            CallRefused: there is no such input, or the value has a wrong type or range.
        """
        self.adapter.set_input_value(name, Nanoseconds(time - self._shift), value)

    def resume(self, time: int) -> None:
        """Continue at ``time`` in ns from the state of the FMU; restart the FMU if it has reached the stop time."""
        if self.started and self._ended:
            self._restart()
        elif self.started:
            self._shift = time - self.adapter.simulation_time_ns

    def update(self, time: int, outputs: Sequence[str], *, restart: bool) -> Update:
        """Step until ``time``, at most to the stop time and at most `max_steps` steps, and read outputs.

        If time has jumped back by more than half a step, ``restart`` says what to do. True, for simulated time: restart
        the FMU. False, for a wall clock that was set back: continue from the state of the FMU.

        Raises:
            FmuError: the FMU failed; only `close` is allowed now.
        """
        jumped_back = 0.0
        if self.started:
            back = (self.adapter.simulation_time_ns + self._shift - time) / 1e9
            jumped_back = back if back > self.adapter.step_size / 2 else 0.0
            if jumped_back and restart:
                self._restart()
            elif jumped_back:
                self._shift = time - self.adapter.simulation_time_ns
        if not self.started:
            self._start = time
            self._steps = 0
            self.adapter.exit_initialization_mode(Nanoseconds(time))
            self.started = True
        steps, behind = self._advance(time - self._shift)
        return Update(
            time=self.adapter.simulation_time_ns + self._shift,
            values={name: self.adapter.get_value(name) for name in outputs},
            steps=steps,
            behind=behind,
            jumped_back=jumped_back,
            ended=self._ended,
        )

    def close(self) -> None:
        """Free the FMU and remove its files. Never raises; may be called more than once."""
        self.adapter.close()

    @property
    def _ended(self) -> bool:
        return self._steps >= self._last_step

    def _load(self) -> FMIAdapter:
        adapter = FMIAdapter(self._settings.fmu_path, self._settings.step_size)
        stop_time = self._settings.stop_time
        self._last_step = math.inf
        if stop_time is not None:
            exact = steps_between(0.0, stop_time, adapter.step_size)
            self._last_step = math.floor(stop_time / adapter.step_size) if exact is None else exact
        return adapter

    def _restart(self) -> None:
        """Replace the FMU by a new instance, and set again every variable that was set."""
        self.adapter.close()
        self.started = False
        self._shift = 0
        self.adapter = self._load()
        for name, value in self._kept.items():
            self.adapter.set_initial_value(name, value)

    def _advance(self, time: int) -> tuple[int, float]:
        """Step until ``time`` on the clock of the adapter; returns the number of steps, and the rest in s."""
        before = self._steps
        allowed = min(self._settings.max_steps, self._last_step - before)
        if allowed >= 1:
            self.adapter.do_steps_until(Nanoseconds(time), max_steps=int(allowed))
        reached = self.adapter.simulation_time_ns
        self._steps = round((reached - self._start) / 1e9 / self.adapter.step_size)
        missing = (time - reached) / 1e9
        behind = missing if missing > self.adapter.step_size / 2 and not self._ended else 0.0
        return self._steps - before, behind


class FmuThread(ThreadPoolExecutor):
    """The only thread that calls one FMU, whatever executor the node is in (FMI does not require thread safety).

    The services of the node answer while the FMU computes. Call `close` last.
    """

    def __init__(self) -> None:
        self._thread: threading.Thread | None = None

        def keep() -> None:
            self._thread = threading.current_thread()

        super().__init__(1, thread_name_prefix="fmu", initializer=keep)

    def call(
        self, function: Callable[Parameters, Result], *args: Parameters.args, **kwargs: Parameters.kwargs
    ) -> Result:
        """Call a function on the thread and return its result.

        Raises:
            FmuMeshError: the function raised it.
            DeadlineExceeded: the function did not return within 60 s.
            FmuError: the function raised another exception.
        """
        return self.result(self.submit(function, *args, **kwargs))

    def result(self, future: Future[Result]) -> Result:
        """The result of a call that was submitted; raises as `call` does."""
        try:
            return future.result(_ANSWER_S)
        except FutureTimeout as error:
            raise DeadlineExceeded(f"the FMU has not returned for {_ANSWER_S:g} s.") from error
        except FmuMeshError:
            raise
        except Exception as error:
            raise FmuError(f"the FMU's thread failed: {error!r}.") from error

    def close(self) -> bool:
        """Cancel the calls that have not started, and wait up to 5 s; returns whether the thread has ended."""
        self.shutdown(wait=False, cancel_futures=True)
        if self._thread is None:
            return True
        self._thread.join(_THREAD_END_S)
        return not self._thread.is_alive()
