"""Files inside archives, by paths that lead into them: `system.ssp/resources/a.fmu`, where `system.ssp` is a file.

Owns how such a path is followed, also through an archive inside an archive. A file is copied into memory, or into a
file without a name if it is large, so nothing of it is left when it is closed. Does not know what the files mean.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import zipfile
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path, PurePosixPath
from typing import IO, Final, NamedTuple

from .. import files
from ..config.mesh import LimitsConfig
from ..errors import LoadFailed
from ..text import meant, nearest
from .archive_entries import checked_archive, entry_name, reading

__all__ = ["InnerFile", "inner_file", "inner_sha256", "inner_size"]

_DEEPEST: Final = 8
"""How many archives may lie in one another."""

_IN_MEMORY: Final = 16 * 2**20
"""Bytes of a file that are kept in memory; a larger one goes to the disk."""

_CHUNK: Final = 2**20


class InnerFile(NamedTuple):
    """A file of an archive, copied out of it, and its SHA-256 in hexadecimal digits; who has it closes ``file``."""

    file: IO[bytes]
    sha256: str


def inner_file(path: Path, outer: Path, limits: LimitsConfig) -> InnerFile:
    """Copy the file at ``path`` out of the archive at ``outer``, the part of the path that is a file on the disk.

    Raises:
        LoadFailed: there is no such file, or an archive on the way is damaged or exceeds ``limits``; names the archive.
    """
    with ExitStack() as stack, reading(outer):
        file = stack.enter_context(files.opened(outer))
        version = files.version_of(file)
        copy = _followed(path, outer, file, limits, stack)
    files.remember_sha256(version, _inside(path, outer), copy.sha256)
    return copy


def inner_sha256(path: Path, outer: Path, limits: LimitsConfig = LimitsConfig()) -> str:  # noqa: B008 a frozen Struct
    """The SHA-256 of the file at ``path``; calculated once per process, unless the archive on the disk changes.

    Raises:
        OSError: the archive on the disk cannot be examined.
        LoadFailed: as `inner_file`.
    """
    version = files.version_at(outer)
    if (known := files.known_sha256(version, _inside(path, outer))) is not None:
        return known
    copy = inner_file(path, outer, limits)
    copy.file.close()
    return copy.sha256


def inner_size(path: Path, outer: Path, limits: LimitsConfig = LimitsConfig()) -> int:  # noqa: B008 a frozen Struct
    """The size of the file at ``path`` in bytes.

    Raises:
        LoadFailed: as `inner_file`.
    """
    with inner_file(path, outer, limits).file as file:
        return file.seek(0, os.SEEK_END)


def _followed(path: Path, outer: Path, file: IO[bytes], limits: LimitsConfig, stack: ExitStack) -> InnerFile:
    """Copy archive after archive out of one another, until the file at ``path`` is there."""
    here = outer
    for _ in range(_DEEPEST):
        otherwise = f"archive with '{_inside(path, here)}' inside"
        with reading(here):
            archive = checked_archive(here, file, limits, otherwise)
            name, entry = _entry_towards(path, here, archive)
            copy = _copied(archive, entry)
        here /= name
        if here == path:
            return copy
        file = stack.enter_context(copy.file)
    raise LoadFailed(f"'{path}' lies in more than {_DEEPEST} archives inside one another.")


def _entry_towards(path: Path, here: Path, archive: zipfile.ZipFile) -> tuple[str, zipfile.ZipInfo]:
    """The file of an archive that ``path`` names, or that it leads into."""
    wanted = _inside(path, here)
    entries = {entry_name(entry): entry for entry in archive.infolist() if not entry.is_dir()}
    parts = PurePosixPath(wanted)
    for name in map(str, (parts, *parts.parents)):
        if name in entries:
            return name, entries[name]
    if any(name.startswith(f"{wanted}/") for name in entries):
        raise LoadFailed(f"'{path}' is a folder inside '{here}'.", hint="Name a file in it.")
    hint = meant(_nearest(wanted, entries))
    raise LoadFailed(f"'{path}' does not exist: '{here}' has no file '{wanted}'.", hint=hint)


def _nearest(wanted: str, names: Iterable[str]) -> str | None:
    """A file of the same name in another folder of an archive, or the nearest name in the same folder."""
    folder, _, own = wanted.rpartition("/")
    by_folder = [name.rpartition("/") for name in names]
    elsewhere = next((f"{parent}{slash}{name}" for parent, slash, name in by_folder if name == own), None)
    near = nearest(own, [name for parent, _, name in by_folder if parent == folder])
    return elsewhere or (str(PurePosixPath(folder, near)) if near is not None else None)


def _copied(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> InnerFile:
    digest = hashlib.sha256()
    with ExitStack() as stack:
        copy = stack.enter_context(tempfile.SpooledTemporaryFile(_IN_MEMORY))
        with archive.open(entry) as source:  # ends at the declared size, and compares the checksum
            while chunk := source.read(_CHUNK):
                digest.update(chunk)
                copy.write(chunk)
        stack.pop_all()
    return InnerFile(copy, digest.hexdigest())


def _inside(path: Path, here: Path) -> str:
    return path.relative_to(here).as_posix()
