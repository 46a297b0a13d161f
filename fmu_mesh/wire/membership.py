"""How a node or the recorder joins a mesh, and by which way its messages reach each of the others.

Joining proves that all links work: a source that says hello has the subscription of who asked, and the master answers a
registration when all are there. On the way everybody learns who can be reached through shared memory.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from contextlib import ExitStack

import msgspec
import zenoh

from ..errors import FmuMeshError
from ..model.plan import NodePlan
from ..model.window import FRAME_OVERHEAD
from .inbox import Inbox
from .keys import Keys
from .messages import decode_json
from .session import ask
from .shared_memory import Offer, SharedInbox, SharedOutlet, available

__all__ = ["MASTER", "Membership", "Registration", "Welcome", "shared_inbox"]

MASTER = "@mesh"
"""Name of the master where node names stand."""

_SHARED = b"shared"


class Hello(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a node tells its sources: who it is, and where its shared memory is."""

    node: str
    offer: Offer | None = None


def shared_inbox(plan: NodePlan, *, spins: bool) -> SharedInbox | None:
    """Shared memory with room for what each sender of this node has credit for; None where nothing can be shared."""
    if not plan.shared_memory or not available():
        return None
    senders = {MASTER: 0}
    for link in plan.links_in:
        own = plan.ring_rows * (link.layout.row_size + FRAME_OVERHEAD)
        senders[link.source_node] = senders.get(link.source_node, 0) + own
    return SharedInbox(senders, spins=spins)


class Registration(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a node says about itself when it is ready for Initialization Mode.

    Attributes:
        offer: its shared memory.
        shared: whether all its sources can reach that.
    """

    node: str
    digest: str
    pid: int
    host: str
    offer: Offer | None = None
    shared: bool = False


class Welcome(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The master's answer to a registration, when all nodes are there.

    Attributes:
        number: what the node writes into its progress.
        profile: how many bursts and waits it shall note for a profile; 0: nothing is measured.
        shared: who gets all messages through shared memory: names of nodes, `@mesh` for the master.
        offer: the shared memory of the master, if it is among them.
    """

    number: int
    profile: int = 0
    shared: tuple[str, ...] = ()
    offer: Offer | None = None


class Membership:
    """One participant's part in the mesh.

    Args:
        plan: what the participant has to do.
        session: the session of this process; stays the caller's.
        inbox: its inbox, made with `shared_inbox`.

    Attributes:
        given_up: whether `give_up` was called.

    Call sequence: `join` once, then `sender` for everything that is sent to, and `close` at the end.
    """

    def __init__(self, plan: NodePlan, session: zenoh.Session, keys: Keys, inbox: Inbox) -> None:
        self._plan = plan
        self._session = session
        self._keys = keys
        self._inbox = inbox
        self._outlets: dict[str, SharedOutlet] = {}
        self._shared: frozenset[str] = frozenset()
        self._stack = ExitStack()
        self.given_up = False

    def give_up(self) -> None:
        """From any thread: let `join` end with an error, because there is nothing to join any more."""
        self.given_up = True

    def answer_hello(self, query: zenoh.Query) -> None:
        """On a foreign thread: a target asks; tell it whether its shared memory can be reached from here."""
        hello = decode_json(query.payload.to_bytes() if query.payload else b"", Hello)
        outlet = self._outlet(hello.offer, hello.node, f"node '{hello.node}'")
        query.reply(query.key_expr, _SHARED if outlet is not None else b"")
        query.drop()

    def join(self) -> Welcome:
        """Wait until the links with all other nodes work in both directions, then register with the master.

        Raises:
            DeadlineExceeded: somebody was not there in time.
            MeshLost: the master refused this node, the message says why; or this node has given up.
        """
        plan, inbox = self._plan, self._inbox
        deadline_s = plan.timeouts.start
        hello = msgspec.json.encode(Hello(plan.node, inbox.offer))
        shared = inbox.offer is not None
        for node in dict.fromkeys(link.source_node for link in plan.links_in):
            key, who = self._keys.hello(node), f"node '{node}'"
            answer = ask(self._session, key, hello, deadline_s, who, over=lambda: self.given_up)
            shared = shared and answer == _SHARED
        registration = Registration(
            plan.node, plan.digest, os.getpid(), socket.gethostname(), offer=inbox.offer, shared=shared
        )
        payload = msgspec.json.encode(registration)
        answer = ask(
            self._session,
            self._keys.register,
            payload,
            deadline_s,
            "the master",
            2 * deadline_s,
            over=lambda: self.given_up,
        )
        welcome = decode_json(answer, Welcome)
        self._shared = frozenset(welcome.shared)
        if welcome.offer is not None and self._outlet(welcome.offer, MASTER, "the master") is None:
            raise FmuMeshError(
                "the shared memory of the master cannot be reached, though the master reaches ours",
                hint="Set `zenoh: {shared_memory: false}`.",
            )
        if plan.node in self._shared:
            inbox.share()
        return welcome

    def sender(self, target: str, key: str) -> Callable[[bytes], None]:
        """What sends a message to a target: through shared memory, or as a publication on ``key``."""
        if target in self._shared:
            return self._outlets[target].put
        publisher = self._session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK, express=True)
        self._stack.callback(publisher.undeclare)
        return publisher.put

    def close(self) -> None:
        """Undeclare what `sender` declared."""
        self._stack.close()

    def _outlet(self, offer: Offer | None, target: str, spoken: str) -> SharedOutlet | None:
        outlet = SharedOutlet.open(offer, self._plan.node, spoken, self._inbox.stash, self._plan.timeouts.step)
        if outlet is not None:
            self._outlets[target] = outlet
        return outlet
