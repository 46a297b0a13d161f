"""`play`: sends the messages of a recorded bag to the inputs of a running mesh."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..api.attaching import attach
from ..ros.bags.bag import Bag
from .arguments import CommandParser, Parsers, add_quiet, add_reaching, number

__all__ = ["PARSERS"]

_TIMEOUT_S = 60.0


def _add_play(parser: CommandParser) -> None:
    add_reaching(parser, _TIMEOUT_S)
    add_quiet(parser)
    parser.add_argument("bag", type=Path, metavar="BAG", help="an MCAP file, or the folder of a `ros2 bag`")
    parser.add_argument("mesh", nargs="?", metavar="MESH", help="name or key of the mesh; default: the only one")
    parser.add_argument(
        "--topic",
        action="append",
        default=[],
        metavar="TOPIC[:FIELD]=INSTANCE.VARIABLE",
        help="a topic and its input; repeatable; default: the topics that the mesh subscribes to",
    )
    parser.add_argument(
        "--start", type=number, metavar="T", help="simulation time of the first message in s; default: its stamp"
    )
    parser.add_argument(
        "--stamps",
        choices=("header", "log"),
        default="header",
        help="use header stamps where messages have them, or log times (header)",
    )
    parser.add_argument(
        "--config", type=Path, metavar="CONFIG", help="the configuration, if that of the mesh is not on this host"
    )
    parser.set_defaults(run_command=_play)


def _play(arguments: argparse.Namespace) -> int:
    with (
        Bag(arguments.bag) as bag,  # first: what is wrong with it is told before anything about meshes
        attach(arguments.mesh, connect=arguments.connect, timeout=arguments.timeout) as run,
    ):
        played = run.play(
            bag,
            topics=arguments.topic,
            start=arguments.start,
            stamps=arguments.stamps,
            config=arguments.config,
            timeout=arguments.timeout,
        )
    names = ", ".join(played.topics)
    print(f"played {played.values} values of {names} from point {played.first} to point {played.last}")
    for several, why in (
        (played.merged, "were followed by another one for the same point"),
        (played.past, "were past already, and followed by another one"),
        (played.beyond, "are at or after the end of the simulation"),
    ):
        if several:
            print(f"{several} values {why}")
    return 0


PARSERS: Parsers = {"play": _add_play}
