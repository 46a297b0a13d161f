"""The recorder: receives frames like a node, and writes rows as soon as they are complete.

It has its own thread in the master's process, and its own inbox, liveliness token and progress. The grant waits for
rows that are not written yet. So no row is dropped, and memory is bounded.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from types import TracebackType
from typing import Any, Self

import numpy as np
import zenoh
from numpy.typing import NDArray

from ..errors import DeadlineExceeded, FmuMeshError, MeshLost, MessageRefused, from_report
from ..files import unwritable
from ..system.plan import RECORDER, Link, NodePlan
from ..system.recording import ResultFile
from ..wire.frames import FrameReceiver
from ..wire.inbox import Inbox, Message
from ..wire.keys import MASTER
from ..wire.membership import Membership, shared_inbox
from ..wire.messages import (
    ABORT,
    FINISH,
    FRAME,
    GRANT,
    HEADER,
    INITIAL,
    LAST,
    PROGRESS,
    NodeReport,
    decode_abort,
)

__all__ = ["Recorder"]

log = logging.getLogger(__name__)

_LOOK_S = 0.2
_WRITE_ROWS = 4096
_REST_S = 0.005
"""How long in s the recorder pauses while thousands of rows arrive: each frame that wakes the recorder takes a
processor from a node that steps, and writing many rows at once takes less time."""

_LEAST_REST_S = 0.0005
_REST_ROWS = 256
_LAST_S = 0.5
"""How long in s the recorder waits for the last rows of the nodes when a run ends early."""

_TELL_S = 0.1
_FLUSH_S = 0.2
_CAN_CHOOSE = hasattr(os, "sched_setaffinity")  # Linux


class Recorder:
    """Records one run.

    Args:
        plan: the recorder's part of the plan.
        session: the session of this process; the caller closes it.
        file: the result file; closed by the recorder.
        has_begun: whether all instances have reached point 0; nothing is written before.

    Use it as a context manager: the thread runs inside; afterwards the file has all complete rows.
    """

    def __init__(
        self,
        plan: NodePlan,
        session: zenoh.Session,
        file: ResultFile,
        has_begun: Callable[[], bool] = lambda: True,
        *,
        launch: str | None = None,
    ) -> None:
        self._plan = plan
        self._session = session
        self._sources = {
            link.index: _Source(FrameReceiver(link, "the recorder", plan.ring_rows, partial(self._fits, link)))
            for link in plan.links_in
        }
        by_name = {source.name: source for source in self._sources.values()}
        self._columns = [by_name[instance].column(variable) for instance, variable in plan.recorded]
        self._file = file
        self._has_begun = has_begun
        self._written = 0
        self._rested = 0
        self._rested_at = 0.0
        self._leaving = threading.Event()
        self._progress_sent = -1
        self._progress_told_at = 0.0
        self._finished = False
        # At the end the main thread writes what is left; on a slow disk this thread may still be writing.
        self._writing = threading.Lock()
        self._flushed = time.monotonic()
        self._flushed_rows = 0
        self._inbox = Inbox(shared_inbox(plan, spins=False))  # no process waits for it, but others need the processor
        self._membership = Membership(plan, session, self._inbox, launch)
        self._put_progress: Callable[[bytes], None]
        self._turns: _Turns
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)

    @property
    def rows(self) -> int:
        """Number of rows written so far; after the `with` block, the number of rows in the file."""
        return self._file.rows

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._leaving.set()
        if self._thread.is_alive():
            self._membership.give_up()
            self._inbox.post(self._end)
        self._thread.join(5.0)
        try:
            self._finish_file()
        except OSError as failure:
            # The master has already reported a failure during the run; this failure came after the last point.
            if error is None:
                raise unwritable(self._file.path, failure) from failure
        finally:
            self._membership.close()
            self._inbox.close()

    def _finish_file(self) -> None:
        try:
            self._write_complete_rows()
        finally:
            self._file.close()

    def _end(self) -> None:
        self._finished = True

    def _run(self) -> None:
        try:
            self._membership.register()
            self._meet_in_time()
            self._record()
            self._report(None)
        except _Ended:
            log.info("recording_ended_early", extra={"rows": self._written})
        except OSError as error:
            self._try_to_report(unwritable(self._file.path, error))
        except Exception as error:  # noqa: BLE001 whatever it is, the master must know that nothing is recorded any more
            known = error if isinstance(error, FmuMeshError) else FmuMeshError(f"recording failed: {error!r}")
            self._try_to_report(known)

    def _meet_in_time(self) -> None:
        try:
            self._meet()
        except MeshLost as error:
            # The master has the same deadline, and names all missing nodes; the recorder must not be one of them.
            patience_s = self._plan.timeouts.stop if isinstance(error, DeadlineExceeded) else 0.0
            end = time.monotonic() + patience_s
            while not self._finished and time.monotonic() < end:
                self._inbox.wait(_LOOK_S)
            raise _Ended(error) from error

    def _meet(self) -> None:
        welcome = self._membership.join()
        self._turns = _Turns(len({link.source_node for link in self._plan.links_in}.intersection(welcome.shared)))
        progress = self._membership.keys(self._plan.timeouts.start).progress(RECORDER)
        self._put_progress = self._membership.sender(MASTER, progress)

    def _record(self) -> None:
        """Receive rows, write them when there are many or when no message is left, and send the progress."""
        heard = self._rested_at = time.monotonic()
        while not self._finished:
            message = self._inbox.poll()
            if message is None:
                self._write_complete_rows()
                self._tell_progress()
                self._rest()
                message = self._inbox.wait(_LOOK_S)
            if message is not None:
                heard = time.monotonic()
                self._take(message)
                if self._complete() - self._written >= _WRITE_ROWS:
                    self._write_complete_rows()
                    self._tell_progress()
            elif time.monotonic() - heard > self._plan.timeouts.step:
                raise DeadlineExceeded("the recorder received nothing from the master")
        while self._leaving.is_set() and (message := self._inbox.poll()) is not None:
            self._take(message)  # messages that arrived before the end, above all its reason

    def _rest(self) -> None:
        """Pause, so that several frames arrive, if many rows have come since the last pause.

        At most for a quarter of the remaining time of the run at its present speed, so that its end is not delayed.
        """
        written, now = self._written, time.monotonic()
        came = written - self._rested
        if came < _REST_ROWS:
            return
        left_s = (self._plan.grid.last_point - written) * (now - self._rested_at) / came
        rest_s = min(_REST_S, left_s / 4)
        if rest_s >= _LEAST_REST_S:
            self._rested, self._rested_at = written, now
            self._turns.next()
            self._leaving.wait(rest_s)

    def _take(self, message: Message) -> None:
        self._inbox.hand_on(message, self._take_from_master, self._take_from_node)

    def _take_from_node(self, message: Message) -> None:
        sender, kind, number, count, point, data = message
        source = self._sources.get(number)
        if source is None or source.receiver.link.source_node != sender:
            raise MessageRefused(f"there is no link {number} from it to the recorder")
        if kind == FRAME:
            source.receiver.take(point, count, data)
        elif kind == LAST:
            source.end()
        elif kind != INITIAL:
            raise MessageRefused(f"a message of kind {kind} is not one that a node sends")

    def _take_from_master(self, message: Message) -> None:
        _, kind, _, _, _, data = message
        if kind == FINISH:
            self._finished = True
        elif kind == ABORT:
            cause = from_report(decode_abort(data))
            self._take_last_rows(cause)
            raise _Ended(cause)
        elif kind != GRANT:
            raise MessageRefused(f"a message of kind {kind} is not one that the master sends")

    def _fits(self, link: Link, end: int) -> bool:
        """Whether rows of a source before its own step ``end`` overwrite no rows that are not written yet."""
        return end - self._written // link.step_points <= self._plan.ring_rows

    def _complete(self) -> int:
        """The last point whose row is complete, or -1."""
        return min(source.covered(self._plan.grid.last_point) for source in self._sources.values())

    def _write_complete_rows(self) -> None:
        with self._writing:
            self._write_rows()
            rows = self._file.rows
            if rows > self._flushed_rows and (now := time.monotonic()) - self._flushed > _FLUSH_S:
                self._flushed_rows, self._flushed = rows, now
                self._file.flush()

    def _write_rows(self) -> None:
        rows = self._complete() + 1
        if rows <= self._written or not (self._written or self._has_begun()):
            return
        while (first := self._written) < rows:
            end = min(rows, first - first % self._plan.ring_rows + self._plan.ring_rows)  # read without wrap-around
            columns = [column(first, end) for column in self._columns]
            self._file.write(self._plan.grid.times(first, end), columns)
            self._written = end

    def _take_last_rows(self, cause: FmuMeshError) -> None:
        """When a run ends early, wait for the last frames; the rows that they complete are written at the end.

        Wait until every live node has reported that it has sent its last rows; lost nodes send nothing more.
        """
        if isinstance(cause, MeshLost):
            lost = (cause.instance or "").split(", ")
            for source in self._sources.values():
                if source.name in lost:
                    source.end()
        deadline = time.monotonic() + _LAST_S
        while True:
            message = self._inbox.poll()
            if message is None:
                left = deadline - time.monotonic()
                if left <= 0 or not self._rows_are_missing():
                    return
                message = self._inbox.wait(left)
            if message is not None and message[1] in (FRAME, LAST):
                self._take(message)

    def _rows_are_missing(self) -> bool:
        """Whether rows are still missing that would complete rows of the sources that have ended."""
        last_point, sources = self._plan.grid.last_point, self._sources.values()
        end = min((source.covered(last_point) for source in sources if source.ended), default=last_point)
        return any(not source.ended and source.covered(last_point) < end for source in sources)

    def _tell_progress(self) -> None:
        """Send the progress to the master, if the grant may depend on it or a status needs it."""
        complete = self._complete()
        now = time.monotonic()
        due = complete - self._progress_sent >= self._plan.progress_stride or now - self._progress_told_at > _TELL_S
        if complete > self._progress_sent and (due or complete == self._plan.grid.last_point):
            self._progress_sent = complete
            self._progress_told_at = now
            self._put_progress(HEADER.pack(PROGRESS, 0, 0, complete))

    def _report(self, error: FmuMeshError | None) -> None:
        """Report to the master how recording ended. A master that ends accepts no reports; it waits for this thread."""
        report = NodeReport(RECORDER, max(self._written - 1, 0), error.report() if error is not None else None)
        patience_s, left = self._plan.timeouts.stop, self._leaving.is_set
        try:
            self._membership.report(report, patience_s, left)
        except MeshLost:
            if not left():
                raise

    def _try_to_report(self, error: FmuMeshError) -> None:
        try:
            self._report(error)
        except FmuMeshError as unreachable:
            log.info("failure_not_reported", extra={"error": str(unreachable)})


class _Ended(FmuMeshError):
    """The run ended before its last point; the written rows are kept."""

    def __init__(self, cause: FmuMeshError) -> None:
        super().__init__(cause.message)


class _Source:
    """Rows of one instance that wait for rows of the others; ``ended``: no more rows will come."""

    def __init__(self, receiver: FrameReceiver) -> None:
        self.receiver = receiver
        self.name = receiver.link.source
        self.ended = False

    def end(self) -> None:
        """Note that no more rows will come."""
        self.ended = True

    def covered(self, last_point: int) -> int:
        """The last point for which the value is known; it holds until the next own point."""
        received, points = self.receiver.received, self.receiver.link.step_points
        if received * points > last_point:
            return last_point
        return received * points - 1

    def column(self, variable: str) -> Callable[[int, int], NDArray[Any]]:
        """A function that returns the values of a variable at the points first to end - 1, without wrap-around."""
        ring, step_points = self.receiver.kept, self.receiver.link.step_points
        place = ring.layout.place(variable)
        values, mask = ring.parts[place.part][:, place.first], ring.mask

        def each(first: int, end: int) -> NDArray[Any]:
            start = first & mask
            return values[start : start + end - first]

        def held(first: int, end: int) -> NDArray[Any]:
            column: NDArray[Any] = values[(np.arange(first, end) // step_points) & mask]
            return column

        return each if step_points == 1 else held


class _Turns:
    """Moves a thread that works from time to time to another processor each time.

    The scheduler wakes a thread on the processor on which it slept. So a recorder would interrupt the same node again
    and again, and this node would delay the others. Often two nodes then share one processor while another one is idle.

    Args:
        busy: number of nodes of this host that step all the time. If there are more processors, the scheduler finds the
            idle one, and this class does nothing.
    """

    def __init__(self, busy: int) -> None:
        self._busy = busy
        self._turn = 0

    def next(self) -> None:
        """Move the calling thread to the next processor; the scheduler may move it on to an idle one."""
        processors = sorted(os.sched_getaffinity(0)) if _CAN_CHOOSE else []
        if 1 < len(processors) <= self._busy:
            self._turn = (self._turn + 1) % len(processors)
            with suppress(OSError):  # this processor was just taken from this process
                os.sched_setaffinity(0, {processors[self._turn]})
                os.sched_setaffinity(0, processors)
