"""The link of a gateway to ROS: its session and profiles, whether a bridge or router is there, who else has `/clock`.

Owns a thread that watches the link, warns of each change once, and keeps the answer to `…/mesh/ros`. Nothing waits for
this thread. A router does not pass tokens on between peers. So where the gateway is a peer, a second session, a client,
is opened as soon as the router answers, to see the tokens of others.
"""

# Threads: `ros-link` looks at the link four times a second and writes `_view`; Zenoh calls `_token_changed` and
# `_answer` on threads of its own, which take the lock of the tokens, read `_view`, and ask publishers of the other
# session whether they match: only then is it looked at each topic. Nobody waits for `ros-link` but
# `close`, at most 3 s: to open a session may take long where nobody answers (ADR 0030).

from __future__ import annotations

import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import msgspec
import zenoh
from msgspec.structs import replace

from ...config.mesh import RosConfig
from ...errors import FmuMeshError
from ...ros_wire.profile import Ros2Dds, ZenohProfile, topic_in
from ...ros_wire.rmw_zenoh import RmwZenoh
from ...ros_wire.topics import RosPlan
from ...wire.keys import Keys, escape, unescape
from ...wire.session import Wiring, close_session, is_of_this_host, open_session, undeclare_all
from ...wire.values import json_encoding
from ...wire.views import RosView
from .deadline import Deadline
from .parameter_services import ParameterServices
from .simulation_services import SimulationServices

__all__ = ["RosLink", "open_profiles", "open_ros", "two_clocks"]

log = logging.getLogger(__name__)

_INTERVAL_S = 0.25
_PATIENCE_S = 3.0
_OPEN_S = 1.0
_OWN_S = 20.0
"""How long it may take to reach another session of this process."""
# Longer than one look at the link, which may wait for a bridge that does not answer.
_WATCH_END_S = 3.0
_MAX_WARNINGS = 20

_BRIDGES = "@/*/@ros2_lv"
_BRIDGED = "@/*/@ros2_lv/MP/**"
_CLOCK_TOPICS = (("clock",), ("%clock",))
_GATEWAYS = "@/*/@fmu_mesh/*/*/*"

_WHO = {"ros2dds": ("the bridge", "zenoh-bridge-ros2dds"), "rmw_zenoh": ("the router", "rmw_zenohd")}


def open_ros(section: RosConfig, folder: Path) -> tuple[bool, zenoh.Session]:
    """Whether the gateway is a peer in the network of ROS, and its session there; ``folder`` is that of the run.

    A router of ROS introduces peers to each other, and forwards nothing between them. On one host, nodes have ports to
    which this process connects, so it is a peer, which is faster (a port of its own would be open to every user). Those
    of another host cannot be reached like this, and their router forwards to clients. A client has one link, to the
    first endpoint that answers. So with several bridges the gateway stays a peer: topics end there, in DDS.
    """
    endpoints = tuple(section.connect)
    are_bridges = section.profile == "ros2dds" and len(endpoints) > 1
    if section.listen or are_bridges or all(map(is_of_this_host, endpoints)):
        return True, open_session(
            Wiring(listen=tuple(section.listen), connect=endpoints, gossip=True, timestamps=True, insecure=True)
        )
    client = Wiring(mode="client", connect=endpoints, patience_s=_OPEN_S, timestamps=True, insecure=True)
    try:
        return False, open_session(client)
    except FmuMeshError:  # nobody answers, which `RosLink` reports
        # Zenoh opens no client without a router, but a client that loses its router connects again to any endpoint.
        at = f"unixsock-stream/{folder}/ros.sock"
        router = open_session(Wiring(mode="router", listen=(at,)))
        session = open_session(replace(client, connect=(at, *endpoints), patience_s=_OWN_S))
        router.close()
        return False, session


@contextmanager
def open_profiles(  # noqa: PLR0913, PLR0917  one gateway and its surroundings
    section: RosConfig, ros: zenoh.Session, plan: RosPlan, mesh: zenoh.Session, keys: Keys, settle: Callable[[], None]
) -> Iterator[dict[str, ZenohProfile]]:
    """Open the profiles of a plan by name, that of the section first, and with rmw_zenoh the services.

    ``settle`` waits until the mesh has all values that came before.
    """
    profiles: dict[str, ZenohProfile] = {}
    with ExitStack() as stack:
        for name in dict.fromkeys((section.profile, *(topic.profile for topic in plan.topics))):
            profile = RmwZenoh(ros, plan, section.domain) if name == "rmw_zenoh" else Ros2Dds(ros, plan.types)
            profiles[name] = profile
            stack.callback(profile.close)
            if isinstance(profile, RmwZenoh):
                stack.enter_context(ParameterServices(plan, mesh, keys).served_by(profile))
                if section.interfaces is not None:
                    services = SimulationServices(section.interfaces, plan.types, mesh, keys, settle)
                    stack.enter_context(services.served_by(profile, plan.namespace))
        yield profiles


def two_clocks(other: str, setting: str) -> str:
    """The warning that ``other`` publishes `/clock` as well; ``setting`` stops this process from publishing it."""
    return (
        f"{other} publishes /clock, too, so the time of nodes with use_sim_time jumps between the two. "
        f"Let only one of them publish it (here: {setting}), or keep them in different ROS domains."
    )


class RosLink:
    """Watches the link of one gateway. Call `open` first and `close` last. The caller closes both sessions."""

    def __init__(  # noqa: PLR0913  one gateway and its surroundings
        self,
        section: RosConfig,
        ros: zenoh.Session,
        mesh: zenoh.Session,
        keys: Keys,
        profiles: Mapping[str, ZenohProfile],
        *,
        clock: bool,
        as_peer: bool,
    ) -> None:
        self._section = section
        self._profiles = profiles
        self._as_peer = as_peer
        self._ros = ros
        self._mesh = mesh
        self._keys = keys
        self._clock = clock
        self._who, self._program = _WHO[section.profile]
        self._where = ", ".join(section.connect or section.listen)
        self._over = threading.Event()
        self._changed = threading.Lock()
        self._tokens: set[str] = set()
        self._client: zenoh.Session | None = None
        self._watches_tokens = False
        self._entities: list[zenoh.LivelinessToken | zenoh.Subscriber[None] | zenoh.Queryable[None]] = []
        self._since = time.monotonic()
        self._was_linked = False
        self._warned_absence = self._warned_bridge = False
        self._warned_clocks: set[str] = set()
        self._warnings = 0
        self._view = self._seen(linked=False, clocks=())
        self._thread = threading.Thread(target=self._run, name="ros-link", daemon=True)

    def open(self, ignored: Mapping[str, int], deadlines: Sequence[Deadline]) -> None:
        """Declare the token of this gateway, answer queries about the link and these two, and start to watch it."""
        chunks = map(escape, (self._keys.mesh, socket.gethostname(), str(os.getpid())))
        token = f"@/{self._ros.zid()}/@fmu_mesh/{'/'.join(chunks)}"
        self._entities.append(self._ros.liveliness().declare_token(token))
        # Each gateway answers with its own key: a query returns only the last of several answers with one key.
        key = f"{self._keys.mesh_key('ros')}/{self._ros.zid()}"
        self._entities.append(
            self._mesh.declare_queryable(key, lambda query: self._answer(key, query, ignored, deadlines))
        )
        self._thread.start()

    def close(self) -> None:
        """Stop watching. If there never was a link, warn now at the latest."""
        self._over.set()
        self._thread.join(_WATCH_END_S)
        if not self._was_linked and not self._warned_absence and not self._linked():
            self._warn(f"{self._view.activity}, so ROS got nothing of mesh '{self._keys.mesh}'. {self._hint}")
        undeclare_all(self._entities)
        if self._client is not None:
            close_session(self._client)

    def _answer(self, key: str, query: zenoh.Query, ignored: Mapping[str, int], deadlines: Sequence[Deadline]) -> None:
        with self._changed:
            tokens = sorted(self._tokens)
        others = [token for token in tokens if "/MP/" in token and f"/{self._ros.zid()}/" not in token]
        topics = tuple(topic for profile in self._profiles.values() for topic in profile.topics(others))
        missed = {own.topic: own.missed for own in deadlines if own.missed}
        view = replace(self._view, topics=topics, ignored=dict(ignored), missed=missed)
        query.reply(key, msgspec.json.encode(view), encoding=json_encoding)
        query.drop()

    # --- on the thread

    def _run(self) -> None:
        linked = False
        while True:
            was, linked = linked, self._linked()
            if linked != was:
                self._since = time.monotonic()
            if linked and not self._watches_tokens:
                self._watch_tokens()
            clocks = self._other_clocks() if linked else ()
            self._view = self._seen(linked=linked, clocks=clocks)
            self._warn_of_link(linked=linked)
            for other in sorted({*clocks} - self._warned_clocks):
                self._warned_clocks.add(other)
                self._warn(two_clocks(other, "`clock_rate: null` in the section `ros`"))
            self._was_linked = self._was_linked or linked
            if self._over.wait(_INTERVAL_S):
                return

    def _linked(self) -> bool:
        return any(True for zids in (self._ros.info.routers_zid(), self._ros.info.peers_zid()) for _ in zids)

    def _watch_tokens(self) -> None:
        session = self._ros  # sees all tokens as a client, or if others connect to this gateway directly
        if self._as_peer and self._section.connect:
            try:
                wiring = Wiring("client", connect=tuple(self._section.connect), patience_s=_OPEN_S, insecure=True)
                session = self._client = open_session(wiring)
            except FmuMeshError:  # the link is lost again, which the next look reports
                return
        self._watches_tokens = True
        # In this order, the name of a gateway arrives before the topics that it publishes.
        for key in (_GATEWAYS, _BRIDGES, _BRIDGED, f"@ros2_lv/{self._section.domain}/*/*/*/MP/**"):
            self._entities.append(session.liveliness().declare_subscriber(key, self._token_changed, history=True))

    def _token_changed(self, sample: zenoh.Sample) -> None:
        with self._changed:
            if sample.kind == zenoh.SampleKind.PUT:
                self._tokens.add(str(sample.key_expr))
            else:
                self._tokens.discard(str(sample.key_expr))

    def _warn_of_link(self, *, linked: bool) -> None:
        name = self._keys.mesh
        late = time.monotonic() - self._since > _PATIENCE_S
        if linked and self._lacks_bridge():
            if late and not self._warned_bridge:
                self._warned_bridge = True
                nothing = f"so ROS on DDS gets nothing of mesh '{name}', which runs on"
                self._warn(f"{self._view.activity}, {nothing}. {self._hint}")
        elif linked and (self._warned_absence or self._warned_bridge):
            self._warned_absence = self._warned_bridge = False
            self._warn(f"{self._view.activity}; ROS gets mesh '{name}' from now on")
        elif not linked and not self._warned_absence and (self._was_linked or late):
            self._warned_absence = True
            what = f"the link to {self._where} was lost" if self._was_linked else self._view.activity
            nothing = f"so ROS gets nothing of mesh '{name}', which runs on"
            self._warn(f"{what}, {nothing}. {self._hint} The gateway keeps trying.")

    def _warn(self, text: str) -> None:
        self._warnings += 1
        if self._warnings <= _MAX_WARNINGS:  # a link that comes and goes would fill the log
            log.warning("%s", text)

    # --- what the tokens say

    def _seen(self, *, linked: bool, clocks: tuple[str, ...]) -> RosView:
        if not linked:
            nobody = "nobody answers at" if self._section.connect else "nobody has connected to"
            activity = f"{nobody} {self._where}"
        elif self._lacks_bridge():
            activity = f"connected at {self._where}, but no bridge to DDS is there"
        else:
            activity = f"connected to {self._who} at {self._where}"
        endpoints = (*self._section.connect, *self._section.listen)
        return RosView(self._section.profile, endpoints, linked, activity, clocks)

    @property
    def _hint(self) -> str:
        if self._section.connect:
            return f"Start {self._who} there ({self._program}), or say in `ros.connect` where it is."
        return f"Let {self._who} ({self._program}) connect there, or say in `ros.connect` where it is."

    def _lacks_bridge(self) -> bool:
        with self._changed:
            return self._section.profile == "ros2dds" and not any(key.endswith("/@ros2_lv") for key in self._tokens)

    def _other_clocks(self) -> tuple[str, ...]:
        """Who else publishes `/clock`, in words; empty if this gateway does not publish it."""
        if not self._clock:
            return ()
        with self._changed:
            keys = sorted(self._tokens)
        names = {key.split("/")[1]: key.split("/")[3:] for key in keys if "/@fmu_mesh/" in key}
        clocks = [key.split("/") for key in keys if "/MP/" in key and topic_in(key)[:1] in _CLOCK_TOPICS]
        own = str(self._ros.zid())
        return tuple(
            _described(chunks, names.get(zid))
            for chunks in clocks
            if (zid := chunks[1 if _is_bridged(chunks) else 2]) != own
        )


def _is_bridged(chunks: Sequence[str]) -> bool:
    """Whether a token is that of a bridge; otherwise it is that of rmw_zenoh."""
    return chunks[0] == "@"


def _described(chunks: Sequence[str], gateway: Sequence[str] | None) -> str:
    """Who declared a token, in words; ``gateway`` is its mesh, host and process if it is a gateway."""
    if gateway is not None:
        mesh, host, pid = map(unescape, gateway)
        return f"mesh '{mesh}' (gateway process {pid} on {host})"
    if _is_bridged(chunks):
        return f"a ROS node behind the bridge {chunks[1]}"
    namespace, node = chunks[7].replace("%", "/").rstrip("/"), chunks[8]
    return f"the node '{namespace}/{node}'"
