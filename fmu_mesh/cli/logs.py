"""`logs`: the log messages of a running mesh."""

from __future__ import annotations

import argparse
import os
import sys

from ..api.attaching import attach
from ..errors import ConfigurationError, Interrupted
from ..text import listed, nearest
from ..wire.views import LogLine
from .arguments import Runs
from .mesh_arguments import LEVELS
from .output.json_output import print_json

__all__ = ["RUNS"]


def _logs(arguments: argparse.Namespace) -> int:
    with attach(arguments.mesh, connect=arguments.connect, timeout=arguments.timeout) as run:
        if arguments.instance is not None and arguments.instance not in (names := run.info().instances):
            near = nearest(arguments.instance, names)
            hint = f"Did you mean '{near}'?" if near is not None else f"There are: {listed(names)}."
            raise ConfigurationError(f"mesh '{run.name}' has no instance '{arguments.instance}'.", hint=hint)
        try:
            for line in run.logs(follow=arguments.follow):
                if arguments.instance in (None, line.instance) and _rank(line.status) >= _rank(arguments.level):
                    _show(line, as_json=arguments.json)
        except KeyboardInterrupt:
            sys.stdout.flush()
            os._exit(Interrupted.exit_code)  # as `watch` does: closing a session in order can take long
    return 0


def _show(line: LogLine, *, as_json: bool) -> None:
    if as_json:
        print_json(line)
    else:
        text = " ".join(line.message.split())
        print(f"{line.instance} at point {line.point}: {line.status.lower()}: {text}", flush=True)


def _rank(status: str) -> int:
    """How severe a status is; one that FMI does not know is the least."""
    return LEVELS.index(status.lower()) if status.lower() in LEVELS else 0


RUNS: Runs = {"logs": _logs}
