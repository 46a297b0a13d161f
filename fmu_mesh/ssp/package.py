"""The files of a package: an .ssp archive, a folder that somebody has unpacked, or one .ssd and what lies beside it.

Owns how the URIs in a package become paths, and that none leads out of an archive; a folder is its user's own, and its
descriptions may name files beside it. The protection against hostile archives is
that of FMUs (`fmu_mesh.instances.fmi.archive`).
"""

from __future__ import annotations

import posixpath
import re
import zipfile
from contextlib import ExitStack
from pathlib import Path, PurePosixPath
from typing import Final, Self
from urllib.parse import unquote

from .. import files
from ..archives.archive_entries import LIMITS_HINT
from ..config.mesh import LimitsConfig, RecordConfig
from ..errors import ConfigurationError, LoadFailed
from ..instances.fmi.archive.archive import OpenFmu, opened
from ..text import did_you_mean, listed, meant, nearest, nearest_file
from .problems import Problems
from .system_structure import FilePlace

__all__ = ["ARCHIVE", "DEFAULT", "RESULT_BESIDE_PACKAGE", "Package", "beginning"]

ARCHIVE: Final = b"PK\x03\x04"
"""The first bytes of a ZIP archive with at least one file."""

DEFAULT: Final = "SystemStructure.ssd"
RESULT_BESIDE_PACKAGE: Final = f"../{RecordConfig().file}"
"""The result file of a package that says none: beside the archive, and not in it."""

_SCHEME: Final = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):")


class Package:
    """The files of one package, as a context manager.

    Names of files are relative to the package, with `/` between the parts. A name may lead into an archive inside the
    package, such as `resources/a.fmu/extra/start.ssv`.

    Attributes:
        root: the archive, or the folder.
        given: the .ssd that the user named instead of the package; empty if there is none.

    Raises:
        ConfigurationError: it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        is_ssd = path.suffix.lower() == ".ssd" and not files.is_folder(path)
        self.root = path.parent if is_ssd else path
        self.given = path.name if is_ssd else ""
        self._open = ExitStack()
        self._containers: dict[str, OpenFmu] = {}
        if is_ssd and not files.is_file(path):
            raise ConfigurationError(f"{path}: no such file", hint=meant(nearest_file(path)))
        if is_ssd and beginning(path) == ARCHIVE:
            raise ConfigurationError(f"'{path}' is a ZIP archive, and no description", hint="Name it .ssp.")
        self._container("")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    @property
    def is_archive(self) -> bool:
        """Whether it is one file."""
        return not files.is_folder(self.root)

    @property
    def descriptions(self) -> list[str]:
        """The names of the system structure descriptions at its root, the default one first."""
        names = [name for name in self.names() if name.lower().endswith(".ssd") and "/" not in name]
        return sorted(names, key=lambda name: (name != DEFAULT, name))

    def names(self) -> list[str]:
        """The names of all files of the package."""
        return sorted(self._container("").contents().names)

    def shown(self, name: str) -> str:
        """A file as messages name it."""
        return str(self.root / name)

    def exists(self, name: str) -> bool:
        """Whether there is a file of this name."""
        try:
            return self._owner(name) is not None
        except ConfigurationError:
            return False

    def read(self, name: str) -> bytes:
        """The bytes of a file.

        Raises:
            ConfigurationError: there is no such file, or it cannot be read.
        """
        owner = self._owner(name)
        if owner is None:
            hint = did_you_mean(name, self.names(), f"It has {listed(self.names())}.")
            raise ConfigurationError(f"'{self.root}' has no file '{name}'", hint=hint)
        try:
            if owner[1].startswith("../"):
                return self.read_beside(self.root / owner[1])
            return self._container(owner[0]).read(owner[1])
        except LoadFailed as error:
            raise ConfigurationError(error.message, hint=error.hint) from error

    def read_beside(self, path: Path) -> bytes:
        """The bytes of a file on the disk that somebody names instead of one in the package.

        Raises:
            ConfigurationError: there is no such file, or it cannot be read.
        """
        if not files.is_file(path):
            hint = meant(nearest(str(path), self.names()) or nearest_file(path))
            raise ConfigurationError(f"'{path}': there is no such file, nor is it in '{self.root}'", hint=hint)
        try:
            size, limit = path.stat().st_size, LimitsConfig().description_bytes
            if size > limit:
                text = f"'{path}' has {size} bytes; the limit is {limit}"
                raise ConfigurationError(text, hint="Divide it into several files: `ssv=...` takes several.")
            return path.read_bytes()
        except OSError as error:
            raise ConfigurationError(f"'{path}' cannot be read: {error.strerror}") from error

    def named_by(self, uri: str, base: str, place: FilePlace, problems: Problems) -> str | None:
        """The name of the file that a URI without a fragment means.

        None after a finding: it has a scheme, is absolute, leads out of an archive, or there is no such file. It is
        relative to the folder ``base``, such as `resources`; empty: the root of the package.
        """
        expected = "a path inside the package, such as resources/model.fmu"
        scheme = _SCHEME.match(uri)
        if scheme is not None:
            problems.add(place, f"the URI '{uri}' with the scheme '{scheme[1]}'", expected)
            return None
        text = unquote(uri)
        name = posixpath.normpath(posixpath.join(base, text)) if text else ""
        if not name or name == ".":
            problems.add(place, f"the source '{uri}', which is this file itself", expected)
            return None
        if "\\" in text:
            near = nearest(name.replace("\\", "/"), self.names())
            problems.add(place, f"the source '{uri}' with a backslash", "`/` between folders and files", near)
            return None
        leads_out = name.startswith("../") and not (self.root / base).is_dir()  # out of an archive
        if text.startswith("/") or leads_out or name == ".." or "\0" in text:
            problems.add(place, f"the source '{uri}', which leads out of the package", expected)
            return None
        if not self.exists(name):
            near = nearest(name, self.names())
            problems.add(place, f"no such file '{name}' in the package", "an existing file", near)
            return None
        return name

    def _owner(self, name: str) -> tuple[str, str] | None:
        """The container that has a file (empty: the package itself), and the name of the file in it."""
        container, rest = "", name
        if name.startswith("../"):  # beside the folder of the package
            whole = [*_around(name), name]
            container = next((one for one in whole if files.is_file(self.root / one)), "")
            if container in ("", name):
                return ("", name) if container else None
            rest = name[len(container) + 1 :]
        while rest not in (names := self._container(container).contents().names):
            inner = next((one for one in _around(rest) if one in names), None)
            if inner is None:
                return None
            container, rest = posixpath.join(container, inner), rest[len(inner) + 1 :]
        return container, rest

    def _container(self, name: str) -> OpenFmu:
        """An archive or a folder with files, opened once."""
        if name not in self._containers:
            path = self.root / name if name else self.root
            if not name and not files.exists(path):
                raise ConfigurationError(f"{path}: no such file", hint=meant(nearest_file(path)))
            try:
                self._containers[name] = self._open.enter_context(opened(path))
            except LoadFailed as error:
                text = error.message.replace(", so it is no FMU", "")
                raise ConfigurationError(text, hint=_way_out(path, error)) from error
        return self._containers[name]


def _around(name: str) -> list[str]:
    """What a file may lie in: the beginnings of its name that end before a `/`, the shortest first."""
    return [str(path) for path in reversed(PurePosixPath(name).parents)]


def _way_out(path: Path, error: LoadFailed) -> str | None:
    """What to do about an archive that cannot be opened."""
    if error.hint == LIMITS_HINT:  # the limits of a configuration are known when the package has been read
        return "If you trust it, unpack it, and name the folder instead."
    if error.hint is not None or not files.is_file(path):
        return error.hint
    match beginning(path):
        case b"":
            return "The file is empty."
        case begin if begin == ARCHIVE and not zipfile.is_zipfile(path):
            return "It begins like one, and its end is missing: was it copied completely?"
        case begin if begin.startswith((b"<", b"\xef\xbb\xbf<")):
            return "It is XML: name it .ssd if it is a system structure description."
    return None


def beginning(path: Path) -> bytes:
    """The first bytes of a file; empty if it cannot be read."""
    try:
        with files.opened(path) as file:
            return file.read(len(ARCHIVE))
    except OSError:
        return b""
