"""What feeds the instances of a node: rows of other instances of the node, and frames of other nodes.

Makes the feeds once, from the plan; using them is `fmu_mesh.node.stepping`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

from ..rings.transfer import Transfer
from ..system.plan import NodePlan
from ..wire.frames import FrameReceiver
from .stepping import LocalFeed, RemoteFeed, Runner

__all__ = ["connect_feeds"]


def connect_feeds(plan: NodePlan, runners: Mapping[str, Runner]) -> dict[int, tuple[FrameReceiver, list[RemoteFeed]]]:
    """Give all runners their feeds; returns who receives the frames of each link, by its index, and what they feed."""
    remote: dict[int, tuple[FrameReceiver, list[RemoteFeed]]] = {}
    for link in plan.links_in:
        fed: list[RemoteFeed] = []
        fits = partial(_fit, fed)
        remote[link.index] = (FrameReceiver(link, f"node '{plan.node}'", plan.ring_rows, fits), fed)
    receivers = {
        receiver.link.source: (receiver, feeds) for receiver, feeds in remote.values() if not receiver.link.initial_only
    }
    for runner in runners.values():
        for feed in runner.plan.feeds:
            points = runner.plan.step_points
            if feed.source in runners:
                source = runners[feed.source]
                local = Transfer(
                    feed,
                    source.outputs.layout,
                    runner.inputs,
                    source_points=source.plan.step_points,
                    target_points=points,
                )
                runner.local_feeds.append(LocalFeed(source, local))
            else:
                receiver, feeds = receivers[feed.source]
                link = receiver.link
                transfer = Transfer(
                    feed, link.layout, runner.inputs, source_points=link.step_points, target_points=points
                )
                feeds.append(RemoteFeed(receiver, runner, transfer))
                runner.remote_feeds.append(feeds[-1])
    return remote


def _fit(feeds: Sequence[RemoteFeed], end: int) -> bool:
    """Whether the source's rows before own step ``end`` overwrite no input that was not used yet."""
    return all(feed.transfer.ready(end) - feed.target.step <= feed.target.inputs.rows for feed in feeds)
