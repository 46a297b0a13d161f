"""The command `security`: what it writes, and its words for whatever somebody may try."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import pytest

from fmu_mesh.cli.main import main
from fmu_mesh.wire.security.identity import CERTIFICATE, KEY, ROLES

pytest.importorskip("cryptography")
from fmu_mesh.wire.security.authority import LIST, Authority
from fmu_mesh.wire.security.certificates import hosts_of, identity_in

Does = Callable[..., str]


@pytest.fixture
def does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Does:
    """Runs `fmu-mesh security` in an empty folder; returns what it says: its output, or the error of a wrong use."""
    monkeypatch.chdir(tmp_path)

    def do(line: str, code: int = 0) -> str:
        assert main(["security", *line.split()]) == code
        said = capsys.readouterr()
        assert (said.err == "") is (code == 0)
        return said.out if code == 0 else said.err.removeprefix("fmu-mesh: ").strip()

    return do


@pytest.fixture
def lab(does: Does) -> Does:
    """The same beside an authority `lab` with a node, an operator and an observer."""
    does("init lab")
    does("add lab host1 --role node")
    does("add lab alice --role operator")
    does("add lab bob --role observer --days 0.5")
    return does


def test_a_new_authority_keeps_its_key_to_itself(does: Does, tmp_path: Path) -> None:
    said = does("init lab")

    assert "lab: a new authority, 'lab of 20" in said
    assert "Its key, ca.key, stays here" in said
    assert "security add lab NAME --role ROLE" in said
    assert stat.S_IMODE((tmp_path / "lab").stat().st_mode) == 0o700
    assert stat.S_IMODE((tmp_path / "lab" / "ca.key").stat().st_mode) == 0o600
    assert does("init lab", 2) == "'lab' has an authority already; nothing was written"


def test_a_folder_that_is_handed_over_has_what_its_owner_needs(lab: Does, tmp_path: Path) -> None:
    said = lab("add lab host2 --role node --days 3 --host lab2 --host 10.0.0.5")

    assert "lab/host2: node 'host2', ends at 20" in said
    assert "(3 days left); listens as lab2, 10.0.0.5" in said
    assert "Hand this folder over, and nothing else" in said
    assert "The folder of host1 has a new roles.json: copy it" in said
    names = {
        name: [one.name for one in sorted((tmp_path / "lab" / name).iterdir())]
        for name in ("alice", "bob", "host1", "host2")
    }
    of_node, of_person = ["ca.pem", CERTIFICATE, KEY, ROLES], ["ca.pem", CERTIFICATE, KEY]
    assert names == {"alice": of_person, "bob": of_person, "host1": of_node, "host2": of_node}
    for name in names:
        assert stat.S_IMODE((tmp_path / "lab" / name / KEY).stat().st_mode) == 0o600


def test_show_tells_who_has_which_role_until_when(lab: Does) -> None:
    lines = lab("show lab").splitlines()

    assert "; table 3 of roles of 20" in lines[0]
    assert [line.split()[:2] for line in lines[1:]] == [
        ["host1", "node"],
        ["alice", "operator"],
        ["bob", "observer"],
    ]
    assert "localhost, 127.0.0.1, ::1" in lines[1]
    assert "(90 days left)" in lines[2]
    assert lines[3].endswith("(12 hours left): renew it")
    assert lab("show lab/bob").startswith("lab/bob: observer 'bob' of the authority 'lab of 20")
    assert "It has table 3 of roles of 20" in lab("show lab/host1")
    assert [msgspec.json.decode(line)["name"] for line in lab("show lab --json").splitlines()] == [
        "host1",
        "alice",
        "bob",
    ]
    assert msgspec.json.decode(lab("show lab/bob --json"))["role"] == "observer"
    assert "pause, resume, step, reset, stop, checkpoint" in lab("show lab --table")


def test_a_renewed_folder_has_a_new_key_and_the_same_table(lab: Does, tmp_path: Path) -> None:
    folder = tmp_path / "lab" / "host1"
    before, key = identity_in(folder), (folder / KEY).read_bytes()

    said = lab("renew lab host1 --days 200")

    after = identity_in(folder)
    assert "Who dials takes it at the next dial, who listens at its next start." in said
    assert after.until > before.until + timedelta(days=100)
    assert (folder / KEY).read_bytes() != key
    assert (after.name, after.role, after.table) == (before.name, before.role, after.table)
    assert after.table is not None
    assert before.table is not None
    assert (after.table.number, after.table.roles) == (before.table.number, before.table.roles)
    assert "listens as lab7" in lab("renew lab host1 --host lab7")


def test_a_name_that_is_removed_is_in_no_new_table(lab: Does, tmp_path: Path) -> None:
    said = lab("remove lab bob")

    assert "'bob' has no role in table 4 of roles" in said
    assert "What is running keeps its table until it is started again. The certificate ends at 20" in said
    assert "The folder of host1 has a new roles.json" in said
    assert not (tmp_path / "lab" / "bob").exists()
    table = identity_in(tmp_path / "lab" / "host1").table
    assert table is not None
    assert table.roles == {"host1": "node", "alice": "operator"}


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("add lab a/b --role observer", "'a/b' cannot be a name: expected 1 to 64 letters, digits, `.`, `_` and `-`"),
        ("add lab .. --role observer", "'..' cannot be a name"),
        ("add lab Local --role observer", "'Local' cannot be a name: 'local' is who comes by the Unix socket"),
        ("add lab Bob --role observer", "'bob' is in 'lab' already. `fmu-mesh security renew` renews it"),
        ("add lab carol", "'carol' needs a role. `--role` is one of observer, operator, node."),
        ("add lab carol --role admin", "--role: invalid choice: 'admin'"),
        ("add lab --role observer", "`security add` needs a name after the folder."),
        ("add lab carol --role observer --host h", "'carol' is an observer: only a node listens"),
        ("add lab host2 --role node --host lab2:7447", "'lab2:7447' is no name and no address of a host"),
        ("add lab carol --role observer --days 0", "--days: 0 is not a time above 0"),
        ("renew lab bobb", "there is no 'bobb' in 'lab'. Did you mean 'bob'?"),
        ("renew lab bob --role operator", "`security renew` takes no --role"),
        ("remove lab bob --days 3", "`security remove` takes no --days"),
        ("show lab bob", "`security show` takes no 'bob'"),
        ("init lab2 --table", "`security init` takes no --table"),
        ("show nowhere", "'nowhere' is no authority: there is no nowhere/authority.json. `fmu-mesh security init"),
        ("add lab/bob carol --role node", "'lab/bob' is no authority: there is no lab/bob/authority.json. It is the"),
        ("add lab notes --role observer", "'lab/notes' is there, and of no name: remove it first"),
        ("init lab/alice", "'lab/alice' is not empty; nothing was written"),
        ("init lab/alice/key.pem", "'lab/alice/key.pem' is no folder; nothing was written"),
        ("init lab/alice/key.pem/x", "'lab/alice/key.pem/x' cannot be written: Not a directory"),
    ],
)
def test_wrong_use_is_told_and_changes_nothing(line: str, words: str, lab: Does, tmp_path: Path) -> None:
    (tmp_path / "lab" / "notes").mkdir()
    before = (tmp_path / "lab" / LIST).read_bytes()

    assert words in lab(line, 2)
    assert (tmp_path / "lab" / LIST).read_bytes() == before
    assert [one.name for one in sorted((tmp_path / "lab").iterdir())] == [
        *("alice", "authority.json", "bob", "ca.key", "ca.pem", "host1", "notes"),
    ]


def test_an_authority_that_cannot_be_read_or_written_is_told(lab: Does, tmp_path: Path) -> None:
    folder = tmp_path / "lab"
    folder.chmod(0o500)
    if os.geteuid() == 0:
        line = ["setpriv", "--bounding-set", "-dac_override", "--inh-caps", "-dac_override", sys.executable, "-m"]
        if shutil.which(line[0]) is None:
            pytest.skip("root can write everywhere, and there is no setpriv")
    else:
        line = [sys.executable, "-m"]
    command = [*line, "fmu_mesh", "security", "add", "lab", "carol", "--role", "observer"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60)
    folder.chmod(0o700)
    assert (done.returncode, done.stderr) == (2, "fmu-mesh: 'lab' cannot be written: Permission denied\n")

    shutil.copy(folder / "alice" / KEY, folder / "ca.key")
    assert lab("show lab", 2) == "ca.key of 'lab' is not the key of its ca.pem"
    (folder / LIST).write_text('{"version": 1}', encoding="utf-8")
    assert "the authority 'lab' cannot be read: Object missing required field" in lab("show lab", 2)


def test_no_certificate_outlives_its_authority(tmp_path: Path) -> None:
    authority = Authority.made(tmp_path / ("long" * 40))
    folder = authority.add("alice", "operator", 1e9)

    assert identity_in(folder).until == authority.until
    assert authority.until - datetime.now(UTC) > timedelta(days=3600)


def test_a_certificate_is_for_the_hosts_that_were_given(tmp_path: Path) -> None:
    from cryptography.x509 import load_pem_x509_certificate  # noqa: PLC0415  an optional library

    authority = Authority.made(tmp_path / "lab")
    folder = authority.add("host1", "node", 1, ["lab1", "*.lab", "10.0.0.5", "fe80::1"])
    alice = authority.add("alice", "operator", 1)

    own, persons = (load_pem_x509_certificate((one / CERTIFICATE).read_bytes()) for one in (folder, alice))
    assert hosts_of(own) == ["lab1", "*.lab", "10.0.0.5", "fe80::1"]
    assert hosts_of(persons) == []
