"""What rows pay for ssh between two hosts: a chain and a cycle of two processes, by ssh and by plain TCP.

Run it with `python -m benchmarks.over_ssh`. The hosts are namespaces on this machine, each with a real sshd, and share
no memory. The first instance is on the host of the master, the second one on the other host. By ssh, `launch` starts
everything, and each row passes through ssh and sshd; by plain TCP, the processes are started by hand, and their row
streams are connections of TCP. Rounds are interleaved, and each is compared within itself. Every result has the bytes
of `launch --local`.
"""

from __future__ import annotations

import argparse
import re
import statistics
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import yaml

from benchmarks.environment import ROOT
from benchmarks.publishing import Figures, add_write_docs, markdown_table, publish
from tests.helpers import Launched
from tests.network_hosts import NetworkHost
from tests.ssh_hosts import PYTHON, SshHosts, ssh_hosts, why_not

__all__ = ["main"]

_WAYS: Final = ("plain TCP", "ssh", "ssh, with `rows: tcp`")
_ADDRESS: Final = "10.77.0.2"
"""Of the second host."""
_FOLDER: Final = Path("own-clone", "configs")
_RESULT: Final = "over_ssh.csv"
_SUMMARY: Final = re.compile(r"^(\d+) points in ([0-9.]+) s: (\d+) points/s", re.MULTILINE)
_MOST_S: Final = 300.0


@dataclass(frozen=True)
class _Job:
    """A configuration of two instances.

    Attributes:
        example: its file.
        points: of a run.
        window: None: as the plan chooses.
    """

    title: str
    example: str
    points: int
    window: int | None = None


class _Pair:
    """Two hosts, and what runs on them."""

    def __init__(self, entered: SshHosts) -> None:
        self._here, self._there = entered.hosts
        self._expected: dict[str, bytes] = {}

    def seconds(self, job: _Job, way: str) -> float:
        """The time of a run, in s.

        Raises:
            RuntimeError: it failed, or its result is another one.
        """
        own = _content(job, way, self._there.name)
        for host in (self._here, self._there):
            (host.folder / _FOLDER / "over_ssh.yaml").write_text(yaml.safe_dump(own, sort_keys=False), encoding="utf-8")
        if job.title not in self._expected:
            _summary(self._here.start("fmu-mesh", "launch", "configs/over_ssh.yaml", "--local"))
            self._expected[job.title] = self._result()
        if way == _WAYS[0]:
            first, *others = _by_hand(self._here, self._there, [*own["instances"]])
        else:
            first, *others = [self._here.start("fmu-mesh", "launch", "configs/over_ssh.yaml", "--no-progress")]
        seconds = _summary(first)
        if any(one.wait(_MOST_S) for one in others):
            raise RuntimeError("".join(one.story() for one in others))
        if self._result() != self._expected[job.title]:
            msg = f"{job.title} by {way}: the result is another one"
            raise RuntimeError(msg)
        return seconds

    def _result(self) -> bytes:
        file = self._here.folder / _FOLDER / _RESULT
        content = file.read_bytes()
        file.unlink()
        return content


def _content(job: _Job, way: str, there: str) -> dict[str, Any]:
    """A configuration whose second instance runs ``there``; by hand, it says so in no place."""
    content: dict[str, Any] = yaml.safe_load((ROOT / "configs" / job.example).read_text(encoding="utf-8"))
    content["simulation"]["stop_time"] = job.points * content["simulation"]["step_size"]
    if job.window:
        content["simulation"]["window"] = job.window
    content["record"] = {"file": _RESULT}
    content["zenoh"] = {"insecure": way != _WAYS[1]}
    if way != _WAYS[0]:
        rows = "sockets" if way == _WAYS[1] else "tcp"
        content["deploy"] = {"hosts": {there: {"ssh": there, "python": PYTHON, "rows": rows, "address": _ADDRESS}}}
        [*content["instances"].values()][1]["host"] = there
    return content


def _by_hand(here: NetworkHost, there: NetworkHost, nodes: Sequence[str]) -> list[Launched]:
    near, far = nodes
    config = "configs/over_ssh.yaml"
    master = ("fmu-mesh", "master", config, "--no-progress", "--listen", "tcp/0.0.0.0:7447", "--insecure")
    return [
        here.start(*master),
        here.start("fmu-mesh", "node", config, near),
        there.start("fmu-mesh", "node", config, far, "--connect", "tcp/router:7447", "--insecure"),
    ]


def _summary(launched: Launched) -> float:
    """How long the run took that this process tells of, in s."""
    if launched.wait(_MOST_S) or not (found := _SUMMARY.search(launched.output)):
        raise RuntimeError(launched.story())
    seconds, rate = float(found[2]), int(found[3])  # rounded: the first one is finer where a run is slow
    return seconds if seconds > 1 else int(found[1]) / rate


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; 1 if a run fails or a result is another one."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.over_ssh", description=__doc__)
    parser.add_argument("--repeat", type=int, default=5, metavar="N", help="interleaved rounds (5)")
    parser.add_argument("--points", type=int, default=2_000_000, metavar="N", help="of the chain (2,000,000)")
    parser.add_argument("--few", type=int, default=20_000, metavar="N", help="of the cycle (20,000)")
    add_write_docs(parser)
    options = parser.parse_args(arguments)
    if reason := why_not():
        print(f"skipped: {reason}")
        return int(options.write_docs)
    return publish("ssh", lambda: _all(options), write=options.write_docs)


def _all(options: argparse.Namespace) -> Figures:
    jobs = [
        _Job("a chain", "pendulum_delay.yaml", options.points),
        _Job("a chain with window 1", "pendulum_delay.yaml", options.few, window=1),
        _Job("a cycle", "cycle2.yaml", options.few),
    ]
    seen: dict[tuple[str, str], list[float]] = {}
    with tempfile.TemporaryDirectory(prefix="ssh-") as folder, ssh_hosts(Path(folder)) as entered:
        pair = _Pair(entered)
        for number in range(options.repeat):
            for job in jobs:
                for way in _WAYS if number % 2 else _WAYS[::-1]:
                    seen.setdefault((job.title, way), []).append(seconds := pair.seconds(job, way))
                    print(f"round {number + 1}: {job.title} by {way}: {seconds:.3f} s", file=sys.stderr, flush=True)
    rows = [(job.title, *_figures(job, seen)) for job in jobs]
    header = ["points/s", *_WAYS, *(f"{way}: of plain TCP" for way in _WAYS[1:])]
    about = f"medians of {options.repeat} interleaved rounds; the shares are medians of those of a round"
    return Figures(about=about, tables=markdown_table(header, rows))


def _figures(job: _Job, seen: Mapping[tuple[str, str], Sequence[float]]) -> list[str]:
    speeds = [f"{job.points / statistics.median(seen[job.title, way]):,.0f}" for way in _WAYS]
    plain = seen[job.title, _WAYS[0]]
    shares = [
        statistics.median(first / second for first, second in zip(plain, seen[job.title, way], strict=True))
        for way in _WAYS[1:]
    ]
    return [*speeds, *(f"{share:.2f}" for share in shares)]


if __name__ == "__main__":
    sys.exit(main())
