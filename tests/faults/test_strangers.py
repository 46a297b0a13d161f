"""What a program that belongs to no node sends: it changes no number and ends no run (design, invariant 7).

The stranger is a plain Zenoh client of the same user. What it cannot be kept from without access control is a message
that is right in every respect; what a registered peer may not send ends the run with the names of both ends.
"""

from __future__ import annotations

import fcntl
import json
import mmap
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np
import pytest
import yaml
import zenoh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fmu_mesh.errors import ErrorReport
from fmu_mesh.rings.host_memory import can_share
from fmu_mesh.rings.native import NEVER
from fmu_mesh.rings.ring import Ring
from fmu_mesh.run.options import PlanOptions
from fmu_mesh.wire.keys import Keys, RunKeys
from fmu_mesh.wire.messages import ABORT, FINISH, FRAME, GRANT, HEADER, LAST, PROGRESS, NodeReport
from tests.helpers import DEADLINE_S, Launched, Place, row_count, rows_of, wait_until, write_config
from tests.plain_run import PlainRun
from tests.planning import prepare

WAYS = pytest.mark.parametrize("shared_memory", [True, False], ids=["shared memory", "Zenoh"])
needs_memory = pytest.mark.skipif(not can_share(), reason="needs Linux with memfd_create, and the library")
FAR = 2**62


class Stranger:
    """A plain client in the one mesh that runs here.

    Attributes:
        keys: the internal keys of the run, which any client can find out.
    """

    def __init__(self, session: zenoh.Session, mesh: str) -> None:
        self.session = session
        self.public = Keys("fmu_mesh", mesh)
        found = session.liveliness().get(self.public.run("*").master, timeout=DEADLINE_S)
        [token] = [str(reply.ok.key_expr) for reply in found if reply.ok is not None]
        self.keys = RunKeys(self.public.root, token.split("/")[-2])

    def put(self, key: str, payload: bytes, attachment: bytes | None = None) -> None:
        """Publish, and wait where queues are full: what is sent must not be lost on the way."""
        self.session.put(key, payload, attachment=attachment, congestion_control=zenoh.CongestionControl.BLOCK)

    def ask(self, key: str, payload: bytes | None = None) -> list[str]:
        """The texts of the refusals that a query gets."""
        replies = self.session.get(key, payload=payload, timeout=DEADLINE_S)
        return [reply.err.payload.to_bytes().decode() for reply in replies if reply.err is not None]

    def refused(self) -> int:
        """How many messages the processes of the mesh have refused."""
        replies = self.session.get(f"{self.public.root}/*/status", timeout=DEADLINE_S)
        return sum(int(json.loads(reply.ok.payload.to_bytes())["refused"]) for reply in replies if reply.ok is not None)


def config_of(place: Place, *, shared_memory: bool, stop_time: float = 2.0, **simulation: float) -> Path:
    """A cycle with a free input: frames go both ways, and something can be set."""
    return write_config(
        place.folder,
        instances={
            "left": {"fmu": "Gain", "start_values": {"k": 0.9}},
            "right": {"fmu": "TransportDelay", "start_values": {"d": 0.01}},
            "free": {"fmu": "Gain"},
        },
        connections=("left.y -> right.x", "right.y -> left.u"),
        stop_time=stop_time,
        simulation={"window": 256, **simulation},
        zenoh={"shared_memory": shared_memory, "row_streams": False},
    )


def local_result(place: Place, config: Path) -> bytes:
    output = place.folder / "local.csv"
    PlainRun(prepare(config, PlanOptions(output=output))).run()
    return output.read_bytes()


@contextmanager
def paused(place: Place, config: Path) -> Iterator[tuple[Launched, Stranger]]:
    """A mesh at rest at its first point, and a stranger in it."""
    launched = place.start("launch", config, "--paused", "--no-progress")
    with place.session() as session:
        wait_until(lambda: place.run("status", "pair", "--json").output.count("paused"), "a mesh at rest")
        yield launched, Stranger(session, "pair")


def assert_unharmed(place: Place, config: Path, launched: Launched) -> None:
    """The run goes on to its end, and its result is that of a single process."""
    assert launched.running, launched.story()
    assert place.run("resume", "pair").wait() == 0
    assert launched.wait() == 0, launched.story()
    assert "Traceback" not in launched.errors
    assert config.with_suffix(".csv").read_bytes() == local_result(place, config)
    place.assert_nothing_left()


# ---- what is malformed, or comes by another key than exactly the expected one


@WAYS
def test_the_messages_that_once_ended_run_are_refused_and_it_goes_on(place: Place, *, shared_memory: bool) -> None:
    config = config_of(place, shared_memory=shared_memory)
    with paused(place, config) as (launched, stranger):
        public, keys = stranger.public, stranger.keys

        assert stranger.ask(f"{public.root}/@sync/**")
        assert stranger.ask(public.mesh_key("command"), b'{"command":"\xff"}')
        assert stranger.ask(public.mesh_key("command"), b'{"command":"step","points":1' + b"0" * 400 + b"}")
        for key in (
            public.register,
            keys.ready("left"),
            keys.report("left"),
            keys.report("@record"),
            keys.hello("left"),
        ):
            for payload in (b"", b"\xff", b"{}", b"[" * 3000, b'{"node":"left"}'):
                assert stranger.ask(key, payload), key
        stranger.put(public.setting("free", "u"), b"1.0", b'{"time":"soon"}')
        stranger.put(f"{public.root}/left/log", b'{"instance":"\xff"}')
        stranger.put(f"{public.root}/left/log", b"\xff" * 100)
        for key in (keys.frames("left", "right"), keys.frames("right", "@record"), keys.progress("left")):
            for payload in (
                b"",
                b"\x01",
                bytes(HEADER.size - 1),
                HEADER.pack(FRAME, 99, 1, 0),
                HEADER.pack(77, 0, 0, 0),
            ):
                stranger.put(key, payload)
            stranger.session.delete(key)

        wait_until(lambda: stranger.refused() >= 40, "refused messages")
        assert "was refused" in launched.errors
    assert_unharmed(place, config, launched)


def keys_of(stranger: Stranger) -> list[str]:
    """Every key of the mesh that means something to one of its processes."""
    public, keys = stranger.public, stranger.keys
    nodes = ["left", "right", "free", "@record", "@mesh", "nobody"]
    of_nodes = [key(node) for key in (keys.node, keys.ready, keys.report, keys.hello, keys.progress) for node in nodes]
    frames = [keys.frames(source, target) for source in ("left", "right") for target in nodes]
    views = [public.mesh_key(what) for what in ("info", "status", "plan", "command")]
    of_left = [
        f"{public.root}/left/{what}"
        for what in ("info", "status", "log", "out/y", "set/u", "set/k", "set", "in/u", "param/k")
    ]
    return [public.register, keys.master, *of_nodes, *frames, *keys.grants(nodes).values(), *views, *of_left]


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
).map(lambda value: json.dumps(value).encode())
HEADERS = st.builds(
    lambda kind, link, count, point, rest: HEADER.pack(kind, link, count, point) + rest,
    st.integers(9, 255),  # what is right in every respect is for access control
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**32 - 1),
    st.integers(-(2**63), 2**63 - 1),
    st.binary(max_size=64),
)
PAYLOADS = st.none() | st.binary(max_size=HEADER.size - 1) | JSON | HEADERS | st.just(b"[" * 5000)
WILDCARDS = st.sampled_from(["@sync/**", "@sync/*/**", "**", "*/*", "*/**", "@sync/*/report/**", "@sync/*/frame/**"])


@WAYS
def test_no_bytes_on_any_key_do_harm(place: Place, *, shared_memory: bool) -> None:
    config = config_of(place, shared_memory=shared_memory)
    with paused(place, config) as (launched, stranger):
        known = st.sampled_from(keys_of(stranger))
        wild = WILDCARDS.map(lambda rest: f"{stranger.public.root}/{rest}")
        run = f"/{stranger.keys.run}/"
        of_any_run = known.map(lambda key: key.replace(run, "/*/"))

        @settings(max_examples=400, deadline=None, database=None, suppress_health_check=list(HealthCheck))
        @given(known | wild | of_any_run, PAYLOADS, st.none() | st.binary(max_size=40) | JSON, st.booleans())
        def send(key: str, payload: bytes | None, attachment: bytes | None, asks: bool) -> None:  # noqa: FBT001  hypothesis draws it
            if asks:
                stranger.session.get(key, payload=payload, attachment=attachment, timeout=DEADLINE_S)
            elif payload is None:
                stranger.session.delete(key)
            elif not key.endswith(("in/u", "param/k")):  # a value that fits is rightly taken
                stranger.put(key, payload, attachment)

        send()
        wait_until(lambda: stranger.refused() >= 40, "40 refused messages")
    assert_unharmed(place, config, launched)


@WAYS
def test_what_is_right_in_every_respect_but_its_key_is_refused(place: Place, *, shared_memory: bool) -> None:
    config = config_of(place, shared_memory=shared_memory)
    error = ErrorReport("StepFailed", "a lie", 3, instance="left", point=0)
    with paused(place, config) as (launched, stranger):
        root = stranger.public.root
        for kind in (GRANT, FINISH, ABORT, PROGRESS, LAST):
            for node in ("left", "right", "@record", "@mesh"):
                message = HEADER.pack(kind, 0, 0, FAR) + (msgspec.json.encode(error) if kind == ABORT else b"")
                for key in (f"{root}/@sync/*/**/to={node}", f"{root}/@sync/{stranger.keys.run}/x/to={node}"):
                    stranger.put(key, message)
        for report in (NodeReport("left", 0), NodeReport("left", 0, error)):
            assert stranger.ask(f"{root}/@sync/*/report/of=left", msgspec.json.encode(report))
            assert stranger.ask(f"{root}/@sync/**", msgspec.json.encode(report))
        assert stranger.ask(f"{root}/@sync/*/report/of=nobody", msgspec.json.encode(NodeReport("nobody", 0)))
        # Whose token a stranger takes back is there all the same; that of the recorder is in the session that looks.
        for key in (stranger.keys.node("left"), stranger.keys.node("@record"), stranger.keys.master):
            stranger.session.liveliness().declare_token(key).undeclare()
    assert_unharmed(place, config, launched)


# ---- what only the process of a node knows


@WAYS
def test_no_stranger_reports_the_end_of_a_node(place: Place, *, shared_memory: bool) -> None:
    config = config_of(place, shared_memory=shared_memory)
    with paused(place, config) as (launched, stranger):
        place.run("step", "pair", "500")
        wait_until(lambda: json.loads(place.run("status", "pair", "--json").output)["point"] == 500, "point 500")
        for point in (0, 100, 500, 1500, 2000):  # of the past, now, and beyond what is granted
            for kind in ("TerminationRequested", "NotFinite", "StepFailed", "MeshLost"):
                error = ErrorReport(kind, "that is all", 3, instance="left", point=point, time=point / 1000)
                for report in (NodeReport("left", point, error), NodeReport("left", point)):
                    [refusal] = stranger.ask(stranger.keys.report("left"), msgspec.json.encode(report))
                    assert refusal == "its sender is not the process that has registered"
        assert stranger.ask(stranger.keys.report("@record"), msgspec.json.encode(NodeReport("@record", 100)))
        assert stranger.refused() >= 41
    assert_unharmed(place, config, launched)


def test_no_stranger_is_ready_instead_of_a_node(place: Place) -> None:
    place.hold("node right")
    config = config_of(place, shared_memory=True)
    launched = place.start("launch", config, "--no-progress")
    with place.session() as session:
        stranger = Stranger(session, "pair")
        token = stranger.keys.node("left")
        wait_until(lambda: [*session.liveliness().get(token, timeout=DEADLINE_S)], "left, which waits for right")

        assert stranger.ask(stranger.keys.ready("left"), b'{"shared":false}')

        launched.child("right").resume()
        assert launched.wait() == 0, launched.story()


GATE = """
import time
from pathlib import Path
import fmu_mesh

class Gate(fmu_mesh.Component):
    y = fmu_mesh.Output(start=0.0)

    def step(self, now, step_size):
        if now + step_size > 0.1995:  # the last step, which can only be taken if the master has granted all points
            here = Path(__file__).parent
            (here / "waits").touch()
            while not (here / "open").exists():
                time.sleep(0.001)
        self.y = now
"""


def test_progress_that_a_stranger_sends_makes_no_result_shorter(place: Place) -> None:
    (place.folder / "gate.py").write_text(GATE)
    instances = {"gate": {"python": "gate.py:Gate"}, "free": {"fmu": "Gain"}}
    config = write_config(
        place.folder,
        instances=instances,
        connections=(),
        stop_time=0.2,
        zenoh={"shared_memory": False, "row_streams": False},
    )
    launched = place.start("launch", config, "--no-progress")
    with place.session() as session:
        stranger = Stranger(session, "pair")
        status = f"{stranger.public.root}/*/status"

        def believed() -> bool:
            for node in ("gate", "@record"):  # until it is believed: nobody answers a put
                stranger.put(stranger.keys.progress(node), HEADER.pack(PROGRESS, 0, 0, 200))
            return any(
                reply.ok and b'"state":"stopping"' in reply.ok.payload.to_bytes() for reply in session.get(status)
            )

        wait_until((place.folder / "waits").exists, "'gate' in the step where it waits")
        wait_until(believed, "a master that believes it")
    (place.folder / "open").touch()

    assert launched.wait() == 0, launched.story()
    assert config.with_suffix(".csv").read_bytes() == local_result(place, config)


# ---- more than anybody needs

FLOOD = """
import json, sys, threading
import zenoh

config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
session = zenoh.open(config)
open_queries = [session.get("**", zenoh.handlers.FifoChannel(1), timeout=600) for _ in range(10_000)]
print("sent", flush=True)
threading.Event().wait()
"""


@WAYS
def test_ten_thousand_open_queries_of_a_client_end_no_run(place: Place, *, shared_memory: bool) -> None:
    config = config_of(place, shared_memory=shared_memory, stop_time=8.0, real_time_factor=1.0)
    launched = place.start("launch", config, "--no-progress")
    wait_until(lambda: row_count(config.with_suffix(".csv")), "the first row")
    flood = place.start_command([sys.executable, "-c", FLOOD, place.note().endpoints[0]])
    wait_until(lambda: "sent" in flood.output, "its queries")

    assert launched.wait() == 0, launched.story()

    flood.close()
    config = config_of(place, shared_memory=shared_memory, stop_time=8.0)
    assert config.with_suffix(".csv").read_bytes() == local_result(place, config)


@WAYS
def test_many_subscribers_and_tokens_of_a_stranger_do_no_harm(place: Place, *, shared_memory: bool) -> None:
    config = config_of(place, shared_memory=shared_memory)
    with paused(place, config) as (launched, stranger):
        root, keys, session = stranger.public.root, stranger.keys, stranger.session
        for key in (f"{root}/**", f"{root}/left/out/y", f"{keys.base}/**", f"{root}/mesh/log"):
            for _ in range(500):
                session.declare_subscriber(key, zenoh.handlers.RingChannel(1))
        for number in range(500):
            session.liveliness().declare_token(f"{root}/x{number}")
            session.liveliness().declare_token(keys.node("left")).undeclare()
            session.liveliness().declare_token(keys.node(f"x{number}"))
    assert_unharmed(place, config, launched)


@pytest.mark.parametrize("listen", [[], ["tcp/127.0.0.1:0"]], ids=["sockets", "network"])
def test_no_session_of_a_mesh_tells_strangers_about_itself(place: Place, listen: list[str]) -> None:
    # Zenoh answers with its own tables, and stands for ever when another program subscribes meanwhile.
    config = config_of(place, shared_memory=True)
    data = yaml.safe_load(config.read_text())
    data["zenoh"]["listen"] = listen
    config.write_text(yaml.safe_dump(data))
    with paused(place, config) as (launched, stranger):
        replies = [*stranger.session.get("@/**", timeout=DEADLINE_S)]
        assert len(place.note().endpoints) == 1 + len(listen)
        own = f"@/{stranger.session.zid()}/"
    assert not [
        key for reply in replies if reply.ok is not None and not (key := str(reply.ok.key_expr)).startswith(own)
    ]
    assert_unharmed(place, config, launched)


# ---- what a registered peer may not send


def assert_ends_with_names(place: Place, config: Path, launched: Launched, *names: str) -> None:
    """The run ends with an error that names both ends, and what was recorded is right."""
    assert launched.wait() == 4, launched.story()
    assert_no_row_is_wrong(place, config, launched, *names)


def assert_no_row_is_wrong(place: Place, config: Path, launched: Launched, *names: str) -> None:
    """What was recorded is right; and if the run has ended with an error, it names both ends."""
    assert launched.wait() in {0, 4}, launched.story()
    if launched.wait() == 4:
        for name in names:
            assert name in launched.message
    rows = rows_of(config.with_suffix(".csv"))
    local_result(place, config)
    local = rows_of(place.folder / "local.csv")
    assert rows == local[: len(rows)]
    assert launched.wait() == 4 or rows == local
    place.assert_nothing_left()


def grant(stranger: Stranger) -> None:
    for key in {*stranger.keys.grants(["left", "right", "free", "@record"]).values()}:
        stranger.put(key, HEADER.pack(GRANT, 0, 0, FAR))


def progress(stranger: Stranger) -> None:
    for node in ("left", "right", "free", "@record"):
        stranger.put(stranger.keys.progress(node), HEADER.pack(PROGRESS, 0, 0, 2000))


def finish(stranger: Stranger) -> None:
    for key in {*stranger.keys.grants(["left", "right", "free", "@record"]).values()}:
        stranger.put(key, HEADER.pack(FINISH, 0, 0, 0))


def abort(stranger: Stranger) -> None:
    error = ErrorReport("StepFailed", "a lie", 3, instance="left", point=0)
    for key in {*stranger.keys.grants(["left", "right", "free", "@record"]).values()}:
        stranger.put(key, HEADER.pack(ABORT, 0, 0, 0) + msgspec.json.encode(error))


def too_many_rows(stranger: Stranger) -> None:
    rows = 1 << 20  # more than its ring has
    for index in range(5):
        stranger.put(stranger.keys.frames("left", "right"), HEADER.pack(FRAME, index, rows, 0) + bytes(8 * rows))


@pytest.mark.parametrize(
    ("forge", "names"),
    [
        (grant, ("the master grants point 4611686018427387904 to node '", "which may be granted ")),
        (finish, ("says that it has ended at point 0, and the master has granted point ",)),
        (abort, (" was lost",)),
        (progress, ("says that it is at point 2000, and the master has granted point ",)),
        (too_many_rows, ("'left' sends its values up to point 1048575 to node 'right', more than was granted",)),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_registered_peer_that_breaks_the_protocol_ends_run_with_both_names(
    place: Place, forge: Callable[[Stranger], None], names: tuple[str, ...]
) -> None:
    """A forgery that is sent exactly as a peer sends its messages cannot be told from a peer; it must do no harm."""
    config = config_of(place, shared_memory=False)
    with paused(place, config) as (launched, stranger):
        forge(stranger)
        place.run("resume", "pair")
    assert_ends_with_names(place, config, launched, *names)


# ---- what a process of the same user can write into the shared memory


class Intruder:
    """A process of the same user that has opened the memory of a run, and knows what lies where."""

    def __init__(self, launched: Launched, config: Path) -> None:
        plan = prepare(config, PlanOptions())
        node = plan.nodes["left"]
        self.map = node.memory
        self.places = {place.instance: place for own in plan.nodes.values() for place in own.rings}
        master = launched.child("master")
        descriptors = Path(f"/proc/{master.pid}/fd").iterdir()
        self.path = next(path for path in descriptors if "memfd:fmu_mesh" in str(path.readlink()))
        with self.path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), self.map.size)

    def write(self, offset: int, *values: int) -> None:
        """Write numbers of 64 bits."""
        np.frombuffer(self._memory, np.int64, len(values), offset)[:] = values

    def ring(self, instance: str) -> Ring:
        """The ring of an instance."""
        place = self.places[instance]
        return Ring(place.layout, place.rows, memoryview(self._memory)[place.offset :])


def memory_grant(intruder: Intruder) -> None:
    intruder.write(intruder.map.grant, FAR)


def memory_progress(intruder: Intruder) -> None:
    intruder.write(intruder.map.progress_of("left"), FAR)


def memory_progress_of_the_recorder(intruder: Intruder) -> None:
    intruder.write(intruder.map.progress_of("@record"), FAR)


def memory_rows(intruder: Intruder) -> None:
    intruder.write(intruder.places["left"].counter, 1500)


def memory_all_rows(intruder: Intruder) -> None:
    for place in intruder.places.values():
        intruder.write(place.counter, FAR)


def memory_stamps(intruder: Intruder) -> None:
    for name in intruder.places:
        intruder.ring(name).stamps[:] = 7


@needs_memory
@pytest.mark.parametrize(
    ("forge", "names"),
    [
        (memory_grant, ("says that it is at point ", "and the master has granted point ")),
        (memory_progress, ("node 'left' says that it is at point 4611686018427387903, and the master has granted",)),
        (memory_progress_of_the_recorder, ("the recorder says that it is at point 4611686018427387903",)),
        (memory_rows, ("a row of 'left' for ", " is not the one that was written")),
        (memory_all_rows, ("a row of '", " is not the one that was written")),
        (memory_stamps, ("a row of '", " is not the one that was written")),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_number_that_is_forged_in_shared_memory_makes_no_wrong_row(
    place: Place, forge: Callable[[Intruder], None], names: tuple[str, ...]
) -> None:
    """The run ends with names, or goes on where the owner of the number writes its own before anybody looks."""
    config = config_of(place, shared_memory=True)
    with paused(place, config) as (launched, _):
        forge(Intruder(launched, config))
        place.run("resume", "pair")
    assert_no_row_is_wrong(place, config, launched, *names)


@needs_memory
def test_nobody_can_take_the_shared_memory_away(place: Place) -> None:
    """Who reads beyond the end of a mapping is killed by SIGBUS; so nobody can shrink it, and a copy is none of it."""
    config = config_of(place, shared_memory=True)
    with paused(place, config) as (launched, _):
        intruder = Intruder(launched, config)
        with intruder.path.open("r+b") as file:
            for size in (0, 4096, intruder.map.size - 1):
                with pytest.raises(PermissionError):
                    os.ftruncate(file.fileno(), size)
            with pytest.raises(OSError, match=r"Operation not permitted|busy"):
                fcntl.fcntl(file.fileno(), fcntl.F_ADD_SEALS, fcntl.F_SEAL_WRITE)
    assert_unharmed(place, config, launched)


@needs_memory
def test_whoever_rings_bells_and_writes_needs_delays_run_and_changes_no_number(place: Place) -> None:
    config = config_of(place, shared_memory=True)
    with paused(place, config) as (launched, _):
        intruder = Intruder(launched, config)
        for counter in (intruder.map.grant, *intruder.map.progress, *intruder.map.rings):
            for wake_at, need in ((-1, -5), (0, 1), (FAR, FAR), (NEVER, 3)):
                intruder.write(counter + 8, wake_at)
                intruder.write(counter + 64, *[need] * len(intruder.map.processes))
        for number in range(len(intruder.map.processes)):
            intruder.write(intruder.map.bells + 64 * number, number + 1)
    assert_unharmed(place, config, launched)


def test_a_forged_value_is_found_when_the_real_peer_sends_its_value(place: Place) -> None:
    config = config_of(place, shared_memory=False)
    with paused(place, config) as (launched, stranger):
        for index in range(5):
            message = HEADER.pack(FRAME, index, 2, 0) + b"\x3f" * 16
            stranger.put(stranger.keys.frames("left", "right"), message)
        place.run("resume", "pair")
    assert_ends_with_names(place, config, launched, "the values of 'left' came twice and differ")
