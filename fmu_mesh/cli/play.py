"""`play`: sends the messages of a recorded bag to the inputs of a running mesh."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..errors import ConfigurationError
from ..instances.configuration import load
from ..ros.bags.bag import Bag, chosen_topics
from ..ros.bags.playing import grid_of, play, schedule
from ..wire.client.reaching import Meshes
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
    with Bag(arguments.bag) as bag, Meshes(arguments.connect, arguments.timeout) as meshes:
        client = meshes.named(arguments.mesh)
        mesh = client.info()
        infos = {name: client.instance_info(name) for name in mesh.instances}
        loaded = load(arguments.config or Path(mesh.config))
        topics = chosen_topics(loaded, infos, bag, arguments.topic)
        step_points = {name: round(info.step_size / mesh.step_size) for name, info in infos.items()}
        samples = bag.samples(topics, arguments.stamps)
        moments, merged, beyond = schedule(samples, grid_of(mesh), step_points, start=arguments.start)
        names = ", ".join(topic.name for topic in topics)
        if not moments:
            raise _nothing(arguments, names, beyond)
        count, first = play(client, moments, step_points, arguments.timeout)
    past = sum(len(moment.values) for moment in moments) - count
    print(f"played {count} values of {names} from point {first} to point {moments[-1].point}")
    for several, why in (
        (merged, "were followed by another one for the same point"),
        (past, "were past already, and followed by another one"),
        (beyond, "are at or after the end of the simulation"),
    ):
        if several:
            print(f"{several} values {why}")
    return 0


def _nothing(arguments: argparse.Namespace, names: str, beyond: int) -> ConfigurationError:
    if beyond:
        return ConfigurationError(
            f"all {beyond} values of {names} in '{arguments.bag}' are at or after the end of the simulation.",
            hint="Say when the first one is: --start 0.",
        )
    return ConfigurationError(f"there is no message of {names} in '{arguments.bag}'.")


PARSERS: Parsers = {"play": _add_play}
