"""`dashboard`: a page in a browser that shows running meshes and steers them."""

from __future__ import annotations

import argparse
import os
import sys
import webbrowser

from ..dashboard.access import is_loopback
from ..dashboard.dashboard_server import DashboardOptions, serve
from ..errors import Interrupted
from .arguments import CommandParser, Parsers, add_reaching, port_number

__all__ = ["PARSERS"]

_LOOPBACK = "127.0.0.1"


def _add_dashboard(parser: CommandParser) -> None:
    add_reaching(parser)
    parser.add_argument("mesh", nargs="?", metavar="MESH", help="name or key of the mesh; default: all that run")
    parser.add_argument(
        "--host", default=_LOOPBACK, metavar="ADDRESS", help=f"address where the page is served ({_LOOPBACK})"
    )
    parser.add_argument("--port", type=port_number, default=0, metavar="N", help="port of the page; 0: a free one (0)")
    parser.add_argument("--read-only", action="store_true", help="show the meshes, but set and steer nothing")
    parser.add_argument("--no-browser", action="store_true", help="print the address only")
    parser.set_defaults(run_command=_dashboard)


def _dashboard(arguments: argparse.Namespace) -> int:
    options = DashboardOptions(
        mesh=arguments.mesh,
        connect=arguments.connect,
        timeout=arguments.timeout,
        host=arguments.host,
        port=arguments.port,
        read_only=arguments.read_only,
    )

    def ready(url: str) -> None:
        if not is_loopback(arguments.host):
            sys.stderr.write(
                f"fmu-mesh: warning: everybody who can reach {arguments.host} and knows the address can use this page, "
                "and it is not encrypted\n"
            )
        print(f"dashboard: {url}", flush=True)
        if not arguments.no_browser and _has_screen():
            webbrowser.open(url)

    try:
        serve(options, ready)
    except KeyboardInterrupt:
        return Interrupted.exit_code
    return 0


def _has_screen() -> bool:
    """Whether a browser opens in a window, and not in this terminal."""
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))


PARSERS: Parsers = {"dashboard": _add_dashboard}
