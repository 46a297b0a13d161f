"""All nodes of one host, started there by one command: `fmu-mesh node CONFIG --host NAME`.

Each node is a process as if it were started manually on its own. This module starts them, passes on what they write,
and ends when they have ended. Which other hosts there are, and who starts those, it does not know.
"""

# Who meets here (ADR 71): the main thread, which waits for the queue, and the threads of each `Child`, which only put
# functions into it. So does the handler of SIGINT and SIGTERM. The nodes have sessions of their own, so Ctrl-C reaches
# only this process; the kernel ends them with its main thread, which has started them (`die_with_parent`).
#
# What may go wrong: a node fails before the master knows it, so nobody tells the others. They get some time to end by
# themselves, because what the master says of a failure is more than what can be known here.

from __future__ import annotations

import queue
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Final

from ..errors import ConfigurationError, FmuError, FmuMeshError, Interrupted, MeshLost
from ..text import did_you_mean, listed
from .child import Child, how_it_ended
from .fork_server import executed
from .run_plan import RunPlan

__all__ = ["nodes_on", "run_nodes"]

_OTHERS_S: Final = 10.0
"""How long the other nodes may take to end by themselves after one has failed, and again after SIGTERM."""
_CODES: Final = (ConfigurationError.exit_code, FmuError.exit_code, FmuMeshError.exit_code, MeshLost.exit_code)
"""The exit codes of failures, the one that says most first."""


def nodes_on(run: RunPlan, host: str) -> list[str]:
    """The names of the nodes that run on a host of `deploy.hosts`.

    Raises:
        ConfigurationError: there is no such host, or it has no nodes.
    """
    hosts = run.loaded.config.deploy.hosts
    if host not in hosts:
        known = f"There are {listed(list(hosts))}." if hosts else "`deploy.hosts` has no entry."
        raise ConfigurationError(f"there is no host '{host}'", hint=did_you_mean(host, hosts, known))
    names = [name for name, node in run.plan.nodes.items() if node.host == host]
    if not names:
        raise ConfigurationError(f"host '{host}' has no nodes", hint="An instance with this `host` has its node there.")
    return names


def run_nodes(run: RunPlan, names: Sequence[str], tell: Callable[[str], None]) -> int:
    """Run several nodes of a mesh, each in a process, until all have ended.

    Args:
        run: the plan of the run.
        names: of the nodes.
        tell: called with each line that a node writes, after its name, on this thread, which has to be the main one.

    Returns:
        The exit code: 130 if this process was asked to end, otherwise 0 or that of the failure that says most.
    """
    happened: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()

    def start(name: str) -> Child:
        process = executed("node", file, name, interpreter=run.plan.nodes[name].interpreter)
        return Child(name, process, happened.put)

    nodes = _Nodes(tell, start, run.loaded.config.recovery.restarts)
    with TemporaryDirectory(prefix="fmu_mesh-") as folder, _signals(lambda: happened.put(nodes.interrupt)):
        file = str(run.write(Path(folder)))
        for name in names:
            nodes.start(name)
        while nodes.running:
            try:
                happened.get(timeout=nodes.wait_s)()
            except queue.Empty:
                nodes.end()
    return nodes.code


class _Nodes:
    """The processes of the nodes; all of it is called on one thread."""

    def __init__(self, tell: Callable[[str], None], start: Callable[[str], Child], restarts: int) -> None:
        self._tell, self._start, self._restarts = tell, start, restarts
        self._children: dict[str, Child] = {}
        self._codes: dict[str, int] = {}
        self._until: float | None = None
        self._signals: Iterator[signal.Signals] = iter((signal.SIGTERM, signal.SIGKILL))
        self._asked = False

    def start(self, name: str) -> None:
        """Start a node, pass on what it writes, and note its end."""
        self._children[name] = child = self._start(name)
        child.watch(partial(self._line, name), self._line, self._ended, limited=True)

    @property
    def running(self) -> bool:
        """Whether a node has not ended."""
        return len(self._codes) < len(self._children)

    @property
    def wait_s(self) -> float | None:
        """How long to wait until `end` is due; None: until something happens."""
        return max(0.0, self._until - time.monotonic()) if self._until is not None else None

    @property
    def code(self) -> int:
        """The exit code of all."""
        if self._asked:
            return Interrupted.exit_code
        codes = {code if code >= 0 else MeshLost.exit_code for code in self._codes.values()}
        return next((code for code in _CODES if code in codes), max(codes))

    def interrupt(self) -> None:
        """Somebody asks for the end; the second time, the nodes have no time for it."""
        self._asked = True
        self.end()

    def end(self) -> None:
        """Ask those that run to end: first by SIGTERM, then by SIGKILL."""
        number = next(self._signals, signal.SIGKILL)
        self._until = time.monotonic() + _OTHERS_S
        for name in self._running:
            self._children[name].signal(number)

    @property
    def _running(self) -> Iterable[str]:
        return [name for name in self._children if name not in self._codes]

    def _line(self, name: str, line: bytes) -> None:
        if text := line.decode(errors="replace").rstrip():
            self._tell(f"{name} | {text}")

    def _ended(self, name: str, code: int) -> None:
        self._children[name].close()
        is_lost = code < 0 and not self._asked
        if is_lost:
            self._tell(f"node '{name}' was lost: its process {how_it_ended(code)}")
        if is_lost and self._restarts and self._until is None:  # for the next attempt, as the others
            self._restarts -= 1
            self.start(name)
            return
        self._codes[name] = code
        if code != 0 and self._until is None:
            self._until = time.monotonic() + _OTHERS_S


@contextmanager
def _signals(asked: Callable[[], None]) -> Iterator[None]:
    """Inside, SIGINT and SIGTERM call a function, which may be called at any place of this thread."""

    def handle(_number: int, _frame: FrameType | None) -> None:
        asked()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
