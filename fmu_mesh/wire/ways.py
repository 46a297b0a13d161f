"""The ways of rows between two processes of a run: the only place where it is decided how they go."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from ..system.memory_map import MASTER, RECORDER
from .views import Way

__all__ = ["Ways", "pair"]


def pair(one: str, other: str) -> tuple[str, str]:
    """Two participants in the order in which `Ways` has them."""
    return (one, other) if one < other else (other, one)


class Ways(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How rows, progress and grants go between the participants of a run.

    Attributes:
        shared: the nodes that use the memory of the master's host, and the recorder, if the master shares any.
        streams: the pairs of participants that have a row stream; the recorder has those of the master.
    """

    shared: tuple[str, ...] = ()
    streams: tuple[tuple[str, str], ...] = ()

    def way(self, one: str, other: str) -> Way:
        """How rows go between two participants."""
        if self._shares(one) and self._shares(other):
            return "ring"
        one, other = (MASTER if name == RECORDER else name for name in (one, other))
        return "stream" if pair(one, other) in self.streams else "zenoh"

    def streams_of(self, participant: str) -> list[str]:
        """With whom a participant has a row stream."""
        return [name for both in self.streams if participant in both for name in both if name != participant]

    def all_but_zenoh(self, links: Iterable[tuple[str, str]]) -> bool:
        """Whether no rows between these pairs go by Zenoh."""
        return all(self.way(*link) != "zenoh" for link in links)

    def _shares(self, name: str) -> bool:
        return name in self.shared or (name in (MASTER, RECORDER) and bool(self.shared))
