"""Certificates made by hand, as another authority makes them, and those that no authority should make."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from fmu_mesh.wire.security.identity import CA, CERTIFICATE, KEY

__all__ = ["CLIENT", "SERVER", "Signer", "new_signer", "write_folder"]

CLIENT = ExtendedKeyUsageOID.CLIENT_AUTH
SERVER = ExtendedKeyUsageOID.SERVER_AUTH

Key = ec.EllipticCurvePrivateKey | rsa.RSAPrivateKey


class Signer(NamedTuple):
    """An authority: its certificate, its key, and the certificates between it and a root."""

    certificate: x509.Certificate
    key: Key
    between: tuple[x509.Certificate, ...] = ()


def new_signer(name: str, by: Signer | None = None, *, with_rsa: bool = False) -> Signer:
    """An authority, signed by itself or by another one."""
    key = _new_key(with_rsa=with_rsa)
    subject = _named([name])
    builder = _begun(subject, key, timedelta(days=-1), timedelta(days=90))
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
    signer = by.certificate.subject if by is not None else subject
    certificate = builder.issuer_name(signer).sign(by.key if by is not None else key, SHA256())
    return Signer(certificate, key, () if by is None else (certificate, *by.between))


def write_folder(
    folder: Path,
    by: Signer,
    names: Sequence[str],
    *,
    root: Signer | None = None,
    begins: timedelta = timedelta(hours=-1),
    ends: timedelta = timedelta(days=90),
    usages: Sequence[x509.ObjectIdentifier] = (CLIENT, SERVER),
    hosts: Sequence[str] = ("localhost",),
    with_rsa: bool = False,
) -> Path:
    """A folder with a certificate of these common names; ``root``, by default ``by``, is in its `ca.pem`."""
    key = _new_key(with_rsa=with_rsa)
    builder = _begun(_named(names), key, begins, ends).issuer_name(by.certificate.subject)
    if usages:
        builder = builder.add_extension(x509.ExtendedKeyUsage(list(usages)), critical=False)
    if hosts:
        places = [x509.DNSName(host) for host in hosts]
        builder = builder.add_extension(x509.SubjectAlternativeName(places), critical=False)
    chain = (builder.sign(by.key, SHA256()), *by.between)
    folder.mkdir(parents=True, exist_ok=True)
    encoding = serialization.Encoding.PEM
    (folder / CERTIFICATE).write_bytes(b"".join(one.public_bytes(encoding) for one in chain))
    (folder / CA).write_bytes((root or by).certificate.public_bytes(encoding))
    form = serialization.PrivateFormat.PKCS8
    (folder / KEY).touch(mode=0o600)
    (folder / KEY).write_bytes(key.private_bytes(encoding, form, serialization.NoEncryption()))
    return folder


def _new_key(*, with_rsa: bool) -> Key:
    return rsa.generate_private_key(65537, 2048) if with_rsa else ec.generate_private_key(ec.SECP256R1())


def _named(names: Sequence[str]) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name) for name in names])


def _begun(subject: x509.Name, key: Key, begins: timedelta, ends: timedelta) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now + begins)
        .not_valid_after(now + ends)
    )
