"""The connections of an instance, grouped by source and delay: what a node needs of them in a run."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import msgspec

from .connections import Connection

__all__ = ["Feed", "FeedColumn", "feeds_of"]


class FeedColumn(NamedTuple):
    """One connection of a feed.

    Attributes:
        source: the output, or an element of it as `y[2]`; ``target`` likewise.
        map: see `Connection`; ``items`` likewise.
    """

    source: str
    target: str
    factor: float = 1.0
    offset: float = 0.0
    map: tuple[tuple[int, int], ...] = ()
    items: tuple[tuple[str, int], ...] = ()


class Feed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All connections from one instance to another that have the same delay."""

    source: str
    delay: int
    columns: tuple[FeedColumn, ...]


def feeds_of(connections: Iterable[Connection]) -> tuple[Feed, ...]:
    """The feeds of connections to one instance, sorted by source and delay; all delays are known."""
    feeds: dict[tuple[str, int], list[FeedColumn]] = {}
    for c in connections:
        column = FeedColumn(c.source_name, c.target_name, c.factor, c.offset, c.map, c.items)
        feeds.setdefault((c.source_instance, c.delay or 0), []).append(column)
    return tuple(Feed(source=s, delay=d, columns=tuple(columns)) for (s, d), columns in sorted(feeds.items()))
