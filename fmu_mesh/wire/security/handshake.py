"""Why a link to an endpoint with TLS does not come about, in words: a handshake of our own before Zenoh's.

Zenoh has one text for all reasons, after its whole deadline; or it opens, and has no links.
"""

# With TLS 1.3 a client is ready before the listener has looked at its certificate. So its end is waited for: an alert
# says what is wrong, and a ticket for the next session (which Zenoh's library sends at once) that it was accepted.

from __future__ import annotations

import os
import select
import socket
import ssl
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final, Self

from ...config.access_sections import host_of, port_of
from ...errors import ConfigurationError, MeshLost
from .identity import Identity

if TYPE_CHECKING:
    from cryptography.x509 import Certificate

__all__ = ["check_link", "shake_hands"]

_DEADLINE_S: Final = 1.9
_DIAL_S: Final = 0.1
"""Time in s between two looks for who does not listen yet."""

_UNKNOWN_VERSION_OF_QUIC: Final = b"\xc0\x1a\x2a\x3a\x4a\x08" + os.urandom(8) + b"\x00" + bytes(1185)
"""Who listens with QUIC answers with the versions that it knows (RFC 9000, 6.1)."""

_BY_ALERT: Final = {
    "CERTIFICATE_REQUIRED": "it wants a certificate, and got none",
    "UNKNOWN_CA": "it does not know the authority {authority} of {name}",
    "CERTIFICATE_EXPIRED": "by its clock the certificate of {name}, which ends at {until:%Y-%m-%d %H:%M} UTC, "
    "is not valid now",
    "BAD_CERTIFICATE": "it does not take the certificate of {name}",
    "UNSUPPORTED_CERTIFICATE": "the certificate of {name} is for another use",
    "CERTIFICATE_REVOKED": "the certificate of {name} is revoked",
    "CERTIFICATE_UNKNOWN": "it does not take the certificate of {name}",
    "DECRYPT_ERROR": "it does not know the authority {authority} of {name}",
    "HANDSHAKE_FAILURE": "it wants a certificate, and got none that it takes",
}
"""What the other end says of our certificate."""


def check_link(endpoint: str, own: Identity | None) -> None:
    """Shake hands with who listens at an endpoint, and hang up.

    Args:
        endpoint: `tls/host:port`. Of `quic/host:port` it is only seen whether somebody listens with QUIC.
        own: who comes; None: without a certificate, and without a look at that of who listens.

    Raises:
        MeshLost: nobody listens there, or not with TLS.
        ConfigurationError: one of the two does not take the certificate of the other one; says which, and why.
    """
    if not endpoint.startswith(("tls/", "quic/")):
        return
    host, port, quic = host_of(endpoint), port_of(endpoint), endpoint.startswith("quic/")
    end = time.monotonic() + _DEADLINE_S
    try:
        with _connection(host, port, end, socket.SOCK_DGRAM if quic else socket.SOCK_STREAM) as connection:
            try:
                if quic:
                    connection.send(_UNKNOWN_VERSION_OF_QUIC)
                    connection.recv(1)
                    return
                with _Context(own).wrap_socket(connection, server_hostname=host) as secured:
                    _wait_for_verdict(secured, end)
            except ssl.SSLCertVerificationError as error:
                why = _why_not_theirs(error.verify_code, host, own, _certificate_at(host, port, end))
                raise ConfigurationError(f"{endpoint}: {why or error.verify_message}") from error
            except (ssl.SSLError, ConnectionResetError, BrokenPipeError) as error:
                raise _refused(endpoint, error, own) from error
            except TimeoutError as error:
                text = f"who listens at {endpoint} does not answer with {'QUIC' if quic else 'TLS'}"
                hint = f"It had {_DEADLINE_S:g} s." + (
                    "" if quic else " Is it a port of TCP? Then it is tcp/ and not tls/."
                )
                raise MeshLost(text, hint=hint) from error
    except (socket.gaierror, UnicodeError) as error:
        raise MeshLost(f"{endpoint}: no host has the name '{host}'") from error
    except OSError as error:
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


class _Context(ssl.SSLContext):
    """Takes and refuses the same certificates as Zenoh: any authority of the folder is enough, a common name is not.

    Without an identity it takes each, and shows none.
    """

    def __new__(cls, own: Identity | None) -> Self:
        self = super().__new__(cls, ssl.PROTOCOL_TLS_CLIENT)
        if own is None:
            self.check_hostname = False
            self.verify_mode = ssl.CERT_NONE
        else:
            self.hostname_checks_common_name = False
            self.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
            self.load_verify_locations(own.ca)
            self.load_cert_chain(own.certificate, own.key)
        return self


def _connection(host: str, port: int, end: float, kind: socket.SocketKind) -> socket.socket:
    for family, _, _, _, address in (places := socket.getaddrinfo(host, port, type=kind)):
        connection = socket.socket(family, kind)
        connection.settimeout(max(end - time.monotonic(), _DIAL_S))
        try:
            connection.connect(address)
        except OSError:
            connection.close()
            if address == places[-1][-1]:
                raise
        else:
            return connection
    raise TimeoutError


def _certificate_at(host: str, port: int, end: float) -> Certificate | None:
    """The certificate of who listens, whatever it is worth; None if it does not come in time."""
    from cryptography.x509 import load_der_x509_certificate  # noqa: PLC0415  an optional library

    with (
        suppress(OSError),
        _connection(host, port, end, socket.SOCK_STREAM) as connection,
        _Context(None).wrap_socket(connection, server_hostname=host) as secured,
    ):
        return load_der_x509_certificate(secured.getpeercert(binary_form=True) or b"")
    return None


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


def _why_not_theirs(code: int, host: str, own: Identity | None, theirs: Certificate | None) -> str | None:
    """Why we do not take the certificate of who listens, by the code of OpenSSL."""
    from .certificates import called, hosts_of  # noqa: PLC0415  an optional library

    if theirs is None:
        return None
    whose = f"the certificate of who listens, '{called(theirs.subject)}',"
    match code:
        case 10:
            ended = theirs.not_valid_after_utc
            return (
                f"{whose} ended at {ended:%Y-%m-%d %H:%M} UTC. `fmu-mesh security renew` renews it, for its next start"
            )
        case 9:
            begins, now = theirs.not_valid_before_utc, datetime.now(UTC)
            return (
                f"{whose} is not valid before {begins:%Y-%m-%d %H:%M} UTC, and the clock here says {now:%Y-%m-%d %H:%M}"
            )
        case 62 | 64:
            hint = "`fmu-mesh security renew ... --host` gives it other names"
            return f"{whose} is for {', '.join(hosts_of(theirs)) or 'no host'} and not for '{host}'. {hint}"
        case 26:
            return f"{whose} is for clients only: its role is not node"
    ours = f", and ours by '{own.authority}'" if own is not None else ""
    return f"{whose} is signed by '{called(theirs.issuer)}'{ours}"


def _refused(endpoint: str, error: OSError, own: Identity | None) -> ConfigurationError | MeshLost:
    # Who hangs up resets the connection if our first words have come too late to be read.
    reason = (error.reason or "") if isinstance(error, ssl.SSLError) else "UNEXPECTED_EOF"
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
