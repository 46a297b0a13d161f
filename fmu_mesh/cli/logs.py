"""`logs`: the log messages of a running mesh."""

from __future__ import annotations

import argparse
import os
import sys
from typing import Final

from ..errors import ConfigurationError, Interrupted
from ..text import listed, nearest
from ..wire.client.reaching import Meshes
from ..wire.views import LogLine
from .arguments import CommandParser, Parsers
from .looking import add_question
from .output.json_output import print_json

__all__ = ["PARSERS"]

_LEVELS: Final = ("ok", "warning", "discard", "error", "fatal")


def _add_logs(parser: CommandParser) -> None:
    add_question(parser, _logs)
    parser.add_argument("mesh", nargs="?", metavar="MESH", help="name or key of the mesh; default: the only one")
    parser.add_argument("--instance", metavar="NAME", help="only the messages of this instance")
    parser.add_argument(
        "--level",
        choices=_LEVELS,
        default="ok",
        metavar="STATUS",
        help=f"from this status on: {', '.join(_LEVELS)} (ok)",
    )
    parser.add_argument("-f", "--follow", action="store_true", help="also show new messages, until the mesh ends")


def _logs(arguments: argparse.Namespace, meshes: Meshes) -> int:
    client = meshes.named(arguments.mesh)
    if arguments.instance is not None and arguments.instance not in (names := client.info().instances):
        near = nearest(arguments.instance, names)
        hint = f"Did you mean '{near}'?" if near is not None else f"There are: {listed(names)}."
        raise ConfigurationError(f"mesh '{client.keys.mesh}' has no instance '{arguments.instance}'.", hint=hint)
    with client.logs(follow=arguments.follow) as lines:
        try:
            for line in lines:
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
    return _LEVELS.index(status.lower()) if status.lower() in _LEVELS else 0


PARSERS: Parsers = {"logs": _add_logs}
