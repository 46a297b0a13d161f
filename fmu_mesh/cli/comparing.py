"""`compare`: two result files side by side, for people, for scripts and for the tests of users."""

from __future__ import annotations

import argparse
from pathlib import Path

from msgspec.structs import asdict

from ..api.comparison import Comparison
from ..api.drawing import draw
from ..api.result import Result
from ..installing import require
from .arguments import CommandParser, Parsers, add_json, add_quiet, tolerance
from .output.json_output import print_json

__all__ = ["PARSERS"]

_DIFFERENT = 1


def _add_compare(parser: CommandParser) -> None:
    parser.add_argument("first", type=Path, metavar="RESULTS.csv", help="a result file, whose times and units hold")
    parser.add_argument("second", type=Path, metavar="RESULTS.csv", help="the other result file")
    parser.add_argument(
        "--rtol", type=tolerance, default=0.0, metavar="X", help="relative tolerance; default: 0, bit for bit"
    )
    parser.add_argument(
        "--atol", type=tolerance, default=0.0, metavar="X", help="absolute tolerance, in the unit of each variable"
    )
    parser.add_argument(
        "--variables",
        nargs="+",
        default=(),
        metavar="INSTANCE.VARIABLE",
        help="compare only these, or patterns such as 'motor.*'; default: all",
    )
    parser.add_argument(
        "--plot", type=Path, metavar="FILE.png", help="draw both and their difference: the variables that differ most"
    )
    add_quiet(parser)
    add_json(parser, "JSON: one object with all differences")
    parser.set_defaults(run_command=_compare)


def _compare(arguments: argparse.Namespace) -> int:
    if arguments.plot is not None:
        require("matplotlib", "plots")
    first, second = (Result(path.stem, file=path) for path in (arguments.first, arguments.second))
    comparison = first.compare(second, rtol=arguments.rtol, atol=arguments.atol, variables=tuple(arguments.variables))
    if arguments.json:
        print_json(_plain(comparison))
    else:
        print(comparison.text)
    if arguments.plot is not None:
        draw(comparison.plot(), arguments.plot)
        if not arguments.json:
            print(f"plot: {arguments.plot}")
    return 0 if comparison.equal else _DIFFERENT


def _plain(comparison: Comparison) -> dict[str, object]:
    fields = {name: value for name, value in asdict(comparison).items() if name != "drawn"}
    return {"equal": comparison.equal, "exit_code": 0 if comparison.equal else _DIFFERENT, **fields}


PARSERS: Parsers = {"compare": _add_compare}
