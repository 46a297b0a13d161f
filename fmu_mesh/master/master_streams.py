"""The row streams of the master's process: grants for other hosts, the progress of nodes there, and recorded rows."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable

from ..errors import FmuMeshError
from ..rings.host_memory import HostMemory
from ..rings.ring import Ring
from ..rings.row_streams import CounterEnd, RowsEnd, RowStreams, StreamEnd
from ..system.plan import MASTER, RECORDER, Link, NodePlan, Plan
from ..wire.frames import SourceRows, of_numbers
from ..wire.meeting import Meeting
from ..wire.messages import FINISH, GRANT, PROGRESS
from ..wire.stream_keeper import StreamKeeper
from ..wire.streamed_rows import incoming_rows, why_not
from ..wire.ways import Ways

__all__ = ["MasterStreams"]

# Threads: `streams` moves rows and counters, in C and without the interpreter's lock; it raises counters in the memory
# of this process, for which the master and the recorder sleep as for those of nodes on this host, and sends the
# counters that they raise. The main thread starts and ends it. The recorder asks for its mirrors on its own thread,
# after it was welcomed, and so after `start`.
#
# What may go wrong: a stream brings what is no part of the run. Then the thread says so, and the run fails. A stream
# that is cut is no failure here: whether the process is gone, its token says. ADR 74.

_TURN_S = 0.2


class MasterStreams:
    """The row streams of one run.

    Args:
        memory: that of the master, for this participant.
        meeting: that of the master.
        fail: gets the error if a stream cannot be used; from another thread.
    """

    def __init__(self, plan: Plan, memory: HostMemory, meeting: Meeting, fail: Callable[[FmuMeshError], None]) -> None:
        self._plan = plan
        self._memory = memory
        self._meeting = meeting
        self._fail = fail
        self._posted: deque[Callable[[], None]] = deque()
        self._keeper: StreamKeeper | None = None
        self._mirrors: dict[int, SourceRows] = {}
        self._streams: RowStreams | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="streams", daemon=True)
        self._last: list[Callable[[str], None]] = []

    def start(self, ways: Ways) -> None:
        """Begin to exchange rows and counters with the nodes that have a stream."""
        plan, memory = self._plan, self._memory
        recorder = plan.nodes.get(RECORDER)
        ends = []
        for node in ways.streams_of(MASTER):
            incoming = (
                [self._incoming(recorder, link) for link in recorder.links_in if link.source_node == node]
                if recorder
                else []
            )
            told = [CounterEnd(GRANT, 0, memory.sent, 0), CounterEnd(FINISH, 0, memory.finish)]
            if recorder is not None:
                number, stride = memory.map.number_of(RECORDER), recorder.progress_stride
                told.append(CounterEnd(PROGRESS, number, memory.progress[RECORDER], stride))
            heard = [CounterEnd(PROGRESS, memory.map.number_of(node), memory.progress[node])]
            rows = [own for own in incoming if own is not None]
            ends.append(StreamEnd(node, self._meeting.sockets[node], incoming=rows, told=told, heard=heard))
        if ends:
            self._streams = RowStreams(memory, ends, plan.grid.last_point)
            self._thread.start()
            self._keeper = StreamKeeper(self._streams, self._meeting, [end.peer for end in ends], self._post)

    def grant(self, point: int) -> None:
        """On the main thread: grant to the nodes that have a stream; without the other thread, which would be woken."""
        self._memory.sent.raise_to(point)
        if self._streams is not None:
            self._streams.tell()

    @property
    def round_trip_s(self) -> float:
        """From any thread: the longest round trip to a node, in s."""
        return self._keeper.round_trip_s if self._keeper is not None else 0.0

    def silent_s(self, node: str) -> float:
        """From any thread: for how long nothing has come from a node, in s; infinite without a row stream."""
        return self._streams.silent_s(node) if self._streams is not None else math.inf

    @property
    def cut(self) -> dict[str, float]:
        """From any thread: for how long the streams with these nodes are cut, in s."""
        return self._keeper.cut if self._keeper is not None else {}

    def check(self) -> bool:
        """From any thread: whether a stream is cut, so that nobody may be able to go on.

        Raises:
            MeshLost: one is cut for longer than a link may be silent.
        """
        if self._keeper is None:
            return False
        self._keeper.check(MASTER, self._plan.system.config.timeouts.link)
        return bool(self._keeper.cut)

    def _post(self, action: Callable[[], None]) -> None:
        self._posted.append(action)
        if self._streams is not None:
            self._streams.wake()

    def _incoming(self, recorder: NodePlan, link: Link) -> RowsEnd | None:
        numbers = of_numbers(link.layout)
        if not numbers.columns:
            return None
        place = next(place for place in recorder.rings if place.instance == link.source)
        mirror = SourceRows(Ring(numbers, place.rows), self._memory.counter(place.counter), text=False)
        self._mirrors[link.index] = mirror
        return incoming_rows(link, mirror, self._plan.grid.last_point)

    def tell_last(self, tell: Callable[[str], None]) -> None:
        """From now on, ``tell`` gets each instance of which no more rows come; on another thread."""
        self._last.append(tell)

    def mirror(self, link: Link) -> SourceRows | None:
        """Where the rows of a link for the recorder come to."""
        return self._mirrors.get(link.index)

    def close(self) -> None:
        """End all streams."""
        if self._streams is not None:
            if self._keeper is not None:
                self._keeper.close()
            self._closing = True
            self._streams.wake()
            self._thread.join()
            self._streams.close()
            self._streams = None

    def _run(self) -> None:
        assert self._streams is not None
        links = self._plan.nodes[RECORDER].links_in if RECORDER in self._plan.nodes else ()
        while not self._closing:
            self._streams.serve(_TURN_S)
            while self._posted:
                self._posted.popleft()()
            for peer, state, about, row in self._streams.states():
                if (error := why_not(peer, state, about, row, links)) is not None:
                    self._fail(error)
            for index in self._streams.ended_links():
                for tell in self._last:
                    tell(next(link.source for link in links if link.index == index))
