"""A process with copies of a batch: it does what the batch asks for, until that ends.

Owns the copies, and what was saved of them. How they step is `fmu_mesh.run.copies`; the batch is
`fmu_mesh.run.process_copies`.
"""

# Threads: the main thread calls all FMUs, and waits for requests between them. The thread of the watch looks at each
# call: after its deadline, or after a crash, it says which copy the call was for and ends the process, while the main
# thread stays in the FMU. A third thread counts in the shared memory: where a component keeps the lock of the
# interpreter, or the process is stopped, the watch cannot run, and the batch sees that the count stands. Signals and
# the end of the parent are looked after as in a node (`fmu_mesh.run.process`), but Ctrl-C is for the program (ADR 82).

from __future__ import annotations

import os
import signal
import socket
import threading
import traceback
from collections.abc import Callable
from contextlib import closing, suppress
from typing import Any, Final

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray
from setproctitle import setproctitle

from ..errors import FmuError, FmuMeshError, MeshLost, StepFailed
from ..instances.call_guard import CallWatch
from ..instances.contract import LogMessage
from ..instances.registry import prepare
from ..wire.runtime import enter_run_folder, fmu_folder, run_folder
from .copies import Copies, Truths
from .copies_messages import (
    FIRST_COPIES,
    Answer,
    Begin,
    Channel,
    Failed,
    Free,
    Get,
    GoOn,
    LoggedByModel,
    Request,
    Reset,
    Restore,
    Save,
    Set,
    SharedBlock,
    StepCopies,
    Values,
)
from .limits import resident_bytes
from .local_system import opening_of
from .process import RunProcess
from .run_plan import RunPlan
from .system_copy import SavedCopy

__all__ = ["job_with_copies"]

_BEAT_S: Final = 0.5


def job_with_copies(run: RunPlan, number: str, part: str, control: str, memory: str) -> Callable[[], None]:
    """What a process with copies does; what all such processes need is done here, once.

    Args:
        run: the plan of each copy.
        number: that of the process in its batch, and how many there are: `1/4`.
        part: its first copy, the one after its last one, and how many the batch has: `0:512/1024`.
        control: the descriptor of its end of the pair of sockets.
        memory: the descriptor of the shared memory.
    """
    for name in run.plan.system.instances:
        with suppress(FmuMeshError):  # the process says it
            folder = fmu_folder(run_folder(run.mesh, run.run))
            opening = opening_of(run.plan, name, folder, lambda _message: None, run.showing)
            prepare(replace(opening, content=run.contents.get(name)))

    def job() -> None:
        for descriptor in (control, memory):
            os.set_inheritable(int(descriptor), False)  # noqa: FBT003  it takes no keyword
        (own, processes), (where, count) = (text.split("/") for text in (number, part))
        first, end = map(int, where.split(":"))
        setproctitle(f"fmu-mesh copies {where} of {run.mesh}")
        block = SharedBlock(int(memory), int(count), int(processes))
        channel = Channel(socket.socket(fileno=int(control)), Request)
        with RunProcess(run.mesh, run.run) as process:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            _CopiesProcess(run, process, channel, block, where=slice(first, end), number=int(own)).run()

    return job


class _CopiesProcess:
    """The copies, and what is done with them."""

    def __init__(  # noqa: PLR0913  the plan, and what is shared with the batch
        self, run: RunPlan, process: RunProcess, channel: Channel, block: SharedBlock, *, where: slice, number: int
    ) -> None:
        self._run, self._process = run, process
        self._channel, self._block, self._where, self._number = channel, block, where, number
        self._count = where.stop - where.start
        self._saved: dict[int, list[SavedCopy]] = {}
        self._told: dict[int, FmuMeshError] = {}
        self._requests = 0
        self._waits = True
        self._closed = threading.Event()
        self._before = 0
        self._copies: Copies

    def run(self) -> None:
        """Do what is asked for, until there is no more."""
        run, process = self._run, self._process
        enter_run_folder(process.folder, f"copies {self._number}")
        process.interruption.goes_to(lambda _reason: self._channel.end())
        threading.Thread(target=self._beat, name="beats", daemon=True).start()
        process.stack.callback(self._closed.set)
        folder = fmu_folder(process.folder)
        folder.mkdir(parents=True, exist_ok=True)
        watch = process.stack.enter_context(closing(CallWatch(self._failed, survives=True)))
        self._copies = Copies(run, self._count, folder, self._log, watch=watch)
        with watch.surviving(""):
            process.stack.callback(self._copies.close)
            while (request := self._next()) is not None:
                with watch.stepping(self._position, run.loaded.config.timeouts.step):
                    answer = self._answered(request)
                self._answer(answer)
            process.stack.close()

    def _next(self) -> Request | None:
        self._waits = True
        request: Request | None = self._channel.receive()
        self._requests += 1
        self._waits = False
        return request

    def _answered(self, request: Request) -> Answer:
        answer = Answer()
        try:
            for own in request:
                answer = self._do(own) or answer
        except FmuMeshError as error:
            answer = Answer(raised=error.report())
        except Exception:  # noqa: BLE001  the program that waits shows it
            answer = Answer(raised=FmuMeshError(f"an internal error: {traceback.format_exc()}").report())
        if self._copies.errors != self._told:
            self._told = dict(self._copies.errors)
            answer = replace(answer, errors={number: error.report() for number, error in self._told.items()})
        return answer

    def _answer(self, answer: Answer) -> None:
        self._tell_points()
        with suppress(OSError):  # the batch is gone, which the end of the requests tells
            self._channel.send(answer)

    def _tell_points(self) -> None:
        self._block.points[self._where] = self._copies.points
        self._block.ended[self._where] = self._copies.ended

    def _do(self, own: Any) -> Answer | None:  # noqa: ANN401, C901  one of a request; each has one line
        copies = self._copies
        match own:
            case Begin(gone):
                return self._begin(np.frombuffer(gone, np.bool_))
            case GoOn():  # a request that was not expected: all copies are there
                return None
            case StepCopies(points, reads):
                copies.step(points)
                for values in reads:
                    copies.get(values.instance, values.names, self._values(values))
            case Set(values, wanted, texts):
                rows = self._values(values) if texts is None else _texts(texts, values.width)
                copies.set(values.instance, values.names[0], rows, _truths(wanted))
            case Get(values) if values.dtype == "O":
                rows = np.full((self._count, values.width), None, object)
                copies.get(values.instance, values.names, rows)
                return Answer(texts=rows.tolist())
            case Get(values):
                copies.get(values.instance, values.names, self._values(values))
            case Save(state):
                self._saved[state] = copies.save()
            case Restore(state, wanted):
                copies.restore(self._saved[state], _truths(wanted))
            case Free(state) if state in self._saved:
                copies.free(self._saved.pop(state))
            case Reset(wanted, overrides):
                copies.reset(_truths(wanted), overrides.__getitem__ if overrides is not None else None)
        return None

    def _begin(self, gone: Truths) -> Answer:
        self._before = resident_bytes()
        self._copies.start(self._look_at_memory)
        for number in np.flatnonzero(gone).tolist():
            self._copies.end(number, MeshLost("the process with this copy has ended"))
        return Answer(why_not_saved=self._copies.why_not_saved)

    def _look_at_memory(self, ready: int) -> None:
        """After some copies, let the batch look at how much memory they take."""
        if ready == min(FIRST_COPIES, self._count):
            self._answer(Answer(taken=max(0, resident_bytes() - self._before)))
            if self._next() != [GoOn()]:
                raise MeshLost("the batch has ended")

    def _values(self, own: Values) -> NDArray[Any]:
        return self._block.values(own)[self._where]

    def _log(self, message: LogMessage) -> None:
        with suppress(OSError):  # as above
            self._channel.send(LoggedByModel(message))

    # --- on other threads

    def _beat(self) -> None:
        while not self._closed.wait(_BEAT_S):
            self._block.beats[self._number] += 1

    def _position(self) -> tuple[str, int, str]:
        """See `CallWatch.stepping`: where the main thread is; each request counts as progress."""
        if self._waits:  # for the memory of the others
            self._requests += 1
        runner = self._copies.under_way[1]
        doing, at = (runner.doing, runner.point) if runner is not None else ("a call", 0)
        return str(self._requests), int(self._copies.points.sum()) + at, doing

    def _failed(self, error: FmuError) -> None:
        """An FMU has not returned, or has crashed: the process has to end."""
        copy, runner = self._copies.under_way
        report = error.report()
        if report.instance not in self._run.plan.system.instances:
            report = replace(report, instance=runner.name if runner is not None else None)
        if copy is not None:
            point = runner.point if runner is not None else int(self._copies.points[copy])
            report = replace(report, point=point, time=self._run.plan.grid.time(point))
        self._tell_points()
        if copy is not None:
            self._block.points[self._where][copy] = self._copies.reached(copy)
        with suppress(OSError):  # as above
            self._channel.send(Failed(copy, report))
        self._process.end_now(StepFailed.exit_code)


def _truths(data: bytes) -> Truths:
    return np.frombuffer(data, np.bool_)


def _texts(texts: list[list[Any]], width: int) -> NDArray[Any]:
    rows = np.empty((len(texts), width), object)
    rows[:] = texts
    return rows
