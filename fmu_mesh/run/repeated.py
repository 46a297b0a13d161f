"""Runs of a mesh in this process, one after another: `launch --local`, sweeps, optimizers and calibration.

The instances of a run are stepped as one copy of a batch is (`fmu_mesh.run.copies`), and their rows go from the rings
to the result files as those of a recorder do. So a short run takes less than a millisecond, and its floats, and where
it ends, are those of `LocalSystem`. Between two runs there are no instances, but the libraries of their models stay
loaded (`fmu_mesh.instances.kept_models`), and so does what the runs of one plan share (`fmu_mesh.run.hosted_system`).
"""

# Threads: that of the runs calls FMUs, and nobody else does (ADR 12). `interrupt` comes from any thread, and ends a
# wait for the wall clock, or the run after the current step. The thread of `CallWatch` takes a hang:
# the thread of the runs is inside an FMU then and changes nothing, so the rows can be saved from outside.

from __future__ import annotations

import logging
import shutil
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from operator import is_
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from msgspec.structs import astuple, replace

from ..config.mesh import TimeoutsConfig
from ..errors import ConfigurationError, FmuError, FmuMeshError, Interrupted, TerminationRequested
from ..instances.call_guard import CallWatch
from ..instances.contract import Instance, LogMessage
from ..instances.kept_models import KeptModels
from ..instances.process_state import kept_state
from ..instances.registry import open_instance
from ..master.pacing import Pacer
from ..node.engine import Engine
from ..results.recording import ResultFile
from ..system.plan import Plan
from ..variables.value_types import PlainValue
from .hosted_system import HostedSystem, in_one_node
from .local_system import opening_of
from .one_process import OneProcess
from .outcome import Outcome, outcome_at
from .row_writer import RowWriter
from .run_plan import RunPlan
from .threads import LimitedThreads

__all__ = ["RepeatedRuns"]

log = logging.getLogger(__name__)

_SCRATCH = "scratch"
_WRITE_ROWS = 2048
_MANY_POINTS = 1 << 16
_SLICE_S = 0.01


class RepeatedRuns:
    """Runs plans one after another in this process and on one thread, with the libraries of their models kept loaded.

    Each run has new instances; an FMU that allows one instance per process is reset instead. What a model keeps in
    variables of its library, or writes into its own folder, stays from run to run; after a failure of an instance its
    FMU is loaded anew. Until `close`, the numeric libraries of this process use one thread.

    Example:
        >>> import tempfile, fmu_mesh
        >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     runs = RepeatedRuns(Path(folder))
        ...     for damping in (0.001, 0.1):
        ...         print(runs.run(mesh.plan(start_values={"pendulum.d": damping}, stop_time=1.0), list).point)
        ...     runs.close()
        500
        500

    Args:
        folder: an existing private folder; FMUs are extracted below it.
        log: called with every log message of a model.
        progress: called with the last point reached, about every 10 ms.
        on_hang: called on another thread if a model does not return in time. All complete rows are in the result files.
            The thread that is inside the model cannot be stopped, so the caller has to end the process.
        reset: whether instances stay between runs and are reset, where their models can be reset.
        alone: whether nothing else in this process changes its state between runs; see `HostedSystem`.
        before_close: called with how a run has ended, before its instances are closed. With it, ``on_hang`` is also
            called if a model crashes while it is closed; the thread of the runs never goes on then.
        open_instance: opens an instance by name, instead of the model of the plan; it is closed here.
    """

    def __init__(  # noqa: PLR0913  what a caller may want to hear of
        self,
        folder: Path,
        *,
        log: Callable[[LogMessage], None] = lambda _message: None,
        progress: Callable[[int], None] = lambda _point: None,
        on_hang: Callable[[FmuError], None] = lambda error: log.error("%s", error),
        reset: bool = False,
        alone: bool = False,
        before_close: Callable[[Outcome | BaseException], None] | None = None,
        open_instance: Callable[[str], Instance] | None = None,
    ) -> None:
        models = KeptModels(folder, resets=reset)
        given = log, progress, open_instance, before_close, threading.Event()
        self._around = _Surroundings(folder / _SCRATCH, models, *given)
        self._on_hang, self._alone = on_hang, alone
        self._threads = LimitedThreads()
        self._process = OneProcess()
        self._watch: CallWatch | None = None
        self._thread = 0
        self._run: _Run | None = None
        self._system: HostedSystem | None = None
        self._made_for: tuple[object, ...] = ()
        self._writer: RowWriter | None = None
        self._slices = _Slices()
        self._stop: str | None = None

    def run(
        self,
        run: RunPlan,
        open_files: Callable[[], Sequence[ResultFile]],
        start_values: Mapping[str, Mapping[str, PlainValue]] = MappingProxyType({}),
    ) -> Outcome:
        """Run a plan from the first to the last point.

        Args:
            run: the plan; its nodes and its window are not used. Runs of the same object, one after another, take less
                time than those of equal ones.
            open_files: opens the first result files of the plan, or all, or none; each is closed here.
            start_values: by instance and variable, those that are not as in the plan, and change nothing else of it.

        Raises:
            FmuMeshError: a model failed, the run was interrupted, or this system cannot run in one process. The rows
                that were recorded before are kept.
        """
        try:
            watch = self._watch_here()
            made_for = run, len(files := open_files()), watch
            system = self._system if all(map(is_, made_for, self._made_for)) else None
            if system is None or system.loads or (writer := self._writer) is None:
                system, self._writer = None, (writer := RowWriter(files, run.plan))
            else:
                writer.begin_again(files)
            with closing(writer):
                system = system or self._new_system(*made_for)
                self._around.stopping.clear()
                self._run = current = _Run(system, writer, self._around, self._slices)
                if self._stop is not None:
                    current.interrupt(self._stop)
                return current.run(start_values, watch, self._threads)
        finally:
            self._stop = None
            if self._system is None or self._system.loads:
                self._remove_scratch()

    def interrupt(self, reason: str) -> None:
        """From any thread: end the run under way with `Interrupted` after the current step.

        Between two runs this ends the next one.
        """
        self._stop = reason
        if self._run is not None:
            self._run.interrupt(reason)

    @property
    def point(self) -> int:
        """The last point that all instances of the last run reached."""
        return self._run.point if self._run is not None else 0

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the rows of the last run warn of."""
        return self._run.writer.warnings if self._run is not None else ()

    @property
    def writer(self) -> RowWriter | None:
        """What writes the rows of the last run; None: there was none."""
        return self._run.writer if self._run is not None else None

    def save(self, error: FmuMeshError) -> None:
        """From another thread, where that of the runs does not return from a model: keep all complete rows.

        ``error`` gets the point of the step that does not return, and the sentence about the rows.
        """
        if self._run is not None:
            self._run.save(error)

    def close(self) -> None:
        """Free all models, and remove their files; on the thread of the runs. May be called twice."""
        run = self._run
        if self._system is not None:
            self._system.close()
            self._system = None
        if run is not None:
            watched = self._watch_here().calling(run.names, FmuError, "terminate", run.timeouts.terminate)
            with watched, kept_state():
                self._around.models.close()
        if self._watch is not None:
            self._watch.close()
            self._watch = None
        self._remove_scratch()
        self._threads.close()

    def _new_system(self, run: RunPlan, files: int, watch: CallWatch) -> HostedSystem:
        """In the place of that of the run before, which cannot begin again with this plan."""
        around = self._around
        if self._system is not None:
            self._system.close()
        self._system = None
        _check_keys(run.plan)
        if around.open_instance is None:
            self._process.check(run.plan, run.contents)

        plan = in_one_node(run.plan, files)

        def opened(name: str) -> Instance:
            if around.open_instance is not None:
                return around.open_instance(name)
            around.scratch.mkdir(mode=0o700, exist_ok=True)
            opening = opening_of(plan, name, around.scratch, self._log, run.showing)
            return open_instance(replace(opening, content=run.contents.get(name), kept=around.models))

        self._slices, self._made_for = _Slices(), (run, files, watch)
        self._system = HostedSystem(plan, watch, opened, self._log, alone=self._alone, begins_with=run.begins_with)
        return self._system

    def _log(self, message: LogMessage) -> None:
        self._around.log(message)
        if message.noted and self._run is not None:
            self._run.note_event(message)

    def _remove_scratch(self) -> None:
        shutil.rmtree(self._around.scratch, ignore_errors=True)

    def _watch_here(self) -> CallWatch:
        """What watches the calls of this thread; to start a thread for each run would take longer than to load it."""
        if self._watch is None or self._thread != threading.get_ident():
            if self._watch is not None:
                self._watch.close()
            survives = self._around.before_close is not None
            self._watch, self._thread = CallWatch(self._take_hang, survives=survives), threading.get_ident()
        return self._watch

    def _take_hang(self, error: FmuError) -> None:
        """From the watching thread, which ends then."""
        self._watch = None
        self.save(error)
        self._on_hang(error)


class _Surroundings(NamedTuple):
    """What the instances of all runs get.

    Attributes:
        scratch: a folder for files that are removed after each run.
        stopping: ends a wait of the run under way.
    """

    scratch: Path
    models: KeptModels
    log: Callable[[LogMessage], None]
    progress: Callable[[int], None]
    open_instance: Callable[[str], Instance] | None
    before_close: Callable[[Outcome | BaseException], None] | None
    stopping: threading.Event


class _Slices:
    """Over how many points a system is stepped before its rows are written; from run to run.

    Attributes:
        points: how many.
    """

    def __init__(self) -> None:
        self.points = 1

    def note(self, points: int, took_s: float) -> None:
        """A slice over so many points has taken so long."""
        if took_s > 2 * _SLICE_S:
            self.points = max(1, int(self.points * _SLICE_S / took_s))
        elif took_s < _SLICE_S / 2 and points == self.points:
            self.points = min(2 * points, _MANY_POINTS)


class _Run:
    """One run of a system, and how it ended.

    Attributes:
        point: the last point that all instances reached.
        writer: writes its rows.
    """

    def __init__(self, system: HostedSystem, writer: RowWriter, surroundings: _Surroundings, slices: _Slices) -> None:
        self.point = system.plan.grid.first_point
        self._slices = slices
        self._system, self._plan = system, system.plan
        self._last = self._plan.grid.last_point
        self.writer = writer
        self._around = surroundings
        self._stop: str | None = None
        self._stopping = surroundings.stopping
        self._seconds = 0.0
        self._engine: Engine | None = None
        self._asked: TerminationRequested | None = None
        self._end: Outcome | None = None

    @property
    def names(self) -> str:
        """The names of all instances, for errors."""
        return ", ".join(self._plan.order)

    @property
    def timeouts(self) -> TimeoutsConfig:
        """The deadlines."""
        return self._system.node.timeouts

    def run(
        self, start_values: Mapping[str, Mapping[str, PlainValue]], watch: CallWatch, threads: LimitedThreads
    ) -> Outcome:
        """See `RepeatedRuns.run`."""
        try:
            threads.limit(self._around.models.loads)
            self._system.open()
            try:
                threads.limit(self._around.models.loads)  # with the libraries that a component has imported
                self._write_steps(start_values, watch)
            except BaseException as error:
                self._tell_end(error)
                raise
            self._tell_end(None)
        except BaseException:
            self._leave(failed=True)
            raise
        self._leave(failed=False)
        return self._outcome()

    def _write_steps(self, start_values: Mapping[str, Mapping[str, PlainValue]], watch: CallWatch) -> None:
        """From Initialization Mode to the last point; then the files are closed, and the instances are not."""
        try:
            self._engine = engine = self._system.begin(start_values)
            self.writer.begin(self._plan, self._system.runners)
            for noted in self._system.initialization.noted:
                self.writer.note_event(*astuple(noted))
            started = time.perf_counter()
            try:
                with watch.stepping(self._position, self.timeouts.step):
                    self._step_to_the_end(engine)
            except TerminationRequested as asked:
                self._asked = asked
            finally:
                self._seconds = time.perf_counter() - started
                self._write_rest(engine)
        finally:
            self.writer.close()

    def _outcome(self) -> Outcome:
        """How a run ended that did not fail."""
        if self._end is not None:
            return self._end
        own = self._plan, self.point, self.writer.counted, None, self._asked
        ended = outcome_at(*own, seconds=self._seconds, warnings=self.writer.warnings)
        self._end = replace(ended, defects=self.writer.defects)
        return self._end

    def _leave(self, *, failed: bool) -> None:
        """Keep the system for the next run, if this one has come to its last point."""
        try:
            if failed or self._asked is not None or not self._system.end():
                self._system.close()
        finally:
            self._engine = None  # not before: an FMU that does not return even now is told with the point

    def _tell_end(self, error: BaseException | None) -> None:
        if isinstance(error, FmuMeshError):
            error.with_hint(self.writer.kept())
        if self._around.before_close is not None:
            self._around.before_close(error or self._outcome())

    def interrupt(self, reason: str) -> None:
        """From any thread: see `RepeatedRuns.interrupt`."""
        self._stop = reason
        self._stopping.set()
        if (engine := self._engine) is not None:
            engine.ring_bell()

    def note_event(self, message: LogMessage) -> None:
        """Note in the results what has turned out; see `LogMessage.noted`."""
        step_points = self._plan.system.instances[message.instance].step_points
        self.writer.note_event(message.noted, message.instance, message.step * step_points, message.message)

    def _step_to_the_end(self, engine: Engine) -> None:
        """Take steps and write rows; rows that are not written yet are never overwritten."""
        writer, window, slices = self.writer, self._plan.window, self._slices
        pacer = Pacer(self._plan, self._plan.system.config.simulation.real_time_factor)
        pacer.start(self.point)
        many = max(1, min(_WRITE_ROWS, window // 2))
        while True:
            self.point = point = engine.point
            writer.write(point + 1, many)
            self._around.progress(point)
            if self._stop is not None:
                raise Interrupted(self._stop, point=point, time=self._plan.grid.time(point))
            if point >= self._last:
                return
            granted, pause_s = pacer.limit(min(self._last, writer.written - 1 + window), point)
            if granted <= point:
                self._stopping.wait(pause_s)
                continue
            started = time.perf_counter()
            try:
                engine.step_to(min(granted, point + slices.points))
            except (FmuError, TerminationRequested) as event:
                self._system.located(event, engine.point)
                raise
            slices.note(engine.point - point, time.perf_counter() - started)

    def _position(self) -> tuple[str, int, str]:
        """See `CallWatch.stepping`; between two steps, the answer changes all the time."""
        runner = self._engine.current if self._engine is not None else None
        return (
            (runner.name, runner.step, runner.doing) if runner and not runner.awaited else ("", time.monotonic_ns(), "")
        )

    def _write_rest(self, engine: Engine) -> None:
        """However the run ends: write the rows that are complete."""
        self.point = engine.point
        self.writer.write(self.point + 1, 1)

    def save(self, error: FmuMeshError) -> None:
        """See `RepeatedRuns.save`. This is safe: the thread of the runs is blocked in a model."""
        engine = self._engine
        if engine is not None:
            runner = engine.current
            point, covered = (runner.point, runner.covered) if runner is not None else (self.point, self.point)
            error.at(point, self._plan.grid.time(point))
            with suppress(FmuMeshError):  # the process ends now for another reason
                self.writer.write(min(self.writer.complete, covered, self._last) + 1, 1)
        with suppress(FmuMeshError):
            self.writer.close()
        error.with_hint(self.writer.kept())


def _check_keys(plan: Plan) -> None:
    """Refuse a run in one process whose inputs get the values of keys: it has no session of Zenoh.

    Raises:
        ConfigurationError: there is such an input, and no earlier run to take its values from.
    """
    fed = {name: own.keys_in for name, own in plan.system.instances.items() if own.keys_in}
    for name, keys in fed.items() if plan.system.recorded_keys is None else ():
        what = f"'{name}.{keys[0].variable}' gets its values by the key '{keys[0].key}'"
        hint = "Run it in processes, or take the values of an earlier run with `keys_from=...`."
        raise ConfigurationError(f"{what}, which needs processes with Zenoh", hint=hint)
