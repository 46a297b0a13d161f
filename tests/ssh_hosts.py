"""Hosts that take commands by ssh: `tests.network_hosts` with a real sshd on each, and a user who may enter the others.

On each host, `ssh b` is all that it takes to enter the host `b`, as with a configuration of a real user: the key, the
known hosts and the configuration are in the home folder. An entered command finds the Python of this checkout as
`PYTHON`.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import psutil
import pytest

from tests.helpers import DEADLINE_S, Launched
from tests.network_hosts import HOME, NEEDS_HOSTS, NetworkHost, started_hosts

__all__ = ["NEEDS_SSH", "PYTHON", "SshHosts", "ssh_hosts", "why_not"]

PYTHON: Final = sys.executable
"""The Python of all hosts."""

_SSHD: Final = shutil.which("sshd", path="/usr/sbin:/usr/local/sbin")
_SEPARATION: Final = Path("/run/sshd")
"""An empty folder that sshd of Debian wants; a service would make it."""


def why_not() -> str:
    """Why there can be no such hosts here; empty if they can."""
    if _SSHD is None:
        return "needs sshd: apt install openssh-server"
    return str(NEEDS_HOSTS.kwargs["reason"]) if NEEDS_HOSTS.args[0] else ""


NEEDS_SSH = pytest.mark.skipif(bool(why_not()), reason=why_not() or "can run")


class SshHosts:
    """Hosts, the first of which can enter each of the others, and they each other.

    Args:
        hosts: their names are those that ssh knows.
        folder: for keys; on no host.

    Attributes:
        hosts: as above.
        daemons: the sshd of each host, by its name.
    """

    def __init__(self, hosts: Sequence[NetworkHost], folder: Path) -> None:
        self.hosts = hosts
        self.daemons: dict[str, Launched] = {}
        self._keys = folder
        self._make_key("user")
        for host in hosts:
            self._make_key(host.name)
        known = [f"{host.name} {self._public(host.name)}" for host in hosts]
        for host in hosts:
            self._write_user(host, known)
            self.serve(host)

    def __getitem__(self, name: str) -> NetworkHost:
        """The host of this name."""
        return next(host for host in self.hosts if host.name == name)

    def serve(self, host: NetworkHost, settings: Mapping[str, str] = {}) -> None:
        """Start the sshd of a host with these settings of `sshd_config`; one that runs ends, and its sessions stay."""
        if running := self.daemons.pop(host.name, None):
            for process in psutil.Process(running.pid).children():
                process.terminate()
            running.wait()
        (folder := host.folder / "sshd").mkdir(exist_ok=True)
        # The first value of a setting counts.
        lines = [f"{key} {value}" for key, value in (dict(settings) | _settings(settings)).items()]
        (folder / "sshd_config").write_text("\n".join([*lines, ""]), encoding="utf-8")
        for name, source in (("host_key", host.name), ("authorized_keys", "user.pub")):
            shutil.copy(self._keys / source, folder / name)
        assert _SSHD is not None
        daemon = host.start(_SSHD, "-D", "-e", "-f", "/tmp/sshd/sshd_config")  # noqa: S108  its own
        daemon.wait_for_error_line("Server listening on")
        self.daemons[host.name] = daemon

    def _make_key(self, name: str) -> None:
        command = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", name, "-f", str(self._keys / name)]
        subprocess.run(command, check=True, timeout=DEADLINE_S)

    def _public(self, name: str) -> str:
        return (self._keys / f"{name}.pub").read_text(encoding="utf-8").strip()

    def _write_user(self, host: NetworkHost, known: Sequence[str]) -> None:
        """What a user has in the home folder of this host."""
        (folder := host.home / ".ssh").mkdir(mode=0o700)
        shutil.copy(self._keys / "user", folder / "id_ed25519")
        (folder / "id_ed25519").chmod(0o600)
        (folder / "known_hosts").write_text("\n".join([*known, ""]), encoding="utf-8")
        (folder / "config").write_text("Host *\n  StrictHostKeyChecking yes\n", encoding="utf-8")


def _settings(own: Mapping[str, str]) -> dict[str, str]:
    """The settings of an sshd that is started by nobody but a test."""
    usual = {
        "Port": "22",
        "ListenAddress": "0.0.0.0",  # noqa: S104  of a network that only hosts of a test have
        "HostKey": "/tmp/sshd/host_key",  # noqa: S108  its own
        "AuthorizedKeysFile": "/tmp/sshd/authorized_keys",  # noqa: S108  its own
        "PermitRootLogin": "prohibit-password",
        "PasswordAuthentication": "no",
        "KbdInteractiveAuthentication": "no",
        "UsePAM": "no",
        "StrictModes": "no",
        "PidFile": "none",
        "Subsystem": "sftp internal-sftp",
        "LogLevel": "VERBOSE",
    }
    if measured := os.environ.get("COVERAGE_PROCESS_START"):
        usual["SetEnv"] = f"COVERAGE_PROCESS_START={measured}"
    return {key: value for key, value in usual.items() if key not in own}


@contextmanager
def ssh_hosts(folder: Path, names: Sequence[str] = ("a", "b")) -> Iterator[SshHosts]:
    """Hosts with an sshd each; ``folder`` is empty."""
    _SEPARATION.mkdir(mode=0o755, exist_ok=True)
    (keys := folder / "keys").mkdir()
    with started_hosts(folder, names) as hosts:
        entered = SshHosts(hosts, keys)
        for host in hosts[1:]:
            first = hosts[0].start("ssh", "-o", "BatchMode=yes", host.name, "hostname; pwd")
            assert first.wait() == 0, first.story() + entered.daemons[host.name].story()
            assert first.output.split() == [host.name, HOME]
        yield entered
