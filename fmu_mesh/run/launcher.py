"""The launcher: starts one process per node and one for the master, and watches them until all have ended.

The fork server starts them (`fmu_mesh.run.fork_server`); a node that needs another Python is started by exec. Every
process should run until the master has reported the outcome. If a process ends before, the run ends with `MeshLost` and
the name of the process. A request to end goes to the master, which tells the nodes. Whatever happens, no process and no
file of the run is left at the end.
"""

# Who meets here (ADR 71). One thread calls `Launcher.run`: it alone starts processes, feeds `LaunchStates` and does
# what that says. It has to live as long as the processes, because the kernel signals the death of a *thread*
# (PDEATHSIG) to what that thread has started. For each process, `Child` has three threads: one for each pipe, and one
# that waits for the exit code. They, and whoever calls `interrupt` (any thread, or a signal handler), only put a
# function into one queue, so nothing here needs a lock. It is a `SimpleQueue` because its `put` may also be called in a
# signal handler.
#
# What may go wrong: everything that has no event. A process that is stopped writes nothing and does not end; a process
# that an FMU has left behind holds the pipes open; a fork server that is stopped or killed tells no exit code. So the
# wait for the queue has a limit, and then the state machine has the processes looked at.
#
# What was given up: to wait only for events (with a fork server that was stopped, the end of the master was noticed
# after 10 s, and a node was said to have ended with exit code 4); to end the run at the first sign of a loss (only the
# master knows the point and the instance, and it reports them within milliseconds); the wall clock (after Ctrl-Z and
# `fg`, or on a host that was suspended, every deadline had passed).

from __future__ import annotations

import queue
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Protocol

import msgspec
from msgspec.structs import replace

from ..awake import AwakeClock
from ..config.deadlines import Deadlines
from ..errors import ConfigurationError, FmuMeshError, Interrupted, MeshLost
from ..files import remove_tree
from ..results.played_rows import PLAYED_ROWS
from ..results.record_files import rows_left, what_is_kept
from ..system.placement import manual_hosts, placed
from ..system.plan import MASTER, RECORDER, NodePlan
from ..wire.journal import JOURNAL
from ..wire.refused_links import RefusedLinks
from ..wire.runtime import (
    box_of,
    leave_shared,
    remove_stale_folders,
    run_folder,
    run_name,
    shared_file,
    socket_endpoint,
    write_note,
)
from .child import Child, Process
from .events import Event, OutputLine, Reachable, WasReset, decode_event
from .fork_server import ForkServer, executed, executed_command, fork_server
from .launcher_states import (
    GATEWAY,
    SERVER,
    THE_MASTER,
    Action,
    FinishServer,
    LaunchStates,
    LaunchTerms,
    Look,
    Signal,
    Start,
)
from .limits import memory_share, why_ended
from .one_process import is_other_python
from .outcome import Outcome, last_recorded, outcome_at
from .run_plan import RunPlan
from .sandbox import Sandboxed
from .state_file import STATE, again_from_checkpoint
from .wiring import with_doors

__all__ = ["Elsewhere", "Launcher"]


class Elsewhere(Protocol):
    """The other hosts of a run: `are_ready` after each event, and now and then, until it is true; `start`; `close`."""

    def are_ready(self) -> bool:
        """Whether nodes can be started there; raises `FmuMeshError` if that will never be."""
        ...

    def start(self, node: NodePlan) -> Process | None:
        """Start a node; None if it belongs to this host."""
        ...

    def why(self, node: NodePlan) -> str | None:
        """How the process of a node has ended, if that is because its host was lost."""
        ...

    def close(self, *, goes_on: bool) -> None:
        """End what is left there; the journals stay there if the run ``goes_on`` with another attempt."""
        ...


class Launcher:
    """Runs a plan as processes of this host.

    Args:
        run: the plan of the run.
        on_event: called with every event, on the thread that calls `run`.
        elsewhere: connects to the other hosts of the run.

    Attributes:
        outcome: how the run ended, also where `run` raises an error; None before.
        next: the plan with which the run starts again, if it was lost and may; its journals are still there.
    """

    def __init__(
        self, run: RunPlan, on_event: Callable[[Event], None], elsewhere: Callable[..., Elsewhere] | None = None
    ) -> None:
        self._connect = elsewhere
        self._elsewhere: Elsewhere | None = None
        self.outcome: Outcome | None = None
        self.next: RunPlan | None = None
        is_again = run.restarts > 0  # at the same endpoints, with the same journals
        self._run = self._first = run if is_again else with_doors(replace(run, run=run_name()))  # the newest, the first
        self._on_event = on_event
        self._happened: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._server: ForkServer | None = None
        self._processes: dict[str, Child] = {}
        self._files: tuple[tuple[str, int], ...] | None = None
        self._shares: dict[str, float | None] = {}
        self._clock = AwakeClock()
        self._refused_links = RefusedLinks()
        config, plan = run.loaded.config, run.plan
        manual = {name for nodes in manual_hosts(plan).values() for name in nodes}
        self._states = LaunchStates(
            LaunchTerms(
                {
                    n: [item.name for item in node.instances]
                    for n, node in plan.nodes.items()
                    if n not in (RECORDER, *manual)
                },
                Deadlines.of(config.timeouts),
                has_gateway=config.ros is not None and config.ros.profile != "rclpy",
                start_time=plan.grid.start_time,
            )
        )

    def run(self) -> Outcome:
        """Start all processes, wait for the end, and remove what the run has left.

        Raises:
            FmuMeshError: the run ended early, and why.
        """
        self._run.check_memory()
        self._check_reachable()
        remove_stale_folders()
        self._folder = run_folder(self._run.mesh, self._run.run)
        has_run = False
        try:
            socket_endpoint(self._folder, MASTER)  # a path that is too long is found here
            for name, node in self._run.plan.nodes.items():
                if node.process.is_sandboxed:
                    box_of(self._folder, name).mkdir(mode=0o700, exist_ok=True)
            self._file = str(self._run.write(self._folder))
            self._reach_others()
            self._do(self._states.begin())
            while not self._states.is_ending:
                self._turn()
            has_run = True
        except FmuMeshError as error:
            if self._run.restarts:  # another host is not back
                plan, files = self._run.plan, self._run.with_earlier(())
                last = last_recorded(plan, files)
                error.at(last, plan.grid.time(last)).with_hint(what_is_kept(files))
                self.outcome = outcome_at(plan, last, files, error)
            raise
        finally:
            self._do(self._states.end(self._clock()))
            while not self._states.is_over:
                self._turn()
            self._close_all(goes_on=has_run and self._goes_on)
            if self._files is None:  # the master could not say it any more
                self._files = rows_left([record.file for record in self._run.plan.system.records], self._folder)
            self._files = self._run.with_earlier(self._files)
            self.next = self._next(self._files) if has_run and self._goes_on else None
            if self.next is None:
                self.clear()
            else:
                self._clear_for_next()
        return self._result(self._files)

    def clear(self) -> None:
        """Remove the folder of the run: it does not start again."""
        remove_tree(self._folder)

    def _clear_for_next(self) -> None:
        """Remove what the processes of this attempt have left, but for their journals and the note about the mesh."""
        journals = [*self._folder.glob(f"**/*{JOURNAL}")]
        states = self._folder.glob(f"*{STATE}")
        kept = {*journals, *states, *(file.parent for file in journals)}
        kept |= {self._folder / "mesh.json", self._folder / PLAYED_ROWS}
        boxes = [entry for entry in kept if entry.is_dir()]
        for entry in [entry for folder in {self._folder, *boxes} for entry in folder.iterdir()]:
            if entry not in kept:
                remove_tree(entry) if entry.is_dir() else entry.unlink(missing_ok=True)

    @property
    def _goes_on(self) -> bool:
        """Whether another attempt follows."""
        run, error = self._run, self._states.error()
        return type(error) is MeshLost and run is self._first and run.restarts < run.max_restarts

    def _next(self, files: Sequence[tuple[str, int]]) -> RunPlan:
        """The plan of the next attempt."""
        run = self._run
        seen = max(run.replays_to, last_recorded(run.plan, files), self._states.point)
        rows = tuple(rows for _, rows in files)
        again = replace(run, restarts=run.restarts + 1, rows=rows, replays_to=min(seen, run.plan.grid.last_point))
        return again_from_checkpoint(again, run.kept_in, rows) if run.checkpoint_s is not None else again

    def _check_reachable(self) -> None:
        """Check that nodes that are started manually on other hosts can reach the master.

        Raises:
            ConfigurationError: it has no endpoint for them.
        """
        zenoh, hosts = self._run.loaded.config.zenoh, manual_hosts(self._run.plan)
        if hosts and not (zenoh.listen or zenoh.connect):
            text = f"the nodes of host '{next(iter(hosts))}', which has no `ssh`, cannot reach this mesh"
            raise ConfigurationError(text, hint="Give it `listen=...` or `connect=...`, or `ssh` to the host.")

    def interrupt(self) -> None:
        """From any thread or signal handler: end the run; a second call ends it without waiting."""
        self._happened.put(lambda: self._do(self._states.interrupted(self._clock())))

    def _reach_others(self) -> None:
        """Wait until nodes can be started on all other hosts of the run."""
        if self._connect is not None:
            self._elsewhere = self._connect(self._run, self._folder, self._happened.put, self._take_word)
            while not self._elsewhere.are_ready():
                with suppress(queue.Empty):
                    self._happened.get(timeout=self._states.wait_s)()
                if self._states.is_asked:
                    raise Interrupted("interrupted")

    def _take_word(self, host: str, text: str) -> None:
        """From any thread: there is something to say about a host."""
        self._happened.put(lambda: self._on_event(OutputLine(f"host {host}", text)))

    # --- waiting and doing; all of it on the thread that called `run`

    def _turn(self) -> None:
        for name, process in self._processes.items():
            node = self._run.plan.nodes.get(name)
            if node is not None and node.process.memory is not None and process.pid is not None:
                self._shares[name] = memory_share(node.process, process.pid) or self._shares.get(name)
        try:
            self._happened.get(timeout=self._states.wait_s)()
            quiet = False
        except queue.Empty:
            quiet = True
        self._do(self._states.go_on(self._clock(), quiet=quiet))

    def _do(self, actions: Sequence[Action]) -> None:
        for action in actions:
            match action:
                case Start(name):
                    self._start(name)
                case Signal(name, number):
                    self._processes[name].signal(number)
                case FinishServer() if self._server is not None:
                    self._server.finish()
                case Look():
                    running = [name for name, process in self._processes.items() if process.running]
                    stopped = tuple(name for name in running if self._processes[name].stopped)
                    self._states.seen(running, stopped, self._clock())

    def _start(self, name: str) -> None:
        if name == SERVER:
            self._server = fork_server()
            self._watch(name, self._server.process, partial(self._take_output, name))
        elif name == THE_MASTER:
            self._watch(name, self._fork("master"), self._take_event)
        elif name == GATEWAY:
            self._watch(name, self._fork("gateway"), self._take_gateway_line)
        else:
            node = self._run.plan.nodes[name]
            process = self._elsewhere.start(node) if self._elsewhere is not None else None
            if process is not None:
                pass
            elif node.process.is_sandboxed:
                own, command = self._run.loaded.config.security, executed_command("node", self._file, name)
                keys = own.folder if own is not None else None
                process = Sandboxed(node, self._folder, command, self._is_own, keys)
            elif node.interpreter is not None and is_other_python(node.interpreter):
                process = executed("node", self._file, name, interpreter=node.interpreter)
            else:
                process = self._fork("node", name)
            self._watch(name, process, partial(self._take_output, name), limited=True)

    def _is_own(self, pid: int) -> bool:
        """From any thread: whether a process is one of this run."""
        return pid in [process.pid for process in [*self._processes.values()]]

    def _fork(self, role: str, *arguments: str) -> Process:
        assert self._server is not None
        return self._server.fork(self._run.mesh, role, self._file, *arguments)

    def _watch(self, name: str, process: Process, on_line: Callable[[bytes], None], *, limited: bool = False) -> None:
        self._processes[name] = child = Child(name, process, self._happened.put)
        child.watch(
            on_line,
            self._take_output,
            lambda name, code: self._states.ended(name, code, self._clock(), self._why(name, code)),
            limited=limited,
        )

    def _why(self, name: str, code: int) -> str | None:
        """How the process of a node has ended, if its limits say it."""
        node = self._run.plan.nodes.get(name)
        if node is None:
            return None
        return self._lost_host(node) or why_ended(code, node.process, self._shares.get(name))

    def _lost_host(self, node: NodePlan) -> str | None:
        """How the process of a node has ended, if that is because its host was lost."""
        return self._elsewhere.why(node) if self._elsewhere is not None else None

    def _take_event(self, line: bytes) -> None:
        try:
            event = decode_event(line)
        except msgspec.DecodeError:
            self._take_output(THE_MASTER, line)
            return
        if isinstance(event, Reachable):
            write_note(self._folder, self._run.note(event.endpoints))
        elif isinstance(event, Outcome):
            self._files = event.files
        elif isinstance(event, WasReset):
            self._run = self._first.after_resets(event.number)
        self._states.reported(event, self._clock())
        self._on_event(event)

    def _take_gateway_line(self, line: bytes) -> None:
        try:
            decode_event(line)  # it has one event: it is ready
        except msgspec.DecodeError:
            self._take_output(GATEWAY, line)
        else:
            self._do(self._states.gateway_ready())

    def _take_output(self, name: str, line: bytes) -> None:
        text = line.decode(errors="replace").rstrip()
        refused = self._refused_links.told(text) if name == THE_MASTER else None
        if refused != "":
            self._on_event(OutputLine(name, refused or text))

    # --- the end

    def _close_all(self, *, goes_on: bool) -> None:
        if self._elsewhere is not None:
            self._elsewhere.close(goes_on=goes_on)
        for process in self._processes.values():
            process.close()
        if self._server is not None:
            self._server.close()
        while not self._happened.empty():
            self._happened.get()()
        if (group := self._run.loaded.config.runtime.share_with) is not None:  # a master that was killed leaves it
            leave_shared(shared_file(self._folder, group))

    def _result(self, files: Sequence[tuple[str, int]]) -> Outcome:
        """The outcome of a run that went well.

        Raises:
            FmuMeshError: it did not.
        """
        plan, outcome, error = self._run.plan, self._states.outcome, self._states.error()
        if error is None:
            assert outcome is not None
            self.outcome = replace(outcome, warnings=tuple(map(self._states.with_how, outcome.warnings)))
            return self.outcome
        placed(plan, error)
        if isinstance(error, MeshLost) and error.instance in plan.system.instances:
            node = plan.nodes[plan.node_of(error.instance)]
            if (lost := self._lost_host(node)) is not None:  # that is why, whatever the node had time to say
                error.saying(f"node '{node.node}' was lost: its process {lost}")
        last = last_recorded(plan, files)
        if type(error) in (Interrupted, MeshLost) and last > (error.point or 0):
            error.at(last, plan.grid.time(last))
        seconds, warnings = (outcome.seconds, outcome.warnings) if outcome is not None else (0.0, ())
        self.outcome = outcome_at(plan, error.point or 0, files, error, seconds=seconds, warnings=warnings)
        raise error.with_hint(what_is_kept(files))
