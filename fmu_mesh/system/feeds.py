"""The connections of an instance, grouped by source and rule: what a node needs of them in a run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
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
    """All connections from one instance to another that follow the same rule."""

    source: str
    rule: CouplingRule
    columns: tuple[FeedColumn, ...]


RuleOf = Callable[[Connection], CouplingRule]


def feeds_of(connections: Iterable[Connection], rule_of: RuleOf) -> tuple[Feed, ...]:
    """The feeds of connections to one instance, sorted by source and rule; all delays are known."""
    return _grouped((c.source_instance, rule_of(c), _column(c)) for c in connections)


def step_feeds_of(
    connections: Iterable[Connection], consistent: Mapping[tuple[str, str], Consistent], rule_of: RuleOf
) -> tuple[Feed, ...]:
    """As `feeds_of`, for steps: a connection from a consistent output becomes one column for each of its terms."""
    return _grouped(
        (source, rule_of(c), column) for c in connections for source, column in consistent_columns(c, consistent)
    )


def reads_of(
    connections: Iterable[Connection], consistent: Mapping[tuple[str, str], Consistent]
) -> list[tuple[str, str, str]]:
    """What steps read: the source instance, the column, and the instance that reads it."""
    return [
        (source, column.source, c.target_instance)
        for c in connections
        if not c.initial_only
        for source, column in consistent_columns(c, consistent)
    ]


def consistent_columns(
    c: Connection, consistent: Mapping[tuple[str, str], Consistent]
) -> Iterator[tuple[str, FeedColumn]]:
    """The source and the column of each value that a step needs for a connection, in their order.

    All these sources have the same step size.
    """
    pairs = [*element_pairs(c)] if any(instance == c.source_instance for instance, _ in consistent) else []
    if not any((c.source_instance, source) in consistent for source, _ in pairs):
        yield c.source_instance, _column(c)
        return
    for source, target in pairs:
        own = consistent.get((c.source_instance, source))
        if own is None:
            yield c.source_instance, FeedColumn(source, target, c.factor, c.offset)
            continue
        scaled = own.scaled(c.factor, c.offset)
        for number, term in enumerate(scaled.terms):
            offset = scaled.constant if not number else 0.0
            yield term.instance, FeedColumn(term.column, target, term.factor, offset, adds=number > 0)


def compared_of(
    connections: Iterable[Connection],
    consistent: Mapping[tuple[str, str], Consistent],
    step_points: Mapping[str, int],
) -> Iterator[Compared]:
    """What targets assume over their steps, as far as it can be compared: continuous inputs with continuous sources.

    Where a source goes ahead, its target knows what will come, and assumes nothing.
    """
    for c in connections:
        ends = c.source, c.target
        if c.initial_only or c.ahead or any(not is_float(end.type) or end.variability != "continuous" for end in ends):
            continue
        rule = CouplingRule(c.delay or 0, step_points[c.source_instance], step_points[c.target_instance])
        for source, target in element_pairs(c):
            key = c.source_instance, source
            value = consistent.get(key) or Consistent(0.0, (Term(*key, 1.0),))
            name = f"{c.source_instance}.{source} -> {c.target_instance}.{target}"
            yield Compared(name, rule, c.extrapolation or "hold", value.scaled(c.factor, c.offset))


def _column(c: Connection) -> FeedColumn:
    return FeedColumn(c.source_name, c.target_name, c.factor, c.offset, c.map, c.items)


def _grouped(columns: Iterable[tuple[str, CouplingRule, FeedColumn]]) -> tuple[Feed, ...]:
    """The feeds of these columns. Terms are sorted by their instances, so they stay in their order."""
    feeds: dict[tuple[str, CouplingRule], list[FeedColumn]] = {}
    for source, rule, column in columns:
        feeds.setdefault((source, rule), []).append(column)
    ordered = sorted(feeds, key=lambda own: (own[0], own[1].delay, own[1].ahead))
    return tuple(Feed(source, rule, tuple(feeds[source, rule])) for source, rule in ordered)
