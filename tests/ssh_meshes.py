"""A mesh over hosts that `launch` enters by ssh: its files, its processes by their part, and what it leaves on them."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import psutil
import yaml

from fmu_mesh.run.options import PlanOptions
from tests.all_systems import written_system
from tests.helpers import DEADLINE_S, Launched, row_count, wait_until
from tests.network_hosts import NetworkHost
from tests.plain_run import PlainRun
from tests.planning import prepare
from tests.ssh_hosts import PYTHON, SshHosts

__all__ = ["MeshOverSsh", "mesh_over_ssh"]

_FOLDER: Final = Path("own-clone", "system")
_STAYS: Final = {"own-clone", "home"}
"""Folders of a host that a run may write to; all of its other files are looked at."""
_RUNTIME: Final = re.compile(r"fmu_mesh-\d+$")
"""The runtime folder of a user, which stays when no run has files in it."""


class MeshOverSsh:
    """A system whose first instance is on the first host, as its master; each next one is on the next host.

    Only the first host has the files of the system; its FMUs are in its own `/tmp`.

    Args:
        entered: the hosts.
        system: one of `tests.all_systems.SYSTEMS`.
        lasts_s: how long a run takes by the wall clock; 0: as short as it can.
        entries: by the name of a host: what is different in its entry in `deploy.hosts`.
        sections: more of the file.
    """

    def __init__(
        self,
        entered: SshHosts,
        system: str = "pendulum_delay",
        *,
        lasts_s: float = 0.0,
        entries: Mapping[str, Mapping[str, Any]] = {},
        **sections: Mapping[str, Any],
    ) -> None:
        self.entered = entered
        self.hosts = entered.hosts
        for host in self.hosts:
            shutil.rmtree(host.folder / _FOLDER, ignore_errors=True)
        folder = self.hosts[0].folder / _FOLDER
        self.config = written_system(system, folder, lasts_s=lasts_s, **sections)
        self.result = self.config.with_suffix(".csv")
        content = yaml.safe_load(self.config.read_text(encoding="utf-8"))
        others = [host.name for host in self.hosts[1:]]
        for number, instance in enumerate(content["instances"].values()):
            if (place := number % len(self.hosts)) and "group" not in instance:
                instance["host"] = others[place - 1]
            if Path(instance.get("fmu", "")).is_absolute():
                shutil.copy(instance["fmu"], folder)
                instance["fmu"] = Path(instance["fmu"]).name
        deploy = {name: {"ssh": name, "python": PYTHON, **entries.get(name, {})} for name in others}
        self.write({**content, "deploy": {"hosts": deploy}})
        self._before = [self._files(host) for host in self.hosts]
        self._launched: list[Launched] = []

    def write(self, content: Mapping[str, Any]) -> None:
        """Write the configuration anew."""
        text = yaml.safe_dump(dict(content), sort_keys=False, allow_unicode=True)
        self.config.write_text(text, encoding="utf-8")

    def launch(self, *options: str, **environment: str) -> Launched:
        """Start `launch` on the first host."""
        self.result.unlink(missing_ok=True)
        words = ("fmu-mesh", "launch", "system/system.yaml", "--no-progress", *options)
        self._launched.append(launched := self.hosts[0].start(*words, **environment))
        return launched

    def running(self, *options: str, rows: int = 1) -> Launched:
        """Start it, and wait until more than so many rows are written."""
        launched = self.launch(*options)
        wait_until(lambda: row_count(self.result) > rows or not launched.running, "some rows")
        assert launched.running, launched.story()
        return launched

    def process(self, part: str) -> psutil.Process:
        """A process of the run, as soon as it is there.

        Args:
            part: `launcher`, `master`, `relay`, `ssh`, `session` (of sshd), `helper`, or the name of a node.
        """
        return wait_until(lambda: self._process(part), f"the process of {part}")

    def expected(self) -> bytes:
        """The result of a run in one process, in the plainest way."""
        local = self.config.with_name("local.csv")
        PlainRun(prepare(self.config, PlanOptions(output=local))).run()
        return local.read_bytes()

    def left(self) -> list[str]:
        """In words what is there on any host and was not before: processes, and files outside the cache."""
        found = []
        for host, before in zip(self.hosts, self._before, strict=True):
            found += [f"{host.name}: process {one.pid}: {' '.join(_command(one))}" for one in self._processes(host)]
            found += [f"{host.name}: {path}" for path in sorted(self._files(host) - before)]
        return found

    def assert_nothing_left(self, within_s: float = DEADLINE_S) -> None:
        """Nothing may be left but the cache, ``within_s`` seconds from now."""
        with suppress(AssertionError):  # the one below says what is left
            wait_until(lambda: not self.left(), "empty hosts", within_s)
        left = self.left()
        assert not left, "\n".join(left)

    def close(self) -> None:
        """Kill what still runs, and remove its files, so that the next mesh finds hosts as they were."""
        for host in self.hosts:
            for process in self._processes(host):
                with suppress(psutil.Error):
                    process.kill()
        for launched in self._launched:
            launched.close()
        for host, before in zip(self.hosts, self._before, strict=True):
            for path in sorted(self._files(host) - before, reverse=True):
                path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink(missing_ok=True)

    def story(self) -> str:
        """What was started and said, and what is there."""
        daemons = [f"sshd of {name}:\n{one.errors}" for name, one in self.entered.daemons.items()]
        return "\n".join([*(one.story() for one in self._launched), *self.left(), *daemons])

    def _process(self, part: str) -> psutil.Process | None:
        host = self.hosts[0] if part in _HERE else None
        for process in (one for other in self.hosts if host in {None, other} for one in self._processes(other)):
            if _is_part(process, part):
                return process
        return None

    def _processes(self, host: NetworkHost) -> list[psutil.Process]:
        daemon = self.entered.daemons[host.name].pid
        found = []
        for process in host.processes():
            with suppress(psutil.Error):
                if process.ppid() != daemon and process.status() != psutil.STATUS_ZOMBIE:  # the first one reaps none
                    found.append(process)
        return found

    @staticmethod
    def _files(host: NetworkHost) -> set[Path]:
        own = [path for path in host.folder.iterdir() if path.name not in _STAYS]
        # A folder that goes away meanwhile is no error of `os.walk`, as it is of `rglob`.
        inner = ((Path(at), names) for folder in own for at, *both in os.walk(folder) for names in both)
        found = {*own, *(at / name for at, names in inner for name in names)}
        return {path for path in found if not _RUNTIME.match(str(path.relative_to(host.folder)))}


_HERE: Final = {"launcher", "master", "relay", "ssh"}
"""Parts that are on the host of `launch` only."""

_LINES: Final = {
    "launcher": r"\S+ -m fmu_mesh launch ",
    "relay": r"\S*python\S* .*relay",
    "ssh": r"(\S*/)?ssh ",
    "session": r"sshd: ",
    "helper": r"\S+ -Pu -m fmu_mesh\.hosts\.helper ",
    "master": r"fmu-mesh master",
}
"""How the command of each part begins; a node is named by its title."""


def _is_part(process: psutil.Process, part: str) -> bool:
    line = _LINES.get(part, rf"fmu-mesh node {part}( |$)")
    return re.match(line, " ".join(_command(process))) is not None


def _command(process: psutil.Process) -> Sequence[str]:
    try:
        return process.cmdline()
    except psutil.Error:
        return []


@contextmanager
def mesh_over_ssh(entered: SshHosts, system: str = "pendulum_delay", **options: Any) -> Iterator[MeshOverSsh]:  # noqa: ANN401  those of the class
    """A mesh, with nothing of it left on the hosts afterwards."""
    mesh = MeshOverSsh(entered, system, **options)
    try:
        yield mesh
    finally:
        mesh.close()
