"""Serves the page: the socket, the requests, the end.

Only this module and `live_page` import NiceGUI, and only when a dashboard is started.
"""

from __future__ import annotations

import secrets
import socket
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from ..installing import require
from ..web_server import ServedMesh, is_loopback, listening, shown_host
from .access import Access
from .mesh_directory import MeshDirectory
from .mesh_follower import CurveQuestion

if TYPE_CHECKING:
    import uvicorn
    from fastapi import Request

__all__ = ["serve"]

STATIC: Final = Path(__file__).parent / "static"
_QUESTION_BYTES: Final = 64 << 10
_HISTORY: Final = 100
"""Messages that the server keeps for a page whose connection breaks; a page that misses more loads itself again."""
_PATIENCE_S: Final = 30.0
"""A page that does not answer for this long is forgotten, and loads itself again; a busy browser needs some time."""
_CLOSING_S: Final = 1
_ICON: Final = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 16 16"><g fill="none" stroke="#0072b2" stroke-width="1.5">'
    '<path d="M4 4L12 6L7 12Z"/></g><g fill="#0072b2"><circle cx="4" cy="4" r="2.5"/><circle cx="12" cy="6" r="2.5"/>'
    '<circle cx="7" cy="12" r="2.5"/></g></svg>'
)


def serve(options: ServedMesh, ready: Callable[[str], None]) -> None:
    """Serve the page until SIGINT, which raises KeyboardInterrupt, or SIGTERM, which ends the process.

    ``ready`` is called with the URL as soon as it can be opened.

    Raises:
        ConfigurationError: NiceGUI is not installed, the port is taken, or the mesh does not run.
        DeadlineExceeded: an endpoint does not answer.
    """
    require("nicegui")
    with (
        listening(options.host, options.port, "the dashboard") as listener,
        MeshDirectory(options.mesh, options.reach) as directory,
    ):
        port, token = listener.getsockname()[1], secrets.token_urlsafe(24)
        server = _server(options, port, token, directory)
        ready(f"http://{shown_host(options.host)}:{port}/?token={token}")
        server.run([listener])


def _server(options: ServedMesh, port: int, token: str, directory: MeshDirectory) -> uvicorn.Server:
    import uvicorn  # noqa: PLC0415  an extra, and slow to import
    from fastapi import FastAPI, Response  # noqa: PLC0415  as above
    from fastapi.staticfiles import StaticFiles  # noqa: PLC0415  as above
    from nicegui import ui  # noqa: PLC0415  as above

    from .live_page import register_page  # noqa: PLC0415  it imports NiceGUI

    application = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    async def curves(request: Request) -> Response:
        body = bytearray()
        async for piece in request.stream():
            body += piece
            if len(body) > _QUESTION_BYTES:
                return Response(status_code=HTTPStatus.BAD_REQUEST)
        try:
            question = msgspec.json.decode(body, type=CurveQuestion)
        except (msgspec.MsgspecError, ValueError):
            return Response(status_code=HTTPStatus.BAD_REQUEST)
        follower = directory.followers.get(question.mesh)
        changes = follower.changes(question) if follower is not None else {}
        return Response(msgspec.json.encode(changes), media_type="application/json")

    # Not by annotations: FastAPI would look for these names in this module.
    application.router.add_route("/dashboard/curves", curves, methods=["POST"])
    application.mount("/dashboard/static", StaticFiles(directory=STATIC))
    register_page(directory, read_only=options.read_only)
    ui.run_with(
        application,
        title="fmu_mesh",
        favicon=_ICON,
        dark=None,  # as the browser or the system says
        language="en-US",
        tailwind=False,
        message_history_length=_HISTORY,
        reconnect_timeout=_PATIENCE_S,
        show_welcome_message=False,
    )
    names = frozenset() if is_loopback(options.host) else frozenset((socket.gethostname().lower(), socket.getfqdn()))
    config = uvicorn.Config(
        Access(application, token, options.host, port, names),
        log_config=None,
        log_level="error",
        access_log=False,
        server_header=False,
        lifespan="on",
        timeout_graceful_shutdown=_CLOSING_S,
    )
    return uvicorn.Server(config)
