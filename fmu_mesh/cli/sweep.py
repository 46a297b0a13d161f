"""`sweep`: many runs of one mesh with other values, into one table."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Literal

import msgspec

from ..errors import ConfigurationError, DeadlineExceeded, FmuMeshError
from ..sweeps.dask_cluster import dask_executor
from ..sweeps.planned_sweep import PlannedSweep, SweepOptions, continued_sweep, planned_sweep
from ..sweeps.slurm_sweep import SlurmOptions, SlurmSweep
from ..sweeps.sweep_folder import is_sweep
from ..sweeps.sweeping import ExecutorSweep, Sweep, SweepPart
from ..sweeps.variants import Values, read_values
from ..text import short_path, shown
from .arguments import CommandParser, Parsers, add_json, add_package, count, whole
from .output.display import say, stdout_as_stderr
from .output.json_output import Failure, failure_of, print_json
from .output.progress import SweepProgressLine
from .output.terminal import error_console
from .run_options import add_options, given_options, mesh_of
from .running import add_output, interrupted_by_signals

__all__ = ["PARSERS", "SweepReport"]

_LOOK_S = 0.1
_SHOWN_FAILURES = 5
_HERE = "here"
"""`--dask` without an address."""
_OF_FOLDER = {"allow_code", "on_notice", "resume", "workers"}
"""The options that go with the folder of a sweep, which says all others."""


class SweepReport(msgspec.Struct, frozen=True):
    """The output of `sweep --json`.

    Attributes:
        mesh: name of the mesh; None if the sweep could not be planned.
        state: whether every variant has a row, and none has failed.
        exit_code: that of the command.
        variants: how many there are.
        runs: how many have a row.
        failed: how many of these have failed.
        seconds: wall-clock time in s.
        folder: the folder of the sweep.
        table: the CSV file with all rows.
        error: why the sweep ended early; not why a run has failed, which its row says.
    """

    mesh: str | None
    state: Literal["done", "failed"]
    exit_code: int
    variants: int = 0
    runs: int = 0
    failed: int = 0
    seconds: float = 0.0
    folder: str | None = None
    table: str | None = None
    error: Failure | None = None


def _add_sweep(parser: CommandParser) -> None:
    parser.add_argument(
        "config",
        type=Path,
        metavar="CONFIG",
        help="the configuration file or package; or the folder of a sweep, to continue it",
    )
    add_package(parser)
    what = parser.add_argument_group("what varies")
    what.add_argument(
        "--vary",
        action="append",
        default=[],
        metavar="NAME=VALUES",
        help="values of instance.variable or of a key of CONFIG: LOW:HIGH:COUNT, LOW:HIGH:COUNT:log, LOW:HIGH for a "
        "sampler, or VALUE,VALUE; repeatable: all combinations run",
    )
    add_options(what, "sampler", "seed", options=SweepOptions)
    add_options(parser.add_argument_group("what is kept"), "reduce", "folder", "curves", options=SweepOptions)
    how = parser.add_argument_group("how it runs")
    add_options(how, "resume", "force", "workers", "max_instances", "processes", "reset", options=SweepOptions)
    how.add_argument(
        "--dask",
        nargs="?",
        const=_HERE,
        metavar="ADDRESS",
        help="run on the Dask cluster at this address; without one, on a Dask cluster of this host",
    )
    how.add_argument("--part", type=_part, metavar="K/N", help="run the K-th of N parts of FOLDER, without a table")
    slurm = parser.add_argument_group("on a Slurm cluster; FOLDER is on a file system that its hosts share")
    slurm.add_argument("--slurm", action="store_true", help="submit an array of jobs, and follow it")
    slurm.add_argument("--tasks", type=count, default=16, metavar="N", help="tasks of the array, at most (16)")
    slurm.add_argument(
        "--slurm-option",
        action="append",
        default=[],
        metavar="OPTION",
        help="an option of sbatch, as in --slurm-option=--partition=short; repeatable",
    )
    slurm.add_argument("--no-wait", action="store_true", help="submit only; the same command follows it later")
    add_options(
        parser.add_argument_group("instead of what CONFIG says, for all runs"),
        "algorithm",
        "step_size",
        "stop_time",
        "start_values",
        "config_values",
    )
    add_options(parser, "allow_code")
    add_output(parser)
    add_json(parser, "print what came out as one JSON object, and nothing else on standard output")
    parser.set_defaults(run_command=_sweep)


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
    """Plan the sweep, or what is missing of one.

    Raises:
        ConfigurationError: something is wrong with it, or two arguments cannot be combined.
    """
    given = given_options(arguments, SweepOptions)
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
    if arguments.slurm:
        options = SlurmOptions(arguments.tasks, arguments.workers or 1, tuple(arguments.slurm_option))
        with SlurmSweep(planned, options) as sweep:
            yield sweep
        return
    dask: AbstractContextManager[Executor | None] = nullcontext()
    if arguments.dask is not None:
        dask = dask_executor(None if arguments.dask == _HERE else arguments.dask, arguments.workers)
    with (
        dask as executor,
        ExecutorSweep(planned, executor=executor, workers=arguments.workers, part=arguments.part) as sweep,
    ):
        yield sweep


def _follow(sweep: Sweep, arguments: argparse.Namespace) -> None:
    """Wait for the end, and show the progress meanwhile; with `--no-wait`, only say what was submitted."""
    if isinstance(sweep, SlurmSweep) and sweep.job is not None:
        job = sweep.job
        say(f"job {job.id} of Slurm has {job.tasks} tasks")
        if arguments.no_wait:
            say(f"`{sweep.again}` follows it, and `scancel {job.id}` ends it")
            return
    line = SweepProgressLine(sweep.mesh, error_console(), show=not (arguments.no_progress or arguments.quiet))
    line.start()
    try:
        while True:
            line.update(sweep.progress)
            try:
                sweep.wait(_LOOK_S)
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
    """Print the first failures, the table, and how fast it was."""
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
    kept = progress.done - sweep.ran
    before = f", {kept} of them before" if kept else ""
    print(
        f"{progress.done} of {progress.total} runs{before}, {progress.failed} failed, in {progress.seconds:.3f} s{rate}"
    )


def _part(text: str) -> SweepPart:
    number, slash, of = text.partition("/")
    if not (slash and 1 <= whole(number) <= whole(of)):
        raise argparse.ArgumentTypeError(f"'{text}' is no part such as 1/8")
    return SweepPart(int(number), int(of))


PARSERS: Parsers = {"sweep": _add_sweep}
