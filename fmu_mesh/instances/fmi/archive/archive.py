"""The files of an FMU: a ZIP archive from any source, also inside another one, or a folder that somebody has unpacked.

Owns the private folder that an instance uses. That folder has the layout of the FMU and can always be removed: if the
FMU is a folder, it holds copies of `binaries` and `resources` and links to all other files. It belongs to a folder that
is passed in, so that it is removed even if the process that used it was killed. The protection against hostile archives
is in `fmu_mesh.archives`; what the files mean, in `fmu_mesh.instances.fmi.archive.examining`.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from errno import EACCES, ENOSPC
from functools import cached_property
from pathlib import Path
from typing import IO, Final
from zipfile import ZipInfo

import msgspec

from .... import files
from ....archives.archive_entries import LIMITS_HINT, checked_archive, entry_name, reading, write_entry
from ....archives.inner_files import inner_file, inner_sha256, inner_size
from ....config.mesh import LimitsConfig
from ....errors import LoadFailed
from ..step_options import Terms

__all__ = ["Contents", "OpenFmu", "content_of", "in_new_folder", "opened", "sha256_of", "size_of"]

_MARGIN: Final = 2**20
"""The bytes that the folder of a run keeps for everything else."""
_PLACE_HINT: Final = "Set FMU_MESH_RUNTIME_DIR, or TMPDIR, to a folder with room from which code may run."
_XML_FILES: tuple[str, ...] = ("modelDescription.xml", "sources/buildDescription.xml")


class Contents(msgspec.Struct, frozen=True):
    """What is in an FMU."""

    names: frozenset[str]  # the names of all files, with `/` between the parts
    xml: dict[str, bytes]  # the contents of the XML files that describe the FMU, by name


class OpenFmu(ABC):
    """An FMU that is `opened` and meets its terms; whoever needs several things from one FMU opens it once.

    Each method raises `LoadFailed` if a file cannot be read or is damaged.
    """

    def __init__(self, path: Path, limits: LimitsConfig) -> None:
        self.path = path
        self._limits = limits

    def contents(self) -> Contents:
        """The names of its files and its descriptions; nothing is unpacked."""
        names = self._names()
        return Contents(names, {name: self.read(name) for name in _XML_FILES if name in names})

    def read(self, name: str) -> bytes:
        """The content of one of its files, which must not be larger than a description (`limits.description_bytes`)."""
        size, limit = self._size(name), self._limits.description_bytes
        if size > limit:
            text = f"the {name} of '{self.path}' has {size} bytes; the limit is {limit}."
            raise LoadFailed(text, hint=LIMITS_HINT)
        return self.read_binary(name)

    def _known(self, name: str) -> str:
        if name not in self._names():
            raise LoadFailed(f"'{self.path}' has no file '{name}'.")
        return name

    @abstractmethod
    def read_binary(self, name: str) -> bytes:
        """The content of one of its libraries, of any size that the limits of an archive allow."""

    @abstractmethod
    def read_begin(self, name: str, size: int) -> bytes:
        """The first ``size`` bytes of one of its files."""

    @abstractmethod
    def content_sha256(self) -> str:
        """Calculate the SHA-256 of the archive, or of the names and contents of all files of a folder."""

    @abstractmethod
    def unpacked_size(self) -> int:
        """How many bytes `unpack_into` writes."""

    @abstractmethod
    def unpack_into(self, folder: Path) -> None:
        """Unpack all files into an empty folder."""

    @abstractmethod
    def close(self) -> None:
        """Close it."""

    @abstractmethod
    def _names(self) -> frozenset[str]:
        """The names of all files, with `/` between the parts."""

    @abstractmethod
    def _size(self, name: str) -> int:
        """The size of a file in bytes."""


@contextmanager
def opened(path: Path, terms: Terms = Terms()) -> Iterator[OpenFmu]:  # noqa: B008 a frozen Struct
    """Open the FMU at ``path``; `LoadFailed` if there is none, or if it does not meet ``terms``."""
    kind = _Folder if files.is_folder(path) else _Archive
    with closing(kind(path, terms)) as fmu:
        if terms.content is not None and fmu.content_sha256() != terms.content:
            raise LoadFailed(f"'{path}' is not the FMU that this run was planned with.", hint="Start the run again.")
        yield fmu


def sha256_of(path: Path) -> str | None:
    """The SHA-256 of an archive in hexadecimal digits; None for a folder."""
    return None if files.is_folder(path) else content_of(path)


def size_of(path: Path) -> int | None:
    """The size of an archive in bytes; None for a folder."""
    if files.is_folder(path):
        return None
    outer = files.archive_on_the_way(path)
    return path.stat().st_size if outer is None else inner_size(path, outer)


def content_of(path: Path) -> str:
    """A SHA-256 that identifies an FMU; see `OpenFmu.content_sha256`. `OSError` or `LoadFailed`: it cannot be read."""
    if not files.is_folder(path):
        outer = files.archive_on_the_way(path)
        return files.sha256_of(path) if outer is None else inner_sha256(path, outer)
    digest = hashlib.sha256()
    for name in sorted(_names_in(path)):
        digest.update(f"{files.sha256_of(path / name)} {name}\0".encode(errors="surrogateescape"))
    return digest.hexdigest()


def in_new_folder(path: Path, parent: Path, size: Callable[[Path], int], fill: Callable[[Path], None]) -> Path:
    """Make a private folder for an FMU, with ``size(place)`` bytes that ``fill`` writes; returns the folder.

    It is below ``parent``. If that has no room, or no code may run from there, it is in the folder for temporary files,
    and `files.remove_tree` finds it by a link below ``parent``. After `LoadFailed` nothing is left behind.
    """
    temporary = Path(tempfile.gettempdir())
    reasons: list[str] = []
    for place in (parent, temporary):
        if reasons and parent.is_dir() and parent.stat().st_dev == temporary.stat().st_dev:
            break
        with ExitStack() as stack:
            try:
                parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                folder = Path(tempfile.mkdtemp(prefix=f"{path.stem[:40]}-", dir=place))
                stack.callback(shutil.rmtree, folder, ignore_errors=True)
                if place != parent:
                    (parent / f"{folder.name}{files.ELSEWHERE}").symlink_to(folder)
                _refuse_unfit(place, size(place))
                fill(folder)
            except (OSError, LoadFailed) as error:
                cause = error.__cause__ if isinstance(error, LoadFailed) else error
                if not isinstance(cause, OSError) or (cause is not error and cause.errno != ENOSPC):
                    raise  # it is not this folder that is wrong
                text = cause.args[0][0][2] if isinstance(cause, shutil.Error) else cause.strerror or cause
                reasons.append(f"'{place}': {text}")
            else:
                stack.pop_all()
                return folder
    raise LoadFailed(f"'{path}' cannot be extracted into {' or into '.join(reasons)}.", hint=_PLACE_HINT)


def _refuse_unfit(place: Path, size: int) -> None:
    """Refuse a folder that has too little room, or that is on a file system from which no library can be loaded."""
    found = os.statvfs(place)
    free = found.f_bavail * found.f_frsize
    if size + _MARGIN > free:
        raise OSError(ENOSPC, f"too little room ({size / 1e6:.1f} MB needed, {free / 1e6:.1f} MB free)")
    if found.f_flag & os.ST_NOEXEC:
        raise OSError(EACCES, "no code may run from there (the file system is mounted noexec)")


# --- an archive


class _Archive(OpenFmu):
    def __init__(self, path: Path, terms: Terms) -> None:
        super().__init__(path, terms.limits)
        # Bytes that have to be the right ones are read; it does not matter what the file was before.
        self._verifies = terms.sha256 is not None or terms.content is not None
        self._digest: str | None = None
        with ExitStack() as stack, reading(path):
            if (outer := files.archive_on_the_way(path)) is None:
                self._file: IO[bytes] = stack.enter_context(files.opened(path))
            else:
                copy = inner_file(path, outer, terms.limits)
                self._file, self._digest = stack.enter_context(copy.file), copy.sha256
            if terms.sha256 is not None and self._sha256() != terms.sha256.lower():
                raise LoadFailed(
                    f"'{path}' has the SHA-256 {self._sha256()}, not {terms.sha256.lower()}, which the configuration "
                    "asks for.",
                    hint="It is another file, or was changed. If it is the right one, correct `sha256`.",
                )
            self._zip = stack.enter_context(checked_archive(path, self._file, terms.limits))
            self._open = stack.pop_all()

    def close(self) -> None:
        self._open.close()

    def read_binary(self, name: str) -> bytes:
        with reading(self.path):
            return self._zip.read(self._entries[self._known(name)])

    def read_begin(self, name: str, size: int) -> bytes:
        with reading(self.path), self._zip.open(self._entries[self._known(name)]) as file:
            return file.read(size)

    def content_sha256(self) -> str:
        with reading(self.path):
            return self._sha256()

    def unpacked_size(self) -> int:
        return sum(entry.file_size for entry in self._zip.infolist())

    def unpack_into(self, folder: Path) -> None:
        with reading(self.path):
            for entry in self._zip.infolist():
                write_entry(self._zip, entry, folder)

    def _names(self) -> frozenset[str]:
        return frozenset(self._entries)

    def _size(self, name: str) -> int:
        return self._entries[self._known(name)].file_size

    @cached_property
    def _entries(self) -> dict[str, ZipInfo]:
        return {entry_name(entry): entry for entry in self._zip.infolist() if not entry.is_dir()}

    def _sha256(self) -> str:
        if self._digest is None:
            self._digest = files.sha256_of_open(self._file, again=self._verifies)
        return self._digest


# --- a folder

_COPIED: Final = ("binaries/", "resources/")


class _Folder(OpenFmu):
    def __init__(self, path: Path, terms: Terms) -> None:
        if terms.sha256 is not None:
            text = f"'{path}' is a folder, and `sha256` is that of an archive."
            raise LoadFailed(text, hint="Zip it, or leave it out.")
        super().__init__(path, terms.limits)

    def close(self) -> None:
        """Nothing is open."""

    def read_binary(self, name: str) -> bytes:
        with reading(self.path):
            return (self.path / self._known(name)).read_bytes()

    def read_begin(self, name: str, size: int) -> bytes:
        with reading(self.path), (self.path / self._known(name)).open("rb") as file:
            return file.read(size)

    def content_sha256(self) -> str:
        with reading(self.path):
            return content_of(self.path)

    def unpacked_size(self) -> int:
        names = (name for name in _names_in(self.path) if name.startswith(_COPIED))
        return sum((self.path / name).stat().st_size for name in names)

    def unpack_into(self, folder: Path) -> None:
        """Give ``folder`` the layout of the FMU without writing to the FMU: what it may change is copied.

        Each instance has a library file of its own, so that two instances in one process share no variables of it.
        """
        for entry in self.path.resolve().iterdir():
            if f"{entry.name}/" in _COPIED and entry.is_dir():
                shutil.copytree(entry, folder / entry.name, copy_function=files.cloned, ignore_dangling_symlinks=True)
            else:
                (folder / entry.name).symlink_to(entry)

    def _names(self) -> frozenset[str]:
        return _names_in(self.path)

    def _size(self, name: str) -> int:
        with reading(self.path):
            return (self.path / self._known(name)).stat().st_size


def _names_in(path: Path) -> frozenset[str]:
    """The names of all files, with `/` between the parts."""
    return frozenset(
        Path(parent, name).relative_to(path).as_posix() for parent, _, names in os.walk(path) for name in names
    )
