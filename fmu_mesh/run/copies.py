"""Many copies of one system in this process, stepped together: `Mesh.batch`.

Each copy has its own instances, rings and tables, and takes its steps as the burst does; one call of the library steps
all of them. Owns how far each copy is, how each has ended, and where their values are. Knows no names that a user has
mistyped: `fmu_mesh.api.batch` checks them.
"""

# Threads: all calls come from the one that made the copies. It calls the FMUs (ADR 12), or several threads do, of
# which each has a part of the copies, and extracts the FMUs for itself, so the variables of a library belong to one
# thread; what instances share beyond that is a claim on the process, and then there is one thread only. What is below
# as a call for `CopyThreads.each` runs on the thread of its copy, while this one waits. The library releases the lock
# of the interpreter while it steps, so other threads of the program go on; they may look at nothing here.
#
# In the process of the user, a step of an FMU that does not return cannot be ended. In one of ours, a watch looks at
# the calls, and asks from its thread which copy is under way (`fmu_mesh.run.copies_role`). Ctrl-C ends a call between
# two pieces of it, so all copies are at one point then.

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ..errors import CallRefused, FmuError, FmuMeshError, NotInOneProcess, TerminationRequested
from ..instances.call_guard import CallWatch, Unwatched
from ..instances.contract import ChangesProcess, Instance, LogMessage
from ..instances.kept_models import SharedModels
from ..instances.registry import open_instance
from ..node.burst_engine import BurstEngine
from ..node.inputs import TimedInputs
from ..node.stepping import Runner
from ..rings import native
from ..rings.host_memory import HostMemory
from ..rings.native import BurstEnd, WorkKind
from ..system.layout import row_bytes
from ..system.memory_map import MemoryMap, RingPlace, map_memory
from ..system.plan import NodePlan, Plan
from ..system.process_sharing import SharedProcess
from ..text import listed
from ..variables.value_types import is_text
from .copy_threads import CopyThreads, Pieces
from .first_points import FirstPoints
from .hosted_system import IN_ONE_NODE, HostedSystem, in_one_node
from .local_system import opening_of
from .one_process import claims_in, limited
from .run_plan import RunPlan
from .system_copy import Overrides, SavedCopy, SystemCopy, Verb
from .threads import one_thread_meanwhile

__all__ = ["Copies", "Truths"]

Truths = NDArray[np.bool_]


class Copies:
    """Copies of one plan, all at a point of their own.

    Call sequence: `start`; then `step`, `set`, `get`, `reset`, `save` and `restore`; at the end `close`.

    Args:
        run: the plan; its nodes and its window are not used.
        count: how many copies.
        folder: an existing private folder; FMUs are extracted below it.
        log: called with every log message of a model.
        threads: how many threads call the FMUs.
        watch: watches the calls of FMUs, if somebody does.

    Attributes:
        points: the last point that all instances of a copy have reached, shape (count,).
        errors: how copies have ended before the stop time, by their numbers.
    """

    def __init__(  # noqa: PLR0913  what copies need of their surroundings
        self,
        run: RunPlan,
        count: int,
        folder: Path,
        log: Callable[[LogMessage], None],
        threads: int = 1,
        *,
        watch: CallWatch | Unwatched | None = None,
    ) -> None:
        self.errors: dict[int, FmuMeshError] = {}
        self._run = run
        self._plan = plan = in_one_node(run.plan, window=1)
        self._node = plan.nodes[IN_ONE_NODE]
        self._last = plan.grid.last_point
        self._places = _rings_of(plan)
        self._rooms = HostMemory.rooms(self._places[0], count, _bytes_beside(self._node))
        self._log = log
        self._watch = watch or Unwatched()
        self._by_python: int | None = None
        self._copies: list[SystemCopy] = []
        self._table = (native.CopyTable * count)()
        self._several = threads > 1
        self._threads = CopyThreads(self._table, threads)
        folders = [folder / f"thread{number}" for number in range(len(self._threads.parts))]
        self._models = [(own, SharedModels(own)) for own in folders]
        numbers: NDArray[np.int64] = np.frombuffer(memoryview(self._table), np.int64).reshape(count, -1)
        self.points, self._goals, self._ends = numbers[:, 1], numbers[:, 2], numbers[:, 3]
        self._ended = np.zeros(count, np.bool_)
        self._set_at = {name: np.full(count, -1) for name in plan.order}
        self._is_set: set[str] = set()
        self._timed: list[str] = []
        self._accesses: dict[tuple[str, Verb, tuple[str, ...]], Any] = {}
        self._columns: dict[tuple[str, str], Any] = {}
        self._first = FirstPoints(self._threads, self._copies, self._table)
        self._limits = ExitStack()
        self._pieces = Pieces()

    def start(self, ready: Callable[[int], None] = lambda _count: None) -> None:
        """Open and initialize all copies: then they are at point 0.

        Args:
            ready: called after each one with how many there are.

        Raises:
            NotInOneProcess: copies of an instance cannot share a process.
            CallRefused: the models share something that several threads cannot use.
            FmuError: an instance cannot be opened or initialized.
        """
        self._check_sharing()
        for folder, _ in self._models:
            folder.mkdir()
        self._limits.enter_context(one_thread_meanwhile())
        for number in range(len(self._table)):
            self._copies.append(SystemCopy(partial(self._system, number)))
            self._threads.each([number], partial(self._begin, overrides={}, is_new=False))
            ready(number + 1)
        runners = self._copies[0].runners
        if self._several and any(
            isinstance(own.instance, ChangesProcess) and own.instance.changes_process for own in runners.values()
        ):
            text = "copies cannot be stepped by several threads, because a step of an FMU may change the process"
            raise CallRefused(text, hint="Use one thread.")
        self._timed = [name for name, own in runners.items() if isinstance(own.instance, TimedInputs)]
        self._limits.enter_context(one_thread_meanwhile())  # with the libraries that components have imported

    @property
    def ended(self) -> Truths:
        """Which copies take no more steps, shape (count,)."""
        ended: Truths = self._ended | (self.points >= self._last)
        return ended

    def step(self, points: int, is_asked: Callable[[], bool] = lambda: False) -> None:
        """Step all copies that have not ended, those near the stop time to that; until somebody asks to end the call.

        What an FMU raises is in `errors`, and ends its copy at the last point that all its instances have reached.
        """
        if self._pieces.step(points, is_asked, self._step_piece):
            for copy in self._copies:
                copy.take_care()

    def _step_piece(self, points: int) -> None:
        np.minimum(self.points + points, self._last, out=self._goals)
        if self.errors:
            np.copyto(self._goals, self.points, where=self._ended)
        if native.library is None:
            for number, copy in enumerate(self._copies):
                self._end_of(number, partial(copy.engine.step_to, int(self._goals[number])))
                self.points[number] = copy.engine.point
            return
        while self._threads.work(WorkKind.STEP, wanted=None):
            self._threads.each(np.flatnonzero(self._ends != BurstEnd.DONE).tolist(), self._complete)

    def _complete(self, number: int) -> None:
        self._end_of(
            number, partial(cast("BurstEngine", self._copies[number].engine).complete, int(self._ends[number]))
        )

    def _end_of(self, number: int, call: Callable[[], object]) -> None:
        """Make a call for a copy; what it raises ends the copy."""
        self._by_python = number
        try:
            call()
        except (FmuError, TerminationRequested) as error:
            self._copies[number].located(error, int(self.points[number]))
            self.end(number, error)
        finally:
            self._by_python = None

    def end(self, number: int, error: FmuMeshError) -> None:
        """From now on a copy takes no steps, until it is reset."""
        self.errors[number] = error
        self._ended[number] = True
        self._goals[number] = self.points[number]
        self._first.leave(number)

    @property
    def under_way(self) -> tuple[int | None, Runner | None]:
        """From any thread: which copy a call is for, and the instance whose step it is; None if it is not known."""
        number = self._by_python
        begun = range(len(self._copies) - 1, -1, -1) if number is None else (number,)
        for own in begun:  # those before the last one may have a step that Python takes later
            if not self._ended[own] and (runner := self._copies[own].current) is not None:
                return own, runner
        return number, None

    def reached(self, number: int) -> int:
        """From any thread: the last point that all instances of a copy have reached, also within a call."""
        current = self._copies[number].current
        return min(self._copies[number].engine.covered, self._last) if current is not None else int(self.points[number])

    # --- values

    def set(self, instance: str, name: str, values: NDArray[Any], wanted: Truths) -> None:
        """Set a variable of the ``wanted`` copies to ``values``, of shape (count, elements) and its dtype.

        What an FMU raises is in `errors`, and ends its copy.
        """
        wanted = wanted & ~self._ended
        np.copyto(self._set_at[instance], self._steps_done(instance), where=wanted)
        self._is_set.add(instance)
        variable = self._plan.system.instances[instance].description.variable(name)
        shape = variable.shape if variable is not None else ()

        def by_python(number: int) -> None:
            row = values[number].reshape(shape).tolist() if shape else values[number, 0]
            value = row.item() if isinstance(row, np.generic) else row
            self._end_of(number, partial(self._copies[number].set, instance, name, value))

        over_time = instance in self._timed and variable is not None and variable.causality == "input"
        access = None if over_time else self._access(instance, "Set", (name,))
        self._call(access, values, wanted, by_python)

    def _steps_done(self, instance: str) -> NDArray[np.int64]:
        own = self._node.instance(instance)
        done = (self.points + own.step_points - 1 - own.wait_points) // own.step_points
        return np.minimum(done, self._last // own.step_points)

    def get(self, instance: str, names: Sequence[str], out: NDArray[Any]) -> None:
        """Read variables of one type into ``out``, of shape (count, elements) and their dtype.

        Where a failed copy has no value any more, it stays as it is.
        """
        members = self._node.instance(instance)
        in_rows = all(name in members.outputs.names for name in names) and native.library is not None
        if in_rows and not is_text(members.outputs.column(names[0]).type):
            first = 0
            for name in names:
                place = members.outputs.place(name)
                size = place.size * out.itemsize
                self._read(instance, name, size, out[:, first:])
                first += place.size
            if instance not in self._is_set:
                return
            rows = self.points // members.step_points  # the model of an instance that goes ahead may be at the next one
            wanted = (self._set_at[instance] == rows) & (self._steps_done(instance) == rows)
            if not wanted.any():
                return
        else:
            wanted = np.ones(len(self._copies), np.bool_)
        if self.errors:
            wanted[[number for number, error in self.errors.items() if isinstance(error, FmuError)]] = False

        def by_python(number: int) -> None:
            copy = self._copies[number]
            values = copy.values(instance, names, int(self.points[number]), since=self._set_at[instance][number])
            out[number] = np.concatenate([np.ravel(np.array(value, out.dtype)) for value in values])

        self._call(
            self._access(instance, "Get", tuple(names)), out, wanted, lambda n: self._end_of(n, partial(by_python, n))
        )

    def _call(self, accesses: Any, values: NDArray[Any], wanted: Truths, otherwise: Callable[[int], None]) -> None:  # noqa: ANN401  an array of ctypes
        """Get or set through the library; copies for which it cannot, or fails, one by one: ``wanted`` are these."""
        if accesses is not None and native.library is not None:
            calls, own, to = ctypes.addressof(accesses), wanted.ctypes.data, values.ctypes.data
            if not self._threads.work(WorkKind.CALL, calls=calls, wanted=own, values=to, stride=values.strides[0]):
                return
        self._threads.each(np.flatnonzero(wanted).tolist(), otherwise)

    def _access(self, instance: str, verb: Verb, names: tuple[str, ...]) -> Any:  # noqa: ANN401  an array of ctypes
        """How the library gets or sets variables of all copies; None if it cannot."""
        key = instance, verb, names
        if key not in self._accesses:
            found = [copy.access(*key) for copy in self._copies]
            self._accesses[key] = native.table(native.CopyCall, found) if all(found) else None
        return self._accesses[key]

    def _read(self, instance: str, name: str, size: int, out: NDArray[Any]) -> None:
        key = instance, name
        if key not in self._columns:
            columns = [copy.column(*key) for copy in self._copies]
            self._columns[key] = native.table(native.CopyOutput, columns)
        reads, to = ctypes.addressof(self._columns[key]), out.ctypes.data
        self._threads.work(WorkKind.READ, reads=reads, wanted=None, values=to, stride=out.strides[0], size=size)

    # --- states

    @property
    def why_not_saved(self) -> str | None:
        """Why `save` is not possible, in words; None if it is."""
        instances = self._plan.system.instances
        without = [name for name, own in instances.items() if not own.description.can_get_and_set_state]
        if without:
            return f"the model description of {listed(without)} says that it cannot (canGetAndSetFMUstate)"
        return None

    def save(self) -> list[SavedCopy]:
        """Save all copies; `free` frees them.

        Raises:
            FmuError: an FMU cannot, or has failed.
        """
        saved: list[SavedCopy] = []
        for _, models in self._models:
            models.reset_from_now_on()
        try:
            self._threads.each(range(len(self._copies)), lambda number: saved.append(self._saved(number)))
        except BaseException:
            self.free(saved)
            raise
        return saved

    def _saved(self, number: int) -> SavedCopy:
        set_at = {name: int(steps[number]) for name, steps in self._set_at.items()}
        return self._copies[number].save(int(self.points[number]))._replace(set_at=set_at)

    def restore(self, saved: Sequence[SavedCopy], wanted: Truths) -> None:
        """Bring the ``wanted`` copies back to what was saved of them.

        What an FMU raises is in `errors`, and ends its copy.

        Raises:
            CallRefused: a copy has other instances since then; those before it are there.
        """

        def one(number: int) -> None:
            self._copies[number].restore(saved[number])
            self._back_at(number, saved[number].point)
            for name, step in saved[number].set_at.items():
                self._set_at[name][number] = step

        numbers = np.flatnonzero(wanted).tolist()
        self._threads.each(numbers, lambda number: self._end_of(number, partial(one, number)))

    def free(self, saved: Sequence[SavedCopy]) -> None:
        """Free saved copies, in the order of the copies."""
        self._threads.each(range(len(saved)), lambda number: self._copies[number].free(saved[number]))

    def reset(self, wanted: Truths, overrides: Callable[[int], Overrides] | None = None) -> None:
        """Bring the ``wanted`` copies back to point 0: they are as new ones.

        Args:
            wanted: which, shape (count,).
            overrides: other start values of a copy, by instance and variable; None: those of the plan.

        Raises:
            FmuError: one cannot be initialized, and has ended; those after it stay as they were.
        """
        rest = self._first.restore(wanted) if overrides is None else wanted
        back = wanted if rest is None else wanted & ~rest
        for name in self._is_set:
            np.copyto(self._set_at[name], -1, where=back)
        if rest is not None:
            self._threads.each(np.flatnonzero(rest).tolist(), partial(self._reset, overrides))

    def _reset(self, overrides: Callable[[int], Overrides] | None, number: int) -> None:
        """Make a copy as a new one."""
        if overrides is None and number not in self.errors and self._first.by_python(number):
            self._back_at(number, 0)
            return
        self._first.free(number)
        self._ended[number] = True
        own = overrides(number) if overrides is not None else {}
        try:
            self._begin(number, own, is_new=number in self.errors)
        except FmuError as error:
            self.errors[number] = error
            raise
        if overrides is None and self.why_not_saved is None:
            self._first.note(number)

    def _begin(self, number: int, overrides: Overrides, *, is_new: bool) -> None:
        copy, self._by_python = self._copies[number], number
        try:
            copy.begin(overrides, is_new=is_new)
        finally:  # without instances, nothing can be read
            self._by_python = None
            for own, columns in self._columns.items():
                columns[number] = copy.column(*own)
        if isinstance(copy.engine, BurstEngine):
            self._table[number] = copy.engine.copy
        for key, accesses in self._accesses.items():
            if accesses is not None and (access := copy.access(*key)) is not None:
                accesses[number] = access
        self._back_at(number, 0)

    def _back_at(self, number: int, point: int) -> None:
        """A copy is at a point, and has not ended."""
        self.errors.pop(number, None)
        self._ended[number] = False
        self.points[number] = self._goals[number] = point
        for steps in self._set_at.values():
            steps[number] = -1

    def close(self) -> None:
        """Close all instances and free all models. Never raises; may be called twice."""
        self._threads.each(range(len(self._copies)), self._close)
        for thread, (_, models) in enumerate(self._models):
            self._threads.on(thread, models.close)
        self._models.clear()
        self._copies.clear()
        self.end_threads()
        self._limits.close()

    def _close(self, number: int) -> None:
        self._first.free(number)
        self._copies[number].close()

    def end_threads(self) -> None:
        """End the threads that were started here, from any thread; after that, only `close` is allowed."""
        self._threads.close()

    def _check_sharing(self) -> None:
        process, claims_of = SharedProcess(), claims_in(self._plan)
        why = [reason for name in self._plan.order for reason in claims_of(name)] if self._several else []
        if why:
            raise CallRefused(f"copies cannot be stepped by several threads, where {why[0]}", hint="Use one thread.")
        for limit in limited(self._plan):
            raise NotInOneProcess(limit, hint="Copies have no such limits: leave out `process`.")
        for copy in ("", " of another copy")[: len(self._table)]:
            for name in self._plan.order:
                if (refusal := process.refusal(f"{name}{copy}", partial(claims_of, name))) is not None:
                    raise NotInOneProcess(
                        refusal, hint="Give each copy a process (`processes` as many as copies), or make one copy."
                    )

    def _system(self, number: int) -> HostedSystem:
        """The system of one copy; this object looks after the state of the process."""
        room, opened = self._rooms[number], partial(self._opened, self._threads.part_of(number))
        if number < len(self._copies):  # it had another system
            room[:] = bytes(len(room))
        return HostedSystem(self._plan, self._watch, opened, self._log, alone=True, places=self._places, room=room)

    def _opened(self, thread: int, name: str) -> Instance:
        folder, models = self._models[thread]
        opening = opening_of(self._plan, name, folder, self._log, self._run.showing)
        return open_instance(replace(opening, content=self._run.contents.get(name), kept=models))


def _bytes_beside(node: NodePlan) -> int:
    """Enough for what the engine of a copy has beside its rings: its tables, and the inputs."""
    lines = ctypes.sizeof(native.UnitTable) + sum(row_bytes(item.input_row) + 64 for item in node.instances) + 128
    return lines + len(node.instances) * ctypes.sizeof(native.MemberTable)


def _rings_of(plan: Plan) -> tuple[MemoryMap, Mapping[str, RingPlace]]:
    """The memory of one copy: as many rows as its own instances read."""
    instances = plan.system.instances
    rings = {}
    for item in plan.nodes[IN_ONE_NODE].instances:
        readers = {c.target_instance for c in plan.connections if c.source_instance == item.name} | {item.name}
        oldest = max(instances[reader].step_points for reader in readers)
        rows = 1 << (2 * -(-oldest // item.step_points)).bit_length()
        rings[item.name] = (IN_ONE_NODE, item.step_points, item.outputs, rows)
    return map_memory([IN_ONE_NODE], rings)
