"""Who a process is: what is known of the folder that a person or a host was given.

Owns the names of its files, and the table of roles. `fmu_mesh.wire.security.certificates` reads such a folder, which
`fmu_mesh.wire.security.authority` has made, or somebody by hand with certificates of another authority.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

import msgspec

from ...config.access_sections import Role
from ...text import counted
from ..keys import LOCAL

__all__ = [
    "CA",
    "CA_KEY",
    "CERTIFICATE",
    "KEY",
    "ROLES",
    "Identity",
    "Role",
    "RoleTable",
    "ends_soon",
    "other_table",
    "time_left",
    "warnings_about",
    "wrong_name",
]

CA: Final = "ca.pem"
CA_KEY: Final = "ca.key"
"""Only in the folder of the authority."""

CERTIFICATE: Final = "certificate.pem"
KEY: Final = "key.pem"
ROLES: Final = "roles.json"

_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_SOON: Final = timedelta(days=30)


class RoleTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Who has which role, as an authority has signed it.

    Attributes:
        roles: by name.
        number: of this table; that of a newer one is larger. 0 if no authority of ours has made it.
        made: when, in ISO 8601.
        signature: of all else, in base64: ECDSA with SHA-256 by the key of the authority.
    """

    roles: dict[str, Role]
    number: int = 0
    made: str = ""
    signature: str = ""

    @property
    def signed(self) -> bytes:
        """What the signature is of."""
        return msgspec.json.encode((self.number, self.made, sorted(self.roles.items())))

    def __str__(self) -> str:
        made = f" of {datetime.fromisoformat(self.made):%Y-%m-%d %H:%M} UTC" if self.made else ""
        return f"table {self.number} of roles{made}" if self.number else "a table of roles of its own"


class Identity(msgspec.Struct, frozen=True):
    """A person or a host with a certificate.

    Attributes:
        folder: where it is.
        name: the one common name of its certificate.
        role: what the table says, or a certificate of our authority; None: only who listens knows it.
        until: the end of the certificate, or of one that signs it, whichever comes first.
        authority: the name of who has signed it.
        table: who else has which role; None in the folder of somebody who accepts no links.
    """

    folder: Path
    name: str
    role: Role | None
    until: datetime
    authority: str
    table: RoleTable | None = None

    @property
    def ca(self) -> Path:
        """The certificates of the authorities."""
        return self.folder / CA

    @property
    def certificate(self) -> Path:
        """Its own certificate, and those between it and an authority."""
        return self.folder / CERTIFICATE

    @property
    def key(self) -> Path:
        """The key of its certificate."""
        return self.folder / KEY


def wrong_name(name: str) -> str | None:
    """What is wrong with a name, which is a chunk of keys and of paths; None if nothing is."""
    if not _NAME.fullmatch(name):
        return "expected 1 to 64 letters, digits, `.`, `_` and `-`, beginning with a letter or a digit"
    return f"'{LOCAL}' is who comes by the Unix socket of a mesh" if name.lower() == LOCAL else None


def other_table(own: int, theirs: int) -> str:
    """What to do where two processes of a mesh have tables of roles with other numbers."""
    which, whose = ("this one", "this host") if own < theirs else ("that one", "the host of the master")
    return (
        f"here is table {own} of roles, and at the master table {theirs}: {which} is older. Copy the newest {ROLES} "
        f"from the folder of {whose} at the authority to {whose}; the next start takes it"
    )


def time_left(until: datetime) -> str:
    """When a certificate ends, or has ended, in words."""
    left = until - datetime.now(UTC)
    if left < timedelta(0):
        return f"ended at {until:%Y-%m-%d %H:%M} UTC"
    days, hours = round(left / timedelta(days=1)), round(left / timedelta(hours=1))
    about = counted(days, "day") if days > 1 else counted(hours, "hour") if hours else "less than an hour"
    return f"ends at {until:%Y-%m-%d %H:%M} UTC ({about} left)"


def ends_soon(until: datetime) -> bool:
    """Whether a certificate has to be renewed: it ends within 30 days, or has ended."""
    return until - datetime.now(UTC) < _SOON


def warnings_about(identity: Identity, ends_at: datetime | None = None) -> list[str]:
    """What its owner has to know at each start: a certificate that will end soon, or before the run does.

    Args:
        identity: who starts something.
        ends_at: when that will end, where it is known; with a time zone.
    """
    whose = f"the certificate of '{identity.name}' {time_left(identity.until)}"
    if ends_at is not None and identity.until < ends_at:
        return [f"{whose}, before this run (about {ends_at:%Y-%m-%d %H:%M} UTC): links to others close then"]
    return [f"{whose}: renew it with `fmu-mesh security renew`"] if ends_soon(identity.until) else []
