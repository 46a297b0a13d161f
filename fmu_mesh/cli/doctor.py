"""`doctor`: what this host can run, one line for each thing, and what to do about those that are missing."""

from __future__ import annotations

import argparse
import shutil
import sys
import textwrap

from ..hosts.this_host import report_of_this_host
from ..text import printable
from .arguments import Runs
from .output.json_output import print_json

__all__ = ["RUNS"]


def _doctor(arguments: argparse.Namespace) -> int:
    report = report_of_this_host()
    if arguments.json:
        print_json(report)
        return report.exit_code
    width = max(60, shutil.get_terminal_size().columns) if sys.stdout.isatty() else sys.maxsize
    for check in report.checks:
        said = f"{check.found.removesuffix('.')}. {check.hint}" if check.hint is not None else check.found
        line = printable(f"{check.state:9}{check.name:22}{said}")
        print(textwrap.fill(line, width, subsequent_indent=" " * 31, break_on_hyphens=False))
    failed, missing = ([one.name for one in report.checks if one.state == state] for state in ("failed", "missing"))
    last = f"Meshes can run on this host. Missing for some of them: {', '.join(missing) or 'nothing'}."
    last = f"No mesh can run on this host: see {', '.join(failed)}." if failed else last
    print(f"\n{textwrap.fill(last, width, break_on_hyphens=False)}")
    return report.exit_code


RUNS: Runs = {"doctor": _doctor}
