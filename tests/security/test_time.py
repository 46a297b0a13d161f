"""Certificates and tables in time: what is renewed or removed, when that counts, and what is told before."""

from __future__ import annotations

import json
import shutil
import ssl
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

import pytest

import fmu_mesh
from fmu_mesh import Result
from fmu_mesh.errors import ConfigurationError
from tests.helpers import DEADLINE_S, Launched, Place, wait_until, write_config

pytest.importorskip("cryptography")
from cryptography.x509 import load_pem_x509_certificate

from fmu_mesh.wire.security.authority import Authority

_DAY_S: Final = 86400.0
_SHORT_S: Final = 8.0
"""How long a certificate lasts whose end a test waits for: longer than a link takes to come about."""


@pytest.fixture
def lab(place: Place) -> Authority:
    own = Authority.made(place.folder / "lab")
    for name in ("lab", "rig"):
        own.add(name, "node", 60.0, ["localhost", "127.0.0.1"])
    own.add("alice", "operator", 60.0)
    own.add("bob", "observer", 60.0)
    return own


def started(
    place: Place, *options: str, listen: str = "tls/127.0.0.1:0", file: str = "pair.csv"
) -> tuple[Launched, str]:
    """A mesh behind TLS that runs in real time, and its endpoint."""
    config = write_config(
        place.folder,
        instances={"gain": {"fmu": "Gain"}},
        connections=[],
        stop_time=3600.0,
        simulation={"real_time_factor": 1},
        zenoh={"listen": [listen]},
        security={"folder": "lab/lab"},
        record={"file": file},
    )
    launched = place.start("launch", config, "--no-progress", *options)
    return launched, launched.wait_for_error_line("mesh 'pair' at").rpartition(" at ")[2].strip()


def stopped(place: Place, launched: Launched) -> None:
    assert place.run("stop").wait() == 0
    launched.wait()


def served(endpoint: str) -> int:
    """The serial number of the certificate of who listens."""
    host, _, port = endpoint.removeprefix("tls/").partition(":")
    return load_pem_x509_certificate(ssl.get_server_certificate((host, int(port))).encode()).serial_number


def kept(folder: Path) -> int:
    """The serial number of the certificate in a folder."""
    return load_pem_x509_certificate((folder / "certificate.pem").read_bytes()).serial_number


def test_who_dials_takes_a_renewed_certificate_before_the_old_one_ends(place: Place, lab: Authority) -> None:
    launched, endpoint = started(place)
    alice, until = lab.renew("alice", _SHORT_S / _DAY_S), datetime.now(UTC) + timedelta(seconds=_SHORT_S)

    with fmu_mesh.attach(connect=endpoint, security=alice) as run:
        lab.renew("alice", 60.0)

        def joined() -> int:
            with place.session() as session:
                [reply] = session.get("fmu_mesh/pair/mesh/audit", timeout=DEADLINE_S)
            assert reply.ok is not None
            entries = json.loads(reply.ok.payload.to_bytes())["entries"]
            return sum(own.get("number", 1) for own in entries if own["what"] == "joined")

        assert joined() == 1
        wait_until(lambda: datetime.now(UTC) > until, "the end of the certificate")
        wait_until(lambda: joined() == 2, "a second link")
        assert run.set("gain.u", 2.0).point
        assert run.get("gain.u") == 2.0
    stopped(place, launched)


def test_who_listens_takes_a_renewed_certificate_at_its_start_only(place: Place, lab: Authority) -> None:
    launched, endpoint = started(place)
    before = served(endpoint)
    assert before == kept(lab.folder / "lab")
    lab.renew("lab", 60.0)

    assert place.run("reset", "pair").wait() == 0
    assert served(endpoint) == before
    stopped(place, launched)
    launched, endpoint = started(place)
    assert served(endpoint) == kept(lab.folder / "lab") != before
    stopped(place, launched)


def test_a_name_is_locked_out_at_the_next_start_of_who_listens(place: Place, lab: Authority) -> None:
    old = shutil.copytree(lab.folder / "bob", place.folder / "bob")
    launched, endpoint = started(place)
    lab.remove("bob")

    def value() -> object:
        with fmu_mesh.attach(connect=endpoint, security=old) as run:
            return run.get("gain.k")

    assert value() == 1.0
    assert place.run("reset", "pair").wait() == 0
    assert value() == 1.0
    stopped(place, launched)
    launched, endpoint = started(place)
    with pytest.raises(ConfigurationError, match="'bob' has no role in mesh 'pair'"):
        value()
    stopped(place, launched)


@pytest.mark.parametrize("changed", ["here", "there"])
def test_a_node_tells_that_the_master_has_another_table(place: Place, lab: Authority, changed: str) -> None:
    config = write_config(place.folder, stop_time=2.0, security={"folder": "lab/lab"})
    rig = Path(shutil.copytree(lab.folder / "rig", place.folder / "rig"))
    number = lab.table.number
    lab.add("carol", "observer", 1.0)
    if changed == "there":
        shutil.copy(rig / "roles.json", lab.folder / "lab" / "roles.json")
        rig = lab.folder / "rig"

    by_hand = [place.start("master", config, "--no-progress", "--listen", "tls/127.0.0.1:0")]
    endpoint = by_hand[0].wait_for_error_line("mesh 'pair' at").rpartition(" at ")[2].strip()
    by_hand += [place.start("node", config, "pendulum")]
    runtime = place.environment["FMU_MESH_RUNTIME_DIR"]
    place.environment |= {"FMU_MESH_RUNTIME_DIR": f"{runtime}2", "FMU_MESH_SECURITY": str(rig)}
    by_hand += [place.start("node", config, "delay", "--connect", endpoint)]

    assert [one.wait() for one in by_hand] == [0, 0, 0], "".join(one.story() for one in by_hand)
    told = by_hand[2].errors
    if changed == "here":
        assert f"here is table {number} of roles, and at the master table {number + 1}: this one is older" in told
        assert "from the folder of this host at the authority to this host" in told
    else:
        assert f"here is table {number + 1} of roles, and at the master table {number}: that one is older" in told
        assert "from the folder of the host of the master at the authority" in told
    assert "table" not in by_hand[1].errors


def commands(endpoint: str) -> dict[str, Callable[[Place], Launched]]:
    """One of each kind of tool that comes with a certificate."""

    def run(*words: str) -> Callable[[Place], Launched]:
        return lambda place: place.run(*words, "--connect", endpoint, "--security", "lab/alice")

    return {
        "ls": run("ls", "--json"),
        "status": run("status", "--json"),
        "get": run("get", "gain.k", "--json"),
        "set": run("set", "gain.k", "1", "--json"),
        "top": run("top", "--once", "--json"),
        "logs": run("logs", "--json"),
        "wait": run("wait", "--json"),
        "pause": run("pause", "--json"),
    }


def test_each_tool_tells_once_that_its_certificate_ends_soon(place: Place, lab: Authority) -> None:
    launched, endpoint = started(place)
    lab.renew("alice", 3.0)

    for name, command in commands(endpoint).items():
        done = command(place)
        assert done.wait() == 0, done.story()
        assert done.errors.count("the certificate of 'alice' ends at ") == 1, name
        assert "renew it with `fmu-mesh security renew`" in done.errors
        assert all(json.loads(line) for line in done.output.splitlines()), name
    lab.renew("alice", 60.0)
    assert "certificate" not in commands(endpoint)["ls"](place).errors
    stopped(place, launched)


def test_a_router_tells_that_its_certificate_ends_soon(place: Place, lab: Authority) -> None:
    lab.renew("rig", 3.0)

    router = place.start("router", "--listen", "tls/127.0.0.1:0", "--security", lab.folder / "rig")

    router.wait_for_error_line("the certificate of 'rig' ends at ")


@pytest.mark.parametrize("file", ["pair.csv", "pair.parquet"])
def test_only_the_user_reads_what_says_who_has_done_what(place: Place, lab: Authority, file: str) -> None:
    assert lab.members
    launched, endpoint = started(place, file=file)
    assert place.run("set", "gain.k", "2", "--connect", endpoint, "--security", "lab/alice").wait() == 0
    stopped(place, launched)

    written = place.folder / file
    about = written.with_name(f"{file}.json") if file.endswith(".csv") else written
    entries = Result.read(written).metadata["audit"]["entries"]
    assert [(own["what"], own["who"]) for own in entries] == [
        ("joined", "alice"),
        ("set", "alice"),
        ("commanded", "local"),
    ]
    assert about.stat().st_mode & 0o777 == 0o600


def test_check_tells_programs_who_may_do_what(place: Place, lab: Authority) -> None:
    listening = {"listen": ["tls/localhost:7443"]}
    config = write_config(place.folder, zenoh=listening, security={"folder": "lab/lab"})
    checked = place.run("check", config, "--json")

    access = json.loads(checked.output)["access"]

    until = datetime.fromisoformat(access.pop("until"))
    assert timedelta(days=59) < until - datetime.now(UTC) < timedelta(days=61)
    assert access == {
        "listen": ["tls/localhost:7443"],
        "connect": [],
        "shared_with": None,
        "name": "lab",
        "authority": lab.name,
        "table": lab.table.number,
        "roles": {"node": ["lab", "rig"], "observer": ["bob"], "operator": ["alice"]},
    }
    assert json.loads(place.run("check", write_config(place.folder), "--json").output)["access"] is None
