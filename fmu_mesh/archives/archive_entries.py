"""The entries of ZIP archives, which may be hostile: what is refused before anything of an archive is read or written.

Owns the protection for every archive that we open: FMUs, and the archives in which FMUs lie. Does not know what the
files mean.
"""

from __future__ import annotations

import lzma
import shutil
import stat
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO, Final

from ..config.mesh import LimitsConfig
from ..errors import LoadFailed

__all__ = ["LIMITS_HINT", "checked_archive", "entry_name", "reading", "write_entry"]

LIMITS_HINT: Final = "If you trust it, raise `limits` in the configuration."

_HARMLESS_BYTES: Final = 64 * 2**20
"""An archive with fewer unpacked bytes is not a ZIP bomb, whatever its compression ratio is."""

_UNREAD: Final = ("__macosx/", "documentation/")
"""Folders, in lower case, that no run reads: of two entries of one name both are left out there, instead of refused."""

_CHUNK: Final = 2**20
_ENCRYPTED: Final = 0x1


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Convert what can go wrong while the archive at ``path`` is read to `LoadFailed`."""
    try:
        yield
    except FileNotFoundError as error:
        raise LoadFailed(f"'{path}' does not exist.") from error
    except (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError) as error:
        raise LoadFailed(f"'{path}' is a damaged ZIP archive: {error}") from error
    except OSError as error:
        raise LoadFailed(f"'{path}' cannot be read: {error.strerror or error}.") from error
    except (RuntimeError, ValueError) as error:  # `zipfile` raises them for entries that it cannot read
        raise LoadFailed(f"'{path}' cannot be extracted: {error}") from error


def checked_archive(path: Path, file: IO[bytes], limits: LimitsConfig, otherwise: str = "FMU") -> zipfile.ZipFile:
    """The archive in an open file, after a check that all its entries may be unpacked. Closing it leaves the file open.

    Errors name the file ``path``, and say that it is no ``otherwise`` if it is no archive.

    Raises:
        LoadFailed: it is no archive, an entry exceeds a limit, or an entry would be written outside the folder.
    """
    if not zipfile.is_zipfile(file):
        raise LoadFailed(f"'{path}' is no ZIP archive, so it is no {otherwise}.")
    with reading(path):
        archive = zipfile.ZipFile(file)
        for entry in archive.infolist():
            entry.filename = entry.filename.replace("\\", "/")  # tools for Windows write it, and no name of FMI has one
        _check(path, archive, limits)
    return archive


def entry_name(entry: zipfile.ZipInfo) -> str:
    """The name of an entry without the leading `./` that some tools write."""
    return str(PurePosixPath(entry.filename))


def write_entry(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, folder: Path) -> None:
    """Unpack one entry, with permissions for this user only, and never more bytes than the archive declares."""
    target = folder / PurePosixPath(entry.filename)
    if entry.is_dir():
        target.mkdir(parents=True, exist_ok=True)
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    executable = (entry.external_attr >> 16) & stat.S_IXUSR
    with archive.open(entry) as source, target.open("xb") as file:
        shutil.copyfileobj(source, file, _CHUNK)  # `ZipExtFile` ends at the declared size
    target.chmod(0o700 if executable else 0o600)


def _check(path: Path, archive: zipfile.ZipFile, limits: LimitsConfig) -> None:
    entries = archive.infolist()
    if len(entries) > limits.entries:
        raise LoadFailed(f"'{path}' has {len(entries)} entries; the limit is {limits.entries}.", hint=LIMITS_HINT)
    by_name: dict[str, list[zipfile.ZipInfo]] = {}
    for entry in entries:
        _check_entry(path, entry)
        by_name.setdefault(entry_name(entry), []).append(entry)
    unpacked = sum(entry.file_size for entry in entries)
    if unpacked > limits.unpacked_bytes:
        text = f"'{path}' has {unpacked} bytes when it is unpacked; the limit is {limits.unpacked_bytes}."
        raise LoadFailed(text, hint=LIMITS_HINT)
    packed = max(1, sum(entry.compress_size for entry in entries))
    if unpacked > _HARMLESS_BYTES and unpacked > limits.ratio * packed:
        text = f"'{path}' is {unpacked / packed:.0f} times as large when it is unpacked; the limit is {limits.ratio:g}."
        raise LoadFailed(text, hint=LIMITS_HINT)
    doubled = {name for name, same in by_name.items() if len(same) > 1 and not all(one.is_dir() for one in same)}
    if read := [name for name in doubled if not name.lower().startswith(_UNREAD)]:
        raise LoadFailed(f"'{path}' has two entries with one name: '{min(read)}'.")
    # So nobody reads or unpacks either of two.
    entries[:] = [entry for entry in entries if entry_name(entry) not in doubled]


def _check_entry(path: Path, entry: zipfile.ZipInfo) -> None:
    name = entry.filename
    if not name:
        raise LoadFailed(f"'{path}' is a damaged ZIP archive: it has an entry without a name.")
    relative = PurePosixPath(name)
    has_drive = any(":" in part for part in relative.parts[:1])
    has_name = bool(relative.parts) or entry.is_dir()
    if not has_name or relative.is_absolute() or ".." in relative.parts or has_drive:
        raise LoadFailed(f"'{path}' has an entry outside its own folder: '{name}'.")
    kind = stat.S_IFMT(entry.external_attr >> 16)
    if kind == stat.S_IFLNK:
        raise LoadFailed(f"'{path}' has a symbolic link inside: '{name}'.")
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise LoadFailed(f"'{path}' has something inside that is neither a file nor a folder: '{name}'.")
    if entry.flag_bits & _ENCRYPTED:
        raise LoadFailed(f"'{path}' is encrypted: '{name}'.")
