"""Where the inputs of a node come from: rings that others share, and mirrors of rings that frames fill."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial

from ..rings.host_memory import HostMemory
from ..rings.transfer import Transfer
from ..system.plan import Link, NodePlan
from ..wire.frames import FrameReceiver, SourceRows, rows_of
from .stepping import Runner, Source

__all__ = ["connect", "sources_of"]


def connect(
    plan: NodePlan,
    runners: Mapping[str, Runner],
    memory: HostMemory,
    own_memory: HostMemory,
    shares: Collection[str],
) -> dict[int, FrameReceiver | Link]:
    """Give all runners their sources: in ``memory`` for nodes that share it, and in mirrors for all others.

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
        shared = memory if link.source_node in shares else None
        fits = partial(_fits, runners, link.source)
        found, receiver = rows_of(link, places[link.source], shared, own_memory, fits)
        rows.setdefault(link.source, []).extend(found)
        if receiver is not None:
            receivers[link.index] = receiver
    points = {name: place.step_points for name, place in places.items()}
    for runner in runners.values():
        runner.sources.extend(sources_of(runner, rows, points))
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
