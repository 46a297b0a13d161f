"""The arguments of the commands that run a mesh, or plan one. Owns no work: `--help` imports this and little else."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..config.call_options import option_fields
from ..run.options import SimulateOptions
from ..sweeps.sweep_options import SweepOptions
from .arguments import CommandParser, Parsers, add_json, add_package, add_quiet, count, endpoint, whole
from .run_options import add_configuration, add_options

__all__ = ["HERE", "PARSERS", "SIMULATION"]

HERE = "here"
"""`--dask` without an address."""
SIMULATION = {"real_time_factor": 1.0, "update_period": 0.01, "catch_up": 1.0}
"""The keys of `simulation` that `run` has other defaults for than a file; options replace them."""


def _add_launch(parser: CommandParser) -> None:
    add_configuration(parser)
    add_options(parser, "paused", "view", "video", "profile")
    add_options(parser, "processes", "restarts")
    _add_plot(parser)
    _add_output(parser)
    add_json(parser, "print the outcome as one JSON object, and nothing else on standard output")


def _add_node(parser: CommandParser) -> None:
    add_configuration(parser)
    add_options(parser, "view", "video")
    parser.add_argument("node", metavar="INSTANCE", help="name of the instance, or of its group")


def _add_master(parser: CommandParser) -> None:
    add_configuration(parser)
    add_options(parser, "paused", "profile")
    _add_plot(parser)
    _add_output(parser)


def _add_gateway(parser: CommandParser) -> None:
    add_configuration(parser)
    add_quiet(parser)


def _add_router(parser: CommandParser) -> None:
    parser.add_argument(
        "--listen",
        type=endpoint,
        action="append",
        metavar="ENDPOINT",
        help="endpoint where others can connect; repeatable; default: tcp/127.0.0.1:7447",
    )
    add_quiet(parser)


def _add_plot(parser: CommandParser) -> None:
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="plot the result at the end")


def _add_output(parser: CommandParser) -> None:
    """Add the flags for what a run prints."""
    parser.add_argument("--no-progress", action="store_true", help="no progress line")
    add_quiet(parser)


def _add_run(parser: CommandParser) -> None:
    parser.add_argument("fmu", type=Path, metavar="MODEL.fmu", help="the FMU")
    parser.add_argument("--name", help="name of the mesh and of its instance; default: the model identifier")
    parser.add_argument(
        "--interpolation",
        choices=("hold", "linear"),
        default="linear",
        help="how a Real input changes between two given values; other types hold; default: linear",
    )
    add_options(
        parser,
        "step_size",
        "stop_time",
        *SIMULATION,
        "start_values",
        "config_values",
        "output",
        "listen",
        "connect",
        defaults={
            "step_size": "that of the FMU",
            "stop_time": "none, it runs until it is stopped",
            "output": "nothing is recorded",
            **{name: f"{value:g}" for name, value in SIMULATION.items()},
        },
        metavars={"start_values": "VARIABLE=VALUE"},
    )
    _add_output(parser)
    add_json(parser, "print the outcome as one JSON object, and nothing else on standard output")


def _add_simulate(parser: CommandParser) -> None:
    parser.add_argument("fmu", type=Path, metavar="MODEL.fmu", help="the FMU")
    flags = [name for name, field in option_fields(SimulateOptions).items() if field.flag]
    of_fmu = dict.fromkeys(("start_time", "stop_time", "step_size"), "that of the FMU")
    add_options(parser, *flags, options=SimulateOptions, defaults={**of_fmu, "output": "nothing is written"})
    _add_plot(parser)
    _add_output(parser)
    add_json(parser, "print the outcome as one JSON object, and nothing else on standard output")


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
        const=HERE,
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
    _add_output(parser)
    add_json(parser, "print what came out as one JSON object, and nothing else on standard output")


def _add_rerun(parser: CommandParser) -> None:
    parser.add_argument("result", type=Path, metavar="RESULT", help="the result file of a run")
    add_options(parser, "output", "allow_code", defaults={"output": "RESULT with .rerun in its name"})
    _add_output(parser)
    add_json(parser, "print the outcome as one JSON object, and nothing else on standard output")


def _add_check(parser: CommandParser) -> None:
    add_configuration(parser)
    add_quiet(parser)
    add_json(parser, "print the plan, or all findings, as one JSON object")


def _add_schema(_parser: CommandParser) -> None:
    """It has none."""


def _part(text: str) -> tuple[int, int]:
    number, slash, of = text.partition("/")
    if not (slash and 1 <= whole(number) <= whole(of)):
        raise argparse.ArgumentTypeError(f"'{text}' is no part such as 1/8")
    return int(number), int(of)


PARSERS: Parsers = {
    "launch": _add_launch,
    "node": _add_node,
    "master": _add_master,
    "gateway": _add_gateway,
    "router": _add_router,
    "simulate": _add_simulate,
    "run": _add_run,
    "sweep": _add_sweep,
    "rerun": _add_rerun,
    "check": _add_check,
    "schema": _add_schema,
}
