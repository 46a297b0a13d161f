"""`foxglove`: serves the live values of a mesh to Foxglove until Ctrl-C."""

from __future__ import annotations

import argparse
import sys

from ..installing import importing
from ..web_server import is_loopback
from .arguments import Runs, reach

__all__ = ["RUNS"]


def _foxglove(arguments: argparse.Namespace) -> int:
    with importing("foxglove-sdk"):
        from ..foxglove.serving import Serving, serve  # noqa: PLC0415  an extra
    serving = Serving(
        mesh=arguments.mesh,
        **reach(arguments),
        variables=tuple(arguments.variables),
        host=arguments.host,
        port=arguments.port,
        read_only=not arguments.steer,
        origins=tuple(arguments.origin),
    )
    if not is_loopback(serving.host):
        can = "read" if serving.read_only else "read and set"
        who = f"whoever can reach this host at {serving.host}, port {serving.port} and knows the address"
        print(f"fmu-mesh: warning: {who} can {can} this mesh; it is not encrypted", file=sys.stderr, flush=True)
    serve(serving, lambda text: print(text, flush=True))
    return 0


RUNS: Runs = {"foxglove": _foxglove}
