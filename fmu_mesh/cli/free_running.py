"""`run`: one FMU as a free-running node, paced by the wall clock and without a configuration file.

It is a mesh of one instance, whose configuration is made here from the options, so everything else is as in any mesh.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from ..config.base import NAME_PATTERN
from ..config.loading import LoadedConfig, parse
from ..errors import ConfigurationError, LoadFailed
from ..instances.fmi import read_description
from ..run.launcher import Launcher
from ..run.options import Options
from ..run.preparing import planned
from ..variables.model_description import ModelDescription
from .arguments import add_command, endpoint, no_fmu, number
from .output.display import Display, warn
from .running import finish, run_launcher

__all__ = ["add_commands"]

_UPDATE_PERIOD_S = 0.01
_CATCH_UP_S = 1.0


def add_commands(commands: argparse._SubParsersAction[Any], common: argparse.ArgumentParser) -> None:
    """Add the command of this module."""
    run = add_command(commands, "run", "run one FMU as a free-running node, without a file", [common])
    run.add_argument("fmu", type=Path, metavar="MODEL.fmu", help="the FMU")
    run.add_argument("--name", help="name of the mesh and of its instance; default: the model identifier")
    run.add_argument("--step-size", type=number, metavar="S", help="step size in s; default: that of the FMU")
    run.add_argument(
        "--update-period",
        type=number,
        default=_UPDATE_PERIOD_S,
        metavar="S",
        help="wall-clock time in s after which the steps that are due are taken (0.01)",
    )
    run.add_argument(
        "--real-time-factor",
        type=number,
        default=1.0,
        metavar="F",
        help="1: wall clock (default); 2: twice as fast; 0: as fast as possible",
    )
    run.add_argument(
        "--catch-up",
        type=number,
        default=_CATCH_UP_S,
        metavar="S",
        help="how far in s it may fall behind the wall clock before it gives up what it lost (1)",
    )
    run.add_argument("--stop-time", type=number, metavar="S", help="stop time in s; default: until it is stopped")
    run.add_argument(
        "--set", action="append", default=[], metavar="VARIABLE=VALUE", help="another start value; repeatable"
    )
    run.add_argument(
        "--interpolation",
        choices=("hold", "linear"),
        default="linear",
        help="how inputs go from one time to the next; other types than Real hold (linear)",
    )
    run.add_argument("--output", type=Path, metavar="FILE.csv", help="record all outputs into a file")
    run.add_argument(
        "--listen",
        type=endpoint,
        action="append",
        default=[],
        metavar="ENDPOINT",
        help="listen there, such as tcp/0.0.0.0:7447; repeatable",
    )
    run.add_argument(
        "--connect",
        type=endpoint,
        action="append",
        default=[],
        metavar="ENDPOINT",
        help="connect there, such as tcp/HOST:PORT; repeatable",
    )
    run.add_argument("--no-progress", action="store_true", help="no progress line")
    run.set_defaults(run_command=_run)


def _run(arguments: argparse.Namespace) -> int:
    try:
        description = read_description(arguments.fmu)
    except LoadFailed as error:
        raise no_fmu(arguments.fmu, error) from error
    name = arguments.name if arguments.name is not None else description.model_identifier
    if re.search(NAME_PATTERN, name) is None:
        what = "a name of letters, digits, _ and - that starts with a letter or _"
        raise ConfigurationError(f"'{name}' is not {what}", hint="Give the mesh such a name with --name.")
    options = Options(start_values=tuple(f"{name}.{change}" for change in arguments.set))
    text = msgspec.json.encode(_configuration(arguments, name, description)).decode()
    loaded = _named_by_options(parse(text, arguments.fmu, options.start_values), name, arguments)
    run = planned(loaded, loaded.findings(), options)
    warn(run.plan)
    with Display(run.plan, show_progress=not arguments.no_progress) as display:
        outcome = run_launcher(Launcher(run, display.event, display.output))
    finish(run.plan, outcome, arguments)
    return 0


def _configuration(arguments: argparse.Namespace, name: str, description: ModelDescription) -> dict[str, Any]:
    """The configuration of a mesh of one instance, as it would stand in a file."""
    step_size = arguments.step_size
    if step_size is None:
        step_size = description.default_experiment.step_size
        if step_size is None:
            raise ConfigurationError(f"'{arguments.fmu}' has no default step size.", hint="Give one with --step-size.")
    record: dict[str, Any] = {"file": str(arguments.output.absolute()) if arguments.output is not None else None}
    return {
        "mesh": name,
        "simulation": {
            "stop_time": arguments.stop_time,
            "step_size": step_size,
            "real_time_factor": arguments.real_time_factor,
            "update_period": arguments.update_period,
            "catch_up": arguments.catch_up,
        },
        "instances": {name: {"fmu": str(arguments.fmu.absolute()), "interpolation": arguments.interpolation}},
        "record": record,
        "zenoh": {"listen": arguments.listen, "connect": arguments.connect},
    }


def _named_by_options(loaded: LoadedConfig, name: str, arguments: argparse.Namespace) -> LoadedConfig:
    """The configuration whose findings name the options and no lines, because nobody has written a file."""
    names = {
        f"simulation.{field}": f"--{field.replace('_', '-')} {value:g}"
        for field in ("stop_time", "step_size", "real_time_factor", "update_period", "catch_up")
        if (value := getattr(arguments, field)) is not None
    }
    names |= {place: text.replace(f"--set {name}.", "--set ", 1) for place, text in loaded.overrides.items()}
    return replace(loaded, lines={}, overrides=names)
