"""Reads the folder of a name, before anything is opened: its certificates, key and table have to belong together.

Zenoh checks certificates again, at each link; its errors name no file and no reason. Who imports this needs
cryptography.
"""

from __future__ import annotations

import base64
import os
import stat
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar, cast, get_args

from ...errors import ConfigurationError
from ...files import decoded_json
from ...installing import importing
from ...text import listed, short_path, shown
from .identity import CA, CA_KEY, CERTIFICATE, KEY, ROLES, Identity, Role, RoleTable, wrong_name

with importing("cryptography"):
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ec import ECDSA, EllipticCurvePublicKey
    from cryptography.hazmat.primitives.hashes import SHA256
    from cryptography.hazmat.primitives.serialization import load_pem_private_key
    from cryptography.x509 import (
        Certificate,
        DNSName,
        IPAddress,
        Name,
        SubjectAlternativeName,
        load_pem_x509_certificates,
    )
    from cryptography.x509.oid import NameOID

__all__ = ["called", "hosts_in", "hosts_of", "identity_in"]

T = TypeVar("T")


def identity_in(folder: Path, roles: Mapping[str, Role] | None = None) -> Identity:
    """Read a folder, and check all of it.

    Args:
        folder: DIR/NAME.
        roles: who has which role, instead of what `roles.json` of the folder says.

    Raises:
        ConfigurationError: it is no such folder, something in it is wrong, or a certificate is not valid now.
    """
    folder = folder.absolute()
    _check_files(folder)
    table = None if roles is None else RoleTable(dict(roles))
    file = folder / CERTIFICATE
    place = short_path(file)
    authorities, (own, *between) = (
        _read(one, load_pem_x509_certificates, "no certificate in PEM") for one in (folder / CA, file)
    )
    key = _read(folder / KEY, lambda data: load_pem_private_key(data, None), "no key without a password")
    names = [str(one.value) for one in own.subject.get_attributes_for_oid(NameOID.COMMON_NAME)]
    if len(names) != 1:  # of several Zenoh takes the first
        raise ConfigurationError(f"the certificate '{place}' has {len(names)} common names; expected exactly one")
    [name] = names
    if (wrong := wrong_name(name)) is not None:
        raise ConfigurationError(f"the certificate '{place}' has the common name {shown(name)}: {wrong}")
    path = _path(own, between, authorities, folder)
    if key.public_key() != own.public_key():
        raise ConfigurationError(f"the key '{short_path(folder / KEY)}' does not belong to '{place}'")
    for one in path:
        _check_dates(one, place if one is own else f"{called(one.subject)}' in '{short_path(folder)}")
    table = table if table is not None else _table(folder, own, path[-1])
    if table is not None and (bad := next((one for one in table.roles if wrong_name(one) is not None), None)):
        raise ConfigurationError(f"{shown(bad)} in the table of roles cannot be a name: {wrong_name(bad)}")
    if table is not None and name not in table.roles:
        raise ConfigurationError(f"'{name}' of '{short_path(folder)}' has no role in {table}")
    role = table.roles[name] if table is not None else _role_in(own)
    if table is None and role == "node":
        hint = f"Take {ROLES} from the folder that the authority has for it."
        raise ConfigurationError(f"there is no {ROLES} in '{short_path(folder)}', which a node needs", hint=hint)
    until = min(one.not_valid_after_utc for one in path)
    return Identity(folder, name, role, until, called(own.issuer), table)


def _check_files(folder: Path) -> None:
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
    state = (folder / KEY).stat()
    # A key of root, as in a Secret of Kubernetes, is for a group of this process.
    open_to = stat.S_IRWXO | (stat.S_IWGRP if os.getuid() and not state.st_uid else stat.S_IRWXG)
    if (mode := state.st_mode) & open_to:
        hint = f"`chmod 600 {short_path(folder / KEY)}` closes it."
        raise ConfigurationError(f"others can read '{short_path(folder / KEY)}' (mode {mode & 0o777:o})", hint=hint)


def called(name: Name) -> str:
    """What a certificate is called: its common name, or all it has instead of one."""
    names = name.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else name.rfc4514_string()


def hosts_of(certificate: Certificate) -> list[str]:
    """Names and addresses of the hosts that a certificate is for."""
    found = [one for one in certificate.extensions if isinstance(one.value, SubjectAlternativeName)]
    return [str(own.value) for one in found for own in one.value if isinstance(own, DNSName | IPAddress)]


def hosts_in(folder: Path) -> list[str]:
    """Names and addresses of the hosts that the certificate in a folder is for, which `identity_in` has checked."""
    return hosts_of(load_pem_x509_certificates((folder / CERTIFICATE).read_bytes())[0])


def _path(
    own: Certificate, between: Sequence[Certificate], authorities: Sequence[Certificate], folder: Path
) -> list[Certificate]:
    """A certificate, those between, and the authority that they lead to."""
    path = [own]
    while True:
        signed = [one for one in (*authorities, *between) if one not in path and _has_signed(one, path[-1])]
        if not signed:
            what = f"'{short_path(folder / CERTIFICATE)}'" if path[-1] is own else f"'{called(path[-1].subject)}' in it"
            raise ConfigurationError(
                f"the certificate {what} is signed by '{called(path[-1].issuer)}', of which there is no certificate "
                f"in '{short_path(folder / CA)}'",
                hint=f"There is {', '.join(repr(called(one.subject)) for one in authorities)}.",
            )
        path.append(signed[0])
        if signed[0] in authorities:
            return path


def _has_signed(issuer: Certificate, certificate: Certificate) -> bool:
    try:
        certificate.verify_directly_issued_by(issuer)
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True


def _role_in(certificate: Certificate) -> Role | None:
    """The role that the authority has written into a certificate, for its owner: listeners look into their table."""
    units = [own.value for own in certificate.subject.get_attributes_for_oid(NameOID.ORGANIZATIONAL_UNIT_NAME)]
    return cast("Role", units[0]) if len(units) == 1 and units[0] in get_args(Role) else None


def _check_dates(certificate: Certificate, place: str) -> None:
    now = datetime.now(UTC)
    if now > certificate.not_valid_after_utc:
        hint = "Whoever has the folder of the authority renews it with `fmu-mesh security renew`."
        ended = certificate.not_valid_after_utc
        raise ConfigurationError(f"the certificate '{place}' ended at {ended:%Y-%m-%d %H:%M} UTC", hint=hint)
    if now < certificate.not_valid_before_utc:
        begins = certificate.not_valid_before_utc
        hint = f"The clock of this host says {now:%Y-%m-%d %H:%M} UTC: is it right?"
        raise ConfigurationError(
            f"the certificate '{place}' is not valid before {begins:%Y-%m-%d %H:%M} UTC", hint=hint
        )


def _table(folder: Path, own: Certificate, authority: Certificate) -> RoleTable | None:
    """The table of a folder. It is signed, unless another authority made the certificates: that one cannot sign it."""
    file = folder / ROLES
    if not file.exists():
        return None
    table = _read(file, lambda data: decoded_json(data, RoleTable), "no table of roles")
    if not table.signature and _role_in(own) is None:
        return table
    try:
        key = cast("EllipticCurvePublicKey", authority.public_key())
        key.verify(base64.b64decode(table.signature), table.signed, ECDSA(SHA256()))
    except (InvalidSignature, ValueError, TypeError) as error:  # TypeError: it is a key of another kind
        text = f"'{short_path(file)}' is not what the authority '{called(authority.subject)}' has signed"
        raise ConfigurationError(text, hint="Take the newest one from the folder of the authority.") from error
    return table


def _read(file: Path, decode: Callable[[bytes], T], what: str) -> T:
    try:
        return decode(file.read_bytes())
    except OSError as error:
        raise ConfigurationError(f"'{short_path(file)}' cannot be read: {error.strerror}") from error
    except (ValueError, TypeError) as error:  # TypeError: the key has a password
        raise ConfigurationError(f"'{short_path(file)}' is {what}: {error}") from error
