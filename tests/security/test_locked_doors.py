"""A mesh behind TLS: who may do what there, by our commands and between hosts; and what is refused, in words."""

from __future__ import annotations

import shutil
import socket
import ssl
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import pytest

import fmu_mesh
from fmu_mesh.errors import ConfigurationError, MeshLost
from tests.helpers import Launched, Place, free_port, on_a_busy_machine, wait_until, write_config
from tests.network_hosts import NEEDS_HOSTS, started_hosts

pytest.importorskip("cryptography")
from fmu_mesh.wire.security.authority import Authority
from fmu_mesh.wire.security.identity import Role

NAMES: Final[dict[str, Role]] = {"lab": "node", "rig": "node", "alice": "operator", "bob": "observer"}
_WORDS_S: Final = 2.0
"""A reason why there is no link is there within this time, as the issue asks."""


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    own = Authority.made(tmp_path_factory.mktemp("authority") / "lab")
    for name, role in NAMES.items():
        own.add(name, role, 60.0, ["localhost", "127.0.0.1", "router"] if role == "node" else ())
    return own


@pytest.fixture
def lab(authority: Authority, place: Place) -> Path:
    """The folders of all names, beside the configuration."""
    return Path(shutil.copytree(authority.folder, place.folder / "lab"))


def secured(place: Place, sections: Mapping[str, Mapping[str, Any]] = {}, name: str = "lab") -> Path:
    """A mesh that runs in real time behind TLS."""
    own: dict[str, Mapping[str, Any]] = {
        "simulation": {"real_time_factor": 1},
        "zenoh": {"listen": ["tls/127.0.0.1:0"]},
        "security": {"folder": f"lab/{name}"},
        **sections,
    }
    one = {"gain": {"fmu": "Gain"}}
    return write_config(place.folder, instances=one, connections=[], name="pair", stop_time=3600.0, **own)


@pytest.fixture
def running(place: Place, lab: Path) -> Iterator[str]:
    """The endpoint of a mesh behind TLS."""
    assert lab.is_dir()
    launched = place.start("launch", secured(place), "--no-progress")
    yield endpoint_of(launched)
    assert place.run("stop").wait() == 0
    launched.wait()


def endpoint_of(launched: Launched) -> str:
    return launched.wait_for_error_line("mesh 'pair' at").rpartition(" at ")[2].strip()


def asked(place: Place, endpoint: str, who: str | None, *words: str) -> Launched:
    """A command that comes with a certificate; None: with none."""
    return place.run(*words, "--connect", endpoint, *(["--security", f"lab/{who}"] if who is not None else []))


def test_an_operator_reads_sets_and_commands_over_tls(place: Place, running: str) -> None:
    assert "pair" in asked(place, running, "alice", "ls").output
    assert "holds from point" in asked(place, running, "alice", "set", "gain.u", "2.5").output
    assert "is paused" in asked(place, running, "alice", "pause").output
    assert asked(place, running, "alice", "get", "gain.u").output.split()[1] == "2.5"
    assert "is running" in asked(place, running, "alice", "resume").output


@pytest.mark.parametrize("command", ["ls", "status", "get gain.y", "info gain", "top --once", "logs", "wait"])
def test_an_observer_reads_over_tls(place: Place, running: str, command: str) -> None:
    assert asked(place, running, "bob", *command.split()).wait() == 0


@pytest.mark.parametrize(
    ("command", "what"),
    [("set gain.u 1", "setting a value"), ("pause", "'pause'"), ("stop", "'stop'"), ("step 3", "'step'")],
)
def test_an_observer_is_refused_before_anything_is_sent(place: Place, running: str, command: str, what: str) -> None:
    refused = asked(place, running, "bob", *command.split())

    assert refused.wait() == 2
    assert refused.message == f"fmu-mesh: you are observer 'bob'; {what} needs operator."


def test_who_has_no_certificate_or_no_role_is_told_so_in_time(place: Place, lab: Path, running: str) -> None:
    own, other = Authority(lab), Authority.made(place.folder / "other")
    own.add("carl", "operator", 1.0)
    other.add("eve", "operator", 1.0)
    port = running.rpartition(":")[2]
    expected = {
        (running, "carl"): "'carl' has no role in mesh 'pair'",
        (running, "../other/eve"): "and ours by 'other of 20",
        (running, None): "without a certificate. Expected `--security`, or FMU_MESH_SECURITY",
        (f"tcp/127.0.0.1:{port}", "alice"): "without TLS, although there is `security`",
        (f"tls/127.0.0.1:{free_port()}", "alice"): "nobody listens at",
        (f"tls/127.0.0.2:{port}", "alice"): "nobody listens at",
    }
    for (endpoint, who), words in expected.items():
        began = time.monotonic()
        with pytest.raises((ConfigurationError, MeshLost)) as raised:
            fmu_mesh.attach(connect=endpoint, security=lab / who if who is not None else None)
        assert time.monotonic() - began < on_a_busy_machine(_WORDS_S)
        told = asked(place, endpoint, who, "ls")

        assert told.wait() == raised.value.exit_code
        assert words in told.message


def test_the_socket_of_the_same_user_needs_no_certificate(place: Place, running: str) -> None:
    assert running.startswith("tls/")
    assert "holds from point" in place.run("set", "gain.u", "1.5").output
    assert "is paused" in place.run("pause").output


def test_a_variable_of_the_host_wins_over_the_file(place: Place, lab: Path) -> None:
    config = secured(place)
    place.environment["FMU_MESH_SECURITY"] = str(lab / "rig")
    shutil.rmtree(lab / "lab")

    launched = place.start("launch", config, "--no-progress")

    assert "pair" in asked(place, endpoint_of(launched), "alice", "ls").output
    place.run("stop")


def test_who_runs_a_mesh_at_a_network_is_a_node(place: Place, lab: Path) -> None:
    assert lab.is_dir()

    refused = place.run("launch", secured(place, name="alice"), "--no-progress")

    assert refused.wait() == 2
    assert "'alice' of" in refused.message
    assert "has the role node" in refused.message


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({"zenoh": {"listen": ["tcp/127.0.0.1:0"]}}, "without TLS, although there is `security`"),
        ({"zenoh": {"insecure": True}}, "true, although there is `security`; expected one of the two"),
        ({"zenoh": {"row_streams": True}}, "true, although there is `security`; expected false: row streams have no"),
        ({"security": {"folder": "lab/alice", "roles": {"alice": "king"}}}, "expected node or observer or operator"),
    ],
)
def test_what_does_not_go_with_security_is_a_finding(
    place: Place, sections: dict[str, Mapping[str, Any]], words: str
) -> None:
    checked = place.run("check", secured(place, sections))

    assert checked.wait() == 2
    assert words in checked.message


def test_check_says_who_may_do_what_and_a_start_what_ends_soon(place: Place, lab: Path) -> None:
    checked = place.run("check", secured(place)).output
    Authority(lab).renew("lab", 0.01)

    launched = place.start("launch", secured(place), "--no-progress")
    endpoint_of(launched)
    place.run("stop")

    access = checked.partition("Access\n")[2]
    assert "  listens at tls/127.0.0.1:0\n  certificate of 'lab', signed by 'lab of " in access
    assert "  node: lab, rig\n  observer: bob\n  operator: alice\n" in access
    assert "warning: the certificate of 'lab' ends at" in launched.errors
    assert "before this run" in launched.errors


@pytest.mark.parametrize("who", ["launch", "master", "router"])
def test_who_listens_says_why_it_has_refused_a_link(place: Place, lab: Path, who: str) -> None:
    if who == "router":
        there = f"tls/127.0.0.1:{free_port()}"
        listener = place.start("router", "--listen", there, "--security", lab / "lab")
        wait_until(lambda: "router at" in listener.output, "the router")
    else:
        listener = place.start(who, secured(place), "--no-progress")
        there = endpoint_of(listener)
    stranger = ssl.create_default_context()
    stranger.check_hostname, stranger.verify_mode = False, ssl.CERT_NONE

    with (
        suppress(ssl.SSLError),
        socket.create_connection(("127.0.0.1", int(there.rpartition(":")[2]))) as knocking,
        stranger.wrap_socket(knocking) as link,
    ):
        link.recv(1)

    listener.wait_for_error_line("a link was refused: peer sent no certificates\n")
    assert "Hint: increase" not in listener.errors + listener.output


@pytest.mark.parametrize("shared_memory", [True, False], ids=["memory", "zenoh"])
@pytest.mark.parametrize("way", ["master", "router"])
def test_nodes_over_tls_give_the_floats_of_one_process(
    place: Place, lab: Path, way: str, *, shared_memory: bool
) -> None:
    config = write_config(
        place.folder, stop_time=5.0, security={"folder": "lab/lab"}, zenoh={"shared_memory": shared_memory}
    )
    result, runtime = config.with_suffix(".csv"), place.environment["FMU_MESH_RUNTIME_DIR"]
    assert place.run("launch", config, "--local", "--no-progress").wait() == 0
    expected = result.read_bytes()
    result.unlink()
    there = f"tls/localhost:{free_port()}"
    if way == "router":
        router = place.start("router", "--listen", there, "--security", lab / "lab")
        wait_until(lambda: "router at" in router.output, "the router")

    own = ["--connect", there] if way == "router" else []
    by_hand = [place.start("master", config, "--no-progress", *(own or ["--listen", there]))]
    by_hand += [place.start("node", config, "pendulum", *own)]
    place.environment |= {"FMU_MESH_RUNTIME_DIR": f"{runtime}2", "FMU_MESH_SECURITY": str(lab / "rig")}
    by_hand += [place.start("node", config, "delay", "--connect", there)]

    assert [one.wait() for one in by_hand] == [0, 0, 0], "".join(one.story() for one in by_hand)
    assert result.read_bytes() == expected


@NEEDS_HOSTS
def test_two_hosts_with_a_certificate_each_give_the_floats_of_one(tmp_path: Path, authority: Authority) -> None:
    config, file = "configs/pendulum_delay.yaml", "own-clone/results/pendulum_delay.csv"
    with started_hosts(tmp_path) as (first, second):
        assert second.start("fmu-mesh", "launch", config, "--local", "--no-progress").wait() == 0
        for host, name in ((first, "lab"), (second, "rig")):
            shutil.copytree(authority.folder / name, host.folder / "own")
        own, there = {"FMU_MESH_SECURITY": "/tmp/own"}, ("--connect", "tls/router:7447")  # noqa: S108  of that host
        file_too = ("--security", "/tmp/own")  # noqa: S108  as above

        by_hand = [
            first.start("fmu-mesh", "master", config, "--listen", "tls/0.0.0.0:7447", *file_too, "--no-progress"),
            first.start("fmu-mesh", "node", config, "pendulum", *file_too),
            second.start("fmu-mesh", "node", config, "delay", *there, *file_too, **own),
        ]

        assert [one.wait() for one in by_hand] == [0, 0, 0], "".join(one.story() for one in by_hand)
        assert (first.folder / file).read_bytes() == (second.folder / file).read_bytes()
