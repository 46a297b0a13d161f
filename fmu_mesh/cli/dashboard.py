"""`dashboard`: a page in a browser that shows running meshes and steers them."""

# Signals: SIGTERM ends the command as Ctrl-C does, by an exception on the main thread, so that the note with the token
# is removed. Other threads are those of NiceGUI's server.

from __future__ import annotations

import argparse
import os
import signal
import sys
import webbrowser
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from html import escape
from pathlib import Path
from tempfile import NamedTemporaryFile

from ..dashboard.dashboard_server import serve
from ..errors import Interrupted
from ..web_server import ServedMesh, is_loopback
from .arguments import Runs, reach

__all__ = ["RUNS"]


def _dashboard(arguments: argparse.Namespace) -> int:
    options = ServedMesh(
        mesh=arguments.mesh,
        **reach(arguments),
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
        # Otherwise a browser would open in this terminal, and not in a window.
        has_screen = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))
        if not arguments.no_browser and has_screen:
            webbrowser.open(until_end.enter_context(_redirecting(url)))

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # so that the file below is removed
    with ExitStack() as until_end:
        try:
            serve(options, ready)
        except KeyboardInterrupt:
            return Interrupted.exit_code
    return 0


@contextmanager
def _redirecting(url: str) -> Iterator[str]:
    """The address of a page that only this user can read and that leads to the URL.

    All users of the host see the arguments of a browser that is started, and the URL has the token.
    """
    with NamedTemporaryFile("w", prefix="fmu_mesh-", suffix=".html", encoding="utf-8") as file:  # its mode is 0600
        file.write(f'<meta http-equiv="refresh" content="0; url={escape(url)}">\n')
        file.flush()
        yield Path(file.name).as_uri()


RUNS: Runs = {"dashboard": _dashboard}
