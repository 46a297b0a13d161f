"""`convert`: a package of SSP becomes a YAML file, and a mesh becomes a package."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from .. import files
from ..api.converting import convert
from ..api.package_inspection import inspect_package
from ..errors import ConfigurationError
from .arguments import CommandParser, Parsers, add_quiet, add_ssd
from .output.display import say
from .run_options import add_options, read_options

__all__ = ["PARSERS"]

_TIMES = ("algorithm", "step_size", "stop_time")
_DESCRIPTION = ".ssd"
_DEFAULT = "SystemStructure.ssd"


def _add_convert(parser: CommandParser) -> None:
    parser.add_argument("source", type=Path, metavar="SOURCE", help="a package of SSP, or a configuration file")
    parser.add_argument("target", type=Path, metavar="TARGET", help="the new file: .yaml, or .ssp")
    add_ssd(parser)
    parser.add_argument(
        "--version",
        choices=("1.0", "2.0"),
        metavar="1.0|2.0",
        help="version of SSP; default: that of SOURCE if it is a package, otherwise 1.0",
    )
    add_options(parser.add_argument_group("instead of what SOURCE says"), *_TIMES)
    parser.add_argument("--force", action="store_true", help="overwrite TARGET")
    add_quiet(parser)
    parser.set_defaults(run_command=_convert)


def _convert(arguments: argparse.Namespace) -> int:
    source, target = arguments.source, arguments.target
    if files.exists(target) and not arguments.force:
        raise ConfigurationError(f"'{target}' exists.", hint="--force overwrites it.")
    options = read_options(arguments)
    given = {name: value for name in _TIMES if (value := getattr(options, name)) is not None}
    lost = convert(source, target, ssd=arguments.ssd, version=arguments.version, simulation=given)
    if not arguments.quiet:
        for finding in lost:
            say(f"warning: {finding}")
    of_package = source.name if arguments.ssd is None and source.suffix == _DESCRIPTION else arguments.ssd
    print(f"{target}: run it with `fmu-mesh launch {target}{_option(target, of_package)}`")
    return 0


def _option(target: Path, ssd: str | None) -> str:
    """The option that a copy of a package needs to run another description of it than the default one."""
    if ssd is None or target.suffix.lower() != ".ssp":
        return ""
    try:
        name = inspect_package(target, ssd=ssd).description
    except ConfigurationError:
        return ""  # it has a new description, which is its only one
    return "" if name == _DEFAULT else f" --ssd {shlex.quote(name)}"


PARSERS: Parsers = {"convert": _add_convert}
