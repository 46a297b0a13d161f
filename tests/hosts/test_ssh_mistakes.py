"""What `launch` says when a host cannot be entered, or is not fit for the mesh: which host, why, and what to do.

Each mistake is made on hosts with a real sshd, so the words of ssh are those of ssh. Nothing is started, and nothing is
left.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Final, NamedTuple

import psutil
import pytest

from fmu_mesh import __version__
from tests.helpers import DEADLINE_S, on_a_busy_machine, wait_until
from tests.ssh_hosts import NEEDS_SSH, PYTHON, SshHosts, ssh_hosts
from tests.ssh_meshes import mesh_over_ssh

pytestmark = NEEDS_SSH

SSH: Final = Path("home", ".ssh")


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SshHosts]:
    with ssh_hosts(tmp_path_factory.mktemp("pair")) as entered:
        yield entered


@contextmanager
def changed(file: Path, text: str | None) -> Iterator[None]:
    """A file has another text, or is not there."""
    before = file.read_text(encoding="utf-8") if file.exists() else None
    mode = file.stat().st_mode if file.exists() else 0o644
    file.unlink(missing_ok=True)
    if text is not None:
        file.write_text(text, encoding="utf-8")
        file.chmod(mode)
    try:
        yield
    finally:
        file.unlink(missing_ok=True)
        if before is not None:
            file.write_text(before, encoding="utf-8")
            file.chmod(mode)


@contextmanager
def serving(pair: SshHosts, settings: Mapping[str, str]) -> Iterator[None]:
    """The sshd of the second host has other settings."""
    pair.serve(pair["b"], settings)
    try:
        yield
    finally:
        pair.serve(pair["b"])


@contextmanager
def unknown_key(pair: SshHosts) -> Iterator[None]:
    with changed(pair["a"].folder / SSH / "known_hosts", None):
        yield


@contextmanager
def changed_key(pair: SshHosts) -> Iterator[None]:
    file = pair["a"].folder / SSH / "known_hosts"
    [own, other] = file.read_text(encoding="utf-8").splitlines()
    with changed(file, f"{own}\nb {own.partition(' ')[2]}\n"):
        assert other.startswith("b ")
        yield


@contextmanager
def passphrase(pair: SshHosts) -> Iterator[None]:
    file = pair["a"].folder / SSH / "id_ed25519"
    with changed(file, file.read_text(encoding="utf-8")):
        command = ["ssh-keygen", "-q", "-p", "-N", "a passphrase", "-P", "", "-f", str(file)]
        subprocess.run(command, check=True, timeout=DEADLINE_S, capture_output=True)
        yield


@contextmanager
def no_key(pair: SshHosts) -> Iterator[None]:
    with changed(pair["a"].folder / SSH / "id_ed25519", None):
        yield


@contextmanager
def no_daemon(pair: SshHosts) -> Iterator[None]:
    with serving(pair, {"Port": "2222"}):
        yield


@contextmanager
def no_room(pair: SshHosts) -> Iterator[None]:
    """Somebody else connects, and does not say who it is; no second one may."""
    asking = (
        "import socket; s = socket.create_connection(('b', 22)); print(s.recv(9), flush=True); "
        "import signal; signal.pause()"
    )
    with serving(pair, {"MaxStartups": "1:100:1"}):
        other = pair["a"].start(PYTHON, "-c", asking)
        wait_until(lambda: "SSH" in other.output, "the greeting of sshd")
        try:
            yield
        finally:
            for process in psutil.Process(other.pid).children():
                process.kill()
            other.close()


@contextmanager
def forbidden(pair: SshHosts) -> Iterator[None]:
    with serving(pair, {"AllowStreamLocalForwarding": "no"}):
        yield


class Mistake(NamedTuple):
    """What is wrong with the host `b`, and what the message has to say; ``python`` is that of its entry."""

    make: Callable[[SshHosts], AbstractContextManager[object]]
    words: tuple[str, ...]
    python: str = PYTHON


MISTAKES: Final = {
    "unknown host key": Mistake(unknown_key, ("Host key verification failed", "`ssh b`")),
    "changed host key": Mistake(changed_key, ("host key has changed", "ssh-keygen -R")),
    "passphrase": Mistake(passphrase, ("Permission denied", "ssh-add")),
    "no key": Mistake(no_key, ("Permission denied",)),
    "no sshd": Mistake(no_daemon, ("Connection refused",)),
    "too many connections": Mistake(no_room, ("MaxStartups",)),
    "wrong python": Mistake(lambda _: ExitStack(), ("exit code 127", "/no/such/python"), python="/no/such/python"),
    "no fmu_mesh": Mistake(lambda _: ExitStack(), ("No module named", "Install fmu-mesh"), python="/usr/bin/python3"),
    "forbidden forwarding": Mistake(forbidden, ("AllowStreamLocalForwarding",)),
}


@pytest.mark.parametrize("mistake", MISTAKES.values(), ids=MISTAKES)
def test_a_host_that_cannot_be_entered_is_told_with_what_to_do(pair: SshHosts, mistake: Mistake) -> None:
    with mesh_over_ssh(pair, entries={"b": {"python": mistake.python}}) as mesh:
        with mistake.make(pair):
            launched = mesh.launch()
            assert launched.wait() in {2, 4}, mesh.story()

        assert launched.ended_after_s < on_a_busy_machine(15.0)
        assert re.search(r"\bb\b", launched.message)
        for words in mistake.words:
            assert words in launched.message
        assert not mesh.result.exists()
        mesh.assert_nothing_left()


def other_python(pair: SshHosts, start: str, **files: str) -> str:
    """A Python on the second host that runs this code first, and has more files; its path there."""
    (folder := pair["b"].folder / "own-clone" / "other").mkdir(exist_ok=True)
    for name, text in {"sitecustomize.py": start, **files}.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    command = f'#!/bin/sh\nPYTHONPATH=/tmp/own-clone/other exec {PYTHON} "$@"\n'
    (folder / "python").write_text(command, encoding="utf-8")
    (folder / "python").chmod(0o755)
    return "/tmp/own-clone/other/python"  # noqa: S108  of the host


def test_another_version_there_is_refused_before_anything_starts(pair: SshHosts) -> None:
    start = "import fmu_mesh\nfmu_mesh.__version__ = '0.1.0'\n"
    python = other_python(pair, start)
    with mesh_over_ssh(pair, entries={"b": {"python": python}}) as mesh:
        launched = mesh.launch()

        assert launched.wait() == 2, mesh.story()
        assert f"b has fmu_mesh 0.1.0, here {__version__}." in launched.message
        mesh.assert_nothing_left()


def test_a_full_disk_there_is_told_and_leaves_nothing(pair: SshHosts) -> None:
    folder = pair["b"].home / ".cache" / "fmu_mesh"
    folder.mkdir(parents=True, exist_ok=True)
    where = "/tmp/home/.cache/fmu_mesh"  # noqa: S108  of the host
    assert pair["b"].start("mount", "-t", "tmpfs", "-o", "size=8k", "own", where).wait() == 0
    try:
        with mesh_over_ssh(pair) as mesh:
            launched = mesh.launch()

            assert launched.wait() in {2, 4}, mesh.story()
            assert "No space left" in launched.message
            mesh.assert_nothing_left()
            listing = pair["b"].start("find", where, "-type", "f")
            assert listing.wait() == 0
            assert not listing.output
    finally:
        assert pair["b"].start("umount", where).wait() == 0


def test_a_damaged_file_of_the_cache_is_sent_again(pair: SshHosts) -> None:
    with mesh_over_ssh(pair) as mesh:
        assert mesh.launch().wait() == 0, mesh.story()
        cached = [path for path in (pair["b"].home / ".cache" / "fmu_mesh" / "hosts").rglob("*") if path.is_file()]
        assert cached
        for path in cached:
            path.chmod(0o644)
            path.write_bytes(path.read_bytes()[:-1])

        assert mesh.launch().wait() == 0, mesh.story()

        assert mesh.result.read_bytes() == mesh.expected()


USER: Final = """
Host *
  Compression yes
  ControlMaster auto
  ControlPath ~/.ssh/master-%C
  ControlPersist 600
  ExitOnForwardFailure yes
  ForkAfterAuthentication yes
  LocalForward 2022 localhost:22
  LogLevel DEBUG
  RemoteCommand echo another command
  RequestTTY force
  StdinNull yes
"""


def test_whatever_the_file_of_the_user_says_a_mesh_runs(pair: SshHosts) -> None:
    with changed(pair["a"].folder / SSH / "config", USER), mesh_over_ssh(pair) as mesh:
        launched = mesh.launch()

        assert launched.wait() == 0, mesh.story()
        assert mesh.result.read_bytes() == mesh.expected()
        mesh.assert_nothing_left()


def test_what_a_profile_prints_harms_nothing(pair: SshHosts) -> None:
    profile = pair["b"].home / ".bashrc"
    with (
        changed(profile, "echo Welcome to b; printf '\\0\\1\\2%0999d' 0; echo trouble >&2\n"),
        mesh_over_ssh(pair) as mesh,
    ):
        launched = mesh.launch()

        assert launched.wait() == 0, mesh.story()
        assert mesh.result.read_bytes() == mesh.expected()
        mesh.assert_nothing_left()
