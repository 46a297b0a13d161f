"""`Batch`: many copies of a mesh as arrays.

Owns names and values, in how many processes the copies are, and the private folder of those in this one. What a step
does is `fmu_mesh.run.copies`, or `fmu_mesh.run.process_copies`.
"""

# Threads: the one that made a batch calls it, and so all FMUs that are here (ADR 12). The object of a state may be
# freed on any thread: then it is only noted in `_lost`. Where the last reference to a batch is dropped on another
# thread, processes end as ever; of copies that are here, only the files are removed: their FMUs may not be called.

from __future__ import annotations

import operator
import os
import shutil
import tempfile
import threading
import weakref
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import CallRefused
from ..run.copies import Copies
from ..run.copies_messages import FIRST_COPIES
from ..run.limits import resident_bytes
from ..run.local_system import forwarded
from ..run.process import interrupts_later
from ..run.process_copies import ProcessCopies
from ..run.resetting import OtherStartValues
from ..run.run_plan import RunPlan
from ..run.system_copy import Overrides, SavedCopy
from ..text import option_text, shown
from ..variables.model_description import Variable
from ..variables.value_conversion import ValueRefused, checked_value, range_of, to_plain
from ..variables.value_types import DTYPES, is_float, is_text
from .batch_rows import BatchRows
from .result import Result
from .system_state import BatchState

__all__ = ["Batch"]

_COPIES_EACH: Final = 512
"""So many copies at least pay for a process: a round of messages takes as long as a step of some 300 small FMUs."""

_MOST_OF_MEMORY: Final = 0.9

Values = Mapping[str, ArrayLike]


class Batch:
    """Many copies of a mesh that your program steps as arrays; `Mesh.batch` makes it.

    Copy ``i`` is element ``i`` of each array, and gives the floats of a `System` with its values. Copies are
    independent: each has a point of its own, and one that fails does not end the others. All calls come from the thread
    that made the batch; with several ``threads``, each of those makes the calls of its copies. Ctrl-C ends `step` with
    all copies at one point.

    Where copies are in ``processes``, an FMU that crashes, or does not return within `timeouts.step`, ends the copies
    of its process: they are `done`, and `reset` starts another process for them. In this process, a call that hangs
    cannot be ended, and an FMU that crashes takes the program with it. Copies of an FMU in one process share its
    library, as the standard allows (FMI 2.0, 2.1.1).

    Example:
        >>> import fmu_mesh, numpy as np
        >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
        >>> with mesh.batch(3) as batch:
        ...     batch.reset(start_values={"pendulum.a": [0.1, 0.2, 0.3]})
        ...     batch.step(500)
        ...     batch.get("pendulum.a").shape, batch.get(["pendulum.a", "delay.y"]).shape
        ((3,), (3, 2))

    Args:
        run: the plan of each copy.
        copies: how many.
        threads: on how many threads they are stepped; each has its own library of each FMU, and makes all calls of its
            copies.
        processes: in how many processes they are, at most one for each; 1: in this one. None: as many as this process
            may use processors, where each has 512 copies or more.
        memory_limit: the most bytes that the rows for `result` may take; None: nothing is recorded.

    Raises:
        NotInOneProcess: copies of an FMU need a process each.
        CallRefused: there is not enough memory; ``copies`` is no number above 0; the models share something that
            several threads cannot use; or threads and processes are asked for.
        FmuError: an FMU cannot be opened or initialized. Nothing is left behind.
        MeshLost: a process has ended before its copies were ready.
    """

    def __init__(
        self,
        run: RunPlan,
        copies: int,
        threads: int = 1,
        processes: int | None = None,
        *,
        memory_limit: int | None = None,
    ) -> None:
        if copies < 1:
            raise CallRefused(f"{option_text('copies', copies)}: expected a whole number of 1 or more")
        count = _processes(copies, threads, processes)
        self._run = run
        self._count = copies
        self._thread = threading.get_ident()
        self._resets = OtherStartValues(run, loads=False)
        self._variables: dict[str, tuple[str, Variable]] = {}
        self._settable: set[str] = set()
        self._saved: weakref.WeakKeyDictionary[BatchState, list[SavedCopy]] = weakref.WeakKeyDictionary()
        self._lost: deque[list[SavedCopy]] = deque()
        folder: Path | None = None
        own: Copies | ProcessCopies
        try:
            if count > 1:
                own = ProcessCopies(run, copies, count, forwarded)
            else:
                folder = Path(tempfile.mkdtemp(prefix="fmu_mesh-"))
                own = Copies(run, copies, folder, forwarded, min(threads, copies))
        except BaseException:
            _remove(folder)
            raise
        self._copies = own
        self._release = weakref.finalize(self, _release, own, folder, self._thread)
        self._before = resident_bytes()
        self._is_looked_at = False
        self._recorded = BatchRows(run, copies, memory_limit) if memory_limit is not None else None
        try:
            own.start(self._look_at_memory)
            self._note(np.ones(copies, np.bool_))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return self._count

    def __repr__(self) -> str:
        state = f"{int(self.done.sum())} done" if self._release.alive else "closed"
        return f"<Batch of {self._count} x {self._run.mesh}: {state}>"

    @property
    def copies(self) -> int:
        """How many copies there are."""
        return self._count

    @property
    def point(self) -> NDArray[np.int64]:
        """The communication point that all instances of each copy have reached, shape (copies,)."""
        return self._copies.points.copy()

    @property
    def time(self) -> NDArray[np.float64]:
        """The simulation time of each copy in s, shape (copies,)."""
        grid = self._run.plan.grid
        return grid.start_time + self._copies.points.astype(np.float64) * grid.step_size

    @property
    def done(self) -> NDArray[np.bool_]:
        """Which copies take no more steps, shape (copies,): an FMU failed or asked to end, or it is the stop time."""
        return self._copies.ended

    @property
    def reasons(self) -> dict[int, str]:
        """Why copies are done that have not reached the stop time, by their numbers."""
        return {number: str(error) for number, error in sorted(self._copies.errors.items())}

    def step(self, points: int = 1) -> None:
        """Step all copies that are not done over ``points``, 1 or more; those near the stop time to that.

        A copy whose FMU fails, or asks to end, stays at the last point that all its instances have reached; it is
        `done`, and the others go on.

        Raises:
            CallRefused: the rows for `result` would not fit into memory; or see `close`.
        """
        self._demand("step")
        if not hasattr(points, "__index__") or operator.index(points) < 1:
            raise CallRefused(f"{option_text('points', points)}: expected a whole number of 1 or more")
        points = operator.index(points)
        with interrupts_later() as is_asked:
            if self._recorded is None:
                self._copies.step(points, is_asked)
                return
            self._recorded.make_room(min(int(self._copies.points.max()) + points, self._run.plan.grid.last_point))
            while points > 0 and not is_asked() and not self._copies.ended.all():
                self._copies.step(1, is_asked)
                self._recorded.take(self._copies.points, self.get)
                points -= 1

    def get(self, name: str | Sequence[str], out: NDArray[Any] | None = None) -> NDArray[Any]:
        """The current values of a variable, or of several ones of one type.

        Example:
            >>> import fmu_mesh
            >>> with fmu_mesh.load("configs/pendulum_delay.yaml").batch(2) as batch:
            ...     batch.get("pendulum.a").tolist()
            [1.3, 1.3]

        Args:
            name: `instance.variable`; or several such names, of variables that are no arrays.
            out: an array for the result, of its shape and dtype, whose last dimensions are contiguous.

        Returns:
            Shape (copies, dimensions of the variable), or (copies, names), in the unit of the variable. A copy whose
            FMU has failed keeps the outputs of its last point; what cannot be read is NaN, 0 or None.

        Raises:
            UnknownName: there is no such variable; suggests the nearest one.
            CallRefused: the variables have several types; or see `close`.
        """
        self._demand("get")
        names = [name] if isinstance(name, str) else list(name)
        found = [self._variable(one) for one in names]
        if len({variable.type for _, variable in found}) != 1:
            raise CallRefused(f"get needs variables of one type, and got {shown(names)}.", hint="Ask for each type.")
        first = found[0][1]
        if not isinstance(name, str) and any(variable.shape for _, variable in found):
            raise CallRefused(f"{shown(names)} has an array", hint="Ask for each array by its name alone.")
        shape = (self._count, *first.shape) if isinstance(name, str) else (self._count, len(names))
        dtype = np.dtype(DTYPES[first.type])
        if out is None:
            out = np.full(shape, np.nan if is_float(first.type) else None if is_text(first.type) else 0, dtype)
        elif out.shape != shape or out.dtype != dtype:
            raise CallRefused(f"`out` has shape {out.shape} and dtype {out.dtype}; expected {shape} and {dtype}")
        rows = out.reshape(self._count, -1)
        if not np.shares_memory(rows, out) or rows.strides[1] != dtype.itemsize:
            raise CallRefused("the last dimensions of `out` are not contiguous")
        start = 0
        while start < len(names):  # neighbours of one instance are read with one call
            end = start + 1
            while end < len(names) and found[end][0] == found[start][0]:
                end += 1
            width = sum(variable.size for _, variable in found[start:end])
            columns = rows[:, start : start + width]
            self._copies.get(found[start][0], [variable.name for _, variable in found[start:end]], columns)
            start = end
        return out

    def set(self, name: str | Values, values: ArrayLike | None = None) -> None:
        """Set an unconnected input or a tunable parameter of all copies that are not done, or several of them.

        A value holds from the next step on, as with `System.set`.

        Example:
            >>> mesh = fmu_mesh.Mesh("m", step_size=0.1, stop_time=1.0)
            >>> mesh.add("gain", fmu="fmus/Gain.fmu")
            >>> with mesh.batch(2) as batch:
            ...     batch.set("gain.u", [3.0, 4.0])
            ...     batch.step()
            ...     batch.get("gain.y").tolist()
            [3.0, 4.0]

        Args:
            name: `instance.variable`, or values by such names; none is set if one of them is refused.
            values: shape (copies, dimensions of the variable), or one value for all, in the unit of the variable.

        Raises:
            UnknownName: there is no such variable; suggests the nearest one.
            CallRefused: a variable cannot be set, or not to these values; or see `close`.
        """
        self._demand("set")
        given: Values = {name: values} if isinstance(name, str) else name  # type: ignore[dict-item]  # None is refused
        ready = [(one, *self._ready(one, own)) for one, own in given.items()]
        for one, variable, rows in ready:
            instance = self._variables[one][0]
            self._copies.set(instance, variable.name, rows, np.ones(self._count, np.bool_))

    def reset(self, mask: ArrayLike | None = None, start_values: Values | None = None) -> None:
        """Bring copies back to point 0: they are as new ones, whether they were done or not.

        Where all FMUs can get and set their state, and no start values are given, the second reset of a copy takes
        about as long as that (FMI 2.0, 2.1.8); the first one, and any other, makes new instances of the loaded models.

        Example:
            >>> import fmu_mesh, numpy as np
            >>> with fmu_mesh.load("configs/pendulum_delay.yaml").batch(2) as batch:
            ...     batch.step(100)
            ...     batch.reset(np.array([True, False]), {"pendulum.a": [0.5, 0.0]})
            ...     batch.point.tolist(), float(batch.get("pendulum.a")[0])
            ([0, 100], 0.5)

        Args:
            mask: which copies, truths of shape (copies,); None: all.
            start_values: by `instance.variable`: shape (copies, dimensions of the variable), or one value for all;
                those of other copies are ignored. They replace those of `Mesh.batch`, in this reset only.

        Raises:
            ConfigurationError: a start value is wrong; carries all findings.
            CallRefused: see `close`.
            FmuError: an FMU cannot be initialized; its copy, and those after it, are as they were, or done.
        """
        self._demand("reset")
        wanted = self._wanted("mask", mask)
        overrides = self._overrides(wanted, start_values) if start_values else None
        try:
            self._copies.reset(wanted, overrides)
        finally:
            self._note(wanted)

    def result(self, copy: int) -> Result:
        """What a copy has recorded, from its last `reset` or `restore` to its point.

        Example:
            >>> import fmu_mesh
            >>> with fmu_mesh.load("configs/pendulum_delay.yaml").batch(2, record=["pendulum.a"]) as batch:
            ...     batch.step(3)
            ...     result = batch.result(1)
            ...     result.names, result.times.tolist(), result["pendulum.a"].shape
            (['pendulum.a'], [0.0, 0.002, 0.004, 0.006], (4,))

        Returns:
            As that of a run which ended at the point of the copy; its arrays are copies.

        Raises:
            CallRefused: there is no such copy, or the batch does not record; or see `close`.
        """
        self._demand("result")
        if self._recorded is None:
            raise CallRefused(
                "result needs rows, and this batch records nothing", hint='Make it with `record="memory"`.'
            )
        if not hasattr(copy, "__index__") or not 0 <= operator.index(copy) < self._count:
            raise CallRefused(f"{option_text('copy', copy)}: expected a number from 0 to {self._count - 1}")
        return self._recorded.result(operator.index(copy), self._copies.errors.get(operator.index(copy)))

    def _note(self, wanted: NDArray[np.bool_]) -> None:
        """Copies are at a point to which no step has led."""
        if self._recorded is not None:
            self._recorded.begin(wanted, self._copies.points)
            self._recorded.take(self._copies.points, self.get)

    def save(self) -> BatchState:
        """Save the state of all copies: every instance, the values between them, and what was set (FMI 2.0, 2.1.8).

        Returns:
            The state. It is freed with the object, with its `close`, or with the batch.

        Raises:
            CallRefused: an FMU cannot get and set its state; or see `close`.
            FmuError: an FMU failed.
        """
        self._demand("save")
        self._free_lost()
        if (why := self._copies.why_not_saved) is not None:
            raise CallRefused(f"the state cannot be saved: {why}.", hint="Use `reset` to go back to the first point.")
        saved = self._copies.save()
        state = BatchState(self.point, partial(self._lost.append, saved))
        self._saved[state] = saved
        return state

    def restore(self, state: BatchState, copies: ArrayLike | None = None) -> None:
        """Bring copies back, or ahead, to what `save` has saved of them; as often as you like.

        Args:
            state: of this batch.
            copies: which copies, truths of shape (copies,); None: all.

        Raises:
            CallRefused: it is no state of this batch, or is closed; the FMU of a copy has failed since then, so that a
                reset has made new instances; or see `close`.
            FmuError: an FMU failed.
        """
        self._demand("restore")
        saved = None if getattr(state, "closed", True) else self._saved.get(state)
        if saved is None:
            raise CallRefused("restore needs a state that this batch has saved, and that is not closed.")
        self._free_lost()
        wanted = self._wanted("copies", copies)
        self._copies.restore(saved, wanted)
        self._note(wanted)

    def close(self) -> None:
        """Free all FMUs and states, and remove the files. May be called twice.

        Raises:
            CallRefused: this is not the thread that made the batch. Every other method raises this, too, and also where
                the batch is closed.
        """
        if self._release.alive:
            self._demand("close")
            self._release()

    def _demand(self, call: str) -> None:
        if threading.get_ident() != self._thread:
            text = f"{call} is not possible here, because a batch belongs to the thread that made it."
            raise CallRefused(text, hint="Make a batch on each thread that steps one.")
        if not self._release.alive:
            raise CallRefused(f"{call} is not possible, because the batch is closed.")

    def _variable(self, name: str) -> tuple[str, Variable]:
        found = self._variables.get(name)
        if found is None:
            found = self._variables[name] = self._run.variable(name)
        return found

    def _ready(self, name: str, values: ArrayLike) -> tuple[Variable, NDArray[Any]]:
        """The variable, and its values as rows, if it may be set to them."""
        instance, variable = self._variable(name)
        item = self._run.plan.nodes[self._run.plan.node_of(instance)].instance(instance)
        try:
            if name not in self._settable:
                item.check_settable(variable)
                self._settable.add(name)
            rows = self._rows(values, variable, finite=item.not_finite == "stop")
        except ValueRefused as refused:
            raise CallRefused(f"it {refused}.", instance=instance, variable=variable.name) from refused
        return variable, rows

    def _rows(
        self, values: ArrayLike, variable: Variable, *, finite: bool, wanted: NDArray[np.bool_] | None = None
    ) -> NDArray[Any]:
        """Values as an array of shape (copies, elements); only those of the ``wanted`` copies are checked."""
        shape, dtype = (self._count, *variable.shape), np.dtype(DTYPES[variable.type])
        given = np.asarray(values)
        if given.shape != shape and given.shape not in {(), variable.shape}:
            expected = f"{shape}, or {variable.shape} for all copies"
            raise ValueRefused(f"cannot be set to values of shape {given.shape}; expected {expected}")
        every = np.broadcast_to(given, shape)
        if given.dtype.kind in "iuf" and dtype.kind == "f":
            rows = every.astype(dtype)
            checked = rows if wanted is None else rows[wanted]
            if finite and not np.isfinite(checked).all():
                raise ValueRefused("cannot be set to values that are not finite")
            low, high = variable.minimum, variable.maximum
            if (low is not None and (checked < low).any()) or (high is not None and (checked > high).any()):
                raise ValueRefused(f"cannot be set to a value out of its range: expected {range_of(variable)}")
        else:
            rows = np.zeros(shape, dtype)
            for number in range(self._count) if wanted is None else np.flatnonzero(wanted).tolist():
                own = every[number]
                plain = own.tolist() if isinstance(own, np.ndarray | np.generic) else own
                rows[number] = checked_value(plain, variable, f"cannot be set: {shown(plain)}", finite=finite)
        return np.ascontiguousarray(rows).reshape(self._count, -1)

    def _wanted(self, option: str, mask: ArrayLike | None) -> NDArray[np.bool_]:
        if mask is None:
            return np.ones(self._count, np.bool_)
        wanted = np.asarray(mask)
        if wanted.dtype != np.bool_ or wanted.shape != (self._count,):
            raise CallRefused(
                f"`{option}` has shape {wanted.shape} and dtype {wanted.dtype}; expected truths of shape "
                f"({self._count},)"
            )
        return wanted

    def _overrides(self, wanted: NDArray[np.bool_], start_values: Values) -> Callable[[int], Overrides]:
        """The start values of a copy, by its number."""
        found: list[tuple[str, str, str, list[Any]]] = []
        for name, values in start_values.items():
            instance, variable = self._variable(name)
            try:
                rows = self._rows(values, variable, finite=False, wanted=wanted)
            except ValueRefused as refused:
                raise CallRefused(f"'{name}' {refused}.") from refused
            found.append((name, instance, variable.name, rows.reshape(self._count, *variable.shape).tolist()))

        def of_copy(number: int) -> dict[str, dict[str, Any]]:
            own: dict[str, dict[str, Any]] = {}
            for _, instance, variable, values in found:
                own.setdefault(instance, {})[variable] = values[number]
            return own

        for number in np.flatnonzero(wanted)[:1].tolist():  # the names and roles are the same in all copies
            self._resets.of_reset({name: to_plain(values[number]) for name, _, _, values in found})
        return of_copy

    def _look_at_memory(self, ready: int, taken: int | None = None) -> None:
        """Once some copies are there: whether all of them fit into memory."""
        if self._is_looked_at or ready < FIRST_COPIES or self._count <= ready:
            return
        self._is_looked_at = True
        each = (taken if taken is not None else max(0, resident_bytes() - self._before)) // ready
        needed, free = each * (self._count - ready), os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        if needed > _MOST_OF_MEMORY * free:
            text = f"{self._count} copies take about {each * self._count / 2**30:.1f} GiB of memory, {each / 1024:.0f} "
            raise CallRefused(f"{text}KiB each; {free / 2**30:.1f} GiB are free", hint="Make fewer copies.")

    def _free_lost(self) -> None:
        """Free the states whose objects are gone, which may have happened on any thread."""
        while self._lost:
            self._copies.free(self._lost.popleft())


def _processes(copies: int, threads: int, processes: int | None) -> int:
    """In how many processes the copies are."""
    if processes is not None and processes > 1:
        if threads > 1:
            text = f"{option_text('threads', threads)} and {option_text('processes', processes)} exclude each other"
            raise CallRefused(text, hint="Leave one of them out; threads are those of this process.")
        if not hasattr(os, "memfd_create"):
            raise CallRefused(f"{option_text('processes', processes)}: several processes need Linux")
        return min(processes, copies)
    if processes == 1 or threads > 1 or not hasattr(os, "memfd_create"):
        return 1
    return max(1, min(len(os.sched_getaffinity(0)), copies // _COPIES_EACH))


def _release(copies: Copies | ProcessCopies, folder: Path | None, thread: int) -> None:
    """Free everything. On another thread only the files and processes: an FMU is only called on its own."""
    if threading.get_ident() == thread or isinstance(copies, ProcessCopies):
        copies.close()
    else:
        copies.end_threads()
    _remove(folder)


def _remove(folder: Path | None) -> None:
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)
