"""An array of jobs on a Slurm cluster: write the batch script, submit it, ask how far it is.

Task K of N runs one command, which is told its part as ``K/N``, from 1 on. This module knows the programs of Slurm and
what they print; it does not know what the command does. It needs no accounting database: where there is one, it also
tells how tasks ended that `squeue` has forgotten.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from ..errors import ConfigurationError, DeadlineExceeded, FmuMeshError

__all__ = ["PART", "EndedTask", "SlurmJob", "cancel", "ended_tasks", "submit", "unfinished"]

PART: Final = "{part}"
"""The word of a command that stands for the part of a task, such as ``3/8``."""

_SCRIPT = "sweep.sbatch"
_LOG = "slurm-{task}.log"
_SUBMIT_S, _ASK_S = 60.0, 30.0
_TAIL = 4096
"""Length in bytes of the end of a log in which its last line is looked for."""

_COMPLETED = "COMPLETED"
_ENDED = frozenset(
    {
        "BOOT_FAIL",
        "CANCELLED",
        _COMPLETED,
        "DEADLINE",
        "FAILED",
        "NODE_FAIL",
        "OUT_OF_MEMORY",
        "PREEMPTED",
        "REVOKED",
        "TIMEOUT",
    }
)
"""States in which a task never runs again. A task that Slurm queues again is PENDING (squeue, job state codes)."""

_OWN_OPTIONS = {
    "--array": "-a",
    "--chdir": "-D",
    "--cpus-per-task": "-c",
    "--error": "-e",
    "--open-mode": "",
    "--output": "-o",
    "--wait": "-W",
}
"""Options of `sbatch` that belong to the sweep, with their short form."""

_OVERRULING = (
    "SBATCH_ARRAY_INX",
    "SBATCH_ERROR",
    "SBATCH_OPEN_MODE",
    "SBATCH_OUTPUT",
    "SBATCH_WAIT",
    "SQUEUE_",
    "SCANCEL_",
)
"""Beginnings of the environment variables with which a user changes what the programs do or print."""


class SlurmJob(msgspec.Struct, frozen=True):
    """An array of jobs that was submitted.

    Example:
        >>> SlurmJob("4711", Path("damping/sweep.sbatch"), tasks=8).log(3)
        PosixPath('damping/slurm-3.log')
    """

    id: str  # number of the job, as `squeue --jobs` and `scancel` take it
    script: Path  # its batch script, in the folder that also has the logs
    tasks: int  # they are numbered from 1
    cluster: str | None = None  # name of the cluster, if `sbatch` has named one

    def log(self, task: int) -> Path:
        """The file with what a task has printed."""
        return self.script.with_name(_LOG.format(task=task))


class EndedTask(NamedTuple):
    """A task that has ended and was not completed; or nobody knows any more how it ended.

    Example:
        >>> print(EndedTask(3, "TIMEOUT", Path("damping/slurm-3.log"), "error: *** CANCELLED DUE TO TIME LIMIT ***"))
        task 3: TIMEOUT; the last line of 'damping/slurm-3.log': error: *** CANCELLED DUE TO TIME LIMIT ***
    """

    task: int
    # the state of Slurm, such as FAILED, TIMEOUT, NODE_FAIL or OUT_OF_MEMORY; None if it is not known
    state: str | None
    log: Path  # the file with what it has printed
    last_line: str | None  # the last line there; None if there is no such file

    def __str__(self) -> str:
        if self.last_line is None:
            what = f"there is no '{self.log}'; it did not start, or its host cannot write to this folder"
        elif not self.last_line:
            what = f"'{self.log}' is empty"
        else:
            what = f"the last line of '{self.log}': {self.last_line}"
        return f"task {self.task}: {self.state or 'its state is not known'}; {what}"


def submit(  # noqa: PLR0913  each is a line of the script
    folder: Path,
    command: Sequence[str],
    *,
    name: str,
    tasks: int,
    at_once: int | None,
    cpus: int,
    options: Sequence[str],
) -> SlurmJob:
    """Write ``sweep.sbatch`` into a folder, and submit it as an array of jobs.

    A task that Slurm queues again, because its host was lost or a more important job came, runs the same command again.

    Args:
        folder: an existing folder that all hosts share. The tasks run there and write their logs there.
        command: a program and its arguments; the word ``{part}`` (`PART`) stands for the part of a task, such as 3/8.
        name: of the job, as `squeue` shows it.
        tasks: number of tasks.
        at_once: how many of them may run at the same time; None: any number.
        cpus: processors of each task.
        options: more options of `sbatch`, such as ``--partition=short``; each becomes a line of the script.

    Raises:
        ConfigurationError: there is no `sbatch`, it refuses the job, or an option is none.
        DeadlineExceeded: `sbatch` has not answered.
    """
    for option in options:
        _check_option(option)
    limit = f"%{at_once}" if at_once is not None else ""
    script = folder.absolute() / _SCRIPT
    log = str(script.parent).replace("%", "%%") + "/" + _LOG.format(task="%a")  # Slurm replaces %a, in folders, too
    if not log.isprintable():  # a line break would end the comment; tasks run in this folder anyway
        log = _LOG.format(task="%a")
    settings = [
        f"--job-name={shlex.quote(name)}",
        f"--array=1-{tasks}{limit}",
        "--nodes=1",
        "--ntasks=1",
        f"--cpus-per-task={cpus}",
        f"--output={shlex.quote(log)}",
        "--open-mode=append",
        "--requeue",
        *options,
    ]
    words = " ".join(f'"$SLURM_ARRAY_TASK_ID"/{tasks}' if word == PART else shlex.quote(word) for word in command)
    # Slurm sends its signals to this one process; with a shell around the command they would not reach it.
    lines = ["#!/bin/sh", *(f"#SBATCH {setting}" for setting in settings), f"exec {words}"]
    try:
        script.write_text("\n".join([*lines, ""]), encoding="utf-8", errors="surrogateescape")
    except OSError as error:
        raise ConfigurationError(f"the batch script '{script}' cannot be written: {error.strerror}") from error
    printed = _submitted(script)
    found = re.findall(r"^(\d+)(?:;(\S+))?$", printed, re.MULTILINE)
    if not found:
        hint = "`squeue --me` shows whether the job was submitted."
        raise ConfigurationError(f"`sbatch` has printed no number of a job, but {printed.strip()!r}", hint=hint)
    return SlurmJob(found[-1][0], script, tasks, found[-1][1] or None)


def unfinished(job: SlurmJob) -> int | None:
    """How many tasks of a job wait or run; None if Slurm does not answer now.

    It takes up to 30 s. Ask every 10 s or less often: the controller serves all users of the cluster.
    """
    states = _in_queue(job)
    return None if states is None else sum(1 for state in states.values() if state not in _ENDED)


def ended_tasks(job: SlurmJob) -> tuple[EndedTask, ...]:
    """The tasks of a job that have ended, without those that are known to be completed.

    How they ended is known by `squeue` for some minutes, and by `sacct` where the cluster has an accounting database.
    """
    queued, accounted = _in_queue(job) or {}, _accounted(job)
    found = []
    for task in range(1, job.tasks + 1):
        state = queued.get(task)
        if state is None or state in _ENDED:
            state = accounted.get(task, state)
            if state != _COMPLETED:
                found.append(EndedTask(task, state, job.log(task), _last_line(job.log(task))))
    return tuple(found)


def cancel(job: SlurmJob) -> None:
    """Cancel all tasks of a job; a job that has ended stays as it is.

    Raises:
        ConfigurationError: `scancel` refuses it, or is missing.
        DeadlineExceeded: `scancel` has not answered.
    """
    code, _, errors = _run(["scancel", *_on_cluster(job), job.id], _ASK_S)
    if code and not _is_forgotten(errors):
        raise ConfigurationError(f"`scancel {job.id}` failed: {_words(errors)}")


def _check_option(option: str) -> None:
    """Refuse an option that cannot be a line of the script, or belongs to the sweep."""
    if not option.startswith("-") or not option.isprintable():
        hint = "Write it as `sbatch` takes it, such as --slurm-option=--partition=short."
        raise ConfigurationError(f"{option!r} is no option of `sbatch`", hint=hint)
    for long, short in _OWN_OPTIONS.items():  # `sbatch` understands the beginning of a long option, too
        if long.startswith(re.split(r"[= ]", option)[0]) or (short and option.startswith(short)):
            raise ConfigurationError(f"'{option}' cannot be given to `sbatch`: the sweep sets {long} itself")


def _submitted(script: Path) -> str:
    try:
        code, printed, errors = _run(["sbatch", "--parsable", script.name], _SUBMIT_S, folder=script.parent)
    except DeadlineExceeded as error:
        raise error.with_hint("`squeue --me` shows whether the job was submitted.") from None
    if code:
        hint = f"The batch script is '{script}'."
        raise ConfigurationError(f"`sbatch` has not submitted the job: {_words(errors)}", hint=hint)
    return printed


def _in_queue(job: SlurmJob) -> dict[int, str] | None:
    """The states of the tasks that `squeue` knows, by their numbers; None if it does not answer.

    It forgets a task some minutes after its end (MinJobAge in slurm.conf), and then the whole job.
    """
    form = ["--noheader", "--array", "--states=all", "--format=%K|%T"]
    try:
        code, printed, errors = _run(["squeue", *_on_cluster(job), *form, f"--jobs={job.id}"], _ASK_S)
    except FmuMeshError:
        return None
    if code:
        return {} if _is_forgotten(errors) else None
    lines = [line for line in printed.splitlines() if line.strip() and not line.startswith("CLUSTER:")]
    found = [re.fullmatch(r"(\d+)\|([A-Z_]+)", line.strip()) for line in lines]
    return {int(match[1]): match[2] for match in found if match} if all(found) else None


def _accounted(job: SlurmJob) -> dict[int, str]:
    """The states of ended tasks in the accounting database, with exit code and signal; empty where there is none."""
    form = ["--noheader", "--allocations", "--parsable2", "--format=JobID,State,ExitCode"]
    try:
        code, printed, _ = _run(["sacct", *_on_cluster(job), *form, f"--jobs={job.id}"], _ASK_S)
    except FmuMeshError:
        return {}
    found = re.finditer(rf"^{job.id}_(\d+)\|([A-Z_]+)[^|]*\|(\d+):(\d+)$", printed if not code else "", re.MULTILINE)
    states = {}
    for task, state, exit_code, number in (match.groups() for match in found):
        how = f" by signal {number}" if number != "0" else f" with exit code {exit_code}" if exit_code != "0" else ""
        if state in _ENDED:
            states[int(task)] = f"{state}{how}"
    return states


def _last_line(log: Path) -> str | None:
    """The last line of a log that is not empty; None if it cannot be read."""
    try:
        with log.open("rb") as file:
            file.seek(-min(_TAIL, os.fstat(file.fileno()).st_size), os.SEEK_END)
            lines = [line.strip() for line in file.read().decode(errors="replace").splitlines()]
    except OSError:
        return None
    return next((line for line in reversed(lines) if line), "")


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
        hint = "Install the programs of Slurm (Debian, Ubuntu: apt install slurm-client), or run this on a login host."
        raise ConfigurationError(f"`{command[0]}` cannot be started: {error.strerror}", hint=hint) from error
    with child:
        try:
            output, errors = child.communicate(timeout=deadline_s)
        except BaseException as error:
            os.killpg(child.pid, signal.SIGKILL)  # `child` was not waited for, so its number is still its own
            if isinstance(error, subprocess.TimeoutExpired):
                raise DeadlineExceeded(f"`{command[0]}` has not answered for {deadline_s:g} s") from None
            raise
    return child.returncode, output, errors
