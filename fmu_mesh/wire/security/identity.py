"""Who a process is: the folder that a person or a host was given, checked before anything is opened.

Owns the names of its files, the roles, and the table of who has which. Such a folder is made by
`fmu_mesh.wire.security.authority`, or by hand with certificates of another authority.
"""

from __future__ import annotations

import base64
import re
import stat
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast, get_args

import msgspec

from ...config.access_sections import Role
from ...errors import ConfigurationError
from ...files import decoded_json
from ...installing import importing
from ...text import listed, short_path, shown
from ..keys import LOCAL

if TYPE_CHECKING:
    from cryptography.x509 import Certificate

__all__ = [
    "CA",
    "CA_KEY",
    "CERTIFICATE",
    "KEY",
    "ROLES",
    "Identity",
    "Role",
    "RoleTable",
    "identity_in",
    "name_in",
    "wrong_name",
]

CA: Final = "ca.pem"
CA_KEY: Final = "ca.key"
"""Only in the folder of the authority."""

CERTIFICATE: Final = "certificate.pem"
KEY: Final = "key.pem"
ROLES: Final = "roles.json"

_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_USER: Final = "certificates"

T = TypeVar("T")


class RoleTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Who has which role, as an authority has signed it.

    Attributes:
        number: of this table; that of a newer one is larger.
        made: when, in ISO 8601.
        roles: by name.
        signature: of all else, in base64: ECDSA with SHA-256 by the key of the authority.
    """

    number: int
    made: str
    roles: dict[str, Role]
    signature: str = ""

    @property
    def signed(self) -> bytes:
        """What the signature is of."""
        return msgspec.json.encode((self.number, self.made, sorted(self.roles.items())))


class Identity(msgspec.Struct, frozen=True):
    """A person or a host with a certificate.

    Attributes:
        folder: where it is.
        name: the one common name of its certificate.
        role: what the table, or the name of the role in the folder, says.
        until: the end of the certificate.
        authority: the common name of who has signed it.
        table: who else has which role; None in the folder of somebody who accepts no links.
    """

    folder: Path
    name: str
    role: Role
    until: datetime
    authority: str
    table: RoleTable | None = None

    @property
    def ca(self) -> Path:
        """The certificate of the authority."""
        return self.folder / CA

    @property
    def certificate(self) -> Path:
        """Its own certificate."""
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


def identity_in(folder: Path, roles: Mapping[str, Role] | None = None) -> Identity:
    """Read a folder, and check all of it.

    Args:
        folder: DIR/NAME.
        roles: who has which role, instead of what `roles.json` of the folder says.

    Raises:
        ConfigurationError: it is no such folder, something in it is wrong, or a certificate is not valid now.
        LibraryMissing: cryptography is not installed.
    """
    folder = folder.absolute()
    if (folder / CA_KEY).exists():
        names = sorted(own.parent.name for own in folder.glob(f"*/{CERTIFICATE}"))
        hint = (
            f"Give the folder of one name in it: {listed(names)}." if names else "Add a name: `fmu-mesh security add`."
        )
        raise ConfigurationError(
            f"'{short_path(folder)}' is the folder of an authority, whose key no run reads", hint=hint
        )
    missing = [name for name in (CA, CERTIFICATE, KEY) if not (folder / name).is_file()]
    if missing:
        hint = "It has to be a folder DIR/NAME that `fmu-mesh security add DIR NAME` has made."
        raise ConfigurationError(f"there is no {listed(missing)} in '{short_path(folder)}'", hint=hint)
    if (mode := (folder / KEY).stat().st_mode) & (stat.S_IRWXG | stat.S_IRWXO):
        hint = f"`chmod 600 {short_path(folder / KEY)}` closes it."
        raise ConfigurationError(f"others can read '{short_path(folder / KEY)}' (mode {mode & 0o777:o})", hint=hint)
    with importing("cryptography", _USER):
        return _checked(folder, roles)


def _checked(folder: Path, roles: Mapping[str, Role] | None) -> Identity:
    from cryptography.exceptions import InvalidSignature  # noqa: PLC0415  an optional library, and 60 ms
    from cryptography.hazmat.primitives.serialization import load_pem_private_key  # noqa: PLC0415  as above

    authority, own = (_certificate(folder / name) for name in (CA, CERTIFICATE))
    key = _read(folder / KEY, lambda data: load_pem_private_key(data, None), "no key without a password")
    place = short_path(folder / CERTIFICATE)
    name = name_in(own)
    if name is None or (wrong := wrong_name(name)) is not None:
        found = f"the name {shown(name)}: {wrong}" if name is not None else "not exactly one common name"
        raise ConfigurationError(f"the certificate '{place}' has {found}")
    try:
        own.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature) as error:
        signer = own.issuer.rfc4514_string()
        raise ConfigurationError(
            f"the certificate '{place}' is signed by {signer}, which is not what '{short_path(folder / CA)}' holds"
        ) from error
    if key.public_key() != own.public_key():
        raise ConfigurationError(f"the key '{short_path(folder / KEY)}' does not belong to '{place}'")
    _check_dates(own, place, name)
    _check_dates(authority, short_path(folder / CA), "its authority")
    table = _table(folder, authority) if roles is None else RoleTable(0, "", dict(roles))
    role = table.roles.get(name) if table is not None else _role_in(own)
    if role is None:
        raise ConfigurationError(f"'{name}' of '{short_path(folder)}' has no role")
    return Identity(folder, name, role, own.not_valid_after_utc, name_in(authority) or "", table)


def name_in(certificate: Certificate) -> str | None:
    """The one common name of a certificate; None if it has none, or several, of which Zenoh takes the first."""
    from cryptography.x509.oid import NameOID  # noqa: PLC0415  as above

    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if len(names) == 1 else None


def _role_in(certificate: Certificate) -> Role | None:
    """The role that the authority has written into a certificate, for its owner: listeners look into their table."""
    from cryptography.x509.oid import NameOID  # noqa: PLC0415  as above

    units = [own.value for own in certificate.subject.get_attributes_for_oid(NameOID.ORGANIZATIONAL_UNIT_NAME)]
    return cast("Role", units[0]) if len(units) == 1 and units[0] in get_args(Role) else None


def _check_dates(certificate: Certificate, place: str, whose: str) -> None:
    now = datetime.now(UTC)
    if now > certificate.not_valid_after_utc:
        hint = "Whoever has the folder of the authority renews it with `fmu-mesh security renew`."
        ended = certificate.not_valid_after_utc
        raise ConfigurationError(
            f"the certificate '{place}' of {whose} has ended at {ended:%Y-%m-%d %H:%M} UTC", hint=hint
        )
    if now < certificate.not_valid_before_utc:
        begins = certificate.not_valid_before_utc
        text = f"the certificate '{place}' of {whose} is not valid before {begins:%Y-%m-%d %H:%M} UTC"
        raise ConfigurationError(text, hint=f"The clock of this host says {now:%Y-%m-%d %H:%M} UTC: is it right?")


def _table(folder: Path, authority: Certificate) -> RoleTable | None:
    from cryptography.exceptions import InvalidSignature  # noqa: PLC0415  as above
    from cryptography.hazmat.primitives.asymmetric.ec import ECDSA, EllipticCurvePublicKey  # noqa: PLC0415  as above
    from cryptography.hazmat.primitives.hashes import SHA256  # noqa: PLC0415  as above

    file = folder / ROLES
    if not file.exists():
        return None
    table = _read(file, lambda data: decoded_json(data, RoleTable), "no table of roles")
    key: Any = authority.public_key()
    try:
        if not isinstance(key, EllipticCurvePublicKey):
            raise InvalidSignature
        key.verify(base64.b64decode(table.signature), table.signed, ECDSA(SHA256()))
    except (InvalidSignature, ValueError) as error:
        text = f"'{short_path(file)}' is not what the authority {name_in(authority)} has signed"
        raise ConfigurationError(text, hint="Take the newest one from the folder of the authority.") from error
    return table


def _certificate(file: Path) -> Certificate:
    from cryptography.x509 import load_pem_x509_certificate  # noqa: PLC0415  as above

    return _read(file, load_pem_x509_certificate, "no certificate in PEM")


def _read(file: Path, decode: Callable[[bytes], T], what: str) -> T:
    try:
        return decode(file.read_bytes())
    except OSError as error:
        raise ConfigurationError(f"'{short_path(file)}' cannot be read: {error.strerror}") from error
    except (ValueError, TypeError) as error:  # TypeError: the key has a password
        raise ConfigurationError(f"'{short_path(file)}' is {what}: {error}") from error
