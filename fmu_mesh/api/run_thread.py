"""A run that this program has started: a thread of its own that starts it, follows it, and has its result.

The kernel ends the children of a run with the thread that started them, so that thread lives as long as they do.
"""

# Threads: the one of the run starts its processes, and waits for them; any other one asks for its end, also a signal
# handler, which may interrupt another handler: so `_changing` can be taken again. It orders "begin" and "end": a run
# that is ended before its first process is started never starts one. `future` and `reached` are what others wait for.
# At the end of the program, `_end_all` ends what still runs, or its processes would be killed in the middle of a row.

from __future__ import annotations

import atexit
import logging
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from shutil import rmtree
from typing import TYPE_CHECKING

from msgspec.structs import replace

from ..errors import (
    CallRefused,
    ConfigurationError,
    DeadlineExceeded,
    FmuError,
    FmuMeshError,
    Interrupted,
    KeyboardInterrupted,
    MeshLost,
)
from ..printing import paragraph
from ..results.arrays_file import bytes_of_a_row
from ..results.formats import read_result
from ..run.events import Event, Log, OutputLine, Reachable, Restarted, Status, WasReset
from ..run.launcher import Launcher
from ..run.options import StartOptions
from ..run.outcome import Outcome
from ..run.overriding import memory_of
from ..run.run_directory import RunDirectory
from ..run.run_plan import RunPlan, numbered
from ..run.wiring import certified, name_of, warnings_of
from ..simtime import ENDLESS
from ..wire.client.mesh_client import MeshClient
from ..wire.keys import Keys
from ..wire.session import Wiring, close_session, open_session
from ..wire.views import MeshStatus
from .result import Result, result_of, types_of

if TYPE_CHECKING:
    from ..run.in_process import InProcessRun

__all__ = ["RunThread", "check_memory"]

log = logging.getLogger("fmu_mesh.run")

_WARNED_AT = 0.8
_JOIN_S = 10.0
_TRY_S = 0.25
_LEVELS = {"ok": logging.DEBUG, "warning": logging.WARNING, "discard": logging.WARNING}


class RunThread:
    """Runs a plan, as its settings say, on a thread of its own, which starts at once."""

    def __init__(self, plan: RunPlan, settings: StartOptions) -> None:
        if not sys.platform.startswith("linux"):
            raise ConfigurationError(f"a mesh runs on Linux, and this system is '{sys.platform}'")
        self.plan = plan = _recovering(plan, settings)
        self.future: Future[Result] = Future()  # gets the result, or the error with which the run ended
        self.status: MeshStatus | None = None  # the last one
        self.results: list[Result] = []  # of the runs that a reset has ended
        self.reached = threading.Event()  # `endpoints` are known, or the run is over
        self.endpoints: tuple[str, ...] = ()  # of Zenoh; empty in this process
        self._settings = settings
        self._runner: Launcher | InProcessRun | None = None
        self._stopped = False
        self._failure: BaseException | None = None
        self._warned = False
        self._changing = threading.RLock()  # a signal handler may interrupt the handler before it
        self._directory: RunDirectory | None = None
        if settings.processes:
            for text in warnings_of(plan):  # a certificate that cannot be used raises
                if settings.on_event is None:
                    log.warning("%s", text)
            if plan.loaded.config.recovery.directory is not None:
                self._directory = RunDirectory(plan, resume=settings.resume)
                self.plan = self._directory.plan
        if settings.resume and self._directory is None:
            text = f"the run of '{plan.mesh}' cannot be resumed: it keeps nothing"
            raise ConfigurationError(text, hint="`recovery: {directory: DIR}` keeps what this needs, in processes.")
        self._memory = memory_of(plan)
        if self._memory is not None:
            check_memory(plan, settings.memory_limit)
            try:
                self._memory.parent.mkdir(mode=0o700)
            except FileExistsError as error:
                text = f"this plan of '{plan.mesh}' runs already"
                raise CallRefused(text, hint="Make another one for another run.") from error
        _active.add(self)
        self._thread = threading.Thread(target=self._work, name=f"run of {plan.mesh}", daemon=True)
        self._thread.start()

    @property
    def in_process(self) -> bool:
        """Whether all of it runs in this process."""
        return not self._settings.processes

    def stop(self) -> None:
        """End the run where it is: an orderly end, and `future` gets the result."""
        self.expect_stop()
        self.interrupt()

    def expect_stop(self) -> None:
        """The run is about to be stopped by a command of this program: an orderly end."""
        self._stopped = True

    def interrupt(self) -> None:
        """End the run; a second call does not wait for its processes."""
        with self._changing:
            self._fail(Interrupted("interrupted"))

    def over(self) -> bool:
        """False while it goes on.

        Raises:
            MeshLost: it has ended.
        """
        if not self.future.done():
            return False
        hint = "Its values are in `run.wait()`." if self.future.exception() is None else "`run.wait()` raises why."
        raise MeshLost(f"the run of mesh '{self.plan.mesh}' has ended", hint=hint)

    def reach(self, way: ExitStack, timeout_s: float) -> MeshClient:
        """The mesh of this run, once it can be reached; ``way`` closes what this opens.

        Raises:
            CallRefused: the run is in this process.
            DeadlineExceeded: it has not started in time.
            MeshLost: it has ended.
        """
        self.over()
        name, config = self.plan.mesh, self.plan.loaded.config
        if self.in_process:
            hint = "Start it with processes=True, or step it by hand with `Mesh.open`."
            raise CallRefused(f"the run of mesh '{name}' is in this process, where nobody can reach it", hint=hint)
        if not self.reached.wait(config.timeouts.start):
            raise DeadlineExceeded(f"mesh '{name}' cannot be reached within {config.timeouts.start:g} s")
        keys = Keys(config.zenoh.key_prefix, name)
        reached = Wiring("client", waits=False, insecure=config.zenoh.insecure)
        patience_s = _TRY_S  # Zenoh tries for all of it, also if the mesh ends meanwhile
        while True:
            self.over()
            try:
                ends = replace(reached, connect=self.endpoints[:1], patience_s=patience_s)
                session = open_session(ends := certified(ends, config.security, keys.root))
            except (ConfigurationError, MeshLost) as error:
                patience_s *= 2
                if patience_s > timeout_s:
                    raise DeadlineExceeded(f"mesh '{name}' does not answer at {self.endpoints[0]}") from error
            else:
                way.callback(close_session, session)
                keys = replace(keys, by=name_of(ends, config.security))
                return MeshClient(session, keys, self.endpoints[:1], timeout_s, self.over)

    def end_by_keyboard(self) -> FmuMeshError:
        """End the run on Ctrl-C, and return its error; a second Ctrl-C does not wait for its processes."""
        while True:
            self.interrupt()
            try:
                result = self.future.result()
            except KeyboardInterrupt as error:
                if self.future.done() and self.future.exception() is error:
                    return error if isinstance(error, FmuMeshError) else Interrupted("interrupted")
            except Interrupted as error:
                named = KeyboardInterrupted(error.message, point=error.point, time=error.time, hint=error.hint)
                return named.with_result(error.result)
            except FmuMeshError as error:
                return error
            else:
                return KeyboardInterrupted("interrupted").with_result(result)

    def join(self) -> None:
        """Wait until the thread has ended, for some seconds at most."""
        self._thread.join(_JOIN_S)

    def _work(self) -> None:
        result: Result | None = None
        error: BaseException | None = None
        try:
            result = self._run()
        except BaseException as caught:  # noqa: BLE001 whoever waits gets it
            error = caught
        if self._memory is not None:  # before anybody can start the plan again
            rmtree(self._memory.parent, ignore_errors=True)
        if self._directory is not None:
            if result is not None or not self._directory.has_rows():
                self._directory.clear()
            elif isinstance(error, FmuMeshError) and not isinstance(error, FmuError):  # which would come again
                error.with_hint("`resume=True` goes on with it.")
            self._directory.close()
        if result is not None:
            self.future.set_result(result)
        else:
            self.future.set_exception(error)
        self.reached.set()
        _active.discard(self)

    def _run(self) -> Result:
        plan = self.plan
        for text in self._directory.told if self._directory is not None else ():
            self._take(OutputLine("recovery", text))
        while True:
            try:
                return self._result(self._run_once(plan))
            except FmuMeshError as error:
                following = self._runner.next if isinstance(self._runner, Launcher) else None
                if following is None or self._failure is not None:
                    if following is not None and isinstance(self._runner, Launcher):
                        self._runner.clear()
                    if plan.restarts:
                        error.with_hint(f"This was attempt {plan.restarts + 1} of {plan.max_restarts + 1}.")
                    return self._ended_early(error)
                plan = following
                if self._directory is not None:
                    self._directory.sync(plan.rows)
                self._take(Restarted(error.report(), plan.restarts, plan.max_restarts, plan.replays_to))

    def _run_once(self, plan: RunPlan) -> Outcome:
        kind: Callable[..., Launcher | InProcessRun] = Launcher
        if not self._settings.processes:
            from ..run.in_process import InProcessRun  # noqa: PLC0415 it needs all that nodes do

            kind = InProcessRun
        elif any(host.ssh is not None for host in plan.plan.hosts.values()):
            from ..hosts.ssh import SshHosts  # noqa: PLC0415  most runs are on one host

            kind = partial(Launcher, elsewhere=SshHosts)
        with self._changing:
            if self._failure is not None:
                raise self._failure
            self._runner = runner = kind(plan, self._take)
        return runner.run()

    def _ended_early(self, error: FmuMeshError) -> Result:
        """The result, if this program has stopped the run.

        Raises:
            BaseException: why the run has ended otherwise; one of ours has the result.
        """
        result = self._result(self._runner.outcome if self._runner is not None else None)
        cause = error if self._failure is None or isinstance(self._failure, Interrupted) else self._failure
        if self._stopped and isinstance(cause, Interrupted):
            return result
        raise cause.with_result(result) if isinstance(cause, FmuMeshError) else cause

    def _take(self, event: Event) -> None:
        match event:
            case Reachable(endpoints):
                self.endpoints = endpoints
                self.reached.set()
            case Status(status):
                self.status = status
                self._watch_memory()
            case WasReset(outcome):
                self.results.append(self._read(outcome))
                if self._directory is not None:  # it could not go on after the reset
                    self._directory.clear()
        on_event, on_progress = self._settings.on_event, self._settings.on_progress
        if on_event is None:
            _log(event)
        try:
            if on_event is not None:
                on_event(event)
            if on_progress is not None and isinstance(event, Status):
                on_progress(event.status)
        except BaseException as error:  # noqa: BLE001 whoever waits gets it
            self._fail(error)

    def _fail(self, error: BaseException) -> None:
        """End the run because of something in this program."""
        self._failure = self._failure or error
        if self._runner is not None:
            self._runner.interrupt()

    def _watch_memory(self) -> None:
        limit = self._settings.memory_limit
        file = numbered(self._memory, len(self.results)) if self._memory is not None else None
        if file is None or not file.exists():
            return
        size = file.stat().st_size
        if size >= limit:
            self._fail(_too_large(self.plan.mesh, limit))
        elif size >= _WARNED_AT * limit and not self._warned:
            self._warned = True
            log.warning("the results of '%s' take %d bytes of memory; the run ends at %d", self.plan.mesh, size, limit)

    def _result(self, outcome: Outcome | None) -> Result:
        if outcome is not None and (self.status is None or self.status.state not in ("done", "failed")):
            grid, progress = self.plan.plan.grid, dict.fromkeys(self.plan.plan.nodes, outcome.point)
            rate = (outcome.point - outcome.first) / outcome.seconds if outcome.seconds > 0.0 else 0.0
            ended = outcome.point, grid.last_point, outcome.time, rate, rate * grid.step_size
            self.status = MeshStatus(self.plan.mesh, outcome.state, *ended, progress, outcome.error)
        return self._read(outcome)

    def _read(self, outcome: Outcome | None) -> Result:
        if self._memory is None or outcome is None or outcome.file is None:
            return result_of(self.plan, outcome)
        types = types_of(self.plan.plan.system) or {}
        return Result(
            self.plan.mesh,
            outcome=replace(outcome, file=None, files=()),
            system=self.plan.plan.system,
            columns=read_result(Path(outcome.file), types),
        )


def _recovering(plan: RunPlan, settings: StartOptions) -> RunPlan:
    """The plan with what follows when a process is lost; all of a run in this process is lost with it.

    Raises:
        ConfigurationError: the mesh cannot start again.
    """
    config, restarts = plan.loaded.config, settings.restarts
    most = config.recovery.restarts if restarts is None else restarts
    if not most or not settings.processes:
        return plan
    if (why := config.why_not_restarted) is not None:
        raise ConfigurationError(f"the run of '{plan.mesh}' cannot be started again: {why}")
    return replace(plan, max_restarts=most)


_active: set[RunThread] = set()
"""The runs of this process that have not ended."""


@atexit.register
def _end_all() -> None:
    threads = list(_active)
    for thread in threads:
        thread.interrupt()
    for thread in threads:
        thread.join()


def check_memory(plan: RunPlan, limit: int, *, to_its_end: bool = False) -> None:
    """Check that all rows of a run fit into memory.

    Rows without an end are refused where they are calculated as fast as possible and awaited ``to_its_end``: in real
    time somebody can stop them.

    Raises:
        CallRefused: they do not.
    """
    types = types_of(plan.plan.system) or {}
    last, records = plan.plan.grid.last_point, plan.plan.system.records
    size = records[0].rows_before(last + 1) * bytes_of_a_row(types.values()) if records else 0
    if last < ENDLESS and size > limit:
        raise _too_large(plan.mesh, limit, size)
    if last >= ENDLESS and to_its_end and size and not plan.plan.system.config.simulation.real_time_factor:
        text = f"the run of '{plan.mesh}' has no end, and its results would stay in memory"
        raise CallRefused(text, hint="Give a `stop_time`, or a `memory_limit` at which it ends.")


def _too_large(mesh: str, limit: int, size: int | None = None) -> CallRefused:
    takes = f"take {size} bytes of memory" if size is not None else "do not fit into memory"
    hint = "Raise `memory_limit`, record fewer variables, or record into a file with `output=...`."
    return CallRefused(f"the results of '{mesh}' {takes}; the limit is {limit} bytes", hint=hint)


def _log(event: Event) -> None:
    match event:
        case Log(line):
            level = _LEVELS.get(line.status, logging.ERROR)
            log.log(level, "%s at point %d: %s", line.instance, line.point, paragraph(line.message))
        case OutputLine(process, text):
            log.info("%s: %s", process, paragraph(text))
        case Restarted(error, number):
            log.warning("restart %d: %s", number, paragraph(error.message))
