"""The command `fmu-mesh`: finds the module of a command, runs the command, and turns errors into text and an exit code.

Only the arguments of the command that is asked for are imported, and what does the work only if it runs.
"""

from __future__ import annotations

import argparse
import gc
import io
import os
import sys
from collections.abc import Collection, Mapping, Sequence
from contextlib import nullcontext, redirect_stdout
from functools import partial
from importlib import import_module
from pathlib import PurePath
from typing import Final

from .. import __version__
from ..errors import ConfigurationError, FmuMeshError
from ..printing import guard_streams
from ..run.limits import needed_mib
from ..text import did_you_mean
from .arguments import CommandParser, Runs

__all__ = ["COMMANDS", "command_parser", "main"]


COMMANDS: Final[Mapping[str, tuple[str, str, str]]] = {
    "launch": ("run", "running", "run a mesh: one process per node, and the master"),
    "simulate": ("run", "free_running", "simulate one FMU to its end, as fast as possible; `run` keeps it live"),
    "run": ("run", "free_running", "run one FMU live until it is stopped; `simulate` runs it to its end"),
    "sweep": ("run", "sweep", "run a mesh many times with other values, into one table"),
    "convergence": ("run", "sweep", "run a mesh with smaller and smaller steps, and estimate its error"),
    "new": ("file", "new_mesh", "write a configuration for FMUs, with suggested connections"),
    "check": ("run", "checking", "check a configuration and show its plan, without running it"),
    "graph": ("file", "graphing", "draw the graph of a configuration or of a running mesh"),
    "convert": (
        "file",
        "convert_command",
        "convert a package of SSP into a configuration file, or a mesh into a package",
    ),
    "inspect": ("file", "inspecting", "show the properties of an FMU, or of a package of SSP, without running it"),
    "doctor": ("file", "doctor", "show what this host can run, and what is missing for the rest"),
    "schema": ("run", "checking", "print the JSON Schema of configurations"),
    "ls": ("mesh", "looking", "list meshes, instances and variables"),
    "status": ("mesh", "looking", "show the state and progress of a mesh or an instance"),
    "top": ("mesh", "top", "show a live table of all instances of a mesh"),
    "dashboard": ("mesh", "dashboard", "show and steer running meshes on a page in a browser"),
    "foxglove": ("mesh", "foxglove_command", "show a mesh live in Foxglove"),
    "info": ("mesh", "looking", "show information about a mesh or an instance"),
    "get": ("mesh", "looking", "show current values"),
    "set": ("mesh", "looking", "set an unconnected input or a tunable parameter"),
    "watch": ("mesh", "looking", "show every value of variables until the mesh ends"),
    "logs": ("mesh", "steering", "show the log messages of a mesh"),
    "wait": ("mesh", "steering", "wait until a mesh is running, or in another state"),
    "pause": ("mesh", "steering", "pause a mesh at a point"),
    "resume": ("mesh", "steering", "resume a paused mesh"),
    "step": ("mesh", "steering", "run a mesh for some points and pause it again"),
    "reset": ("mesh", "steering", "begin again at the first point, in the same processes"),
    "checkpoint": ("mesh", "steering", "write the states of all instances at one point into a file"),
    "stop": ("mesh", "steering", "end the run of a mesh"),
    "rerun": ("run", "running", "run again what a result file has recorded"),
    "play": ("mesh", "steering", "play a recorded bag into the inputs of a mesh"),
    "plot": ("file", "plotting", "plot result files"),
    "compare": ("file", "plotting", "compare two result files"),
    "recover": ("file", "plotting", "finish the result file of a run that was killed"),
    "node": ("run", "running", "start one node manually"),
    "master": ("run", "running", "start the master and the recorder manually"),
    "render": ("run", "engines", "write a mesh for Slurm, Compose or Kubernetes"),
    "submit": ("run", "engines", "run a mesh as a job of Slurm, and follow it"),
    "gateway": ("run", "running", "start the gateway to ROS manually"),
    "router": ("run", "running", "run a Zenoh router"),
    "security": ("file", "security_command", "certify who may do what, and show it"),
    "completion": ("file", "completion", "print the script that completes commands in a shell"),
}
"""All commands in the order of the help: the module that has it in `PARSERS`, that in `RUNS`, and one line about it."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code (design, section 7)."""
    if "_ARGCOMPLETE" in os.environ:  # a shell asks how the line goes on
        from .completion import complete  # noqa: PLC0415 only then

        return complete(command_parser)
    guard_streams()
    given = [*(sys.argv[1:] if arguments is None else arguments)]
    try:
        options = _parsed(given)
    except ConfigurationError as error:
        print(f"fmu-mesh: {error}", file=sys.stderr)
        if "--json" in given:
            from .output.json_output import print_failure  # noqa: PLC0415 only then

            print_failure(error)
        return error.exit_code
    if options is None:
        return ConfigurationError.exit_code
    from ..run.program import exit_code_of  # noqa: PLC0415 not for `--version` and `--help`

    needed = needed_mib(options.command, local=getattr(options, "processes", None) is False)
    return exit_code_of(partial(_run, options), needed, debug=options.debug)


def _run(options: argparse.Namespace) -> int:
    """Run the command; with `--quiet` and without `--json`, nothing of what it prints is shown but errors."""
    quiet = getattr(options, "quiet", False) and not getattr(options, "json", False)
    with redirect_stdout(io.StringIO()) if quiet else nullcontext():
        runs: Runs = import_module(f".{COMMANDS[options.command][1]}", __package__).RUNS
        if not gc.isenabled():
            gc.freeze()  # what was imported stays
            gc.enable()
        try:
            return runs[options.command](options)
        except FmuMeshError as error:
            from .output.flag_words import in_flags  # noqa: PLC0415  only then

            raise error.in_words(in_flags) from error.__cause__


def _parsed(given: Sequence[str]) -> argparse.Namespace | None:
    """The command and its arguments; None, after the help, without a command."""
    name = next((argument for argument in given if not argument.startswith("-")), None)
    if name is not None and given[0] == name and name not in COMMANDS:
        suffix = PurePath(name).suffix  # somebody may have left the command out
        hint = did_you_mean(name, COMMANDS, "`fmu-mesh --help` lists them.")
        if suffix in (".yaml", ".yml", ".fmu", ".ssp", ".ssd", ".world", ".sdf"):
            hint = f"Did you mean `fmu-mesh {'simulate' if suffix == '.fmu' else 'launch'} {name}`?"
        raise ConfigurationError(f"there is no command '{name}'.", hint=hint)
    parser, commands = command_parser([] if name is None else [name])
    options, others = parser.parse_known_args(given)
    if others:
        commands = command_parser()[1]  # all of them: another one may have the option
        wrong = next((other for other in others if other.startswith("-")), others[0])
        raise commands.get(options.command, parser).unknown(wrong, commands)
    if options.command is None:
        parser.print_help()
        return None
    return options


def command_parser(needed: Collection[str] = COMMANDS) -> tuple[CommandParser, Mapping[str, CommandParser]]:
    """The parser, and those of all commands by name; those of commands that are not ``needed`` have no arguments."""
    parser = CommandParser(
        prog="fmu-mesh",
        description="A service mesh for co-simulation: FMUs as Zenoh nodes under one master.",
        epilog="Exit codes: 0 done, 1 internal error, 2 wrong usage or configuration, 3 an FMU failed, "
        "4 a node or the master was lost, 130 interrupted.",
    )
    parser.add_argument("--version", action="version", version=f"fmu-mesh {__version__}")
    commands: argparse._SubParsersAction[CommandParser] = parser.add_subparsers(dest="command", metavar="COMMAND")
    for name, (kind, _, text) in COMMANDS.items():
        command = commands.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
        command.add_argument("--debug", action="store_true", help="show the traceback of an error")
        if name in needed:
            for add in import_module(f".{kind}_arguments", __package__).PARSERS[name]:
                add(command)
    return parser, commands.choices
