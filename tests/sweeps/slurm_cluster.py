"""A real Slurm cluster on this host, for tests: one controller, and two daemons that stand for two hosts.

Everything is in one folder: configuration, key, socket, logs, state. The ports are free ones, and no service of the
system is touched. The daemons are children of this process; the kernel ends them with it.
"""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import socket
import subprocess
import time
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

import psutil

from tests.helpers import DEADLINE_S, wait_until

__all__ = ["NODES", "SlurmCluster", "missing"]

NODES = ("n1", "n2")
"""Names of the two hosts; each offers two processors."""

_PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "scancel", "scontrol", "setpriv", "sinfo", "squeue")

_CONFIGURATION = """
ClusterName=fmu_mesh_test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool-%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd-%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd-%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
MpiDefault=none
ReturnToService=2
KillWait=2
SchedulerParameters=batch_sched_delay=0,sched_min_interval=0,bf_interval=1
NodeName=n1 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[1]} CPUs=2 State=UNKNOWN
NodeName=n2 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[2]} CPUs=2 State=UNKNOWN
PartitionName=all Nodes=n1,n2 Default=YES MaxTime=INFINITE State=UP
"""


def missing() -> str | None:
    """Why there is no cluster here; None if there can be one."""
    if not os.environ.get("FMU_MESH_SLURM"):
        return "it starts the daemons of a cluster; `.ci/long slurm` does that"
    if os.getuid() != 0:
        return "only root can start the daemons of Slurm"
    # Debian has the daemons in a folder that is on the path of root only.
    lacking = [name for name in _PROGRAMS if shutil.which(name, path=_path()) is None]
    if lacking:
        return f"Slurm is not installed (no {', '.join(lacking)}): apt install slurmctld slurmd slurm-client munge"
    return None


class SlurmCluster:
    """One cluster; use it as a context manager.

    Args:
        folder: an empty folder; its path must be short, because it has a socket.

    Attributes:
        environment: the environment variables with which the programs of Slurm reach this cluster.
        controller: the process of the controller.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stack = ExitStack()
        self.environment = {"SLURM_CONF": str(folder / "slurm.conf"), "PATH": _path()}

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._stack = stack
            self._start()
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def ask(self, *command: str) -> str:
        """What a program of Slurm prints."""
        done = subprocess.run(
            command, env={**os.environ, **self.environment}, capture_output=True, text=True, check=True, timeout=30
        )
        return done.stdout

    def states(self, job: str) -> dict[int, str]:
        """The state of each task of an array, as Slurm sees it."""
        lines = self.ask("squeue", "--noheader", "--array", "--states=all", "--format=%K %T", f"--jobs={job}").split(
            "\n"
        )
        return {int(line.split()[0]): line.split()[1] for line in lines if line}

    def jobs(self) -> list[str]:
        """The numbers of the jobs that wait or run."""
        return sorted(set(self.ask("squeue", "--noheader", "--array", "--format=%F").split()))

    def begin_again(self, job: str) -> None:
        """Let a job that was queued again begin; Slurm would wait for two minutes.

        It is pending at once, and waits for its time when its host has let go of it; before, an update ends it. In the
        second of its end, the host refuses to start it: "Job credential revoked". A later time than now would wait for
        the next round of the controller, which comes once a minute.
        """
        reason = partial(self.ask, "squeue", "--noheader", "--jobs", job, "--format", "%r")
        wait_until(lambda: "BeginTime" in reason(), f"job {job} in the queue")
        another_second = time.time() + 1.5
        wait_until(lambda: time.time() > another_second, "another second")
        self.ask("scontrol", "update", f"JobId={job}", "StartTime=now")

    def cancel_all(self) -> None:
        """Cancel what a test has left, and wait until it has ended."""
        with suppress(subprocess.SubprocessError):
            self.ask("scancel", "--me")
            wait_until(lambda: not self.jobs(), "the end of all jobs", 20)

    def _start(self) -> None:
        folder = self._folder
        folder.chmod(0o755)
        self._stack.callback(self._kill_steps)
        (folder / "state").mkdir()
        key = folder / "munge.key"
        key.write_bytes(secrets.token_bytes(128))
        key.chmod(0o400)
        with ExitStack() as sockets:
            free = [sockets.enter_context(socket.socket()) for _ in range(3)]
            for one in free:
                one.bind(("127.0.0.1", 0))
            ports = [one.getsockname()[1] for one in free]
        text = _CONFIGURATION.format(host=socket.gethostname().partition(".")[0], folder=folder, ports=ports)
        (folder / "slurm.conf").write_text(text, encoding="utf-8")
        files = [f"--{name}-file={folder}/munge.{name}" for name in ("key", "pid", "log", "seed")]
        self._daemon("munged", "--foreground", f"--socket={folder}/munge.socket", *files)
        wait_until((folder / "munge.socket").exists, "the socket of munged")
        self.controller = self._daemon("slurmctld", "-D")
        for name in NODES:
            self._daemon("slurmd", "-D", "-N", name)
        self._stack.callback(self.cancel_all)
        wait_until(self._is_ready, f"two idle hosts; see the logs in {folder}")

    def _daemon(self, *command: str) -> subprocess.Popen[bytes]:
        log = self._stack.enter_context((self._folder / f"{command[0]}.out").open("ab"))
        process = subprocess.Popen(
            ["setpriv", "--pdeathsig", "KILL", *command],
            env={**os.environ, **self.environment},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            process_group=0,
        )
        self._stack.callback(_end, process)
        return process

    def _is_ready(self) -> bool:
        with suppress(subprocess.CalledProcessError):
            return self.ask("sinfo", "--noheader", "--Node", "--format=%N %T").split() == ["n1", "idle", "n2", "idle"]
        return False

    def _kill_steps(self) -> None:
        """End the steps and jobs whose daemon has ended before them."""
        for process in psutil.process_iter():
            with suppress(psutil.Error):
                if process.pid != os.getpid() and self._is_ours(process):
                    process.kill()

    def _is_ours(self, process: psutil.Process) -> bool:
        """Whether a process belongs to this cluster: a step has lost its environment, and keeps a log open."""
        if process.environ().get("SLURM_CONF") == self.environment["SLURM_CONF"]:
            return True
        return "slurm" in process.name() and any(
            Path(file.path).is_relative_to(self._folder) for file in process.open_files()
        )


def _path() -> str:
    return f"{os.environ.get('PATH', os.defpath)}:/usr/sbin:/sbin"


def _end(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGCONT)
    process.terminate()
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait(DEADLINE_S)
