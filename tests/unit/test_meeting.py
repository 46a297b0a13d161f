"""How two processes meet for a row stream: who knows the secret gets in, and nobody else, however often he comes."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path

import msgspec
import pytest

from fmu_mesh.errors import ConfigurationError
from fmu_mesh.rings import native
from fmu_mesh.wire import meeting as module
from fmu_mesh.wire.meeting import Door, Meeting, meeting_of
from fmu_mesh.wire.session import Wiring
from tests.helpers import wait_until

pytestmark = pytest.mark.skipif(native.library is None, reason="there is no library of C")

LIMIT_S = 10.0

Make = Callable[..., Meeting]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    """Makes meetings, by default with a Unix socket each."""
    with ExitStack() as stack:

        def made(name: str, *listen: Path | str, connected: tuple[str, ...] = ()) -> Meeting:
            own = Meeting(name, listen or [tmp_path / f"{name}.rows"], connected)
            stack.callback(own.close)
            return own

        yield made


def introduce(*both: Meeting) -> None:
    """As the queries of Zenoh do: each knows the door of the other one."""
    one, other = both
    one.knows(other.name, other.door_for(one.name))
    other.knows(one.name, one.door_for(other.name))


def settled(*every: Meeting, timeout_s: float = LIMIT_S) -> None:
    names = [own.name for own in every]
    threads = [
        threading.Thread(target=own.settle, args=([name for name in names if name != own.name], timeout_s))
        for own in every
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LIMIT_S)
        assert not thread.is_alive()


def assert_connected(one: Meeting, other: Meeting) -> None:
    with one.sockets[other.name] as here, other.sockets[one.name] as there:
        here.sendall(b"rows")
        there.settimeout(LIMIT_S)
        assert there.recv(4) == b"rows"


@pytest.mark.parametrize("place", [None, "127.0.0.1"], ids=["socket", "port"])
def test_two_that_know_each_other_have_one_socket(make: Make, place: str | None) -> None:
    one, other = (make(name, *([place] if place else [])) for name in ("a", "bb"))
    introduce(one, other)

    settled(one, other)

    assert_connected(one, other)


def test_the_earlier_name_dials_where_the_later_one_cannot(make: Make, tmp_path: Path) -> None:
    one, other = make("a"), make("b")
    one.knows("b", other.door_for("a"))
    other.knows("a", Door((f"unix:{tmp_path / 'nobody'}",), one.door_for("b").secret))

    settled(one, other)

    assert_connected(one, other)


def test_a_door_at_all_addresses_is_found_by_a_connection(make: Make) -> None:
    one = make("a", "0.0.0.0")  # noqa: S104  the door is at all addresses
    other = make("b", "127.0.0.1", connected=("127.0.0.1",))
    assert one.door_for("b").addresses[0].startswith("tcp:*:")
    introduce(one, other)

    settled(one, other)

    assert_connected(one, other)


def test_who_cannot_be_reached_is_given_up_soon(make: Make, tmp_path: Path) -> None:
    one = make("a")
    one.knows("b", Door((f"unix:{tmp_path / 'nobody'}", "tcp:127.0.0.1:1"), "secret"))
    one.knows("c", None)
    started = time.monotonic()

    one.settle(["b", "c"], LIMIT_S)

    assert one.sockets == {}
    assert time.monotonic() - started < LIMIT_S / 2  # a second and a little


def test_all_peers_are_dialled_at_the_same_time(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    together, peers = threading.Barrier(20), [f"b{number}" for number in range(20)]
    dialled: list[str] = []

    def dial(_self: Meeting, peer: str) -> None:
        together.wait(LIMIT_S)  # raises if the others are not dialled until this ends
        dialled.append(peer)

    monkeypatch.setattr(Meeting, "dial", dial)
    last = make("c")
    for peer in peers:
        last.knows(peer, Door((), ""))

    last.settle(peers, LIMIT_S)

    assert sorted(dialled) == sorted(peers)


def test_a_wait_for_who_never_comes_ends_when_the_run_is_over(make: Make) -> None:
    one = make("a")

    one.settle(["b"], LIMIT_S, over=lambda: True)

    assert one.sockets == {}


def greeting(name: str, secret: str) -> bytes:
    data = msgspec.json.encode({"name": name, "secret": secret, "received": {}})
    return len(data).to_bytes(4, "little") + data


STRANGE = {
    "a wrong secret": greeting("b", "0" * 64),
    "another name": greeting("c", "0" * 64),
    "no greeting": b"\x05\0\0\0hello",
    "an endless one": b"\xff\xff\xff\xff" + b"x" * 100,
    "nothing": b"",
}


@pytest.mark.parametrize("name", STRANGE)
def test_a_stranger_who_comes_first_does_not_keep_a_peer_out(make: Make, name: str, tmp_path: Path) -> None:
    one, other = make("a"), make("b")
    introduce(one, other)
    with socket.socket(socket.AF_UNIX) as stranger:
        stranger.settimeout(LIMIT_S)
        stranger.connect(str(tmp_path / "a.rows"))
        stranger.sendall(STRANGE[name])

        settled(one, other)

        with suppress(ConnectionResetError):  # of bytes that nobody has read
            assert stranger.recv(1) == b""
    assert_connected(one, other)


def test_more_strangers_than_places_are_sent_away_at_once(make: Make, tmp_path: Path) -> None:
    make("a")
    with ExitStack() as stack:
        strangers = [stack.enter_context(socket.socket(socket.AF_UNIX)) for _ in range(module._STRANGERS)]
        for stranger in strangers:
            stranger.connect(str(tmp_path / "a.rows"))
        late = stack.enter_context(socket.socket(socket.AF_UNIX))
        late.settimeout(LIMIT_S)
        late.connect(str(tmp_path / "a.rows"))

        assert late.recv(1) == b""
        for stranger in strangers:
            stranger.settimeout(LIMIT_S)
            assert stranger.recv(1) == b""


def test_the_secret_of_one_peer_does_not_open_the_door_for_another(make: Make, tmp_path: Path) -> None:
    one, other = make("a"), make("b")
    introduce(one, other)
    one.knows("c", Door((), "nothing"))
    with socket.socket(socket.AF_UNIX) as stranger:
        stranger.settimeout(LIMIT_S)
        stranger.connect(str(tmp_path / "a.rows"))
        stranger.sendall(greeting("c", one.door_for("b").secret))

        assert stranger.recv(1) == b""
    assert one.sockets == {}


@pytest.mark.parametrize("answer", [greeting("b", "0" * 64), greeting("c", "0" * 64), b"\x05\0\0\0hello", b""], ids=str)
def test_a_door_that_a_stranger_has_taken_is_left_soon(make: Make, tmp_path: Path, answer: bytes) -> None:
    """He hears the secret of that door, and not that of the other one: so he does not come in."""
    one = make("a")
    with socket.socket(socket.AF_UNIX) as taken:
        taken.bind(str(tmp_path / "taken"))
        taken.listen()
        taken.settimeout(LIMIT_S)
        one.knows("b", Door((f"unix:{tmp_path / 'taken'}",), "secret"))
        begun = time.monotonic()
        dialing = threading.Thread(target=one.dial, args=["b"])
        dialing.start()
        with taken.accept()[0] as stranger:
            stranger.sendall(answer)
            dialing.join(LIMIT_S)

    assert not dialing.is_alive()
    assert one.sockets == {}
    assert time.monotonic() - begun < LIMIT_S / 2


def test_a_greeting_in_slow_pieces_does_not_stretch_the_second(make: Make, tmp_path: Path) -> None:
    one, other = make("a"), make("b")
    introduce(one, other)
    with socket.socket(socket.AF_UNIX) as slow:
        slow.settimeout(0.1)
        slow.connect(str(tmp_path / "a.rows"))
        begun, said = time.monotonic(), b"\0\0\x01\0" + b" " * 1000
        with suppress(ConnectionError):  # the door was closed while this spoke
            for place in range(len(said)):
                slow.sendall(said[place : place + 1])
                with suppress(TimeoutError):
                    if slow.recv(1) == b"":
                        break

        assert module._PATIENCE_S / 2 < time.monotonic() - begun < LIMIT_S / 2


def test_an_address_that_is_given_is_the_only_one_of_the_network(tmp_path: Path) -> None:
    wiring = Wiring(listen=("tcp/0.0.0.0:7447",), connect=("tcp/localhost:7447",))
    own = meeting_of("a", tmp_path, wiring, "127.0.0.2")
    assert own is not None

    local, port = own.door_for("b").addresses
    own.close()

    assert local.startswith(f"unix:{tmp_path}")
    assert port.startswith("tcp:127.0.0.2:")


def test_an_address_of_another_host_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"at '192\.0\.2\.1'") as refused:
        meeting_of("a", tmp_path, Wiring(), "192.0.2.1")

    assert "zenoh.rows_address" in str(refused.value.hint)


def test_a_closed_door_leaves_no_socket(make: Make, tmp_path: Path) -> None:
    one = make("a")
    assert [*tmp_path.iterdir()] == [tmp_path / "a.rows"]

    one.close()
    one.close()

    assert [*tmp_path.iterdir()] == []


class Again:
    """Who waits for peers that come again."""

    def __init__(self, rows: dict[int, int]) -> None:
        self.rows = rows
        self.came: list[tuple[str, dict[int, int]]] = []

    def received(self, _peer: str) -> dict[int, int]:
        return self.rows

    def take(self, peer: str, own: socket.socket, received: Mapping[int, int]) -> None:
        self.came.append((peer, dict(received)))
        own.close()


def test_who_comes_again_is_handed_on_with_what_he_has(make: Make) -> None:
    one, other = make("a"), make("b")
    introduce(one, other)
    settled(one, other)
    here, there = Again({1: 5}), Again({2: 7})
    one.wait_for_returns(here)
    other.wait_for_returns(there)

    assert other.dial("a", again=True)
    wait_until(lambda: here.came, "the other one to be handed on")  # the one that dials does not wait for this

    assert (here.came, there.came) == ([("b", {2: 7})], [("a", {1: 5})])
    assert_connected(one, other)


@pytest.mark.parametrize("name", STRANGE)
def test_a_stranger_who_comes_again_is_not_handed_on(make: Make, name: str, tmp_path: Path) -> None:
    one, other = make("a"), make("b")
    introduce(one, other)
    settled(one, other)
    here = Again({1: 5})
    one.wait_for_returns(here)
    with socket.socket(socket.AF_UNIX) as stranger:
        stranger.settimeout(LIMIT_S)
        stranger.connect(str(tmp_path / "a.rows"))
        stranger.sendall(STRANGE[name])

        with suppress(ConnectionResetError):  # of bytes that nobody has read
            assert stranger.recv(1) == b""

    assert here.came == []
    assert_connected(one, other)
