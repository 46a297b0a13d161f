"""What the servers for browsers share: what is served and where, the socket, and the secret in the address."""

from __future__ import annotations

import errno
import hmac
import ipaddress
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from .errors import ConfigurationError

__all__ = ["ServedMesh", "is_loopback", "is_secret", "listening", "shown_host"]


class ServedMesh(msgspec.Struct, frozen=True):
    """What is served, and where.

    Attributes:
        mesh: name or key of the only mesh; None: all that can be reached, or the only one of them.
        connect: Zenoh endpoints of the mesh or of a router; none: the meshes of this user on this host.
        timeout: deadline of every question to a mesh in s.
        security: folder with the certificate for it; None: that of this host.
        insecure: whether a network without TLS is used.
        host: the address to listen at.
        port: 0 for a free one.
        read_only: whether nothing can be set or steered.
    """

    mesh: str | None
    connect: Sequence[str]
    timeout: float
    security: Path | None
    insecure: bool
    host: str
    port: int
    read_only: bool

    @property
    def reach(self) -> dict[str, Any]:
        """How the meshes are reached, as `attach` takes it."""
        return {
            "connect": self.connect,
            "timeout": self.timeout,
            "security": self.security,
            "insecure": self.insecure,
        }


def listening(host: str, port: int, who: str) -> socket.socket:
    """A socket that listens.

    Raises:
        ConfigurationError: the port is taken, or the address is none of this host; names ``who`` wants it.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, protocol)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen()
        except BaseException:
            listener.close()
            raise
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            text = f"port {port} of {host} is taken by another program."
            raise ConfigurationError(text, hint="`--port 0` takes a free one.") from error
        reason = error.strerror or str(error)
        raise ConfigurationError(f"{who} cannot listen at {host}, port {port}: {reason}.") from error
    return listener


def shown_host(host: str) -> str:
    """The host in a URL: a name of this host if the server listens at all addresses."""
    if host in ("0.0.0.0", "::"):  # noqa: S104  the user asked for it
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host


def is_loopback(host: str) -> bool:
    """Whether only programs of this host reach a server that listens there."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_secret(given: str, secret: str) -> bool:
    """Whether a text is the secret; takes as long for any text."""
    return hmac.compare_digest(given.encode("utf-8", "replace"), secret.encode())
