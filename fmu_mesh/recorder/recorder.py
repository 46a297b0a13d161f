"""The recorder: reads the rings of all recorded instances, and writes rows as soon as they are complete.

It has its own thread in the master's process, and its own inbox, liveliness token and progress. No node may be further
ahead of the rows that are not written yet than the window of the recorder. So no row is dropped, and memory is bounded.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Collection
from functools import partial
from types import TracebackType
from typing import Any, Self

import numpy as np
import zenoh
from numpy.typing import NDArray

from ..errors import DeadlineExceeded, FmuMeshError, MeshLost, MessageRefused, ProtocolBroken, from_report
from ..files import unwritable
from ..rings.host_memory import HostMemory, Wish
from ..system.plan import RECORDER, Link, NodePlan
from ..system.recording import ResultFile
from ..variables.value_types import is_text
from ..wire.frames import FrameReceiver, SourceRows, rows_of
from ..wire.inbox import Inbox, Message
from ..wire.membership import Membership
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
_WAKE_ROWS = 2048
_REST_S = 0.005
"""How long in s the recorder pauses while rows come: each time it wakes up it takes a processor from a node that steps,
and writing many rows at once takes less time."""

_LAST_S = 0.5
"""How long in s the recorder waits for the last rows of the nodes when a run ends early."""

_TELL_S = 0.1
_FLUSH_S = 0.2


class Recorder:
    """Records one run.

    Args:
        plan: the recorder's part of the plan.
        session: the session of this process; the caller closes it.
        file: the result file; closed by the recorder.
        has_begun: whether all instances have reached point 0; nothing is written before.

    Use it as a context manager: the thread runs inside; afterwards the file has all complete rows.
    """

    def __init__(  # noqa: PLR0913  one participant and its surroundings
        self,
        plan: NodePlan,
        session: zenoh.Session,
        file: ResultFile,
        has_begun: Callable[[], bool] = lambda: True,
        *,
        launch: str | None = None,
        memory: HostMemory | None = None,
    ) -> None:
        self._plan = plan
        self._session = session
        self._own_memory = HostMemory.private(plan.memory, RECORDER)
        self._memory = memory if memory is not None else self._own_memory
        self._sources: dict[int, _Source] = {}
        self._columns: list[Callable[[int, int], NDArray[Any]]] = []
        self._rows = plan.rings[0].rows
        self._file = file
        self._has_begun = has_begun
        self._written = 0
        self._leaving = threading.Event()
        self._progress_sent = -1
        self._progress_told_at = 0.0
        self._finished = False
        # At the end the main thread writes what is left; on a slow disk this thread may still be writing.
        self._writing = threading.Lock()
        self._flushed = time.monotonic()
        self._flushed_rows = 0
        self._inbox = Inbox(self._memory)
        self._membership = Membership(plan, session, self._inbox, launch, memory=memory)
        self._put_progress: Callable[[bytes], None]
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
        shares = {*welcome.shared} if self._memory is not self._own_memory else set()
        self._sources = {link.index: self._source(link, shares) for link in self._plan.links_in}
        by_name = {source.link.source: source for source in self._sources.values()}
        self._columns = [by_name[instance].column(variable) for instance, variable in self._plan.recorded]
        self._put_progress = self._membership.sender(
            self._membership.keys(self._plan.timeouts.start).progress(RECORDER)
        )

    def _source(self, link: Link, shares: Collection[str]) -> _Source:
        place = next(place for place in self._plan.rings if place.instance == link.source)
        shared = self._memory if link.source_node in shares else None
        return _Source(link, *rows_of(link, place, shared, self._own_memory, partial(self._fits, link)))

    def _record(self) -> None:
        """Write rows when there are many, or every few milliseconds, and tell the progress."""
        heard = time.monotonic()
        while not self._finished:
            message = self._inbox.poll()
            if message is None:
                self._write_complete_rows()
                self._tell_progress()
                if (wishes := self._wishes()) is None:
                    continue
                message = self._inbox.wait(_REST_S if self._complete() >= self._written else _LOOK_S, wishes)
            if message is not None:
                heard = time.monotonic()
                self._take(message)
            elif time.monotonic() - heard > self._plan.timeouts.step:
                raise DeadlineExceeded("the recorder received nothing from the master")
        end = time.monotonic() + _LAST_S
        while self._leaving.is_set() and (left := end - time.monotonic()) > 0:
            if (message := self._inbox.wait(left)) is not None:
                self._take(message)  # messages that are under way, above all the reason of the end

    def _wishes(self) -> list[Wish] | None:
        """Wake up when many rows can be written, or all that are left; first for point 0. None: they are there."""
        last_point, complete = self._plan.grid.last_point, self._complete()
        if self._written > last_point:
            return []
        due = min(self._written + _WAKE_ROWS if complete >= 0 else 0, last_point)
        if self._written <= complete and complete >= due and (self._written or self._has_begun()):
            return None
        slowest = min(self._sources.values(), key=lambda source: source.covered(last_point))
        rows = due // slowest.link.step_points + 1
        return [(counter, rows) for counter in slowest.counters]

    def _take(self, message: Message) -> None:
        self._inbox.hand_on(message, self._take_from_master, self._take_from_node)

    def _take_from_node(self, message: Message) -> None:
        sender, kind, number, count, point, data = message
        source = self._sources.get(number)
        if source is None or source.link.source_node != sender:
            raise MessageRefused(f"there is no link {number} from it to the recorder")
        if kind == FRAME and source.receiver is not None:
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
        return end - self._written // link.step_points <= self._rows

    def _complete(self) -> int:
        """The last point whose row is complete, or -1."""
        return min((source.covered(self._plan.grid.last_point) for source in self._sources.values()), default=-1)

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
            end = min(rows, first - first % self._rows + self._rows, first + _WRITE_ROWS)  # read without wrap-around
            self._check(first, end)
            self._file.write(self._plan.grid.times(first, end), [column(first, end) for column in self._columns])
            self._check(first, end)
            self._written = end

    def _check(self, first: int, end: int) -> None:
        """The rows from which points are written are complete, and nobody has overwritten them."""
        for source in self._sources.values():
            source.check(first, end)

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
        """Tell how many points are written; the first one before, because nothing is written until all are there."""
        known = max(self._written, min(self._complete() + 1, 1))
        if self._memory is not self._own_memory:
            self._memory.progress[RECORDER].raise_to(known)
            return
        complete, now = known - 1, time.monotonic()
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
    """Rows of one instance that wait for rows of the others.

    Args:
        link: what is recorded of it.
        rows: where its rows are.
        receiver: takes its frames; None if nothing comes in frames.

    Attributes:
        ended: whether no more rows will come.
    """

    def __init__(self, link: Link, rows: list[SourceRows], receiver: FrameReceiver | None) -> None:
        self.link = link
        self.name = link.source
        self.receiver = receiver
        self.ended = False
        self._rows = rows
        self.counters = [own.counter for own in rows]

    def end(self) -> None:
        """Note that no more rows will come."""
        self.ended = True

    def covered(self, last_point: int) -> int:
        """The last point for which the value is known; it holds until the next own point."""
        received, points = min(counter.value for counter in self.counters), self.link.step_points
        if received * points > last_point:
            return last_point
        return received * points - 1

    def check(self, first: int, end: int) -> None:
        """The rows for the points first to end - 1 are complete.

        Raises:
            ProtocolBroken: one is not.
        """
        low, high = first // self.link.step_points, (end - 1) // self.link.step_points + 1
        wanted = np.arange(low + 1, high + 1)
        for ring, _, _ in self._rows:
            wrong = ring.stamps[(wanted - 1) & ring.mask] != wanted
            if wrong.any():
                raise ProtocolBroken(
                    f"a row of '{self.name}' for the recorder is not the one that was written",
                    instance=self.name,
                    point=(low + int(wrong.argmax())) * self.link.step_points,
                    hint="Does another process write to the memory of this run?",
                )

    def column(self, variable: str) -> Callable[[int, int], NDArray[Any]]:
        """A function that returns the values of a variable at the points first to end - 1, without wrap-around."""
        has_text = is_text(self.link.layout.column(variable).type)
        ring, step_points = next(own.ring for own in self._rows if own.text in (None, has_text)), self.link.step_points
        place = ring.layout.place(variable)
        values, mask = ring.parts[place.part][:, place.first], ring.mask

        def each(first: int, end: int) -> NDArray[Any]:
            start = first & mask
            return values[start : start + end - first]

        def held(first: int, end: int) -> NDArray[Any]:
            column: NDArray[Any] = values[(np.arange(first, end) // step_points) & mask]
            return column

        return each if step_points == 1 else held
