"""Who joined, set, commanded or was refused: kept for queries, for subscribers, and for the metadata of results.

What the rules of Zenoh drop is not seen here, nor anywhere else.
"""

# Threads: links and values come on threads of Zenoh, commands on the main thread of the master, and the recorder reads
# on its own. They meet at `_lock`, which is held for one entry only; nothing waits under it (ADR 81).

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Final, Literal

import msgspec
import zenoh
from msgspec.structs import replace

from ..config.access_sections import is_socket
from ..errors import MessageRefused
from ..wire.keys import Keys, RunKeys
from ..wire.messages import HEADER, SET, SetValue, decode_json
from ..wire.session import matches, undeclare_all
from ..wire.values import json_encoding
from ..wire.views import AuditEntry

__all__ = ["Audit"]

_MOST: Final = 1000
_LONGEST: Final = 300
"""Letters of a name, a key or a text that strangers choose."""

_What = Literal["joined", "set", "commanded", "refused"]


class Audit:
    """The audit of one mesh, over all its runs.

    Args:
        point: the communication point that all instances have reached.

    Attributes:
        changes: how often something was added.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, point: Callable[[], int]) -> None:
        self.changes = 0
        self._session, self._point = session, point
        self._newest: dict[tuple[str, ...], AuditEntry] = {}
        self._left_out = 0
        self._lock = threading.Lock()
        drop = zenoh.CongestionControl.DROP
        key = keys.mesh_key("audit")
        self._publisher = session.declare_publisher(key, encoding=json_encoding, congestion_control=drop)
        self._links = session.info.declare_link_events_listener(self._link, history=True)
        self._of_run: deque[zenoh.Subscriber[None]] = deque()

    def follow(self, keys: RunKeys) -> None:
        """From now on take the values that are set in this run, and no longer those of the one before."""
        self._forget_run()
        self._of_run.append(self._session.declare_subscriber(keys.settings("*"), self._value))

    def note(self, what: _What, who: str, key: str = "", text: str = "", point: int | None = None) -> None:
        """Add an entry; values, or refusals, of one sender at one key are one entry."""
        at, now = self._point() if point is None else point, datetime.now(UTC).isoformat(timespec="milliseconds")
        who, key, text = who[:_LONGEST], key[:_LONGEST], text[:_LONGEST]
        same = (what, who, key) if what in {"set", "refused"} else (what, who, key, str(self.changes))
        with self._lock:
            self.changes += 1
            known = self._newest.get(same)
            if known is not None:
                self._newest[same] = replace(known, number=known.number + 1, last_time=now, last_point=at)
                return
            entry = self._newest[same] = AuditEntry(what, who, now, at, key, text)
            if len(self._newest) > _MOST:
                del self._newest[next(iter(self._newest))]
                self._left_out += 1
        if matches(self._publisher):
            self._publisher.put(msgspec.json.encode(entry))

    def view(self) -> dict[str, object]:
        """All that is known: the ``entries`` in their order, and how many of them, the oldest, are ``left_out``."""
        with self._lock:
            return {"left_out": self._left_out, "entries": [*self._newest.values()]}

    def close(self) -> None:
        """Undeclare everything."""
        self._forget_run()
        undeclare_all([self._links, self._publisher])

    def _forget_run(self) -> None:
        undeclare_all(self._of_run)
        self._of_run.clear()

    def _value(self, sample: zenoh.Sample) -> None:
        data = sample.payload.to_bytes()
        if len(data) < HEADER.size or "*" in str(sample.key_expr):  # no node sends it
            return
        try:
            if HEADER.unpack_from(data)[0] != SET:
                return
            value = decode_json(data[HEADER.size :], SetValue)
        except (MessageRefused, ValueError):  # the recorder refuses it, too, and counts it
            return
        self.note("set", value.by or value.who, value.key, f"{value.instance}.{value.variable}", value.point)

    def _link(self, event: zenoh.LinkEvent) -> None:
        link = event.link
        if event.kind == zenoh.SampleKind.PUT and not is_socket(str(link.dst)) and not is_socket(str(link.src)):
            self.note("joined", link.auth_identifier or "", text=str(link.dst))
