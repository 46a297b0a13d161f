"""Who joined, set, commanded or was refused: kept for queries, subscribers, the log, and the metadata of results.

What the rules of Zenoh drop is not seen here, nor anywhere else.
"""

# Threads: links and values come on threads of Zenoh, commands on the main thread of the master, and the recorder reads
# on its own. They meet at `_lock`, which is held for one entry only; nothing waits under it (ADR 81).

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Any, Final, Literal

import msgspec
import zenoh
from msgspec.structs import replace

from ..config.access_sections import is_socket
from ..errors import MessageRefused
from ..wire.keys import Keys, RunKeys
from ..wire.messages import HEADER, KEYS, REFUSED, SET, SetValue, decode_json
from ..wire.session import matches, undeclare_all
from ..wire.values import json_encoding
from ..wire.views import AuditEntry, AuditView, LogLine

__all__ = ["Audit"]

_MOST: Final = 1000
_LONGEST: Final = 300
"""Letters of a name, a key or a text that strangers choose."""

_What = Literal["joined", "set", "commanded", "refused"]


class Audit:
    """The audit of one mesh, over all its runs.

    Args:
        point: the communication point that all instances have reached.
        fed: the keys of other programs that feed inputs, by `instance.variable`.
        say: adds a line to the log of the mesh; from any thread.

    Attributes:
        changes: how often something was added.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        point: Callable[[], int],
        fed: Mapping[str, str],
        say: Callable[[LogLine], None],
    ) -> None:
        self.changes = 0
        self._session, self._point, self._fed, self._say = session, point, fed, say
        self._newest: dict[tuple[str, ...], AuditEntry] = {}
        self._command = "", "", ""
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
        """Add an entry of this moment, by default at the point of the mesh."""
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        self._add(AuditEntry(what, who, now, self._point() if point is None else point, key, text))

    def _add(self, new: AuditEntry, *, is_logged: bool = False) -> None:
        """One entry: values or refusals of one sender at one key, commands in a row, joins from one host."""
        new = replace(new, who=new.who[:_LONGEST], key=new.key[:_LONGEST], text=new.text[:_LONGEST])
        with self._lock:
            if new.what == "commanded" and (new.who, new.text) != self._command[:2]:
                self._command = new.who, new.text, str(self.changes)
            own = {"commanded": self._command, "joined": (new.who, new.text.rpartition(":")[0])}
            same = new.what, *own.get(new.what, (new.who, new.key))
            known = self._newest.get(same)
            self.changes += 1
            if known is not None:
                self._newest[same] = known.and_again(new)
                return
            self._newest[same] = new
            if len(self._newest) > _MOST:
                # Whoever comes or is refused again and again must not hide what was done.
                harmless = (key for key in self._newest if key[0] in {"refused", "joined"})
                del self._newest[next(harmless, next(iter(self._newest)))]
                self._left_out += 1
        if matches(self._publisher):
            self._publisher.put(msgspec.json.encode(new))
        if not is_logged:
            status = "warning" if new.what == "refused" else "ok"
            self._say(LogLine("mesh", status, "audit", str(new), new.point))

    def view(self) -> AuditView:
        """All that is known."""
        with self._lock:
            return AuditView(tuple(self._newest.values()), self._left_out)

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
            kind, content = HEADER.unpack_from(data)[0], data[HEADER.size :]
            if kind == SET:
                value = decode_json(content, SetValue)
                name = f"{value.instance}.{value.variable}"
                self.note("set", value.by or value.who, value.key, name, value.point)
            elif kind == REFUSED:
                self._add(decode_json(content, AuditEntry), is_logged=True)
            elif kind == KEYS:
                for name, point, *_ in decode_json(content, list[tuple[str, int, Any, Any]]):
                    self.note("set", "", self._fed.get(name, ""), name, point)
        except (MessageRefused, ValueError):  # the recorder refuses it, too, and counts it
            return

    def _link(self, event: zenoh.LinkEvent) -> None:
        link = event.link
        if event.kind == zenoh.SampleKind.PUT and not is_socket(str(link.dst)) and not is_socket(str(link.src)):
            self.note("joined", link.auth_identifier or "", text=str(link.dst))
