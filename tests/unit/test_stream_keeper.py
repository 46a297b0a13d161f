"""What the keeper of row streams does while some of them are cut; cuts of real links are in `tests/faults`."""

from __future__ import annotations

import math
import threading
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import pytest

from fmu_mesh.errors import MeshLost
from fmu_mesh.system.memory_map import MASTER
from fmu_mesh.wire.stream_keeper import StreamKeeper

if TYPE_CHECKING:
    from fmu_mesh.rings.row_streams import RowStreams
    from fmu_mesh.wire.meeting import Meeting

LIMIT_S = 10.0


class Dialled:
    """A meeting at which each dial waits until all peers are dialled, and then until it may end."""

    def __init__(self, peers: int) -> None:
        self.together = threading.Barrier(peers + 1)
        self.may_end = threading.Event()
        self.dials: list[str] = []

    def wait_for_returns(self, _returns: object) -> None:
        pass

    def dial(self, peer: str, *, again: bool) -> bool:
        assert again
        self.dials.append(peer)
        self.together.wait(LIMIT_S)
        return self.may_end.wait(LIMIT_S)


def kept(meeting: Dialled, silent: set[str], peers: list[str]) -> StreamKeeper:
    streams = SimpleNamespace(
        silent_s=lambda peer: math.inf if peer in silent else 0.0, beat=lambda: None, round_trip_s=lambda _peer: 0.0
    )
    return StreamKeeper(cast("RowStreams", streams), cast("Meeting", meeting), peers, lambda _action: None)


def test_cut_peers_are_dialled_at_the_same_time_and_once_each() -> None:
    meeting = Dialled(peers=2)
    keeper = kept(meeting, {"b", "c"}, ["b", "c", "d"])

    meeting.together.wait(LIMIT_S)  # raises if one is not dialled before the other one ends

    assert sorted(meeting.dials) == ["b", "c"]
    assert {*keeper.cut} == {"b", "c"}
    meeting.may_end.set()
    keeper.close()


def test_words_for_a_cut_name_both_ends_and_the_limit_is_kept() -> None:
    meeting = Dialled(peers=1)
    keeper = kept(meeting, {MASTER}, [MASTER, "b"])
    meeting.together.wait(LIMIT_S)

    assert keeper.cut_in_words("a") == ["the link between node 'a' and the master is cut for 0 s"]
    keeper.check("a", LIMIT_S)
    with pytest.raises(MeshLost, match="node 'a' and the master"):
        keeper.check("a", 0.0)

    meeting.may_end.set()
    keeper.close()
