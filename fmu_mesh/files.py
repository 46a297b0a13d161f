"""Files with a single writer that stay unchanged until the first write; hashes of files.

Knows nothing of their format. A run opens and locks its result file at its start: a path that cannot be written and a
second run are refused before the first point. It writes from the first point on:

* An existing file is opened and locked, and truncated by the first write. It stays the same file: permissions, owner,
  links and a `tail -f` keep working, also in a read-only folder.
* A new file begins as an empty `<name>.starting` beside it, which is locked, too, and is renamed by the first write. A
  run that ends earlier removes it; if the run was killed, the next one removes it.
* A device or a pipe is written directly.

`docs/adr/0050-a-result-replaces-the-last-one-at-its-first-point.md` says why.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader, FileIO
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple, TypeVar, cast

import msgspec

from .errors import ConfigurationError

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

__all__ = [
    "CACHE_HINT",
    "ELSEWHERE",
    "Kept",
    "OwnFile",
    "archive_on_the_way",
    "below",
    "beside",
    "cache_folder",
    "cloned",
    "decoded_json",
    "exists",
    "is_file",
    "is_folder",
    "known_sha256",
    "open_alone",
    "opened",
    "remember_sha256",
    "remove_tree",
    "replaced",
    "sha256_of",
    "sha256_of_open",
    "unwritable",
    "version_at",
    "version_of",
    "write_whole",
]

T = TypeVar("T")

FileVersion = tuple[int, int, int, int]
"""What changes if a file changes."""

CACHE_HINT = "Set FMU_MESH_CACHE_DIR to a folder that can be written."
ELSEWHERE = ".elsewhere"
_DRAFT = ".starting"
_FICLONE = 0x40049409
_TRIES = 10
"""Attempts to open a file that other processes rename or remove at the same time."""

_hashes: dict[tuple[FileVersion, str], str] = {}
"""The SHA-256 of files that this process has read, and of files inside archives."""


class Kept(NamedTuple):
    """The part of a file that survives the death of its process: ``rows`` in the first ``size`` bytes."""

    rows: int = 0
    size: int = 0


def exists(path: Path) -> bool:
    """Whether the path exists.

    Unlike those of `Path`, this and the two below return False if the path cannot be examined: a name that is too
    long, or a folder without permission. Opening the path then raises the error with its reason.
    """
    return os.path.exists(path)  # noqa: PTH110 see above


def is_file(path: Path) -> bool:
    """Whether the path is a file."""
    return os.path.isfile(path)  # noqa: PTH113 see `exists`


def is_folder(path: Path) -> bool:
    """Whether the path is a folder."""
    return os.path.isdir(path)  # noqa: PTH112 see `exists`


def beside(file: Path, relative: str) -> Path:
    """The absolute path that a relative path in ``file`` means.

    Links in the folder are resolved, the last part is not: `/dev/stdout` stays `/dev/stdout`. From a file inside an
    archive, `..` leads out of the archive, to what is beside it where it was named, which may be a link.
    """
    path = file.absolute().parent / relative
    if archive_on_the_way(file) is not None:
        path = Path(os.path.normpath(path))
    return path.parent.resolve() / path.name


def cache_folder() -> Path:
    """The user's cache folder: ``$FMU_MESH_CACHE_DIR``, or else a folder below ``$XDG_CACHE_HOME``."""
    if chosen := os.environ.get("FMU_MESH_CACHE_DIR"):
        return Path(chosen)
    from platformdirs import user_cache_path  # noqa: PLC0415 only FMUs of sources need it

    return user_cache_path("fmu_mesh")


def opened(path: Path) -> BufferedReader[FileIO]:
    """A file that somebody has named, open for reading.

    Raises:
        OSError: it cannot be opened; or it is a pipe or a device, which may have no end.
    """
    # A pipe would wait for a writer.
    file = BufferedReader(FileIO(path, opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)))
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(errno.EINVAL, "it is a pipe or a device, and no file", str(path))
    return file


def decoded_json(data: bytes | str, type_: type[T], dec_hook: Callable[[type, Any], Any] | None = None) -> T:
    """JSON that somebody else has written; ``dec_hook`` as for `msgspec.json.decode`.

    Raises:
        ValueError: it is not JSON of that type.
    """
    try:
        return msgspec.json.decode(data, type=type_, dec_hook=dec_hook)
    # msgspec does not catch exceptions of Python itself, such as UnicodeDecodeError.
    except (msgspec.MsgspecError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(str(error)) from error


def open_alone(path: Path, result: Path | None = None) -> OwnFile:
    """Open a result file for a single writer: two runs of one configuration would mix their rows.

    Args:
        path: the file. Its folder is created; its content stays until the first write.
        result: the result file that errors name, if the run makes it of this one.

    Raises:
        ConfigurationError: another run writes it, or it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return OwnFile(path)
    except BlockingIOError as error:
        hint = "Wait for its end, or choose another file with `output=...`."
        raise ConfigurationError(f"another run is writing the result file '{result or path}'", hint=hint) from error
    except OSError as error:
        hint, archive = "Choose another file with `output=...`.", archive_on_the_way(result or path)
        if archive is not None:
            hint = f"'{archive}' is a file, and no folder. {hint}"
        text = f"the result file '{result or path}' cannot be written: {error.strerror}"
        raise ConfigurationError(text, hint=hint) from error


def unwritable(path: Path, error: OSError) -> ConfigurationError:
    """The error for a result file that could be opened, but not be written to its end."""
    return ConfigurationError(
        f"the result file '{path}' cannot be written: {error.strerror}",
        hint="The run has ended there. Free some disk space, or choose another file with `output=...`.",
    )


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """A path for writing a file that is useless until it is complete; the end of the block renames it to ``path``.

    After an error in the block an older file stays unchanged. A device or a pipe is written directly.

    Example:
        >>> with replaced(Path("angles.svg")) as draft:
        ...     _ = draft.write_text("<svg/>")
        >>> Path("angles.svg").read_text()
        '<svg/>'
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        yield path
        return
    draft = target.with_name(f"{target.stem}.unfinished{path.suffix}")
    try:
        yield draft
        draft.replace(target)
    finally:
        draft.unlink(missing_ok=True)


def write_whole(path: Path, content: str | bytes, what: str = "", *, make_folder: bool = False) -> None:
    """Write a file in the place of an older one; ``what`` is in front of its name in the error.

    Raises:
        ConfigurationError: it cannot be written; the older one is as it was.
    """
    try:
        if make_folder:
            path.parent.mkdir(parents=True, exist_ok=True)
        with replaced(path) as draft:
            draft.write_bytes(content if isinstance(content, bytes) else content.encode())
    except OSError as error:
        raise ConfigurationError(f"{what}'{path}' cannot be written: {error.strerror}") from error


def remove_tree(folder: Path) -> None:
    """Remove a folder with all that is in it, and the folders elsewhere that links of their names lead to.

    Never raises. A link of this kind is called as the folder, with `ELSEWHERE` behind; other links are not followed.
    """
    with suppress(OSError):
        for link in folder.glob(f"**/*{ELSEWHERE}"):
            if link.is_symlink() and link.name == f"{(target := link.readlink()).name}{ELSEWHERE}":
                shutil.rmtree(target, ignore_errors=True)
    shutil.rmtree(folder, ignore_errors=True)


def cloned(source: str, target: str) -> None:
    """Copy a file; where the file system can, both share their blocks until one of them is written to."""
    with open(source, "rb") as of, open(target, "xb") as to:  # noqa: PTH123 as `shutil.copytree` calls it
        try:
            fcntl.ioctl(to, _FICLONE, of.fileno())
        except OSError:
            shutil.copyfileobj(of, to)
    shutil.copymode(source, target)


def archive_on_the_way(path: Path) -> Path | None:
    """The file that a path leads into, such as `system.ssp` for `system.ssp/resources/a.fmu`.

    None if something is at the path itself, or if no part of it is a file.
    """
    return None if exists(path) else next((parent for parent in path.parents if is_file(parent)), None)


def below(folder: Path) -> list[Path]:
    """All files below a folder, but hidden ones and the byte code of Python."""
    found: list[Path] = []
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith(".") and name != "__pycache__")
        own = (Path(place) / name for name in sorted(names) if not name.startswith("."))
        found += [file for file in own if file.is_file()]
    return found


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file in hexadecimal digits; it is calculated once per process, unless the file changes."""
    if (known := known_sha256(version_at(path))) is not None:
        return known
    with path.open("rb") as file:
        return sha256_of_open(file)


def sha256_of_open(file: IO[bytes], *, again: bool = False) -> str:
    """As `sha256_of`, for a file that is open; ``again``: read it even if its hash is known. Moves its position."""
    version = version_of(file)
    known = None if again else known_sha256(version)
    if known is None:
        file.seek(0)
        known = hashlib.file_digest(cast("BufferedReader", file), "sha256").hexdigest()
        remember_sha256(version, "", known)
    return known


def version_at(path: Path) -> FileVersion:
    """What changes if the file at a path changes.

    Raises:
        OSError: it cannot be examined.
    """
    return _version(path.stat())


def version_of(file: IO[bytes]) -> FileVersion:
    """As `version_at`, for a file that is open."""
    return _version(os.fstat(file.fileno()))


def known_sha256(version: FileVersion, inside: str = "") -> str | None:
    """The SHA-256 of a file, or of the file at the path ``inside`` of it, if this process has calculated it."""
    return _hashes.get((version, inside))


def remember_sha256(version: FileVersion, inside: str, sha256: str) -> None:
    """Remember the SHA-256 of a file, or of the file at the path ``inside`` of it."""
    _hashes[version, inside] = sha256


class OwnFile(FileIO):
    """An open file with a single writer, from `open_alone`.

    After a failed write all later ones fail, too, even if the disk has room again: the file never has a gap.

    Attributes:
        size: bytes written so far.
    """

    def __init__(self, path: Path) -> None:
        descriptor, self._draft = _open_locked(path)
        super().__init__(descriptor, "wb")
        self._untouched = stat.S_ISREG(os.fstat(descriptor).st_mode)
        self._failure: OSError | None = None
        self.size = 0

    def write(self, data: ReadableBuffer, /) -> int:
        """Write bytes; returns how many were written, which may be fewer than given."""
        if self._failure is not None:
            raise self._failure
        try:
            if self._untouched:
                self._begin()
            written = super().write(data)
        except OSError as error:
            self._failure = error
            raise
        self.size += written
        return written

    def append_after(self, size: int) -> None:
        """The next write goes after the first ``size`` bytes, which stay; what follows them is cut off."""
        self._untouched, self.size = False, size
        self.truncate(size)
        self.seek(size)

    def close(self) -> None:
        """Close the file; if nothing was written, an older file is unchanged and no new one appears."""
        if not self.closed and self._untouched and self._draft is not None:
            with suppress(OSError):
                self._draft.unlink()
        super().close()

    def _begin(self) -> None:
        self._untouched = False
        if self._draft is not None:
            self._draft.rename(str(self._draft).removesuffix(_DRAFT))
        self.truncate(0)


def _version(status: os.stat_result) -> FileVersion:
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def _open_locked(path: Path) -> tuple[int, Path | None]:
    """The descriptor of a file, and the path of its draft if the file does not exist yet.

    Raises:
        BlockingIOError: another process has locked it.
        OSError: it cannot be opened.
    """
    draft = Path(f"{os.path.realpath(path)}{_DRAFT}")
    for _ in range(_TRIES):
        try:
            descriptor, is_draft = os.open(path, os.O_WRONLY | os.O_CLOEXEC), False
        except FileNotFoundError:
            flags = os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
            descriptor, is_draft = os.open(draft, flags, 0o666), True
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                return descriptor, None
            _lock(descriptor)
            if _is_at(draft if is_draft else path, descriptor):
                if not is_draft:
                    _remove(draft)
                    return descriptor, None
                if not path.exists():
                    return descriptor, draft
                draft.unlink()  # another run has started meanwhile and renamed its own draft
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
    raise BlockingIOError


def _lock(descriptor: int) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:
        return  # the file system has no locks


def _is_at(path: Path, descriptor: int) -> bool:
    """Whether the open file is still the one at the path, and was not renamed or removed."""
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _remove(draft: Path) -> None:
    """Remove the draft of a run that was killed."""
    with suppress(OSError), draft.open("r+b") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        draft.unlink()
