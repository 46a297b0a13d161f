"""The files of an FMU: a ZIP archive from any source, or a folder that somebody has unpacked.

Owns the protection against hostile archives, and the private folder that an instance uses. That folder has the layout
of the FMU and can always be removed: if the FMU is a folder, it holds copies of the binaries and links to all other
files. It lies below a folder that is passed in, so that it is removed even if the process that used it was killed.
Does not know what the files mean; see `fmu_mesh.instances.fmi.archive.examining`.
"""

from __future__ import annotations

import hashlib
import lzma
import os
import shutil
import stat
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path, PurePosixPath
from typing import Final, Protocol

import msgspec

from .... import files
from ....config.mesh import LimitsConfig
from ....errors import LoadFailed

__all__ = ["Contents", "OpenFmu", "Terms", "content_of", "opened", "sha256_of", "unpacked"]

_HARMLESS_BYTES: Final = 64 * 2**20
"""An archive with fewer unpacked bytes is not a ZIP bomb, whatever its compression ratio is."""

_CHUNK: Final = 2**20
_ENCRYPTED: Final = 0x1
_XML_FILES: tuple[str, ...] = ("modelDescription.xml", "sources/buildDescription.xml")


class Terms(msgspec.Struct, frozen=True):
    """The conditions that an FMU must meet before it is used.

    Attributes:
        sha256: the SHA-256 that the configuration asks for, in hexadecimal digits.
        content: what `content_of` returned when the run was planned.
    """

    limits: LimitsConfig = LimitsConfig()
    sha256: str | None = None
    content: str | None = None


class Contents(msgspec.Struct, frozen=True):
    """What is in an FMU.

    Attributes:
        names: the names of all files, with `/` between the parts.
        xml: the contents of the XML files that describe the FMU, by name.
    """

    names: frozenset[str]
    xml: dict[str, bytes]


class OpenFmu(Protocol):
    """An FMU that is open and meets its terms.

    Whoever needs several things from one FMU opens it once:

    ```python
    with opened(path, terms) as fmu:
        description = description_of(fmu)
        compile_sources(fmu, description, tell)
    ```

    Attributes:
        path: where it lies.

    Raises:
        LoadFailed: by each method: a file cannot be read or is damaged.
    """

    path: Path

    def contents(self) -> Contents:
        """The names of its files and its descriptions; nothing is unpacked."""
        ...

    def content_sha256(self) -> str:
        """Calculate the SHA-256 of the archive, or of the names and contents of all files of a folder."""
        ...

    def unpack_into(self, folder: Path) -> None:
        """Unpack all files into an empty folder."""
        ...


@contextmanager
def opened(path: Path, terms: Terms = Terms()) -> Iterator[OpenFmu]:  # noqa: B008 a frozen Struct
    """Open the FMU at ``path`` and check that it meets ``terms``.

    Raises:
        LoadFailed: there is no FMU, or it does not meet the terms.
    """
    kind = _Folder if files.is_folder(path) else _Archive
    with closing(kind(path, terms)) as fmu:
        if terms.content is not None and fmu.content_sha256() != terms.content:
            raise LoadFailed(f"'{path}' is not the FMU that this run was planned with.", hint="Start the run again.")
        yield fmu


def sha256_of(path: Path) -> str | None:
    """The SHA-256 of an archive in hexadecimal digits; None for a folder."""
    return None if files.is_folder(path) else files.sha256_of(path)


def content_of(path: Path) -> str:
    """A SHA-256 that identifies an FMU; see `OpenFmu.content_sha256`.

    Raises:
        OSError: it cannot be read.
    """
    if not files.is_folder(path):
        return files.sha256_of(path)
    digest = hashlib.sha256()
    for name in sorted(_names_in(path)):
        digest.update(f"{files.sha256_of(path / name)} {name}\0".encode(errors="surrogateescape"))
    return digest.hexdigest()


@contextmanager
def unpacked(fmu: OpenFmu, parent: Path) -> Iterator[Path]:
    """Unpack an FMU into a new private folder below ``parent``.

    Inside the block the folder has the suffix `.part`. It gets its final name, without the suffix, when the block ends
    without an exception; otherwise it is removed. So no reader sees an incomplete FMU.

    Raises:
        LoadFailed: the FMU is damaged, or the folder cannot be written; nothing is left behind.
    """
    path = fmu.path
    try:
        parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f"{path.stem[:40]}-", suffix=".part", dir=parent))
    except OSError as error:
        raise LoadFailed(f"'{path}' cannot be extracted into '{parent}': {error.strerror}") from error
    try:
        fmu.unpack_into(partial)
        yield partial
        partial.rename(partial.with_suffix(""))
    except OSError as error:
        raise LoadFailed(f"'{path}' cannot be extracted: {error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


# --- an archive


class _Archive:
    def __init__(self, path: Path, terms: Terms) -> None:
        self.path = path
        self._limits = terms.limits
        # Bytes that have to be the right ones are read; it does not matter what the file was before.
        self._verifies = terms.sha256 is not None or terms.content is not None
        self._digest: str | None = None
        with ExitStack() as stack, _reading(path):
            self._file = stack.enter_context(path.open("rb"))
            if terms.sha256 is not None:
                _verify(path, self._sha256(), terms.sha256.lower())
            self._zip = stack.enter_context(zipfile.ZipFile(self._file))
            _check(path, self._zip, terms.limits)
            self._open = stack.pop_all()

    def close(self) -> None:
        self._open.close()

    def contents(self) -> Contents:
        entries = {_name(entry): entry for entry in self._zip.infolist() if not entry.is_dir()}
        present = [name for name in _XML_FILES if name in entries]
        _refuse_large_description(self.path, {name: entries[name].file_size for name in present}, self._limits)
        with _reading(self.path):
            return Contents(frozenset(entries), {name: self._zip.read(entries[name]) for name in present})

    def content_sha256(self) -> str:
        with _reading(self.path):
            return self._sha256()

    def unpack_into(self, folder: Path) -> None:
        with _reading(self.path):
            for entry in self._zip.infolist():
                _write(self._zip, entry, folder)

    def _sha256(self) -> str:
        if self._digest is None:
            self._digest = files.sha256_of_open(self._file, again=self._verifies)
        return self._digest


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Convert what can go wrong while an archive is read to `LoadFailed`."""
    try:
        yield
    except FileNotFoundError as error:
        raise LoadFailed(f"'{path}' does not exist.") from error
    except zipfile.BadZipFile as error:
        is_zip = files.is_file(path) and zipfile.is_zipfile(path)
        what = f"is a damaged ZIP archive: {error}" if is_zip else "is no ZIP archive, so it is no FMU."
        raise LoadFailed(f"'{path}' {what}") from error
    except (zlib.error, lzma.LZMAError, EOFError) as error:
        raise LoadFailed(f"'{path}' is a damaged ZIP archive: {error}") from error
    except OSError as error:
        raise LoadFailed(f"'{path}' cannot be read: {error.strerror or error}.") from error
    except (RuntimeError, ValueError) as error:  # `zipfile` raises them for entries that it cannot read
        raise LoadFailed(f"'{path}' cannot be extracted: {error}") from error


def _verify(path: Path, found: str, expected: str) -> None:
    if found != expected:
        raise LoadFailed(
            f"'{path}' has the SHA-256 {found}, not {expected}, which the configuration asks for.",
            hint="It is another file, or was changed. If it is the right one, correct `sha256`.",
        )


def _check(path: Path, archive: zipfile.ZipFile, limits: LimitsConfig) -> None:
    """Check that all entries of an archive may be unpacked.

    Raises:
        LoadFailed: an entry exceeds a limit or would be written outside the folder.
    """
    entries = archive.infolist()
    hint = "If you trust it, raise `limits` in the configuration."
    if len(entries) > limits.entries:
        raise LoadFailed(f"'{path}' has {len(entries)} entries; the limit is {limits.entries}.", hint=hint)
    names: set[str] = set()
    for entry in entries:
        _check_entry(path, entry)
        name = _name(entry)
        if name in names and not entry.is_dir():
            raise LoadFailed(f"'{path}' has two entries with one name: '{name}'.")
        names.add(name)
    unpacked = sum(entry.file_size for entry in entries)
    if unpacked > limits.unpacked_bytes:
        text = f"'{path}' has {unpacked} bytes when it is unpacked; the limit is {limits.unpacked_bytes}."
        raise LoadFailed(text, hint=hint)
    packed = max(1, sum(entry.compress_size for entry in entries))
    if unpacked > _HARMLESS_BYTES and unpacked > limits.ratio * packed:
        text = f"'{path}' is {unpacked / packed:.0f} times as large when it is unpacked; the limit is {limits.ratio:g}."
        raise LoadFailed(text, hint=hint)


def _name(entry: zipfile.ZipInfo) -> str:
    """The name of an entry without the leading `./` that some tools write."""
    return str(PurePosixPath(entry.filename))


def _check_entry(path: Path, entry: zipfile.ZipInfo) -> None:
    name = entry.filename
    relative = PurePosixPath(name)
    has_drive = any(":" in part for part in relative.parts[:1])
    has_name = bool(relative.parts) or entry.is_dir()
    if not has_name or relative.is_absolute() or ".." in relative.parts or has_drive:
        raise LoadFailed(f"'{path}' has an entry outside its own folder: '{name}'.")
    if "\\" in name:
        raise LoadFailed(
            f"'{path}' has an entry with a backslash in its name: '{name}' (FMI 2.0, 2.3: the separator is '/').",
            hint="Unpack it with a tool that accepts backslashes, and zip it again.",
        )
    kind = stat.S_IFMT(entry.external_attr >> 16)
    if kind == stat.S_IFLNK:
        raise LoadFailed(f"'{path}' has a symbolic link inside: '{name}'.")
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise LoadFailed(f"'{path}' has something inside that is neither a file nor a folder: '{name}'.")
    if entry.flag_bits & _ENCRYPTED:
        raise LoadFailed(f"'{path}' is encrypted: '{name}'.")


def _write(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, folder: Path) -> None:
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


def _refuse_large_description(path: Path, sizes: dict[str, int], limits: LimitsConfig) -> None:
    for name, size in sizes.items():
        if size > limits.description_bytes:
            raise LoadFailed(
                f"the {name} of '{path}' has {size} bytes; the limit is {limits.description_bytes}.",
                hint="If you trust it, raise `limits` in the configuration.",
            )


# --- a folder


class _Folder:
    def __init__(self, path: Path, terms: Terms) -> None:
        if terms.sha256 is not None:
            text = f"'{path}' is a folder, and `sha256` is that of an archive."
            raise LoadFailed(text, hint="Zip it, or leave it out.")
        self.path = path
        self._limits = terms.limits

    def close(self) -> None:
        """Nothing is open."""

    def contents(self) -> Contents:
        try:
            names = _names_in(self.path)
            sizes = {name: (self.path / name).stat().st_size for name in _XML_FILES if name in names}
            _refuse_large_description(self.path, sizes, self._limits)
            return Contents(names, {name: (self.path / name).read_bytes() for name in sizes})
        except OSError as error:
            raise LoadFailed(f"'{self.path}' cannot be read: {error.strerror}.") from error

    def content_sha256(self) -> str:
        try:
            return content_of(self.path)
        except OSError as error:
            raise LoadFailed(f"'{self.path}' cannot be read: {error.strerror}.") from error

    def unpack_into(self, folder: Path) -> None:
        """Give ``folder`` the layout of the FMU without writing to the FMU: binaries are copied, the rest is linked.

        Each instance has a library file of its own, so that two instances in one process share no variables of it.
        """
        for entry in self.path.resolve().iterdir():
            if entry.name == "binaries" and entry.is_dir():
                shutil.copytree(entry, folder / entry.name, copy_function=shutil.copyfile)
            else:
                (folder / entry.name).symlink_to(entry)


def _names_in(path: Path) -> frozenset[str]:
    """The names of all files, with `/` between the parts."""
    return frozenset(
        Path(parent, name).relative_to(path).as_posix() for parent, _, names in os.walk(path) for name in names
    )
