"""Where everything lies in the memory that the processes of a run share on one host.

The map is a pure function of the plan. It has a bell for each process, and counters: the grant of the master, the
progress of each node, and the rows of each instance; then the rings. `fmu_mesh.rings.host_memory` makes the memory.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain

import msgspec

from .layout import Layout, row_bytes

__all__ = ["MASTER", "RECORDER", "STREAMS", "MemoryMap", "RingPlace", "map_memory"]

RECORDER = "@record"
"""Name of the recorder in place of the name of a node. No instance can have it."""

MASTER = "@mesh"
"""Name of the master in place of the name of a node."""

STREAMS = "@streams"
"""Name of the thread that moves the row streams of the master's process, where it has a bell."""

_LINE = 64
"""Size of a cache line in bytes. Two processes that write do not share one."""

_TOKEN_LINES = 1


class RingPlace(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The output ring of one instance.

    Attributes:
        step_points: base points per own step.
        rows: number of rows, a power of two.
        counter: offset of the counter of complete rows, in bytes.
        text_counter: the same for rows whose text comes beside them, at another time.
        offset: offset of the first row, in bytes.
    """

    instance: str
    node: str
    step_points: int
    layout: Layout
    rows: int
    counter: int
    text_counter: int
    offset: int


class MemoryMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The offsets in bytes of what all processes use.

    Attributes:
        processes: names of the nodes, the recorder and the master; a process has the number of its place here.
        size: of the memory.
        bells: offset of the first bell; each takes 64 bytes.
        grant: the counter of granted points.
        sent: the counter of those points that were granted to processes of other hosts.
        finish: the counter of the points of the run, from its end on.
        progress: the counters of known points, in the order of ``processes``; the last two have none.
        rings: the counters of complete rows of all instances, and those of their text.
    """

    processes: tuple[str, ...]
    size: int
    bells: int
    grant: int
    sent: int
    finish: int
    progress: tuple[int, ...]
    rings: tuple[int, ...]

    def number_of(self, process: str) -> int:
        """The number of a process."""
        return self.processes.index(process)

    def progress_of(self, process: str) -> int:
        """The offset of its counter of known points."""
        return self.progress[self.number_of(process)]


def map_memory(
    processes: Sequence[str], rings: Mapping[str, tuple[str, int, Layout, int]]
) -> tuple[MemoryMap, dict[str, RingPlace]]:
    """The map, and the place of each ring by instance; the processes are all nodes. The master and `STREAMS` follow.

    A ring is given by its node, base points per own step, outputs and number of rows.
    """
    ends = _Places(_TOKEN_LINES * _LINE)
    everybody = (*processes, MASTER, STREAMS)
    counter = _LINE + 8 * len(everybody)
    bells = ends.take(_LINE * len(everybody))
    grant, sent, finish = (ends.take(counter) for _ in range(3))
    progress = tuple(ends.take(counter) for _ in processes)
    counters = {name: (ends.take(counter), ends.take(counter)) for name in rings}
    places = {
        name: RingPlace(name, node, points, layout, rows, *counters[name], ends.take(rows * row_bytes(layout)))
        for name, (node, points, layout, rows) in rings.items()
    }
    every = tuple(chain.from_iterable(counters.values()))
    return MemoryMap(everybody, ends.end, bells, grant, sent, finish, progress, every), places


class _Places:
    """Takes one piece after the other, each at the start of a cache line."""

    def __init__(self, start: int) -> None:
        self.end = start

    def take(self, size: int) -> int:
        first = self.end
        self.end += -(-size // _LINE) * _LINE
        return first
