"""The arguments of the commands that run a mesh, or plan one. Owns no work: `--help` imports this and little else."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ..config.call_options import option_fields
from ..run.options import ConvergenceOptions, SimulateOptions
from ..sweeps.sweep_options import SweepOptions
from .arguments import (
    ACCESS,
    PACKAGE,
    QUIET,
    RULED,
    ArgumentPart,
    Parsers,
    argument,
    count,
    endpoint,
    group,
    json_switch,
    positive_seconds,
    switch,
    whole,
)
from .run_options import CONFIG, CONFIGURED, PLACED, add_options, options

__all__ = ["HERE", "PARSERS", "SIMULATION"]

HERE = "here"
"""`--dask` without an address."""
SIMULATION = {"real_time_factor": 1.0, "update_period": 0.01, "catch_up": 1.0}
"""The keys of `simulation` that `run` has other defaults for than a file; options replace them."""

_FMU = argument("fmu", "MODEL.fmu", "the FMU", type=Path)
_PLOT = argument("--plot", "FILE.png", "plot the result at the end", type=Path)
_OUTPUT = (switch("--no-progress", text="no progress line"), QUIET)
"""What a run prints."""
_EVENTS = argument("--events", "FILE.jsonl", "also write the events of the run into a file, as JSON lines", type=Path)
_OUTCOME = json_switch("print the outcome as one JSON object, and nothing else on standard output")


def _add_simulate(parser: argparse._ActionsContainer) -> None:
    flags = [name for name, field in option_fields(SimulateOptions).items() if field.flag]
    defaults = dict.fromkeys(("start_time", "stop_time", "step_size"), "that of the FMU")
    add_options(parser, *flags, options=SimulateOptions, defaults={**defaults, "output": "nothing is written"})


def _add_processes(parser: argparse._ActionsContainer) -> None:
    """Until version 0.5: `sweep` warns, and says what to do."""
    parser.add_argument("--processes", action="store_true", default=None, help=argparse.SUPPRESS)


def _add_target(parser: argparse._ActionsContainer) -> None:
    text = "write it into a file; default: standard output"
    parser.add_argument("-o", "--to", metavar="FILE", help=text, type=Path, dest="target")


_FOR_ALL_RUNS = group(
    "instead of what CONFIG says, for all runs",
    options("algorithm", "step_size", "stop_time", "start_values", "config_values"),
)
_SLURM_OPTION = argument(
    "--slurm-option",
    "OPTION",
    "an option of sbatch, as in --slurm-option=--partition=short; repeatable",
    action="append",
    default=[],
)


def _part(text: str) -> tuple[int, int]:
    number, slash, of = text.partition("/")
    if not (slash and 1 <= whole(number) <= whole(of)):
        raise argparse.ArgumentTypeError(f"'{text}' is no part such as 1/8")
    return int(number), int(of)


def _end(text: str) -> tuple[str, str]:
    variable, _, key = text.partition("=")
    if not (variable and key):
        raise argparse.ArgumentTypeError(f"'{text}' is no variable and key such as u=plant/pump/flow")
    return variable, key


def _with_key(flag: str, text: str) -> ArgumentPart:
    return argument(flag, "VARIABLE=KEY", f"{text}; repeatable", type=_end, action="append", default=[])


class _Stored(argparse.Action):
    """An argument, or an option with which another argument is not needed.

    With `nargs="?"` for that argument, argparse would not find it behind an option.
    """

    def __init__(self, instead: argparse.Action | None = None, **details: Any) -> None:  # noqa: ANN401 the arguments of argparse
        super().__init__(**details)
        self._instead = instead

    def __call__(
        self,
        _parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        _option: str | None = None,
    ) -> None:
        vars(namespace)[self.dest] = values
        if isinstance(self._instead, _Stored):
            self._instead.spare()

    def spare(self) -> None:
        """It is not needed."""
        self.required = False


def _add_nodes(parser: argparse._ActionsContainer) -> None:
    node = parser.add_argument("node", metavar="INSTANCE", help="name of the instance, or of its group", action=_Stored)
    text = "start all nodes of this host of `deploy.hosts` instead, each in a process"
    parser.add_argument("--host", metavar="NAME", help=text, action=_Stored, instead=node)


PARSERS: Parsers = {
    "launch": (
        *CONFIGURED,
        options(
            "state", "replaced", "paused", "view", "video", "profile", "defects", "processes", "restarts", "resume"
        ),
        _PLOT,
        *_OUTPUT,
        _EVENTS,
        _OUTCOME,
    ),
    "node": (
        *CONFIGURED,
        options("view", "video"),
        _add_nodes,
    ),
    "master": (
        *CONFIGURED,
        options("paused", "profile"),
        _PLOT,
        *_OUTPUT,
        _EVENTS,
    ),
    "gateway": (*CONFIGURED, QUIET),
    "router": (
        argument(
            "--listen",
            "ENDPOINT",
            "endpoint where others can connect; repeatable; default: tcp/127.0.0.1:7447",
            type=endpoint,
            action="append",
        ),
        *ACCESS,
        *RULED,
        QUIET,
    ),
    "simulate": (_FMU, _add_simulate, _PLOT, *_OUTPUT, _OUTCOME),
    "run": (
        _FMU,
        argument("--name", "NAME", "name of the mesh and of its instance; default: the model identifier"),
        argument(
            "--interpolation",
            "{hold,linear}",
            "how a Real input changes between two given values; other types hold; default: linear",
            choices=("hold", "linear"),
            default="linear",
        ),
        _with_key(
            "--subscribe",
            "give an input what others publish under a Zenoh key, which may have wildcards",
        ),
        _with_key("--publish", "publish the values of an output under a Zenoh key"),
        options(
            "step_size",
            "stop_time",
            *SIMULATION,
            "start_values",
            "config_values",
            "output",
            "listen",
            "connect",
            "security",
            "insecure",
            defaults={
                "step_size": "that of the FMU",
                "stop_time": "none, it runs until it is stopped",
                "output": "nothing is recorded",
                **{name: f"{value:g}" for name, value in SIMULATION.items()},
            },
            metavars={"start_values": "VARIABLE=VALUE"},
        ),
        *_OUTPUT,
        _OUTCOME,
    ),
    "sweep": (
        argument(
            "config", "CONFIG", "the configuration file or package; or the folder of a sweep, to continue it", type=Path
        ),
        *PACKAGE,
        group(
            "what varies",
            argument(
                "--vary",
                "NAME=VALUES",
                "values of instance.variable or of a key of CONFIG: LOW:HIGH:COUNT, LOW:HIGH:COUNT:log, LOW:HIGH for "
                "a sampler, or VALUE,VALUE; repeatable: all combinations run",
                action="append",
                default=[],
            ),
            options("sampler", "seed", of=SweepOptions),
        ),
        group("what is kept", options("reduce", "folder", "curves", of=SweepOptions)),
        group(
            "how it runs",
            options("resume", "force", "workers", "max_instances", "reset", of=SweepOptions),
            _add_processes,
            argument(
                "--dask",
                "ADDRESS",
                "run on the Dask cluster at this address; without one, on a Dask cluster of this host",
                nargs="?",
                const=HERE,
            ),
            argument("--part", "K/N", "run the K-th of N parts of FOLDER, without a table", type=_part),
        ),
        group(
            "on a Slurm cluster; FOLDER is on a file system that its hosts share",
            switch("--slurm", text="submit an array of jobs, and follow it"),
            argument("--tasks", "N", "tasks of the array, at most (16)", type=count, default=16),
            _SLURM_OPTION,
            switch("--no-wait", text="submit only; the same command follows it later"),
        ),
        _FOR_ALL_RUNS,
        options("state", "replaced", "keys_from", "allow_code"),
        *_OUTPUT,
        json_switch("print what came out as one JSON object, and nothing else on standard output"),
    ),
    "convergence": (
        *CONFIG,
        options("halvings", of=ConvergenceOptions),
        argument("--output", "FILE.csv", "write the table into this file", type=Path),
        argument("--plot", "FILE.png", "draw errors over the step size and over the number of steps", type=Path),
        group("how it runs", options("workers", "folder", "resume", "force", of=ConvergenceOptions)),
        _FOR_ALL_RUNS,
        options("allow_code"),
        *_OUTPUT,
        json_switch("print what came out as one JSON object, and nothing else on standard output"),
    ),
    "render": (
        argument("engine", "ENGINE", "slurm, compose or kubernetes", choices=("slurm", "compose", "kubernetes")),
        *PLACED,
        options("resume"),
        _add_target,
        argument("--image", "IMAGE", "of compose and kubernetes: the image with fmu-mesh; default: fmu-mesh"),
        argument(
            "--claim",
            "NAME",
            "of kubernetes: the claim of a volume with the folder of the mesh; default: the name of the mesh",
        ),
        _SLURM_OPTION,
        QUIET,
    ),
    "submit": (
        argument("engine", "ENGINE", "slurm", choices=("slurm",)),
        *PLACED,
        options("resume"),
        _SLURM_OPTION,
        *_OUTPUT,
    ),
    "rerun": (
        argument("result", "RESULT", "the result file of a run", type=Path),
        options("output", "allow_code", defaults={"output": "RESULT with .rerun in its name"}),
        *_OUTPUT,
        _OUTCOME,
    ),
    "check": (
        *CONFIGURED,
        argument(
            "--round-trip", "S", "show what a network between hosts with this round trip costs", type=positive_seconds
        ),
        QUIET,
        json_switch("print the plan, or all findings, as one JSON object"),
    ),
    "schema": (),
}
