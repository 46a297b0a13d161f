"""Where the inputs of a node come from: rings that others share, and mirrors of rings that frames fill."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

from ..rings.host_memory import Counter, HostMemory
from ..rings.ring import Ring
from ..rings.transfer import Transfer
from ..system.plan import Link, NodePlan
from ..wire.frames import FrameReceiver, of_text
from .stepping import Runner, Source

__all__ = ["SourceRows", "connect", "sources_of"]


class SourceRows(NamedTuple):
    """Rows of an instance.

    Attributes:
        text: True: only its text is taken from here, because the numbers are in another ring. False: only its numbers.
    """

    ring: Ring
    counter: Counter
    text: bool | None = None


def connect(
    plan: NodePlan,
    runners: Mapping[str, Runner],
    memory: HostMemory,
    own_memory: HostMemory,
    shares: Collection[str],
) -> dict[int, FrameReceiver | Link]:
    """Give all runners their sources.

    Args:
        plan: the plan of the node.
        runners: its instances by name.
        memory: the memory that is shared; ``own_memory`` if there is none.
        own_memory: the memory of this process, for mirrors.
        shares: the nodes that share ``memory``.

    Returns:
        What takes the frames of each link, by its number; the link itself if it brings initial values only.
    """
    rows: dict[str, list[SourceRows]] = {name: [SourceRows(own.outputs, own.counter)] for name, own in runners.items()}
    places = {place.instance: place for place in plan.rings}
    receivers: dict[int, FrameReceiver | Link] = {}
    for link in plan.links_in:
        receivers[link.index] = link
        if link.initial_only:
            continue
        place, found = places[link.source], rows.setdefault(link.source, [])
        is_shared = link.source_node in shares
        if is_shared:
            found.append(SourceRows(memory.ring(place), memory.counter(place.counter), text=False))
        layout = of_text(link.layout) if is_shared else link.layout
        if layout.columns:
            mirror, counter = own_memory.ring(place), own_memory.counter(place.counter)
            found.append(SourceRows(mirror, counter, text=True if is_shared else None))
            fits = partial(_fits, runners, link.source)
            who = f"node '{plan.node}'"
            receivers[link.index] = FrameReceiver(link, layout, who, mirror, counter, fits)
    points = {name: place.step_points for name, place in places.items()}
    for runner in runners.values():
        runner.connect(sources_of(runner, rows, points))
    return receivers


def sources_of(
    runner: Runner, rows: Mapping[str, Sequence[SourceRows]], step_points: Mapping[str, int]
) -> Iterator[Source]:
    """The sources of a runner, from the rows and the base points per own step of each instance."""
    for feed in runner.plan.feeds:
        for ring, counter, text in rows[feed.source]:
            transfer = Transfer(
                feed,
                ring,
                runner.inputs,
                target=runner.name,
                source_points=step_points[feed.source],
                target_points=runner.plan.step_points,
                text=text,
            )
            if transfer.columns:
                yield Source(feed.source, transfer, counter)


def _fits(runners: Mapping[str, Runner], source: str, end: int) -> bool:
    """Whether rows of a mirror before own step ``end`` overwrite no row that a step still needs."""
    return all(
        end - own.transfer.rule.row_for(runner.step) <= own.transfer.source.rows
        for runner in runners.values()
        for own in runner.sources
        if own.instance == source
    )
