"""`run`: one FMU as a free-running node in real time, without a configuration file.

Owns the configuration of this mesh of one instance; everything else is as for any mesh.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from ..config.base import NAME_PATTERN
from ..config.instance_sections import KIND
from ..config.loading import PlainConfig
from ..errors import ConfigurationError, LoadFailed
from ..instances.configuration import examine_data
from ..instances.registry import KINDS, describe
from ..run.launcher import Launcher
from ..run.options import Options, with_config_values
from ..run.preparing import planned
from ..run.run_plan import RunPlan
from ..variables.model_description import ModelDescription
from .arguments import CommandParser, Parsers, add_json
from .inspecting import no_fmu
from .output.display import Display, teller, warn
from .output.reports import RunReporter
from .run_options import add_options, read_options
from .running import add_output, finish, run_launcher

__all__ = ["PARSERS"]

_SIMULATION = {"real_time_factor": 1.0, "update_period": 0.01, "catch_up": 1.0}
"""The keys of `simulation` with other defaults than in a file; options replace them."""


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
        *_SIMULATION,
        "start_values",
        "config_values",
        "output",
        "listen",
        "connect",
        defaults={
            "step_size": "that of the FMU",
            "stop_time": "none, it runs until it is stopped",
            "output": "nothing is recorded",
            **{name: f"{value:g}" for name, value in _SIMULATION.items()},
        },
        metavars={"start_values": "VARIABLE=VALUE"},
    )
    add_output(parser)
    add_json(parser, "print the outcome as one JSON object, and nothing else on standard output")
    parser.set_defaults(run_command=_run)


def _run(arguments: argparse.Namespace) -> int:
    with RunReporter(wanted=arguments.json) as reporter:
        run = _planned(arguments, teller(quiet=arguments.quiet))
        if not arguments.quiet:
            warn(run.plan)
        with Display(run.plan, show_progress=not arguments.no_progress, quiet=arguments.quiet) as display:
            outcome = run_launcher(Launcher(run, display.event), run, reporter)
        finish(run.plan, outcome, arguments)
    return 0


def _planned(arguments: argparse.Namespace, tell: Callable[[str], None]) -> RunPlan:
    try:
        section = msgspec.convert({KIND: "fmu", "fmu": str(arguments.fmu)}, KINDS.section("fmu"))
        description = describe(arguments.fmu, section, tell=tell)
    except LoadFailed as error:
        raise no_fmu(arguments.fmu, error) from error
    name = arguments.name if arguments.name is not None else description.model_identifier
    if re.search(NAME_PATTERN, name) is None:
        what = "a name of letters, digits, _ and - that starts with a letter or _"
        raise ConfigurationError(f"'{name}' is not {what}", hint="Give the mesh such a name with --name.")
    options = read_options(arguments)
    options = replace(options, start_values=tuple(f"{name}.{change}" for change in options.start_values))
    plain = PlainConfig(_configuration(arguments, name, options, description), arguments.fmu)
    loaded, findings = examine_data(with_config_values(plain, options.config_values), options.start_values)
    findings.raise_any()
    named = {place: text.replace(f"--set {name}.", "--set ", 1) for place, text in loaded.overrides.items()}
    loaded = replace(loaded, overrides=named)
    return planned(loaded, loaded.findings(), options, known={name: description})


def _configuration(
    arguments: argparse.Namespace, name: str, options: Options, description: ModelDescription
) -> dict[str, Any]:
    """The configuration of a mesh of one instance as a file would have it, before options replace its keys."""
    step_size = description.default_experiment.step_size
    if step_size is None and options.step_size is None:
        raise ConfigurationError(f"'{arguments.fmu}' has no default step size.", hint="Give one with --step-size.")
    return {
        "mesh": name,
        "simulation": {
            "stop_time": None,
            "step_size": step_size if step_size is not None else options.step_size,
            **_SIMULATION,
        },
        "instances": {name: {"fmu": str(arguments.fmu.absolute()), "interpolation": arguments.interpolation}},
        "record": {"file": None},
    }


PARSERS: Parsers = {"run": _add_run}
