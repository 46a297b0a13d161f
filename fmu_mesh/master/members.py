"""How the nodes of a mesh are reached by its master: their queries, their tokens, and messages to them.

Owns the master's part of `fmu_mesh.wire.membership`. `fmu_mesh.master.registrations` decides who belongs to the run.
All of it runs on the main thread: what arrives on threads of Zenoh is posted to the inbox (ADR 0008).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

import msgspec
import zenoh

from ..errors import FmuMeshError
from ..rings.host_memory import Offer
from ..system.attempt import Attempt
from ..system.placement import manual_hosts
from ..system.plan import RECORDER
from ..wire.host_processes import is_alive, is_stopped
from ..wire.inbox import Inbox
from ..wire.keys import RunKeys
from ..wire.meeting import Meeting
from ..wire.membership import Admission, NodeReady, Registration, Welcome
from ..wire.messages import ABORT, HEADER, RESET, NewStart, decode_json, encode_json
from ..wire.refusals import payload_of
from ..wire.router_link import RouterLink
from ..wire.session import undeclare_all
from ..wire.ways import Ways
from .registrations import Registrations

__all__ = ["Followers", "Members"]

log = logging.getLogger(__name__)

_AGAIN_S = 0.25
"""How often in s the question about a token that went is asked again."""


class Members:
    """The processes of the nodes of one run.

    Call sequence: `register`, `ready` and `token_changed` for messages that arrive; `welcome` when all are ready; then
    `send`, and `lost` now and then. `abort` and `begin_again` may be called at any time, `close` at the
    end.
    """

    def __init__(  # noqa: PLR0913, PLR0917  one run and how it is reached
        self,
        nodes: Registrations,
        session: zenoh.Session,
        keys: RunKeys,
        offer: Offer | None,
        launch: str | None,
        attempt: Attempt,
        meeting: Meeting | None = None,
        table: int = 0,
    ) -> None:
        self._nodes = nodes
        self._session = session
        self._keys = keys
        self._offer = offer
        self._launch, self._table, self._attempt = launch, table, attempt
        self._by_hand = {node for own in manual_hosts(nodes.plan).values() for node in own}
        self._meeting = meeting
        self._waiting: dict[str, zenoh.Query] = {}
        self._shared: tuple[str, ...] = ()
        self._doubted: dict[str, float] = {}
        self._present: set[str] = set()
        self._grant_keys = keys.grants([*nodes.plan.nodes])
        self._grants = [
            session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK, express=True)
            for key in dict.fromkeys(self._grant_keys.values())
        ]

    def register(self, query: zenoh.Query) -> None:
        """Answer a process that wants to be a node of this run."""
        registration = decode_json(payload_of(query), Registration)
        if registration.launch == self._launch or (registration.launch is None and registration.node in self._by_hand):
            reason = self._nodes.register(registration)
            if reason is None:
                door = None
                if self._meeting is not None and registration.door is not None:
                    self._meeting.knows(registration.node, registration.door)
                    door = self._meeting.door_for(registration.node)
                grants = self._grant_keys[registration.node]
                admission = Admission(self._keys.run, grants, self._offer, door, self._table, self._attempt)
                query.reply(query.key_expr, msgspec.json.encode(admission))
            else:
                log.info("node_refused", extra={"reason": reason})
                query.reply_err(reason)
        # A process of another launch gets no answer here: its own master answers it.
        query.drop()

    def ready(self, query: zenoh.Query) -> None:
        """Store that a node is ready; `welcome` answers it."""
        node = RunKeys.node_in(str(query.key_expr))
        self._nodes.take_ready(node, decode_json(payload_of(query), NodeReady))
        self._waiting[node] = query

    def welcome(self, profile_entries: int, ways: Ways) -> None:
        """Answer all nodes, as `Welcome` says."""
        self._shared = ways.shared
        for query in self._waiting.values():
            query.reply(query.key_expr, msgspec.json.encode(Welcome(profile_entries, ways)))
            query.drop()
        self._waiting.clear()

    def token_changed(self, sample: zenoh.Sample) -> None:
        """A liveliness token appeared or seems to be gone. A lost token is a question; `lost` finds the answer."""
        node = RunKeys.node_in(str(sample.key_expr))
        if sample.kind == zenoh.SampleKind.PUT:
            self._present.add(node)
            return
        self._present.discard(node)
        if node in self._nodes.admitted:
            self._doubted[node] = 0.0

    @property
    def have_left(self) -> bool:
        """Whether no node of a model has a token any more."""
        return self._present <= {RECORDER}

    @property
    def some_are_far(self) -> bool:
        """Whether a node of another host has a token: a message may be on its way to it for long, and need this end."""
        return not self._present <= {RECORDER, *self._shared}

    def lost(self, router: RouterLink, link_s: float, silent_s: Callable[[str], float]) -> list[str]:
        """The nodes whose processes are gone.

        On this host the process itself shows it, elsewhere what `RouterLink.has_gone` says.
        """
        found, now = [], time.monotonic()
        for node in [node for node, at in self._doubted.items() if at <= now]:
            match self._is_lost(node, router, link_s, silent_s):
                case None:
                    self._doubted[node] = now + _AGAIN_S
                case gone:
                    del self._doubted[node]
                    if gone:
                        found.append(node)
        return found

    def _is_lost(self, node: str, router: RouterLink, link_s: float, silent_s: Callable[[str], float]) -> bool | None:
        """Whether a node whose token went is gone; None: that is not known yet."""
        if node in self._shared:
            gone = not is_alive(self._nodes.admitted[node].pid)
            return gone or (router.is_lost and not router.may_come_back(link_s)) or None
        return router.has_gone(self._keys.node(node), silent_s(node), link_s)

    def stopped(self) -> list[str]:
        """The nodes on this host whose processes are stopped."""
        return [node for node in self._shared if is_stopped(self._nodes.admitted[node].pid)]

    def send(self, kind: int, point: int) -> None:
        """Send a message to all nodes."""
        message = HEADER.pack(kind, 0, 0, point)
        for publisher in self._grants:
            publisher.put(message)

    def abort(self, error: FmuMeshError) -> None:
        """Tell the nodes why the run ends, and wait so that they can end themselves."""
        for publisher in self._grants:
            publisher.put(encode_json(ABORT, error.report()))
        for query in self._waiting.values():
            query.reply_err(str(error))
            query.drop()

    def begin_again(self, start: NewStart) -> None:
        """Tell the nodes that the run ends, and that they register again for the next one."""
        for publisher in self._grants:
            publisher.put(encode_json(RESET, start))

    def close(self) -> None:
        """Undeclare all publishers."""
        undeclare_all(self._grants)


class Followers:
    """The followers of one run: readers that must get the last sample.

    The master waits for them at the end, because it routes samples. A follower has a liveliness token
    until it has all samples; Zenoh itself does not report this.
    """

    def __init__(self, inbox: Inbox, is_going_on: Callable[[], bool]) -> None:
        self._inbox = inbox
        self._is_going_on = is_going_on
        self._there: set[str] = set()
        self._lost: set[str] = set()

    def changed(self, sample: zenoh.Sample) -> None:
        """Handle a token of a follower that appeared or is gone."""
        name = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.PUT:
            self._there.add(name)
            self._lost.discard(name)
        else:
            self._there.discard(name)
            if self._is_going_on():
                self._lost.add(name)

    def wait(self, timeout_s: float) -> None:
        """Wait until all followers have their last sample, for at most ``timeout_s`` seconds."""
        if self._lost:
            log.warning("a gateway was lost before the last point; ROS did not get the samples after it")
        if not self._inbox.wait_until(lambda: not self._there, timeout_s):
            log.warning("a gateway did not receive its last samples within %g s", timeout_s)
