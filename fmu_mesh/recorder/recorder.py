"""The recorder: reads the rings of all recorded instances, and writes rows into all files as soon as they are complete.

It has its own thread in the master's process, and its own inbox, liveliness token and progress. No node may be further
ahead of the rows that are not written yet than the window of the recorder. So no row is dropped, and memory is bounded.
"""

# Who meets here. The recorder is a thread of the master's process; the master is the main thread of it. The nodes are
# other processes, often on the same host. They meet in two places: counters in shared memory, which the nodes raise and
# this thread reads (and the other way round for the progress), and the inbox, into which Zenoh's threads put frames and
# messages, and the main thread the end of the run (`__exit__`). Only this thread touches the sources and the files
# until it has ended; then a second one writes what is left and closes them. The main thread reads in which file a
# write is under way, and for how long (`check_writing`), and the newest defects, which this thread replaces as a whole.
#
# What may go wrong:
# * A node could overwrite rows that are not written yet. The windows forbid it, and the stamps of all rows are compared
#   before and after they are read: a row that is not the one expected ends the run and never becomes a value.
# * The run may fail in Initialization Mode, after rows of point 0 are complete. So nothing is written before the master
#   says that all nodes have begun (ADR 50): the last result stays.
# * A run that ends early still has rows on their way. This thread waits half a second for the nodes to say that they
#   have sent their last ones, and not for those that are lost.
# * A disk may not take what is written (a network disk whose server is gone). A write cannot be cancelled, and not even
#   SIGKILL ends it. So the main thread ends the run after `timeouts.write`, and this thread is left behind (ADR 89).
# * The reason of such an end comes from the master of this process and not by a message: on the other thread a message
#   may arrive after the end.
#
# What was tried and given up: a thread that never slept while rows came took a processor from a node that steps, and
# the interpreter from the master; one that woke up only five times a second let the run wait at point 0. Now it sleeps
# until half a window is there, or for 5 ms. A recorder thread for each file would read the same rings several times
# (ADR 60). The rings and counters are ADR 58.

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

import zenoh
from msgspec import to_builtins
from msgspec.structs import astuple

from ..awake import AwakeClock
from ..errors import (
    ConfigurationError,
    DeadlineExceeded,
    FmuMeshError,
    MeshLost,
    MessageRefused,
    RunReset,
)
from ..files import Kept
from ..results.defects import DefectWatch
from ..results.growth import GrowthWatch
from ..results.played_rows import MemoryOf, PlayedRows
from ..results.record_files import RecordFiles
from ..results.recording import ResultFile
from ..rings.host_memory import HostMemory, Wish
from ..simtime import ENDLESS
from ..system.defect import Defect, largest_defects
from ..system.live_keys import KeyValue
from ..system.plan import RECORDER, Link, NodePlan
from ..variables.value_conversion import MAX_TEXT_SIZE
from ..wire.frames import SourceRows, rows_of
from ..wire.inbox import Inbox, Message
from ..wire.membership import Membership
from ..wire.messages import (
    ABORT,
    FINISH,
    FOR_METADATA,
    FRAME,
    GRANT,
    HEADER,
    INITIAL,
    KEYS,
    LAST,
    NOTED,
    PROGRESS,
    REFUSED,
    RESET,
    SAVE,
    SET,
    NodeReport,
    Noted,
    SetValue,
    decode_json,
)
from ..wire.router_link import RouterLink
from ..wire.ways import Ways
from .recorded_source import RecordedSource

__all__ = ["Recorder"]

log = logging.getLogger(__name__)

# Rows that have come and are too few to wake the recorder are written after this time at the latest, so that a result
# can be followed while the run is slow. A wake-up that a killed process has lost costs this much once (docs/rings.md).
_LONGEST_SLEEP_S = 0.2
_WRITE_ROWS = 4096
_WAKE_ROWS = 2048
_REST_S = 0.005
"""How long in s the recorder pauses while rows come: each time it wakes up it takes a processor from a node that steps,
and writing many rows at once takes less time."""

_LAST_S = 0.5
"""How long in s the recorder waits for the last rows of the nodes when a run ends early."""
_MOST_KEYS = 8 * MAX_TEXT_SIZE
"""In bytes; JSON has up to six for a character."""
_FLUSH_S = 0.2
_DEFECTS_S = 1.0
"""How often in s, at most, defects are calculated for the status; a hundredth of the time if there are very many."""
_SHOWN_DEFECTS = 64
"""Defects in the status, which is published ten times a second."""
_LOOK_S = 0.1
"""How often in s the end of the recorder is looked at for a write that does not return."""

_AUDIT_S = 10.0
"""Time in s between two notes of the audit, but for the last one."""


class Recorder:
    """Records one run.

    Args:
        session: the session of this process; the caller closes it.
        files: the result files, in the order of the plan; closed by the recorder.
        wanted: the point up to which the master lets nodes step, such as that of a pause; negative until all instances
            have reached point 0, and nothing is written before.
        notes: the folder of the run, if somebody counts the rows when this process was killed (`rows_left`).
        memory: that of the master's process, if others exchange rows through it or through its row streams.
        mirror_of: where the rows of a link come to that has a row stream.
        audit: how often something has come from outside, and what, for the metadata.
        played: gets the rows of the nodes that may have to play them.
        on_flush: called about five times a second, with what the operating system has of each file; its error ends the
            run.

    Use it as a context manager: the thread runs inside; afterwards the files have all complete rows.
    """

    def __init__(  # noqa: PLR0913  one participant and its surroundings
        self,
        plan: NodePlan,
        session: zenoh.Session,
        files: Sequence[ResultFile],
        wanted: Callable[[], int] = lambda: ENDLESS,
        *,
        growth: GrowthWatch | None = None,
        defects: DefectWatch | None = None,
        notes: Path | None = None,
        launch: str | None = None,
        router: RouterLink | None = None,
        memory: HostMemory | None = None,
        mirror_of: Callable[[Link], SourceRows | None] = lambda _link: None,
        audit: Callable[[], tuple[int, object]] = lambda: (0, None),
        on_flush: Callable[[Sequence[Kept]], None] = lambda _kept: None,
        played: PlayedRows | None = None,
    ) -> None:
        self._plan = plan
        self._mirror_of, self._audit, self._audited, self._audit_at = mirror_of, audit, 0, -math.inf
        self._own_memory = HostMemory.private(plan.memory, RECORDER)
        self._own_memory.begin_at(plan.grid.first_point, plan.rings)
        self._memory = memory if memory is not None else self._own_memory
        self._sources: dict[int, RecordedSource] = {}
        self._rings: dict[str, MemoryOf] = {}
        self._rows = min(place.rows for place in plan.rings)
        # At the end of the window, the nodes would wait for this thread.
        self._wake_rows = max(1, min(_WAKE_ROWS, plan.window // 2))
        self._files = RecordFiles(files, growth, notes, defects)
        self._wanted, self._on_flush, self._played = wanted, on_flush, played
        self._first = self._written = self._told = plan.grid.first_point
        self._flushed = self._defects_due = 0.0
        self._newest_defects: dict[str, Defect] = {}
        self._finished = False
        self._finish_at: float = math.inf
        self._cause: BaseException | None = None
        self._ended: set[str] = set()
        self._inbox = Inbox(self._memory)
        self._router = router or RouterLink(session)
        self._membership = Membership(plan, session, self._inbox, launch, self._router, memory=memory)
        self._put_progress: Callable[[bytes], None]
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._clock = AwakeClock()

    @property
    def files(self) -> tuple[tuple[str, int], ...]:
        """Each file and its number of rows written so far; after the `with` block, the number of rows in the file."""
        return self._files.counted

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the rows warn of; complete after the `with` block."""
        return self._files.warnings

    @property
    def defects(self) -> dict[str, Defect]:
        """See `RecordFiles`; complete after the `with` block."""
        return self._files.defects

    def newest_defects(self) -> dict[str, Defect]:
        """From any thread: the 64 largest of about a second ago, the largest first."""
        return self._newest_defects

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._membership.give_up()
        self._inbox.post(lambda: self._end(error))
        last = Future[None]()
        threading.Thread(target=self._finish, args=(error, last), name="recorder's end", daemon=True).start()
        try:
            while not wait([last], _LOOK_S).done:  # a slow disk takes its time, but each write has its deadline
                self.check_writing()
            last.result()
        except (ConfigurationError, DeadlineExceeded):
            # The master has already reported a failure during the run; this failure came after the last point.
            if error is None:
                raise
        finally:
            self._membership.close()
            self._inbox.close()

    def check_writing(self) -> None:
        """From the thread of the master, at least twice a second: look whether each write returns in time.

        Raises:
            DeadlineExceeded: one has not returned for `timeouts.write`. The thread stays in it.
        """
        try:
            self._files.check_writing(self._clock(), self._plan.timeouts.write)
        except DeadlineExceeded as error:
            point = max(self._written - 1, 0)
            raise error.at(point, self._plan.grid.time(point))  # noqa: B904  it is the same error

    def _finish(self, error: BaseException | None, last: Future[None]) -> None:
        """Write all that is complete after the end, and close the files."""
        try:
            self._thread.join()  # all its waits have deadlines, but that for a disk
            try:
                self._take_notes()
                self._write_rows()
                self._note_audit()
                if isinstance(error, RunReset):
                    self._files.note({"ended_by": error.message})
            finally:
                self._files.close()
                if self._played is not None:
                    self._played.close()
        except BaseException as failure:  # noqa: BLE001  the thread of the master raises it
            last.set_exception(failure)
        else:
            last.set_result(None)

    def _take_notes(self) -> None:
        """All nodes have reported: what they have told before, faster rows may have overtaken."""
        self._inbox.settle(_LAST_S)
        while (message := self._inbox.poll()) is not None:
            if message[1] in FOR_METADATA:
                self._take(message)

    def _note_audit(self, now: float = math.inf) -> None:
        """Some formats keep all that was noted, so a stream of values is not noted whenever its number has changed."""
        changes, audit = self._audit()
        if changes != self._audited and now - self._audit_at >= _AUDIT_S:
            self._audited, self._audit_at = changes, now
            self._files.note({"audit": to_builtins(audit)})

    def _end(self, cause: BaseException | None) -> None:
        self._finished, self._cause = True, cause

    def _run(self) -> None:
        failure: FmuMeshError | None = None
        try:
            self._membership.register()
            if not self._meet():
                return
            self._record()
            if self._cause is not None:
                self._take_last_rows(self._cause)
                log.info("recording_ended_early", extra={"rows": self._written - self._first})
                return
        except Exception as error:  # noqa: BLE001 whatever it is, the master must know that nothing is recorded any more
            failure = error if isinstance(error, FmuMeshError) else FmuMeshError(f"recording failed: {error!r}")
        self._report(failure)

    def _meet(self) -> bool:
        """Join the mesh. If this fails, the master has the same deadline, and names all missing nodes."""
        try:
            welcome = self._membership.join()
            progress_key = self._membership.keys(self._plan.timeouts.start).progress(RECORDER)
        except MeshLost:
            return False
        self._sources = {link.index: self._source(link, welcome.ways) for link in self._plan.links_in}
        by_name = {source.link.source: source for source in self._sources.values()}
        self._rings = {name: source.memory for name, source in by_name.items()}
        self._files.begin(
            self._plan.grid, self._plan.records, lambda instance, variable: by_name[instance].column(variable)
        )
        self._put_progress = self._membership.sender(progress_key)
        return True

    def _source(self, link: Link, ways: Ways) -> RecordedSource:
        """Where the rows of an instance are: in its ring, in a mirror that frames fill, or text in the mirror."""
        place = next(place for place in self._plan.rings if place.instance == link.source)

        def fits(end: int) -> bool:
            """Whether rows of the source before its own step ``end`` overwrite no rows that are not written yet."""
            return end - self._written // link.step_points <= place.rows

        way, mirror = ways.way(RECORDER, link.source_node), self._mirror_of(link)
        rows, receiver = rows_of(link, place, way, self._memory, self._own_memory, fits)
        if mirror is not None:
            rows = [mirror if own.text is False else own for own in rows]
        return RecordedSource(link, self._plan.grid.last_point, rows, receiver)

    def _record(self) -> None:
        """Write rows when there are many, or every few milliseconds, and tell the progress."""
        while not self._finished and self._written <= self._finish_at:
            message = self._inbox.poll()
            if message is None:
                self._write_rows()
                self._tell_progress()
                if self._written > self._first and (now := time.monotonic()) - self._flushed > _FLUSH_S:
                    self._flushed = now
                    self._note_audit(now)
                    self._files.flush()
                    if (begun := time.monotonic()) >= self._defects_due:
                        self._newest_defects = largest_defects(self._files.defects, _SHOWN_DEFECTS)
                        self._defects_due = begun + max(_DEFECTS_S, 100.0 * (time.monotonic() - begun))
                    self._on_flush(self._files.kept)
                    self._router.is_unsteady()  # it notices only what it sees
                if (wishes := self._wishes()) is None:
                    continue
                message = self._inbox.wait(_REST_S if self._complete() >= self._written else _LONGEST_SLEEP_S, wishes)
            if message is not None:
                self._take(message)

    def _wishes(self) -> list[Wish] | None:
        """Wake up when many rows can be written, or all up to a pause or to the end; None: they are there."""
        wanted, complete = self._wanted(), self._complete()
        last_point = self._plan.grid.last_point
        if self._written > last_point:
            return []
        many = self._written + self._wake_rows if complete >= self._first else self._first
        due = min(many, max(self._written, wanted), last_point)
        if self._written <= complete and complete >= due and (self._written > self._first or wanted >= 0):
            return None
        slowest = min(self._sources.values(), key=lambda source: source.covered)
        rows = due // slowest.link.step_points + 1
        return [(counter, rows) for counter in slowest.counters]

    def note_last(self, source: str) -> None:
        """From any thread: all rows of an instance have come by its row stream."""
        self._inbox.post(lambda: self._ended.add(source))

    def _take(self, message: Message) -> None:
        self._inbox.hand_on(message, self._take_from_master, self._take_from_node)

    def _take_from_node(self, message: Message) -> None:
        sender, kind, number, count, point, data = message
        if kind == SET:
            self._files.note(to_builtins(decode_json(data[HEADER.size :], SetValue)))
            return
        if kind == NOTED:
            self._files.note_event(*astuple(decode_json(data[HEADER.size :], Noted)))
            return
        if kind == KEYS:
            self._files.keep(decode_json(data[HEADER.size :], list[KeyValue], _MOST_KEYS))
            return
        source = self._sources.get(number)
        if source is None or source.link.source_node != sender:
            raise MessageRefused(f"there is no link {number} from it to the recorder")
        if kind == FRAME and source.receiver is not None:
            if point <= source.receiver.received or not self._router.is_unsteady():  # else its source sends it again
                source.receiver.take(point, count, data)
        elif kind == LAST:
            self._ended.add(source.link.source)
        elif kind not in (INITIAL, REFUSED):  # the latter is for the master
            raise MessageRefused(f"a message of kind {kind} is not one that a node sends")

    def _take_from_master(self, message: Message) -> None:
        kind = message[1]
        if kind == FINISH:
            self._finish_at = message[4]
        elif kind not in (
            GRANT,
            ABORT,
            RESET,
            SAVE,
        ):  # why the run ends early comes from the master of this process: `__exit__`
            raise MessageRefused(f"a message of kind {kind} is not one that the master sends")

    def _complete(self) -> int:
        """The last point whose row is complete, or -1."""
        return min((source.covered for source in self._sources.values()), default=-1)

    def _write_rows(self) -> None:
        rows = self._complete() + 1
        if self._written == self._first and self._wanted() < 0:
            return
        while (first := self._written) < rows:
            end = min(rows, first - first % self._rows + self._rows, first + _WRITE_ROWS)  # read without wrap-around
            self._check(first, end)
            self._files.write(first, end)
            if self._played is not None:
                self._files.write_to(self._played.path, partial(self._played.write, first, end, self._rings))
            self._check(first, end)
            self._written = end

    def _check(self, first: int, end: int) -> None:
        """The rows from which points are written are complete, and nobody has overwritten them."""
        for source in self._sources.values():
            source.check(first, end)

    def _tell_progress(self) -> None:
        """Tell how many points are written; the first one before, because nothing is written until all are there."""
        known = max(self._written, min(self._complete(), self._first) + 1)
        if known > self._told:
            self._told = known
            if self._memory is not self._own_memory:
                self._memory.progress[RECORDER].raise_to(known)
            else:
                self._put_progress(HEADER.pack(PROGRESS, 0, 0, known - 1))

    def _take_last_rows(self, cause: BaseException) -> None:
        """When a run ends early, wait for the last frames; the rows that they complete are written at the end.

        Wait until every live node has reported that it has sent its last rows; lost nodes send nothing more.
        """
        if isinstance(cause, MeshLost):
            self._ended.update((cause.instance or "").split(", "))
        deadline = time.monotonic() + _LAST_S
        while True:
            message = self._inbox.poll()
            if message is None:
                left = deadline - time.monotonic()
                if left <= 0 or not self._rows_are_missing():
                    return
                message = self._inbox.wait(left)
            if message is not None and message[1] in (FRAME, LAST, *FOR_METADATA):
                self._take(message)

    def _rows_are_missing(self) -> bool:
        """Whether rows are still missing that would complete rows of the sources that have ended."""
        known = {source.link.source: source.covered for source in self._sources.values()}
        end = min((known[name] for name in known if name in self._ended), default=self._plan.grid.last_point)
        return any(point < end for name, point in known.items() if name not in self._ended)

    def _report(self, failure: FmuMeshError | None) -> None:
        """Report to the master how recording ended. A master that ends accepts no reports; it waits for this thread."""
        report = NodeReport(RECORDER, max(self._written - 1, 0), failure.report() if failure is not None else None)
        try:
            self._membership.report(report, self._plan.timeouts.stop, lambda: self._membership.given_up)
        except FmuMeshError as unreachable:
            log.info("end_not_reported", extra={"error": str(unreachable)})
