"""The files of an FMU: a ZIP archive from anywhere, or a folder that somebody unpacked.

Owns the protection against hostile archives, and the private folder that an instance lives in. That folder is laid out
like the FMU and always safe to remove: where the FMU is a folder, it holds copies of the binaries and links to the
rest. It is made below a folder that is handed in, so that it is removed even when the process that used it was killed.
Knows nothing of what the files mean; that is `fmu_mesh.instances.fmi.archive.examining`.
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
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path, PurePosixPath
from typing import Final

import msgspec

from .... import files
from ....config.mesh import LimitsConfig
from ....errors import LoadFailed

__all__ = ["Contents", "Terms", "content_of", "look_into", "sha256_of", "unpack"]

_HARMLESS_BYTES: Final = 64 * 2**20
"""An archive that unpacks to less is no bomb, however well it compresses."""

_CHUNK: Final = 2**20
_ENCRYPTED: Final = 0x1
_XML_FILES: tuple[str, ...] = ("modelDescription.xml", "sources/buildDescription.xml")


class Terms(msgspec.Struct, frozen=True):
    """What an FMU has to keep to before anything of it is used.

    Attributes:
        sha256: the SHA-256 that the archive must have, as hexadecimal digits.
    """

    limits: LimitsConfig = LimitsConfig()
    sha256: str | None = None


class Contents(msgspec.Struct, frozen=True):
    """What is in an FMU.

    Attributes:
        names: of all files, with `/` between the parts.
        xml: the XML files that tell what the FMU is, by name.
    """

    names: frozenset[str]
    xml: dict[str, bytes]


def look_into(path: Path, terms: Terms = Terms()) -> Contents:  # noqa: B008 a frozen Struct
    """The names and the descriptions in the FMU at ``path``; unpacks nothing.

    Raises:
        LoadFailed: there is no FMU, or it breaks the terms.
    """
    if files.is_folder(path):
        _refuse_sha256_of_folder(path, terms)
        try:
            return _look_into_folder(path, terms.limits)
        except OSError as error:
            raise LoadFailed(f"'{path}' cannot be read: {error.strerror}.") from error
    with _opened(path, terms) as archive:
        entries = {_name(entry): entry for entry in archive.infolist() if not entry.is_dir()}
        present = [name for name in _XML_FILES if name in entries]
        _refuse_large_description(path, {name: entries[name].file_size for name in present}, terms.limits)
        return Contents(frozenset(entries), {name: archive.read(entries[name]) for name in present})


def sha256_of(path: Path) -> str | None:
    """The SHA-256 of an archive as hexadecimal digits; None for a folder."""
    return None if files.is_folder(path) else files.sha256_of(path)


def content_of(path: Path) -> str:
    """A SHA-256 that tells an FMU from any other: of its archive, or of the names and contents of a folder's files."""
    if not files.is_folder(path):
        return files.sha256_of(path)
    digest = hashlib.sha256()
    for name in sorted(_names_in(path)):
        digest.update(f"{files.sha256_of(path / name)} {name}\0".encode(errors="surrogateescape"))
    return digest.hexdigest()


@contextmanager
def unpack(path: Path, parent: Path, terms: Terms = Terms()) -> Iterator[Path]:  # noqa: B008 a frozen Struct
    """Unpack the FMU at ``path`` into a new private folder below ``parent``.

    The folder is given while it still has another name; it takes its own (the same without `.part`) when the block
    ends without an exception, in one step, and is removed otherwise. So no reader sees half of an FMU.

    Raises:
        LoadFailed: the archive is broken, or breaks the terms; nothing is left behind.
    """
    try:
        parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f"{path.stem[:40]}-", suffix=".part", dir=parent))
    except OSError as error:
        raise LoadFailed(f"'{path}' cannot be extracted into '{parent}': {error.strerror}") from error
    try:
        if files.is_folder(path):
            _refuse_sha256_of_folder(path, terms)
            _link_folder(path, partial)
        else:
            with _opened(path, terms) as archive:
                for entry in archive.infolist():
                    _write(archive, entry, partial)
        yield partial
        partial.rename(partial.with_suffix(""))
    except OSError as error:
        raise LoadFailed(f"'{path}' cannot be extracted: {error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


# --- an archive


@contextmanager
def _opened(path: Path, terms: Terms) -> Iterator[zipfile.ZipFile]:
    """The archive, if it keeps to the terms; what breaks while it is read is a `LoadFailed`, too."""
    try:
        with path.open("rb") as file:
            _verify(path, file, terms.sha256)
            with zipfile.ZipFile(file) as archive:
                _check(path, archive, terms.limits)
                yield archive
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
    except (RuntimeError, ValueError) as error:  # what `zipfile` has for entries that it does not know how to read
        raise LoadFailed(f"'{path}' cannot be extracted: {error}") from error


def _verify(path: Path, file: BufferedReader, expected: str | None) -> None:
    if expected is None:
        return
    found = hashlib.file_digest(file, "sha256").hexdigest()
    if found != expected.lower():
        raise LoadFailed(
            f"'{path}' has the SHA-256 {found}, not {expected.lower()}, which the configuration asks for.",
            hint="It is another file, or was changed. If it is the right one, correct `sha256`.",
        )


def _check(path: Path, archive: zipfile.ZipFile, limits: LimitsConfig) -> None:
    """Whether everything in an archive may be unpacked.

    Raises:
        LoadFailed: what breaks a limit or would leave the folder.
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
    """The name of an entry, without the `./` that some tools write before it, or for the folder of the FMU itself."""
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
            hint="Unpack it with a tool that bears with that, and zip it again.",
        )
    kind = stat.S_IFMT(entry.external_attr >> 16)
    if kind == stat.S_IFLNK:
        raise LoadFailed(f"'{path}' has a symbolic link inside: '{name}'.")
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise LoadFailed(f"'{path}' has something inside that is neither a file nor a folder: '{name}'.")
    if entry.flag_bits & _ENCRYPTED:
        raise LoadFailed(f"'{path}' is encrypted: '{name}'.")


def _write(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, folder: Path) -> None:
    """Unpack one entry, never more of it than was announced, for this user only."""
    target = folder / PurePosixPath(entry.filename)
    if entry.is_dir():
        target.mkdir(parents=True, exist_ok=True)
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    executable = (entry.external_attr >> 16) & stat.S_IXUSR
    with archive.open(entry) as source, target.open("xb") as file:
        shutil.copyfileobj(source, file, _CHUNK)  # `ZipExtFile` ends at the announced size
    target.chmod(0o700 if executable else 0o600)


def _refuse_large_description(path: Path, sizes: dict[str, int], limits: LimitsConfig) -> None:
    for name, size in sizes.items():
        if size > limits.description_bytes:
            raise LoadFailed(
                f"the {name} of '{path}' has {size} bytes; the limit is {limits.description_bytes}.",
                hint="If you trust it, raise `limits` in the configuration.",
            )


# --- a folder


def _look_into_folder(path: Path, limits: LimitsConfig) -> Contents:
    names = _names_in(path)
    sizes = {name: (path / name).stat().st_size for name in _XML_FILES if name in names}
    _refuse_large_description(path, sizes, limits)
    return Contents(names, {name: (path / name).read_bytes() for name in sizes})


def _names_in(path: Path) -> frozenset[str]:
    """The names of all files, with `/` between the parts."""
    return frozenset(
        Path(parent, name).relative_to(path).as_posix() for parent, _, names in os.walk(path) for name in names
    )


def _refuse_sha256_of_folder(path: Path, terms: Terms) -> None:
    if terms.sha256 is not None:
        raise LoadFailed(f"'{path}' is a folder, and `sha256` is that of an archive.", hint="Zip it, or leave it out.")


def _link_folder(source: Path, target: Path) -> None:
    """Lay ``target`` out like ``source`` without writing into it: binaries as copies, everything else as links.

    A copy of a library of its own keeps the variables of two instances in one process apart.
    """
    for entry in source.resolve().iterdir():
        if entry.name == "binaries" and entry.is_dir():
            shutil.copytree(entry, target / entry.name, copy_function=shutil.copyfile)
        else:
            (target / entry.name).symlink_to(entry)
