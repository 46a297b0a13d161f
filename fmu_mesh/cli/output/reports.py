"""What `launch` and `run` print with `--json`: one object at their end, also when they fail.

`docs/reference/json.md` documents the fields.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack, redirect_stdout
from typing import Literal, Self

import msgspec
from msgspec.structs import replace

from ...errors import ErrorReport, FmuMeshError
from ...run.events import Event, Restarted, WasReset
from ...run.outcome import Outcome
from ...run.overriding import memory_of
from ...run.run_plan import RunPlan
from ...system.defect import Defect
from .json_output import Failure, failure_of, print_json
from .terminal import stdout_as_stderr

__all__ = ["RunReport", "RunReporter"]


_AS_THE_OUTCOME = ("point", "time", "seconds", "rows", "file", "ended_by", "warnings", "defects")


class ReportedFile(msgspec.Struct, frozen=True):
    """A result file and its number of rows."""

    file: str
    rows: int


class RunReport(msgspec.Struct, frozen=True):
    """The output of `launch --json` and `run --json`."""

    mesh: str | None  # name of the mesh; None if the configuration cannot be read
    state: Literal["done", "failed"]  # whether the run has ended well
    exit_code: int
    point: int = 0  # the last point that all instances reached
    time: float = 0.0  # the simulation time of that point in s
    seconds: float = 0.0  # wall-clock time from the first grant to the last point in s
    rows: int = 0  # number of rows in the first result file
    file: str | None = None  # the first result file; None if nothing was recorded
    restarts: int = 0  # how often the run was started again
    resets: int = 0  # how often it was reset: the rest is that of the last run
    error: Failure | None = None  # why it failed
    ended_by: ErrorReport | None = None  # what ended the simulation before its last point although nothing failed
    files: tuple[ReportedFile, ...] = ()  # all result files, each with its number of rows
    # what is wrong although nothing failed: a value that grows without a limit, or how an FMU has ended
    warnings: tuple[str, ...] = ()
    defects: dict[str, Defect] = {}  # with `--defects`, by connection: what came, compared with what was assumed


class RunReporter:
    """If ``wanted``, prints a `RunReport` at the end of the block; in it, standard output goes to standard error."""

    def __init__(self, *, wanted: bool) -> None:
        self._wanted = wanted
        self._stack = ExitStack()
        self._run: RunPlan | None = None
        self._outcome: Outcome | None = None
        self._restarts = self._resets = 0

    def __enter__(self) -> Self:
        if self._wanted:
            self._stack.enter_context(stdout_as_stderr())
            self._stack.enter_context(redirect_stdout(sys.stderr))
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        self._stack.close()
        if self._wanted:
            print_json(self._report(error))

    def planned(self, run: RunPlan) -> None:
        """Tell what is going to run."""
        self._run = run

    def event(self, event: Event) -> None:
        """Take an event of the run."""
        match event:
            case Restarted(_, number):
                self._restarts = number
            case WasReset(_, number):
                self._resets = number
            case Outcome():
                self._outcome = event

    def _report(self, error: BaseException | None) -> RunReport:
        failure = failure_of(error) if error is not None else None
        outcome = self._outcome
        if isinstance(error, FmuMeshError) and error.result is not None:  # it knows more than the master
            outcome = error.result.outcome
        outcome = outcome or Outcome("failed", 0, 0.0, 0.0, 0, None)
        if self._run is not None and memory_of(self._run) is not None:  # and gone by now
            outcome = replace(outcome, file=None, files=())
        return RunReport(
            mesh=self._run.mesh if self._run is not None else None,
            state="failed" if failure is not None else outcome.state,
            exit_code=failure.exit_code if failure is not None else 0,
            restarts=self._restarts,
            resets=self._resets,
            error=failure,
            files=tuple(ReportedFile(*own) for own in outcome.files),
            **{name: getattr(outcome, name) for name in _AS_THE_OUTCOME},
        )
