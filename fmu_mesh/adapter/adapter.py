"""`FMIAdapter`: one FMU in a user's own program, which calls its steps.

Owns the modes, the time reached and the FMU's private folder. Knows nothing of meshes and Zenoh, and of ROS only its
times.
"""

from __future__ import annotations

import itertools
import logging
import math
import os
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal, Self

from ..errors import FmuError
from ..instances.contract import LogMessage
from ..instances.fmi.archive.reading import read_description
from ..instances.fmi.fmu_instance import FmuInstance
from ..instances.fmi.opening import open_instance
from ..instances.fmi.step_options import StepOptions
from ..instances.input_trajectory import Trajectory
from ..instances.process_state import LOOK_STEPS, kept_mode, kept_state
from ..printing import paragraph
from ..system.start_values import forbidden
from ..variables.model_description import ModelDescription, Value
from ..variables.value_types import is_float
from .argument_checks import Arguments
from .times import CallerClock, Instant, Nanoseconds, NanosecondsClock, RosTime, SecondsClock, Time

__all__ = ["FMIAdapter"]

log = logging.getLogger(__name__)

_instance_numbers = itertools.count(1)
_HALF = Fraction(1, 2)


class FMIAdapter:
    """One co-simulation FMU of FMI 1.0, 2.0 or 3.0, stepped by the program that owns this object.

    Call sequence: `set_initial_value` as often as needed, `exit_initialization_mode`, then `do_step` or
    `do_steps_until` with `set_input_value` and `get_output_value` in between; `close`, or the end of a `with` block, at
    the end. All calls come from one thread.

    Times are those of the caller's clock, which may have any zero: seconds, or a time of ROS (`rclpy.time.Time`, the
    stamp of a header, `Nanoseconds`), which is exact to the nanosecond. All times must be of the same kind as that of
    `exit_initialization_mode`. The FMU's own time starts at 0.0. A step from t to t + h does this:

        for every input with a trajectory: set its value at t
        fmi2DoStep from t to t + h

    The trajectory of an input is its value at the start, and each value of `set_input_value` from its time on. In
    between, a Real is linear if ``interpolate_input`` is true and else constant; every other type is constant. After
    the last time the last value holds.

    Args:
        fmu_path: the .fmu file.
        step_size: communication step size in s, or a `rclpy.duration.Duration`; None takes the default experiment's.
        interpolate_input: whether Real inputs are linear between their times.
        deep_binding: whether the library of the FMU finds its own functions and variables before those of the program.

    Raises:
        CallRefused: ``step_size`` is not above 0, or missing here and in the FMU.
        LoadFailed: the FMU cannot be read, extracted or instantiated. Nothing is left behind.

    Example:
        >>> with fmu_mesh.FMIAdapter("fmus/Gain.fmu", step_size=0.5) as gain:
        ...     gain.set_initial_value("k", 2.0)
        ...     gain.exit_initialization_mode(0.0)
        ...     gain.set_input_value("u", 0.0, 21.0)
        ...     print(gain.do_steps_until(1.0), gain.get_output_value("y"))
        1.0 42.0
    """

    def __init__(
        self,
        fmu_path: str | os.PathLike[str],
        step_size: float | RosTime | None = None,
        interpolate_input: bool = True,  # noqa: FBT001, FBT002 as the constructor of fmi_adapter has it
        *,
        deep_binding: bool = True,
    ) -> None:
        path = Path(fmu_path)
        self._description = description = read_description(path)
        # No instance of a configuration can have this name, so an adapter and a mesh can be in one process.
        name = f"{description.model_identifier}@{next(_instance_numbers)}"
        self._arguments = Arguments(name, description)
        self._step_size = self._arguments.step_size(step_size)
        self._interpolate_input = interpolate_input
        self._mode: Literal["initialization", "stepping", "failed", "closed"] = "initialization"
        self._entered = False
        self._start_values: dict[str, Value] = {}
        self._early_inputs: dict[str, dict[Instant, Value]] = {}
        self._initial_inputs: dict[str, Value] = {}
        self._trajectories: dict[str, Trajectory] = {}
        self._clock: CallerClock = SecondsClock(0.0)
        self._elapsed = Fraction(0)
        self._point = 0
        self._folder = folder = Path(tempfile.mkdtemp(prefix="fmu_mesh-"))
        try:
            with kept_state(keep_mode=True):
                own = StepOptions(deep_binding=deep_binding)
                self._instance = open_instance(path, name, description, folder, _forward, options=own)
            self._careful = self._instance.changes_process
            self._release = weakref.finalize(self, _release, self._instance, folder)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def description(self) -> ModelDescription:
        """The model description, with units, types and start values."""
        return self._description

    @property
    def all_variable_names(self) -> tuple[str, ...]:
        """Names of all variables, in the order of the model description; the next three have the same order."""
        return tuple(self._arguments.all)

    @property
    def input_variable_names(self) -> tuple[str, ...]:
        """Names of all inputs."""
        return tuple(self._arguments.inputs)

    @property
    def output_variable_names(self) -> tuple[str, ...]:
        """Names of all outputs."""
        return tuple(self._arguments.outputs)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of all parameters that can be set; these are all but calculated parameters."""
        return tuple(self._arguments.parameters)

    @property
    def can_handle_variable_communication_step_size(self) -> bool:
        """Whether the FMU supports steps of different sizes."""
        return self._description.can_handle_variable_step_size

    @property
    def default_experiment_step(self) -> float | None:
        """The step size in s of the FMU's default experiment, or None."""
        return self._description.default_experiment.step_size

    @property
    def step_size(self) -> float:
        """The default step size in s: that of the constructor, or else the FMU's."""
        return self._step_size

    @property
    def is_in_initialization_mode(self) -> bool:
        """Whether `exit_initialization_mode` has not been called yet."""
        return self._mode == "initialization"

    @property
    def simulation_time(self) -> float:
        """The time that the FMU has reached, on the caller's clock, in s.

        Raises:
            CallRefused: there is none before `exit_initialization_mode`.
        """
        self._demand("stepping", "simulation_time")
        return self._clock.from_fmu(float(self._elapsed))

    @property
    def simulation_time_ns(self) -> int:
        """The same in ns; exact to the nanosecond if the clock is one of ROS.

        Raises:
            CallRefused: there is none before `exit_initialization_mode`.
        """
        self._demand("stepping", "simulation_time_ns")
        return self._clock.nanoseconds_from_fmu(float(self._elapsed))

    def set_initial_value(self, name: str, value: Value) -> None:
        """Set a parameter, an input or the initial value of another variable.

        A variable that FMI forbids to set, such as an output with initial 'calculated', is set with a warning in the
        log: some FMUs accept it.

        Raises:
            CallRefused: the mode, the name or the type is wrong, or the variable cannot be set before the start.
            InitializationFailed: the FMU refuses it, here or in `exit_initialization_mode`.

        Example:
            >>> with fmu_mesh.FMIAdapter("fmus/DampedPendulum.fmu") as pendulum:
            ...     pendulum.set_initial_value("a", 1.3)  # rad
            ...     pendulum.set_initial_value("l", 2.0)  # m
            ...     pendulum.exit_initialization_mode(0.0)
            ...     pendulum.get_output_value("a")
            1.3
        """
        self._demand("initialization", "set_initial_value")
        variable = self._arguments.settable(name)
        if not variable.settable_before_start:
            log.warning("start_value instance=%s: %s", self._arguments.instance, forbidden(variable, self._description))
        converted = self._arguments.value(variable, value)
        if not self._entered:
            self._start_values[name] = converted
            if variable.causality == "structuralParameter":  # arrays may have other shapes now
                self._arguments = Arguments(self._arguments.instance, self._description.sized(self._start_values))
            return
        early = variable.causality == "structuralParameter" or variable.initial != "exact"
        if variable.causality != "input" and early:  # FMI 2.0, 4.2.4
            raise self._arguments.refusal("it can only be set before the first value is read.", variable=name)
        with self._fmu_called():
            self._instance.set_values({name: converted})

    def exit_initialization_mode(self, time: Time) -> None:
        """Start the simulation: ``time`` (s, or a time of ROS) on the caller's clock is 0.0 on the FMU's.

        An input whose trajectory begins at or before ``time`` starts with its value there, any other with its initial
        value.

        Raises:
            CallRefused: it was called before, or ``time`` is not a finite number, or its kind differs from the times of
                inputs that were set before.
            InitializationFailed: the FMU refuses a start value, or does not start.
        """
        self._demand("initialization", "exit_initialization_mode")
        start = self._arguments.time(time)
        self._clock = NanosecondsClock(start.nanoseconds) if isinstance(start, Nanoseconds) else SecondsClock(start)
        early = {name: {self._on_fmu_clock(t): v for t, v in own.items()} for name, own in self._early_inputs.items()}
        self._enter()
        with self._fmu_called():
            names = self.input_variable_names
            self._initial_inputs = dict(zip(names, self._instance.get_values(names), strict=True))
            for name, values in early.items():
                trajectory = self._begin_trajectory(name, initial=min(values) > self._clock.resolution(0.0))
                for when, value in values.items():
                    trajectory.add(when, value)
            self._early_inputs.clear()
            self._set_inputs(0.0)
            self._instance.exit_initialization()
        self._mode = "stepping"

    def set_input_value(self, name: str, time: Time, value: Value) -> None:
        """Add a value to the trajectory of an input: it is valid from ``time`` (caller's clock) on.

        Times may come in any order and lie any time ahead. Of several values for one time the last one counts. A past
        time, also one before the start, is accepted: its value holds from the next step on, unless a value with a later
        time is already used.

        Raises:
            CallRefused: the adapter is closed, or the name, the type or the time is wrong.

        Example:
            >>> with fmu_mesh.FMIAdapter("fmus/Gain.fmu", step_size=1.0) as gain:
            ...     gain.exit_initialization_mode(0.0)
            ...     gain.set_input_value("u", 0.0, 10.0)
            ...     gain.set_input_value("u", 2.0, 20.0)  # in between it is linear
            ...     for _ in range(3):
            ...         print(gain.do_step(), gain.get_output_value("y"))
            1.0 10.0
            2.0 15.0
            3.0 20.0
        """
        self._demand(None, "set_input_value")
        converted = self._arguments.value(self._arguments.find(name, self._arguments.inputs, "an input"), value)
        instant = self._arguments.time(time)
        if self._mode == "initialization":
            self._early_inputs.setdefault(name, {})[instant] = converted
            return
        when = self._on_fmu_clock(instant)
        if name not in self._trajectories:
            self._begin_trajectory(name, initial=when > self._clock.resolution(0.0))
        self._trajectories[name].add(when, converted)

    def set_parameter_value(self, name: str, value: Value) -> None:
        """Change a tunable parameter between two steps.

        Raises:
            CallRefused: the mode, the name or the type is wrong, or the parameter is not tunable.
            StepFailed: the FMU refuses it; only `close` is allowed now.
        """
        self._demand("stepping", "set_parameter_value")
        converted = self._arguments.value(self._arguments.tunable(name), value)
        with self._fmu_called():
            self._instance.set_values({name: converted})

    def do_step(self, step_size: float | RosTime | None = None) -> float:
        """Advance by one step of ``step_size`` (s; None: the default one) and return the time reached, in s.

        Raises:
            CallRefused: the mode is wrong, or the step size is not above 0, or this FMU does not support it.
            StepFailed: the FMU failed; only `close` is allowed now.
        """
        self._demand("stepping", "do_step")
        default = self._step_size
        self._step(default if step_size is None else self._arguments.other_step_size(step_size, default))
        return self.simulation_time

    def do_steps_until(self, time: Time, max_steps: int | None = None) -> float:
        """Step with the default step size to the time that is nearest to ``time``; return the time reached, in s.

        Of two equally near times the earlier one is used. So the time reached may be up to half a step later than
        ``time``. A ``time`` in the past is no error if it is at most half a step ago.

        Args:
            time: on the caller's clock.
            max_steps: take no more steps than this, to stay responsive when the caller's clock jumps ahead.

        Raises:
            CallRefused: the mode is wrong, or the FMU is already more than half a step past ``time``.
            StepFailed: the FMU failed; only `close` is allowed now.

        Example:
            >>> with fmu_mesh.FMIAdapter("fmus/DampedPendulum.fmu", step_size=0.02) as pendulum:
            ...     pendulum.exit_initialization_mode(0.0)
            ...     pendulum.do_steps_until(0.055)  # 0.06 is nearer than 0.04
            0.06
        """
        self._demand("stepping", "do_steps_until")
        if max_steps is not None and max_steps < 1:
            raise self._arguments.refusal(f"max_steps is {max_steps!r}; expected 1 or more.")
        target = Fraction(self._on_fmu_clock(self._arguments.time(time)))
        missing = (target - self._elapsed) / Fraction(self._step_size)
        if missing < -_HALF:
            now = self.simulation_time
            wanted = self._clock.from_fmu(float(target))
            raise self._arguments.refusal(f"cannot step until {wanted!r} s, because {now!r} s is already reached.")
        steps = max(0, math.ceil(missing - _HALF))
        for _ in range(steps if max_steps is None else min(steps, max_steps)):
            self._step(self._step_size)
        return self.simulation_time

    def get_output_value(self, name: str) -> Any:  # noqa: ANN401 what type it is, the FMU says
        """The current value of an output; before the first step, its initial value.

        Raises:
            CallRefused: the adapter is closed, or there is no such output.
            FmuError: the FMU refuses it; only `close` is allowed now.
        """
        self._arguments.find(name, self._arguments.outputs, "an output")
        return self.get_value(name)

    def get_value(self, name: str) -> Any:  # noqa: ANN401 what type it is, the FMU says
        """The current value of any variable.

        Raises:
            CallRefused: the adapter is closed, or there is no such variable.
            FmuError: the FMU refuses it; only `close` is allowed now.
        """
        self._demand(None, "get_value")
        self._arguments.find(name, self._arguments.all, "a variable")
        self._enter()
        with self._fmu_called():
            return self._instance.get_values([name])[0]

    def close(self) -> None:
        """Free the FMU and remove its files. Never raises; may be called twice."""
        self._mode = "closed"
        self._release()

    def remove_files(self) -> None:
        """From any thread, before the process is ended because the FMU does not return: remove its files."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def _demand(self, mode: Literal["initialization", "stepping"] | None, call: str) -> None:
        if self._mode in ("initialization", "stepping") and mode in (None, self._mode):
            return
        reason, hint = {
            "closed": ("the adapter is closed", None),
            "failed": ("the FMU has failed before", "Only close() is allowed now."),
            "initialization": ("the adapter is in initialization mode", "Call exit_initialization_mode first."),
            "stepping": (
                "initialization mode is over",
                "Inputs change by set_input_value, tunable parameters by set_parameter_value.",
            ),
        }[self._mode]
        raise self._arguments.refusal(f"{call} is not possible, because {reason}.", hint)

    def _on_fmu_clock(self, time: Instant) -> float:
        """A time of the caller on the FMU's clock, in s."""
        when = self._clock.to_fmu(time)
        if when is None:
            other, own = ("s", "ns") if isinstance(time, float) else ("ns", "s")
            raise self._arguments.refusal(
                f"{time!r} is a time in {other}, and this adapter's clock is in {own}.",
                "Give all times as the one of exit_initialization_mode: as times of ROS, or as seconds.",
            )
        return when

    def _enter(self) -> None:
        """Enter Initialization Mode, as late as possible, because some values can only be set before."""
        if not self._entered:
            with self._fmu_called():
                self._instance.enter_initialization(0.0, None, self._start_values)
            self._entered = True

    def _begin_trajectory(self, name: str, *, initial: bool) -> Trajectory:
        """A new trajectory; if ``initial`` is true, it starts with the initial value at 0.0."""
        linear = self._interpolate_input and is_float(self._arguments.inputs[name].type)
        self._trajectories[name] = trajectory = Trajectory(linear=linear)
        if initial:
            trajectory.add(0.0, self._initial_inputs[name])
        return trajectory

    def _step(self, step_size: float) -> None:
        time = float(self._elapsed)
        with self._fmu_called():
            self._set_inputs(time)
            self._instance.advance(time, step_size)
        # A Fraction is exact: with a constant step size, its float is point * step_size.
        self._elapsed += Fraction(step_size)
        self._point += 1

    def _set_inputs(self, time: float) -> None:
        resolution = self._clock.resolution(time)
        values = {name: trajectory.value(time, resolution) for name, trajectory in self._trajectories.items()}
        if values:
            self._instance.set_values(values)

    @contextmanager
    def _fmu_called(self) -> Iterator[None]:
        """Around every call of the FMU: restore the state of the process as a `Guarded` does, and note a failure."""
        stepping = self._mode == "stepping"
        looks = not stepping or self._careful or self._point % LOOK_STEPS == 0
        try:
            with kept_state(keep_mode=True) if looks else kept_mode() as state:
                yield
        except FmuError as error:
            if stepping:
                error.at(self._point, self.simulation_time)
            self._mode = "failed"
            raise
        self._careful = self._careful or (state is not None and state.changed)


def _forward(message: LogMessage) -> None:
    level = {"ok": logging.DEBUG, "warning": logging.WARNING}.get(message.status, logging.ERROR)
    said = map(paragraph, (message.category, message.message))
    log.log(level, "fmu_message instance=%s category=%s: %s", message.instance, *said)


def _release(instance: FmuInstance, folder: Path) -> None:
    with kept_state(keep_mode=True):
        instance.close()
    shutil.rmtree(folder, ignore_errors=True)
