"""The common parts of all sections of the configuration file: types of values, patterns, and the base Struct."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

__all__ = [
    "ENDPOINT_PATTERN",
    "KEY_PREFIX_PATTERN",
    "NAME_PATTERN",
    "NOT_NEGATIVE",
    "POSITIVE",
    "SHA256_PATTERN",
    "Base",
    "DeadlineSeconds",
    "Endpoint",
    "Name",
    "Sha256",
]

NAME_PATTERN = r"^[A-Za-z_][A-Za-z0-9_-]*$"
SHA256_PATTERN = r"^[0-9A-Fa-f]{64}$"
KEY_PREFIX_PATTERN = r"^[^/*$?#@\s]+(/[^/*$?#@\s]+)*$"
ENDPOINT_PATTERN = r"^((tcp|udp|tls|quic|ws)/\S+:[0-9]+([?#]\S*)?|(?!(tcp|udp|tls|quic|ws)/)[a-z0-9_-]+/\S+)$"

Name = Annotated[
    str, Meta(pattern=NAME_PATTERN, title="a name of letters, digits, _ and - that starts with a letter or _")
]
Sha256 = Annotated[
    str,
    Meta(
        pattern=SHA256_PATTERN,
        title="a SHA-256 as 64 hexadecimal digits, as `sha256sum` or `fmu-mesh inspect` prints it",
    ),
]
Endpoint = Annotated[str, Meta(pattern=ENDPOINT_PATTERN, title="a Zenoh endpoint such as tcp/192.168.1.2:7447")]
DeadlineSeconds = Annotated[float, Meta(gt=0)]

# For the JSON Schema only. `system.build` checks these, so that such errors are shown together with wrong names.
POSITIVE = {"exclusiveMinimum": 0}
NOT_NEGATIVE = {"minimum": 0}


class Base(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of every section: frozen, without unknown fields. A subclass repeats `kw_only`, which is not inherited."""
