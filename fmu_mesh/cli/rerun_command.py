"""`rerun`: a run again, from its result file."""

from __future__ import annotations

import argparse
from functools import partial

import msgspec

from ..api.rerunning import planned_rerun
from ..api.result import Result
from ..api.run_handle import Run
from ..errors import FmuMeshError
from ..run.options import RerunOptions
from .arguments import Runs
from .output.display import Display, summary, warn
from .output.reports import RunReporter
from .run_options import given_options
from .running import interrupted_by_signals, show_event

__all__ = ["RUNS"]


def _rerun(arguments: argparse.Namespace) -> int:
    with RunReporter(wanted=arguments.json) as reporter:
        again = planned_rerun(arguments.result, **given_options(arguments, RerunOptions))
        reporter.planned(again.plan)
        plan = again.plan.plan
        if not arguments.quiet:
            warn(plan)
        with (
            Display(plan, show_progress=not arguments.no_progress, quiet=arguments.quiet) as display,
            interrupted_by_signals() as runs,
        ):
            run = Run.start(again.plan, on_event=partial(show_event, reporter, display))
            runs.append(run)
            again.drive(run)
            outcome = run.wait().outcome
        assert outcome is not None  # it has run
        for line in summary(plan, outcome):
            print(line)
        assert outcome.file is not None  # it records what the first run has recorded
        comparison = again.first.compare(Result.read(outcome.file))
        if not comparison.equal:
            print(comparison.text)
            raise FmuMeshError(f"the values are not those of '{arguments.result}'.")
        # It was to end where the first run has ended, which may have been stopped.
        reporter.event(msgspec.structs.replace(outcome, state="done"))
        print(f"every value is that of '{arguments.result}'")
    return 0


RUNS: Runs = {"rerun": _rerun}
