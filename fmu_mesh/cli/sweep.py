"""`sweep`: many runs of one mesh with other values, into one table."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any, Literal, cast

import msgspec
from msgspec.structs import asdict

from ..errors import ConfigurationError, DeadlineExceeded, FmuMeshError
from ..run.options import Options
from ..sweeps.dask_cluster import dask_executor
from ..sweeps.planned_sweep import PlannedSweep, SweepOptions, continued_sweep, planned_sweep
from ..sweeps.slurm_sweep import SlurmOptions, SlurmSweep
from ..sweeps.sweep_folder import is_sweep
from ..sweeps.sweeping import ExecutorSweep, Sweep, SweepPart
from ..sweeps.variants import Values, read_values
from ..text import short_path, shown
from .arguments import CommandParser, Parsers, add_json, add_package, count, whole
from .output.display import say, stdout_as_stderr, teller
from .output.json_output import Failure, failure_of, print_json
from .output.progress import SweepProgressLine
from .output.terminal import error_console
from .run_options import add_options, mesh_of, read_options
from .running import add_output, interrupted_by_signals

__all__ = ["PARSERS", "SweepReport"]

_LOOK_S = 0.1
_SHOWN_FAILURES = 5
_HERE = "here"
"""`--dask` without an address."""
_ASKED = ("ssd", "ssv", "vary", "sampler", "reduce", "no_curves", "processes", "reset", "max_instances", "folder")
"""What the folder of a sweep says."""


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
    what.add_argument(
        "--sampler", metavar="NAME:COUNT", help="choose COUNT variants: lhs, sobol, halton or random; as in lhs:64"
    )
    what.add_argument("--seed", type=_seed, default=0, metavar="N", help="seed of the sampler (0)")
    kept = parser.add_argument_group("what is kept")
    kept.add_argument(
        "--reduce",
        action="append",
        default=[],
        metavar="FUNCTION(VARIABLE)",
        help="a column of the table, such as max(pendulum.a); repeatable; default: the last value of each variable",
    )
    kept.add_argument(
        "--folder", type=Path, metavar="FOLDER", help="folder of the sweep; default: MESH_sweep beside the result file"
    )
    kept.add_argument("--no-curves", action="store_true", help="keep the table only")
    how = parser.add_argument_group("how it runs")
    how.add_argument("--resume", action="store_true", help="keep the runs that FOLDER has, and run what is missing")
    how.add_argument("--workers", type=count, metavar="N", help="processes of this host; default: one per processor")
    how.add_argument(
        "--max-instances",
        action="append",
        default=[],
        metavar="MODEL.fmu=N",
        help="at most N instances of a model at a time, as its licence may ask; repeatable",
    )
    how.add_argument("--processes", action="store_true", help="run each variant in processes, as `launch` does")
    how.add_argument("--reset", action="store_true", help="reset the instances of FMUs between two runs (fmi2Reset)")
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
    options = read_options(arguments)
    if is_sweep(arguments.config):
        given = [name for name in _ASKED if getattr(arguments, name)]
        if given or options != Options(allow_code=options.allow_code):
            text = f"'{arguments.config}' is the folder of a sweep, which says what varies"
            raise ConfigurationError(text, hint="Continue it with its folder alone, or give the configuration file.")
        tell = teller(quiet=arguments.quiet)
        return continued_sweep(arguments.config, allow_code=options.allow_code, on_notice=tell)
    if arguments.part is not None:
        raise ConfigurationError("--part needs the folder of a sweep in place of the configuration file.")
    vary: dict[str, Values] = {}
    for text in arguments.vary:
        name, values = read_values(text)
        if name in vary:
            raise ConfigurationError(f"--vary {name} is there twice", hint="Give all its values at once.")
        vary[name] = values
    chosen: dict[str, Any] = {**asdict(options), "on_notice": teller(quiet=arguments.quiet)}
    own = SweepOptions(
        sampler=arguments.sampler,
        seed=arguments.seed,
        reduce=arguments.reduce,
        folder=arguments.folder,
        curves=not arguments.no_curves,
        resume=arguments.resume,
        processes=arguments.processes,
        reset=arguments.reset,
        max_instances=dict(map(_limit, arguments.max_instances)),
    )
    base = {name: chosen[name] for name in SweepOptions.__annotations__ if name in chosen}
    return planned_sweep(mesh_of(arguments), vary, **cast("SweepOptions", {**base, **own}))


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


def _limit(text: str) -> tuple[str, int]:
    name, equals, number = text.rpartition("=")
    if not (name and equals and whole(number) > 0):
        raise ConfigurationError(f"--max-instances {text}: expected MODEL.fmu=N, such as gain.fmu=2")
    return name, int(number)


def _part(text: str) -> SweepPart:
    number, slash, of = text.partition("/")
    if not (slash and 1 <= whole(number) <= whole(of)):
        raise argparse.ArgumentTypeError(f"'{text}' is no part such as 1/8")
    return SweepPart(int(number), int(of))


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is no whole number of at least 0")
    return int(text)


PARSERS: Parsers = {"sweep": _add_sweep}
