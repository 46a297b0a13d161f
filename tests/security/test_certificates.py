"""Folders of a name: what is wrong with them is said before anything is opened."""

from __future__ import annotations

import json
import shutil
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from fmu_mesh.errors import ConfigurationError
from fmu_mesh.wire.security.identity import CA, CERTIFICATE, KEY, ROLES, time_left, warnings_about

pytest.importorskip("cryptography")
from cryptography.hazmat.primitives import serialization

from fmu_mesh.wire.security.authority import Authority
from fmu_mesh.wire.security.certificates import identity_in
from tests.certificates import new_signer, write_folder

_DAY = timedelta(days=1)


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """An authority with a node, an operator and an observer."""
    authority = Authority.made(tmp_path / "lab")
    authority.add("host1", "node", 90)
    authority.add("alice", "operator", 90)
    authority.add("bob", "observer", 90)
    return tmp_path / "lab"


def wrong_in(folder: Path, **roles: Any) -> str:  # noqa: ANN401  whatever somebody writes
    with pytest.raises(ConfigurationError) as caught:
        identity_in(folder, roles or None)
    return str(caught.value)


def test_a_folder_says_who_has_it(lab: Path) -> None:
    host, bob = identity_in(lab / "host1"), identity_in(lab / "bob")

    assert (host.name, host.role) == ("host1", "node")
    assert host.table is not None
    assert host.table.roles == {"host1": "node", "alice": "operator", "bob": "observer"}
    assert (bob.name, bob.role, bob.table) == ("bob", "observer", None)
    assert bob.authority == host.authority
    assert bob.authority.startswith("lab of 20")


def test_files_that_are_missing_open_or_of_others_are_named(lab: Path) -> None:
    bob = lab / "bob"

    assert "is the folder of an authority, whose key no run reads. Give the folder of one name" in wrong_in(lab)
    assert "there is no ca.pem, certificate.pem, key.pem in" in wrong_in(lab / "carol")
    (bob / KEY).chmod(0o640)
    assert "others can read" in (text := wrong_in(bob))
    assert "(mode 640). `chmod 600" in text
    (bob / KEY).chmod(0o600)
    own = {name: (bob / name).read_bytes() for name in (CERTIFICATE, KEY, CA)}
    shutil.copy(lab / "alice" / KEY, bob / KEY)
    assert "does not belong to" in wrong_in(bob)
    (bob / KEY).write_text("no key", encoding="utf-8")
    assert "is no key without a password: " in wrong_in(bob)
    key = serialization.load_pem_private_key(own[KEY], None)
    secret = serialization.BestAvailableEncryption(b"secret")
    (bob / KEY).write_bytes(key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, secret))
    assert "is no key without a password: " in wrong_in(bob)
    (bob / KEY).write_bytes(own[KEY])
    (bob / CERTIFICATE).write_bytes(b"\xff")
    assert "is no certificate in PEM: " in wrong_in(bob)


def test_a_certificate_of_another_authority_is_told_with_both_names(lab: Path) -> None:
    other = Authority.made(lab.parent / "other").add("bob", "observer", 90)
    for name in (CERTIFICATE, KEY):
        shutil.copy(other / name, lab / "bob" / name)

    text = wrong_in(lab / "bob")

    assert "is signed by 'other of 20" in text
    assert "There is 'lab of 20" in text


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ([], "has 0 common names; expected exactly one"),
        (["alice", "bob"], "has 2 common names; expected exactly one"),
        (["a/b"], "has the common name 'a/b': expected 1 to 64 letters"),
        (["**"], "has the common name '**': expected 1 to 64 letters"),
        (["local"], "has the common name 'local': 'local' is who comes by the Unix socket"),
    ],
)
def test_a_certificate_has_one_name_that_keys_can_have(names: list[str], words: str, tmp_path: Path) -> None:
    assert words in wrong_in(write_folder(tmp_path, new_signer("theirs"), names))


def test_the_times_of_certificates_and_of_the_clock_are_told(tmp_path: Path) -> None:
    signer = new_signer("theirs")
    make = partial(write_folder, by=signer, names=["alice"])

    old = wrong_in(make(tmp_path / "old", begins=-3 * _DAY, ends=-2 * _DAY))
    early = wrong_in(make(tmp_path / "early", begins=2 * _DAY))

    assert f"ended at {datetime.now(UTC) - 2 * _DAY:%Y-%m-%d}" in old
    assert "`fmu-mesh security renew`" in old
    assert f"is not valid before {datetime.now(UTC) + 2 * _DAY:%Y-%m-%d}" in early
    assert "The clock of this host says 20" in early


def test_a_table_that_the_authority_has_not_signed_is_refused(lab: Path) -> None:
    file = lab / "host1" / ROLES
    table = json.loads(file.read_text(encoding="utf-8"))

    def wrong_with(**changes: Any) -> str:  # noqa: ANN401  whatever somebody writes
        file.write_text(json.dumps({**table, **changes}), encoding="utf-8")
        return wrong_in(lab / "host1")

    for changes in (
        {"roles": {**table["roles"], "bob": "operator"}},
        {"number": table["number"] + 1},
        {"made": "2020-01-01T00:00:00+00:00"},
        {"signature": ""},
        {"signature": "bm9uZQ=="},
        {"signature": "é"},
    ):
        assert "is not what the authority 'lab of 20" in wrong_with(**changes)
    assert "is no table of roles: Invalid enum value 'root'" in wrong_with(roles={"host1": "root"})
    other = Authority.made(lab.parent / "other").add("host1", "node", 1)
    shutil.copy(other / ROLES, file)
    assert "is not what the authority 'lab of 20" in wrong_in(lab / "host1")
    file.unlink()
    assert "there is no roles.json in" in wrong_in(lab / "host1")


def test_the_table_of_a_node_has_to_name_it(lab: Path) -> None:
    host2 = Authority(lab).add("host2", "node", 90)
    kept = host2.parent.parent / "kept"
    shutil.copytree(host2, kept)
    Authority(lab).remove("host2")
    shutil.copy(lab / "host1" / ROLES, kept / ROLES)

    assert "'host2' of" in (text := wrong_in(kept))
    assert "has no role in table 5 of roles of 20" in text


def test_another_authority_needs_a_table_of_ones_own(tmp_path: Path) -> None:
    root = new_signer("the root", with_rsa=True)
    folder = write_folder(tmp_path, new_signer("the department", root, with_rsa=True), ["host1"], root=root)

    tool = identity_in(folder)
    given = identity_in(folder, {"host1": "node", "alice": "operator"})
    (folder / ROLES).write_text('{"roles": {"host1": "node", "bob": "observer"}}', encoding="utf-8")
    written = identity_in(folder)

    assert (tool.role, tool.table, tool.authority) == (None, None, "the department")
    assert (given.role, written.role) == ("node", "node")
    assert given.table is not None
    assert written.table is not None
    assert given.table.roles == {"host1": "node", "alice": "operator"}
    assert written.table.roles == {"host1": "node", "bob": "observer"}
    assert str(written.table) == "a table of roles of its own"
    assert "'host1' of" in wrong_in(folder, alice="operator")
    assert "'a b' in the table of roles cannot be a name" in wrong_in(folder, **{"host1": "node", "a b": "observer"})


def test_a_chain_has_to_lead_to_an_authority_of_the_folder(tmp_path: Path) -> None:
    root = new_signer("the root")
    between = new_signer("the department", root)
    folder = write_folder(tmp_path, between._replace(between=()), ["host1"], root=root)

    assert "is signed by 'the department', of which there is no certificate in" in wrong_in(folder)


def test_what_ends_soon_or_before_the_run_is_told(tmp_path: Path) -> None:
    authority = Authority.made(tmp_path / "lab")
    alice, bob = (identity_in(authority.add(name, "operator", days)) for name, days in (("alice", 90), ("bob", 0.5)))
    now = datetime.now(UTC)

    assert warnings_about(alice) == []
    assert warnings_about(alice, now + 80 * _DAY) == []
    [before] = warnings_about(alice, now + 100 * _DAY)
    assert before.startswith("the certificate of 'alice' ends at 20")
    assert "(90 days left), before this run (about 20" in before
    assert before.endswith("UTC): links to others close then")
    [soon] = warnings_about(bob)
    assert soon.endswith("UTC (12 hours left): renew it with `fmu-mesh security renew`")
    assert time_left(now - _DAY) == f"ended at {now - _DAY:%Y-%m-%d %H:%M} UTC"
    assert time_left(now + timedelta(minutes=10)).endswith("(less than an hour left)")
