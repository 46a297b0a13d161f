"""`inspect`: the properties of one FMU. Nothing of it is executed."""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path
from typing import Final

import msgspec

from ..api.inspection import SHOWN_VARIABLES, inspect
from ..errors import ConfigurationError, LoadFailed
from .arguments import CommandParser, Parsers, add_json
from .output.json_output import print_failure

__all__ = ["PARSERS"]

_NARROWEST: Final = 60
_WIDE: Final = 120


def _add_inspect(parser: CommandParser) -> None:
    parser.add_argument("fmu", type=Path, metavar="MODEL.fmu", help="the FMU, or the folder of an unpacked one")
    parser.add_argument(
        "variables",
        nargs="*",
        metavar="VARIABLE",
        help="show only these variables, or patterns, such as 'x*'",
    )
    parser.add_argument(
        "--all", action="store_true", help=f"show all variables instead of {SHOWN_VARIABLES} of each causality"
    )
    add_json(parser, "print everything as one JSON object")
    parser.set_defaults(run_command=_inspect)


def _inspect(arguments: argparse.Namespace) -> int:
    try:
        inspection = inspect(arguments.fmu)
    except LoadFailed as error:  # a wrong argument: nothing was going to run
        wrong = ConfigurationError(error.message, hint=error.hint)
        if arguments.json:
            print_failure(wrong)
        raise wrong from error
    if arguments.json:
        sys.stdout.buffer.write(msgspec.json.format(msgspec.json.encode(inspection)) + b"\n")
        return 0
    width = max(_NARROWEST, shutil.get_terminal_size((_WIDE, 0)).columns)
    print(inspection.page(width, arguments.variables, everything=arguments.all))
    return 0


PARSERS: Parsers = {"inspect": _add_inspect}
