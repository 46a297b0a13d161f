"""Why there is no link, in words and within 2 s: real listeners of Zenoh with TLS, and sockets that are none."""

from __future__ import annotations

import json
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import timedelta
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Any, Final

import pytest
import zenoh

from fmu_mesh.config.access_sections import host_of, port_of
from fmu_mesh.errors import ConfigurationError, FmuMeshError, MeshLost
from fmu_mesh.wire.refused_links import RefusedLinks
from fmu_mesh.wire.security.identity import CA, CERTIFICATE, KEY, Identity
from tests.helpers import free_port, wait_until

pytest.importorskip("cryptography")
from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from cryptography.x509 import load_pem_x509_certificate

from fmu_mesh.wire.security.authority import Authority
from fmu_mesh.wire.security.certificates import identity_in
from fmu_mesh.wire.security.handshake import check_link
from tests.certificates import CLIENT, SERVER, Signer, new_signer, write_folder

Opened = Callable[..., str]

_DAY = timedelta(days=1)
_LIMIT_S = 6.0
"""It waits 1.9 s at most; a busy machine adds to that."""

_LISTENING = """
import json, sys, zenoh
zenoh.init_log_from_env_or("warn")
config = zenoh.Config()
for key, value in json.loads(sys.argv[1]).items():
    config.insert_json5(key, json.dumps(value))
with zenoh.open(config):
    print("listens", flush=True)
    sys.stdin.read()
"""
"""Zenoh writes its log to the standard output of the process, whatever Python does with it."""


@pytest.fixture(scope="module")
def signer() -> Signer:
    return new_signer("the lab")


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory, signer: Signer) -> Path:
    """Folders of all kinds of certificates, of one authority."""
    folder = tmp_path_factory.mktemp("folders")
    make = partial(write_folder, by=signer)
    make(folder / "host1", names=["host1"])
    make(folder / "alice", names=["alice"], usages=[CLIENT], hosts=[])
    make(folder / "bare", names=["bare"], usages=[])
    make(folder / "old", names=["old"], begins=-3 * _DAY, ends=-2 * _DAY)
    make(folder / "early", names=["early"], begins=2 * _DAY)
    make(folder / "server", names=["server"], usages=[SERVER])
    make(folder / "far", names=["far"], hosts=["far.lab", "far"])
    make(folder / "unplaced", names=["localhost"], hosts=[])
    stranger = write_folder(folder / "eve", new_signer("elsewhere"), ["eve"])
    (folder / "mixed").mkdir()
    for name in (CERTIFICATE, KEY):
        (folder / "mixed" / name).write_bytes((stranger / name).read_bytes())
    (folder / "mixed" / CA).write_bytes((folder / "host1" / CA).read_bytes())
    certificate = load_pem_x509_certificate((folder / "alice" / CERTIFICATE).read_bytes())
    key = load_pem_private_key((folder / "alice" / KEY).read_bytes(), None)
    assert isinstance(key, EllipticCurvePrivateKey)
    write_folder(folder / "carol", Signer(certificate, key, (certificate,)), ["carol"], root=signer)
    between = new_signer("the department", signer)._replace(between=())
    write_folder(folder / "chainless", between, ["chainless"], root=signer)
    return folder


def comes_as(folder: Path) -> Identity:
    """Who has a folder, even if our own check would refuse it: another program has none."""
    certificate = load_pem_x509_certificate((folder / CERTIFICATE).read_bytes())
    return Identity(folder, folder.name, "operator", certificate.not_valid_after_utc, "the lab")


def settings(endpoint: str, folder: Path) -> dict[str, Any]:
    return {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "listen/endpoints": [endpoint],
        "transport/link/tls": {
            "root_ca_certificate": str(folder / CA),
            "enable_mtls": True,
            "listen_certificate": str(folder / CERTIFICATE),
            "listen_private_key": str(folder / KEY),
            "connect_certificate": str(folder / CERTIFICATE),
            "connect_private_key": str(folder / KEY),
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        },
    }


def zenoh_session(**own: Any) -> zenoh.Session:  # noqa: ANN401  the settings of Zenoh
    config = zenoh.Config()
    for key, value in own.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


@pytest.fixture
def listens() -> Iterator[Opened]:
    """Opens listeners of Zenoh with the certificate of a folder; each returns its endpoint."""
    with ExitStack() as stack:

        def listen(folder: Path, kind: str = "tls") -> str:
            port = free_port(socket.SOCK_DGRAM if kind == "quic" else socket.SOCK_STREAM)
            endpoint = f"{kind}/localhost:{port}"
            stack.enter_context(zenoh_session(**settings(endpoint, folder)))
            return endpoint

        yield listen


@contextmanager
def listens_and_tells(folder: Path) -> Iterator[tuple[str, Callable[[], str]]]:
    """A listener in a process of its own: its endpoint, and what ends it and returns all that it has said."""
    endpoint = f"tls/localhost:{free_port()}"
    with subprocess.Popen(
        [sys.executable, "-c", _LISTENING, json.dumps(settings(endpoint, folder))],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline().strip() == "listens"
            yield endpoint, lambda: process.communicate(timeout=30)[0]
        finally:
            process.kill()


def why_not(endpoint: str, own: Identity | None) -> FmuMeshError:
    """The error of a check, which has come in time."""
    began = time.monotonic()
    with pytest.raises(FmuMeshError) as caught:
        check_link(endpoint, own)
    assert time.monotonic() - began < _LIMIT_S
    return caught.value


@pytest.mark.parametrize("name", ["host1", "alice", "bare"])
def test_a_good_certificate_is_taken(name: str, folders: Path, listens: Opened) -> None:
    check_link(listens(folders / "host1"), identity_in(folders / name))


def told_by_listener(output: str) -> list[str]:
    """What people are told of all that a listener has written."""
    links = RefusedLinks()
    return [told for line in output.splitlines() if (told := links.told(line))]


REFUSED_THERE: Final = {
    "old": ("by its clock the certificate of 'old', which ends at 20", "certificate expired: verification time"),
    "early": (
        "by its clock the certificate of 'early', which ends at 20",
        "certificate not valid yet: verification time",
    ),
    "server": (
        "the certificate of 'server' is for another use",
        "certificate does not allow extended key usage for client authentication",
    ),
    "mixed": ("it does not know the authority the lab of 'mixed'", "UnknownIssuer"),
    "chainless": ("it does not know the authority the lab of 'chainless'", "UnknownIssuer"),
    "carol": ("it does not take the certificate of 'carol'", "Other(OtherError(EndEntityUsedAsCa))"),
}
"""What a listener refuses: what who dials is told, and what stands in the log of who listens; alice signed carol."""

REFUSED_HERE: Final = {
    "old": ("'old', ended at 20", "CertificateExpired"),
    "early": ("'early', is not valid before 20", "BadCertificate"),
    "alice": ("'alice', is for clients only: its role is not node", "UnsupportedCertificate"),
    "far": ("'far', is for far.lab, far and not for 'localhost'", "BadCertificate"),
    "unplaced": ("'localhost', is for no host and not for 'localhost'", "BadCertificate"),
    "eve": ("'eve', is signed by 'elsewhere', and ours by 'the lab'", "UnknownCA"),
    "chainless": ("'chainless', is signed by 'the department', and ours by 'the lab'", "UnknownCA"),
    "carol": ("'carol', is signed by 'alice', and ours by 'the lab'", "UnknownCA"),
}
"""What who dials refuses, in the same way."""


@pytest.mark.parametrize("name", REFUSED_THERE)
def test_a_listener_refuses_a_certificate_and_both_sides_say_why(name: str, folders: Path) -> None:
    words, theirs = REFUSED_THERE[name]
    with listens_and_tells(folders / "host1") as (endpoint, all_said):
        error = why_not(endpoint, comes_as(folders / name))
        [told] = told_by_listener(all_said())

    assert isinstance(error, ConfigurationError)
    assert words in str(error)
    assert told.startswith(f"a link was refused: invalid peer certificate: {theirs}")


def test_who_comes_without_a_certificate_is_told_to_give_one(folders: Path) -> None:
    with listens_and_tells(folders / "host1") as (endpoint, all_said):
        error = why_not(endpoint, None)
        told = told_by_listener(all_said())

    assert "wants a certificate" in str(error)
    assert "from its authority with `security=...`" in str(error)
    assert told == ["a link was refused: peer sent no certificates"]


@pytest.mark.parametrize("name", REFUSED_HERE)
def test_the_certificate_of_who_listens_is_refused_and_both_sides_say_why(name: str, folders: Path) -> None:
    words, theirs = REFUSED_HERE[name]
    with listens_and_tells(folders / name) as (endpoint, all_said):
        error = why_not(endpoint, comes_as(folders / "alice"))
        first, *more = told_by_listener(all_said())

    assert isinstance(error, ConfigurationError)
    assert f"the certificate of who listens, {words}" in str(error)
    assert first == f"a link was refused: received fatal alert: {theirs}"
    assert set(more) <= {"a link was refused: peer sent no certificates"}  # the look at what the certificate says


def test_who_speaks_no_tls_is_in_the_log_of_who_listens(folders: Path) -> None:
    with listens_and_tells(folders / "host1") as (endpoint, all_said):
        own = {"mode": "client", "scouting/multicast/enabled": False, "connect/timeout_ms": 300}
        with pytest.raises(zenoh.ZError):
            zenoh_session(**own, **{"connect/endpoints": [endpoint.replace("tls/", "tcp/")]})
        told = told_by_listener(all_said())

    assert set(told) == {"a link was refused: received corrupt message of type InvalidContentType"}


def test_a_reason_is_told_at_its_first_tenth_and_hundredth_time() -> None:
    line = (
        "2026-11-30T08:00:00.{}Z  WARN acc-0 ThreadId(07) zenoh_link_tls::unicast: {}, {} seconds ago. Hint: a limit."
    )
    links = RefusedLinks()
    told = [links.told(line.format(number, "certificate expired", number)) for number in range(120)]

    assert [links.told(line.format(7, "eof", 7)), links.told("another line")] == [
        "a link was refused: eof, 7 seconds ago",
        None,
    ]
    said = "a link was refused: certificate expired, {} seconds ago"
    assert [one for one in told if one] == [
        said.format(0),
        f"{said.format(9)} (10 times)",
        f"{said.format(99)} (100 times)",
    ]
    assert told.count("") == 117


@pytest.mark.parametrize(
    ("theirs", "own"), [*(("host1", name) for name in REFUSED_THERE), *((name, "host1") for name in REFUSED_HERE)]
)
def test_zenoh_itself_refuses_what_the_handshake_refuses(theirs: str, own: str, folders: Path, listens: Opened) -> None:
    endpoint = listens(folders / theirs)
    dials = {
        **settings(endpoint, folders / own),
        "mode": "client",
        "listen/endpoints": [],
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 300,
    }
    with pytest.raises(zenoh.ZError):
        zenoh_session(**dials)


def test_nobody_listens_or_no_host_has_the_name(folders: Path) -> None:
    alice = comes_as(folders / "alice")

    for kind in ("tls", "quic"):
        error = why_not(f"{kind}/127.0.0.1:{free_port()}", alice)
        assert isinstance(error, MeshLost)
        assert "nobody listens" in str(error)
        assert "connection refused" in str(error)
    assert "no host has the name 'nowhere.invalid'" in str(why_not("tls/nowhere.invalid:7447", alice))


@pytest.mark.parametrize("kind", ["mute", "zenoh", "talks", "hangs up"])
def test_a_port_without_tls_is_told_apart(kind: str, folders: Path) -> None:
    alice = comes_as(folders / "alice")
    if kind == "zenoh":
        endpoint = f"127.0.0.1:{free_port()}"
        own = {"mode": "peer", "scouting/multicast/enabled": False, "listen/endpoints": [f"tcp/{endpoint}"]}
        with zenoh_session(**own):
            error = why_not(f"tls/{endpoint}", alice)
    else:
        with socket.create_server(("127.0.0.1", 0)) as server, ExitStack() as stack:
            if kind != "mute":

                def answer() -> None:
                    with suppress(OSError), server.accept()[0] as one:
                        if kind == "talks":
                            one.recv(10_000)
                            one.sendall(b"HTTP/1.0 400 Bad Request\r\n\r\n")

                thread = Thread(target=answer)
                thread.start()
                stack.callback(thread.join, 10.0)
            error = why_not(f"tls/127.0.0.1:{server.getsockname()[1]}", alice)

    assert isinstance(error, MeshLost)
    assert "tcp/ and not tls/" in str(error)


def test_quic_is_seen_and_a_mute_port_is_not_quic(folders: Path, listens: Opened) -> None:
    alice = comes_as(folders / "alice")
    check_link(listens(folders / "host1", "quic"), alice)

    with socket.socket(type=socket.SOCK_DGRAM) as mute:
        mute.bind(("127.0.0.1", 0))
        error = why_not(f"quic/127.0.0.1:{mute.getsockname()[1]}", alice)

    assert "does not answer with QUIC" in str(error)


def test_a_chain_with_keys_of_rsa_is_taken(tmp_path: Path, listens: Opened) -> None:
    root = new_signer("the root", with_rsa=True)
    between = new_signer("the department", root, with_rsa=True)
    host = write_folder(tmp_path / "host1", between, ["host1"], root=root, with_rsa=True)
    alice = write_folder(tmp_path / "alice", between, ["alice"], root=root, with_rsa=True, hosts=[], usages=[CLIENT])
    endpoint = listens(host)

    check_link(endpoint, identity_in(alice, {"alice": "operator"}))
    dials = {**settings(endpoint, alice), "mode": "client", "listen/endpoints": [], "connect/endpoints": [endpoint]}
    with zenoh_session(**dials) as session:
        assert len(list(session.info.peers_zid())) == 1


def test_a_renewed_certificate_is_taken_at_the_next_dial(tmp_path: Path) -> None:
    authority = Authority.made(tmp_path / "lab")
    host, alice = authority.add("host1", "node", 90), authority.add("alice", "operator", 6 / 86400)
    endpoint = f"tls/localhost:{free_port()}"
    dials = {
        **settings(endpoint, alice),
        "mode": "client",
        "listen/endpoints": [],
        "connect/endpoints": [endpoint],
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 20, "period_max_ms": 100, "period_increase_factor": 1.5},
    }
    with zenoh_session(**settings(endpoint, host)) as listener, zenoh_session(**dials) as session:

        def linked() -> bool:
            return any(link.zid == session.zid() for link in listener.info.links())

        wait_until(linked, "a link with the first certificate", 30.0)
        wait_until(lambda: not linked(), "the end of the link, as the certificate has ended", 30.0)
        authority.renew("alice", 90)
        wait_until(linked, "a link with the renewed certificate", 30.0)


def test_a_listener_takes_its_renewed_certificate_at_its_next_start(tmp_path: Path) -> None:
    authority = Authority.made(tmp_path / "lab")
    host = authority.add("host1", "node", 90)
    shown = []
    for _ in range(2):
        endpoint = f"tls/localhost:{free_port()}"
        with zenoh_session(**settings(endpoint, host)):
            before = (host / CERTIFICATE).read_text(encoding="utf-8")
            authority.renew("host1", 90)
            shown.append(ssl.get_server_certificate((host_of(endpoint), port_of(endpoint))))
            assert shown[-1].split() == before.split()

    assert shown[0] != shown[1]
