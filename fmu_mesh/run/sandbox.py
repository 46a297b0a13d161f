"""A node in a sandbox of bubblewrap: what it sees of the host, and whom it asks for what it cannot see.

Owns the command line. The node has the files of the system, of Python and of its models, which it can only read, its
place in the folder of the run, and no network, no other processes and no other user's variables. So it cannot open the
memory of the run through `/proc`: the launcher hands it the descriptor, and says whether a process of the run lives.
"""

# Who meets here: for each such node a thread "outside of NODE" of the launcher, which answers one question at a time,
# and in the node any thread (`fmu_mesh.wire.runtime.Outside`). The node may be hostile, so the thread answers only
# about processes of the run, and hands out nothing but their memory with rings. It ends when the node has: the other
# end of the pair of sockets is only there. bubblewrap is a process outside (the child of the launcher, whose number is
# that of the group) and one inside; the node is the child of the latter, and signals go to it directly. ADR 84.

from __future__ import annotations

import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

import msgspec

from .. import files
from ..config.access_sections import ZenohConfig, given_folder
from ..system.plan import NodePlan
from ..wire.host_processes import STATES, Answered, Asked, is_alive, is_stopped
from ..wire.runtime import box_of, runtime_folder
from .threads import ONE_THREAD

__all__ = ["Sandboxed", "why_no_bubblewrap", "why_no_sandbox"]

_LINKS: Final = ("/bin", "/sbin", "/lib", "/lib32", "/lib64")
_SYSTEM: Final = (
    "/usr",
    "/opt",
    *(f"/etc/{name}" for name in ("ld.so.cache", "ld.so.conf", "ld.so.conf.d", "alternatives", "localtime")),
    *(f"/etc/{name}" for name in ("passwd", "group", "nsswitch.conf", "hosts")),
)
_VARIABLES: Final = ("PATH", "LANG", "TZ", "CC", "CXX", "LD_LIBRARY_PATH", "LC_", "PYTHON", "FMU_MESH_", "COVERAGE_")
"""Variables that a node gets: these, and those that begin so."""

_TEMPORARY: Final = "/tmp"  # noqa: S108  that of the sandbox is its own
_APART: Final = ("--unshare-all", "--die-with-parent", "--proc", "/proc", "--dev", "/dev", "--tmpfs", _TEMPORARY)
_MEMORY: Final = "/memfd:fmu_mesh"
_TRY_S: Final = 5.0
_SIGNALLED: Final = 128
"""bubblewrap adds this to the number of the signal that has ended what it runs."""
_CREDENTIALS: Final = struct.Struct("3i")


def why_no_sandbox(zenoh: ZenohConfig, sandboxed: Mapping[str, bool]) -> tuple[str, str] | None:
    """Why nodes cannot run in a sandbox here, and what to do; None: they can.

    Args:
        zenoh: how the processes find each other.
        sandboxed: the instances in a sandbox, and whether each runs on another host or in another Python.
    """
    if zenoh.mode == "client" or zenoh.connect:
        return (
            f"a sandbox for '{next(iter(sandboxed))}', which has no network, with `zenoh.connect`",
            "a mesh on one host",
        )
    if (other := next((name for name, is_elsewhere in sandboxed.items() if is_elsewhere), None)) is not None:
        return f"a sandbox for '{other}', which has a `host` or an `interpreter`", "an instance without"
    return why_no_bubblewrap()


def why_no_bubblewrap() -> tuple[str, str] | None:
    """Why no sandbox can be made here, and what to do; None: one was made."""
    if (program := shutil.which("bwrap")) is None:
        return "bubblewrap, which is not installed", "`apt-get install bubblewrap`, or `sandbox: none`"
    command = [program, *_APART, *_system(), "true"]
    try:
        tried = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, check=False, text=True, timeout=_TRY_S
        )
    except subprocess.TimeoutExpired:
        return f"bubblewrap, which has not answered for {_TRY_S:g} s", "a host where it works, or `sandbox: none`"
    if tried.returncode != 0:
        said = (tried.stderr.strip().splitlines() or ["no message"])[-1]
        return f"bubblewrap, which does not work here: {said}", "a host that allows user namespaces, or `sandbox: none`"
    return None


class Sandboxed(subprocess.Popen[bytes]):
    """The process of a node in a sandbox, started from the thread of the launcher.

    Args:
        node: its plan.
        folder: that of the run, where the node has a box.
        command: what starts it without a sandbox; its last argument comes here.
        is_of_run: whether a process belongs to the run.
        security: the folder of the certificate of this host, which the node needs not; None: there is none.
    """

    def __init__(
        self,
        node: NodePlan,
        folder: Path,
        command: Sequence[str],
        is_of_run: Callable[[int], bool],
        security: str | None = None,
    ) -> None:
        self._is_of_run = is_of_run
        self._inside: int | None = None
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._control.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        box, runtime = box_of(folder, node.node), str(runtime_folder())
        prefix = ["bwrap", *_APART, *_system(), *_bound("--ro-bind", _of_models(node))]
        if (own_keys := given_folder(security)) is not None:
            prefix += _without_keys(own_keys)
        prefix += ["--perms", "0700", "--dir", runtime, *_bound("--ro-bind", [folder]), *_bound("--bind", [box])]
        own = {name: value for name, value in os.environ.items() if name.startswith(_VARIABLES)}
        own |= {"HOME": str(box), "TMPDIR": _TEMPORARY, "FMU_MESH_RUNTIME_DIR": runtime, "SPT_NOENV": "1"}
        own["FMU_MESH_CACHE_DIR"] = str(box / ".cache")  # what it compiles is for itself
        with theirs:
            super().__init__(
                [*prefix, "--remount-ro", "/", "--chdir", str(box), *command, str(theirs.fileno())],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                start_new_session=True,
                pass_fds=(theirs.fileno(),),
                env=own | ONE_THREAD,
            )
        threading.Thread(target=self._answer, name=f"outside of {node.node}", daemon=True).start()

    def poll(self) -> int | None:
        """As of any process: a signal inside is the negative number."""
        return _code(super().poll())

    def wait(self, timeout: float | None = None) -> int:
        """As `poll`, at its end."""
        super().wait(timeout)
        return self.poll() or 0

    def send_signal(self, sig: int) -> None:
        """Send a signal to the node itself, if it still runs; before it has asked anything, to its sandbox."""
        if self.poll() is None:
            with suppress(ProcessLookupError):
                os.kill(self._inside or self.pid, sig)

    def _answer(self) -> None:
        with self._control as control, suppress(OSError, msgspec.MsgspecError):
            while True:
                data, ancillary, *_ = control.recvmsg(1024, socket.CMSG_SPACE(_CREDENTIALS.size))
                if not data:
                    return
                self._inside = _CREDENTIALS.unpack(ancillary[0][2])[0]
                asked = msgspec.msgpack.decode(data, type=Asked)
                is_known = self._is_of_run(asked.pid) and is_alive(asked.pid)
                state = STATES[1 + is_stopped(asked.pid)] if is_known else STATES[0]
                answer = msgspec.msgpack.encode(Answered(self._inside, state))
                memory = _memory_of(asked) if is_known and asked.descriptor is not None else None
                socket.send_fds(control, [answer], [memory] if memory is not None else [])
                if memory is not None:
                    os.close(memory)


def _memory_of(asked: Asked) -> int | None:
    """The memory with rings that a process has open; None: it is something else."""
    place = f"/proc/{asked.pid}/fd/{asked.descriptor}"
    with suppress(OSError):
        if os.readlink(place).startswith(_MEMORY):  # noqa: PTH115  a path that is none
            return os.open(place, os.O_RDWR | os.O_CLOEXEC)
    return None


def _code(code: int | None) -> int | None:
    signalled = code is not None and _SIGNALLED < code <= _SIGNALLED + max(signal.valid_signals())
    return _SIGNALLED - code if signalled and code is not None else code


def _system() -> Iterator[str]:
    """The options for what each node may read: the system, Python, and this package."""
    for path in map(Path, _LINKS):
        yield from ("--symlink", str(path.readlink()), str(path)) if path.is_symlink() else _bound("--ro-bind", [path])
    yield from _bound("--ro-bind", map(Path, (*_SYSTEM, sys.base_prefix, sys.prefix)))
    yield from _bound("--ro-bind", [Path(__file__).parents[1]])


def _of_models(node: NodePlan) -> Iterator[Path]:
    """The files of the models of a node: an FMU alone, and of other kinds the folder, where further ones may be."""
    for item in node.instances:
        path = Path(item.fmu)
        yield (files.archive_on_the_way(path) or path) if item.section.follows_fmi else path.parent


def _without_keys(folder: Path) -> Iterator[str]:
    """The options that hide the keys of certificates, which may be in the folder of a model or below one of Python."""
    from ..wire.security.identity import CA_KEY, KEY  # noqa: PLC0415  most runs have no certificate

    real = folder.resolve()  # a link in a folder that is bound leads to where nothing is
    for key in (*real.parent.glob(f"*/{KEY}"), real.parent / CA_KEY):
        if key.exists():
            yield from ("--ro-bind", os.devnull, str(key))


def _bound(option: str, paths: Iterable[Path]) -> Iterator[str]:
    for path in paths:
        if path.is_absolute() and path.exists():
            yield from (option, str(path), str(path))
