"""`pause`, `resume`, `step`, `stop` and `wait`: a running mesh is told what to do, and waited for."""

from __future__ import annotations

import argparse
import re
from typing import get_args

from ..errors import ConfigurationError
from ..wire.client.reaching import Meshes
from ..wire.client.waiting import rest, wait_for
from ..wire.views import Command, MeshState
from .arguments import CommandParser, Parsers, add_json, add_quiet, add_reaching, whole
from .looking import add_question
from .output.json_output import print_json

__all__ = ["PARSERS"]

_TIMEOUT_S = 5.0
_WAIT_S = 60.0


def _add_command(parser: CommandParser) -> None:
    add_question(parser, _command)
    add_quiet(parser)
    _add_mesh(parser)


def _add_step(parser: CommandParser) -> None:
    _add_command(parser)
    parser.add_argument("points", nargs="?", metavar="N", help="points (1)")


def _command(arguments: argparse.Namespace, meshes: Meshes) -> int:
    name, points = arguments.mesh, getattr(arguments, "points", None)
    if arguments.command == "step" and points is None and name is not None and _NUMBER.fullmatch(name):
        name, points = None, name  # `step 10`: no mesh has a number as its name
    number = whole(points) if points is not None else 1
    if number < 1:
        raise ConfigurationError(f"N: '{points}' is not a whole number of 1 or more")
    command = Command(arguments.command, number)
    client = meshes.named(name)
    answer = rest(client, command) if command.command in ("pause", "step") else client.command(command)
    if arguments.json:
        print_json(answer)
        return 0
    what = "is told to end, and was" if answer.command == "stop" else f"is {answer.state}"
    print(f"mesh '{client.keys.mesh}' {what} at point {answer.point}")
    return 0


_NUMBER = re.compile(r"[-+]?[0-9.].*")


def _add_wait(parser: CommandParser) -> None:
    add_reaching(parser, _WAIT_S)
    add_json(parser, "JSON, as `status` prints it")
    add_quiet(parser)
    _add_mesh(parser)
    parser.add_argument(
        "--state",
        choices=get_args(MeshState),
        default="running",
        metavar="STATE",
        help=f"{', '.join(get_args(MeshState))} (running)",
    )
    parser.set_defaults(run_command=_wait)


def _wait(arguments: argparse.Namespace) -> int:
    # A mesh with a note is running or about to end; an endpoint may appear later.
    patience_s = arguments.timeout if arguments.connect else min(arguments.timeout, _TIMEOUT_S)
    with Meshes(arguments.connect, patience_s) as meshes:
        status = wait_for(meshes, arguments.mesh, arguments.state, arguments.timeout)
    if arguments.json:
        print_json(status)
    else:
        print(f"mesh '{status.mesh}' is {status.state} at point {status.point}")
    return 0


def _add_mesh(parser: CommandParser) -> None:
    parser.add_argument("mesh", nargs="?", metavar="MESH", help="name or key of the mesh; default: the only one")


PARSERS: Parsers = {
    "wait": _add_wait,
    "pause": _add_command,
    "resume": _add_command,
    "step": _add_step,
    "stop": _add_command,
}
