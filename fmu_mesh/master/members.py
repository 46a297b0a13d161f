"""The members of a mesh, as its master sees them: who is there, who has registered, and how each node is reached.

Owns the master's end of `fmu_mesh.wire.membership`. Knows nothing of points and progress; called on the main thread.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

import msgspec
import zenoh

from ..errors import DeadlineExceeded, FmuMeshError, MessageRefused
from ..system.digest import difference
from ..system.plan import RECORDER, Plan
from ..wire.inbox import Inbox
from ..wire.keys import MASTER, RunKeys, batched
from ..wire.membership import Admission, NodeReady, Registration, Welcome
from ..wire.messages import GRANT, HEADER, decode_json, encode_abort
from ..wire.refusals import payload_of
from ..wire.session import tokens, undeclare_all
from ..wire.shared_memory import SharedOutlet

__all__ = ["Members", "spoken"]

log = logging.getLogger(__name__)


class Members:
    """The nodes of one run.

    Args:
        plan: the plan of the whole mesh.
        session: the session of this process; stays the caller's.
        keys: those of the run.
        inbox: the inbox of the master.
        on_lost: called with the name of a node whose process is gone.
        launch: the launcher that started this process; None where it was started by hand.

    Attributes:
        shared: who gets all messages through shared memory: names of nodes, `@mesh` for the master.

    Call sequence: `register`, `ready` and `token_changed` with what arrives; `welcome` once all are `complete`; from
    then on `send`. `abort` may come at any time, `close` at the end.
    """

    def __init__(  # noqa: PLR0913, PLR0917  the run and what it is reached by
        self,
        plan: Plan,
        session: zenoh.Session,
        keys: RunKeys,
        inbox: Inbox,
        on_lost: Callable[[str], None],
        launch: str | None = None,
    ) -> None:
        self._plan = plan
        self._session = session
        self._keys = keys
        self._timeouts = plan.system.config.timeouts
        self._nodes = list(plan.nodes)
        self._inbox = inbox
        self._on_lost = on_lost
        self._launch = launch
        self._admitted: dict[str, Registration] = {}
        self._refused: list[str] = []
        self._ready: dict[str, tuple[NodeReady, zenoh.Query]] = {}
        self._welcomed = False
        self._outlets: dict[str, SharedOutlet] = {}
        self.shared: tuple[str, ...] = ()
        self._grant_keys = {
            node: key for key, part in zip(keys.grants(self._nodes), batched(self._nodes), strict=True) for node in part
        }
        self._grants = [
            session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK, express=True)
            for key in keys.grants(self._nodes)
        ]
        self._senders: list[Callable[[bytes], None]] = [publisher.put for publisher in self._grants]
        self._stepping = self._senders

    def register(self, query: zenoh.Query) -> None:
        """Admit a node, or refuse one that does not belong here: nobody but itself notices.

        Raises:
            MessageRefused: it is no registration.
        """
        registration = decode_json(payload_of(query), Registration)
        if registration.launch == self._launch:
            reason = self._reason_against(registration)
            if reason is None:
                self._admitted[registration.node] = registration
                admission = Admission(self._keys.run, self._grant_keys[registration.node])
                query.reply(query.key_expr, msgspec.json.encode(admission))
            else:
                self._refused.append(reason)
                log.info("node_refused", extra={"reason": reason})
                query.reply_err(reason)
        # What another launch has started gets no answer: it is for its own master to tell it.
        query.drop()

    def _reason_against(self, registration: Registration) -> str | None:
        node, where = registration.node, f"process {registration.pid} on {registration.host}"
        if node not in self._plan.nodes:
            return f"this mesh has no node '{node}'"
        if registration.digest != self._plan.digest:
            what = difference(self._plan.digest, registration.digest, self._plan.system.instances)
            return f"node '{node}' ({where}) has {what}, not that of the master"
        # Who asks again, because no answer came, is the same.
        if self._admitted.get(node, registration) != registration:
            return f"node '{node}' is there already; two processes run it"
        return None

    def is_admitted(self, node: str) -> bool:
        """Whether this is a node of the run."""
        return node in self._admitted

    def ready(self, query: zenoh.Query) -> None:
        """Take that a node is ready, which is answered by `welcome`.

        Raises:
            MessageRefused: it is none, or not of a node of this run.
        """
        node = RunKeys.node_in(str(query.key_expr))
        data = payload_of(query)
        if node not in self._admitted or node in self._ready:
            raise MessageRefused("it is from no node that has registered")
        ready = decode_json(data, NodeReady)
        outlet = SharedOutlet.open(ready.offer, MASTER, spoken(node), self._inbox.stash, self._timeouts.step)
        if outlet is not None and self._inbox.offer is not None:
            self._outlets[node] = outlet
        self._ready[node] = (ready, query)

    def token_changed(self, sample: zenoh.Sample) -> None:
        """Take a liveliness token of a node that is gone, if it really is."""
        node = RunKeys.node_in(str(sample.key_expr))
        gone = sample.kind == zenoh.SampleKind.DELETE and node in self._admitted
        if gone and not tokens(self._session, self._keys.node(node)):
            self._on_lost(node)

    @property
    def complete(self) -> bool:
        """Whether every node is ready and waits for its welcome."""
        return len(self._ready) >= len(self._nodes)

    def absence(self) -> DeadlineExceeded:
        """The error that names who is not ready."""
        missing = [node for node in self._nodes if node not in self._ready]
        if len(missing) > 1:  # the recorder only waits for the others
            missing = [node for node in missing if node != RECORDER]
        there = [node for node in missing if node in self._admitted]
        hint = f"Started, but not ready: {', '.join(there)}." if there else "None of them was started."
        if self._refused:
            hint += f" Refused: {self._refused[-1]}."
        return DeadlineExceeded(f"not ready within {self._timeouts.start:g} s: {spoken(*missing)}", hint=hint)

    def welcome(self, profile_entries: int) -> None:
        """Answer all nodes, and tell them who is reached through shared memory: the master is if all nodes are.

        Args:
            profile_entries: how many bursts and waits each node shall note for a profile; 0: nothing is measured.
        """
        shared = [node for node in self._nodes if node in self._outlets and self._ready[node][0].shared]
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
        for _, query in self._ready.values():
            query.reply(query.key_expr, msgspec.json.encode(Welcome(profile_entries, self.shared, offer)))
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
        if not self._welcomed:
            for _, query in self._ready.values():  # they still wait to be let in
                query.reply_err(str(error))
                query.drop()

    def close(self) -> None:
        """Undeclare what was sent on."""
        undeclare_all(self._grants)


def spoken(*nodes: str) -> str:
    """The names of nodes as a message says them."""
    return ", ".join("the recorder" if node == RECORDER else f"node '{node}'" for node in nodes)
