"""The command `fmu-mesh`: finds the command's module, runs it, and turns errors into one paragraph and an exit code."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path

from .. import __version__
from ..errors import ConfigurationError
from ..run.limits import needed_mib
from ..run.program import exit_code_of
from ..text import nearest
from . import checking, free_running, inspecting, looking, play, plotting, running, top
from .arguments import CommandParser

__all__ = ["command_parser", "main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code (design, section 7)."""
    parser, commands = command_parser()
    options = _parsed(sys.argv[1:] if arguments is None else arguments, parser, commands)
    if isinstance(options, ConfigurationError):
        print(f"fmu-mesh: {options}", file=sys.stderr)
        return options.exit_code
    if options.command is None:
        parser.print_help()
        return ConfigurationError.exit_code
    needed = needed_mib(options.command, local=getattr(options, "local", False))
    return exit_code_of(partial(options.run_command, options), needed, debug=options.debug)


def _parsed(
    given: Sequence[str], parser: CommandParser, commands: Mapping[str, CommandParser]
) -> argparse.Namespace | ConfigurationError:
    """The command and its arguments, or the error in them."""
    if given and not given[0].startswith("-") and given[0] not in commands:
        return _unknown(given[0], commands)
    options, others = parser.parse_known_args(given)
    if not others:
        return options
    wrong = next((other for other in others if other.startswith("-")), others[0])
    return commands.get(options.command, parser).unknown(wrong, commands)


def _unknown(name: str, commands: Iterable[str]) -> ConfigurationError:
    """The error for a first argument that is not a command, such as a file."""
    suffix = Path(name).suffix
    near = nearest(name, commands)
    if suffix in (".yaml", ".yml", ".fmu"):
        hint = f"Did you mean `fmu-mesh {'run' if suffix == '.fmu' else 'launch'} {name}`?"
    else:
        hint = f"Did you mean '{near}'?" if near is not None else "`fmu-mesh --help` lists them."
    return ConfigurationError(f"there is no command '{name}'.", hint=hint)


def command_parser() -> tuple[CommandParser, Mapping[str, CommandParser]]:
    """The parser, and the parsers of all commands by name."""
    parser = CommandParser(
        prog="fmu-mesh",
        description="A service mesh for co-simulation: FMUs as Zenoh nodes under one master.",
        epilog="Exit codes: 0 done, 1 internal error, 2 wrong usage or configuration, 3 an FMU failed, "
        "4 a node or the master was lost, 130 interrupted.",
    )
    parser.add_argument("--version", action="version", version=f"fmu-mesh {__version__}")
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--debug", action="store_true", help="show the traceback of an error")
    parser.set_defaults(debug=False)
    commands: argparse._SubParsersAction[CommandParser] = parser.add_subparsers(dest="command", metavar="COMMAND")
    for module in (running, free_running, checking, inspecting, looking, top, play, plotting):
        module.add_commands(commands, common)
    return parser, commands.choices
