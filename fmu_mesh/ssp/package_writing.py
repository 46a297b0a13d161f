"""Writing a package: a ZIP archive that has the same bytes whenever it has the same content.

Owns times, permissions, order and compression of the entries, and that a failed export leaves nothing behind. What is
in the files is not its business.
"""

from __future__ import annotations

import lzma
import os
import re
import shutil
import stat
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Final, NamedTuple

from .. import files
from ..archives.inner_files import inner_file
from ..config.mesh import LimitsConfig
from ..errors import ConfigurationError
from ..instances.fmi.archive.archive import content_of

__all__ = ["ArchiveEntry", "Content", "resource_names", "write_package"]

_TIME: Final = (1980, 1, 1, 0, 0, 0)
"""The earliest time that an archive can have."""

_ARCHIVES: Final = (".fmu", ".ssp")
"""Files that are archives themselves, and are not compressed again."""

_DAMAGED: Final = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, NotImplementedError)
"""What `zipfile` raises for an entry that it cannot read; the last one for a compression that it does not know."""

_CHUNK: Final = 2**20
_UNSAFE: Final = re.compile(r"[^A-Za-z0-9_.-]")
"""Characters that would have to be escaped in the URI of a source (RFC 3986, 2.3), which not every tool undoes."""


class ArchiveEntry(NamedTuple):
    """A file in an archive that is open."""

    archive: zipfile.ZipFile
    entry: zipfile.ZipInfo


Content = bytes | Path | ArchiveEntry
"""A file of a package, or where it is. The path of a folder is that of an unpacked FMU, which is packed."""


def write_package(path: Path, entries: Mapping[str, Content]) -> None:
    """Write a package of entries by their paths in it; one that is there stays as it is until the new one is complete.

    Raises:
        ConfigurationError: it cannot be written.
        LoadFailed: an FMU cannot be read.
    """
    try:
        with files.replaced(path) as draft, zipfile.ZipFile(draft, "w") as package:
            for name, content in entries.items():
                _add(package, name, content)
    except _DAMAGED as error:
        raise ConfigurationError(f"'{path}' cannot be written, because a file for it is damaged: {error}") from error
    except OSError as error:
        is_own = not error.filename or Path(error.filename).parent == Path(os.path.realpath(path)).parent
        at = "" if is_own else f" ('{error.filename}')"
        raise ConfigurationError(f"'{path}' cannot be written: {error.strerror or error}{at}") from error


def resource_names(models: Iterable[Path]) -> dict[Path, str]:
    """The name in the package of each FMU: as its own, and unique; FMUs with equal content share one file.

    Names that differ in upper and lower case only would be one file on some systems.

    Raises:
        ConfigurationError, LoadFailed: an FMU cannot be read.
    """
    names: dict[Path, str] = {}
    by_content: dict[str, str] = {}
    taken: set[str] = set()
    for path in models:
        try:
            content = content_of(path)
        except OSError as error:
            raise ConfigurationError(f"'{path}' cannot be read: {error.strerror}") from error
        if content not in by_content:
            stem = _UNSAFE.sub("_", path.name.removesuffix(".fmu")) or "model"
            name, number = f"{stem}.fmu", 1
            while name.casefold() in taken:
                number += 1
                name = f"{stem}_{number}.fmu"
            taken.add(name.casefold())
            by_content[content] = f"resources/{name}"
        names[path] = by_content[content]
    return names


def _add(package: zipfile.ZipFile, name: str, content: Content) -> None:
    with _opened(content) as source:
        if isinstance(content, ArchiveEntry):
            size, stored = content.entry.file_size, content.entry.compress_type == zipfile.ZIP_STORED
        else:
            size, stored = source.seek(0, os.SEEK_END), name.lower().endswith(_ARCHIVES)
            source.seek(0)
        info = _info(name, size, zipfile.ZIP_STORED if stored else zipfile.ZIP_DEFLATED)
        with package.open(info, "w") as target:
            shutil.copyfileobj(source, target, _CHUNK)


def _info(name: str, size: int, compression: int, *, executable: bool = False) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name, _TIME)
    info.compress_type = compression
    info.create_system = 3  # Unix, on every system
    info.external_attr = (stat.S_IFREG | (0o755 if executable else 0o644)) << 16
    info.file_size = size
    return info


@contextmanager
def _opened(content: Content) -> Iterator[IO[bytes]]:
    """What a file of the package is to contain, open for reading."""
    match content:
        case bytes():
            yield BytesIO(content)
        case ArchiveEntry():
            with content.archive.open(content.entry) as file:
                yield file
        case _ if files.is_folder(content):
            with _packed(content) as file:
                yield file
        case _:
            outer = files.archive_on_the_way(content)
            with content.open("rb") if outer is None else inner_file(content, outer, LimitsConfig()).file as file:
                yield file


@contextmanager
def _packed(path: Path) -> Iterator[IO[bytes]]:
    """The archive of an unpacked FMU."""
    with TemporaryFile() as packed:
        with zipfile.ZipFile(packed, "w") as archive:
            for own in sorted(path.rglob("*"), key=lambda file: file.relative_to(path).as_posix()):
                if own.is_file():
                    name, status = own.relative_to(path).as_posix(), own.stat()
                    runs = bool(status.st_mode & stat.S_IXUSR)
                    info = _info(name, status.st_size, zipfile.ZIP_DEFLATED, executable=runs)
                    with own.open("rb") as source, archive.open(info, "w") as target:
                        shutil.copyfileobj(source, target, _CHUNK)
        yield packed
