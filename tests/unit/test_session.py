"""Sessions: their end waits for nobody."""

from __future__ import annotations

import socket
import threading
from pathlib import Path
from typing import cast

import psutil
import pytest
import zenoh

from fmu_mesh.errors import ConfigurationError, DeadlineExceeded, MeshLost
from fmu_mesh.wire.client.mesh_client import key_expression
from fmu_mesh.wire.session import Question, Wiring, ask, close_session, is_of_this_host, matches, open_session
from tests.helpers import DEADLINE_S, NUMBERS_OF_ZENOH, wait_until


class Slow:
    """A session that waits for somebody while it is closed."""

    def __init__(self) -> None:
        self.somebody = threading.Event()
        self.closed = threading.Event()

    def close(self) -> None:
        assert self.somebody.wait(DEADLINE_S)
        self.closed.set()


def test_nobody_waits_for_session_that_waits_for_somebody_who_does_not_answer() -> None:
    session = Slow()

    close_session(cast("zenoh.Session", session))

    assert not session.closed.is_set()
    session.somebody.set()
    assert session.closed.wait(DEADLINE_S)


def test_a_session_towards_somebody_who_accepts_and_says_nothing_opens_and_closes() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        endpoint = f"tcp/127.0.0.1:{silent.getsockname()[1]}"
        session = open_session(Wiring(connect=(endpoint,)))
        accepted, _ = silent.accept()

        close_session(session)

        accepted.close()


def test_a_question_that_nobody_wants_answered_any_more_ends() -> None:
    session = open_session(Wiring())

    with pytest.raises(MeshLost, match="this process does not wait any more"):
        ask(session, Question("nobody/there", "nobody", 10 * DEADLINE_S), lambda: True)

    close_session(session)


@pytest.mark.parametrize(
    ("endpoint", "here"),
    [
        ("unixsock-stream//run/fmu_mesh/a.sock", True),
        ("tcp/127.0.0.1:7447", True),
        ("tls/localhost:7447?rel=1#iface=lo", True),
        ("udp/127.1.2.3:7447", True),
        ("tcp/192.0.2.1:7447", False),  # an address for documentation
        ("tcp/[2001:db8::1]:7447", False),
        (f"tcp/{64 * 'x'}:7447", False),  # too long for a name
    ],
)
def test_an_endpoint_is_of_this_host_or_of_another(endpoint: str, here: bool) -> None:  # noqa: FBT001  a parameter
    assert is_of_this_host(endpoint) is here


def test_all_addresses_of_the_interfaces_are_of_this_host() -> None:
    own = [one.address for several in psutil.net_if_addrs().values() for one in several if one.family == socket.AF_INET]

    assert [address for address in own if not is_of_this_host(f"tcp/{address}:7447")] == []


@pytest.mark.parametrize("once", [True, False])
def test_a_question_that_is_sent_once_is_not_repeated(once: bool) -> None:  # noqa: FBT001  a parameter of the test
    session, asked = open_session(Wiring()), threading.Semaphore(0)

    def answer_nothing(query: zenoh.Query) -> None:
        asked.release()
        query.drop()

    queryable = session.declare_queryable("somebody/there", answer_nothing)
    with pytest.raises(DeadlineExceeded):
        ask(session, Question("somebody/there", "somebody", 0.5, once=once))

    assert asked.acquire(timeout=DEADLINE_S)
    assert asked.acquire(blocking=False) is not once
    queryable.undeclare()
    close_session(session)


@pytest.mark.parametrize("once", [True, False])
def test_many_questions_leave_the_publishers_of_session_alone(
    once: bool,  # noqa: FBT001  a parameter of the test
    tmp_path: Path,
) -> None:
    at, received = (f"unixsock-stream/{tmp_path}/tool.sock",), list[bytes]()
    with open_session(Wiring(listen=at)) as mesh, open_session(Wiring(mode="client", connect=at)) as tool:

        def answer(query: zenoh.Query) -> None:
            query.reply("lab/mesh/command", b"{}")
            query.drop()

        mesh.declare_queryable("lab/mesh/command", answer)
        mesh.declare_subscriber("lab/gain/in/u", lambda sample: received.append(sample.payload.to_bytes()))
        publisher = tool.declare_publisher("lab/gain/in/u", congestion_control=zenoh.CongestionControl.BLOCK)
        wait_until(lambda: matches(publisher), "the input")
        key = tool.declare_keyexpr("lab/mesh/command") if once else "lab/mesh/command"
        question = Question(key, "the mesh", DEADLINE_S, once=once)
        for _ in range(NUMBERS_OF_ZENOH - 50):
            tool.declare_keyexpr("lab/other")

        for _ in range(100):
            ask(tool, question)
        publisher.put(b"1.0")

        wait_until(lambda: received, "the value")


def test_a_bad_key_expression_is_reported_without_the_sources_of_zenoh() -> None:
    with pytest.raises(ConfigurationError) as caught:
        key_expression("a//b")

    reason = "empty chunks are forbidden, as well as leading and trailing slashes"
    assert str(caught.value) == f"'a//b' is no key expression: {reason}"
