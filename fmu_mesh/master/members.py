"""The members of a mesh for its master: which nodes are present and registered, and how each node is reached.

Owns the master's part of `fmu_mesh.wire.membership`. Knows nothing of points and progress; called on the main thread.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

import msgspec
import zenoh

from ..errors import DeadlineExceeded, FmuMeshError, MessageRefused
from ..rings.host_memory import Offer
from ..system.digest import difference
from ..system.plan import RECORDER, Plan
from ..wire.inbox import Inbox
from ..wire.keys import RunKeys
from ..wire.membership import Admission, NodeReady, Registration, Welcome
from ..wire.messages import HEADER, decode_json, encode_abort, sealed
from ..wire.refusals import payload_of
from ..wire.runtime import is_alive, is_stopped
from ..wire.session import tokens, undeclare_all

__all__ = ["Followers", "Members", "spoken"]

log = logging.getLogger(__name__)


class Members:
    """The nodes of one run.

    Args:
        plan: the plan of the whole mesh.
        session: the session of this process; the caller closes it.
        keys: the keys of the run.
        offer: the memory that processes of this host share; None if there is none.
        on_lost: called with the name of a node whose process is gone.
        launch: the launcher that started this process; None if it was started manually.

    Attributes:
        shared: the nodes that use the shared memory, and the recorder.
        doubted: nodes on this host whose token is gone, although their process runs.

    Call sequence: `register`, `ready` and `token_changed` for messages that arrive; `welcome` when `complete` is true;
    then `send`. `abort` may be called at any time, `close` at the end.
    """

    def __init__(  # noqa: PLR0913, PLR0917  the run and what it is reached by
        self,
        plan: Plan,
        session: zenoh.Session,
        keys: RunKeys,
        offer: Offer | None,
        on_lost: Callable[[str], None],
        launch: str | None = None,
    ) -> None:
        self._plan = plan
        self._session = session
        self._keys = keys
        self._timeouts = plan.system.config.timeouts
        self._nodes = list(plan.nodes)
        self._offer = offer
        self._on_lost = on_lost
        self._launch = launch
        self._admitted: dict[str, Registration] = {}
        self._refused: list[str] = []
        self._ready: dict[str, tuple[NodeReady, zenoh.Query]] = {}
        self._welcomed = False
        self.shared: tuple[str, ...] = ()
        self.doubted: set[str] = set()
        self._grant_keys = keys.grants(self._nodes)
        self._grants = [
            session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK, express=True)
            for key in dict.fromkeys(self._grant_keys.values())
        ]

    def register(self, query: zenoh.Query) -> None:
        """Admit a node, or refuse one that is not part of this run; the run is not affected.

        Raises:
            MessageRefused: it is no registration.
        """
        registration = decode_json(payload_of(query), Registration)
        if registration.launch == self._launch:
            reason = self._reason_against(registration)
            if reason is None:
                self._admitted[registration.node] = registration
                admission = Admission(self._keys.run, self._grant_keys[registration.node], self._offer)
                query.reply(query.key_expr, msgspec.json.encode(admission))
            else:
                self._refused.append(reason)
                log.info("node_refused", extra={"reason": reason})
                query.reply_err(reason)
        # A process of another launch gets no answer here: its own master answers it.
        query.drop()

    def _reason_against(self, registration: Registration) -> str | None:
        node, where = registration.node, f"process {registration.pid} on {registration.host}"
        if node not in self._plan.nodes:
            return f"this mesh has no node '{node}'"
        if registration.digest != self._plan.digest:
            what = difference(self._plan.digest, registration.digest, self._plan.system.instances)
            return f"node '{node}' ({where}) has {what}, not that of the master"
        # The same node may ask again if it got no answer.
        if self._admitted.get(node, registration) != registration:
            return f"node '{node}' is there already; two processes run it"
        return None

    def is_of(self, node: str, opened: str) -> bool:
        """Whether the sender of a message has registered as this node: it knows what the seal was made from."""
        return node in self._admitted and sealed(opened) == self._admitted[node].seal

    def ready(self, query: zenoh.Query) -> None:
        """Store that a node is ready; `welcome` answers it.

        Raises:
            MessageRefused: it is no such message, or not of a node of this run.
        """
        node = RunKeys.node_in(str(query.key_expr))
        ready = decode_json(payload_of(query), NodeReady)
        if not self.is_of(node, ready.opened) or node in self._ready:
            raise MessageRefused("its sender is not the process that has registered")
        self._ready[node] = (ready, query)

    def token_changed(self, sample: zenoh.Sample) -> None:
        """Handle a liveliness token that seems to be gone, if it really is. On this host its process tells."""
        node = RunKeys.node_in(str(sample.key_expr))
        gone = sample.kind == zenoh.SampleKind.DELETE and node in self._admitted
        if gone and node in self.shared:
            self.doubted.add(node)
        elif gone and not tokens(self._session, self._keys.node(node)):
            self._on_lost(node)

    def look_at_doubted(self, *, router_is_lost: bool) -> None:
        """Call it now and then: a node whose token is gone is lost when its process has ended, or with the router."""
        for node in [node for node in self.doubted if router_is_lost or not is_alive(self._admitted[node].pid)]:
            self.doubted.discard(node)
            self._on_lost(node)

    @property
    def stopped(self) -> list[str]:
        """The nodes on this host whose processes are stopped."""
        return [node for node in self.shared if is_stopped(self._admitted[node].pid)]

    @property
    def complete(self) -> bool:
        """Whether every node is ready and waits for its welcome."""
        return len(self._ready) >= len(self._nodes)

    def absence(self) -> DeadlineExceeded:
        """The error that names the nodes that are not ready."""
        missing = [node for node in self._nodes if node not in self._ready]
        if len(missing) > 1:  # the recorder only waits for the nodes
            missing = [node for node in missing if node != RECORDER]
        there = [node for node in missing if node in self._admitted]
        hint = f"Started, but not ready: {', '.join(there)}." if there else "None of them was started."
        if self._refused:
            hint += f" Refused: {self._refused[-1]}."
        return DeadlineExceeded(f"not ready within {self._timeouts.start:g} s: {spoken(*missing)}", hint=hint)

    def welcome(self, profile_entries: int) -> None:
        """Answer all nodes, and tell them who shares the memory.

        Args:
            profile_entries: how many bursts and waits each node stores for a profile; 0: nothing is measured.
        """
        self.shared = tuple(node for node in self._nodes if self._ready[node][0].shared)
        self._welcomed = True
        for _, query in self._ready.values():
            query.reply(query.key_expr, msgspec.json.encode(Welcome(profile_entries, self.shared)))
            query.drop()

    def send(self, kind: int, point: int) -> None:
        """Send a message to all nodes."""
        message = HEADER.pack(kind, 0, 0, point)
        for publisher in self._grants:
            publisher.put(message)

    def abort(self, error: FmuMeshError) -> None:
        """Tell the nodes why the run ends, and wait so that they can end themselves."""
        for publisher in self._grants:
            publisher.put(encode_abort(error.report()))
        if not self._welcomed:
            for _, query in self._ready.values():  # they still wait for admission
                query.reply_err(str(error))
                query.drop()

    def close(self) -> None:
        """Undeclare all publishers."""
        undeclare_all(self._grants)


def spoken(*nodes: str) -> str:
    """The names of nodes as text for a message."""
    return ", ".join("the recorder" if node == RECORDER else f"node '{node}'" for node in nodes)


class Followers:
    """The followers of one run: readers that must get the last sample.

    The master waits for them at the end, because it routes samples. A follower has a liveliness token
    until it has all samples; Zenoh itself does not report this.

    Args:
        inbox: the inbox of the master.
        is_going_on: whether the run has not ended yet.
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
        deadline = time.monotonic() + timeout_s
        while self._there:
            if (left := deadline - time.monotonic()) <= 0:
                log.warning("a gateway did not receive its last samples within %g s", timeout_s)
                return
            self._inbox.wait(left)
