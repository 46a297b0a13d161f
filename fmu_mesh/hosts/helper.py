"""What runs on another host behind ssh for a launcher: `python -Pu -m fmu_mesh.hosts.helper MESH LINK_S`.

It has a folder of the run and a fork server of its own, starts nodes, passes on what they write, and ends them where
the launcher is gone: at the end of its standard input, where nobody reads what it writes, with another parent, or after
a silence of LINK_S seconds.
"""

# Threads: the main one starts the nodes, which end with it, and alone has their state. `frames` reads what the launcher
# sends, and answers at once that this process lives, whatever the main one does. Those of `Child` and a signal handler
# put functions into the same queue. All write frames, one at a time.
#
# What may go wrong: this process is killed: the fork server, and with it the nodes, get a signal of the kernel. It is
# stopped: it does not answer, so the launcher ends the connection; the nodes lose their link to the master, wake this
# process, and ask it to end (`fmu_mesh.run.process`). ssh passes no signal on, but sshd closes standard input. ADR 85.

from __future__ import annotations

import os
import queue
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Final

import msgspec

from .. import __version__
from ..awake import AwakeClock
from ..errors import FmuMeshError, LoadFailed
from ..files import remove_tree
from ..run.child import Child, Process
from ..run.fork_server import ForkServer, executed
from ..wire.runtime import remove_stale_folders, run_folder, run_name
from . import helper_frames as frames
from .cache import Cache

__all__ = ["main"]

_LOOK_S: Final = 0.25
_LOOK_AT_END_S: Final = 0.02
_GRACES_S: Final = ((signal.SIGTERM, 1.5), (signal.SIGKILL, 1.0))
"""How long nodes may take to end after each signal, if the launcher is gone."""


class _Helper:
    """The helper, on its main thread."""

    def __init__(self, mesh: str, link_s: float, output: int) -> None:
        self._mesh, self._link_s, self._output = mesh, link_s, output
        self._writing = threading.Lock()
        self._happened: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._is_over = self._heard = self._forgets = False
        self._journals: Path | None = None
        self._parent = os.getppid()
        self._children: dict[str, Child] = {}
        self._trees: dict[str, dict[str, str]] = {}
        self._cache = Cache()
        self._run = run_name()
        self._server = ForkServer()
        self._watch("", self._server.process)

    def run(self) -> None:
        """Serve the launcher until it is gone."""
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, lambda *_: self._happened.put(self._leave))
        os.write(self._output, frames.MAGIC)
        ends = [*os.environ.get("SSH_CONNECTION", "").split(), "", "", ""]  # address and port of ssh, then of sshd
        address = ends[2] if ends[2] != "UNKNOWN" else ""  # of an sshd behind a pipe
        this = frames.this_system()
        self._say(frames.HelperHello(__version__, *this, self._run, os.getpid(), str(self._cache.trees), address))
        threading.Thread(target=self._read, name="frames", daemon=True).start()
        folder: Path | None = None
        try:
            from ..run.process import die_with_parent  # noqa: PLC0415  imported while the launcher is busy

            die_with_parent()
            remove_stale_folders()
            folder = self._folder = run_folder(self._mesh, self._run)
            self._serve()
        except FmuMeshError as error:
            self._say(frames.CannotGoOn(error.message, error.hint or ""))
        except OSError as error:
            text = f"'{error.filename or self._cache.folder}' cannot be used: {error.strerror or error}"
            self._say(frames.CannotGoOn(text, "Make room there."))
        finally:
            self._end()
            self._cache.close()
            if self._forgets and self._journals is not None:
                remove_tree(self._journals)
            if folder is not None:
                remove_tree(folder)

    def _serve(self) -> None:
        clock = AwakeClock()
        heard_at = clock()
        while not self._is_over:
            with suppress(queue.Empty):
                self._happened.get(timeout=_LOOK_S)()
            now = clock()
            if self._heard:
                self._heard, heard_at = False, now
            if now - heard_at > self._link_s or os.getppid() != self._parent:
                self._leave()

    def _leave(self) -> None:
        self._is_over = True

    def _say(self, message: frames.FromHelper) -> None:
        """From any thread."""
        data = memoryview(frames.framed(message))
        try:
            with self._writing:
                while data:
                    data = data[os.write(self._output, data) :]
        except OSError:  # the launcher is gone
            self._happened.put(self._leave)

    def _read(self) -> None:
        reader = frames.FrameReader(0)
        try:
            while (content := reader.next()) is not None:
                self._heard = True
                self._say(frames.Alive())
                if content:
                    self._happened.put(partial(self._take, msgspec.msgpack.decode(content, type=frames.ToHelper)))
        finally:
            self._happened.put(self._leave)

    def _take(self, message: frames.ToHelper) -> None:
        if self._is_over:
            return
        match message:
            case frames.OfferTrees(trees):
                self._trees = trees
                (door := socket.socket(socket.AF_UNIX)).bind(str(self._folder / frames.PROBE))
                door.listen()
                threading.Thread(target=self._answer_probe, args=(door,), name="probe", daemon=True).start()
                self._say(frames.Missing(self._cache.missing(trees), str(self._folder)))
            case frames.FilePiece(content, data, last):
                self._cache.take(content, data, last=last)
            case frames.Prepare(plan, nodes, terms, journals, is_first):
                self._cache.make(self._trees)
                self._journals = self._cache.journals(journals, are_new=is_first)
                self._file = self._folder / "run.plan"
                self._file.write_bytes(plan)
                mark = self._cache.mark(f"{terms} {__version__} {sys.version} {sys.prefix}")
                problems = tuple(self._problems(nodes)) if not mark.exists() else ()
                if not problems:
                    mark.touch()
                self._say(frames.Ready(problems))
            case frames.StartNode(node, interpreter):
                self._start(node, interpreter)
            case frames.SignalNode(node, number):
                self._children[node].signal(signal.Signals(number))
            case frames.Forget():
                self._forgets = True

    @staticmethod
    def _answer_probe(door: socket.socket) -> None:
        with door, suppress(OSError), door.accept()[0] as tried:
            tried.send(b"1")

    def _problems(self, nodes: Sequence[str]) -> Iterator[tuple[str, str, str]]:
        """What instances miss here: each model is described as when the run was planned."""
        from ..config.findings import Findings  # noqa: PLC0415  all of these are slow, and often not needed
        from ..instances.registry import check_engines, describe  # noqa: PLC0415  as above
        from ..run.run_plan import read_node  # noqa: PLC0415  as above

        for run in (read_node(self._file, node) for node in nodes):
            for item in run.plan.instances:
                path, limits, findings = Path(item.fmu), run.plan.limits, Findings(self._mesh)
                try:
                    model = path, describe(path, item.section, limits)
                    check_engines({item.name: item.section}, {item.name: model}, limits, findings)
                except LoadFailed as error:
                    yield item.name, error.message, error.hint or ""
                yield from ((item.name, own.found, f"Expected {own.expected}") for own in findings)

    def _start(self, node: str, interpreter: str | None) -> None:
        if interpreter is not None:
            from ..run.one_process import is_other_python  # noqa: PLC0415  as above

            if is_other_python(interpreter):
                self._watch(node, executed("node", str(self._file), node, interpreter=interpreter))
                return
        self._watch(node, self._server.fork(self._mesh, "node", str(self._file), node))

    def _watch(self, node: str, process: Process) -> None:
        self._children[node] = child = Child(node, process, self._happened.put)
        child.watch(
            lambda line: self._say(frames.Line(node, line, error=False)),
            lambda _, line: self._say(frames.Line(node, line, error=True)),
            lambda _, code: self._say(frames.Ended(node, code)) if not self._is_over else None,
            limited=True,
        )

    def _end(self) -> None:
        """End all nodes, and the fork server."""
        clock = AwakeClock()
        self._leave()
        self._server.finish()
        for number, grace_s in _GRACES_S:
            end = clock() + grace_s
            for child in self._children.values():
                child.signal(number)
            while any(child.running for child in self._children.values()) and clock() < end:
                with suppress(queue.Empty):
                    self._happened.get(timeout=_LOOK_AT_END_S)()
        for child in self._children.values():
            child.close()
        self._server.close()


def main() -> int:
    """Be a helper, with the arguments of the module."""
    output = os.dup(1)
    os.dup2(2, 1)  # what is printed must not be among the frames
    _Helper(sys.argv[1], float(sys.argv[2]), output).run()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
