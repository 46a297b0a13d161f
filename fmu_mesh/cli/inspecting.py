"""`inspect`: the properties of one FMU, or of a package of SSP. Nothing of it is executed."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Final

import msgspec

from ..api.inspection import SHOWN_VARIABLES, inspect
from ..errors import ConfigurationError, LoadFailed
from ..printing import write_data
from ..ssp.configuration_files import named_package
from .arguments import CommandParser, Parsers, add_json, add_ssd
from .output.json_output import print_failure

__all__ = ["PARSERS"]

_NARROWEST: Final = 60
_WIDE: Final = 120


def _add_inspect(parser: CommandParser) -> None:
    text = "the FMU, or the folder of an unpacked one; or a package of SSP"
    parser.add_argument("fmu", type=Path, metavar="MODEL.fmu|PACKAGE", help=text)
    parser.add_argument(
        "variables",
        nargs="*",
        metavar="VARIABLE",
        help="show only these variables, or patterns, such as 'x*'",
    )
    parser.add_argument(
        "--all", action="store_true", help=f"show all variables instead of {SHOWN_VARIABLES} of each causality"
    )
    add_ssd(parser)
    add_json(parser, "print everything as one JSON object")
    parser.set_defaults(run_command=_inspect)


def _inspect(arguments: argparse.Namespace) -> int:
    try:
        return _inspected(arguments)
    except ConfigurationError as error:
        if arguments.json:
            print_failure(error)
        raise


def _inspected(arguments: argparse.Namespace) -> int:
    if named_package(arguments.fmu, arguments.ssd) is not None:
        return _inspect_package(arguments)
    if arguments.ssd is not None:
        raise ConfigurationError(
            f"--ssd chooses a description of a package of SSP, and '{arguments.fmu}' is no package"
        )
    try:
        inspection = inspect(arguments.fmu)
    except LoadFailed as error:  # a wrong argument: nothing was going to run
        raise ConfigurationError(error.message, hint=error.hint) from error
    if arguments.json:
        write_data(msgspec.json.format(msgspec.json.encode(inspection)) + b"\n")
        return 0
    width = max(_NARROWEST, shutil.get_terminal_size((_WIDE, 0)).columns)
    print(inspection.page(width, arguments.variables, everything=arguments.all))
    return 0


def _inspect_package(arguments: argparse.Namespace) -> int:
    if arguments.variables:
        path = arguments.fmu.parent if arguments.fmu.suffix.lower() == ".ssd" else arguments.fmu
        hint = f"Those of an FMU are shown by `fmu-mesh inspect {path}/resources/NAME.fmu`."
        raise ConfigurationError("a package of SSP has no variables of its own", hint=hint)
    from ..api.package_inspection import inspect_package  # noqa: PLC0415  it needs more than an FMU does

    found = inspect_package(arguments.fmu, ssd=arguments.ssd)
    if arguments.json:
        write_data(msgspec.json.format(msgspec.json.encode(found)) + b"\n")
    else:
        print(found)
    return 0


PARSERS: Parsers = {"inspect": _add_inspect}
