"""The roles that a process of a run can have: a node, or the master with the recorder.

The same functions serve the processes that `launch` starts and those that a person starts manually.
"""

from __future__ import annotations

import gc
import logging
import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace
from setproctitle import setproctitle

from ..config.access_sections import is_socket
from ..errors import ConfigurationError, FmuError, FmuMeshError, Interrupted, RunReset, StepFailed
from ..instances.call_guard import CallWatch, Guarded
from ..instances.contract import Instance, KeepsFiles, LogMessage, Opening
from ..instances.registry import open_instance, prepare
from ..master.master import Master
from ..master.mesh_server import MasterSettings
from ..node.node import Node
from ..recorder.recorder import Recorder
from ..results.defects import DefectWatch
from ..results.growth import GrowthWatch
from ..results.record_files import open_results
from ..results.recording import ResultFile
from ..system.attempt import Attempt
from ..system.plan import MASTER, RECORDER, Plan
from ..variables.value_types import PlainValue
from ..wire.host_processes import ask_outside
from ..wire.journal import JOURNAL
from ..wire.keys import Keys
from ..wire.meeting import Meeting, meeting_of
from ..wire.messages import NewStart, Noted
from ..wire.router_link import RouterLink
from ..wire.runtime import fmu_folder, run_folder, share, write_note
from ..wire.session import Wiring, close_session, open_session, own_endpoints
from ..wire.views import LogLine, MeshStatus
from .events import Event, EventWriter, Log, Reachable, Status, WasReset, log_line
from .limits import limit_process, strain
from .one_process import is_other_python
from .outcome import Outcome, last_recorded, outcome_at
from .process import RunProcess
from .run_directory import on_flush
from .run_plan import MANUAL, NodeRun, RunPlan, numbered, opening_in, read_node, read_run
from .state_file import keeper, state_bytes
from .wiring import certified, patient, shared_with_group, table_of, wiring

if TYPE_CHECKING:  # most runs are never reset
    from .preparing import KnownModels

__all__ = ["job_of", "run_master", "run_node"]

log = logging.getLogger(__name__)


def job_of(role: str, plan: str, node: str = "", *others: str, forks: bool = False) -> Callable[[], None]:
    """What a process does that the launcher starts: as a `node`, as the `master`, or as the `gateway`.

    Args:
        role: one of the three; or `copies`, which a batch starts.
        plan: the file of the run plan.
        node: name of the node, or the number of the process with copies.
        others: what a process with copies needs besides; of a node in a sandbox, the socket for its questions.
        forks: whether the process is forked from this one. Then what several nodes need is done here, once, such as
            extracting the FMU of all.
    """
    file = Path(plan)
    if role == "node":
        for channel in others:
            ask_outside(int(channel))
        run = read_node(file, node)
        for item in run.plan.instances if forks else ():
            with suppress(FmuMeshError):  # the node says it
                prepare(_opening(run, item.name, run_folder(run.plan.mesh, run.run)))

        def be_node() -> None:
            setproctitle(f"fmu-mesh node {node}")
            run_node(run)

        return be_node
    if role == "copies":
        from .copies_role import job_with_copies  # noqa: PLC0415  a run has none

        return job_with_copies(read_run(file), node, *others)

    def be_other() -> None:
        run = read_run(file)
        setproctitle(f"fmu-mesh {role} {run.mesh}")
        if role == "gateway":
            from .gateway_role import run_gateway  # noqa: PLC0415  most runs have none

            run_gateway(run, EventWriter())
            return
        try:
            run_master(run, EventWriter())
        except FmuMeshError as error:
            error.already_reported()  # the launcher has the event and shows it
            raise

    return be_other


def run_node(run: NodeRun) -> None:
    """Be one node of a mesh, until the run ends.

    Raises:
        ConfigurationError: a component of the node needs another Python; says how to start it.
        FmuMeshError: the node could not start, or its run ended early.
    """
    python = run.plan.interpreter
    if run.run == MANUAL and python is not None and is_other_python(python):
        text = f"node '{run.plan.node}' needs the Python '{python}', and this process is another one"
        command = shlex.join([python, "-m", "fmu_mesh", "node", str(run.config_file), run.plan.node])
        raise ConfigurationError(text, hint=f"Start it with `{command}`.")
    if run.run == MANUAL and run.plan.process.is_sandboxed:  # it could ask nobody outside
        text = f"`sandbox` of node '{run.plan.node}' has no effect where the node is started manually"
        raise ConfigurationError(text, hint="`fmu-mesh launch` starts it in a sandbox; `sandbox: none` without.")
    with RunProcess(run.plan.mesh, run.run, run.launch, run.helper) as process:
        _NodeProcess(run, process).run()


class _NodeProcess:
    """A node, its instances, and what happens if one of them does not return from a call."""

    def __init__(self, run: NodeRun, process: RunProcess) -> None:
        self._run = self._first = run  # the newest, and the first one
        self._meeting: Meeting | None = None
        self._process = process
        self._instances: list[Instance] = []
        self._guarded: list[Guarded] = []
        self._node: Node | None = None

    def run(self) -> None:
        """Run the node."""
        run, process = self._first, self._process
        plan = run.plan
        process.cleans_up(self._remove_files)
        process.take_place(plan.node, f"node '{plan.node}' of mesh '{plan.mesh}'")
        if plan.process.is_private:
            (own_folder := fmu_folder(process.folder) / "work").mkdir(mode=0o700, parents=True)
            os.chdir(own_folder)
        if not process.is_child and plan.host is not None:  # `launch` may start again, and this process goes on
            (journals := fmu_folder(process.folder) / "journal").mkdir(mode=0o700, parents=True)
            self._run = replace(run, plan=replace(plan, attempt=Attempt(journal=str(journals / f"node{JOURNAL}"))))
        root = Keys(plan.key_prefix, plan.mesh).root
        ends = wiring(run.zenoh, run.config_file, process.folder, plan.node, plan.peers())
        made = patient(ends, plan.timeouts, is_node=True, is_mirrored=run.launch is not None)
        own = certified(replace(made, publishes=f"{root}/**"), run.security, root)
        session = open_session(own)
        process.stack.callback(close_session, session)
        limit_process(plan.process)
        self._watch = process.stack.enter_context(closing(CallWatch(self._take_hang, survives=True)))
        process.stack.callback(self._close_instances)
        router = RouterLink(session, run.zenoh.connect)
        process.interruption.goes_to(self._interrupt)
        process.stack.callback(lambda: self._meeting.close() if self._meeting is not None else None)
        while True:
            plan, at = self._run.plan, (process.folder, own, run.zenoh.rows_address)
            self._meeting = meeting_of(plan.node, *at) if plan.row_streams else None
            self._node = node = Node(
                plan,
                session,
                self._open,
                on_hang=self._take_hang,
                router=router,
                launch=process.launch,
                meeting=self._meeting,
                strain=partial(strain, plan.process),
                table=table_of(own),
                begins_with=run.begins_with,
            )
            gc.collect()  # the memory of the run before a reset is in circles of objects
            if process.interruption.reason is not None:
                self._interrupt(process.interruption.reason)
            try:
                node.run()
            except FmuMeshError as error:
                if node.new_start is not None or (node.goes_on and not process.is_child):
                    self._begin_again(node.new_start)
                    continue
                # If there is a launcher, one process shows what happened, and the others only end.
                # It tells who was interrupted by the exit code, and interrupts those whom a lost master leaves behind.
                if process.is_child and (node.failure_is_known or isinstance(error, Interrupted)):
                    error.already_reported()
                raise
            return

    def _interrupt(self, reason: str) -> None:
        """From any thread."""
        if self._node is not None:
            self._node.interrupt(reason)

    def _begin_again(self, start: NewStart | None) -> None:
        """The mesh is reset, or starts again: free all instances, and take the start values for the next ones."""
        self._close_instances()
        self._guarded, self._instances = [], []
        if self._meeting is not None:
            self._meeting.close()
        if start is None:
            log.warning("the mesh of node '%s' is lost; waiting for the next attempt", self._first.plan.node)
            return
        instances = tuple(
            replace(
                item,
                start_values=start.start_values.get(item.name, item.start_values),
                timeouts=start.timeouts.get(item.name, item.timeouts),
            )
            for item in self._first.plan.instances
        )
        plan, showing = self._first.plan, self._first.showing
        if showing.video is not None:
            showing = replace(showing, video=numbered(showing.video, start.resets))
        plan = replace(plan, digest=start.digest, instances=instances, attempt=Attempt())
        self._run = replace(self._first, showing=showing, plan=plan)

    def _open(self, name: str) -> Guarded:
        opening = _opening(self._run, name, self._process.folder, self._log)

        def instantiate() -> Instance:
            instance = open_instance(opening)
            self._instances.append(instance)
            return instance

        self._guarded.append(Guarded(name, instantiate, self._watch, self._run.plan.timeouts))
        return self._guarded[-1]

    def _log(self, message: LogMessage) -> None:
        if self._node is not None:
            line = log_line(message, self._run.plan.instance(message.instance).step_points)
            self._node.server.log_message(line)
            if message.noted:
                self._node.tell_recorder(Noted(message.noted, line.instance, line.point, line.message))
            if message.status in ("error", "fatal"):  # the FMU may end the process next
                self._node.server.say_everything(heard=True)

    def _close_instances(self) -> None:
        for instance in self._guarded:
            instance.close()

    def _remove_files(self) -> None:
        for instance in self._instances:
            if isinstance(instance, KeepsFiles):
                instance.remove_files()

    def _take_hang(self, error: FmuError) -> None:
        """From a watching thread: an FMU has not returned, or has crashed at the end, so the process has to end."""
        known = self._node is not None and self._node.report_hang(error)
        if not (self._process.is_child and known):
            log.error("%s", error)
        self._process.end_now(0 if self._node is not None and self._node.finished else StepFailed.exit_code)


def _opening(
    run: NodeRun, name: str, folder: Path, log: Callable[[LogMessage], None] = lambda _message: None
) -> Opening[Any]:
    """How an instance is opened in this process, in the folder of the run."""
    model = run.models[name]
    opening = opening_in(run.plan, name, model.description, fmu_folder(folder), log)
    return replace(opening, content=model.content, showing=run.showing)


def run_master(run: RunPlan, emit: Callable[[Event], None]) -> Outcome:
    """Be the master and the recorder of a mesh, until the run ends; the outcome is also the last event.

    Raises:
        FmuMeshError: the run ended early; the outcome that was emitted before says the same.
    """
    plan, config = run.plan, run.loaded.config
    zenoh = run.zenoh(config.zenoh.listen)
    with RunProcess(config.mesh, run.run) as process:
        process.take_place(MASTER, f"the master of mesh '{config.mesh}'")
        if config.security is not None:  # results say which persons, at which addresses, have done what
            process.stack.callback(os.umask, os.umask(0o077))
        try:
            own = patient(wiring(zenoh, run.config_file, process.folder, MASTER, ()), config.timeouts, is_node=False)
            own = certified(own, config.security, Keys(config.zenoh.key_prefix, config.mesh).root, config.ends)
            shared = shared_with_group(run, process.folder, own, process.stack.callback)
            runs = _MasterRuns(run, process, replace(own, listen=(*own.listen, *shared)))
            for endpoint in shared:
                share(endpoint)
            session = runs.session
            ends = own_endpoints(session, runs.wiring) if zenoh.mode == "peer" else ()
            ends = ends or tuple(config.zenoh.connect)  # a client is reached through its router
            settings = MasterSettings(
                endpoints=tuple(sorted(ends, key=is_socket, reverse=True)),
                config_file=str(run.loaded.file),
                launch=process.launch,
                profile=run.profile,
                paused=run.paused,
                attempt=run.attempt_of(MASTER),
                table=table_of(own),
                as_file=lambda point, states: state_bytes(runs.run, point, states),
                checkpoint_s=run.checkpoint_s,
                keep=keeper(run, runs.played),
            )
            router = RouterLink(session, config.zenoh.connect)
            master = Master(plan, session, _Emitter(emit), settings, runs.replanned, router, runs.met())
            process.stack.callback(master.close)
            master.claim()
        except FmuMeshError as error:  # before the first point, such as at a port that is in use
            emit(outcome_at(plan, 0, error=error))
            raise
        if not process.is_child:
            write_note(process.folder, run.note(settings.endpoints))
        emit(Reachable(settings.endpoints))
        process.interruption.goes_to(master.interrupt)
        while True:
            recorder = failure = None
            gc.collect()  # the memory of the run before a reset is in circles of objects
            try:
                if RECORDER in run.plan.nodes:
                    recorder = runs.recorder(master)
                    with recorder:
                        master.run(recorder.check_writing, recorder.newest_defects)
                else:
                    master.run()
            except FmuMeshError as error:
                failure = error
            outcome = _outcome_of(run, master, recorder, failure, process.interruption.signal)
            if not isinstance(failure, RunReset):
                break
            run, resets = runs.run, runs.resets
            emit(WasReset(outcome, resets))
            master.begin_again(run.plan, runs.met())
        emit(outcome)
        if failure is not None:
            raise failure
        master.wait_for_followers()
        return outcome


class _MasterRuns:
    """The runs of a master, which follow each other where the mesh is reset.

    Attributes:
        session: of this process.
        run: the plan of the newest.
        resets: how often the mesh was reset.
        played: gets the rows for a restart, before the mesh is reset; None: no node plays any.
        wiring: of its session.
    """

    def __init__(self, run: RunPlan, process: RunProcess, wiring: Wiring) -> None:
        self.session = open_session(wiring)
        process.stack.callback(close_session, self.session)
        self.run = self._first = run
        self.played = run.played_rows()
        self.resets = 0
        self._process = process
        self.wiring = wiring
        self._files: Sequence[ResultFile] | None = None
        self._meeting: Meeting | None = None
        self._known: KnownModels | None = None
        process.stack.callback(self._close)

    def _close(self) -> None:
        if self._meeting is not None:
            self._meeting.close()
        for file in self._files or ():  # a reset that came too late
            file.close()

    def replanned(self, start_values: Mapping[str, PlainValue], resets: int) -> Plan:
        """Plan the next run, and open its files: what is wrong is found before the mesh is reset.

        Raises:
            ConfigurationError: it cannot be run.
        """
        from .preparing import KnownModels  # noqa: PLC0415  most runs are never reset
        from .resetting import planned_reset  # noqa: PLC0415  as above

        self._known = self._known or KnownModels.of(self._first)
        run = replace(planned_reset(self._first, start_values, resets, self._known), rows=())
        self._files = _opened_results(run)
        self.run, self.resets = run, resets
        return run.plan

    def met(self) -> Meeting | None:
        """A new meeting of the master for row streams; that of the run before is closed."""
        zenoh = self._first.zenoh(self._first.loaded.config.zenoh.listen)
        if self._meeting is not None:
            self._meeting.close()
        at = self._process.folder, self.wiring, zenoh.rows_address
        self._meeting = meeting_of(MASTER, *at) if self._first.loaded.config.row_streams else None
        return self._meeting

    def recorder(self, master: Master) -> Recorder:
        """The recorder of the newest run.

        Raises:
            ConfigurationError: a result file cannot be written.
        """
        plan, process, streams = self.run.plan, self._process, master.streams
        files, self._files = self._files or _opened_results(self.run), None
        recorder = Recorder(
            plan.nodes[RECORDER],
            self.session,
            files,
            lambda: master.wanted,
            growth=GrowthWatch(plan),
            defects=DefectWatch(plan),
            notes=process.folder if process.is_child else None,
            launch=process.launch,
            router=RouterLink(self.session, self.run.loaded.config.zenoh.connect),
            memory=master.memory_for(RECORDER),
            mirror_of=streams.mirror if streams is not None else lambda _link: None,
            audit=lambda: (master.audit.changes, master.audit.view()),
            played=self.played if not self.resets else None,
            on_flush=on_flush(self.run, self.played, self.resets),
        )
        if streams is not None:
            streams.tell_last(recorder.note_last)
        return recorder


def _opened_results(run: RunPlan) -> Sequence[ResultFile]:
    return open_results(run.loaded, run.plan.system, digest=run.plan.digest, contents=run.contents, rows=run.rows)


def _outcome_of(
    run: RunPlan, master: Master, recorder: Recorder | None, error: FmuMeshError | None, signal: str | None
) -> Outcome:
    files, warnings = (recorder.files, recorder.warnings) if recorder is not None else ((), ())
    point, ended_by = master.last_status().point, master.ended_by if error is None else None
    if isinstance(error, RunReset):
        point, error, ended_by = max(point, last_recorded(run.plan, files)), None, error
    told = (*warnings, *master.warnings)
    outcome = outcome_at(run.plan, point, files, error, ended_by, seconds=master.seconds, warnings=told)
    defects = recorder.defects if recorder is not None else {}
    return replace(outcome, profile=master.profile(), signal=signal, defects=defects)


class _Emitter:
    """Converts what the master reports to events."""

    def __init__(self, emit: Callable[[Event], None]) -> None:
        self._emit = emit

    def status(self, status: MeshStatus) -> None:
        self._emit(Status(status))

    def log(self, line: LogLine) -> None:
        self._emit(Log(line))
