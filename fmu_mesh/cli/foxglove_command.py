"""`foxglove`: serves the live values of a mesh to Foxglove until Ctrl-C."""

from __future__ import annotations

import argparse
import sys

from ..installing import importing
from .arguments import CommandParser, Parsers, add_quiet, add_reaching, port_number

__all__ = ["PARSERS"]

_HOST = "127.0.0.1"
_PORT = 8765


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
        "--port", type=port_number, default=_PORT, metavar="N", help=f"the port, 0 for a free one ({_PORT})"
    )
    parser.add_argument("--steer", action="store_true", help="clients may set inputs and parameters")
    parser.add_argument(
        "--origin",
        action="append",
        default=[],
        metavar="ORIGIN",
        help="let pages of this origin connect, too, such as https://foxglove.example.org; may be repeated",
    )
    parser.set_defaults(run_command=_foxglove)


def _foxglove(arguments: argparse.Namespace) -> int:
    with importing("foxglove-sdk", "connections of Foxglove"):
        from ..foxglove.serving import Serving, serve  # noqa: PLC0415  an extra
    serving = Serving(
        mesh=arguments.mesh,
        connect=tuple(arguments.connect),
        timeout_s=arguments.timeout,
        variables=tuple(arguments.variables),
        host=arguments.host,
        port=arguments.port,
        read_only=not arguments.steer,
        origins=tuple(arguments.origin),
    )
    if serving.leaves_host:
        can = "read" if serving.read_only else "read and set"
        who = f"whoever can reach this host at {serving.host}, port {serving.port} and knows the address"
        print(f"fmu-mesh: warning: {who} can {can} this mesh; it is not encrypted", file=sys.stderr, flush=True)
    serve(serving, lambda text: print(text, flush=True))
    return 0


PARSERS: Parsers = {"foxglove": _add_foxglove}
