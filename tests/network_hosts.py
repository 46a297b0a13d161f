"""Hosts on this machine: each has process ids, mounts, a host name, a network, a `/tmp` and a home folder of its own.

Without all of these, the processes of two hosts find the shared memory, the sockets and the cached files of each other,
and a test does not use the network.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Final

import psutil
import pytest

from tests.helpers import DEADLINE_S, Launched, wait_until

__all__ = ["HOME", "NEEDS_HOSTS", "NetworkHost", "link_is", "started_apart", "started_hosts"]

_ROOT: Final = Path(__file__).resolve().parents[1]
_HIDDEN: Final = "/tmp"  # noqa: S108  of which each host has its own
HOME: Final = f"{_HIDDEN}/home"
"""The home folder of the user on each host."""
_TOOLS: Final = ("unshare", "nsenter", "ip")
_ROOT_S_HOME: Final = re.compile(r"^(root:(?:[^:]*:){4})[^:]*", re.MULTILINE)
_SPACES: Final = ("--net", "--pid", "--mount", "--uts", "--ipc")

NEEDS_HOSTS = pytest.mark.skipif(
    os.geteuid() != 0
    or any(shutil.which(tool) is None for tool in _TOOLS)
    or subprocess.run(["unshare", *_SPACES, "true"], capture_output=True, check=False).returncode != 0,
    reason="needs root, namespaces, and the commands unshare, nsenter and ip",
)


class NetworkHost:
    """One host: commands run in `/tmp/own-clone`, which has copies of the examples.

    Args:
        name: its host name.
        folder: an empty folder of this machine; it is `/tmp` there.
        shared: a folder of this machine that it has at `/mnt`.
        addresses: what it finds in its `/etc/hosts`, by name.

    Attributes:
        name: as above.
        folder: as above.
        home: where its home folder is on this machine.
        pid: its first process.
    """

    def __init__(self, name: str, folder: Path, shared: Path, addresses: Mapping[str, str]) -> None:
        self.name = name
        self.folder = folder
        (home := folder / Path(HOME).name).mkdir()
        self.home = home
        for part in ("configs", "fmus"):
            shutil.copytree(_ROOT / part, folder / "own-clone" / part)
        lines = [f"{address} {other}\n" for other, address in addresses.items()]
        (folder / "etc_hosts").write_text("".join(lines), encoding="utf-8")
        users = _ROOT_S_HOME.sub(rf"\g<1>{HOME}", Path("/etc/passwd").read_text(encoding="utf-8"))
        users += f"user:x:0:0::{HOME}:/bin/bash\n"  # as the pages call the one who works there
        (folder / "etc_passwd").write_text(users, encoding="utf-8")
        steps = (
            f"hostname {name}",
            "ip link set lo up",
            f"mount --bind {shared} /mnt",
            f"mount --bind {folder}/etc_hosts /etc/hosts",
            f"mount --bind {folder}/etc_passwd /etc/passwd",
            "mount -t tmpfs own /dev/shm",
            *_mounted_checkout(folder),
            f"mount --rbind {folder} {_HIDDEN}",
            "exec sleep infinity",
        )
        command = ["unshare", *_SPACES, "--mount-proc", "--fork", "--kill-child", "sh", "-ec", "\n".join(steps)]
        self._started: list[Launched] = []
        self._outer = Launched(command, os.environ, folder)
        self.pid = wait_until(self._first_process, f"the first process of a host; {self._outer.errors}")

    def start(self, *command: str, **environment: str) -> Launched:
        """Start a command there; its first word may be `fmu-mesh`."""
        program = [sys.executable, "-m", "fmu_mesh"] if command[0] == "fmu-mesh" else [command[0]]
        kept = {name: os.environ[name] for name in ("PATH", "COVERAGE_PROCESS_START") if name in os.environ}
        entered = ["nsenter", f"--target={self.pid}", *_SPACES, "--wdns=/tmp/own-clone"]
        launched = Launched(
            [*entered, *program, *command[1:]], kept | {"COLUMNS": "1000", "HOME": HOME} | environment, self.folder
        )
        self._started.append(launched)
        return launched

    def processes(self) -> list[psutil.Process]:
        """All processes there, without the first one; their ids are those of this machine."""
        namespace = Path(f"/proc/{self.pid}/ns/pid").readlink()
        found = []
        for process in psutil.process_iter():
            with suppress(OSError, psutil.Error):
                if process.pid != self.pid and Path(f"/proc/{process.pid}/ns/pid").readlink() == namespace:
                    found.append(process)
        return found

    def close(self) -> None:
        """End everything there."""
        self._outer.close()
        for launched in self._started:
            launched.close()

    def _first_process(self) -> int | None:
        children = psutil.Process(self._outer.pid).children()
        return next((child.pid for child in children if child.name() == "sleep"), None)


def _mounted_checkout(folder: Path) -> list[str]:
    """Commands that keep the checkout where it is, if that is below the `/tmp` that the host does not see."""
    if not _ROOT.is_relative_to(_HIDDEN):
        return []
    seen = folder / _ROOT.relative_to(_HIDDEN)
    return [f"mkdir -p {seen}", f"mount --bind {_ROOT} {seen}"]


@contextmanager
def started_hosts(
    folder: Path, names: Sequence[str] = ("first", "second"), *, wired: bool = True
) -> Iterator[list[NetworkHost]]:
    """Hosts with a network between them, if they are ``wired``; the first one is also called `router`."""
    (shared := folder / "shared").mkdir()
    addresses = {"localhost": "127.0.0.1", "router": _address(1)}
    addresses |= {name: _address(number) for number, name in enumerate(names, 1)}
    with ExitStack() as stack:
        hosts = []
        for number, name in enumerate(names, 1):
            (own := folder / f"host{number}").mkdir()
            hosts.append(NetworkHost(name, own, shared, addresses))
            stack.callback(hosts[-1].close)
        if wired:
            _wire(hosts)
        yield hosts


def _address(number: int) -> str:
    return f"10.77.0.{number}"


def _wire(hosts: Sequence[NetworkHost]) -> None:
    """Give each host a device `wire`: that of the first one is a bridge, which has a port for each other host."""
    first, *others = (["nsenter", f"--target={host.pid}", "--net", "ip"] for host in hosts)
    steps = [[*first, *["link", "add", "wire", "type", "bridge", "forward_delay", "0"]]]
    for number, (host, ip) in enumerate(zip(hosts[1:], others, strict=True), 2):
        port = f"port{number}"
        steps += [
            [*first, *f"link add {port} master wire type veth peer name wire netns {host.pid}".split()],
            [*first, *f"link set {port} up".split()],
            [*ip, *f"addr add {_address(number)}/24 dev wire".split()],
            [*ip, *["link", "set", "wire", "up"]],
        ]
    steps += [
        [*first, *f"addr add {_address(1)}/24 dev wire".split()],
        [*first, *["link", "set", "wire", "up"]],
    ]
    for step in steps:
        subprocess.run(step, check=True, timeout=DEADLINE_S)


def link_is(host: NetworkHost, state: str) -> None:
    """Bring the network of a host ``up`` or ``down``."""
    assert host.start("ip", "link", "set", "wire", state).wait() == 0


def started_apart(
    hosts: Sequence[NetworkHost],
    config: Path,
    nodes: Sequence[str],
    *options: str,
    environment: Mapping[str, str] = {},
) -> list[Launched]:
    """Start a master with these options and every second node on the first host, and the other nodes on the second one.

    Args:
        hosts: both.
        config: relative to the folder of the copies, which has it on both hosts.
        nodes: their names.
        options: of the master.
        environment: more variables of all processes.
    """
    first, second = hosts
    there = ["--connect", "tcp/router:7447", "--insecure"]
    master = ["fmu-mesh", "master", str(config), "--listen", "tcp/0.0.0.0:7447", "--insecure"]
    master += ["--no-progress", *options]
    return [
        first.start(*master, **environment),
        *(first.start("fmu-mesh", "node", str(config), node, **environment) for node in nodes[::2]),
        *(second.start("fmu-mesh", "node", str(config), node, *there, **environment) for node in nodes[1::2]),
    ]
