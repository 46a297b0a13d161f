"""Keeps row streams alive: a stream that is cut is dialled again, and goes on where it was.

Says each other process twice a second that this one lives, so that a silent link is noticed soon.
"""

from __future__ import annotations

import math
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from ..awake import AwakeClock
from ..errors import MeshLost
from ..rings.row_streams import RowStreams
from ..system.memory_map import MASTER, RECORDER
from .meeting import Meeting

__all__ = ["StreamKeeper"]

# Who meets here: two processes whose link was cut; and a thread, `keeper`, which says that this process lives, and one
# for each silent peer, which dials, with the thread that reads the streams. A new socket, its own or one that came to
# the door, is posted to that one, because nobody else may change a stream. ADR 74.
#
# What may go wrong:
# * A link is cut for a moment. TCP would repeat what was lost after pauses that double: after a cut of 20 s only after
#   27 s. So a stream that is silent for `_SILENT_S` is dialled again, every `_AGAIN_S`, and the first connection that
#   comes about replaces it.
# * Both dial: the later name does it first, and who dials tells the other that it is busy (`Meeting`).
# * The peer has ended. Then nobody answers at its door, and this goes on until this process ends, too: whether the
#   other one is gone, its token says.
# * A long step: its keeper still says that it lives. A stop (SIGSTOP) on this host is no cut: a Unix socket ends with
#   its process, and is never mute. On another one it cannot be told from a cut, nor can a host that is suspended.

_BEAT_S = 0.5
_SILENT_S = 1.5
"""Three beats."""
_AGAIN_S = 0.25


class StreamKeeper:
    """Keeps the streams of one process.

    Args:
        post: lets the thread that reads the streams do something.

    Attributes:
        round_trip_s: the longest one to a peer, in s.
    """

    def __init__(
        self, streams: RowStreams, meeting: Meeting, peers: Sequence[str], post: Callable[[Callable[[], None]], None]
    ) -> None:
        self._streams = streams
        self._meeting = meeting
        self._peers = peers
        self._post = post
        self.round_trip_s = self._round_trip_s()
        self._cut_since: dict[str, float] = {}
        self._clock = AwakeClock()
        self._closing = threading.Event()
        self._dialing: dict[str, threading.Thread] = {}
        meeting.wait_for_returns(self)
        self._thread = threading.Thread(target=self._run, name="keeper", daemon=True)
        self._thread.start()

    @property
    def cut(self) -> dict[str, float]:
        """From any thread: for how long the streams with these peers are cut, in s."""
        now = self._clock()
        return {peer: now - since for peer, since in [*self._cut_since.items()]}

    def cut_in_words(self, own: str, limit_s: float = 0.0) -> list[str]:
        """From any thread: the streams that are cut for longer, with both ends."""
        return [
            f"the link between {_spoken(own)} and {_spoken(peer)} is cut for {cut_s:.0f} s"
            for peer, cut_s in self.cut.items()
            if cut_s > limit_s
        ]

    def check(self, own: str, limit_s: float) -> None:
        """Check that no stream is cut for longer.

        Raises:
            MeshLost: one is; names both ends.
        """
        if words := self.cut_in_words(own, limit_s):
            hint = "Is the process stopped, its host suspended, or the network cut? `timeouts.link` limits it."
            raise MeshLost(words[0], hint=hint)

    def close(self) -> None:
        """End."""
        self._closing.set()
        self._thread.join()
        for dialing in self._dialing.values():
            dialing.join()

    def _run(self) -> None:
        beaten = 0.0
        while not self._closing.wait(_AGAIN_S):
            now = self._clock()
            if now - beaten >= _BEAT_S:
                beaten = now
                self._streams.beat()
                self.round_trip_s = self._round_trip_s()
            for peer in self._peers:
                silent_s = self._streams.silent_s(peer)
                if silent_s == math.inf or (silent_s > _SILENT_S and not self._streams.is_local(peer)):
                    self._cut_since.setdefault(peer, now - (silent_s if silent_s < math.inf else 0.0))
                    self._dial(peer)
                else:
                    self._cut_since.pop(peer, None)

    def _dial(self, peer: str) -> None:
        """Dial, unless this is under way; in a thread, because a peer that cannot be reached takes a second."""
        dialing = self._dialing.get(peer)
        if dialing is None or not dialing.is_alive():
            dial = partial(self._meeting.dial, peer, again=True)
            self._dialing[peer] = threading.Thread(target=dial, name=f"dial {peer}", daemon=True)
            self._dialing[peer].start()

    def _round_trip_s(self) -> float:
        return max(map(self._streams.round_trip_s, self._peers), default=0.0)

    def received(self, peer: str) -> dict[int, int]:
        """See `fmu_mesh.wire.meeting.Returns`."""
        return self._streams.received(peer)

    def take(self, peer: str, own: socket.socket, received: Mapping[int, int]) -> None:
        """See `fmu_mesh.wire.meeting.Returns`."""
        self._post(lambda: self._streams.resume(peer, own, received))


def _spoken(name: str) -> str:
    return {MASTER: "the master", RECORDER: "the recorder"}.get(name, f"node '{name}'")
