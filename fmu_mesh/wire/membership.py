"""How a node or the recorder joins a mesh, and how its messages reach the other participants.

There are three steps; each is a query with an answer:

* **register** with the master, which admits the node and answers with the run's id, or refuses it. The node declares
  nothing before, so a process that is not part of the run does not affect it.
* **hello** to every node that sends rows to this one: a source that answers knows the subscription of this node. Those
  that share no memory meet for a row stream (`fmu_mesh.wire.meeting`).
* **ready** to the master, which answers when all nodes are ready.
"""

from __future__ import annotations

import logging
import math
import secrets
import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack
from typing import Annotated, TypeVar

import msgspec
import zenoh
from msgspec.structs import replace

from ..errors import DeadlineExceeded, MeshLost, MessageRefused
from ..rings.host_memory import HostMemory, Offer
from ..system.attempt import Attempt
from ..system.plan import MASTER, RECORDER, NodePlan
from .host_processes import STOPPED, is_alive, is_stopped, opened_of, own_pid
from .inbox import Inbox
from .keys import RUN_ID_BYTES, Keys, RunKeys
from .meeting import Door, Meeting
from .messages import NodeReport, decode_json, sealed
from .refusals import payload_of
from .router_link import RouterLink
from .session import Question, ask
from .ways import Ways

__all__ = ["Admission", "Membership", "NodeReady", "Registration", "Welcome"]

log = logging.getLogger(__name__)

# Threads: `register` starts one that asks the master, so that FMUs are loaded meanwhile; it sets `_admitted` (a
# future) and `_keys` and ends. The owner's thread calls `keys`, `join`, `check_silence`. A thread of Zenoh answers
# `hello`, and another one notes that the master's token went (`_master_went`): it may not ask anything, because a
# query inside a callback waits for the thread that it is on. So it only sets a flag, and the owner asks
# (`master_is_gone`).
#
# What may go wrong, and why it is done so:
# * A query that is sent before its queryable is known gets no answer: `ask` waits until one matches.
# * A frame that is sent before its receiver is known is lost: so each target says `hello` to its sources. A source
#   that answers has got the subscription, which was declared before the question. Only then a node is ready.
# * The token of the master seems to be gone although it runs: Zenoh notifies a lost token although another session
#   still has one with this key. On this host the process decides, elsewhere a query (ADR 67).
# * Two runs of one name: all keys but `register` have the id of the run, and nothing is declared before the master
#   has admitted this process (ADR 8).
# * Somebody else reports in the name of a node: the master knows a seal, and only the node its secret.
#
# Tried and given up: tokens as the only sign of life (a suspended host ended healthy runs). Not chosen: a heartbeat
# of our own, which tells nothing that the lease does not (ADR 67).

T = TypeVar("T")

_SILENCE_S = 2.0
"""Longer than a live master is silent: it says something twice a second."""

_SAID_PER_S = 4
"""At most so many messages of the master come in a second while a node takes no step."""

_GRACE_S = 1.0
_AGAIN_S = 0.25
"""How often in s the question whether the master is there is asked again."""


class Registration(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A process that wants to be a node of the mesh.

    Attributes:
        launch: the launcher that started it; None if it was started manually.
        door: where the master reaches the process for a row stream.
        seal: the secret of the process, `sealed` twice. Its readiness contains the secret sealed once, and its report
            the secret itself. So nobody can send them who has only read what came before. No other process has the
            same one, while two hosts may have one process id and one host name.
    """

    node: str
    digest: str
    pid: int
    host: str
    launch: str | None = None
    seal: str = ""
    door: Door | None = None


class Admission(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The master's answer to a registration.

    Attributes:
        grants: the key of the master's messages to this node.
        offer: the memory that processes on the master's host share; None if there is none.
        door: where the process reaches the master for a row stream.
        table: number of the table of roles that the master has; 0: it has none of our authority.
        attempt: which one of the run this is.
    """

    run: Annotated[str, msgspec.Meta(pattern=f"^[0-9a-f]{{{2 * RUN_ID_BYTES}}}$")]
    grants: str
    offer: Offer | None = None
    door: Door | None = None
    table: int = 0
    attempt: Attempt = Attempt()


class Hello(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a node sends to its sources, and what they answer: who it is, and how it can exchange rows."""

    node: str
    shared: bool = False
    door: Door | None = None


class NodeReady(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a node reports when its links work.

    Attributes:
        shared: whether it uses the memory of the master's host.
        opened: what its seal was made from.
        streams: those with whom it has a socket for a row stream.
    """

    shared: bool = False
    opened: str = ""
    streams: tuple[str, ...] = ()


class Welcome(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The master's answer to all nodes when all of them are ready.

    Attributes:
        profile: how many bursts and waits the node stores for a profile; 0: nothing is measured.
        ways: how rows go.
    """

    profile: int = 0
    ways: Ways = Ways()


class Membership:
    """One participant's part in the mesh.

    Args:
        inbox: its inbox; opened by `join`.
        memory: the shared memory, for a participant in the process of the master.
        meeting: where it meets others for row streams; None: all of its rows go by rings and by Zenoh.
        table: number of the table of roles of this process; 0: it needs none.
        stream_silent_s: for how long the master has sent nothing by a row stream, in s.

    Attributes:
        memory: the shared memory, from the admission on; None if this process does not share any.
        lost_master: whether the master was found to be gone, or does not answer.
        lost_link: whether only the link to it may be lost, so that nobody else can say it.
        doubts_master: whether `master_is_gone` could not be sure that it is there.

    Call sequence: `register`, then `join` once, then `sender` for each receiver, and `close` at the end.
    """

    def __init__(  # noqa: PLR0913, PLR0917  one participant and its surroundings
        self,
        plan: NodePlan,
        session: zenoh.Session,
        inbox: Inbox,
        launch: str | None = None,
        router: RouterLink | None = None,
        memory: HostMemory | None = None,
        meeting: Meeting | None = None,
        stream_silent_s: Callable[[], float] = lambda: math.inf,
        table: int = 0,
    ) -> None:
        self._plan = plan
        self._meeting, self._table = meeting, table
        self._router = router or RouterLink(session)
        self.lost_master = self.lost_link = self.doubts_master = False
        self._asked_at = -math.inf
        self._stream_silent_s = stream_silent_s
        self._stopped_s = 0.0
        self._session = session
        self._inbox = inbox
        self._launch = launch
        self._secret = secrets.token_hex()
        self._public = Keys(plan.key_prefix, plan.mesh)
        self._keys: RunKeys | None = None
        self._admitted: Future[Admission] = Future()
        self.memory = memory
        self._stack = ExitStack()
        self._master_went = False
        self.given_up = False

    def register(
        self, on_admitted: Callable[[], None] = lambda: None, on_master_gone: Callable[[], None] = lambda: None
    ) -> None:
        """Begin to register, on a separate thread: FMUs can be loaded meanwhile.

        ``on_admitted`` is called on that thread when the master has admitted this node, and ``on_master_gone`` on a
        thread of Zenoh when the master's token seems to be gone: ask `master_is_gone`.
        """

        def run() -> None:
            try:
                admission = self._enter(on_master_gone)
                on_admitted()
                self._admitted.set_result(admission)
            except zenoh.ZError as error:  # the session was closed meanwhile
                self._admitted.set_exception(MeshLost(f"this process cannot join the mesh: {error}"))
            except Exception as error:  # noqa: BLE001 who waits for the keys gets it
                self._admitted.set_exception(error)

        threading.Thread(target=run, name="register", daemon=True).start()

    def give_up(self) -> None:
        """From any thread: let `join` end with an error, because the mesh is gone."""
        self.given_up = True

    def keys(self, patience_s: float) -> RunKeys:
        """The keys of the run, once the master has admitted this node.

        Raises:
            DeadlineExceeded: the master did not answer within ``patience_s`` seconds.
            MeshLost: the master refused this node; the message says why.
        """
        try:
            return self._public.run(self._admitted.result(patience_s).run)
        except TimeoutError:
            raise DeadlineExceeded(f"the master did not answer within {patience_s:g} s") from None

    @property
    def attempt(self) -> Attempt:
        """Which attempt of the run this is, as the master has said it with the admission."""
        return self._admitted.result(0).attempt if self.is_admitted else Attempt()

    @property
    def is_admitted(self) -> bool:
        """Whether the master has admitted this node."""
        return self._admitted.done() and self._admitted.exception() is None

    @property
    def master_is_gone(self) -> bool:
        """Whether the master is gone. This may send a query, so do not call it in a callback of Zenoh.

        On this host its process tells, elsewhere what `RouterLink.has_gone` says.
        """
        self.doubts_master = True
        if self.master_runs or self._keys is None:
            return False
        if (now := time.monotonic()) - self._asked_at < _AGAIN_S:
            return False
        self._asked_at = now
        gone = self._router.has_gone(self._keys.master, self._stream_silent_s(), self._plan.timeouts.link)
        self.doubts_master = gone is not False
        return gone is True

    @property
    def master_runs(self) -> bool:
        """Whether the master is known to run, because it shares memory with this process."""
        return (pid := self._master_pid) is not None and is_alive(pid) and not self._router.is_lost

    @property
    def _master_pid(self) -> int | None:
        offer = self._admitted.result(0).offer if self.memory is not None and self.is_admitted else None
        return offer.pid if offer is not None else None

    def without_master(self, silent_s: float = 0.0) -> MeshLost:
        """The error for a lost master, which has said nothing for ``silent_s`` seconds; also stores that it is lost."""
        self.lost_master = True
        loss = self._router.loss()
        if loss is not None:
            return MeshLost(f"{loss}, and the master with it")
        if silent_s > _SILENCE_S:
            self.note_lost_link()
            text = f"node '{self._plan.node}' lost its link to the master, which did not answer for {silent_s:.0f} s"
            return MeshLost(text, hint="Is its process stopped, its host suspended, or the network cut?")
        return MeshLost("the master is gone", hint="See the messages of its process.")

    def note_lost_link(self) -> None:
        """The link to the master is cut for too long: nobody can be told anything."""
        self.lost_master = self.lost_link = True

    def check_silence(self, silent_s: float) -> None:
        """The master has said nothing for ``silent_s`` seconds.

        Raises:
            MeshLost: no link between hosts may be silent for so long.
            DeadlineExceeded: a step may not take so long.
        """
        timeouts, pid = self._plan.timeouts, self._master_pid
        silent_s = min(silent_s, self._stream_silent_s())
        if silent_s <= min(timeouts.link, timeouts.step):
            self._stopped_s = 0.0
            return
        stopped = pid is not None and is_stopped(pid)
        if stopped:  # on this host, so what is silent is not the link
            self._stopped_s = silent_s
        if self._router.endpoints and silent_s - self._stopped_s > timeouts.link:
            raise self.without_master(silent_s)
        if silent_s > timeouts.step:
            self.lost_master = True
            state = f": its process {STOPPED}" if stopped else ""
            text = f"the master has said nothing for {silent_s:.1f} s{state}"
            raise DeadlineExceeded(text, hint=None if state else "Is its process stopped, or its host gone?")

    def report(
        self,
        report: NodeReport,
        timeout_s: float,
        over: Callable[[], bool] = lambda: False,
        priority: zenoh.Priority = zenoh.Priority.DEFAULT,
    ) -> None:
        """From any thread: report to the master how this participant has ended, unless it is ``over`` before.

        The report arrives after earlier messages of the same priority.

        Raises:
            MeshLost: the master did not accept it in time, or this is not a node of its run.
        """
        key = self.keys(timeout_s).report(self._plan.node)
        payload = msgspec.json.encode(replace(report, secret=self._secret))
        question = Question(key, "the master", timeout_s, payload, priority=priority)
        ask(self._session, question, over)

    def join(self) -> Welcome:
        """Wait until the links with all other nodes work in both directions, then tell the master.

        Raises:
            DeadlineExceeded: a participant did not answer in time.
            MeshLost: the master refused this node, the message says why; or `give_up` was called.
        """
        plan, inbox = self._plan, self._inbox
        deadline_s = plan.timeouts.start
        keys = self.keys(deadline_s + _GRACE_S)
        senders = {keys.frames(link.source, plan.node): link.source_node for link in plan.links_in}
        if plan.node == RECORDER:
            senders |= {keys.settings(node): node for node, _ in plan.windows if node != RECORDER}
        # What may come while a step lasts: the rows that were granted, again after a cut, and what the master says.
        on_way = 2 * sum(place.rows for place in plan.rings) + _SAID_PER_S * plan.timeouts.step
        inbox.open(self._session, keys, plan.node, {**senders, self._admitted.result(0).grants: MASTER}, on_way)
        for node in dict.fromkeys(link.source_node for link in plan.links_in):
            question = Question(keys.hello(node), f"node '{node}'", deadline_s, self._hello_to(node))
            self._heard_hello(decode_json(ask(self._session, question, self._has_nothing_to_join), Hello))
        streams = self._meet(deadline_s)
        ready = msgspec.json.encode(NodeReady(self.memory is not None, sealed(self._secret), streams))
        question = Question(keys.ready(plan.node), "the master", 2 * deadline_s, ready)  # it waits for all others
        answer = ask(self._session, question, self._has_nothing_to_join)
        self._router.look()
        return _understood(answer, Welcome)

    def sender(self, key: str) -> Callable[[bytes], None]:
        """A function that publishes a message on ``key``."""
        publisher = self._session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK, express=True)
        self._stack.callback(publisher.undeclare)
        return publisher.put

    def close(self) -> None:
        """Undeclare everything that this object has declared."""
        self.given_up = True
        self._stack.close()

    def _enter(self, on_master_gone: Callable[[], None]) -> Admission:
        """Register, then declare the token and `hello`: the master notices from now on if this process is lost."""
        plan, stack = self._plan, self._stack
        seal, host = sealed(sealed(self._secret)), socket.gethostname()
        door = self._meeting.door_for(MASTER) if self._meeting is not None else None
        registration = Registration(plan.node, plan.digest, own_pid(), host, self._launch, seal, door)
        payload = msgspec.json.encode(registration)
        question = Question(self._public.register, "the master", plan.timeouts.start, payload)
        admission = _understood(ask(self._session, question, lambda: self.given_up), Admission)
        if self._table and admission.table and self._table != admission.table:
            from .security.identity import other_table  # noqa: PLC0415  most runs have no certificate

            log.warning("%s", other_table(self._table, admission.table))
        self._keys = keys = self._public.run(admission.run)
        if self.memory is None and admission.offer is not None and plan.shared_memory:
            self.memory = HostMemory.opened(admission.offer, plan.memory, plan.node, opened_of)
        if self._meeting is not None:
            self._meeting.knows(MASTER, admission.door if self.memory is None else None)

        def master_changed(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.DELETE:
                self._master_went = True
                on_master_gone()

        watcher = self._session.liveliness().declare_subscriber(keys.master, master_changed, history=True)
        stack.callback(watcher.undeclare)
        hello = self._session.declare_queryable(keys.hello(plan.node), self._answer_hello)
        stack.callback(hello.undeclare)
        stack.callback(self._session.liveliness().declare_token(keys.node(plan.node)).undeclare)
        return admission

    def _answer_hello(self, query: zenoh.Query) -> None:
        """On a thread of Zenoh: answer a target; its subscription is known here."""
        with self._inbox.refusals.guard(str(query.key_expr), query):
            hello = decode_json(payload_of(query), Hello)
            if hello.node not in {link.target_node for link in self._plan.links_out}:
                raise MessageRefused("its sender receives nothing from this node")
            self._heard_hello(hello)
            query.reply(query.key_expr, self._hello_to(hello.node))
            query.drop()

    def _hello_to(self, peer: str) -> bytes:
        door = self._meeting.door_for(peer) if self._meeting is not None and peer != RECORDER else None
        return msgspec.json.encode(Hello(self._plan.node, self.memory is not None, door))

    def _heard_hello(self, hello: Hello) -> None:
        """From any thread: note where a peer is to be met, unless both share memory."""
        if self._meeting is not None:
            shares = hello.shared and self.memory is not None
            self._meeting.knows(hello.node, None if shares else hello.door)

    def _meet(self, deadline_s: float) -> tuple[str, ...]:
        """Meet all with whom this node exchanges rows, and shares no memory; those that were met."""
        if self._meeting is None:
            return ()
        peers = (self._plan.step_sources | self._plan.step_targets | {MASTER}) - {RECORDER}
        self._meeting.settle(peers, deadline_s, self._has_nothing_to_join)
        return tuple(self._meeting.sockets)

    def _has_nothing_to_join(self) -> bool:
        if self._master_went and not self.given_up:
            self.given_up = self.master_is_gone
            self._master_went = self.doubts_master and not self.given_up  # then it is asked again
        return self.given_up


def _understood(answer: bytes, kind: type[T]) -> T:
    try:
        return decode_json(answer, kind)
    except MessageRefused as error:
        hint = "Do all processes run the same version of fmu_mesh?"
        raise MeshLost(f"the master's answer is not understood: {error}", hint=hint) from error
