"""The row streams of a process: what `streams.c` sends and reads, as tables.

Owns the tables, the buffers and the pipe of the bell; who makes it gives the sockets, and closes it. It knows neither
FMI nor Zenoh, and not how two processes meet (`fmu_mesh.wire.meeting`).
"""

from __future__ import annotations

import ctypes
import math
import os
import select
import socket
import struct
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import chain
from typing import Final, NamedTuple, TypeVar

from ..system.layout import Layout
from . import native
from .host_memory import Counter, HostMemory
from .native import StreamState, table
from .ring import Ring

__all__ = ["CounterEnd", "RowStreams", "RowsEnd", "StreamEnd"]

# Threads: `streams.c` says who reads and who writes. Here, `serve`, `resume` and `close` belong to the thread that
# reads the streams; `beat`, `say_last`, `received` and `silent_s` may be called from any thread: each looks at numbers
# that are written once, or takes the flag `sending` in C.
#
# What may go wrong: a table that C uses is freed while a thread of C still sends. So `close` holds each stream before
# it lets its memory go: it shuts the socket down, and waits for the flag, which no thread keeps longer than one `poll`
# of 0.1 s. ADR 74 has the decision.

Rows = TypeVar("Rows", native.OutgoingTable, native.IncomingTable)

_BUFFER_BYTES: Final = 256 * 1024
"""What one call of the system sends or reads; a larger row has a larger buffer."""
_HEADER_BYTES: Final = 24
_UNSENT_BYTES: Final = 128 * 1024
"""What waits in the kernel for the network at most: a grant, or how far a node is, has to wait behind it."""
_LAZY_S: Final = 0.005
"""How long rows for the recorder, and the progress of a node for the master, may wait for more of their kind."""
_ROUND_TRIP: Final = struct.Struct("I")
_ROUND_TRIP_AT: Final = 148
"""Where `tcpi_min_rtt`, in microseconds, stands in the `tcp_info` of linux/tcp.h."""
_TURN_S: Final = 0.02
_LOOK_S: Final = 0.5


class RowsEnd(NamedTuple):
    """One end of a link: the ring where its rows are or come to, and the counter of complete rows.

    Attributes:
        layout: the columns that go over the wire, all of numbers.
        rows: how many there are in the whole run.
        lazy: whether nobody steps with them.
        first: the first one that is sent.
    """

    link: int
    ring: Ring
    counter: Counter
    layout: Layout
    rows: int
    lazy: bool = False
    first: int = 0

    @property
    def pieces(self) -> list[native.Piece]:
        """Where the elements of the layout lie in a row of the ring: neighbours are one piece."""
        found: list[tuple[int, int, bool]] = []
        numbers = {part.type: number for number, part in enumerate(self.ring.layout.parts)}
        for part in self.layout.parts:
            number = numbers[part.type]
            size = self.ring.parts[number].itemsize
            for column in part.columns:
                place = self.ring.layout.place(column.name)
                first = self.ring.place_in_row(number, place.first)
                if found and sum(found[-1][:2]) == first and found[-1][2] == (part.type == "Boolean"):
                    first, before, _ = found.pop()
                else:
                    before = 0
                found.append((first, before + place.size * size, part.type == "Boolean"))
        return [native.Piece(*piece) for piece in found]


class CounterEnd(NamedTuple):
    """A counter that one process tells another one: frames of a ``kind`` with the ``number`` of a participant.

    Attributes:
        stride: by how much it grows before it is sent; 0: it may wait for a while.
    """

    kind: int
    number: int
    counter: Counter
    stride: int = 1


class StreamEnd(NamedTuple):
    """What this process sends to another one, and gets from it."""

    peer: str
    socket: socket.socket
    outgoing: Sequence[RowsEnd] = ()
    incoming: Sequence[RowsEnd] = ()
    told: Sequence[CounterEnd] = ()
    heard: Sequence[CounterEnd] = ()


class RowStreams:
    """All streams of one participant.

    Args:
        memory: has its bell.
        last_point: no counter goes beyond the point after it.

    Attributes:
        address: of the table, for the burst.
    """

    def __init__(self, memory: HostMemory, ends: Sequence[StreamEnd], last_point: int) -> None:
        assert native.library is not None
        self._library = native.library
        self._number = {end.peer: number for number, end in enumerate(ends)}
        self._sockets = [end.socket for end in ends]
        self._kept: list[object] = [ends]
        self._bell, self._ring = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._tables = table(native.StreamTable, [self._table(end, last_point) for end in ends])
        room = ctypes.create_string_buffer(8 * (len(ends) + 1))
        wishes = table(native.Wish, [native.Wish() for end in ends for _ in end.told])
        self._streams = native.StreamsTable(
            place=memory.place,
            streams=self._tables,
            n_streams=len(ends),
            polled=ctypes.addressof(room),
            wishes=ctypes.addressof(wishes),
            bell_pipe=self._bell,
            lazy_ns=int(_LAZY_S * 1e9),
        )
        self._kept += [room, wishes, memory]
        self.address = ctypes.addressof(self._streams)
        self._library.streams_listen(self.address, os.getpid(), self._ring)
        for number, end in enumerate(ends):
            self._open(number, end.socket)

    def _open(self, number: int, own: socket.socket) -> None:
        own.settimeout(0.0)
        if own.family != socket.AF_UNIX:
            own.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, _UNSENT_BYTES)
        self._library.stream_open(self._at(number), own.fileno())

    def _at(self, number: int) -> int:
        return ctypes.addressof(self._tables[number])

    def _table(self, end: StreamEnd, last_point: int) -> native.StreamTable:
        outgoing = [self._rows(native.OutgoingTable, rows, lazy=rows.lazy, sent=rows.first) for rows in end.outgoing]
        incoming = [self._rows(native.IncomingTable, rows, most=rows.rows) for rows in end.incoming]
        most = max((rows.row_bytes for rows in chain(outgoing, incoming)), default=0)
        size = max(_BUFFER_BYTES, _HEADER_BYTES + most)
        buffers = [ctypes.create_string_buffer(size) for _ in range(2)]
        to_send, received = map(ctypes.addressof, buffers)
        made = native.StreamTable(
            state=StreamState.CUT, to_send=to_send, received=received, send_size=size, receive_size=size
        )
        made.give(
            outgoing=outgoing,
            incoming=incoming,
            told=[native.ToldTable(own.kind, own.number, own.counter.address, -1, own.stride) for own in end.told],
            heard=[native.HeardTable(own.kind, own.number, own.counter.address, last_point + 1) for own in end.heard],
        )
        self._kept += [made, buffers]
        return made

    def _rows(self, kind: type[Rows], end: RowsEnd, **more: int) -> Rows:
        ring, pieces = end.ring, end.pieces
        made = kind(
            link=end.link,
            counter=end.counter.address,
            rows=ring.address,
            stride=ring.stride,
            mask=ring.mask,
            row_bytes=sum(piece.size for piece in pieces),
            **more,
        )
        made.give(pieces=pieces)
        self._kept.append(made)
        return made

    # --- what happens

    def serve(self, limit_s: float) -> None:
        """Move rows and counters, for ``limit_s`` seconds or until a stream has news (`states`, `ended_links`)."""
        self._library.streams_serve(self.address, int(limit_s * 1e9))

    def tell(self) -> None:
        """From any thread: send at once all that is new."""
        self._library.streams_write(self.address, 1)

    def wake(self) -> None:
        """From any thread: let `serve` return."""
        self._streams.attend()
        self._library.ring_bell(self._streams.place.bells + 64 * self._streams.place.own)

    def beat(self) -> None:
        """From any thread: tell all others that this process lives, and all that is new."""
        for number in range(len(self._tables)):
            self._library.stream_beat(self._at(number))

    def say_last(self, link: int) -> None:
        """From any thread: no more rows of a link come; send those that are left."""
        for number, stream in enumerate(self._tables):
            for out in stream.outgoing[: stream.n_outgoing]:
                if out.link == link and out.end():
                    self._library.stream_beat(self._at(number))

    def states(self) -> Iterator[tuple[str, StreamState, int, int]]:
        """Peers whose stream cannot be used, each once: why, and which link or kind and which row it is about."""
        for peer, number in self._number.items():
            stream = self._tables[number]
            if (state := stream.take_state()) is not None:
                yield peer, state, stream.about, stream.about_row

    def ended_links(self) -> Iterator[int]:
        """Links of which no more rows come, each once."""
        for stream in self._tables:
            yield from stream.take_ended()

    # --- cuts

    def received(self, peer: str) -> dict[int, int]:
        """From any thread: how many rows of each link from a peer are here."""
        stream = self._tables[self._number[peer]]
        return {rows.link: rows.known for rows in stream.incoming[: stream.n_incoming]}

    def is_local(self, peer: str) -> bool:
        """From any thread: whether a peer is on this host, where no link is ever cut."""
        return self._sockets[self._number[peer]].family == socket.AF_UNIX

    def silent_s(self, peer: str) -> float:
        """From any thread: for how long nothing has come from a peer, in s; infinite if there is no stream any more.

        What has come and was not read yet, because a step is under way, counts as a sign of life.
        """
        number = self._number.get(peer)
        if number is None or self._tables[number].state != StreamState.OPEN:
            return math.inf
        stream, own = self._tables[number], self._sockets[number]
        silent_s = time.monotonic() - stream.heard_ns / 1e9
        return 0.0 if silent_s > _LOOK_S and select.select([own], [], [], 0.0)[0] else silent_s

    def round_trip_s(self, peer: str) -> float:
        """From any thread: the shortest round trip to a peer that its socket has measured, in s; 0 on one host."""
        if self.is_local(peer):
            return 0.0
        own = self._sockets[self._number[peer]]
        with suppress(OSError, struct.error):
            (found,) = _ROUND_TRIP.unpack_from(own.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256), _ROUND_TRIP_AT)
            return float(found) / 1e6
        return 0.0

    def resume(self, peer: str, own: socket.socket, received: Mapping[int, int]) -> None:
        """Go on with a new socket, after the rows that the peer has."""
        number = self._number[peer]
        self._library.stream_hold(self._at(number))
        self._sockets[number].close()
        self._sockets[number] = own
        stream = self._tables[number]
        for rows in stream.outgoing[: stream.n_outgoing]:
            rows.go_on(received.get(rows.link, 0))
        self._open(number, own)

    def close(self, patience_s: float = 1.0) -> None:
        """Send what is left, for so long at most, and end all streams."""
        deadline = time.monotonic() + patience_s
        for number, own in enumerate(self._sockets):
            self._finish(number, deadline)
            self._library.stream_hold(self._at(number))
            own.close()
        os.close(self._bell)
        os.close(self._ring)

    def _finish(self, number: int, deadline: float) -> None:
        """Send what is left, and read until the other process closes its end, too: then it has got everything."""
        stream, own = self._tables[number], self._sockets[number]
        self._library.stream_beat(self._at(number))
        while stream.state == StreamState.OPEN and (left := deadline - time.monotonic()) > 0:
            if stream.is_sent:
                with suppress(OSError):
                    own.shutdown(socket.SHUT_WR)
            with suppress(OSError):
                if select.select([own], [], [], min(left, _TURN_S))[0] and not own.recv(_BUFFER_BYTES):
                    return
