"""The runtime folder: where the processes of a mesh on one host find each other, and where tools find meshes.

Owns the folder of a run (sockets, plans, extracted FMUs) and the note about a running mesh. The process that creates
the folder of a run also removes it, even if processes that used it were killed. Hosts and containers may share the
folder; a process id means something only on the host of the process, so nothing of another host is judged by one.
"""

from __future__ import annotations

import fcntl
import grp
import hashlib
import itertools
import os
import socket
import stat
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from errno import ENOENT
from functools import cache
from pathlib import Path
from typing import TextIO

import msgspec

from ..errors import ConfigurationError, MeshLost
from ..files import remove_tree
from .host_processes import is_alive

__all__ = [
    "MeshNote",
    "box_of",
    "enter_run_folder",
    "fmu_folder",
    "leave_run_folder",
    "leave_shared",
    "meshes",
    "remove_stale_folders",
    "rows_socket",
    "run_folder",
    "run_name",
    "runtime_folder",
    "share",
    "shared_endpoint",
    "shared_file",
    "socket_endpoint",
    "this_host",
    "tidy_run_folder",
    "why_not_shared",
    "write_note",
]

_SOCKET_PATH_LIMIT = 107
"""Of the system: 108 bytes with a zero at the end (unix(7))."""
_SOCKET = ".sock"
_ROWS = ".rows"
_FOLDER_HINT = "Set FMU_MESH_RUNTIME_DIR to a folder of your own."
_ENTRIES = 100
"""How often a process tries to enter a folder that others, who leave it, remove meanwhile."""
_NAME_LIMIT = 40
"""Largest length of a mesh's name in the name of its folder; a longer name is cut, and a hash is added."""

_runs = itertools.count(1)

_held: dict[Path, TextIO] = {}
"""The open notes of this process by the folder of their run; an open file keeps its lock."""


class MeshNote(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The content of the note about a running mesh.

    Attributes:
        endpoints: Zenoh endpoints where the master can be reached, the socket of this user first.
        pid: the process of the note: the launcher, or a master that was started manually.
        host: where it runs; other hosts may share the folder.
        security: folder of its certificate, where it can only be reached at a network; empty: it has none.
        insecure: whether its network may have no TLS.
    """

    mesh: str
    key_prefix: str
    endpoints: tuple[str, ...]
    pid: int
    config: str
    host: str = ""
    security: str = ""
    insecure: bool = False


def runtime_folder() -> Path:
    """The user's folder for running meshes, which other users cannot enter; created if it does not exist.

    Raises:
        ConfigurationError: it cannot be created, or other users can enter it.
    """
    base = Path(os.environ.get("XDG_RUNTIME_DIR") or "/nonexistent")
    if chosen := os.environ.get("FMU_MESH_RUNTIME_DIR"):
        folder = Path(chosen).absolute()
    elif base.is_dir() and base.stat().st_uid == os.getuid():  # after `su` it is that of another user
        folder = base.absolute() / "fmu_mesh"
    else:
        folder = Path(tempfile.gettempdir()) / f"fmu_mesh-{os.getuid()}"
    return _private(folder)


def run_folder(mesh: str, run: str) -> Path:
    """The folder of one run of a mesh; ``run`` is its name (see `run_name`), or `hand` if it is started manually.

    Raises:
        ConfigurationError: it cannot be created, or other users can enter it.
    """
    name = mesh
    if len(mesh) > _NAME_LIMIT:  # FMUs have long names, and the path of a socket must be short
        name = f"{mesh[: _NAME_LIMIT - 9]}-{hashlib.sha256(mesh.encode()).hexdigest()[:8]}"
    return _private(runtime_folder() / f"{name}.{run}")


def run_name() -> str:
    """A name for a run of this process: the process id, the host, and from the second run on the number of the run."""
    number = next(_runs)
    return f"{os.getpid()}-{this_host()}" + (f"-{number}" if number > 1 else "")


@cache
def this_host() -> str:
    """Six digits for all processes that see the same process ids: those of one boot of a host, or of one container."""
    facts = socket.gethostname()
    with suppress(OSError):  # the system has no /proc
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii")
        facts = f"{boot} {Path('/proc/self/ns/pid').readlink()}"
    return hashlib.sha256(facts.encode()).hexdigest()[:6]


def _launcher_of(folder: Path) -> int | None:
    """The process id of the launcher of the run that a folder belongs to; None without a launcher on this host."""
    pid, _, rest = folder.suffix.removeprefix(".").partition("-")
    return int(pid) if pid.isdigit() and rest.startswith(this_host()) else None


def why_not_shared(group: str) -> str | None:
    """Why this user cannot share a socket with a group of this host; None if it can."""
    try:
        number = grp.getgrnam(group).gr_gid
    except KeyError:
        return f"there is no group '{group}' on this host"
    if number in (os.getegid(), *os.getgroups()) or os.geteuid() == 0:
        return None
    return f"you are not a member of the group '{group}' of this host"


def shared_file(folder: Path, group: str) -> Path:
    """The socket for the members of a group, beside that of the master in the folder of a run.

    It is in a folder of its own, which they can enter: that of the run, with the plan and the FMUs, stays private.
    """
    shared = f"fmu_mesh-{os.getuid()}.{grp.getgrnam(group).gr_gid}"
    return Path(tempfile.gettempdir()) / shared / f"{folder.name}{_SOCKET}"


def shared_endpoint(folder: Path, group: str) -> str:
    """The Zenoh endpoint of `shared_file`, whose folder is made.

    Raises:
        ConfigurationError: the folder cannot be used, or its path is too long.
    """
    file = shared_file(folder, group)
    shared = _private(file.parent, others=0o027)
    os.chown(shared, -1, grp.getgrnam(group).gr_gid)
    shared.chmod(0o750)
    for other in shared.glob(f"*{_SOCKET}"):  # of a master that was killed with its launcher
        with socket.socket(socket.AF_UNIX) as probe:
            try:
                probe.connect(str(other))
            except ConnectionRefusedError:
                leave_shared(other)
            except OSError:  # it is gone meanwhile, or has too many connections
                continue
    return _endpoint_at(file)


def share(endpoint: str) -> None:
    """Let the group of the folder of a socket connect to it, once it is there."""
    file = Path(endpoint.partition("/")[2])
    os.chown(file, -1, file.parent.stat().st_gid)
    file.chmod(0o770)


def leave_shared(file: Path) -> None:
    """Remove a socket for a group, and its folder if it was the last one."""
    for own in (file, file.with_name(f"{file.name}.lock")):
        own.unlink(missing_ok=True)
    with suppress(OSError):  # others are there
        file.parent.rmdir()


def _private(folder: Path, others: int = 0o077) -> Path:
    """Create a folder with mode 0700, or check that an existing folder belongs only to this user.

    Everybody who can enter it can connect to the sockets in it, and so read and set values and end the run.
    """
    try:
        found = _made(folder)
    except OSError as error:
        raise ConfigurationError(
            f"the runtime folder '{folder}' cannot be made: {error.strerror or error}", hint=_FOLDER_HINT
        ) from error
    if stat.S_ISLNK(found.st_mode):
        raise ConfigurationError(f"the runtime folder '{folder}' is a symbolic link", hint=_FOLDER_HINT)
    if not stat.S_ISDIR(found.st_mode):
        raise ConfigurationError(f"the runtime folder '{folder}' is no folder", hint=_FOLDER_HINT)
    if found.st_uid != os.getuid():
        raise ConfigurationError(f"the runtime folder '{folder}' belongs to another user", hint=_FOLDER_HINT)
    if (mode := stat.S_IMODE(found.st_mode)) & others:
        raise ConfigurationError(
            f"the runtime folder '{folder}' is open to other users (mode {mode:04o})",
            hint=f"Close it with `chmod 700 {folder}`, or set FMU_MESH_RUNTIME_DIR to another folder.",
        )
    return folder


def _made(folder: Path) -> os.stat_result:
    """Create a folder if nothing is there; return the state of what is there.

    Until this process has a file in it, the last other process that leaves a run may remove its folder at any moment.
    """
    for _ in range(_ENTRIES):
        with suppress(FileExistsError):
            folder.mkdir(mode=0o700, parents=True)
        with suppress(FileNotFoundError):
            return folder.lstat()
    raise FileNotFoundError(ENOENT, "it is removed again and again")


def fmu_folder(folder: Path) -> Path:
    """Where this process extracts FMUs in the folder of a run."""
    return (Path(_held[folder].name).parent if folder in _held else folder) / "fmus" / _own_name(folder)


def box_of(folder: Path, node: str) -> Path:
    """The part of the folder of a run that is there for a node in a sandbox, and that only this one can write."""
    return folder / _socket_name(node).removesuffix(_SOCKET)


def _place(folder: Path, node: str) -> Path:
    """Where a node has its sockets and its note: its box, which the launcher has made, or the folder of the run."""
    box = box_of(folder, node)
    return box if box.is_dir() else folder


def _own_name(folder: Path) -> str:
    return Path(_held[folder].name).stem if folder in _held else str(os.getpid())


def enter_run_folder(folder: Path, node: str) -> None:
    """Note that this process is the node ``node`` of a run, so that others can remove its files if it is killed.

    The note is an empty file, whose name says the process and the socket: it needs no room where others have filled the
    file system with FMUs.

    Raises:
        ConfigurationError: no file can be made there.
        MeshLost: it is removed again and again.
    """
    name, socket_name = str(os.getpid()), _socket_name(node)
    for number in range(2, _ENTRIES):
        note = _place(_private(folder), node) / f"{name}.{socket_name.removesuffix(_SOCKET)}.pid"
        try:
            file = note.open("x", encoding="utf-8")
            fcntl.flock(file, fcntl.LOCK_EX)  # the lock ends with the process, however it ends
            if os.path.samestat(os.fstat(file.fileno()), note.stat()):  # nobody has removed it before it was locked
                _held[folder] = file
                return
        except FileExistsError:  # a process of another host, with which the folder is shared, has the same id
            name = f"{os.getpid()}-{number}"
        except FileNotFoundError:  # it is removed by somebody who leaves it, with the note or without
            continue
        except OSError as error:
            raise _unfit(folder, error) from error
    raise MeshLost(f"the runtime folder '{folder}' is removed again and again", hint="Does something else do that?")


def tidy_run_folder(folder: Path) -> None:
    """Remove the files of killed processes from the folder of a run."""
    try:
        notes = [*folder.glob("*.pid")]
    except FileNotFoundError:  # another process, the last one that left the run, has just removed the folder
        return
    for note in notes:
        try:
            with note.open(encoding="utf-8") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.path.samestat(os.fstat(file.fileno()), note.stat()):  # its process has not left and come again
                    _remove_traces(folder, note.stem)
        except OSError:  # its process still holds the lock, or another process was faster
            continue


def _unfit(folder: Path, error: OSError) -> ConfigurationError:
    message = f"no file can be made in the runtime folder '{folder}': {error.strerror or error}"
    return ConfigurationError(message, hint=_FOLDER_HINT)


def _remove_traces(folder: Path, name: str) -> None:
    """Remove the note of a process with its socket and its extracted FMUs."""
    remove_tree(folder / "fmus" / name)
    if (note := folder / f"{name}.pid").exists():
        used = f"{name.partition('.')[2]}{_SOCKET}"
        others = f"{used}.lock", used.replace(_SOCKET, _ROWS)  # Zenoh uses a lock file beside its socket
        for file in (folder / used, *(folder / other for other in others), note):
            file.unlink(missing_ok=True)


def leave_run_folder(folder: Path) -> None:
    """Remove the folder of a run if no process uses it any more; every process calls this when it ends."""
    _remove_traces(folder, _own_name(folder))
    if (held := _held.pop(folder, None)) is not None:
        held.close()
    tidy_run_folder(folder)
    note = _own_note(folder / "mesh.json")
    if note is not None and note.pid == os.getpid():  # the master of processes that were started manually
        (folder / "mesh.json").unlink(missing_ok=True)
    elif (launcher := note.pid if note is not None else _launcher_of(folder)) is not None:
        if not is_alive(launcher):  # it was killed, and so may be a process that has begun to remove the folder
            remove_tree(folder)
        return
    _remove_if_empty(folder)


def socket_endpoint(folder: Path, node: str) -> str:
    """The Zenoh endpoint of a node's socket in the folder of a run.

    Raises:
        ConfigurationError: the path is too long for a Unix socket.
    """
    return _endpoint_at(_place(folder, node) / _socket_name(node))


def _endpoint_at(path: Path) -> str:
    if len(os.fsencode(path)) > _SOCKET_PATH_LIMIT:
        raise ConfigurationError(
            f"'{path}' is too long for a socket ({_SOCKET_PATH_LIMIT} bytes)",
            hint="Set FMU_MESH_RUNTIME_DIR to a shorter path.",
        )
    return f"unixsock-stream/{path}"


def rows_socket(folder: Path, node: str) -> Path:
    """The socket where a node waits for row streams, in the folder of a run."""
    return _place(folder, node) / _socket_name(node).replace(_SOCKET, _ROWS)


def _socket_name(node: str) -> str:
    return f"{hashlib.sha256(node.encode()).hexdigest()[:8]}{_SOCKET}"


def write_note(folder: Path, note: MeshNote) -> None:
    """Write the note of a running mesh atomically, so that no reader gets an incomplete one.

    Raises:
        ConfigurationError: the folder has no room any more.
    """
    temporary = folder / "mesh.json.new"
    note = msgspec.structs.replace(note, host=this_host())
    try:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(note)))
        temporary.replace(folder / "mesh.json")
    except OSError as error:
        raise _unfit(folder, error) from error


def meshes() -> Iterator[MeshNote]:
    """The meshes of this user on this host; also removes folders whose process is gone."""
    for file in sorted(runtime_folder().glob("*/mesh.json")):
        note = _own_note(file)
        if note is not None and is_alive(note.pid):
            yield note
        elif note is not None:
            remove_tree(file.parent)


def remove_stale_folders() -> None:
    """Remove the folders of runs whose process is gone, and which their other processes could not remove."""
    for _ in meshes():
        continue
    for folder in runtime_folder().glob("*.*"):
        if folder.suffix == ".hand":
            tidy_run_folder(folder)
            _remove_if_empty(folder)
        elif (pid := _launcher_of(folder)) is not None and not (folder / "mesh.json").exists() and not is_alive(pid):
            remove_tree(folder)  # it was killed before it wrote a note, or runs without one


def _remove_if_empty(folder: Path) -> None:
    fmus = folder / "fmus"
    with suppress(OSError):  # another process still uses it, or has removed it
        if any(entry != fmus for entry in folder.iterdir()):
            return
        if fmus.exists():
            fmus.rmdir()
        folder.rmdir()


def _own_note(file: Path) -> MeshNote | None:
    """A note of this host; None if there is none, or one of a host with which the folder is shared."""
    try:
        note = msgspec.json.decode(file.read_bytes(), type=MeshNote)
    except (OSError, msgspec.DecodeError):
        return None
    return note if note.host == this_host() else None
