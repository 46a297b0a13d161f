"""`recover`: finishes the result file of a run that was killed."""

from __future__ import annotations

import argparse

from ..results.formats import recover
from .arguments import Runs

__all__ = ["RUNS"]


def _recover(arguments: argparse.Namespace) -> int:
    print(f"{arguments.results}: {recover(arguments.results)} rows")
    return 0


RUNS: Runs = {"recover": _recover}
