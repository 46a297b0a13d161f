"""What the round trip of a network costs a run whose nodes are on several hosts: lower limits, in words."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence

from .connections import Connection
from .plan import Plan

__all__ = ["round_trip_cost"]


def round_trip_cost(plan: Plan, round_trip_s: float) -> list[str]:
    """Sentences that say how long a run takes at least if the network between its hosts has this round trip, in s.

    A cycle that is on one host costs nothing. For a plan without hosts, whose nodes can be started anywhere, the
    sentence for a cycle has an "if".
    """
    places: dict[str, str | None] = {name: own.node for name, own in plan.system.instances.items()}
    if len({*places.values()}) < 2:
        return ["one process: nothing goes between hosts"]
    doubt = "if it is on several hosts, "
    if plan.hosts:
        places, doubt = {name: plan.nodes[own.node].host for name, own in plan.system.instances.items()}, ""
    if plan.window == 1:
        return [f"window 1: between hosts {_cost(plan, round_trip_s)}"]
    turns = [(cycle, _points_per_turn(plan, cycle, places)) for cycle in plan.cycles]
    return [
        f"window {plan.window}: between hosts at most {plan.window / round_trip_s:.0f} points/s",
        *(
            f"cycle {', '.join(cycle)}: {doubt}{_cost(plan, round_trip_s / points)}"
            for cycle, points in turns
            if points is not None
        ),
    ]


def _cost(plan: Plan, point_s: float) -> str:
    grid = plan.grid
    each = f"at least {point_s:.3g} s per point"
    return (
        f"{each}, {grid.last_point * point_s:.4g} s for {grid.last_point} points"
        if grid.stop_time is not None
        else each
    )


def _points_per_turn(plan: Plan, cycle: Sequence[str], places: Mapping[str, str | None]) -> int | None:
    """How many points the slowest way around a cycle advances; None if the cycle is in one place."""
    following: dict[str, list[tuple[str, int]]] = {name: [] for name in cycle}
    for one in plan.connections:
        if one.source_instance in following and one.target_instance in following and not one.initial_only:
            following[one.source_instance].append((one.target_instance, _points(plan, one)))
    turns = [
        points + back[source]
        for source, links in following.items()
        for target, points in links
        if places[source] != places[target] and source in (back := _reached(following, target))
    ]
    return max(1, min(turns)) if turns else None  # a loop that is iterated has a turn without a delay


def _points(plan: Plan, one: Connection) -> int:
    instances = plan.system.instances
    return (one.delay or 0) * max(
        instances[one.source_instance].step_points, instances[one.target_instance].step_points
    )


def _reached(following: Mapping[str, Sequence[tuple[str, int]]], start: str) -> dict[str, int]:
    """Each instance that can be reached, with the fewest points of delay on the way."""
    fewest = {start: 0}
    waiting = deque([start])
    while waiting:
        source = waiting.popleft()
        for target, points in following[source]:
            if fewest[source] + points < fewest.get(target, math.inf):
                fewest[target] = fewest[source] + points
                waiting.append(target)
    return fewest
