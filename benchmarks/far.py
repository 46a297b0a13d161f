"""Two hosts that are far from each other: a chain, a cycle and the main example over networks with delay and losses.

Run it with `python -m benchmarks.far`. The hosts are namespaces on this machine, which share no memory and no `/tmp`,
and the network is a program between two TUN devices. The master and the first instance are on one host, the second
instance is on the other one. Each result is compared, byte for byte, with that of `launch --local`.
"""

from __future__ import annotations

import argparse
import filecmp
import itertools
import json
import re
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import psutil
import yaml

from benchmarks.environment import ROOT
from benchmarks.far_link import FarLink, far_link, why_not
from benchmarks.jobs import Entry, Job
from benchmarks.publishing import Figures, add_write_docs, publish
from benchmarks.report import Report
from benchmarks.running import Measured
from benchmarks.task import System
from tests.helpers import Launched, wait_until
from tests.network_hosts import NetworkHost, started_hosts

__all__ = ["JOBS", "LINKS", "FarJob", "FarRuns", "main"]

_LISTENING: Final = "--listen", "tcp/0.0.0.0:7447", "--insecure"
_MOST_S: Final = 120.0
_NOT_MET: Final = "their rows go by Zenoh"
"""The end of a warning: processes did not meet for a row stream in time."""
_SUMMARY: Final = re.compile(r"^(\d+) points in ([0-9.]+) s: (\d+) points/s", re.MULTILINE)


@dataclass(frozen=True)
class FarJob:
    """A configuration with two instances in nodes of their own.

    Attributes:
        config: its file; empty: 8 bytes for each point through a TCP socket, and no mesh.
        points: how many it takes without a delay.
        delayed: the same with a delay.
        few: the same where packets are lost, or the line is slow.
    """

    name: str
    title: str
    config: str
    points: int
    delayed: int
    few: int

    def table(self, links: Sequence[FarLink], points: int | None) -> Job:
        """A table with a row for each network; the number of ``points`` may be another one."""
        entries = []
        for link in links:
            hindered = link.loss_percent or link.kbit_per_s
            usual = self.few if hindered else self.delayed if link.round_trip_ms else self.points
            entries.append(Entry(str(link), "far", points or usual))
        return Job(self.name, self.title, System("chain", "jacobi", 1.0, ()), tuple(entries), rows="network")


_CHAIN: Final = "pendulum_delay.yaml"
JOBS: Final = (
    FarJob("far_chain", "far: pendulum -> delay, many points", _CHAIN, 2_000_000, 2_000_000, 100_000),
    FarJob(
        "far_socket", "far: 8 bytes for each point through a TCP socket: the limit", "", 2_000_000, 2_000_000, 100_000
    ),
    FarJob("far_main", "far: the main example (configs/pendulum_delay.yaml)", _CHAIN, 20_000, 20_000, 20_000),
    FarJob("far_cycle", "far: two instances in a cycle (configs/cycle2.yaml)", "cycle2.yaml", 20_000, 300, 300),
)
LINKS: Final = (
    *(FarLink(delay) for delay in (0.0, 5.0, 50.0, 100.0)),
    FarLink(50.0, loss_percent=1.0),
    FarLink(50.0, kbit_per_s=1000.0),
)

_RECEIVING: Final = """
import socket
with socket.create_server(("10.77.0.2", 7000)) as own:
    print("here", flush=True)
    connection, _ = own.accept()
    room = bytearray(1 << 20)
    while connection.recv_into(room):
        pass
    connection.sendall(b"done")
"""
_SENDING: Final = """
import socket, sys, time
data = bytes(8 * int(sys.argv[1]))
with socket.create_connection(("10.77.0.2", 7000)) as own:
    begin = time.monotonic()
    own.sendall(data)
    own.shutdown(socket.SHUT_WR)
    assert own.recv(4)
    print(time.monotonic() - begin)
"""


class FarRuns:
    """What runs on two hosts.

    Args:
        hosts: the first one is `router`.
        changes: of the sections of each configuration.
    """

    def __init__(self, hosts: Sequence[NetworkHost], changes: dict[str, dict[str, object]]) -> None:
        self._hosts = hosts
        self._changes = changes

    def run(self, job: FarJob, measured: Measured) -> None:
        """Run a job once; the link has to be there."""
        running: list[Launched] = []
        try:
            if job.config:
                self._run_mesh(job, measured, running)
            else:
                self._send(measured, running)
        except AssertionError:
            measured.failure = f"not done within {_MOST_S:.0f} s"
            measured.failed += 1
        finally:
            _end(running)

    def _run_mesh(self, job: FarJob, measured: Measured, running: list[Launched]) -> None:
        first, second = self._hosts
        file, (near, far) = self._written(job, measured.points)
        reference, result = first.folder / f"{job.name}-{measured.points}.csv", first.folder / "far.csv"
        if not reference.exists():
            alone = first.start("fmu-mesh", "launch", file, "--local", "--output", f"../{reference.name}")
            if alone.wait(_MOST_S):
                raise RuntimeError(alone.story())
        running += [
            first.start("fmu-mesh", "master", file, *_LISTENING, "--output", f"../{result.name}"),
            first.start("fmu-mesh", "node", file, near),
            second.start("fmu-mesh", "node", file, far, "--connect", "tcp/router:7447", "--insecure"),
        ]
        wait_until(lambda: not running[0].running, "the end", _MOST_S)
        codes = [one.wait() for one in running]
        found = _SUMMARY.search(running[0].output)
        if any(codes) or found is None or int(found[1]) != measured.points:
            measured.failure = " ".join("".join(one.errors for one in running).split())[-400:]
            measured.failed += 1
            return
        seconds, rate = float(found[2]), int(found[3])  # rounded: the first one is finer where a run is slow
        measured.costs.append(seconds / measured.points if seconds > 1 else 1 / rate)
        equal = filecmp.cmp(reference, result, shallow=False)
        by_zenoh = ", by Zenoh" if _NOT_MET in running[0].errors else ""
        if not measured.result.startswith("DIFFERS"):
            measured.result = f"all bytes equal{by_zenoh}" if equal else "DIFFERS"

    def _send(self, measured: Measured, running: list[Launched]) -> None:
        """Send as many bytes as a chain of these points needs."""
        first, second = self._hosts
        running.append(receiving := second.start(sys.executable, "-c", _RECEIVING))
        wait_until(lambda: "here" in receiving.output, f"who receives; {receiving.errors}")
        running.append(sending := first.start(sys.executable, "-c", _SENDING, str(measured.points)))
        if sending.wait(_MOST_S):
            raise RuntimeError(sending.story())
        measured.costs.append(float(sending.output) / measured.points)

    def _written(self, job: FarJob, points: int) -> tuple[str, list[str]]:
        """Write a configuration to both hosts: its path there, and its instances."""
        content: dict[str, Any] = yaml.safe_load((ROOT / "configs" / job.config).read_text(encoding="utf-8"))
        content["simulation"]["stop_time"] = points * content["simulation"]["step_size"]
        for section, changes in self._changes.items():
            content.setdefault(section, {}).update(changes)
        file = f"configs/{job.name}.yaml"
        for host in self._hosts:
            (host.folder / "own-clone" / file).write_text(json.dumps(content), encoding="utf-8")  # JSON is YAML
        return file, [*content["instances"]]


def _end(running: Sequence[Launched]) -> None:
    """End what still runs; `nsenter` waits for it outside, and does not take it along."""
    for one in running:
        if one.running:
            for child in psutil.Process(one.pid).children(recursive=True):
                child.kill()
            one.close()


def main(arguments: list[str] | None = None) -> int:
    """Measure all jobs over all networks."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.far", description=__doc__)
    parser.add_argument("--delays", nargs="+", type=float, metavar="MS", help="round trips in ms; default: a table")
    parser.add_argument("--loss", type=float, default=0.0, metavar="PERCENT", help="packets that are lost (0)")
    parser.add_argument("--rate", type=float, default=0.0, metavar="KBIT", help="kbit/s of each way (no limit)")
    names = [job.name for job in JOBS]
    parser.add_argument("--jobs", nargs="+", choices=names, default=names, metavar="JOB", help=f"of {', '.join(names)}")
    parser.add_argument(
        "--points", type=int, metavar="N", help="points of the chain, and of the socket (2000000, or few)"
    )
    parser.add_argument("--repeat", type=int, default=3, metavar="N", help="interleaved rounds (3)")
    parser.add_argument("--window", type=int, metavar="N", help="the window of each configuration (auto)")
    parser.add_argument("--zenoh", action="store_true", help="rows by Zenoh, and not by row streams")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the measurements to this file")
    add_write_docs(parser)
    options = parser.parse_args(arguments)
    chosen = {name for name, value in vars(options).items() if value != parser.get_default(name)}
    if options.write_docs and chosen - {"write_docs", "repeat", "json"}:
        parser.error("--write-docs needs all jobs and all networks")
    if reason := why_not():
        print(f"skipped: {reason}")
        return int(options.write_docs)
    return publish("far", lambda: _all(options), write=options.write_docs)


def _all(options: argparse.Namespace) -> Figures:
    """The tables of all jobs."""
    links = LINKS
    if options.delays or options.loss or options.rate:
        links = tuple(FarLink(delay, options.loss, options.rate) for delay in options.delays or (0.0, 50.0))
    jobs = [job for job in JOBS if job.name in options.jobs]
    tables = [job.table(links, options.points if job.points == JOBS[0].points else None) for job in jobs]
    results = {job.name: {entry.label: Measured(2, entry.points) for entry in job.entries} for job in tables}
    changes: dict[str, dict[str, object]] = {"zenoh": {"row_streams": not options.zenoh}}
    if options.window is not None:
        changes["simulation"] = {"window": options.window}
    with tempfile.TemporaryDirectory(prefix="far-") as folder, started_hosts(Path(folder), wired=False) as hosts:
        runs = FarRuns(hosts, changes)
        for number, link in itertools.product(range(options.repeat), links):
            with far_link([host.pid for host in hosts], link):
                for job in jobs:
                    print(f"round {number + 1}: {link}: {job.name}", file=sys.stderr, flush=True)
                    runs.run(job, results[job.name][str(link)])
    report = Report(tables, results, [])
    if options.json is not None:
        options.json.write_text(report.json() + "\n")
    problems = [
        f"{job.name}: {label}: {measured.failure or measured.result}"
        for job in tables
        for label, measured in results[job.name].items()
        if measured.failed or measured.result.startswith("DIFFERS")
    ]
    about = f"Medians of {options.repeat} interleaved rounds, rows by {'Zenoh' if options.zenoh else 'row streams'}"
    return Figures(about, report.markdown().strip(), report.text(), problems)


if __name__ == "__main__":
    sys.exit(main())
