"""Opens Zenoh sessions: the only `zenoh.open` of the project, and the reason for every setting."""

from __future__ import annotations

import json
import queue
import re
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
import zenoh
from msgspec.structs import replace
from zenoh.handlers import Callback

from ..config.access_sections import host_of, is_socket, why_closed
from ..errors import ConfigurationError, DeadlineExceeded, MeshLost
from .values import json_encoding

if TYPE_CHECKING:  # most processes have no certificate
    from .security.identity import Identity

__all__ = [
    "LEASE_S",
    "Question",
    "Wiring",
    "answer_of",
    "answers",
    "ask",
    "close_session",
    "is_of_this_host",
    "matches",
    "open_session",
    "own_endpoints",
    "run_router",
    "tokens",
    "undeclare_all",
]

# Threads: a session has its own. Each callback of zenoh-python has a thread in addition, unless it is
# `indirect=False`; that one runs on the thread that reads the link, and must return at once. No function here may be
# called in a callback: those that ask would wait for the thread that they are on. `close_session` closes on a thread
# of its own, which may be left behind. Where Zenoh has no event (a queryable whose process is gone), a wait looks
# every `_OVER_CHECK_S`.
#
# What may go wrong: a receiver is stopped, and a sender blocks on it. Then `stuck_s` closes the link; the lease does
# not expire meanwhile (measured, ADR 4). A slow reader loses samples and answers, which have queues of their own
# behind all other messages. A process that ends while a thread of Zenoh calls Python may abort: `last_exit`.
#
# Tried and given up: gossip and scouting on one host (slower than endpoints, and open to others), a loopback port
# (every user of the host can connect), the lease as it is by default (4 s ended runs whose host was suspended; ADR
# 67).

LEASE_S = 30.0
"""After so long in s without a sign of life a link counts as lost; a dead process is noticed within milliseconds."""

_STUCK_S = 4.0

_LARGE_US = 2_000_000
"""How long the pieces of one large sample or answer may wait for a client in all."""

_LOG_OF_LISTENER = "error,zenoh::net::routing=off,zenoh_link_tls=warn,zenoh_link_quic=warn"
"""What is undeclared was never declared where the rules have dropped that: one error each, as often as others like."""

_OWN_SOURCE = re.compile(r" at /\S+\.rs:\d+\.?")
_CANNOT_LISTEN = (
    ("Address already in use", "another process does", "End that process, or take another port; 0 is a free one."),
    ("Cannot assign requested address", "this host has no such address", "0.0.0.0 stands for all that it has."),
    ("Permission denied", "this user may not", "Take a port above 1023."),
)
"""Why a session cannot listen at an endpoint: the text of the system, our text, and a hint."""


_BACKGROUND: Final = {"priority": "background", "congestion_control": "drop"}
_ADMIN_SPACE_IS_OURS: Final = {
    "enabled": True,
    "default_permission": "allow",
    "rules": [
        {"id": "admin", "messages": ["query"], "flows": ["ingress"], "permission": "deny", "key_exprs": ["@/**"]}
    ],
    "subjects": [{"id": "all"}],
    "policies": [{"rules": ["admin"], "subjects": ["all"]}],
}
"""A session whose admin space others ask for its subscribers, while one comes or goes, stands for ever (zenoh 1.10)."""

# Zenoh closes a session within milliseconds, unless an endpoint does not answer: then it would take ten seconds.
_SESSION_END_S = 1.0
_OWN_S = 5.0
# How late a question notices that its answer is not needed any more, or that the process it asks is gone: neither is
# an event here. One that has waited for long already looks less often: of hundreds of nodes that start, each waits for
# all others, and looking would take the time of those that are not there yet.
_OVER_CHECK_S, _OVER_LONGEST_S, _OVER_SHARE = 0.05, 0.4, 0.1
_TIMEOUT = "Timeout"
"""The reply of Zenoh itself if a queryable did not answer in time."""
_TOKENS_S = 2.0
_TOKENS_TRIES = 10


class Wiring(msgspec.Struct, frozen=True):
    """How one process is connected.

    Attributes:
        mode: `peer` or `client`.
        connect: endpoints to connect to; repeated until they answer.
        gossip: whether peers find each other through other peers (meshes over several hosts).
        patience_s: how long a client tries to connect, in s.
        lease_s: how long a process at the other end waits for a sign of life of this one, in s.
        stuck_s: how long a sender may be blocked before its link is closed, in s; the lease does not expire meanwhile.
            Grants limit the messages on the way, so only a process that is stopped blocks. Nodes wait for each other;
            the master closes the link of a tool that is stopped.
        waits: whether opening the session waits, half a second at most, for the processes that it connects to.
        timestamps: whether samples have timestamps; Zenoh keeps samples for who subscribes later only with them.
        publishes: key expression of many publishers that are declared and undeclared without a message on a link.
        insecure: whether endpoints at a network may have no TLS, because the user says so.
        identity: the certificate that links with TLS have, and the roles of others; None: there are none.
        root: prefix and name of the mesh for which the roles count, with `*` for any.
        ends: keys beside those of the mesh that operators may read and write.
    """

    mode: str = "peer"
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    gossip: bool = False
    config: Path | None = None
    patience_s: float = 20.0
    waits: bool = True
    lease_s: float = LEASE_S
    stuck_s: float = _STUCK_S
    publishes: str | None = None
    timestamps: bool = False
    insecure: bool = False
    identity: Identity | None = None
    root: str = ""
    ends: tuple[str, ...] = ()

    @property
    def asks_itself(self) -> bool:
        """Whether it listens at addresses of which only the session knows all: a port 0, or all that a host has."""
        return not all(map(is_socket, self.listen))


def is_of_this_host(endpoint: str) -> bool:
    """Whether it is a Unix socket, or an address of an interface of this host."""
    if is_socket(endpoint):
        return True
    with suppress(OSError, UnicodeError):  # nobody knows this name, as yet, or it is none
        for family, *_, address in socket.getaddrinfo(host_of(endpoint), None, type=socket.SOCK_DGRAM):
            with suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
                probe.bind(address)  # the system refuses the addresses of others
                return True
    return False


def open_session(wiring: Wiring) -> zenoh.Session:
    """Open a session.

    Raises:
        ConfigurationError: an endpoint or the configuration file cannot be used, or an endpoint and this process do
            not take the certificate of each other.
        MeshLost: a client has found nobody who listens.
    """
    for endpoint in (*wiring.listen, *wiring.connect):
        secured, own_settings = wiring.identity is not None, wiring.config is not None
        closed = why_closed(endpoint, secured=secured, insecure=wiring.insecure, own_settings=own_settings)
        if closed is not None:
            raise ConfigurationError(closed[0], hint=f"Expected {closed[1]}.")
    if wiring.identity is not None:
        from .security.handshake import shake_hands  # noqa: PLC0415  most processes have no certificate

        is_client, patience_s = wiring.mode == "client", wiring.patience_s if wiring.waits else 0.0
        shake_hands(wiring.connect, wiring.identity, patience_s if is_client else None)
    zenoh.init_log_from_env_or(_LOG_OF_LISTENER if wiring.identity is not None and wiring.asks_itself else "error")
    try:
        return zenoh.open(_configuration(wiring))
    except zenoh.ZError as error:
        raise _cannot_open(wiring, reason_of(error)) from error


def reason_of(error: zenoh.ZError) -> str:
    """The text of an error of Zenoh, without places in Zenoh's source code."""
    return _OWN_SOURCE.sub("", str(error))


def _cannot_open(wiring: Wiring, reason: str) -> ConfigurationError | MeshLost:
    # Of TLS, the reason has the address and the port, and neither the protocol nor the name of the host.
    ends = {endpoint: f":{endpoint.rpartition(':')[2]}:" for endpoint in wiring.listen}
    endpoint = next((endpoint for endpoint, port in ends.items() if endpoint in reason or port in reason), None)
    if endpoint is None:
        if wiring.mode == "client" and reason.endswith("Timeout!"):
            text = f"nobody listens at {', '.join(wiring.connect)}"
            return MeshLost(text, hint=f"The router, or the master, had {wiring.patience_s:g} s to start.")
        endpoints = ", ".join((*wiring.listen, *wiring.connect)) or "no endpoints"
        return ConfigurationError(f"no Zenoh session can be opened ({endpoints}): {reason}")
    for words, what, hint in _CANNOT_LISTEN:
        if words in reason:
            return ConfigurationError(f"nothing can listen at {endpoint}: {what}", hint=hint)
    return ConfigurationError(f"nothing can listen at {endpoint}: {reason}")


def _configuration(wiring: Wiring) -> zenoh.Config:
    try:
        config = zenoh.Config.from_file(wiring.config) if wiring.config is not None else zenoh.Config()
    except zenoh.ZError as error:
        raise ConfigurationError(f"'{wiring.config}' is no Zenoh configuration: {reason_of(error)}") from error
    settings: dict[str, Any] = {
        "mode": wiring.mode,
        # No access to the network unless the user asks for it: no multicast, and gossip only between hosts.
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": wiring.gossip,
        "listen/endpoints": list(wiring.listen),
        "connect/endpoints": list(wiring.connect),
        # Processes start in any order: while an endpoint does not answer, connecting is repeated in the background.
        "connect/exit_on_failure": False,
        "connect/timeout_ms": -1 if wiring.mode == "peer" else round(1000 * wiring.patience_s),
        "connect/retry": {"period_init_ms": 20, "period_max_ms": 250, "period_increase_factor": 1.5},
        "listen/exit_on_failure": True,
        "open/return_conditions/connect_scouted": wiring.waits,
        "transport/link/tx/lease": round(1e3 * wiring.lease_s),
        "transport/link/tx/queue/congestion_control/block/wait_before_close": round(1e6 * wiring.stuck_s),
        # A slow subscriber must not delay other messages on its link: where a queue stays full for 5 ms, samples and
        # answers are lost until some of it is read. For each piece of a large one the time doubles, up to a limit: an
        # answer may be larger than the queue. To lose less, these queues have the largest possible size.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 5_000,
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": _LARGE_US,
        "transport/link/tx/queue/size/data_low": 16,
        "transport/link/tx/queue/size/background": 16,
        # Answers get what their question has: a queue of their own behind all other messages. An answer that
        # waits for a client that does not read would stop the link on which it came, and with it frames and progress.
        # `**` fits no key of the synchronization: their `@sync` is verbatim.
        "qos/network": [{"messages": ["query"], "key_exprs": ["**"], "overwrite": _BACKGROUND, "flows": ["ingress"]}],
        # Measured: with the implicit shared memory, Python is slower for messages of 3 kB and more.
        "transport/shared_memory/enabled": False,
        "adminspace/enabled": wiring.asks_itself,
        "aggregation/publishers": [wiring.publishes] if wiring.publishes is not None else [],
    }
    if wiring.timestamps:
        settings["timestamping/enabled"] = True
    if (own := wiring.identity) is not None:
        settings["transport/link/tls"] = {
            "root_ca_certificate": str(own.ca),
            "enable_mtls": True,
            "connect_certificate": str(own.certificate),
            "connect_private_key": str(own.key),
            "listen_certificate": str(own.certificate),
            "listen_private_key": str(own.key),
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }
    if own is not None and wiring.asks_itself:
        settings |= _rules(own, wiring, settings["qos/network"])
    elif wiring.asks_itself and json.loads(config.get_json("access_control/enabled")) is not True:
        settings["access_control"] = _ADMIN_SPACE_IS_OURS
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _rules(own: Identity, wiring: Wiring, priorities: Sequence[Any]) -> dict[str, Any]:
    """What Zenoh lets others do who come by a network: the place of all rules and limits for them."""
    from .security.rules import for_networks  # noqa: PLC0415  as above

    if own.table is None:
        text = f"'{own.name}' cannot listen: there are no roles in '{own.folder}'"
        raise ConfigurationError(text, hint="`security.roles` in the file, or roles.json in the folder, has them.")
    return for_networks(wiring.root, own.table.roles, wiring.ends, priorities)


def close_session(session: zenoh.Session) -> None:
    """Close a session without waiting long.

    If an endpoint accepts a connection without an answer, or drops all packets, Zenoh waits ten seconds for it. When a
    session is closed, nothing is left to send, and the end of the process closes what is still open.
    """
    closing = threading.Thread(target=session.close, name="close", daemon=True)
    closing.start()
    closing.join(_SESSION_END_S)


def own_endpoints(session: zenoh.Session, wiring: Wiring) -> tuple[str, ...]:
    """The endpoints on which this session listens, with the ports that the system has chosen.

    Raises:
        DeadlineExceeded: they are not known in time.
    """
    if not wiring.asks_itself:
        return wiring.listen
    answer = ask(session, Question(f"@/{session.zid()}/*", "this Zenoh session", _OWN_S))
    return tuple(str(locator) for locator in json.loads(answer).get("locators", ()))


def matches(entity: zenoh.Publisher | zenoh.Querier) -> bool:
    """Whether this publisher or querier has a receiver."""
    # The stub says bool, but it is an object that is always true (zenoh-python 1.10).
    return bool(entity.matching_status.matching)  # type: ignore[attr-defined]  # the stub is wrong


def tokens(session: zenoh.Session, key: str, timeout_s: float = _TOKENS_S) -> list[str]:
    """The keys of the liveliness tokens that match ``key``. This waits, so do not call it in a callback of Zenoh.

    A subscriber is notified that a token is gone even if another session still has a token with this key; this query is
    reliable. It is repeated if the answer is empty: a session in client mode that also has a subscriber for these
    tokens sometimes gets an empty answer (1 of 30 with zenoh 1.10.2, 1 of 4 while the subscriber is new).
    """
    for _ in range(_TOKENS_TRIES):
        replies = session.liveliness().get(key, timeout=timeout_s)
        if found := [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]:
            return found
    return []


def undeclare_all(*entities: Iterable[Any]) -> None:
    """Undeclare publishers, subscribers, queryables and listeners."""
    for entity in chain.from_iterable(entities):
        entity.undeclare()


class Question(msgspec.Struct, frozen=True):
    """A query that waits ``deadline_s`` seconds for its answer; an error names ``whom`` it was for.

    It overtakes messages of a lower ``priority``, and follows earlier ones of the same. It is sent ``once`` where its
    repetition would have an effect: then the loss of the answer ends in the deadline. Who asks such questions again and
    again declares their ``key`` (`zenoh.Session.declare_keyexpr`), because each of them needs its number (ADR 77).
    """

    key: str | zenoh.KeyExpr
    whom: str
    deadline_s: float
    payload: bytes | None = None
    attachment: bytes | None = None
    priority: zenoh.Priority = zenoh.Priority.DEFAULT
    once: bool = False


def ask(session: zenoh.Session, question: Question, over: Callable[[], bool] = lambda: False) -> bytes:
    """The payload of the first answer to a question; otherwise as `answers`."""
    return answers(session, question, over, every=False)[0].payload.to_bytes()


def answers(
    session: zenoh.Session, question: Question, over: Callable[[], bool] = lambda: False, *, every: bool = True
) -> list[zenoh.Sample]:
    """Query until a queryable answers; return at least one answer.

    A query that is sent before the queryable is known gets no reply. So then this waits until a queryable matches, and
    repeats the query when the matching changes. Only this wait declares something.

    ``over`` says whether the answer is not needed any more. With ``every`` this waits for the end of the query; without
    it, the first answer is enough.

    Raises:
        DeadlineExceeded: there was no answer in time.
        MeshLost: the answer was an error, whose text is the message; or the answer is not needed any more.
    """
    end = time.monotonic() + question.deadline_s
    changed, sent = threading.Event(), False

    def asked(get: Callable[..., object]) -> list[zenoh.Sample]:
        # Zenoh does not report that the process of the queryable is gone: it would wait for the timeout.
        replies: queue.SimpleQueue[zenoh.Reply | None] = queue.SimpleQueue()
        encoding = json_encoding if question.payload is not None else None
        handler = Callback(replies.put, partial(replies.put, None))
        get(handler, payload=question.payload, encoding=encoding, attachment=question.attachment)
        return _collected(replies, over, every=every)

    get = partial(session.get, question.key, timeout=question.deadline_s, priority=question.priority)
    if not question.once and (samples := asked(get)):
        return samples
    with session.declare_querier(question.key, timeout=question.deadline_s, priority=question.priority) as querier:
        listener = querier.declare_matching_listener(lambda _status: changed.set())
        try:
            while (left := end - time.monotonic()) > 0:
                changed.clear()
                if matches(querier) and not (sent and question.once):
                    sent = True
                    if samples := asked(querier.get):
                        return samples
                if over():
                    raise MeshLost(f"{question.whom} has not answered yet, and this process does not wait any more")
                changed.wait(min(left, _look_s(end - question.deadline_s)))
        finally:
            listener.undeclare()
    raise DeadlineExceeded(f"{question.whom} did not answer within {question.deadline_s:g} s")


def answer_of(reply: zenoh.Reply) -> zenoh.Sample | None:
    """The payload of a reply; None if it is Zenoh's own message that a queryable did not answer in time.

    Raises:
        MeshLost: the answer is an error; its text is the message.
    """
    if reply.ok is not None:
        return reply.ok
    text = reply.err.payload.to_bytes().decode(errors="replace") if reply.err else ""
    if text != _TIMEOUT:
        raise MeshLost(text)
    return None


def _collected(
    replies: queue.SimpleQueue[zenoh.Reply | None], over: Callable[[], bool], *, every: bool
) -> list[zenoh.Sample]:
    """The answers of one query up to its end, which None marks, or only the first one."""
    samples: list[zenoh.Sample] = []
    began = time.monotonic()
    while every or not samples:
        try:
            reply = replies.get(timeout=_look_s(began))
        except queue.Empty:  # only then: an answer may come just before the end, as that to `stop`
            try:
                if over():
                    break
            except MeshLost:
                if replies.empty():  # it may have come while this was found out
                    raise
            continue
        if reply is None:
            break
        if (sample := answer_of(reply)) is not None:
            samples.append(sample)
    return samples


def _look_s(began: float) -> float:
    """How long a question that was asked then waits until it looks whether its answer is needed, in s."""
    return min(max(_OVER_CHECK_S, _OVER_SHARE * (time.monotonic() - began)), _OVER_LONGEST_S)


@contextmanager
def run_router(wiring: Wiring) -> Iterator[tuple[str, ...]]:
    """Run a Zenoh router in this process, for a host without `zenohd`; yields the endpoints on which it listens.

    Raises:
        ConfigurationError: an endpoint cannot be used.
    """
    # Peers that connect to it, such as ROS nodes, find each other here and connect directly; it does not route.
    wiring = replace(wiring, mode="router", gossip=True, stuck_s=LEASE_S)
    session = open_session(wiring)
    try:
        yield own_endpoints(session, wiring)
    finally:
        session.close()
