"""`convert`: a package of SSP becomes a YAML file, and a mesh becomes a package."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from .. import files
from ..api.converting import convert
from ..errors import ConfigurationError
from ..ssp.configuration_files import named_package
from ..ssp.package import DEFAULT, Package
from ..ssp.system_reading import chosen_description
from .arguments import CommandParser, Parsers, add_package, add_quiet
from .output.display import say
from .run_options import add_options

__all__ = ["PARSERS"]

_TIMES = ("algorithm", "step_size", "stop_time")


def _add_convert(parser: CommandParser) -> None:
    parser.add_argument("source", type=Path, metavar="SOURCE", help="a package of SSP, or a configuration file")
    parser.add_argument("target", type=Path, metavar="TARGET", help="the new file: .yaml, or .ssp")
    add_package(parser)
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
    given = {name: value for name in _TIMES if (value := getattr(arguments, name)) is not None}
    lost = convert(source, target, ssd=arguments.ssd, ssv=arguments.ssv, version=arguments.version, simulation=given)
    if not arguments.quiet:
        for finding in lost:
            say(f"warning: {finding}")
    print(f"{target}: run it with `{_launch(source, arguments.ssd, target)}`")
    return 0


def _launch(source: Path, ssd: str | None, target: Path) -> str:
    """The command that runs what was written."""
    words = ["fmu-mesh", "launch", str(target)]
    named = named_package(source, ssd)
    if named is not None and target.suffix.lower() == ".ssp":
        with Package(named[0]) as package:
            name = chosen_description(package, named[1])
        with Package(target) as package:
            if name != DEFAULT and name in package.descriptions:
                words += ["--ssd", name]
    return shlex.join(words)


PARSERS: Parsers = {"convert": _add_convert}
