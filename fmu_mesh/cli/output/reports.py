"""What `launch` and `run` print with `--json`: one object at their end, also when they fail.

`docs/commands.md` documents the fields.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack, redirect_stdout
from types import TracebackType
from typing import Literal, Self

import msgspec

from ...errors import ErrorReport
from ...run.in_process import InProcessRun
from ...run.launcher import Launcher
from ...run.outcome import Outcome
from ...run.run_plan import RunPlan
from .display import stdout_as_stderr
from .json_output import Failure, failure_of, print_json

__all__ = ["RunReport", "RunReporter"]


class RunReport(msgspec.Struct, frozen=True):
    """The output of `launch --json` and `run --json`.

    Attributes:
        mesh: name of the mesh; None if the configuration cannot be read.
        state: whether the run has ended well.
        exit_code: that of the command.
        point: the last point that all instances reached.
        time: the simulation time of that point in s.
        seconds: wall-clock time from the first grant to the last point in s.
        rows: number of rows in the result file.
        file: the result file; None if nothing was recorded.
        restarts: how often the run was started again.
        error: why it failed.
        ended_by: what ended the simulation before its last point although nothing failed.
    """

    mesh: str | None
    state: Literal["done", "failed"]
    exit_code: int
    point: int = 0
    time: float = 0.0
    seconds: float = 0.0
    rows: int = 0
    file: str | None = None
    restarts: int = 0
    error: Failure | None = None
    ended_by: ErrorReport | None = None


class RunReporter:
    """Prints a `RunReport` at the end of the block; in the block, standard output goes to standard error.

    Args:
        wanted: whether to do so; otherwise nothing happens.
    """

    def __init__(self, *, wanted: bool) -> None:
        self._wanted = wanted
        self._stack = ExitStack()
        self._run: RunPlan | None = None
        self._runner: Launcher | InProcessRun | None = None

    def __enter__(self) -> Self:
        if self._wanted:
            self._stack.enter_context(stdout_as_stderr())
            self._stack.enter_context(redirect_stdout(sys.stderr))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()
        if self._wanted:
            print_json(self._report(error))

    def started(self, run: RunPlan, runner: Launcher | InProcessRun) -> None:
        """Tell what runs, and who knows its outcome; again, if it starts again."""
        self._run, self._runner = run, runner

    def _report(self, error: BaseException | None) -> RunReport:
        failure = failure_of(error) if error is not None else None
        outcome = self._runner.outcome if self._runner is not None else None
        outcome = outcome or Outcome("failed", 0, 0.0, 0.0, 0, None)
        return RunReport(
            mesh=self._run.mesh if self._run is not None else None,
            state="failed" if failure is not None else outcome.state,
            exit_code=failure.exit_code if failure is not None else 0,
            point=outcome.point,
            time=outcome.time,
            seconds=outcome.seconds,
            rows=outcome.rows,
            file=outcome.file,
            restarts=self._run.restarts if self._run is not None else 0,
            error=failure,
            ended_by=outcome.ended_by,
        )
