"""The arguments of the commands for running meshes. Owns no work: `--help` imports this and little else."""

from __future__ import annotations

from pathlib import Path
from typing import Final, get_args

from ..ros.bags.play_options import PlayOptions
from ..wire.views import MeshState
from .arguments import (
    CommandParser,
    Parsers,
    add_json,
    add_quiet,
    add_reaching,
    count,
    number,
    port_number,
    positive_seconds,
)
from .run_options import add_options

__all__ = ["LEVELS", "PARSERS"]

_HOST: Final = "127.0.0.1"
_INTERVAL_S: Final = 1.0
_PATIENCE_S: Final = 60.0
"""The usual deadline of `wait` and of `play`."""
LEVELS: Final = ("ok", "warning", "discard", "error", "fatal")
"""The statuses of log messages in ascending order."""
_REFERENCE: Final = (
    "`instance.variable` or `MESH/instance.variable`, or a pattern of them (`*` any characters, `?` one, `re:` a "
    "regular expression); or a key (with wildcards of Zenoh)"
)
_WHICH: Final = "a mesh or an instance: NAME, MESH/INSTANCE, or its key"


def _add_question(parser: CommandParser) -> None:
    """Add the flags of a command that asks running meshes."""
    add_reaching(parser)
    add_json(parser)


def _add_ls(parser: CommandParser) -> None:
    _add_question(parser)
    parser.add_argument("name", nargs="?", metavar="NAME", help="a mesh, or an instance, whose variables are listed")
    parser.add_argument("-l", "--long", action="store_true", help="also list the variables of every instance")


def _add_status(parser: CommandParser) -> None:
    _add_question(parser)
    parser.add_argument("key", nargs="?", metavar="KEY", help=f"{_WHICH}; default: every mesh")


def _add_info(parser: CommandParser) -> None:
    _add_question(parser)
    parser.add_argument("key", metavar="KEY", help=_WHICH)


def _add_get(parser: CommandParser) -> None:
    _add_question(parser)
    parser.add_argument("key", nargs="+", metavar="KEY", help=_REFERENCE)


def _add_set(parser: CommandParser) -> None:
    _add_question(parser)
    add_quiet(parser)
    parser.add_argument("key", metavar="KEY", help="`instance.variable`, `MESH/instance.variable`, or a key")
    parser.add_argument("value", metavar="VALUE", help="a number, true, false, text, or [a, list] for an array")
    parser.add_argument("--at", type=number, metavar="T", help="simulation time in s from which on it holds")


def _add_watch(parser: CommandParser) -> None:
    _add_question(parser)
    parser.add_argument("key", nargs="+", metavar="KEY", help=_REFERENCE)
    parser.add_argument("--count", type=count, metavar="N", help="end after N values")


def _add_top(parser: CommandParser) -> None:
    add_reaching(parser)
    parser.add_argument("mesh", nargs="?", metavar="MESH", help="name or key of the mesh; default: the only one")
    parser.add_argument("--once", action="store_true", help="show it once and exit")
    parser.add_argument(
        "--interval", type=positive_seconds, default=_INTERVAL_S, metavar="S", help="time between two looks in s (1)"
    )
    parser.add_argument(
        "--watch",
        nargs="+",
        default=[],
        metavar="INSTANCE.VARIABLE",
        help="also show the course of these variables (or patterns, such as 'arm*.x')",
    )
    add_json(parser, "JSON, one object per look")


def _add_dashboard(parser: CommandParser) -> None:
    add_reaching(parser)
    parser.add_argument("mesh", nargs="?", metavar="MESH", help="name or key of the mesh; default: all that run")
    parser.add_argument("--host", default=_HOST, metavar="ADDRESS", help=f"address where the page is served ({_HOST})")
    parser.add_argument("--port", type=port_number, default=0, metavar="N", help="port of the page; 0: a free one (0)")
    parser.add_argument("--read-only", action="store_true", help="show the meshes, but set and steer nothing")
    parser.add_argument("--no-browser", action="store_true", help="print the address only")


def _add_foxglove(parser: CommandParser) -> None:
    add_reaching(parser)
    add_quiet(parser)
    parser.add_argument("mesh", nargs="?", metavar="MESH", help="name or key of the mesh; default: the only one")
    parser.add_argument(
        "--variables",
        nargs="+",
        default=[],
        metavar="INSTANCE.VARIABLE",
        help="offer only these, or patterns; default: all outputs",
    )
    parser.add_argument("--host", default=_HOST, metavar="ADDRESS", help=f"the address to listen at ({_HOST})")
    parser.add_argument(
        "--port",
        type=port_number,
        default=8765,
        metavar="N",
        help="the port, 0 for a free one (8765)",
    )
    parser.add_argument("--steer", action="store_true", help="clients may set inputs and parameters")
    parser.add_argument(
        "--origin",
        action="append",
        default=[],
        metavar="ORIGIN",
        help="let pages of this origin connect, too, such as https://foxglove.example.org; may be repeated",
    )


def _add_logs(parser: CommandParser) -> None:
    add_reaching(parser)
    add_json(parser)
    parser.add_argument("mesh", nargs="?", metavar="MESH", help="name or key of the mesh; default: the only one")
    parser.add_argument("--instance", metavar="NAME", help="only the messages of this instance")
    parser.add_argument(
        "--level",
        choices=LEVELS,
        default="ok",
        metavar="STATUS",
        help=f"from this status on: {', '.join(LEVELS)} (ok)",
    )
    parser.add_argument("-f", "--follow", action="store_true", help="also show new messages, until the mesh ends")


def _add_command(parser: CommandParser) -> None:
    add_reaching(parser)
    add_json(parser)
    add_quiet(parser)
    _add_mesh(parser)


def _add_step(parser: CommandParser) -> None:
    _add_command(parser)
    parser.add_argument("points", nargs="?", metavar="N", help="points (1)")


def _add_wait(parser: CommandParser) -> None:
    add_reaching(parser, _PATIENCE_S)
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


def _add_mesh(parser: CommandParser) -> None:
    parser.add_argument("mesh", nargs="?", metavar="MESH", help="name or key of the mesh; default: the only one")


def _add_play(parser: CommandParser) -> None:
    add_reaching(parser, _PATIENCE_S)
    add_quiet(parser)
    parser.add_argument("bag", type=Path, metavar="BAG", help="an MCAP file, or the folder of a `ros2 bag`")
    parser.add_argument("mesh", nargs="?", metavar="MESH", help="name or key of the mesh; default: the only one")
    add_options(parser, "topics", "start", "stamps", "config", options=PlayOptions)


PARSERS: Parsers = {
    "ls": _add_ls,
    "status": _add_status,
    "info": _add_info,
    "get": _add_get,
    "set": _add_set,
    "watch": _add_watch,
    "top": _add_top,
    "dashboard": _add_dashboard,
    "foxglove": _add_foxglove,
    "logs": _add_logs,
    "wait": _add_wait,
    "pause": _add_command,
    "resume": _add_command,
    "step": _add_step,
    "stop": _add_command,
    "play": _add_play,
}
