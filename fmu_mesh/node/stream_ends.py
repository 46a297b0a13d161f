"""The row streams of a node: what it sends to those that share no memory with it, and what it gets from them."""

from __future__ import annotations

import socket
from collections.abc import Iterable, Iterator, Mapping

from ..rings.host_memory import HostMemory
from ..rings.row_streams import CounterEnd, RowsEnd, RowStreams, StreamEnd
from ..system.plan import MASTER, RECORDER, NodePlan
from ..wire.frames import SourceRows, of_numbers
from ..wire.messages import FINISH, GRANT, PROGRESS
from ..wire.streamed_rows import incoming_rows
from ..wire.ways import Ways
from .stepping import Runner

__all__ = ["streams_of"]


def streams_of(  # noqa: PLR0913, PLR0917  what a node has, and how it is connected
    plan: NodePlan,
    ways: Ways,
    sockets: Mapping[str, socket.socket],
    runners: Mapping[str, Runner],
    mirrors: Mapping[int, SourceRows],
    memory: HostMemory,
    own_memory: HostMemory,
) -> RowStreams:
    """The row streams of a node, which has at least one. The ``mirrors`` get the rows of each link."""
    ends, number = [], memory.map.number_of
    for peer in ways.streams_of(plan.node):
        told, heard = [], []
        if peer in plan.step_sources or peer == MASTER:  # whose windows end at this node; grants reach far ahead
            stride = plan.progress_stride if peer != MASTER else 0
            told.append(CounterEnd(PROGRESS, number(plan.node), memory.progress[plan.node], stride))
        if peer in plan.step_targets:
            heard.append(CounterEnd(PROGRESS, number(peer), own_memory.progress[peer]))
        if peer == MASTER:
            heard += [CounterEnd(GRANT, 0, own_memory.grant), CounterEnd(FINISH, 0, own_memory.finish)]
            if RECORDER in own_memory.progress:
                heard.append(CounterEnd(PROGRESS, number(RECORDER), own_memory.progress[RECORDER]))
        incoming = [
            incoming_rows(link, mirrors[link.index], plan.grid.last_point)
            for link in plan.links_in
            if link.source_node == peer and link.index in mirrors
        ]
        targets = (peer, RECORDER) if peer == MASTER else (peer,)
        outgoing = [*_outgoing_rows(plan, runners, targets)]
        ends.append(StreamEnd(peer, sockets[peer], outgoing, incoming, told, heard))
    return RowStreams(memory, ends, plan.grid.last_point)


def _outgoing_rows(plan: NodePlan, runners: Mapping[str, Runner], targets: Iterable[str]) -> Iterator[RowsEnd]:
    """The rows of this node for these targets."""
    for link in plan.links_out:
        numbers = of_numbers(link.layout)
        if link.target_node in targets and not link.initial_only and numbers.columns:
            runner, rows = runners[link.source], plan.grid.last_point // link.step_points + 1
            lazy = link.target_node == RECORDER
            first = plan.grid.first_point // link.step_points
            yield RowsEnd(link.index, runner.outputs, runner.counter, numbers, rows, lazy, first)
