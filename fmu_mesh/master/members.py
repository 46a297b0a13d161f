"""The members of a mesh, as its master sees them: who is there, who has registered, and how each node is reached.

Owns the master's end of `fmu_mesh.wire.membership`. Knows nothing of points and progress; called on the main thread.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import zenoh

from ..errors import DeadlineExceeded, FmuMeshError
from ..model.plan import RECORDER, Plan
from ..wire.inbox import Inbox
from ..wire.keys import Keys, batched
from ..wire.membership import MASTER, Registration, Welcome
from ..wire.messages import GRANT, HEADER, encode_abort
from ..wire.session import undeclare_all
from ..wire.shared_memory import SharedOutlet

__all__ = ["Members", "spoken"]


class Members:
    """The nodes of one run.

    Args:
        plan: the plan of the whole mesh.
        session: the session of this process; stays the caller's.
        inbox: the inbox of the master.
        on_lost: called with the name of a node whose process is gone.

    Attributes:
        shared: who gets all messages through shared memory: names of nodes, `@mesh` for the master.

    Call sequence: `register` and `token_changed` with what arrives; `welcome` once all are `complete`; from then on
    `send`. `abort` may come at any time, `close` at the end.
    """

    def __init__(
        self, plan: Plan, session: zenoh.Session, keys: Keys, inbox: Inbox, on_lost: Callable[[str], None]
    ) -> None:
        self._plan = plan
        self._timeouts = plan.system.config.timeouts
        self._nodes = list(plan.nodes)
        self._inbox = inbox
        self._on_lost = on_lost
        self._registered: dict[str, tuple[Registration, zenoh.Query]] = {}
        self._outlets: dict[str, SharedOutlet] = {}
        self.shared: tuple[str, ...] = ()
        self._present: set[str] = set()
        self._welcomed = False
        self._grants = [
            session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK, express=True)
            for key in keys.grants(self._nodes)
        ]
        self._senders: list[Callable[[bytes], None]] = [publisher.put for publisher in self._grants]
        self._stepping = self._senders

    def register(self, query: zenoh.Query) -> None:
        """Take a registration, which is answered by `welcome`; refuse one that does not belong here."""
        registration = msgspec.json.decode(query.payload.to_bytes() if query.payload else b"", type=Registration)
        if registration.node not in self._plan.nodes:
            query.reply_err(f"this mesh has no node '{registration.node}'")
        elif registration.digest != self._plan.digest:
            where = f"process {registration.pid} on {registration.host}"
            query.reply_err(
                f"node '{registration.node}' ({where}) has another configuration, or other FMUs, than the master"
            )
        elif registration.node in self._registered or self._welcomed:
            query.reply_err(f"node '{registration.node}' is there already; two processes run it")
        else:
            outlet = SharedOutlet.open(
                registration.offer, MASTER, spoken(registration.node), self._inbox.stash, self._timeouts.step
            )
            if outlet is not None and self._inbox.offer is not None:
                self._outlets[registration.node] = outlet
            self._registered[registration.node] = (registration, query)
            return
        query.drop()

    def token_changed(self, sample: zenoh.Sample) -> None:
        """Take the liveliness token of a node: it is there, or it is gone."""
        node = str(sample.key_expr).rsplit("/", 1)[1]
        if sample.kind == zenoh.SampleKind.PUT:
            self._present.add(node)
        elif node in self._plan.nodes:
            self._on_lost(node)

    @property
    def complete(self) -> bool:
        """Whether every node has registered and waits for its welcome."""
        return len(self._registered) >= len(self._nodes)

    def absence(self) -> DeadlineExceeded:
        """The error that names who has not registered."""
        missing = [node for node in self._nodes if node not in self._registered]
        if len(missing) > 1:  # the recorder only waits for the others
            missing = [node for node in missing if node != RECORDER]
        there = [node for node in missing if node in self._present]
        return DeadlineExceeded(
            f"not ready within {self._timeouts.start:g} s: {spoken(*missing)}",
            hint=f"Started, but not ready: {', '.join(there)}." if there else "None of them was started.",
        )

    def welcome(self, profile_entries: int) -> None:
        """Answer all nodes, and tell them who is reached through shared memory: the master is if all nodes are.

        Args:
            profile_entries: how many bursts and waits each node shall note for a profile; 0: nothing is measured.
        """
        shared = [node for node in self._nodes if node in self._outlets and self._registered[node][0].shared]
        self._stepping = [self._outlets[node].put for node in shared if node != RECORDER]
        rest = [node for node in self._nodes if node not in shared]
        if rest:
            publishers = zip(self._grants, batched(self._nodes), strict=True)
            self._stepping += [publisher.put for publisher, nodes in publishers if not set(nodes).isdisjoint(rest)]
        self._senders = self._stepping + [self._outlets[node].put for node in shared if node == RECORDER]
        offer = self._inbox.offer if len(self._outlets) == len(self._nodes) else None
        if offer is not None:
            self._inbox.share()
            shared.append(MASTER)
        self.shared = tuple(shared)
        self._welcomed = True
        for number, node in enumerate(self._nodes):
            _, query = self._registered.pop(node)
            query.reply(query.key_expr, msgspec.json.encode(Welcome(number, profile_entries, self.shared, offer)))
            query.drop()

    def send(self, kind: int, point: int) -> None:
        """Send a message of the master's to all nodes."""
        message = HEADER.pack(kind, 0, 0, point)
        for send in self._senders:
            send(message)

    def grant(self, point: int) -> None:
        """Send a grant to those who step; the recorder takes what comes, and each message would wake it for nothing."""
        message = HEADER.pack(GRANT, 0, 0, point)
        for send in self._stepping:
            send(message)

    def abort(self, error: FmuMeshError) -> None:
        """Tell the nodes why the run ends, and give them the time to end by themselves."""
        for send in self._senders:
            send(encode_abort(error.report()))
        for _, query in self._registered.values():  # nodes that still wait to be let in
            query.reply_err(str(error))
            query.drop()
        self._registered.clear()

    def close(self) -> None:
        """Undeclare what was sent on."""
        undeclare_all(self._grants)


def spoken(*nodes: str) -> str:
    """The names of nodes as a message says them."""
    return ", ".join("the recorder" if node == RECORDER else f"node '{node}'" for node in nodes)
