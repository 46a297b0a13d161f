"""Who gets to the page of a dashboard: requests with its token, by a name of this host, from the page itself."""

from __future__ import annotations

import asyncio
from collections.abc import MutableMapping
from typing import Any

import pytest

from fmu_mesh.dashboard.access import Access, Send
from fmu_mesh.web_server import is_loopback

TOKEN = "0123"  # noqa: S105  a secret of this test
COOKIE = f"fmu_mesh_dashboard_8000={TOKEN}"


def _ask(
    query: str = "",
    *,
    bound_to: str = "127.0.0.1",
    kind: str = "http",
    host: str = "127.0.0.1:8000",
    **headers: str,
) -> list[MutableMapping[str, Any]]:
    """The messages that a request gets as its answer."""
    answers: list[MutableMapping[str, Any]] = []

    async def application(_scope: object, _receive: object, send: Send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def receive() -> MutableMapping[str, Any]:
        return {"type": "websocket.connect"}

    async def send(message: MutableMapping[str, Any]) -> None:
        answers.append(message)

    pairs = [(name.encode(), value.encode()) for name, value in ({"host": host} | headers).items() if value]
    scope = {"type": kind, "path": "/", "query_string": query.encode(), "headers": pairs}
    access = Access(application, TOKEN, bound_to, 8000, frozenset({"lab1"}) if bound_to != "127.0.0.1" else frozenset())
    asyncio.run(access(scope, receive, send))
    return answers


def _status(query: str = "", **more: str) -> object:
    answer = _ask(query, **more)[0]
    return answer.get("status", answer.get("code"))


def test_the_token_gives_a_cookie_and_is_in_no_further_url() -> None:
    [answer, _] = _ask(f"token={TOKEN}&mesh=demo")

    headers = dict(answer["headers"])
    assert answer["status"] == 303
    assert headers[b"location"] == b"/?mesh=demo"
    assert headers[b"set-cookie"] == f"{COOKIE}; Path=/; HttpOnly; SameSite=Strict".encode()


def test_with_the_cookie_a_request_gets_through() -> None:
    assert _status(cookie=f"other=1; {COOKIE}") == 200


@pytest.mark.parametrize(
    "cookie", ["", "fmu_mesh_dashboard_8000=wrong", f"fmu_mesh_dashboard_8001={TOKEN}", "fmu_mesh_dashboard_8000=\xe9"]
)
def test_without_the_cookie_it_is_forbidden(cookie: str) -> None:
    assert _status(cookie=cookie) == 403
    assert _status("token=wrong", cookie=cookie) == 403
    assert _status(kind="websocket", cookie=cookie) == 1008


def test_a_token_opens_no_websocket() -> None:
    assert _status(f"token={TOKEN}", kind="websocket") == 1008


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example:8000", "", "192.168.1.2:8000", "[::1"])
def test_name_that_is_none_of_this_host_is_forbidden_also_with_cookie(host: str) -> None:
    assert _status(host=host, cookie=COOKIE) == 403
    assert _status(f"token={TOKEN}", host=host) == 403


@pytest.mark.parametrize("host", ["localhost:8000", "127.0.0.1:9000", "[::1]:8000", "LOCALHOST"])
def test_all_names_of_this_host_are_allowed_by_any_forwarded_port(host: str) -> None:
    assert _status(host=host, cookie=COOKIE) == 200


def test_beyond_loopback_addresses_and_the_name_of_the_host_are_allowed() -> None:
    assert _status(bound_to="0.0.0.0", host="192.168.1.2:8000", cookie=COOKIE) == 200  # noqa: S104  no socket is made
    assert _status(bound_to="0.0.0.0", host="lab1:8000", cookie=COOKIE) == 200  # noqa: S104  as above
    assert _status(bound_to="0.0.0.0", host="evil.example", cookie=COOKIE) == 403  # noqa: S104  as above


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_scripts_of_other_pages_of_this_host_are_kept_out(kind: str) -> None:
    own, other = "http://127.0.0.1:8000", "http://127.0.0.1:8001"

    assert _status(kind=kind, cookie=COOKIE, origin=own) == 200
    assert _status(kind=kind, cookie=COOKIE, origin=other) in (403, 1008)
    assert _status(kind=kind, cookie=COOKIE, origin="null") in (403, 1008)


def test_loopback_is_what_only_this_host_reaches() -> None:
    assert [is_loopback(host) for host in ("127.0.0.1", "localhost", "::1", "0.0.0.0", "lab1")] == [  # noqa: S104  as above
        True,
        True,
        True,
        False,
        False,
    ]
