"""An authority that certifies names, in a folder: makes the folders that are handed over. Needs cryptography.

Owns `authority.json`, the list of all names, and the key of the authority, which stays here. Each change of the list is
one replaced file, and the table of roles, which is signed, is in the folders of all nodes.
"""

from __future__ import annotations

import base64
import ipaddress
import os
import re
import shutil
import socket
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

import msgspec
from msgspec.structs import replace

from ...errors import ConfigurationError
from ...files import decoded_json, write_whole
from ...installing import importing
from ...text import did_you_mean, short_path
from .certificates import called
from .identity import CA, CA_KEY, CERTIFICATE, KEY, ROLES, Role, RoleTable, wrong_name

with importing("cryptography"):
    from cryptography import x509
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.hazmat.primitives.hashes import SHA256
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

__all__ = ["LIST", "Authority", "Member", "names_of_this_host"]

LIST: Final = "authority.json"
_CA_DAYS: Final = 3650
_LONGEST_NAME: Final = 36
"""Of an authority: with the time, a common name has at most 64 characters."""

_EARLIER: Final = timedelta(minutes=10)
"""A certificate begins so much earlier, for hosts whose clocks differ."""

_HOST: Final = re.compile(r"(\*\.)?[A-Za-z0-9_]([A-Za-z0-9._-]{0,251})")
_CURVE: Final = ec.SECP256R1()
_PRIVATE, _PRIVATE_FOLDER = 0o600, 0o700


class Member(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Somebody whom the authority has certified.

    Attributes:
        until: the end of the certificate, in ISO 8601.
        hosts: names and addresses at which a node may listen.
    """

    role: Role
    until: str
    hosts: tuple[str, ...] = ()


class _List(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    version: int
    number: int
    made: str
    members: dict[str, Member]


def names_of_this_host() -> tuple[str, ...]:
    """Under which names and addresses this host is reached by itself, and by others that know its name."""
    names = socket.gethostname(), socket.getfqdn(), "localhost", "127.0.0.1", "::1"
    return tuple(dict.fromkeys(name for name in names if name == "::1" or _HOST.fullmatch(name)))


class Authority:
    """The authority of a folder.

    Attributes:
        folder: where it is.
        until: its end.
    """

    def __init__(self, folder: Path) -> None:
        """Open it.

        Raises:
            ConfigurationError: it is none, or a file of it cannot be read.
        """
        self.folder = folder
        try:
            self._list = decoded_json((folder / LIST).read_bytes(), _List)
            self._certificate = x509.load_pem_x509_certificate((folder / CA).read_bytes())
            key = serialization.load_pem_private_key((folder / CA_KEY).read_bytes(), None)
        except FileNotFoundError as error:
            of_name = (folder / CERTIFICATE).exists()
            hint = f"`fmu-mesh security init {short_path(folder)}` makes one."
            hint = "It is the folder of one name: give that of its authority." if of_name else hint
            raise ConfigurationError(
                f"'{short_path(folder)}' is no authority: there is no {error.filename}", hint=hint
            ) from error
        except (OSError, ValueError, TypeError) as error:
            raise ConfigurationError(f"the authority '{short_path(folder)}' cannot be read: {error}") from error
        if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != self._certificate.public_key():
            raise ConfigurationError(f"{CA_KEY} of '{short_path(folder)}' is not the key of its {CA}")
        self._key = key
        self.until = self._certificate.not_valid_after_utc

    @property
    def name(self) -> str:
        """What it is called in errors of others."""
        return called(self._certificate.subject)

    @property
    def members(self) -> dict[str, Member]:
        """All names, in the order in which they were added."""
        return self._list.members

    @property
    def table(self) -> RoleTable:
        """The newest table of roles, signed."""
        roles = {name: member.role for name, member in self.members.items()}
        table = RoleTable(roles, self._list.number, self._list.made)
        signature = self._key.sign(table.signed, ec.ECDSA(SHA256()))
        return replace(table, signature=base64.b64encode(signature).decode())

    @classmethod
    def made(cls, folder: Path) -> Authority:
        """Make an authority in a folder that is empty, or not there.

        Raises:
            ConfigurationError: there is something, or it cannot be written.
        """
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            what = "is not empty" if folder.is_dir() else "is no folder"
            what = "has an authority already" if (folder / LIST).exists() else what
            raise ConfigurationError(f"'{short_path(folder)}' {what}; nothing was written")
        key, now = ec.generate_private_key(_CURVE), datetime.now(UTC)
        # Errors name an authority, so two of them have two names.
        subject = _subject(f"{folder.absolute().name[:_LONGEST_NAME]} of {now:%Y-%m-%d %H:%M:%S} UTC")
        certificate = (
            _begun(subject, key.public_key(), now + timedelta(days=_CA_DAYS))
            .issuer_name(subject)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_key_usage(signs_certificates=True), critical=True)
            .sign(key, SHA256())
        )
        with _writing(folder):
            folder.mkdir(mode=_PRIVATE_FOLDER, parents=True, exist_ok=True)
            folder.chmod(_PRIVATE_FOLDER)
            _write_private(folder / CA_KEY, _key_text(key))
            write_whole(folder / CA, _text(certificate))
            write_whole(folder / LIST, msgspec.json.encode(_List(1, 0, _now(), {})))
        return cls(folder)

    def add(self, name: str, role: Role, days: float, hosts: Iterable[str] = ()) -> Path:
        """Certify a name; returns the folder to hand over.

        Args:
            name: legal in keys and paths, and of nobody else.
            role: of the name.
            days: how long the certificate lasts, at most as long as that of the authority.
            hosts: names and addresses at which a node listens; default: those of this host.

        Raises:
            ConfigurationError: the name or a host is wrong or taken, or cannot be written.
        """
        if (wrong := wrong_name(name)) is not None:
            raise ConfigurationError(f"'{name}' cannot be a name: {wrong}")
        taken = next((own for own in self.members if own.lower() == name.lower()), None)
        if taken is not None:
            hint = "`fmu-mesh security renew` renews it, `security remove` takes it away."
            raise ConfigurationError(f"'{taken}' is in '{short_path(self.folder)}' already", hint=hint)
        if (self.folder / name).exists():
            raise ConfigurationError(f"'{short_path(self.folder / name)}' is there, and of no name: remove it first")
        hosts = tuple(dict.fromkeys(hosts)) or (names_of_this_host() if role == "node" else ())
        return self._certify(name, Member(role, "", hosts), days)

    def renew(self, name: str, days: float, hosts: Iterable[str] = ()) -> Path:
        """Make a new certificate, and a new key, for a name that is known; returns the folder to hand over again.

        Args:
            name: has been added.
            days: as for `add`.
            hosts: as for `add`; default: those that it had.

        Raises:
            ConfigurationError: there is no such name, a host is wrong, or it cannot be written.
        """
        member, hosts = self._member(name), tuple(dict.fromkeys(hosts))
        return self._certify(name, replace(member, hosts=hosts or member.hosts), days)

    def remove(self, name: str) -> None:
        """Take the role of a name away: whoever listens with the new table lets it do nothing any more."""
        self._member(name)
        with _writing(self.folder):
            self._write({own: member for own, member in self.members.items() if own != name})
            shutil.rmtree(self.folder / name, ignore_errors=True)

    def _member(self, name: str) -> Member:
        if name not in self.members:
            hint = did_you_mean(name, self.members, "`fmu-mesh security show` lists all.")
            raise ConfigurationError(f"there is no '{name}' in '{short_path(self.folder)}'", hint=hint)
        return self.members[name]

    def _certify(self, name: str, member: Member, days: float) -> Path:
        if member.hosts and member.role != "node":
            raise ConfigurationError(f"'{name}' is an {member.role}: only a node listens, so only a node has hosts.")
        key, until = ec.generate_private_key(_CURVE), datetime.now(UTC) + timedelta(days=min(days, _CA_DAYS))
        until = min(until, self.until).replace(microsecond=0)
        usages = [ExtendedKeyUsageOID.CLIENT_AUTH]
        builder = _begun(_subject(name, member.role), key.public_key(), until)
        if member.role == "node":
            usages.append(ExtendedKeyUsageOID.SERVER_AUTH)
            builder = builder.add_extension(
                x509.SubjectAlternativeName([_place(own) for own in member.hosts]), critical=False
            )
        certificate = (
            builder.issuer_name(self._certificate.subject)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_key_usage(signs_certificates=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key()), critical=False)
            .sign(self._key, SHA256())
        )
        target = self.folder / name
        with _writing(self.folder):
            folder = Path(tempfile.mkdtemp(prefix=".new-", dir=self.folder))
            old = folder.with_name(folder.name.replace("new", "old", 1))
            try:
                _write_private(folder / KEY, _key_text(key))
                (folder / CERTIFICATE).write_bytes(_text(certificate))
                shutil.copyfile(self.folder / CA, folder / CA)
                if target.exists():  # a reader finds the old key with the old certificate, or the new ones
                    target.rename(old)
                folder.rename(target)
            finally:
                shutil.rmtree(folder, ignore_errors=True)
                shutil.rmtree(old, ignore_errors=True)
            self._write({**self.members, name: replace(member, until=until.isoformat())})
        return target

    def _write(self, members: dict[str, Member]) -> None:
        """Replace the list, and the table of each node; its number is another one if a role is."""
        before, roles = self.table.roles, {name: member.role for name, member in members.items()}
        if before == roles:
            self._list = replace(self._list, members=members)
        else:
            self._list = _List(1, self._list.number + 1, _now(), members)
        write_whole(self.folder / LIST, msgspec.json.encode(self._list))
        text = msgspec.json.format(msgspec.json.encode(self.table))
        for name, member in members.items():
            if member.role == "node" and (self.folder / name).is_dir():
                write_whole(self.folder / name / ROLES, text)


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ConfigurationError(f"'{short_path(folder)}' cannot be written: {error.strerror}") from error


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _begun(subject: x509.Name, key: ec.EllipticCurvePublicKey, until: datetime) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(datetime.now(UTC) - _EARLIER)
        .not_valid_after(until)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _subject(name: str, role: str | None = None) -> x509.Name:
    unit = [x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, role)] if role is not None else []
    return x509.Name([*unit, x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _place(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        if not _HOST.fullmatch(host):
            raise ConfigurationError(
                f"'{host}' is no name and no address of a host, such as lab1 or 10.0.0.5"
            ) from None
        return x509.DNSName(host)


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=True,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def _text(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _key_text(key: ec.EllipticCurvePrivateKey) -> bytes:
    form = serialization.PrivateFormat.PKCS8
    return key.private_bytes(serialization.Encoding.PEM, form, serialization.NoEncryption())


def _write_private(file: Path, content: bytes) -> None:
    descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _PRIVATE)
    with os.fdopen(descriptor, "wb") as stream:
        stream.write(content)
