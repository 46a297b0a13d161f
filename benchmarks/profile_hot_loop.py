"""Where the time of a node goes: `python -m benchmarks.profile_hot_loop [pendulum|chain2|cycle2|group] [--window N]`.

Runs a master and the nodes of a job, with clocks around what the hot loop calls: the FMU (through ctypes), sending and
receiving (zenoh's Python binding), and waiting for a message. What remains of the loop's time is Python. The clocks
cost about 0.2 us per call, so that the loop is a little slower than without. The time on the processor tells what the
main thread used and what zenoh's own threads used; it stays meaningful on a busy machine.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import fmu_mesh.node.node as node_module
import fmu_mesh.run.roles as roles_module
from benchmarks.contestants.fmu_mesh_launch import configuration
from benchmarks.environment import ROOT, loads
from benchmarks.jobs import JOBS, OURS
from benchmarks.task import Task
from fmu_mesh.cli.main import main as fmu_mesh_main
from fmu_mesh.instances.fmi import Fmi2Instance
from fmu_mesh.node.links import OutLink
from fmu_mesh.node.node import Node
from fmu_mesh.rings.ring import Ring
from fmu_mesh.system.plan import Link
from fmu_mesh.wire.inbox import Inbox, Message

__all__: list[str] = []

P = ParamSpec("P")
R = TypeVar("R")

_DEADLINE_S = 60.0


@dataclass
class _Clock:
    """Calls of one kind, and the seconds in them."""

    calls: int = 0
    seconds: float = 0.0

    def around(self, function: Callable[P, R]) -> Callable[P, R]:
        """The function with this clock around it."""

        def timed(*arguments: P.args, **options: P.kwargs) -> R:
            started = time.perf_counter()
            try:
                return function(*arguments, **options)
            finally:
                self.seconds += time.perf_counter() - started
                self.calls += 1

        return timed


_FMU, _SEND, _POLL, _WAIT = _Clock(), _Clock(), _Clock(), _Clock()
_LABELS = {"FMU": _FMU, "send": _SEND, "poll": _POLL, "waiting": _WAIT}


class _TimedLink(OutLink):
    def __init__(self, link: Link, outputs: Ring, put: Callable[[bytes], None], window: int) -> None:
        super().__init__(link, outputs, _SEND.around(put), window)


class _TimedInbox(Inbox):
    def poll(self) -> Message | None:
        return _POLL.around(super().poll)()

    def wait(self, timeout_s: float) -> Message | None:
        return _WAIT.around(super().wait)(timeout_s)


class _TimedNode(Node):
    def _step_to_the_end(self) -> None:
        for clock in _LABELS.values():
            clock.calls, clock.seconds = 0, 0.0
        before = (time.perf_counter(), time.thread_time(), time.process_time(), _switches())
        super()._step_to_the_end()
        after = (time.perf_counter(), time.thread_time(), time.process_time(), _switches())
        wall, thread, process, switches = (b - a for a, b in zip(before, after, strict=True))
        lines = [f"node '{self._plan.node}': {wall:.3f} s, {self._plan.grid.last_point} points"]
        rest = wall - sum(clock.seconds for clock in _LABELS.values())
        for label, seconds, calls in (*((k, c.seconds, c.calls) for k, c in _LABELS.items()), ("Python", rest, 0)):
            per_point = 1e6 * seconds / self._plan.grid.last_point
            lines.append(f"  {label:14} {100 * seconds / wall:5.1f} %  {per_point:8.2f} us/point  {calls or '':>8}")
        others = process - thread
        lines.append(f"  processor: main thread {thread:.3f} s, other threads {others:.3f} s; {switches:.0f} switches")
        print("\n".join(lines), file=sys.stderr, flush=True)


def _switches() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_nvcsw + usage.ru_nivcsw


def _be_node(config: str, name: str) -> int:
    """Run one node with clocks."""
    vars(node_module).update(OutLink=_TimedLink, Inbox=_TimedInbox)
    vars(roles_module).update(Node=_TimedNode)
    Fmi2Instance.do_step = _FMU.around(Fmi2Instance.do_step)  # type: ignore[method-assign]
    sys.argv = ["fmu-mesh", "node", config, name]
    return fmu_mesh_main()


def main() -> int:
    """Run a job's mesh with clocks in its nodes, by hand: a master and one process per node."""
    if sys.argv[1:2] == ["--node"]:
        return _be_node(*sys.argv[2:4])
    jobs = {job.name: job for job in JOBS if job.entries[0].module == OURS}
    parser = argparse.ArgumentParser(prog="python -m benchmarks.profile_hot_loop")
    parser.add_argument("job", nargs="?", default="pendulum", choices=jobs)
    parser.add_argument("--points", type=int, help="communication steps (default: those of the job)")
    parser.add_argument("--window", help="in points; 1 is lockstep")
    options = parser.parse_args()
    entry, system = jobs[options.job].entries[0], jobs[options.job].system
    assert system is not None
    changed = {"window": options.window} if options.window else {}
    task = Task(system, options.points or entry.points, entry.options | changed)
    nodes = ["together"] if entry.options.get("group") == "one" else [member.name for member in system.members]
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        file = Path(folder, "profile.yaml")
        file.write_text(json.dumps(configuration(task) | {"mesh": "profile", "record": _record(folder, task)}))
        return _run(str(file), nodes)


def _record(folder: str, task: Task) -> dict[str, Any]:
    return {"file": f"{folder}/result.csv", "variables": [member.column for member in task.system.members]}


def _run(config: str, nodes: list[str]) -> int:
    commands = [["-m", "fmu_mesh", "master", config, "--no-progress"]]
    commands += [["-m", "benchmarks.profile_hot_loop", "--node", config, name] for name in nodes]
    print(f"load average {loads()}", flush=True)
    processes = [
        subprocess.Popen([sys.executable, *command], cwd=ROOT, stdin=subprocess.DEVNULL) for command in commands
    ]
    deadline = time.monotonic() + _DEADLINE_S
    try:
        return max(process.wait(max(0.1, deadline - time.monotonic())) for process in processes)
    finally:
        for process in processes:
            process.kill()


if __name__ == "__main__":
    sys.exit(main())
