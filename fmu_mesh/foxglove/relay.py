"""In front of the server of the SDK: lets programs in that know its token, and pages of known origins only."""

# The SDK serves whoever connects: it knows no token and no origin. So it listens at a port of 127.0.0.1 where a filter
# in the kernel drops every packet but those of this relay, and the relay looks at the request that begins each
# connection; what follows goes through it as it is.
#
# Threads: the relay has one, with an event loop. `close` is called on another one, and only requests the stop of the
# loop. The SDK has threads of its own. The relay waits for nobody: a client that does not read is not read for either,
# and the SDK drops what it cannot send.
#
# What may go wrong:
# * Another program of this host connects to the port of the SDK. The filter lets in one source port at a time, that of
#   the socket with which the relay is connecting (`_connecting`), and nobody between two of these. A connection keeps
#   the filter that it was made with, so changing it cuts nothing off.
# * The SDK does not show its socket. It is in this process, so `/proc/self/fd` has it, and a second handle sets the
#   filter.
# * A kernel without socket filters: the server refuses to start, rather than to serve everybody.
# * A client sends no request, or a long one: it has 10 s and 16 KiB.

from __future__ import annotations

import asyncio
import ctypes
import os
import socket
import struct
import threading
from collections.abc import Iterable
from contextlib import closing, suppress
from pathlib import Path
from typing import Final
from urllib.parse import parse_qs, urlsplit

from ..web_server import is_loopback, is_secret

__all__ = ["Relay", "let_in"]

_OURS: Final = ("https://app.foxglove.dev",)
_HEAD_BYTES: Final = 16 << 10
_HEAD_S: Final = 10.0
_REFUSAL: Final = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_LOCAL: Final = "127.0.0.1"
_SO_ATTACH_FILTER: Final = 26
_SOURCE: Final = 0xFFF00000 + 12  # SKF_NET_OFF, and where a packet has the address of its sender


class Relay:
    """Relays connections until it is closed.

    Args:
        listener: where clients connect; the relay closes it.
        port: where the SDK listens on 127.0.0.1; only the relay gets there from now on.
        token: what the address of a client must have.
        origins: from where pages may connect, besides Foxglove and pages of this host.
    """

    def __init__(self, listener: socket.socket, port: int, token: str, origins: Iterable[str]) -> None:
        self._listener = listener
        self._inner = _listening_at(port)
        self._port = port
        self._token = token
        self._origins = {*_OURS, *origins}
        let_in(self._inner, None)
        self._loop = asyncio.new_event_loop()
        self._connecting = asyncio.Lock()
        self._thread = threading.Thread(target=self._run, name="relay", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End all connections."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._inner.close()

    def _run(self) -> None:
        with closing(self._loop), closing(self._listener):
            self._loop.run_until_complete(asyncio.start_server(self._relay, sock=self._listener, limit=_HEAD_BYTES))
            self._loop.run_forever()
            for task in asyncio.all_tasks(self._loop):
                task.cancel()
            self._loop.run_until_complete(asyncio.sleep(0))

    async def _relay(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with closing(writer), suppress(OSError, EOFError, ValueError, asyncio.LimitOverrunError, TimeoutError):
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _HEAD_S)
            if not self._may_enter(head.decode("latin-1")):
                writer.write(_REFUSAL)
                await writer.drain()
                return
            to_reader, to_writer = await self._entered(b"GET / HTTP/1.1\r\n" + head.partition(b"\r\n")[2], writer)
            with closing(to_writer):
                ways = [asyncio.ensure_future(_pass_on(*way)) for way in ((reader, to_writer), (to_reader, writer))]
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
                for way in ways:
                    way.cancel()

    def _may_enter(self, head: str) -> bool:
        request, *lines = head.split("\r\n")
        headers = {name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
        method, path, _ = request.split(" ")
        token = parse_qs(urlsplit(path).query).get("token", [""])[0]
        origin = headers.get("origin")  # no program but a browser sends it
        known = origin is None or origin in self._origins or is_loopback(urlsplit(origin).hostname or "")
        return method == "GET" and known and is_secret(token, self._token)

    async def _entered(
        self, head: bytes, client: asyncio.StreamWriter
    ) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """Connect to the SDK and pass its first answer on; until then packets of this one socket get through."""
        async with self._connecting, asyncio.timeout(_HEAD_S):
            own = socket.socket()
            own.settimeout(0)
            own.bind((_LOCAL, 0))
            let_in(self._inner, own.getsockname()[1])
            try:
                await self._loop.sock_connect(own, (_LOCAL, self._port))
                reader, writer = await asyncio.open_connection(sock=own)
                writer.write(head)  # without the token, which goes no further
                client.write(await reader.read(_HEAD_BYTES))
            finally:
                let_in(self._inner, None)
        return reader, writer


async def _pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(_HEAD_BYTES):
            writer.write(data)
            await writer.drain()


def _listening_at(port: int) -> socket.socket:
    """A second handle of the socket of this process that listens at a port of 127.0.0.1."""
    for name in Path("/proc/self/fd").iterdir():
        with suppress(OSError):
            if not str(name.readlink()).startswith("socket:"):
                continue
            found = socket.socket(fileno=os.dup(int(name.name)))
            if found.getsockname() == (_LOCAL, port) and found.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
                return found
            found.close()
    raise RuntimeError(f"no socket of this process listens at port {port}")


def let_in(listener: socket.socket, port: int | None) -> None:
    """From now on, the kernel drops all packets to a listening socket but those from a port of 127.0.0.1.

    A connection keeps the filter that it was made with.
    """
    program = [(0x28, 0, 0, 0), (0x15, 0, 3, port or 0), (0x20, 0, 0, _SOURCE), (0x15, 0, 1, 0x7F000001)]
    program += [(0x06, 0, 0, 0xFFFFFFFF), (0x06, 0, 0, 0)]
    code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *line) for line in program))
    listener.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, struct.pack("HP", len(program), ctypes.addressof(code)))
