"""The connections of an instance, grouped by source and delay: what a node needs of them in a run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from typing import NamedTuple

import msgspec

from ..config.instance_sections import Extrapolation
from ..variables.value_types import is_float
from .connections import Connection
from .consistent_outputs import element_pairs
from .coupling_rule import Consistent, CouplingRule, Term

__all__ = [
    "Compared",
    "Feed",
    "FeedColumn",
    "compared_of",
    "consistent_columns",
    "feeds_of",
    "reads_of",
    "step_feeds_of",
]


class FeedColumn(NamedTuple):
    """One connection of a feed.

    Attributes:
        source: the output, or an element of it as `y[2]`; ``target`` likewise.
        map: see `Connection`; ``items`` likewise.
        adds: whether the value is added to what the target has from the columns before it; see `Consistent`.
    """

    source: str
    target: str
    factor: float = 1.0
    offset: float = 0.0
    map: tuple[tuple[int, int], ...] = ()
    items: tuple[tuple[str, int], ...] = ()
    adds: bool = False


class Compared(NamedTuple):
    """A connection, or that of one element, whose assumed values are compared with those that come (`--defects`).

    Attributes:
        name: `a.y -> b.u`.
        value: the input at a point, from the rows of that point.
    """

    name: str
    rule: CouplingRule
    way: Extrapolation
    value: Consistent


class Feed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All connections from one instance to another that have the same delay."""

    source: str
    delay: int
    columns: tuple[FeedColumn, ...]


def feeds_of(connections: Iterable[Connection]) -> tuple[Feed, ...]:
    """The feeds of connections to one instance, sorted by source and delay; all delays are known."""
    return _grouped((c.source_instance, c.delay or 0, _column(c)) for c in connections)


def step_feeds_of(
    connections: Iterable[Connection], consistent: Mapping[tuple[str, str], Consistent]
) -> tuple[Feed, ...]:
    """As `feeds_of`, for steps: a connection from a consistent output becomes one column for each of its terms."""
    return _grouped(chain.from_iterable(consistent_columns(c, consistent) for c in connections))


def reads_of(
    connections: Iterable[Connection], consistent: Mapping[tuple[str, str], Consistent]
) -> list[tuple[str, str, str]]:
    """What steps read: the source instance, the column, and the instance that reads it."""
    return [
        (source, column.source, c.target_instance)
        for c in connections
        if not c.initial_only
        for source, _, column in consistent_columns(c, consistent)
    ]


def consistent_columns(
    c: Connection, consistent: Mapping[tuple[str, str], Consistent]
) -> Iterator[tuple[str, int, FeedColumn]]:
    """The source, the delay and the column of each value that a step needs for a connection, in their order."""
    delay = c.delay or 0
    pairs = [*element_pairs(c)] if any(instance == c.source_instance for instance, _ in consistent) else []
    if not any((c.source_instance, source) in consistent for source, _ in pairs):
        yield c.source_instance, delay, _column(c)
        return
    for source, target in pairs:
        own = consistent.get((c.source_instance, source))
        if own is None:
            yield c.source_instance, delay, FeedColumn(source, target, c.factor, c.offset)
            continue
        scaled = own.scaled(c.factor, c.offset)
        for number, term in enumerate(scaled.terms):
            offset = scaled.constant if not number else 0.0
            yield term.instance, delay, FeedColumn(term.column, target, term.factor, offset, adds=number > 0)


def compared_of(
    connections: Iterable[Connection],
    consistent: Mapping[tuple[str, str], Consistent],
    step_points: Mapping[str, int],
) -> Iterator[Compared]:
    """What targets assume over their steps, as far as it can be compared: continuous inputs with continuous sources."""
    for c in connections:
        ends = c.source, c.target
        if c.initial_only or any(not is_float(end.type) or end.variability != "continuous" for end in ends):
            continue
        rule = CouplingRule(c.delay or 0, step_points[c.source_instance], step_points[c.target_instance])
        for source, target in element_pairs(c):
            key = c.source_instance, source
            value = consistent.get(key) or Consistent(0.0, (Term(*key, 1.0),))
            name = f"{c.source_instance}.{source} -> {c.target_instance}.{target}"
            yield Compared(name, rule, c.extrapolation or "hold", value.scaled(c.factor, c.offset))


def _column(c: Connection) -> FeedColumn:
    return FeedColumn(c.source_name, c.target_name, c.factor, c.offset, c.map, c.items)


def _grouped(columns: Iterable[tuple[str, int, FeedColumn]]) -> tuple[Feed, ...]:
    """The feeds of these columns. Terms are sorted by their instances, so they stay in their order."""
    feeds: dict[tuple[str, int], list[FeedColumn]] = {}
    for source, delay, column in columns:
        feeds.setdefault((source, delay), []).append(column)
    return tuple(Feed(source=s, delay=d, columns=tuple(own)) for (s, d), own in sorted(feeds.items()))
