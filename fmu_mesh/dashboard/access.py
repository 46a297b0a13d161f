"""Who may use the page: those who know its token, at a name of this host, and from the page itself.

Knows requests only, not what they ask for.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any, Final
from urllib.parse import parse_qs, urlencode, urlsplit

from ..web_server import is_loopback, is_secret

__all__ = ["Access"]

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]

_TOKEN: Final = "token"  # noqa: S105  the name of the parameter
_HEADERS: Final = (
    (b"referrer-policy", b"no-referrer"),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
)


class Access:
    """Lets requests through to an application, or answers 403.

    * The name in `Host` must be one of this host. A page of another site can make its own name mean 127.0.0.1 (DNS
      rebinding), but the browser then says that name.
    * `Origin`, which browsers send from scripts, must be the page itself.
    * The token is in the first URL, and in a cookie from then on, so it is in no further URL.
    """

    def __init__(self, application: Application, token: str, host: str, port: int, names: frozenset[str]) -> None:
        self._application = application
        self._token = token
        self._local = is_loopback(host)
        self._names = names | {"localhost", host.lower()}
        # Cookies do not know ports, so the name of this one has it.
        self._cookie = f"fmu_mesh_dashboard_{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request, as ASGI calls it."""
        if scope["type"] == "lifespan":
            await self._application(scope, receive, send)
            return
        headers = {key.decode("latin-1").lower(): value.decode("latin-1") for key, value in scope["headers"]}
        query = parse_qs(scope["query_string"].decode("latin-1"), keep_blank_values=True)
        given = query.pop(_TOKEN, [""])[0]
        if not self._is_ours(headers):
            await _refuse(scope, receive, send, "this is not a name of the host of the dashboard")
        elif scope["type"] == "http" and is_secret(given, self._token):
            await self._enter(query, send)
        elif is_secret(self._cookie_of(headers), self._token):
            await self._application(scope, receive, _with_headers(send))
        else:
            await _refuse(scope, receive, send, "open the address that `fmu-mesh dashboard` printed: it has a token")

    def _is_ours(self, headers: Mapping[str, str]) -> bool:
        host = headers.get("host", "")
        origin = headers.get("origin")
        try:
            name = urlsplit(f"//{host}").hostname  # without the port
        except ValueError:
            return False
        if name is None or (origin is not None and urlsplit(origin).netloc.lower() != host.lower()):
            return False
        if name in self._names:
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return False
        return address.is_loopback or not self._local  # an address cannot be rebound

    def _cookie_of(self, headers: Mapping[str, str]) -> str:
        try:
            cookies = SimpleCookie(headers.get("cookie", ""))
        except CookieError:
            return ""
        return cookies[self._cookie].value if self._cookie in cookies else ""

    async def _enter(self, query: Mapping[str, list[str]], send: Send) -> None:
        """Give the browser the cookie, and send it to the page without the token."""
        rest = urlencode(query, doseq=True)
        location = f"/?{rest}" if rest else "/"
        cookie = f"{self._cookie}={self._token}; Path=/; HttpOnly; SameSite=Strict"
        headers = [(b"location", location.encode()), (b"set-cookie", cookie.encode()), *_HEADERS]
        await send({"type": "http.response.start", "status": 303, "headers": headers})
        await send({"type": "http.response.body", "body": b""})


def _with_headers(send: Send) -> Send:
    async def sending(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", ()), *_HEADERS]
        await send(message)

    return sending


async def _refuse(scope: Scope, receive: Receive, send: Send, reason: str) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 1008})  # before it is accepted: the browser sees 403
        return
    headers = [(b"content-type", b"text/plain; charset=utf-8"), *_HEADERS]
    await send({"type": "http.response.start", "status": 403, "headers": headers})
    await send({"type": "http.response.body", "body": f"403: {reason}\n".encode()})
