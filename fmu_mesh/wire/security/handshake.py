"""Why a link to an endpoint with TLS does not come about, in words: a handshake of our own before Zenoh's.

Zenoh has one text for all reasons, after its whole deadline; or it opens, and has no links.
"""

# With TLS 1.3 a client is ready before the listener has looked at its certificate. So its end is waited for: an alert
# says what is wrong, and a ticket for the next session (which Zenoh's library sends at once) that it was accepted.

from __future__ import annotations

import select
import socket
import ssl
import threading
import time
from collections.abc import Sequence
from typing import Final

from ...errors import ConfigurationError, MeshLost
from .identity import Identity

__all__ = ["check_link", "host_and_port", "shake_hands"]

_DEADLINE_S: Final = 2.0
_DIAL_S: Final = 0.1
"""Time in s between two looks for who does not listen yet."""

_BY_ALERT: Final = {
    "CERTIFICATE_REQUIRED": "it wants a certificate, and got none",
    "UNKNOWN_CA": "it does not know the authority {authority} of {name}",
    "CERTIFICATE_EXPIRED": "the certificate of {name} has ended ({until:%Y-%m-%d %H:%M} UTC)",
    "BAD_CERTIFICATE": "it does not take the certificate of {name}",
    "UNSUPPORTED_CERTIFICATE": "the certificate of {name} is for another use",
    "CERTIFICATE_REVOKED": "the certificate of {name} is revoked",
    "CERTIFICATE_UNKNOWN": "it does not take the certificate of {name}",
    "DECRYPT_ERROR": "it does not know the authority {authority} of {name}",
    "HANDSHAKE_FAILURE": "it wants a certificate, and got none that it takes",
}
"""What the other end says of our certificate."""


def host_and_port(endpoint: str) -> tuple[str, int]:
    """The address of `tls/host:port`."""
    address = endpoint.partition("/")[2].partition("?")[0].partition("#")[0]
    host, _, port = address.rpartition(":")
    return host.strip("[]"), int(port)


def check_link(endpoint: str, own: Identity | None) -> None:
    """Shake hands with who listens at an endpoint, and hang up.

    Args:
        endpoint: `tls/host:port` or `quic/host:port`; the second kind is not looked at.
        own: who comes; None: without a certificate.

    Raises:
        MeshLost: nobody listens there, or not with TLS.
        ConfigurationError: one of the two does not take the certificate of the other one; says which, and why.
    """
    if not endpoint.startswith("tls/"):
        return
    host, port = host_and_port(endpoint)
    end = time.monotonic() + _DEADLINE_S
    try:
        with socket.create_connection((host, port), _DEADLINE_S) as connection:
            context = _context(own)
            try:
                with context.wrap_socket(connection, server_hostname=host) as secured:
                    _wait_for_verdict(secured, end)
            except ssl.SSLCertVerificationError as error:
                raise ConfigurationError(f"{endpoint}: {_why_not_theirs(error, host, own)}") from error
            except ssl.SSLError as error:
                raise _refused(endpoint, error, own) from error
            except (TimeoutError, ConnectionError) as error:
                text = f"who listens at {endpoint} does not answer with TLS within {_DEADLINE_S:g} s"
                raise MeshLost(text, hint="Is it a port of TCP? Then it is tcp/ and not tls/.") from error
    except socket.gaierror as error:
        raise MeshLost(f"{endpoint}: no host has the name '{host}'") from error
    except (TimeoutError, OSError) as error:
        reason = error.strerror or "no answer"
        raise MeshLost(f"nobody listens at {endpoint}: {reason.lower()}") from error


def shake_hands(endpoints: Sequence[str], own: Identity, patience_s: float | None) -> None:
    """Find out whether links with TLS will come about.

    Args:
        endpoints: where Zenoh will dial.
        own: who comes.
        patience_s: how long a client waits for who does not listen yet, in s; one endpoint is enough for it. None: a
            peer, which dials all of them in the background until they answer.

    Raises:
        MeshLost: nobody listens there.
        ConfigurationError: as of `check_link`.
    """
    end, never = time.monotonic() + (patience_s or 0.0), threading.Event()
    while True:
        failures: list[ConfigurationError | MeshLost] = []
        for endpoint in endpoints:
            try:
                check_link(endpoint, own)
            except (ConfigurationError, MeshLost) as error:
                if patience_s is None and isinstance(error, ConfigurationError):
                    raise
                failures.append(error)
        if patience_s is None or len(failures) < len(endpoints) or not endpoints:
            return
        if not isinstance(failures[0], MeshLost) or time.monotonic() >= end:
            raise failures[0]
        never.wait(_DIAL_S)


def _context(own: Identity | None) -> ssl.SSLContext:
    context = ssl.create_default_context(ssl.Purpose.SERVER_AUTH, cafile=own.ca if own is not None else None)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    if own is not None:
        context.load_cert_chain(own.certificate, own.key)
    return context


def _wait_for_verdict(secured: ssl.SSLSocket, end: float) -> None:
    """Read until the other end has sent an alert, which raises, or a ticket."""
    secured.settimeout(0.0)
    while (left := end - time.monotonic()) > 0:
        try:
            if not secured.recv(1):
                return
        except ssl.SSLWantReadError:
            if secured.session is not None and secured.session.has_ticket:
                return
            select.select([secured], [], [], min(left, 0.05))
    # Neither: an end that sends no tickets has taken the certificate.


def _why_not_theirs(error: ssl.SSLCertVerificationError, host: str, own: Identity | None) -> str:
    """Why we do not take the certificate of who listens."""
    code, whose = error.verify_code, own.authority if own is not None else "this system"
    match code:
        case 10:
            return "the certificate of who listens has ended. It renews it with `fmu-mesh security renew`"
        case 9:
            return "the certificate of who listens is not valid yet: is the clock of this host right?"
        case 62 | 64:
            return f"the certificate of who listens is not for '{host}': it was made with other `--host` names"
        case 26:
            return "who listens has a certificate for clients only: its role is not node"
        case 18 | 19 | 20 | 21:
            return f"the certificate of who listens is not signed by {whose}"
    return f"the certificate of who listens is not valid: {error.verify_message}"


def _refused(endpoint: str, error: ssl.SSLError, own: Identity | None) -> ConfigurationError | MeshLost:
    reason = error.reason or ""
    alert = next((text for word, text in _BY_ALERT.items() if word in reason), None)
    if alert is not None:
        if own is None:
            text = f"who listens at {endpoint} wants a certificate"
            return ConfigurationError(
                text, hint="Give the folder that you have from its authority with `security=...`."
            )
        text = alert.format(name=f"'{own.name}'", authority=own.authority, until=own.until)
        return ConfigurationError(f"who listens at {endpoint} refuses: {text}")
    if "WRONG_VERSION_NUMBER" in reason or "RECORD_LAYER" in reason or "UNEXPECTED_EOF" in reason:
        return MeshLost(f"who listens at {endpoint} does not speak TLS", hint="Is it tcp/ and not tls/?")
    return MeshLost(f"no TLS with {endpoint}: {reason or error}")
