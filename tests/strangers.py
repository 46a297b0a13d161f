"""What a program that belongs to no node sends into a mesh: one list of attacks, for whoever comes, by whatever way.

Each attack is a function of a `Stranger`. Whether it is refused, or does not arrive at all, is for the tests to say.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import msgspec
import zenoh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fmu_mesh.errors import ErrorReport
from fmu_mesh.run.options import PlanOptions
from fmu_mesh.wire.keys import Keys, RunKeys
from fmu_mesh.wire.messages import ABORT, FINISH, FRAME, GRANT, HEADER, LAST, PROGRESS, NodeReport
from tests.helpers import DEADLINE_S, Place, write_config
from tests.plain_run import PlainRun
from tests.planning import prepare

__all__ = [
    "ATTACKS",
    "FAR",
    "FORGERIES",
    "NODES",
    "Attack",
    "Stranger",
    "abort",
    "any_bytes",
    "config_of",
    "few_wrong_rows",
    "finish",
    "grant",
    "local_result",
    "malformed",
    "many_declarations",
    "other_keys",
    "progress",
    "reports",
    "too_many_rows",
]

FAR = 2**62
NODES: Final = ("left", "right", "free", "@record")
_POINTS: Final = (0, 100, 500, 1500, 2000)


class _Asked(NamedTuple):
    """A query that a stranger has sent, and the texts of the refusals that it got."""

    key: str
    refusals: list[str]
    answered: bool


class Stranger:
    """A plain session in the one mesh that runs here.

    Attributes:
        keys: the internal keys of the run, which any client of the same user can find out.
        asked: all that it has asked.
        sent: keys and payloads that it has put.
        patience_s: how long it waits for an answer, in s.
    """

    def __init__(
        self, session: zenoh.Session, mesh: str, run: str | None = None, patience_s: float = DEADLINE_S
    ) -> None:
        self.session = session
        self.patience_s = patience_s
        self.public = Keys("fmu_mesh", mesh)
        self.asked: list[_Asked] = []
        self.sent: set[tuple[str, bytes]] = set()
        if run is None:
            found = session.liveliness().get(self.public.run("*").master, timeout=DEADLINE_S)
            [token] = [str(reply.ok.key_expr) for reply in found if reply.ok is not None]
            run = token.split("/")[-2]
        self.keys = RunKeys(self.public.root, run)

    def put(self, key: str, payload: bytes, attachment: bytes | None = None) -> None:
        """Publish, and wait where queues are full: what is sent must not be lost on the way."""
        self.sent.add((key, payload))
        self.session.put(key, payload, attachment=attachment, congestion_control=zenoh.CongestionControl.BLOCK)

    def ask(self, key: str, payload: bytes | None = None) -> list[str]:
        """The texts of the refusals that a query gets."""
        replies = list(self.session.get(key, payload=payload, timeout=self.patience_s))
        refusals = [reply.err.payload.to_bytes().decode() for reply in replies if reply.err is not None]
        self.asked.append(_Asked(key, refusals, answered=any(reply.ok is not None for reply in replies)))
        return refusals

    def refused(self) -> int:
        """How many messages the processes of the mesh have refused."""
        replies = self.session.get(f"{self.public.root}/*/status", timeout=DEADLINE_S)
        return sum(int(json.loads(reply.ok.payload.to_bytes())["refused"]) for reply in replies if reply.ok is not None)


Attack = Callable[[Stranger], None]


def config_of(
    place: Place,
    *,
    shared_memory: bool,
    stop_time: float = 2.0,
    real_time_factor: float = 0.0,
    more: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
) -> Path:
    """A cycle with a free input: frames go both ways, and something can be set; with ``more`` sections."""
    ways = {"shared_memory": shared_memory, "row_streams": False}
    sections: dict[str, Any] = {**more, "zenoh": {**ways, **more.get("zenoh", {})}}
    return write_config(
        place.folder,
        instances={
            "left": {"fmu": "Gain", "start_values": {"k": 0.9}},
            "right": {"fmu": "TransportDelay", "start_values": {"d": 0.01}},
            "free": {"fmu": "Gain"},
        },
        connections=("left.y -> right.x", "right.y -> left.u"),
        stop_time=stop_time,
        simulation={"window": 256, "real_time_factor": real_time_factor},
        **sections,
    )


def local_result(place: Place, config: Path) -> bytes:
    """The result file of a single process."""
    output = place.folder / "local.csv"
    PlainRun(prepare(config, PlanOptions(output=output))).run()
    return output.read_bytes()


# ---- what is malformed, or comes by another key than exactly the expected one; each question is refused


def malformed(stranger: Stranger) -> None:
    public, keys = stranger.public, stranger.keys
    stranger.ask(f"{public.root}/@sync/**")
    stranger.ask(public.mesh_key("command"), b'{"command":"\xff"}')
    stranger.ask(public.mesh_key("command"), b'{"command":"step","points":1' + b"0" * 400 + b"}")
    for key in (public.register, keys.ready("left"), keys.report("left"), keys.report("@record"), keys.hello("left")):
        for payload in (b"", b"\xff", b"{}", b"[" * 3000, b'{"node":"left"}'):
            stranger.ask(key, payload)
    stranger.put(public.setting("free", "u"), b"1.0", b'{"time":"soon"}')
    stranger.put(f"{public.root}/left/log", b'{"instance":"\xff"}')
    stranger.put(f"{public.root}/left/log", b"\xff" * 100)
    headers = HEADER.pack(FRAME, 99, 1, 0), HEADER.pack(77, 0, 0, 0)
    for key in (keys.frames("left", "right"), keys.frames("right", "@record"), keys.progress("left")):
        for payload in (b"", b"\x01", bytes(HEADER.size - 1), *headers):
            stranger.put(key, payload)
        stranger.session.delete(key)


def other_keys(stranger: Stranger) -> None:
    """What is right in every respect but its key."""
    root, keys = stranger.public.root, stranger.keys
    error = ErrorReport("StepFailed", "a lie", 3, instance="left", point=0)
    for kind in (GRANT, FINISH, ABORT, PROGRESS, LAST):
        for node in ("left", "right", "@record", "@mesh"):
            message = HEADER.pack(kind, 0, 0, FAR) + (msgspec.json.encode(error) if kind == ABORT else b"")
            for key in (f"{root}/@sync/*/**/to={node}", f"{root}/@sync/{keys.run}/x/to={node}"):
                stranger.put(key, message)
    for report in (NodeReport("left", 0), NodeReport("left", 0, error)):
        stranger.ask(f"{root}/@sync/*/report/of=left", msgspec.json.encode(report))
        stranger.ask(f"{root}/@sync/**", msgspec.json.encode(report))
    stranger.ask(f"{root}/@sync/*/report/of=nobody", msgspec.json.encode(NodeReport("nobody", 0)))
    # Whose token a stranger takes back is there all the same; that of the recorder is in the session that looks.
    for key in (keys.node("left"), keys.node("@record"), keys.master):
        stranger.session.liveliness().declare_token(key).undeclare()


def reports(stranger: Stranger) -> None:
    """That a node has ended, in the past, now, and beyond what is granted."""
    for point in _POINTS:
        for kind in ("TerminationRequested", "NotFinite", "StepFailed", "MeshLost"):
            error = ErrorReport(kind, "that is all", 3, instance="left", point=point, time=point / 1000)
            for report in (NodeReport("left", point, error), NodeReport("left", point)):
                stranger.ask(stranger.keys.report("left"), msgspec.json.encode(report))
    stranger.ask(stranger.keys.report("@record"), msgspec.json.encode(NodeReport("@record", 100)))


# ---- what is not answered


def _known_keys(stranger: Stranger) -> list[str]:
    """Every key of the mesh that means something to one of its processes."""
    public, keys = stranger.public, stranger.keys
    nodes = [*NODES, "@mesh", "nobody"]
    of_nodes = [key(node) for key in (keys.node, keys.ready, keys.report, keys.hello, keys.progress) for node in nodes]
    frames = [keys.frames(source, target) for source in ("left", "right") for target in nodes]
    views = [public.mesh_key(what) for what in ("info", "status", "plan", "command")]
    of_left = [
        f"{public.root}/left/{what}"
        for what in ("info", "status", "log", "out/y", "set/u", "set/k", "set", "in/u", "param/k")
    ]
    return [public.register, keys.master, *of_nodes, *frames, *keys.grants(nodes).values(), *views, *of_left]


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
).map(lambda value: json.dumps(value).encode())
_HEADERS = st.builds(
    lambda kind, link, count, point, rest: HEADER.pack(kind, link, count, point) + rest,
    st.integers(9, 255),  # what is right in every respect is for access control
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**32 - 1),
    st.integers(-(2**63), 2**63 - 1),
    st.binary(max_size=64),
)
_PAYLOADS = st.none() | st.binary(max_size=HEADER.size - 1) | _JSON | _HEADERS | st.just(b"[" * 5000)
_WILDCARDS = st.sampled_from(["@sync/**", "@sync/*/**", "**", "*/*", "*/**", "@sync/*/report/**", "@sync/*/frame/**"])


def any_bytes(stranger: Stranger) -> None:
    """Any bytes on any key."""
    known = st.sampled_from(_known_keys(stranger))
    wild = _WILDCARDS.map(lambda rest: f"{stranger.public.root}/{rest}")
    run = f"/{stranger.keys.run}/"
    of_any_run = known.map(lambda key: key.replace(run, "/*/"))

    @settings(max_examples=400, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(known | wild | of_any_run, _PAYLOADS, st.none() | st.binary(max_size=40) | _JSON, st.booleans())
    def send(key: str, payload: bytes | None, attachment: bytes | None, asks: bool) -> None:  # noqa: FBT001  hypothesis draws it
        if asks:
            list(stranger.session.get(key, payload=payload, attachment=attachment, timeout=stranger.patience_s))
        elif payload is None:
            stranger.session.delete(key)
        elif not key.endswith(("in/u", "param/k", "set/k")):  # a value that fits is rightly taken
            stranger.put(key, payload, attachment)

    send()


def many_declarations(stranger: Stranger) -> None:
    """Subscribers and tokens."""
    root, keys, session = stranger.public.root, stranger.keys, stranger.session
    for key in (f"{root}/**", f"{root}/left/out/y", f"{keys.base}/**", f"{root}/mesh/log"):
        for _ in range(500):
            session.declare_subscriber(key, zenoh.handlers.RingChannel(1))
    for number in range(500):
        session.liveliness().declare_token(f"{root}/x{number}")
        session.liveliness().declare_token(keys.node("left")).undeclare()
        session.liveliness().declare_token(keys.node(f"x{number}"))


# ---- what is right in every respect: as a peer sends it


def grant(stranger: Stranger) -> None:
    for key in {*stranger.keys.grants(NODES).values()}:
        stranger.put(key, HEADER.pack(GRANT, 0, 0, FAR))


def progress(stranger: Stranger) -> None:
    for node in NODES:
        stranger.put(stranger.keys.progress(node), HEADER.pack(PROGRESS, 0, 0, 2000))


def finish(stranger: Stranger) -> None:
    for key in {*stranger.keys.grants(NODES).values()}:
        stranger.put(key, HEADER.pack(FINISH, 0, 0, 0))


def abort(stranger: Stranger) -> None:
    error = ErrorReport("StepFailed", "a lie", 3, instance="left", point=0)
    for key in {*stranger.keys.grants(NODES).values()}:
        stranger.put(key, HEADER.pack(ABORT, 0, 0, 0) + msgspec.json.encode(error))


def too_many_rows(stranger: Stranger) -> None:
    rows = 1 << 20  # more than its ring has
    for index in range(5):
        stranger.put(stranger.keys.frames("left", "right"), HEADER.pack(FRAME, index, rows, 0) + bytes(8 * rows))


def few_wrong_rows(stranger: Stranger) -> None:
    for index in range(5):
        message = HEADER.pack(FRAME, index, 2, 0) + b"\x3f" * 16
        stranger.put(stranger.keys.frames("left", "right"), message)


FORGERIES: Final[Sequence[Attack]] = (grant, progress, finish, abort, too_many_rows, few_wrong_rows)
ATTACKS: Final[Sequence[Attack]] = (malformed, other_keys, reports, any_bytes, many_declarations, *FORGERIES)
"""None of them has an effect if who comes has no role, or one that may not do it."""
