"""An array of jobs on a Slurm cluster: write the batch script, submit it, ask how far it is.

Task K of N runs one command, which is told its part as ``K/N``, from 1 on. The programs of Slurm are in
`fmu_mesh.hosts.slurm`; this module does not know what the command does.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from ..hosts.slurm import COMPLETED, ENDED, SlurmJob, accounted, check_option, end_of_log, log_option, queued, submitted

__all__ = ["PART", "EndedTask", "ended_tasks", "submit", "unfinished"]

PART: Final = "{part}"
"""The word of a command that stands for the part of a task, such as ``3/8``."""

_SCRIPT: Final = "sweep.sbatch"
_OWN_OPTIONS: Final = {
    "--array": "-a",
    "--chdir": "-D",
    "--cpus-per-task": "-c",
    "--error": "-e",
    "--open-mode": "",
    "--output": "-o",
    "--wait": "-W",
}
"""Options of `sbatch` that belong to the sweep, with their short form."""


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
        check_option(option, _OWN_OPTIONS, "the sweep")
    limit = f"%{at_once}" if at_once is not None else ""
    script = folder.absolute() / _SCRIPT
    settings = [
        f"--job-name={shlex.quote(name)}",
        f"--array=1-{tasks}{limit}",
        "--nodes=1",
        "--ntasks=1",
        f"--cpus-per-task={cpus}",
        log_option(folder, "%a"),
        "--open-mode=append",
        "--requeue",
        *options,
    ]
    words = " ".join(f'"$SLURM_ARRAY_TASK_ID"/{tasks}' if word == PART else shlex.quote(word) for word in command)
    # Slurm sends its signals to this one process; with a shell around the command they would not reach it.
    lines = ["#!/bin/sh", *(f"#SBATCH {setting}" for setting in settings), f"exec {words}"]
    return submitted(script, "\n".join([*lines, ""]), tasks=tasks)


def unfinished(job: SlurmJob) -> int | None:
    """How many tasks of a job wait or run; None if Slurm does not answer now.

    It takes up to 30 s. Ask every 10 s or less often: the controller serves all users of the cluster.
    """
    states = _in_queue(job)
    return None if states is None else sum(1 for state in states.values() if state not in ENDED)


def ended_tasks(job: SlurmJob) -> tuple[EndedTask, ...]:
    """The tasks of a job that have ended, without those that are known to be completed.

    How they ended is known by `squeue` for some minutes, and by `sacct` where the cluster has an accounting database.
    """
    in_queue, in_database = _in_queue(job) or {}, accounted(job)
    found = []
    for task in range(1, job.tasks + 1):
        state = in_queue.get(task)
        if state is None or state in ENDED:
            state = in_database.get(task, state)
            if state != COMPLETED:
                found.append(EndedTask(task, state, job.log(task), _last_line(job.log(task))))
    return tuple(found)


def _in_queue(job: SlurmJob) -> dict[int, str] | None:
    """The states of the tasks that `squeue` knows, by their numbers; None if it does not answer."""
    if (lines := queued(job, "%K|%T")) is None:
        return None
    found = [re.fullmatch(r"(\d+)\|([A-Z_]+)", line) for line in lines]
    return {int(match[1]): match[2] for match in found if match} if all(found) else None


def _last_line(log: Path) -> str | None:
    """The last line of a log that is not empty; None if it cannot be read."""
    return None if (end := end_of_log(log)) is None else end.rpartition("\n")[2].strip()
