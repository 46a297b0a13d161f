"""Floods: whoever comes by a network may be slow for itself, and never for the run."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from socket import create_connection
from typing import Final

import psutil
import pytest
import zenoh

from benchmarks.floods import FLOODS, flooded
from fmu_mesh.errors import MeshLost
from fmu_mesh.wire.messages import MAX_MESSAGE_SIZE
from fmu_mesh.wire.session import Wiring, close_session, matches, open_session
from tests.helpers import DEADLINE_S, Place, wait_until
from tests.security.test_roles import free_endpoint, opened

pytest.importorskip("cryptography")
from fmu_mesh.wire.security.authority import Authority
from fmu_mesh.wire.security.certificates import identity_in
from fmu_mesh.wire.security.handshake import check_link

ROOT: Final = "fmu_mesh/flood"
LONG: Final = "FMU_MESH_FLOODS" in os.environ
"""`.ci/long floods` has all of them, and longer runs."""

WAYS: Final = ("memory", "zenoh") if LONG else ("memory",)
NEVER_S: Final = 3600.0
GARBAGE: Final = 100
_STOPPED: Final = """
import os, signal, sys, threading
from pathlib import Path
from benchmarks.floods import visitor
session = visitor(Path(sys.argv[1]), sys.argv[2])
came = threading.Event()
subscriber = session.declare_subscriber("fmu_mesh/flood/pump/log", lambda _: came.set())
came.wait()
os.kill(os.getpid(), signal.SIGSTOP)
"""


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    authority = Authority.made(tmp_path_factory.mktemp("lab") / "lab")
    authority.add("host", "node", 1.0, ["127.0.0.1"])
    authority.add("bob", "observer", 1.0)
    return authority.folder


@pytest.fixture
def ports() -> tuple[str, str]:
    return free_endpoint(), free_endpoint()


@pytest.fixture
def listener(lab: Path, ports: tuple[str, str]) -> Iterator[zenoh.Session]:
    """Who accepts links as a master does, and closes none because somebody does not read."""
    session = open_session(Wiring(listen=ports, identity=identity_in(lab / "host"), root=ROOT, stuck_s=NEVER_S))
    yield session
    close_session(session)


def asked(session: zenoh.Session, key: str, payload: bytes | None = None, attachment: bytes | None = None) -> int:
    replies = session.get(f"{ROOT}/{key}", payload=payload, attachment=attachment, timeout=DEADLINE_S)
    return sum(reply.ok is not None for reply in replies)


def test_a_payload_does_not_reach_who_is_asked(lab: Path, listener: zenoh.Session, ports: tuple[str, str]) -> None:
    came: list[str] = []

    def answer(query: zenoh.Query) -> None:
        came.append(str(query.key_expr))
        query.reply(str(query.key_expr).replace("*", "pump"), b"1")

    with (
        listener.declare_queryable(f"{ROOT}/**", answer),
        opened(lab / "bob", "client", **{"connect/endpoints": [ports[0]]}) as bob,
    ):
        for key in ("pump/out/y", "*/in/*", "pump/param/k", "pump/local/x", "*/info", "mesh/plan", "mesh/hello"):
            wait_until(partial(asked, bob, key), "an answer")
            came.clear()
            assert not asked(bob, key, b"1")
            assert not asked(bob, key, attachment=b"1")
            assert not came, key

        assert asked(bob, "*/status", attachment=b'{"pump":["y"]}')
        assert not asked(bob, "*/status", attachment=bytes(1 << 23))


def test_a_message_that_is_too_large_is_not_put_together(
    lab: Path, listener: zenoh.Session, ports: tuple[str, str]
) -> None:
    arrived: list[int] = []
    with (
        listener.declare_subscriber(f"{ROOT}/@sync/**", lambda sample: arrived.append(len(sample.payload))),
        opened(lab / "host", "client", **{"connect/endpoints": [ports[0]]}) as host,
    ):
        for size in (MAX_MESSAGE_SIZE + (1 << 20), MAX_MESSAGE_SIZE, 1):
            host.put(f"{ROOT}/@sync/frame", bytes(size), congestion_control=zenoh.CongestionControl.BLOCK)
        wait_until(lambda: 1 in arrived, "the last message")

    assert arrived == [MAX_MESSAGE_SIZE, 1]


def test_nobody_waits_for_an_observer_that_is_stopped(
    place: Place, lab: Path, listener: zenoh.Session, ports: tuple[str, str]
) -> None:
    place.environment["PYTHONPATH"] = str(Path(__file__).parents[2])
    stopped = place.start_command([sys.executable, "-c", _STOPPED, str(lab / "bob"), ports[0]])
    with listener.declare_publisher(f"{ROOT}/pump/log", congestion_control=zenoh.CongestionControl.BLOCK) as log:
        wait_until(lambda: matches(log), "the observer")
        log.put(b"now")
        wait_until(lambda: psutil.Process(stopped.pid).status() == psutil.STATUS_STOPPED, "a stopped observer")

        def publish() -> None:
            for _ in range(1000):
                log.put(bytes(100_000))

        publishing = threading.Thread(target=publish, daemon=True)
        publishing.start()
        publishing.join(DEADLINE_S)
        held = publishing.is_alive()
        stopped.close()
    assert not held


def test_strangers_at_one_port_do_not_delay_another(lab: Path, listener: zenoh.Session, ports: tuple[str, str]) -> None:
    assert listener is not None
    own = identity_in(lab / "bob")
    for port in ports:
        check_link(port, own)
    with ExitStack() as stack:
        for _ in range(GARBAGE):
            stranger = stack.enter_context(create_connection(("127.0.0.1", int(ports[0].rpartition(":")[2]))))
            stranger.sendall(b"GET / HTTP/1.1\r\n\r\n")

        with pytest.raises(MeshLost, match="does not answer with TLS"):
            check_link(ports[0], own)
        check_link(ports[1], own)


@pytest.mark.timeout(900)
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("paced", [True, False], ids=["paced", "fast"])
@pytest.mark.parametrize("flood", FLOODS if LONG else ["all", "sets", "large", "stopped"])
def test_a_run_beside_a_flood_has_the_floats_of_one_without(flood: str, way: str, *, paced: bool) -> None:
    points = 4000 if paced else 200_000

    run = flooded(flood, way, points // (1 if LONG else 4), 1.0 if paced else 0.0)

    assert run.problems == []
    assert len(run.seconds) == 1
