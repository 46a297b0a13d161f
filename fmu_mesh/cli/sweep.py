"""`sweep` and `convergence`: many runs of one mesh with other values, into one table."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from typing import Literal

import msgspec

from ..errors import ConfigurationError, DeadlineExceeded, FmuMeshError
from ..pictures.drawing import draw
from ..run.options import ConvergenceOptions
from ..sweeps.convergence import converging
from ..sweeps.dask_cluster import dask_executor
from ..sweeps.planned_sweep import PlannedSweep, continued_sweep, planned_sweep
from ..sweeps.slurm_sweep import SlurmSweep
from ..sweeps.sweep_folder import is_sweep
from ..sweeps.sweep_options import SweepOptions
from ..sweeps.sweeping import ExecutorSweep, Sweep, SweepPart
from ..sweeps.variants import Values, read_values
from ..sweeps.worker_server import prepare_workers
from ..text import short_path, shown
from .arguments import Runs
from .output.flag_words import in_flags
from .output.json_output import Failure, failure_of, print_failure, print_json
from .output.progress import ProgressLine, sweep_parts
from .output.terminal import error_console, say, stdout_as_stderr
from .plotting import check_plot
from .run_arguments import HERE
from .run_options import given_options, mesh_of
from .running import interrupted_by_signals

__all__ = ["RUNS", "SweepReport"]

# Ten times a second, so that Ctrl-C and the line with the progress feel immediate.
_REDRAW_S = 0.1
_SHOWN_FAILURES = 5
_OF_FOLDER = {"allow_code", "on_notice", "resume", "workers"}
"""The options that go with the folder of a sweep, which says all others."""


class SweepReport(msgspec.Struct, frozen=True):
    """The output of `sweep --json`."""

    mesh: str | None  # name of the mesh; None if the sweep could not be planned
    state: Literal["done", "failed"]  # whether every variant has a row, and none has failed
    exit_code: int
    variants: int = 0  # how many there are
    runs: int = 0  # how many have a row
    failed: int = 0  # how many of these have failed
    seconds: float = 0.0  # wall-clock time in s
    folder: str | None = None
    table: str | None = None  # the CSV file with all rows
    error: Failure | None = None  # why the sweep ended early; not why a run has failed, which its row says


def _sweep(arguments: argparse.Namespace) -> int:
    sweep: Sweep | None = None
    error: FmuMeshError | None = None
    try:
        with stdout_as_stderr() if arguments.json else nullcontext():
            planned = _planned(arguments)
            with _started(planned, arguments) as sweep, interrupted_by_signals() as running:
                running.append(sweep)
                _follow(sweep, arguments)
    except FmuMeshError as failure:
        error = failure
    report = _report(sweep, error)
    if arguments.json:
        print_json(report)
    elif sweep is not None:
        _show(sweep)
    if error is not None:
        raise error
    return report.exit_code


def _planned(arguments: argparse.Namespace) -> PlannedSweep:
    given = given_options(arguments, SweepOptions)
    if not arguments.slurm and arguments.dask is None:
        prepare_workers()
    if is_sweep(arguments.config):
        if given.keys() - _OF_FOLDER or any(getattr(arguments, name) for name in ("ssd", "ssv", "vary")):
            text = f"'{arguments.config}' is the folder of a sweep, which says what varies"
            raise ConfigurationError(text, hint="Continue it with its folder alone, or give the configuration file.")
        allow_code = given.get("allow_code", False)
        return continued_sweep(arguments.config, allow_code=allow_code, on_notice=given["on_notice"])
    if arguments.part is not None:
        raise ConfigurationError("--part needs the folder of a sweep in place of the configuration file.")
    vary: dict[str, Values] = {}
    for text in arguments.vary:
        name, values = read_values(text)
        if name in vary:
            raise ConfigurationError(f"--vary {name} is there twice", hint="Give all its values at once.")
        vary[name] = values
    return planned_sweep(mesh_of(arguments), vary, **given)


@contextmanager
def _started(planned: PlannedSweep, arguments: argparse.Namespace) -> Iterator[Sweep]:
    """The sweep, where the arguments want it; it ends with the block."""
    if arguments.slurm and arguments.dask is not None:
        raise ConfigurationError("--slurm and --dask do not go together", hint="Leave one of them out.")
    part = SweepPart(*arguments.part) if arguments.part is not None else None
    workers, executor = arguments.workers, None
    with ExitStack() as stack:
        if arguments.dask is not None:
            executor = stack.enter_context(dask_executor(None if arguments.dask == HERE else arguments.dask, workers))
        yield stack.enter_context(
            SlurmSweep(planned, tasks=arguments.tasks, workers=workers or 1, options=arguments.slurm_option)
            if arguments.slurm
            else ExecutorSweep(planned, executor=executor, workers=workers, part=part)
        )


def _follow(sweep: Sweep, arguments: argparse.Namespace) -> None:
    """Wait for the end, and show the progress meanwhile; with `--no-wait`, only say what was submitted."""
    if isinstance(sweep, SlurmSweep) and sweep.job is not None:
        job = sweep.job
        say(f"job {job.id} of Slurm has {job.tasks} tasks")
        if arguments.no_wait:
            say(f"`{sweep.again}` follows it, and `scancel {job.id}` ends it")
            return
    console = error_console if not (arguments.no_progress or arguments.quiet) else None
    line = ProgressLine(sweep.mesh, sweep.progress.total, sweep_parts, console)
    line.start()
    try:
        while True:
            progress = sweep.progress
            line.update(progress.done, progress)
            try:
                sweep.wait(_REDRAW_S)
            except DeadlineExceeded:
                continue
            return
    finally:
        line.stop()


def _report(sweep: Sweep | None, error: FmuMeshError | None) -> SweepReport:
    failure = failure_of(error) if error is not None else None
    if sweep is None:
        return SweepReport(None, "failed", failure.exit_code if failure is not None else 0, error=failure)
    progress, result = sweep.progress, sweep.result
    failed = result.failed
    code = failure.exit_code if failure is not None else failed[0].exit_code if failed else 0
    return SweepReport(
        mesh=sweep.mesh,
        state="failed" if code else "done",
        exit_code=code,
        variants=progress.total,
        runs=progress.done,
        failed=progress.failed,
        seconds=progress.seconds,
        folder=str(sweep.folder),
        table=str(result.table),
        error=failure,
    )


def _show(sweep: Sweep) -> None:
    failed, progress = sweep.result.failed, sweep.progress
    warned = [row for row in sweep.result if row.message and not row.exit_code]
    for rows, what in ((failed, "failed"), (warned, "warns")):
        for row in rows[:_SHOWN_FAILURES]:
            values = ", ".join(f"{name}={shown(value)}" for name, value in row.parameters.items())
            say(f"variant {row.variant} ({values}) {what}: {row.message}")
        if len(rows) > _SHOWN_FAILURES:
            say(f"and {len(rows) - _SHOWN_FAILURES} more, which the table has")
    for warning in sweep.result.warnings:
        say(f"warning: {warning}")
    table = sweep.result.table
    if table.is_file():
        print(f"table: {short_path(table)}")
    rate = f": {sweep.ran / progress.seconds:.3g} runs/s" if sweep.ran and progress.seconds > 0.0 else ""
    before = f", {kept} of them before" if (kept := progress.done - sweep.ran) else ""
    runs = f"{progress.done} of {progress.total} runs{before}, {progress.failed} failed"
    print(f"{runs}, in {progress.seconds:.3f} s{rate}")


def _convergence(arguments: argparse.Namespace) -> int:
    try:
        if arguments.plot is not None:
            check_plot(arguments.plot)
        with stdout_as_stderr() if arguments.json else nullcontext():
            options = ConvergenceOptions(**given_options(arguments, ConvergenceOptions))
            with converging(mesh_of(arguments), options) as (runs, end), interrupted_by_signals() as running:
                running.append(runs)
                _follow(runs, arguments)
                found = end()
            if arguments.output is not None:
                found.to_csv(arguments.output)
            if arguments.plot is not None:
                draw(found.plot(), arguments.plot)
    except FmuMeshError as error:
        if arguments.json:
            print_failure(error)
        raise
    if arguments.json:
        print_json(found)
        return 0
    print(in_flags(str(found)))
    for what, file in (("table", arguments.output), ("plot", arguments.plot)):
        if file is not None:
            print(f"{what}: {file}")
    return 0


RUNS: Runs = {"sweep": _sweep, "convergence": _convergence}
