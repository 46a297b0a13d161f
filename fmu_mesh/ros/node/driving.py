"""One FMU driven by the time of a ROS node, without ROS: what happens at each turn of the node's timer.

Owns the `FMIAdapter`, catching up within a bound, pauses, the stop time, and what follows when time jumps back. Knows
nothing of topics, of ROS parameters and of rclpy. All times are nanoseconds of the node's clock.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import msgspec

from ...adapter import FMIAdapter, Nanoseconds
from ...adapter.argument_checks import Arguments
from ...simtime import steps_between
from ...variables.model_description import ModelDescription, Value

__all__ = ["DriveSettings", "FmuDriver", "Turn"]


class DriveSettings(msgspec.Struct, frozen=True, kw_only=True):
    """How an FMU is driven.

    Attributes:
        fmu_path: the .fmu file.
        step_size: communication step size in s; None takes the default experiment's.
        stop_time: the last step ends here at the latest, in s of the FMU's time; None: no end.
        max_steps: how many steps a turn may take to catch up.
    """

    fmu_path: Path
    step_size: float | None = None
    stop_time: float | None = None
    max_steps: int = 1000


class Turn(msgspec.Struct, frozen=True, kw_only=True):
    """What one turn did.

    Attributes:
        time: the time that the outputs belong to, in ns.
        values: the outputs that were asked for, by name.
        steps: how many steps were taken.
        behind: by how much the FMU is behind although it took all the steps it may, in s; else 0.
        jumped_back: by how much time had jumped back before this turn, in s; else 0.
        ended: whether the stop time is reached.
    """

    time: int
    values: dict[str, Value]
    steps: int = 0
    behind: float = 0.0
    jumped_back: float = 0.0
    ended: bool = False


class FmuDriver:
    """One FMU driven by a clock that may pause, jump ahead and jump back. All calls come from one thread.

    Call sequence: `set_value` as often as needed, then `resume`, and `turn` and `set_input` as long as time goes on;
    `resume` again after each pause; `close` at the end.

    The FMU's time is 0.0 at the first turn, and does not go on between the last turn before a pause and `resume`.

    Args:
        settings: how the FMU is driven.

    Raises:
        CallRefused: a setting is out of its range.
        LoadFailed: the FMU cannot be read, extracted or instantiated.
    """

    def __init__(self, settings: DriveSettings) -> None:
        self._settings = settings
        self._kept: dict[str, Value] = {}
        self._adapter = self._load()
        self._arguments = Arguments(settings.fmu_path.stem, self._adapter.description)
        self._started = False
        self._shift = 0
        self._start = 0
        self._steps = 0

    @property
    def description(self) -> ModelDescription:
        """The model description."""
        return self._adapter.description

    @property
    def step_size(self) -> float:
        """The communication step size in s."""
        return self._adapter.step_size

    @property
    def started(self) -> bool:
        """Whether the FMU has left Initialization Mode, so that only tunable parameters can change."""
        return self._started

    def check_value(self, name: str, value: Value) -> Value:
        """The value that `set_value` would set now, in the type of the variable. Any thread may call this.

        Raises:
            CallRefused: the variable cannot be set now, or has another type or range.
        """
        variable = self._arguments.tunable(name) if self._started else self._arguments.settable(name)
        return self._arguments.value(variable, value)

    def set_value(self, name: str, value: Value) -> None:
        """Set a start value before the first turn, or a tunable parameter later; it outlives a jump back of time.

        Raises:
            CallRefused: the variable cannot be set now, or has another type or range.
            FmuError: the FMU refuses it.
        """
        if self._started:
            self._adapter.set_parameter_value(name, value)
        else:
            self._adapter.set_initial_value(name, value)
        self._kept[name] = value

    def get_value(self, name: str) -> Value:
        """The current value of a variable."""
        value: Value = self._adapter.get_value(name)
        return value

    def set_input(self, name: str, time: int, value: Value) -> None:
        """An input has ``value`` from ``time`` on.

        Raises:
            CallRefused: there is no such input, or it has another type or range.
        """
        self._adapter.set_input_value(name, Nanoseconds(time - self._shift), value)

    def resume(self, time: int) -> None:
        """Go on at ``time`` where the FMU is; from its beginning if it has reached the stop time."""
        if self._started and self._ended:
            self._restart()
        elif self._started:
            self._shift = time - self._adapter.simulation_time_ns

    def turn(self, time: int, outputs: Sequence[str], *, restart: bool) -> Turn:
        """Step until ``time``, as far as the bound of steps and the stop time allow, and read outputs.

        Args:
            time: now.
            outputs: names of variables to read.
            restart: what to do when time has jumped back by more than half a step: start from the beginning, which is
                what simulated time means by it; or go on from where the FMU is, as when somebody sets the wall clock.

        Raises:
            FmuError: the FMU failed; only `close` is allowed now.
        """
        jumped_back = 0.0
        if self._started:
            back = (self._adapter.simulation_time_ns + self._shift - time) / 1e9
            jumped_back = back if back > self.step_size / 2 else 0.0
            if jumped_back and restart:
                self._restart()
            elif jumped_back:
                self._shift = time - self._adapter.simulation_time_ns
        if not self._started:
            self._begin(time)
        steps, behind = self._advance(time - self._shift)
        return Turn(
            time=self._adapter.simulation_time_ns + self._shift,
            values={name: self._adapter.get_value(name) for name in outputs},
            steps=steps,
            behind=behind,
            jumped_back=jumped_back,
            ended=self._ended,
        )

    def close(self) -> None:
        """Free the FMU and remove its files. Never raises; may be called twice."""
        self._adapter.close()

    def remove_files(self) -> None:
        """From any thread, when the process is about to be ended while the FMU does not return: remove its files."""
        self._adapter.remove_files()

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

    def _begin(self, time: int) -> None:
        self._start = time
        self._steps = 0
        self._adapter.exit_initialization_mode(Nanoseconds(time))
        self._started = True

    def _restart(self) -> None:
        """A new instance with the same values: what a variable was set to holds again, what it came to does not."""
        self._adapter.close()
        self._started = False
        self._shift = 0
        self._adapter = self._load()
        for name, value in self._kept.items():
            self._adapter.set_initial_value(name, value)

    def _advance(self, time: int) -> tuple[int, float]:
        """Step until ``time`` on the adapter's clock; how many steps that were, and how far behind it is then, in s."""
        before = self._steps
        allowed = min(self._settings.max_steps, self._last_step - before)
        if allowed >= 1:
            self._adapter.do_steps_until(Nanoseconds(time), max_steps=int(allowed))
        reached = self._adapter.simulation_time_ns
        self._steps = round((reached - self._start) / 1e9 / self.step_size)
        missing = (time - reached) / 1e9
        behind = missing if missing > self.step_size / 2 and not self._ended else 0.0
        return self._steps - before, behind
