"""`recover`: finishes the result file of a run that was killed."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..api.recovering import recover
from .arguments import CommandParser, Parsers, add_quiet

__all__ = ["PARSERS"]


def _add_recover(parser: CommandParser) -> None:
    parser.add_argument("results", type=Path, metavar="FILE", help="the result file, as the run was given it")
    add_quiet(parser)
    parser.set_defaults(run_command=_recover)


def _recover(arguments: argparse.Namespace) -> int:
    print(f"{arguments.results}: {recover(arguments.results)} rows")
    return 0


PARSERS: Parsers = {"recover": _add_recover}
