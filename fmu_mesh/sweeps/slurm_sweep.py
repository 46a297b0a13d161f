"""`SlurmSweep`: the variants of a sweep in the tasks of an array of jobs, and how far they are.

Each task runs `fmu-mesh sweep FOLDER --part K/N` and writes its rows into the folder, which all hosts share. This side
only reads them, so it can be ended and started again while the tasks go on.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Sequence
from typing import Final

import msgspec

from ..errors import ConfigurationError, MeshLost
from ..files import decoded_json
from ..hosts.slurm import SlurmJob
from ..run.allowed_code import names_code
from ..text import short_path
from .planned_sweep import PlannedSweep
from .slurm_array import PART, ended_tasks, submit, unfinished
from .sweeping import Sweep
from .variant_run import path_of

__all__ = ["SlurmSweep"]

_JOB: Final = "slurm.json"
# A shared file system shows a new file after about a second, and each look costs its server something.
_FOLDER_CHECK_S: Final = 2.0
_ASK_S: Final = 10.0
_SILENCE_S: Final = 600.0
"""How long Slurm may leave questions without an answer, in s."""
_SHOWN: Final = 3


class SlurmSweep(Sweep):
    """A sweep whose variants run in the tasks of an array of jobs; all hosts share its folder.

    To leave it, or to interrupt it, leaves the tasks as they are. There are at most so many ``tasks``; each asks for
    one processor for each of its ``workers``. ``options`` are more options of `sbatch`, such as `--partition=short`.

    Raises:
        ConfigurationError: Slurm refuses it, or is not installed.
        DeadlineExceeded: Slurm does not answer.
    """

    def __init__(
        self, planned: PlannedSweep, *, tasks: int = 16, workers: int = 1, options: Sequence[str] = ()
    ) -> None:
        super().__init__(planned)
        if planned.functions:
            raise ConfigurationError("functions of a program cannot be columns of a sweep by Slurm.")
        planned.folder.begin(planned.wanted)
        self._note = planned.folder.path / _JOB
        self.job = self._submitted_before()  # None if nothing is missing
        if self.job is None and self._waiting:
            self.job = self._submit(min(tasks, len(self._waiting)), workers, options)
        self._thread.start()

    def _submitted_before(self) -> SlurmJob | None:
        """The job of an earlier call, unless Slurm says that all its tasks have ended."""
        try:
            job = decoded_json(self._note.read_bytes(), SlurmJob, path_of)
        except (OSError, ValueError):
            return None
        return None if unfinished(job) == 0 else job

    def _submit(self, tasks: int, workers: int, options: Sequence[str]) -> SlurmJob:
        planned, at_once = self._planned, None
        if planned.at_once is not None:
            at_once = planned.at_once // workers
            if not at_once:
                text = f"{workers} workers of a task need more instances of a model than may exist"
                raise ConfigurationError(text, hint="Give each task fewer workers.")
        command = [sys.executable, "-Pm", "fmu_mesh", "sweep", str(planned.folder.path), "--part", PART]
        command += ["--workers", str(workers), "--no-progress"]
        if planned.wanted.options.get("allow_code") or not planned.plan.loaded.foreign:  # the tasks see only the folder
            command.append("--allow-code")
        job = submit(
            planned.folder.path,
            command,
            name=self.mesh,
            tasks=tasks,
            at_once=at_once,
            cpus=workers,
            options=options,
        )
        self._note.write_bytes(msgspec.json.encode(job, enc_hook=str))
        return job

    def _run(self) -> None:
        if self.job is not None:
            with self._table():
                self._follow(self.job)

    def _follow(self, job: SlurmJob) -> None:
        left: int | None = job.tasks
        answered = asked = time.monotonic()
        while self._left and left != 0 and not self._cancelled.wait(_FOLDER_CHECK_S):
            now = time.monotonic()
            if now - asked > _ASK_S:
                asked, left = now, unfinished(job)
                answered = now if left is not None else answered
                if now - answered > _SILENCE_S:
                    text = f"Slurm has not told the state of job {job.id} for {_SILENCE_S:g} s"
                    raise MeshLost(text, hint=self._way_on())
            self._read()
        self._read()
        if self._left and left == 0:
            ended = ended_tasks(job)
            said = "; ".join(map(str, ended[:_SHOWN]))
            more = f" (and {len(ended) - _SHOWN} more)" if len(ended) > _SHOWN else ""
            text = f"all tasks of job {job.id} have ended, and {self._left} variants have no row: {said}{more}"
            raise MeshLost(text, hint=self._way_on())

    def _read(self) -> None:
        rows, identities = self._planned.folder.rows(), self._planned.wanted.identities
        waiting, self._waiting = self._waiting, deque()
        for number in waiting:
            if (row := rows.get(identities[number])) is not None:
                self._take(row)
            else:
                self._waiting.append(number)

    @property
    def again(self) -> str:
        """The command that follows it, or runs what is missing."""
        allowed = " --allow-code" if names_code(self._planned.plan.loaded) else ""
        return f"fmu-mesh sweep {short_path(self.folder)} --slurm{allowed}"

    def _way_on(self) -> str:
        if self.job is not None and self._cancelled.is_set():
            return f"Job {self.job.id} goes on: `{self.again}` follows it, and `scancel {self.job.id}` ends it."
        return f"`{self.again}` runs them."
