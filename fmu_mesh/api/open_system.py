"""`System`: a mesh that a program steps in its own process, and `SystemState`: where to go back to.

Owns names, modes and the private folder. What a step does is `fmu_mesh.run.local_system`, which `--local` shares.
"""

from __future__ import annotations

import logging
import operator
import shutil
import tempfile
import threading
import weakref
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from ..errors import CallRefused, ErrorReport, FmuError, TerminationRequested, UnknownName
from ..instances.call_guard import Guarded, Unwatched
from ..instances.contract import LogMessage
from ..instances.registry import open_instance
from ..printing import paragraph
from ..run.local_system import LocalSystem, SavedSystem, opening_of
from ..run.one_process import OneProcess
from ..run.run_plan import RunPlan
from ..simtime import ENDLESS
from ..text import listed, option_text, shown
from ..variables.value_conversion import ValueRefused, checked_value
from ..variables.value_types import DTYPES

__all__ = ["System", "SystemState", "forwarded"]

log = logging.getLogger(__name__)

Mode = Literal["ready", "ended", "failed", "interrupted", "closed"]

_BACK = "Restore a state that was saved before, or close the system."


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

    Raises:
        NotInOneProcess: two instances cannot share a process.
        FmuError: an FMU cannot be opened or initialized. Nothing is left behind.
    """

    def __init__(self, run: RunPlan) -> None:
        plan = run.plan
        OneProcess().check(plan, run.contents)
        self._run = run
        self._grid = plan.grid
        self._thread = threading.get_ident()
        self._mode: Mode = "ready"
        self._ended_by: ErrorReport | None = None
        self._getters: dict[str, Callable[[int], Any]] = {}
        self._saved: weakref.WeakKeyDictionary[SystemState, SavedSystem] = weakref.WeakKeyDictionary()
        self._lost: deque[SavedSystem] = deque()
        self._local = local = LocalSystem(plan)
        folder = Path(tempfile.mkdtemp(prefix="fmu_mesh-"))
        self._release = weakref.finalize(self, _release, local, folder, self._thread)
        try:
            local.start(partial(_opened, run, folder))
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
        so. Ctrl-C ends this call with `KeyboardInterrupt` in the middle of a step: then only `restore` and `close` are
        allowed.

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
            FmuError: an FMU failed; has the instance, the point and the time. Only `close` is allowed now.
        """
        self._demand("step")
        if not hasattr(points, "__index__"):
            raise CallRefused(f"{option_text('points', points)}: expected a whole number")
        count, local = operator.index(points), self._local
        if count < 1:
            raise CallRefused(f"step was given {count} points; expected 1 or more.")
        if count > (left := self._grid.last_point - local.point):
            text = f"step was given {count} points, and {left} are left until the stop time {self._grid.stop_time:g} s."
            raise CallRefused(text, hint="Raise `stop_time`; null has no end.")
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
            FmuError: the FMU failed. Only `close` is allowed now.
        """
        self._demand("get", "ended")
        if not isinstance(name, str):
            raise UnknownName(f"{shown(name)} is no name of a variable.")
        read = self._getters.get(name) or self._getter(name)
        try:
            return read(self._local.point)
        except FmuError as error:
            self._mode = "failed"
            error.at(self.point, self.time)
            raise

    def set(self, name: str, value: object) -> None:
        """Set an unconnected input or a tunable parameter. It holds from the next step on.

        A slower instance uses it in the step that is not complete yet, as it uses an input with a delay of 0.

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
            FmuError: the FMU refuses the value. Only `close` is allowed now.
        """
        self._demand("set")
        instance, variable = self._run.variable(name)
        own = self._run.plan.nodes[self._run.plan.node_of(instance)].instance(instance)
        try:
            own.check_settable(variable)
        except ValueRefused as refused:
            raise CallRefused(f"it {refused}.", instance=instance, variable=variable.name) from refused
        try:
            checked = checked_value(value, variable, shown(value), finite=own.not_finite == "stop")
        except ValueRefused as refused:
            raise CallRefused(f"{refused}.", instance=instance, variable=variable.name) from refused
        with self._changing():
            self._local.set(instance, variable.name, checked)

    def save(self) -> SystemState:
        """Save the state of the whole system: every instance, and the values between them (FMI 2.0, 2.1.8).

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

        Returns:
            The state. It is freed with the object, with its `close`, or with the system.

        Raises:
            CallRefused: an FMU cannot get and set its state; or see `close`.
            FmuError: an FMU failed. Only `close` is allowed now.
        """
        self._demand("save")
        instances = self._run.plan.system.instances
        without = [name for name, own in instances.items() if not own.description.can_get_and_set_state]
        if without:
            why = "as the model description says (canGetAndSetFMUstate)"
            text = f"the state of {listed(without)} cannot be saved, {why}."
            raise CallRefused(text, instance=without[0], hint="Open the mesh again to start from its first point.")
        self._free_lost()
        with self._changing():
            saved = self._local.save()
        state = SystemState(saved.point, partial(self._lost.append, saved))
        self._saved[state] = saved
        return state

    def restore(self, state: SystemState) -> None:
        """Go back, or ahead, to a state of `save`; as often as you like.

        Raises:
            CallRefused: it is not a state of this system, or it is closed; or see `close`.
            FmuError: an FMU failed. Only `close` is allowed now.
        """
        self._demand("restore", "ended", "interrupted")
        saved = None if getattr(state, "closed", True) else self._saved.get(state)
        if saved is None:
            raise CallRefused("restore needs a state that this system has saved, and that is not closed.")
        self._free_lost()
        with self._changing():
            self._local.restore(saved)
        self._ended_by = None

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

    def _demand(self, call: str, *also: Mode) -> None:
        """Check that a call is allowed now; ``also`` has the modes besides `ready` in which it is."""
        self._demand_thread(call)
        if self._mode == "ready" or self._mode in also:
            return
        ended = self._ended_by
        who = ended.instance if ended is not None else None
        reason, hint = {
            "ended": (f"'{who}' has asked to end the simulation", _BACK),
            "failed": ("an instance has failed before", "Only close() is allowed now."),
            "interrupted": ("the last call was interrupted in the middle", _BACK),
            "closed": ("the system is closed", None),
        }[self._mode]
        raise CallRefused(f"{call} is not possible, because {reason}.", hint=hint)

    def _demand_thread(self, call: str) -> None:
        if threading.get_ident() != self._thread:
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

    def _getter(self, name: str) -> Callable[[int], Any]:
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


class SystemState:
    """The state of a `System` at a point, for `System.restore`; it belongs to this system.

    Example:
        >>> with fmu_mesh.load("configs/pendulum_delay.yaml").open() as system:
        ...     system.step(10)
        ...     with system.save() as state:
        ...         system.step(10)
        ...         system.restore(state)
        ...     system.point, state.point, state.closed
        (10, 10, True)

    Attributes:
        point: the communication point.
    """

    def __init__(self, point: int, release: Callable[[], None]) -> None:
        self.point = point
        self._release = weakref.finalize(self, release)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<SystemState: point {self.point}{', closed' if self.closed else ''}>"

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return not self._release.alive

    def close(self) -> None:
        """Give the memory of the state back; the FMUs free it at the next `save`, `restore` or `System.close`."""
        self._release()


def _opened(run: RunPlan, folder: Path, name: str) -> Guarded:
    opening = opening_of(run.plan, name, folder, forwarded, run.showing)
    return Guarded(name, lambda: open_instance(opening), Unwatched(), run.plan.system.config.timeouts)


def forwarded(message: LogMessage) -> None:
    """Give the log a message of a model."""
    level = {"ok": logging.DEBUG, "warning": logging.WARNING}.get(message.status.lower(), logging.ERROR)
    said = map(paragraph, (message.category, message.message))
    log.log(level, "fmu_message instance=%s category=%s: %s", message.instance, *said)


def _release(local: LocalSystem, folder: Path, thread: int) -> None:
    """Free everything. On another thread only the files: an FMU is only called on its own."""
    if threading.get_ident() == thread:
        local.close()
    shutil.rmtree(folder, ignore_errors=True)
