"""What a process of the mesh does from its start to its end: as a node, or as the master with the recorder.

The same functions serve `launch`, which starts these processes, and a person who starts them by hand.
"""

from __future__ import annotations

import logging
import os
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import msgspec

from ..config.loading import LoadedConfig
from ..errors import ConfigurationError, FmuError, FmuMeshError, StepFailed
from ..instances.call_guard import CallWatch, Guarded
from ..instances.configuration import load
from ..instances.contract import Instance, KeepsFiles, LogMessage, Opening
from ..instances.registry import decode_section, describe, open_instance
from ..master.grant_watch import GrantWatch
from ..master.master import Master
from ..node.node import Node
from ..recorder.recorder import Recorder
from ..system.plan import RECORDER, NodePlan, Plan
from ..text import listed, nearest
from ..wire.keys import MASTER
from ..wire.runtime import (
    MeshNote,
    enter_run_folder,
    fmu_folder,
    leave_run_folder,
    run_folder,
    socket_endpoint,
    tidy_run_folder,
    write_note,
)
from ..wire.session import RouterLink, close_session, open_session, own_endpoints
from ..wire.views import LogLine, MeshStatus
from .events import End, Event, Log, Ready, Status
from .options import Options, with_options
from .preparing import prepare
from .process import SIGNAL_RECEIVED, die_with_parent, ended_by_signals
from .results import open_result
from .wiring import is_socket, wiring

__all__ = ["BY_HAND", "run_master", "run_node"]

log = logging.getLogger(__name__)

BY_HAND = "hand"
"""Name of the run whose processes were started by hand."""


def run_node(
    config_file: Path, name: str, options: Options, *, plan_file: Path | None = None, run: str = BY_HAND
) -> None:
    """Be one node of a mesh.

    Args:
        config_file: the configuration file.
        name: name of the node: that of an instance without a group, or of a group.
        options: what the command line changes.
        plan_file: the node's plan if the launcher has made it already; removed once it is read.
        run: name of the run; the launcher's process id when it started this process.

    Raises:
        FmuMeshError: the node could not start, or its run ended early.
    """
    child = run != BY_HAND
    if child:
        die_with_parent()
    if plan_file is not None:
        plan = msgspec.json.decode(plan_file.read_bytes(), type=NodePlan, dec_hook=decode_section)
        plan_file.unlink()
    else:
        plan = _node_plan(prepare(config_file, options), name)
    _NodeProcess(config_file, plan, options, run_folder(plan.mesh, run), _launch(run)).run(child=child)


class _NodeProcess:
    """A node with all that it takes from its host: a session, a folder, FMUs, and an answer to signals."""

    def __init__(self, config_file: Path, plan: NodePlan, options: Options, folder: Path, launch: str | None) -> None:
        self._config_file = config_file
        self._plan = plan
        self._zenoh = with_options(load(config_file), options).config.zenoh
        self._folder = folder
        self._launch = launch
        self._options = options
        self._instances: list[Instance] = []
        self._guarded: list[Guarded] = []
        self._child = False
        self._node: Node | None = None
        self._interrupted: str | None = None

    def run(self, *, child: bool) -> None:
        """Run the node; ``child`` tells whether a launcher watches this process."""
        self._child = child
        with ended_by_signals(self._interrupt, self._clean_up, watch_stdin=child), ExitStack() as stack:
            stack.callback(leave_run_folder, self._folder)
            tidy_run_folder(self._folder)
            _refuse_second(self._folder, self._plan.node, f"node '{self._plan.node}' of mesh '{self._plan.mesh}'")
            enter_run_folder(self._folder, self._plan.node)
            session = open_session(
                wiring(self._zenoh, self._config_file, self._folder, self._plan.node, self._plan.peers())
            )
            stack.callback(close_session, session)
            self._watch = stack.enter_context(closing(CallWatch(self._take_hang)))
            stack.callback(self._close_instances)
            router = RouterLink(session, self._zenoh.connect)
            self._node = node = Node(self._plan, session, self._open, router=router, launch=self._launch)
            node.server.on_hang = self._take_hang
            if self._interrupted is not None:
                node.interrupt(self._interrupted)
            try:
                node.run()
            except FmuMeshError as error:
                # Under a launcher one process tells what happened, and the others only end.
                error.told = child and node.failure_is_known
                raise

    def _open(self, name: str) -> Guarded:
        item = self._plan.instance(name)

        def instantiate() -> Instance:
            limits, path = self._plan.limits, Path(item.fmu)
            opening = Opening(
                name=name,
                path=path,
                section=item.section,
                description=describe(path, item.section, limits),
                folder=fmu_folder(self._folder),
                limits=limits,
                linear_inputs=item.linear_inputs,
                log=self._log,
                showing=self._options.showing,
            )
            self._instances.append(open_instance(opening))
            return self._instances[-1]

        self._guarded.append(Guarded(name, instantiate, self._watch, self._plan.timeouts))
        return self._guarded[-1]

    def _log(self, message: LogMessage) -> None:
        point = max(message.step, 0) * self._plan.instance(message.instance).step_points
        if self._node is not None:
            line = LogLine(message.instance, message.status, message.category, message.message, point)
            self._node.server.log_message(line)

    def _close_instances(self) -> None:
        for instance in self._guarded:
            instance.close()

    def _interrupt(self, reason: str) -> None:
        self._interrupted = reason
        if self._node is not None:
            self._node.interrupt(reason)

    def _clean_up(self) -> None:
        """From another thread, when the main thread does not come back from an FMU."""
        for instance in self._instances:
            if isinstance(instance, KeepsFiles):
                instance.remove_files()
        leave_run_folder(self._folder)

    def _take_hang(self, error: FmuError) -> None:
        """From a watching thread: an FMU has not returned in time, and only the end of the process gets it back."""
        known = self._node is not None and self._node.report_hang(error)
        if not (self._child and known):
            log.error("%s", error)
        self._clean_up()
        sys.stderr.flush()
        os._exit(StepFailed.exit_code)


def run_master(
    config_file: Path,
    options: Options,
    emit: Callable[[Event], None],
    *,
    plan: Plan | None = None,
    run: str = BY_HAND,
) -> None:
    """Be the master, with the recorder in the same process; the end of the run is emitted as an event.

    Raises:
        FmuMeshError: the run ended early; the event before says the same.
    """
    child = run != BY_HAND
    if child:
        die_with_parent()
    if plan is None:
        plan = prepare(config_file, options)
    config = plan.system.config
    folder = run_folder(config.mesh, run)
    master: Master | None = None
    reasons: list[str] = []

    def interrupt(reason: str) -> None:
        reasons.append(reason)
        if master is not None:
            master.interrupt(reason)

    with ended_by_signals(interrupt, lambda: leave_run_folder(folder), watch_stdin=child), ExitStack() as stack:
        stack.callback(leave_run_folder, folder)
        tidy_run_folder(folder)
        _refuse_second(folder, MASTER, f"the master of mesh '{config.mesh}'")
        enter_run_folder(folder, MASTER)
        recorder = error = None
        with _told(plan, emit):
            session = open_session(wiring(config.zenoh, config_file, folder, MASTER, ()))
            stack.callback(close_session, session)
            endpoints = own_endpoints(session) if config.zenoh.mode == "peer" else tuple(config.zenoh.connect)
            endpoints = tuple(sorted(endpoints, key=is_socket, reverse=True))
            master = Master(
                plan,
                session,
                _Emitter(emit),
                endpoints=endpoints,
                config_file=str(config_file),
                router=RouterLink(session, config.zenoh.connect),
                launch=_launch(run),
            )
            stack.callback(master.close)
            master.claim()
        if not child:
            write_note(folder, MeshNote(config.mesh, config.zenoh.key_prefix, endpoints, os.getpid(), str(config_file)))
        emit(Ready(endpoints))
        master.watch = GrantWatch() if options.profile else None
        master.starts_paused = options.paused
        for reason in reasons:
            master.interrupt(reason)
        try:
            if RECORDER in plan.nodes:
                file = open_result(LoadedConfig(config, config_file), plan.system, folder if child else None)
                with Recorder(
                    plan.nodes[RECORDER], session, file, lambda: master.has_begun, launch=_launch(run)
                ) as recorder:
                    master.run()
            else:
                master.run()
        except FmuMeshError as ended:
            error = ended
        rows = recorder.rows if recorder is not None else 0
        signal = reasons[0].removesuffix(SIGNAL_RECEIVED) if reasons else None
        emit(_end_of(master, rows, plan.system.result_file, error, signal))
        if error is not None:
            raise error
        master.wait_for_followers()


def _launch(run: str) -> str | None:
    """Which launch a process belongs to, for those that meet it on a router; None if it was started by hand."""
    return f"{socket.gethostname()}.{run}" if run != BY_HAND else None


def _end_of(master: Master, rows: int, result_file: str | None, error: FmuMeshError | None, signal: str | None) -> End:
    """What is told of a run that is over."""
    report = error.report() if error is not None else None
    ended_by = master.ended_by.report() if master.ended_by is not None and error is None else None
    return End(master.last_status(), master.seconds, rows, result_file, report, master.profile(), ended_by, signal)


@contextmanager
def _told(plan: Plan, emit: Callable[[Event], None]) -> Iterator[None]:
    """Emit the end of a run that fails before its first point, such as at a port that is in use."""
    try:
        yield
    except FmuMeshError as error:
        mesh, grid, report = plan.system.config.mesh, plan.grid, error.report()
        status = MeshStatus(mesh, "failed", 0, grid.last_point, grid.time(0), 0.0, 0.0, progress={}, error=report)
        emit(End(status, 0.0, 0, plan.system.result_file, report))
        raise


def _refuse_second(folder: Path, process: str, who: str) -> None:
    """Look whether somebody listens already where this process is going to.

    Raises:
        ConfigurationError: the process runs already.
    """
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(socket_endpoint(folder, process).partition("/")[2])
        except OSError:
            return
    raise ConfigurationError(f"{who} runs already", hint="Stop it first, or give this mesh another name.")


class _Emitter:
    """The master's events as lines for the launcher, or for the display of this process."""

    def __init__(self, emit: Callable[[Event], None]) -> None:
        self._emit = emit

    def status(self, status: MeshStatus) -> None:
        self._emit(Status(status))

    def log(self, line: LogLine) -> None:
        self._emit(Log(line))


def _node_plan(plan: Plan, name: str) -> NodePlan:
    """The plan of a node, or of the node that an instance runs in if it is alone there.

    Raises:
        ConfigurationError: there is no such node.
    """
    if name in plan.nodes and name != RECORDER:
        return plan.nodes[name]
    names = [node for node in plan.nodes if node != RECORDER]
    suggestion = nearest(name, names)
    if name in plan.system.instances:
        group = plan.node_of(name)
        raise ConfigurationError(f"instance '{name}' runs in the group '{group}'", hint=f"Start node '{group}'.")
    hint = f"Did you mean '{suggestion}'?" if suggestion else None
    raise ConfigurationError(f"there is no node '{name}'; there are: {listed(names)}.", hint=hint)
