"""`System`: a mesh that a program steps in its own process.

Owns names, modes and the private folder. What a step does is `fmu_mesh.run.local_system`, which `--local` shares.
"""

from __future__ import annotations

import logging
import operator
import shutil
import tempfile
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from threading import get_ident
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from msgspec.structs import replace

from ..errors import CallRefused, ErrorReport, FmuError, FmuMeshError, TerminationRequested, UnknownName
from ..instances.call_guard import Guarded, Unwatched
from ..instances.kept_models import KeptModels
from ..instances.registry import open_instance
from ..run.local_system import LocalSystem, SavedSystem, forwarded, opening_of
from ..run.one_process import OneProcess
from ..run.options import ResetOptions
from ..run.resetting import OtherStartValues
from ..run.run_plan import RunPlan
from ..run.state_file import StateFile, state_bytes, with_replaced, write_state
from ..simtime import ENDLESS
from ..system.played_nodes import stateless
from ..text import listed, option_text, shown
from ..variables.value_conversion import ValueRefused, checker
from ..variables.value_types import DTYPES, PlainValue
from .system_state import SystemState

__all__ = ["System"]

log = logging.getLogger(__name__)

Mode = Literal["ready", "ended", "failed", "interrupted", "closed"]

_BACK = "Restore a state that was saved before, reset the system, or close it."


class System:
    """A mesh that your program steps, in this process and on one thread; `Mesh.open` makes it.

    Each step is that of `fmu-mesh launch --local`, so its floats are those of any run. There are no other processes and
    no files of results. Call sequence: `step`, with `get`, `set`, `save` and `restore` between two steps; `close`, or
    the end of a `with` block, at the end. All calls come from the thread that made the system.

    A call that hangs in an FMU cannot be ended, and an FMU that crashes takes the program with it: `Mesh.run` and
    `Mesh.start` put each FMU into a process of its own.

    Example:
        >>> import fmu_mesh
        >>> with fmu_mesh.load("configs/pendulum_delay.yaml").open() as system:
        ...     while system.time < 1.0:
        ...         system.step()
        ...     state = system.save()
        ...     system.step(100)
        ...     later = system.get("pendulum.a")
        ...     system.restore(state)
        ...     system.time, system.get("pendulum.a") == later
        (1.0, False)

    Args:
        run: the plan of the run.
        plan_again: plans it again for a reset, with these start values besides; None: from its configuration.
        state: where it begins; None: at point 0.
        replaced: the instances that begin anew there.

    Raises:
        ConfigurationError: the state is not one of this mesh.
        NotInOneProcess: two instances cannot share a process.
        FmuError: an FMU cannot be opened or initialized. Nothing is left behind.
    """

    def __init__(
        self,
        run: RunPlan,
        plan_again: Callable[[Mapping[str, Any]], RunPlan] | None = None,
        state: StateFile | None = None,
        replaced: Sequence[str] = (),
    ) -> None:
        first = with_replaced(run, replaced)
        begins_with, point = (state.check(first), state.head.point) if state is not None else (None, 0)
        self._resets = OtherStartValues(run, plan_again, loads=False)
        self._plan = plan = run.plan
        OneProcess().check(plan, run.contents)
        self._run = run
        self._others: Mapping[str, Mapping[str, PlainValue]] = {}  # start values that are not as in the plan
        self._grid = plan.grid
        self._last = plan.grid.last_point
        self._thread = get_ident()
        self._mode: Mode = "ready"
        self._ended_by: ErrorReport | None = None
        self._getters: dict[str, Callable[[int], Any]] = {}
        self._setters: dict[str, _Setter] = {}
        self._saved: weakref.WeakKeyDictionary[SystemState, SavedSystem | None] = weakref.WeakKeyDictionary()
        self._lost: deque[SavedSystem] = deque()
        self._first: SavedSystem | None = None
        self._guards: dict[str, Guarded] = {}
        folder = Path(tempfile.mkdtemp(prefix="fmu_mesh-"))
        self._models = KeptModels(folder, resets=True)
        self._local = local = LocalSystem(plan, self._models)
        self._release = weakref.finalize(self, _release, local, folder, self._thread)
        try:
            local.start(self._opened, first.plan, begins_with=begins_with, point=point)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<System {self._run.mesh}: {self._mode}, point {self.point}, {self.time:g} s>"

    @property
    def time(self) -> float:
        """The simulation time in s that all instances have reached."""
        return self._grid.time(self._local.point)

    @property
    def point(self) -> int:
        """The communication point that all instances have reached: `time` is `start_time + point * step_size`."""
        return self._local.point

    @property
    def last_point(self) -> int | None:
        """The last communication point, that of `stop_time`; None without a stop time."""
        return self._grid.last_point if self._grid.last_point < ENDLESS else None

    @property
    def ended_by(self) -> ErrorReport | None:
        """Which FMU has asked to end the simulation, at which point; None while none has (FMI 2.0, 4.2.3)."""
        return self._ended_by

    def step(self, points: int = 1) -> None:
        """Step all instances to the next communication point, or over several.

        If an FMU asks to end the simulation, this returns at the last point that all have reached, and `ended_by` says
        so. Ctrl-C ends this call with `KeyboardInterrupt` in the middle of a step: then only `restore`, `reset` and
        `close` are allowed.

        Example:
            >>> with fmu_mesh.load("configs/pendulum_delay.yaml").open() as system:
            ...     system.step()
            ...     system.step(499)
            ...     system.point, system.time
            (500, 1.0)

        Args:
            points: how many points, 1 or more.

        Raises:
            CallRefused: there are not so many points left, or an FMU has asked to end; or see `close`.
            FmuError: an FMU failed; has the instance, the point and the time. Only `reset` and `close` are allowed now.
        """
        if self._mode != "ready" or get_ident() != self._thread:
            self._demand("step")
        local = self._local
        count = points if points.__class__ is int and 0 < points <= self._last - local.point else self._count(points)
        self._mode = "interrupted"
        try:
            for _ in range(count):
                local.step()
        except TerminationRequested as asked:
            self._mode, self._ended_by = "ended", asked.report()
            return
        except FmuError:
            self._mode = "failed"
            raise
        self._mode = "ready"

    def get(self, name: str) -> Any:  # noqa: ANN401 what type it is, the model says
        """The current value of any variable.

        Example:
            >>> with fmu_mesh.load("configs/pendulum_delay.yaml").open() as system:
            ...     system.get("pendulum.a"), system.get("pendulum.l")
            (1.3, 1.0)

        Args:
            name: `instance.variable`; an element of an array is `instance.variable[1,2]`.

        Returns:
            A float, int, bool, str or bytes in the unit of the variable; an Enumeration as its number; an array as a
            numpy array of your own, which later steps do not change.

        Raises:
            UnknownName: there is no such variable; suggests the nearest one.
            CallRefused: see `close`.
            FmuError: the FMU failed. Only `reset` and `close` are allowed now.
        """
        if self._mode != "ready" or get_ident() != self._thread:
            self._demand("get", "ended")
        try:
            read = self._getters[name]
        except (KeyError, TypeError):
            read = self._getter(name)
        try:
            return read(self._local.point)
        except FmuError as error:
            self._mode = "failed"
            error.at(self.point, self.time)
            raise

    def set(self, name: str, value: object) -> None:
        """Set an unconnected input or a tunable parameter. It holds from the next step on.

        A slower instance uses it in the step that is not complete yet, as it uses an input with a delay of 0; one whose
        target interpolates has taken this step already (docs/coupling.md), and uses it in the next one.

        Example:
            >>> mesh = fmu_mesh.Mesh("m", step_size=0.1, stop_time=1.0)
            >>> mesh.add("gain", fmu="fmus/Gain.fmu")
            >>> with mesh.open() as system:
            ...     system.set("gain.u", 3.0)
            ...     system.step()
            ...     system.get("gain.y")
            3.0

        Args:
            name: `instance.variable`.
            value: a number, bool, str or bytes in the unit of the variable; an Enumeration also by the name of an item;
                an array as a numpy array or nested lists of its shape.

        Raises:
            UnknownName: there is no such variable; suggests the nearest one.
            CallRefused: the variable cannot be set, or not to this value; or see `close`.
            FmuError: the FMU refuses the value. Only `reset` and `close` are allowed now.
        """
        if self._mode != "ready" or get_ident() != self._thread:
            self._demand("set")
        try:
            setter = self._setters[name]
        except (KeyError, TypeError):
            setter = self._setter(name)
        try:
            checked = setter.check(value)
        except ValueRefused as refused:
            raise CallRefused(f"{refused}.", instance=setter.instance, variable=setter.variable) from refused
        self._mode = "interrupted"
        try:
            setter.put(checked)
        except FmuError as error:
            self._mode = "failed"
            error.at(self.point, self.time)
            raise
        self._mode = "ready"

    def set_many(self, values: Mapping[str, object]) -> None:
        """Set several variables at once, as `set` does: all of them, or none if one is refused.

        All values of an instance are set in one call, so that values that belong together make one event of its FMU.

        Example:
            >>> mesh = fmu_mesh.Mesh("m", step_size=0.1, stop_time=1.0)
            >>> mesh.add("gain", fmu="fmus/Gain.fmu")
            >>> with mesh.open() as system:
            ...     system.set_many({"gain.u": 3.0, "gain.k": 2.0})
            ...     system.step()
            ...     system.get("gain.y")
            6.0

        Args:
            values: the values by `instance.variable`, each as `set` takes it.

        Raises:
            UnknownName: there is no such variable; suggests the nearest one. Nothing was set.
            CallRefused: a variable cannot be set, or not to this value; or see `close`. Nothing was set.
            FmuError: an FMU refuses a value. Only `reset` and `close` are allowed now.
        """
        self._demand("set_many")
        if not isinstance(values, Mapping):
            raise CallRefused(f"{option_text('values', values)}: expected a mapping of values by name")
        checked: dict[str, dict[str, Any]] = {}
        for name, value in values.items():
            setter = self._setters.get(name) or self._setter(name)
            try:
                checked.setdefault(setter.instance, {})[setter.variable] = setter.check(value)
            except ValueRefused as refused:
                raise CallRefused(f"{refused}.", instance=setter.instance, variable=setter.variable) from refused
        with self._changing():
            for instance, own in checked.items():
                self._local.set(instance, own)

    def save(self, file: str | Path | None = None) -> SystemState:
        """Save the state of the whole system: every instance, and the values between them (FMI 2.0, 2.1.8).

        With ``file``, the state is also written there, and `Mesh.open` goes on from it at any time in another process:
        ``mesh.open(state="a.state")``. Every float is then that of this system, if it goes on from here.

        The steps that follow are those of a system that was not saved. One exception: where the FMU of a state is
        solved by CVode (model exchange), the solver starts anew, so later floats may differ in their last digits. They
        are the same after each `restore`.

        Example:
            >>> with fmu_mesh.load("configs/pendulum_delay.yaml").open() as system:
            ...     state = system.save()
            ...     ends = []
            ...     for _ in range(2):
            ...         system.restore(state)
            ...         system.step(1000)
            ...         ends.append(system.get("delay.y"))
            ...     ends[0] == ends[1]
            True

        Args:
            file: where the state is written; a file of this name is replaced. None: nowhere.

        Returns:
            The state. It is freed with the object, with its `close`, or with the system.

        Raises:
            CallRefused: an FMU cannot get and set its state, or write it; or see `close`.
            ConfigurationError: the file cannot be written.
            FmuError: an FMU failed: only `reset` and `close` are allowed now. Or the state of an instance cannot be
                written, as that of a component with an attribute that is no plain value: nothing has changed.
        """
        self._demand("save")
        if file is not None and not isinstance(file, str | Path):
            raise CallRefused(f"{option_text('file', file)}: expected the name of a file")
        instances = self._plan.system.instances
        without = [name for name, own in instances.items() if not own.description.can_get_and_set_state]
        if without:
            why = "as the model description says (canGetAndSetFMUstate)"
            text = f"the state of {listed(without)} cannot be saved, {why}."
            raise CallRefused(text, instance=without[0], hint="Open the mesh again to start from its first point.")
        lasting = stateless(self._plan.system, keys=False) if file is not None else {}
        for name, why in lasting.items():
            raise CallRefused(f"its state cannot be written to a file: {why}.", instance=name)
        self._free_lost()
        with self._changing():
            saved = self._local.save()
        if file is not None:
            try:
                run = replace(self._run, plan=self._plan)
                packed = self._local.packed(saved)
                write_state(Path(file), state_bytes(run, saved.point, packed, self._others))
            except FmuMeshError:
                self._local.free(saved)
                raise
        state = SystemState(saved.point, partial(self._lost.append, saved))
        self._saved[state] = saved
        return state

    def restore(self, state: SystemState) -> None:
        """Go back, or ahead, to a state of `save`; as often as you like.

        Raises:
            CallRefused: it is not a state of this system, or it is closed; or see `close`.
            FmuError: an FMU failed. Only `reset` and `close` are allowed now.
        """
        self._demand("restore", "ended", "interrupted")
        if getattr(state, "closed", True) or state not in self._saved:
            raise CallRefused("restore needs a state that this system has saved, and that is not closed.")
        saved = self._saved[state]
        if saved is None:
            raise CallRefused("the state is gone, because a reset has initialized the instances again since then.")
        self._free_lost()
        with self._changing():
            self._local.restore(saved)
        self._ended_by = None

    def reset(self, start_values: Mapping[str, Any] | None = None) -> None:
        """Go back to point 0: every float is that of a newly opened system. Nothing is loaded again.

        What was `set` is gone, and so is the progress of scenarios. From the second reset on, the instances go back to
        their states of point 0, if all FMUs can get and set them and no start values are given. Otherwise each FMU is
        reset (fmi2Reset; FMI 2.0, 2.1.6), or gets a new instance, and is initialized again: then states that were saved
        before are gone. An FMU that has failed is loaded again.

        Example:
            >>> with fmu_mesh.load("configs/pendulum_delay.yaml").open() as system:
            ...     system.step(100)
            ...     system.reset()
            ...     first = system.point, system.get("pendulum.a")
            ...     system.reset({"pendulum.a": 0.5})
            ...     first, system.get("pendulum.a")
            ((0, 1.3), 0.5)

        Args:
            start_values: by `instance.variable`: these replace those of `open`, in this reset only.

        Raises:
            ConfigurationError: a start value is wrong, or changes the size of an array. Nothing has changed.
            CallRefused: this is not the thread that made the system, or it is closed.
            FmuError: an instance cannot be initialized. Only `reset` and `close` are allowed now.
        """
        self._demand("reset", "ended", "interrupted", "failed")
        self._free_lost()
        first = self._first
        if start_values or first is None or self._mode == "failed":
            self._begin_again(start_values)
            return
        self._mode = "interrupted"
        try:
            self._local.restore(first)
        except FmuError as error:
            self._mode = "failed"
            error.at(self.point, self.time)
            raise
        self._mode, self._ended_by = "ready", None

    def close(self) -> None:
        """Free all FMUs and states, and remove the files. May be called twice.

        A system is also closed when the last reference to it is gone, and at the end of the program.

        Raises:
            CallRefused: this is not the thread that made the system. Every other method raises this, too, and also
                where the system is closed, or an FMU has failed.
        """
        if self._mode != "closed":
            self._demand_thread("close")
            self._mode = "closed"
            self._release()

    def _begin_again(self, start_values: Mapping[str, Any] | None) -> None:
        """Initialize all instances again."""
        values = dict(ResetOptions(start_values=start_values).start_values or {})
        self._plan, self._others = self._resets.of_reset(values)
        self._getters.clear()
        self._setters.clear()
        self._first = None
        for state in self._saved:
            self._saved[state] = None
        with self._changing():
            self._local.start(self._opened, self._plan, self._others)
            instances = self._plan.system.instances.values()
            if not values and all(own.description.can_get_and_set_state for own in instances):
                self._first = self._local.save()
        self._ended_by = None

    def _opened(self, name: str) -> Guarded:
        opening = opening_of(self._plan, name, self._models.folder, forwarded, self._run.showing)
        opening, before = replace(opening, kept=self._models), self._guards.get(name)
        timeouts, is_harmless = self._plan.system.config.timeouts, before is not None and before.is_harmless
        guard = Guarded(name, lambda: open_instance(opening), Unwatched(), timeouts, is_harmless=is_harmless)
        self._guards[name] = guard
        return guard

    def _count(self, points: object) -> int:
        """The number of points of a step, if it is one, and so many are left."""
        if not hasattr(points, "__index__"):
            raise CallRefused(f"{option_text('points', points)}: expected a whole number")
        count = operator.index(points)
        if count < 1:
            raise CallRefused(f"step was given {count} points; expected 1 or more.")
        if count > (left := self._last - self._local.point):
            text = f"step was given {count} points, and {left} are left until the stop time {self._grid.stop_time:g} s."
            raise CallRefused(text, hint="Raise `stop_time`; null has no end.")
        return count

    def _demand(self, call: str, *also: Mode) -> None:
        """Check that a call is allowed now; ``also`` has the modes besides `ready` in which it is."""
        self._demand_thread(call)
        if self._mode == "ready" or self._mode in also:
            return
        ended = self._ended_by
        who = ended.instance if ended is not None else None
        reason, hint = {
            "ended": (f"'{who}' has asked to end the simulation", _BACK),
            "failed": ("an instance has failed before", "Only reset() and close() are allowed now."),
            "interrupted": ("the last call was interrupted in the middle", _BACK),
            "closed": ("the system is closed", None),
        }[self._mode]
        raise CallRefused(f"{call} is not possible, because {reason}.", hint=hint)

    def _demand_thread(self, call: str) -> None:
        if get_ident() != self._thread:
            text = f"{call} is not possible here, because a system belongs to the thread that made it."
            raise CallRefused(text, hint="Open a system on each thread that steps one.")

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Around calls that change all instances or none: after any other exception, the system is at no point."""
        self._mode = "interrupted"
        try:
            yield
        except FmuError as error:
            self._mode = "failed"
            error.at(self.point, self.time)
            raise
        self._mode = "ready"

    def _setter(self, name: str) -> _Setter:
        instance, variable = self._run.variable(name)
        own = self._plan.nodes[self._plan.node_of(instance)].instance(instance)
        try:
            own.check_settable(variable)
        except ValueRefused as refused:
            raise CallRefused(f"it {refused}.", instance=instance, variable=variable.name) from refused
        check = checker(variable, finite=own.not_finite == "stop")
        made = _Setter(instance, variable.name, check, self._local.setter(instance, variable.name))
        self._setters[name] = made
        return made

    def _getter(self, name: str) -> Callable[[int], Any]:
        if not isinstance(name, str):
            raise UnknownName(f"{shown(name)} is no name of a variable.")
        instance, variable = self._run.variable(name, elements=True)
        plain = self._local.getter(instance, name.removeprefix(f"{instance}."))
        is_array, dtype = variable.shape and name == f"{instance}.{variable.name}", DTYPES[variable.type]
        read = (lambda point: np.array(plain(point), dtype)) if is_array else plain
        self._getters[name] = read
        return read

    def _free_lost(self) -> None:
        """Free the states whose objects are gone, which may have happened on any thread."""
        while self._lost:
            self._local.free(self._lost.popleft())


class _Setter(NamedTuple):
    """What sets a variable: ``check`` makes its value of what was given, or raises `ValueRefused`; ``put`` sets it."""

    instance: str
    variable: str
    check: Callable[[object], Any]
    put: Callable[[Any], None]


def _release(local: LocalSystem, folder: Path, thread: int) -> None:
    """Free everything. On another thread only the files: an FMU is only called on its own."""
    if get_ident() == thread:
        local.close()
    shutil.rmtree(folder, ignore_errors=True)
