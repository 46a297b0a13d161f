"""`play`: sends the messages of a recorded bag to the inputs of a running mesh."""

from __future__ import annotations

import argparse

from ..api.attaching import attach
from ..ros.bags.bag import Bag
from ..ros.bags.play_options import PlayOptions
from .arguments import Runs
from .run_options import given_options

__all__ = ["RUNS"]


def _play(arguments: argparse.Namespace) -> int:
    with (
        Bag(arguments.bag) as bag,  # first: what is wrong with it is told before anything about meshes
        attach(arguments.mesh, connect=arguments.connect, timeout=arguments.timeout) as run,
    ):
        played = run.play(bag, **given_options(arguments, PlayOptions))
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


RUNS: Runs = {"play": _play}
