"""Copies of a system in several processes, each of which has a part of them: `Mesh.batch` where there are many.

Owns the processes: which copies each has, what it was asked, and how it has ended. What a process does with its copies
is `fmu_mesh.run.copies_role`; what a copy does is `fmu_mesh.run.copies`.
"""

# Processes (ADR 82): all are forked from one fork server (ADR 71), with an end of a pair of sockets and the memory. A
# request goes to all of them, then all answers are waited for; so there is at most one request under way, and one that
# is interrupted by an error of one process has the answers of all others. The thread that made the batch does all of
# it, and the server ends with this thread. Ctrl-C reaches no process: each has a session of its own.
#
# What may go wrong. A process ends, or says that it is about to: its copies have ended, with the reason, and the
# others go on. A process is stopped, or cannot run its watch: its count in the memory stands, and after the time of a
# step it is killed. The batch is killed: the kernel tells the server, the server its processes, and each of these sees
# the end of its standard input as well; the last one removes the folder. The memory has no name.
#
# Messages cost some 0.1 ms a round, so there are few of them. `set` only writes its values; they go with the next
# request. What was read after the step before is read after the next one, too, in the same request: a loop that sets,
# steps and reads takes one round. Only outputs are read ahead: reading them calls no FMU.

from __future__ import annotations

import logging
import os
import select
import socket
import subprocess
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ..awake import AwakeClock
from ..errors import CallRefused, ErrorReport, FmuMeshError, from_report
from ..files import remove_tree
from ..instances.contract import LogMessage
from ..wire.runtime import remove_stale_folders, run_folder, run_name
from .copies import Truths
from .copies_host import CopiesHost
from .copies_messages import (
    FIRST_COPIES,
    Answer,
    Begin,
    Free,
    Get,
    GoOn,
    Request,
    Reset,
    Restore,
    Save,
    Set,
    SharedBlock,
    StepCopies,
    Values,
)
from .copy_threads import Pieces
from .fork_server import ForkServer, fork_server
from .process import interrupts_later
from .run_plan import RunPlan
from .system_copy import Overrides, SavedCopy

__all__ = ["ProcessCopies"]

log = logging.getLogger("fmu_mesh.api.batch")

_EXIT_S: Final = 5.0
"""How long the fork server may take to end after its processes."""


class _Setting(NamedTuple):
    """A `set` that no process has got yet."""

    values: Values
    wanted: Truths
    texts: NDArray[Any] | None


class ProcessCopies:
    """As `Copies`, in so many ``processes``; arrays are those of all copies.

    Call sequence: as for `Copies`. A process that is lost ends its copies; `reset` starts another one for them.

    Args:
        run: the plan of each copy.
        count: how many copies.
        processes: how many processes, at most one for each copy.
        log: called with every log message of a model.
    """

    def __init__(self, run: RunPlan, count: int, processes: int, log: Callable[[LogMessage], None]) -> None:
        self._run = replace(run, run=run_name())
        self._folder: Path | None = None
        self._owner = os.getpid()
        self._log = log
        self._timeouts = run.loaded.config.timeouts
        self._server: ForkServer | None = None
        self._block = SharedBlock.made(count, processes)
        ends = np.linspace(0, count, processes + 1).astype(int).tolist()
        parts = [slice(first, end) for first, end in pairwise(ends)]
        self._hosts = [CopiesHost(number, part, self._block) for number, part in enumerate(parts)]
        self._points = np.zeros(count, np.int64)
        self._ended = np.zeros(count, np.bool_)
        self._gone = np.zeros(count, np.bool_)
        self._errors: dict[int, FmuMeshError] = {}
        self._states = 0
        self._why_not_saved: str | None = None
        self._places: dict[tuple[str, str, tuple[str, ...]], Values] = {}
        self._settings: list[_Setting] = []
        self._read: list[Values] = []
        self._ahead: list[Values] = []
        self._pieces = Pieces()
        self._poll = select.poll()

    def start(self, ready: Callable[[int, int], None] = lambda _count, _bytes: None) -> None:
        """See `Copies`.

        Args:
            ready: called once, with how many copies there are, and the memory that they take, in bytes.
        """
        remove_stale_folders()
        self._folder = run_folder(self._run.mesh, self._run.run)
        self._file = self._run.write(self._folder)
        self._start(self._hosts, self._gone, ready)

    def _start(
        self,
        hosts: Sequence[CopiesHost],
        gone: Truths,
        ready: Callable[[int, int], None] = lambda _count, _bytes: None,
    ) -> None:
        """Start processes, and open their copies; those that are ``gone`` take no steps.

        Raises:
            FmuMeshError: see `Copies.start`; or one of the processes has ended.
        """
        if self._server is not None and self._server.process.poll() is not None:
            self._end_server()
        self._server = self._server or fork_server()
        for host in hosts:
            host.start(self._server, self._run, self._file, len(self._hosts))
            self._poll.register(host.channel, select.POLLIN)
        first = self._ask(hosts, lambda host: [Begin(gone[host.part].tobytes())], demands=True)
        taken = sum(answer.taken for answer in first.values())
        ready(sum(min(FIRST_COPIES, host.size) for host in hosts), taken)
        answers = self._ask(hosts, lambda _host: [GoOn()], demands=True)
        self._why_not_saved = next(iter(answers.values())).why_not_saved

    @property
    def points(self) -> NDArray[np.int64]:
        """See `Copies`."""
        return self._points

    @property
    def ended(self) -> Truths:
        """See `Copies`."""
        self._notice()
        return self._ended.copy()

    @property
    def errors(self) -> dict[int, FmuMeshError]:
        """See `Copies`."""
        self._notice()
        return self._errors

    def step(self, points: int, is_asked: Callable[[], bool] = lambda: False) -> None:
        """See `Copies`; all processes take a piece before one takes the next."""
        reads, self._read, self._ahead = tuple(self._read), [], []
        self._pieces.take(
            points, is_asked, lambda piece: self._ask(self._hosts, lambda _host: [StepCopies(piece, reads)])
        )
        self._ahead = list(reads) if not self._errors else []

    # --- values

    def set(self, instance: str, name: str, values: NDArray[Any], wanted: Truths) -> None:
        """See `Copies`; it goes with the next request."""
        own = self._values("Set", instance, (name,), values)
        if any(setting.values is own for setting in self._settings):
            self._send_settings()
        is_text = values.dtype.hasobject
        if not is_text:
            self._block.values(own)[...] = values
        self._settings.append(_Setting(own, wanted.copy(), values.copy() if is_text else None))
        self._ahead = []

    def get(self, instance: str, names: Sequence[str], out: NDArray[Any]) -> None:
        """See `Copies`."""
        own = self._values("Get", instance, tuple(names), out)
        if out.dtype.hasobject:
            self._get_texts(own, out)
            return
        item = self._run.plan.nodes[self._run.plan.node_of(instance)].instance(instance)
        if item.step_points == 1 and set(names) <= set(item.outputs.names) and own not in self._read:
            self._read.append(own)
        if not any(known is own for known in self._ahead):
            self._block.values(own)[...] = out  # where a copy has no value any more, it stays as it is
            self._ask(self._hosts, lambda _host: [Get(own)])
        np.copyto(out, self._block.values(own), where=~self._gone[:, np.newaxis])

    def _get_texts(self, own: Values, out: NDArray[Any]) -> None:
        for host, answer in self._ask(self._hosts, lambda _host: [Get(own)]).items():
            rows = np.empty((host.size, own.width), object)
            rows[:] = answer.texts
            np.copyto(out[host.part], rows, where=rows != None)  # noqa: E711  of each element

    def _values(self, verb: str, instance: str, names: tuple[str, ...], rows: NDArray[Any]) -> Values:
        """Where values lie: always at the same place."""
        key = verb, instance, names
        if key not in self._places:
            place = 0 if rows.dtype.hasobject else self._block.place_for(rows.dtype, rows.shape[1])
            self._places[key] = Values(instance, names, place, rows.dtype.str.lstrip("|"), rows.shape[1])
        return self._places[key]

    # --- states

    @property
    def why_not_saved(self) -> str | None:
        """See `Copies`."""
        return self._why_not_saved

    def save(self) -> list[SavedCopy]:
        """See `Copies`; the states stay in the processes, which know them by a number."""
        self._states += 1
        state = self._states
        try:
            self._ask(self._hosts, lambda _host: [Save(state)])
        except FmuMeshError:
            self._ask(self._hosts, lambda _host: [Free(state)])
            raise
        return [
            SavedCopy(int(self._points[number]), {"": (state, host.starts)}, b"", None)
            for host in self._hosts
            for number in range(host.part.start, host.part.stop)
        ]

    def restore(self, saved: Sequence[SavedCopy], wanted: Truths) -> None:
        """See `Copies`.

        Raises:
            CallRefused: the process that had a state has ended.
        """
        hosts, state = [host for host in self._hosts if wanted[host.part].any()], 0
        for host in hosts:
            state, starts = cast("tuple[int, int]", saved[host.part.start].states[""])
            if host.process is None or starts != host.starts:
                text = f"the states of {host.copies} are gone with their process"
                raise CallRefused(text, hint="Reset these copies.")
        self._send_settings()
        self._ahead = []
        self._ask(hosts, lambda host: [Restore(state, wanted[host.part].tobytes())])

    def free(self, saved: Sequence[SavedCopy]) -> None:
        """See `Copies`."""
        state, _ = cast("tuple[int, int]", saved[0].states[""])
        self._ask(self._hosts, lambda _host: [Free(state)])

    def reset(self, wanted: Truths, overrides: Callable[[int], Overrides] | None = None) -> None:
        """See `Copies`; copies whose process has ended get another one."""
        self._send_settings()
        self._ahead = []
        lost = [host for host in self._hosts if host.process is None and wanted[host.part].any()]
        if lost:
            self._start(lost, self._gone & ~wanted)
        for number in np.flatnonzero(wanted & self._gone).tolist():
            self._errors.pop(number, None)
        self._gone = self._gone & ~wanted
        hosts = [host for host in self._hosts if wanted[host.part].any() and (host not in lost or overrides)]

        def request(host: CopiesHost) -> Request:
            first, numbers = host.part.start, np.flatnonzero(wanted[host.part]).tolist()
            own = {number: overrides(first + number) for number in numbers} if overrides is not None else None
            return [Reset(wanted[host.part].tobytes(), own)]

        self._ask(hosts, request, demands=True)

    # --- requests and answers

    def _send_settings(self) -> None:
        if self._settings:
            self._ask(self._hosts, lambda _host: [])

    def _notice(self) -> None:
        """Set what was not set yet, and notice what has ended meanwhile."""
        self._send_settings()
        for descriptor, _ in self._poll.poll(0):
            host = next(own for own in self._hosts if own.is_at(descriptor))
            if not host.news(self._log)[1]:
                self._lose(host)

    def _ask(
        self, hosts: Sequence[CopiesHost], request: Callable[[CopiesHost], Request], *, demands: bool = False
    ) -> dict[CopiesHost, Answer]:
        """Send a request to processes, after what was not set yet, and wait for all answers.

        Raises:
            FmuMeshError: what the first one has raised; or that one has ended, if the call ``demands`` all of them.
        """
        settings, self._settings = self._settings, []
        running = [host for host in hosts if host.process is not None]
        with interrupts_later():
            for host in running:
                own = [_set_of(setting, host.part) for setting in settings]
                host.ask([*own, *request(host)])
            answers = self._answers(running)
        np.copyto(self._points, self._block.points, where=~self._gone)
        np.copyto(self._ended, self._block.ended, where=~self._gone)
        for host, answer in answers.items():
            if answer.errors is not None:
                self._note_errors(host, answer.errors)
        if demands and (lost := next((host for host in running if host.process is None), None)) is not None:
            raise lost.reason(self._run.plan.grid)
        for answer in answers.values():
            if answer.raised is not None:
                raise from_report(answer.raised)
        return answers

    def _note_errors(self, host: CopiesHost, errors: Mapping[int, ErrorReport]) -> None:
        first = host.part.start
        before = {
            number: own
            for number, own in self._errors.items()
            if host.part.start <= number < host.part.stop and not self._gone[number]
        }
        for number in before:
            del self._errors[number]
        for number, report in errors.items():
            if not self._gone[first + number]:
                self._errors[first + number] = from_report(report)

    def _answers(self, hosts: Sequence[CopiesHost]) -> dict[CopiesHost, Answer]:
        """Wait for the answers of processes; those that are lost give none."""
        answers: dict[CopiesHost, Answer] = {}
        waiting, clock = list(hosts), AwakeClock()
        for host in hosts:
            host.awaited(clock())
        while waiting:
            for host in [*waiting]:
                answer, more = host.news(self._log)
                if answer is not None:
                    answers[host] = answer
                elif more:
                    host.look(clock(), self._timeouts)
                    continue
                else:
                    self._lose(host)
                waiting.remove(host)
        return answers

    def _lose(self, host: CopiesHost) -> None:
        """A process has ended, and so have its copies."""
        self._poll.unregister(host.channel)
        host.lose()
        part, grid = host.part, self._run.plan.grid
        if (copy := host.guilty) is not None and not self._gone[copy]:  # the others are where their last answer was
            self._points[copy] = self._block.points[copy]
        for number in range(part.start, part.stop):
            if number not in self._errors and self._points[number] < grid.last_point:
                self._errors[number] = host.reason(grid, number, int(self._points[number]))
        self._gone[part] = self._ended[part] = True
        self._ahead = []

    def close(self) -> None:
        """See `Copies`; on any thread. In a fork of the program it does nothing."""
        if os.getpid() != self._owner:
            return
        with interrupts_later():
            for host in self._hosts:
                if host.process is not None:
                    host.channel.end(socket.SHUT_WR)
            running, clock = [host for host in self._hosts if host.process is not None], AwakeClock()
            for host in running:
                host.awaited(clock())
                while host.news(self._log)[1]:  # it may have an answer that nobody waits for
                    host.look(clock(), self._timeouts)
                self._lose(host)
                if host.failed is not None:
                    log.warning("%s", from_report(host.failed.error))
            self._end_server()
        self._block.close()
        if self._folder is not None:
            remove_tree(self._folder)

    def _end_server(self) -> None:
        server, self._server = self._server, None
        if server is None:
            return
        server.finish()
        try:
            server.process.communicate(timeout=_EXIT_S)
        except subprocess.TimeoutExpired:
            server.process.kill()
            with suppress(subprocess.TimeoutExpired):  # it waits for a disk that does not answer (state D)
                server.process.communicate(timeout=_EXIT_S)
        server.close()


def _set_of(setting: _Setting, part: slice) -> Set:
    texts = setting.texts[part].tolist() if setting.texts is not None else None
    return Set(setting.values, setting.wanted[part].tobytes(), texts)
