"""Slurm: its programs, and what is known of a job; `slurm_mesh` has the job of a mesh, and `sweeps` that of a sweep.

It knows the programs of Slurm and what they print, and needs no accounting database: where there is one, it also tells
how jobs ended that `squeue` has forgotten.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import msgspec

from ..errors import ConfigurationError, DeadlineExceeded, FmuMeshError
from ..files import write_whole
from ..installing import PROGRAMS

__all__ = [
    "COMPLETED",
    "ENDED",
    "SlurmJob",
    "accounted",
    "cancel",
    "check_option",
    "end_of_log",
    "log_option",
    "queued",
    "submitted",
]

_LOG: Final = "slurm-{task}.log"
_SUBMIT_S, _ASK_S = 60.0, 30.0
_TAIL = 1 << 16
"""Length in bytes of the end of a log that is looked at."""

COMPLETED: Final = "COMPLETED"
ENDED: Final = frozenset(
    f"BOOT_FAIL CANCELLED {COMPLETED} DEADLINE FAILED NODE_FAIL OUT_OF_MEMORY PREEMPTED REVOKED TIMEOUT".split()
)
"""States in which a task never runs again. A task that Slurm queues again is PENDING (squeue, job state codes)."""

_OVERRULING: Final = (
    *("SBATCH_ARRAY_INX", "SBATCH_ERROR", "SBATCH_OPEN_MODE", "SBATCH_OUTPUT", "SBATCH_WAIT"),
    *("SQUEUE_", "SCANCEL_"),
)
"""Beginnings of the environment variables with which a user changes what the programs do or print."""


class SlurmJob(msgspec.Struct, frozen=True):
    """A job that was submitted: an array, or one that runs a mesh.

    Example:
        >>> SlurmJob("4711", Path("damping/sweep.sbatch"), tasks=8).log(3)
        PosixPath('damping/slurm-3.log')
    """

    id: str  # number of the job, as `squeue --jobs` and `scancel` take it
    script: Path  # its batch script, in the folder that also has the logs
    tasks: int = 1  # those of an array; they are numbered from 1
    cluster: str | None = None  # name of the cluster, if `sbatch` has named one

    def log(self, task: int = 1) -> Path:
        """The file with what a task has printed."""
        return self.script.with_name(_LOG.format(task=task))


def log_option(folder: Path, task: str) -> str:
    """The option of `sbatch` with the log of a task, in the folder of the script; ``task`` may be words of Slurm.

    Raises:
        ConfigurationError: Slurm cannot write there.
    """
    if "\\" in str(folder.absolute()):
        raise ConfigurationError(f"Slurm can write no log into '{folder}': there is a backslash in its name")
    log = str(folder.absolute()).replace("%", "%%") + "/" + _LOG.format(task=task)  # Slurm replaces %a, in folders, too
    if not log.isprintable():  # a line break would end the comment; tasks run in this folder anyway
        log = _LOG.format(task=task)
    return f"--output={shlex.quote(log)}"


def check_option(option: str, own: Mapping[str, str], whose: str) -> None:
    """Check that an option can be a line of a script of `sbatch`, and is none of its ``own``, by their long form.

    Raises:
        ConfigurationError: it is not.
    """
    if not option.startswith("-") or not option.isprintable():
        hint = "Write it as `sbatch` takes it, such as --slurm-option=--partition=short."
        raise ConfigurationError(f"{option!r} is no option of `sbatch`", hint=hint)
    for long, short in own.items():  # `sbatch` understands the beginning of a long option, too
        if long.startswith(re.split(r"[= ]", option)[0]) or (short and option.startswith(short)):
            raise ConfigurationError(f"'{option}' cannot be given to `sbatch`: {whose} sets {long} itself")


def submitted(script: Path, text: str, *, tasks: int = 1) -> SlurmJob:
    """Write a batch script into its folder, and submit it.

    Raises:
        ConfigurationError: there is no `sbatch`, it refuses the job, or the script cannot be written.
        DeadlineExceeded: `sbatch` has not answered.
    """
    write_whole(script, text.encode(errors="surrogateescape"), "the batch script ")
    try:
        code, printed, errors = _run(["sbatch", "--parsable", script.name], _SUBMIT_S, folder=script.parent)
    except DeadlineExceeded as error:
        raise error.with_hint("`squeue --me` shows whether the job was submitted.") from None
    if code:
        hint = f"The batch script is '{script}'."
        raise ConfigurationError(f"`sbatch` has not submitted the job: {_words(errors)}", hint=hint)
    found = re.findall(r"^(\d+)(?:;(\S+))?$", printed, re.MULTILINE)
    if not found:
        hint = "`squeue --me` shows whether the job was submitted."
        raise ConfigurationError(f"`sbatch` has printed no number of a job, but {printed.strip()!r}", hint=hint)
    return SlurmJob(found[-1][0], script, tasks, found[-1][1] or None)


def queued(job: SlurmJob, form: str) -> list[str] | None:
    """What `squeue` says of the tasks or components of a job, in its format; None if it does not answer.

    It forgets a task some minutes after its end (MinJobAge in slurm.conf), and then the whole job. It takes up to 30 s.
    """
    words = ["--noheader", "--array", "--states=all", f"--format={form}", f"--jobs={job.id}"]
    try:
        code, printed, errors = _run(["squeue", *_on_cluster(job), *words], _ASK_S)
    except FmuMeshError:
        return None
    if code:
        return [] if _is_forgotten(errors) else None
    return [line.strip() for line in printed.splitlines() if line.strip() and not line.startswith("CLUSTER:")]


def accounted(job: SlurmJob) -> dict[int, str]:
    """The states of ended tasks in the accounting database, with exit code and signal; empty where there is none.

    The tasks of an array are counted from 1, as are the components of a job.
    """
    form = ["--noheader", "--allocations", "--parsable2", "--format=JobID,State,ExitCode"]
    try:
        code, printed, _ = _run(["sacct", *_on_cluster(job), *form, f"--jobs={job.id}"], _ASK_S)
    except FmuMeshError:
        return {}
    line = rf"^{job.id}(?:_(\d+)|\+(\d+))?\|([A-Z_]+)[^|]*\|(\d+):(\d+)$"
    states = {}
    for match in re.finditer(line, printed if not code else "", re.MULTILINE):
        task, component, state, exit_code, number = match.groups()
        how = f" by signal {number}" if number != "0" else f" with exit code {exit_code}" if exit_code != "0" else ""
        if state in ENDED:
            states[int(task or 1 + int(component or 0))] = f"{state}{how}"
    return states


def cancel(job: SlurmJob) -> None:
    """Cancel a job, with all its tasks; one that has ended stays as it is.

    Raises:
        ConfigurationError: `scancel` refuses it, or is missing.
        DeadlineExceeded: `scancel` has not answered.
    """
    code, _, errors = _run(["scancel", *_on_cluster(job), job.id], _ASK_S)
    if code and not _is_forgotten(errors):
        raise ConfigurationError(f"`scancel {job.id}` failed: {_words(errors)}")


def end_of_log(log: Path) -> str | None:
    """The end of a log, without white space at its own end; None if it cannot be read."""
    try:
        with log.open("rb") as file:
            file.seek(-min(_TAIL, os.fstat(file.fileno()).st_size), os.SEEK_END)
            return file.read().decode(errors="replace").rstrip()
    except OSError:
        return None


def _is_forgotten(errors: str) -> bool:
    """Whether Slurm says that it does not know a job: it has ended long ago."""
    return "Invalid job id specified" in errors


def _on_cluster(job: SlurmJob) -> list[str]:
    return [f"--clusters={job.cluster}"] if job.cluster else []


def _words(errors: str) -> str:
    """What a program of Slurm has written to standard error, in one line and without its own name."""
    lines = [re.sub(r"^\w+: (error: |fatal: )?", "", line.strip()) for line in errors.splitlines()]
    return "; ".join(filter(None, lines)) or "it gives no reason"


def _run(command: Sequence[str], deadline_s: float, *, folder: Path | None = None) -> tuple[int, str, str]:
    """Run a program of Slurm; returns its exit code, output and errors.

    It is in a process group of its own: Ctrl-C does not reach it, and after the deadline it ends with all that it has
    started, since on some clusters it is a script around the real one.
    """
    environment = {name: value for name, value in os.environ.items() if not name.startswith(_OVERRULING)}
    try:
        child = subprocess.Popen(
            command,
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            process_group=0,
        )
    except OSError as error:
        text, (_, hint) = f"`{command[0]}` cannot be started: {error.strerror}", PROGRAMS["sbatch"]
        raise ConfigurationError(text, hint=hint) from error
    with child:
        try:
            output, errors = child.communicate(timeout=deadline_s)
        except BaseException as error:
            os.killpg(child.pid, signal.SIGKILL)  # `child` was not waited for, so its number is still its own
            if isinstance(error, subprocess.TimeoutExpired):
                raise DeadlineExceeded(f"`{command[0]}` has not answered for {deadline_s:g} s") from None
            raise
    return child.returncode, output, errors
