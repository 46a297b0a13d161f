"""`compare`: two result files side by side, for people, for scripts and for the tests of users."""

from __future__ import annotations

import argparse

from msgspec.structs import asdict

from ..api.comparison import Comparison
from ..api.result import Result
from ..installing import require
from ..pictures.drawing import draw
from .arguments import Runs
from .output.json_output import print_json

__all__ = ["RUNS"]

_DIFFERENT = 1


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


RUNS: Runs = {"compare": _compare}
