"""A whole mesh in one process: the reference of invariant 1, and `launch --local`.

A plain loop over points and instances. It uses the same plan as the nodes but none of their code. A distributed run
must give bit-for-bit the same result.
"""

from __future__ import annotations

import logging
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing, suppress
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from ..config.loading import LoadedConfig
from ..errors import ConfigurationError, FmuError, FmuMeshError, Interrupted, StepFailed, TerminationRequested
from ..instances.call_guard import CallWatch, Guarded, floating_point_changed, restore_floating_point
from ..instances.contract import Instance, LogMessage, Opening, Showing
from ..instances.registry import open_instance
from ..master.pacing import Pacer
from ..recorder.row_buffer import RowBuffer
from ..rings.array_elements import scaled
from ..rings.ring import Ring
from ..simtime import TimeGrid
from ..system.algebraic_loop import FixedPoint
from ..system.coupling_rule import CouplingRule
from ..system.initialization_plan import Loop, Tear
from ..system.layout import Layout
from ..system.plan import Plan
from ..variables.value_types import Value
from .child import is_other_python
from .outcome import Outcome
from .results import open_result, what_is_kept
from .threads import one_thread_meanwhile

__all__ = ["LocalMesh"]

log = logging.getLogger(__name__)

_ROWS = 1024
_FLUSH_S = 0.2


class LocalMesh:
    """Runs a plan in this process, as fast as its real-time factor allows.

    ```python
    outcome = LocalMesh(prepare(Path("configs/pendulum_delay.yaml"))).run()
    print(outcome.point, outcome.file)
    ```

    Args:
        plan: the plan; its nodes and its window are not used.
        log: called with every log message of an FMU.
        progress: called with the point now and then.
        open_instance: opens an instance by name, instead of the model of the plan; it is closed here.
        on_hang: called on another thread if an FMU does not return in time. All rows so far are in the result file.
            The thread that is inside the FMU cannot be stopped, so the caller has to end the process.
        parent: an existing folder to extract FMUs into; by default the folder for temporary files.
        showing: whether and how a physics engine shows its world.
        loaded: the configuration; None: that of the plan, with paths relative to the working directory.

    Attributes:
        point: the last point reached.
        rows: rows in the result file, once the run is over.
    """

    def __init__(  # noqa: PLR0913, PLR0917  what a caller may want to hear of
        self,
        plan: Plan,
        log: Callable[[LogMessage], None] = lambda _message: None,
        progress: Callable[[int], None] = lambda _point: None,
        open_instance: Callable[[str], Instance] | None = None,
        on_hang: Callable[[FmuError], None] = lambda error: log.error("%s", error),
        parent: Path | None = None,
        showing: Showing = Showing(),  # noqa: B008  a frozen Struct
        loaded: LoadedConfig | None = None,
    ) -> None:
        self.point = 0
        self._seconds = 0.0
        self._ended_by: TerminationRequested | None = None
        self._buffer: RowBuffer | None = None
        self.rows = 0
        self._plan = plan
        self._log = log
        self._progress = progress
        self._open_instance = open_instance
        self._on_hang = on_hang
        self._parent = parent
        self._stepping = ""
        self._showing = showing
        self._loaded = loaded if loaded is not None else LoadedConfig(plan.system.config, Path())
        self._stop: str | None = None
        self._stopped = threading.Event()
        self._folder: Path | None = None

    def interrupt(self, reason: str) -> None:
        """From any thread: end the run with `Interrupted` at the next point."""
        self._stop = reason
        self._stopped.set()

    def clean_up(self) -> None:
        """From another thread, if the main thread does not return from an FMU: keep the rows, remove other files."""
        self._save_from_outside()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def run(self) -> Outcome:
        """Run from the first to the last point.

        Raises:
            FmuMeshError: an FMU failed, the run was interrupted, or this system cannot run in one process. The rows
                that were recorded before are kept.
        """
        self._check_one_process()
        try:
            self._run()
        except FmuMeshError as error:
            error.with_hint(self._kept())
            raise
        ended_by = self._ended_by.report() if self._ended_by is not None else None
        return Outcome(
            state="done",
            point=self.point,
            time=self._plan.grid.time(self.point),
            seconds=self._seconds,
            rows=self.rows,
            file=self._plan.system.result_file,
            ended_by=ended_by,
        )

    def _kept(self) -> str | None:
        return what_is_kept(self._plan.system.result_file, self.rows)

    def _check_one_process(self) -> None:
        """Refuse what cannot run in one process; groups do not matter here.

        Raises:
            ConfigurationError: a component needs another Python, or there are two instances of an FMU that allows one.
        """
        for name, node in self._plan.nodes.items():
            if node.interpreter is not None and is_other_python(node.interpreter) and self._open_instance is None:
                text = f"'{name}' needs the Python '{node.interpreter}', and this process is another one"
                raise ConfigurationError(text, hint="Run it without --local.")
        first_of: dict[str, str] = {}
        for name, instance in self._plan.system.instances.items():
            if instance.description.only_once_per_process and self._open_instance is None:
                first = first_of.setdefault(instance.description.guid, name)
                if first != name:
                    text = (
                        f"'{first}' and '{name}' cannot run in one process: their FMU allows one instance per process"
                    )
                    raise ConfigurationError(text, hint="Run it without --local.")

    def _run(self) -> None:
        plan = self._plan
        layouts = {name: Layout.of(i.description.variables) for name, i in plan.system.instances.items()}
        types = [layouts[instance].column(name).type for instance, name in plan.system.recorded]
        members: dict[str, _Member] = {}
        watch = CallWatch(self._take_hang)
        with (
            ExitStack() as threads,
            tempfile.TemporaryDirectory(prefix="fmu_mesh-", dir=self._parent) as folder,
            closing(watch),
        ):
            threads.enter_context(one_thread_meanwhile())
            self._folder = Path(folder)
            file = open_result(self._loaded, plan.system) if plan.system.result_file else None
            self._buffer = rows = RowBuffer(file, plan.grid, types)
            try:
                for name in plan.order:
                    members[name] = _Member(plan, name, self._guarded(name, Path(folder), watch))
                threads.enter_context(one_thread_meanwhile())  # with the libraries that a component has imported
                self._initialize(members)
                started = time.perf_counter()
                try:
                    with watch.stepping(self._position, plan.system.config.timeouts.step):
                        self._loop(members, rows)
                finally:
                    self._seconds = time.perf_counter() - started
            finally:
                self._save()
                for member in members.values():
                    member.instance.close()

    def _open(self, name: str, folder: Path) -> Instance:
        if self._open_instance is not None:
            return self._open_instance(name)
        item = self._plan.nodes[self._plan.node_of(name)].instance(name)
        opening = Opening(
            name=name,
            path=Path(item.fmu),
            section=item.section,
            description=self._plan.system.instances[name].description,
            folder=folder,
            limits=self._plan.system.config.limits,
            linear_inputs=item.linear_inputs,
            log=self._log,
            showing=self._showing,
        )
        return open_instance(opening)

    def _guarded(self, name: str, folder: Path, watch: CallWatch) -> Guarded:
        return Guarded(name, lambda: self._open(name, folder), watch, self._plan.system.config.timeouts)

    def _take_hang(self, error: FmuError) -> None:
        """From the watching thread: the main thread is inside an FMU, so nothing of this object changes any more."""
        if self._stepping:
            error.at(self.point, self._plan.grid.time(self.point))
        self._save_from_outside()
        self._on_hang(error.with_hint(self._kept()))

    def _save_from_outside(self) -> None:
        with suppress(FmuMeshError):  # the process ends now for another reason
            self._save()

    def _position(self) -> tuple[str, int]:
        """Which instance steps at which point; while all wait for the wall clock, the answer changes all the time."""
        return (self._stepping, self.point) if self._stepping else ("", time.monotonic_ns())

    def _initialize(self, members: dict[str, _Member]) -> None:
        grid = self._plan.grid
        for member in members.values():
            stop_time = grid.told_stop_time(member.plan.step_points)
            member.instance.enter_initialization(grid.start_time, stop_time, member.plan.start_values)
        levels = self._plan.initialization.levels
        known: dict[tuple[str, str], Value] = {}
        loops = iter((*self._plan.initialization.loops, None))
        loop = next(loops)
        for (name, variable), level in sorted(levels.items(), key=lambda item: item[1]):
            if loop is not None and level >= loop.first:
                self._iterate(loop, members, known)
                loop = next(loops)
            if (name, variable) not in known:
                members[name].set_initial_inputs(known)
                known[(name, variable)] = members[name].instance.get_values([variable])[0]
        for member in members.values():
            member.set_initial_inputs(known)
        for member in members.values():
            member.instance.exit_initialization()
            member.bind(grid, members)

    def _iterate(self, loop: Loop, members: dict[str, _Member], known: dict[tuple[str, str], Value]) -> None:
        """Iterate an algebraic loop until its values are consistent."""
        point = FixedPoint(loop, self._plan.system.config.initialization)
        before = dict(known)
        consistent = False
        while not consistent:
            known.clear()
            known.update(before)
            for name, variable in loop.outputs:
                members[name].set_initial_inputs(known, point.assumed)
                known[(name, variable)] = members[name].instance.get_values([variable])[0]
            consistent = point.update([self._brought(tear, known) for tear in loop.tears])
        for name, variable in point.assumed:
            members[name].settled.add(variable)

    def _brought(self, tear: Tear, known: dict[tuple[str, str], Value]) -> Value:
        c = next(c for c in self._plan.connections if (c.target_instance, c.target_name) == (tear.target, tear.input))
        return scaled(_at(known[c.source_instance, c.source.name], c.source_index), c.factor, c.offset)

    def _loop(self, members: dict[str, _Member], rows: RowBuffer) -> None:
        plan, grid = self._plan, self._plan.grid
        recorded = [members[instance].reader(variable) for instance, variable in plan.system.recorded]
        factor = plan.system.config.simulation.real_time_factor
        pacer = Pacer(plan, factor)
        pacer.start(0)
        try:
            for point in range(grid.last_point + 1):
                self.point = point
                if recorded:
                    rows.add([read(point // points) for read, points in recorded])
                if point % _ROWS == _ROWS - 1:
                    rows.write()
                    self._progress(point)
                if factor and point < grid.last_point:
                    self._wait_for_the_clock(pacer, rows)
                if self._stop is not None:
                    raise Interrupted(self._stop, point=point, time=grid.time(point))
                if point == grid.last_point:
                    break
                for self._stepping, member in members.items():
                    member.step_from(point)
        except TerminationRequested as asked:
            self._ended_by = asked.at(self.point, grid.time(self.point))
        except StepFailed as error:
            error.at(self.point, grid.time(self.point))
            raise
        rows.write()
        self._progress(self.point)

    def _wait_for_the_clock(self, pacer: Pacer, rows: RowBuffer) -> None:
        """Wait until the wall clock allows the next step, or the run has to end; meanwhile write what was recorded."""
        while not self._stopped.is_set():
            granted, pause_s = pacer.limit(self.point + 1, self.point)
            if granted > self.point:
                return
            self._stepping = ""
            if time.monotonic() - rows.flushed_at > _FLUSH_S:
                rows.write(flush=True)
                self._progress(self.point)
            self._stopped.wait(pause_s)

    def _save(self) -> None:
        """Write all rows to the file and close it, once; the watching thread calls this if the main thread cannot."""
        rows, self._buffer = self._buffer, None
        if rows is None:
            return
        try:
            rows.close()
        finally:
            self.rows = rows.count


class _Member:
    """One instance of a `LocalMesh`.

    Attributes:
        settled: inputs that keep the values of the iteration of a loop at the start.
    """

    def __init__(self, plan: Plan, name: str, instance: Instance) -> None:
        node = plan.nodes[plan.node_of(name)]
        self.plan = node.instance(name)
        self.connections = [c for c in plan.connections if c.target_instance == name]
        self.instance = instance
        self._inputs = Ring(self.plan.inputs, 1)
        # A slower instance reads values that are as old as its own step.
        oldest = max(instance.step_points for instance in plan.system.instances.values())
        self._outputs = Ring(self.plan.outputs, 1 << (2 * oldest).bit_length())
        self._points = self.plan.step_points
        self._feeds: list[_Feed] = []
        self.step = 0
        self.settled: set[str] = set()

    def set_initial_inputs(
        self, known: Mapping[tuple[str, str], Value], assumed: Mapping[tuple[str, str], Value] = MappingProxyType({})
    ) -> None:
        """Set every connected input whose source is known, or which has an assumed value."""
        values: dict[str, Value] = {}
        for c in self.connections:
            key = (c.source_instance, c.source.name)
            own = (c.target_instance, c.target_name)
            if own in assumed:
                value = assumed[own]
            elif key in known and c.target_name not in self.settled:
                value = scaled(_at(known[key], c.source_index), c.factor, c.offset)
            else:
                continue
            if not c.target_index:
                values[c.target.name] = value
                continue
            if c.target.name not in values:
                values[c.target.name] = self.instance.get_values([c.target.name])[0]
            row = values[c.target.name]
            for i in c.target_index[:-1]:
                row = _at(row, (i,))
            assert isinstance(row, list)
            row[c.target_index[-1]] = value
        if values:
            self.instance.set_values(values)

    def bind(self, grid: TimeGrid, members: Mapping[str, _Member]) -> None:
        """Prepare `step_from`: what it needs at every point is looked up here, once."""
        arrays = [column.name for column in self.plan.inputs.columns if column.shape]
        for name, value in zip(arrays, self.instance.get_values(arrays) if arrays else [], strict=True):
            self._inputs.put(0, name, value)  # elements that are not connected keep it
        self.instance.bind(self._inputs, (self._outputs,), grid, self.plan.step_points)
        for c in self.connections:
            read, points = members[c.source_instance].reader(c.source_name)
            lead = CouplingRule(c.delay or 0, points, self._points).lead
            same = (c.factor, c.offset) == (1.0, 0.0)
            change = None if same else partial(scaled, factor=c.factor, offset=c.offset)
            self._feeds.append(_Feed(read, points, lead, change, self._inputs.writer(c.target_name)))

    def reader(self, variable: str) -> tuple[Callable[[int], Value], int]:
        """A function that returns an output after an own step, and the number of points of an own step.

        The value at a point is that of the last own step that ended there or before: ``read(point // points)``.
        """
        return self._outputs.reader(variable), self.plan.step_points

    def step_from(self, point: int) -> None:
        """Take the own step that ends at ``point + 1``, if there is one, with the inputs that the delays prescribe."""
        if (point + 1) % self._points:
            return
        start = self.step * self._points
        for read, points, lead, change, write in self._feeds:
            value = read((start + lead) // points)  # `CouplingRule.row_for`, without a call
            write(0, value if change is None else change(value))
        self.instance.do_step(self.step)
        if floating_point_changed():
            restore_floating_point()
        self.step += 1


class _Feed(NamedTuple):
    """How an input gets its value: ``read`` a row of the source; see `CouplingRule` for ``points`` and ``lead``."""

    read: Callable[[int], Value]
    points: int
    lead: int
    change: Callable[[Value], Value] | None
    write: Callable[[int, Value], None]


def _at(value: Value, index: tuple[int, ...]) -> Value:
    """An element of an array; the value itself if there is no index."""
    for number in index:
        assert isinstance(value, list)
        value = value[number]
    return value
