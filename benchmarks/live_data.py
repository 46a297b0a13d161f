"""Values of other programs by Zenoh keys: how soon they take effect, whether one is lost, how many a run can take.

Run it with `python -m benchmarks.live_data`. A program that uses Zenoh and one that uses MQTT feed two inputs at 1 kHz;
beside it are both without a mesh, where a session sends back what it receives. One program then feeds an input for
each point of a long run, and another one sends as many values as it can.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import filecmp
import json
import re
import statistics
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import psutil
import pytest
import zenoh

from benchmarks.publishing import Figures, add_write_docs, markdown_table, publish
from fmu_mesh.results.keys_file import keys_beside
from tests.helpers import Launched, Place, free_port, row_count, wait_until, write_config
from tests.mqtt.mqtt_bridge import Bridge, bridge_or_skip, running_bridge
from tests.ros.peers import Peer

__all__ = ["PARTS", "Watched", "ahead", "flooded", "main", "misplaced"]

PARTS: Final = ("clients", "ahead", "flood")
_WAYS: Final = {"zenoh": "Zenoh", "mqtt": "MQTT, `mosquitto_pub` and the bridge"}
_RATE_HZ: Final = 1000.0
_STEP_S: Final = 1 / _RATE_HZ
_OUT_OF_STEP_HZ: Final = 997.0
"""Values that take effect on arrival come at each moment between two points, and seldom two of them."""

_AHEAD_S: Final = 2.0
"""How long before its time a value is sent: none may come late, however busy the machine is."""

_WINDOW: Final = 20_000
_MORE_S: Final = 120.0
_PEER: Final = Path(__file__).with_name("live_data_peer.py")
_SUMMARY: Final = re.compile(r"^(\d+) points in ([0-9.]+) s: (\d+) points/s", re.MULTILINE)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; 1 if it is to be written and cannot."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.live_data", description=__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=[*PARTS], metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--seconds", type=float, default=60.0, metavar="S", help="of each run of clients, floods (60)")
    parser.add_argument("--repeat", type=int, default=3, metavar="N", help="interleaved rounds of clients (3)")
    parser.add_argument("--points", type=int, default=24_000_000, metavar="N", help="of the long run (24,000,000)")
    add_write_docs(parser)
    options = parser.parse_args(arguments)
    if options.write_docs and options.parts != [*PARTS]:
        parser.error("--write-docs needs all parts")
    return publish("live data", lambda: _all(options), write=options.write_docs)


def _all(options: argparse.Namespace) -> Figures:
    tables: list[str] = []
    problems: list[str] = []
    if "clients" in options.parts:
        for table, problem in (_clients(options),):
            tables += table
            problems += problem
    if "ahead" in options.parts:
        run = ahead(options.points)
        tables.append(
            "A value for each point, sent as fast as the run takes them:\n\n" + _ahead_table(options.points, run)
        )
        problems += run.problems
    if "flood" in options.parts:
        runs = [flooded(kind, options.seconds) for kind in ("arrival", "t")]
        tables.append(f"As many values as a program can send in {options.seconds:g} s:\n\n" + _flood_table(runs))
        problems += [problem for run in runs for problem in run.problems]
    about = f"Medians of {options.repeat} interleaved rounds of {options.seconds:g} s where clients are compared"
    return Figures(about, "\n\n".join(tables), problems=problems)


# --- two clients at 1 kHz


@dataclass
class Way:
    """What was measured of one way of values, of all rounds: percentiles 50 and 99 of each."""

    bare_ms: list[list[float]] = field(default_factory=list)
    mesh_ms: list[list[float]] = field(default_factory=list)
    points: list[list[float]] = field(default_factory=list)
    replaced: int = 0
    lost: int = 0
    misplaced: int = 0
    late: int = 0
    sent: int = 0

    def row(self, name: str) -> list[str]:
        """The row of the table."""
        medians = [
            f"{statistics.median(own[place] for own in rounds):.2f}"
            for rounds in (self.bare_ms, self.mesh_ms, self.points)
            for place in (0, 1)
        ]
        counts = self.lost, self.misplaced, self.late
        return [_WAYS[name], *medians, f"{self.replaced:,}", f"{self.sent:,}", *map(str, counts)]


_HEADER: Final = (
    "client",
    "without a mesh: median, ms",
    "p99, ms",
    "through the mesh: median, ms",
    "p99, ms",
    "takes effect after: median, points",
    "p99, points",
    "replaced",
    "with times",
    "lost",
    "at another point",
    "late",
)


def _clients(options: argparse.Namespace) -> tuple[list[str], list[str]]:
    """The table of two clients, and what is wrong."""
    names, reason = [*_WAYS], ""
    try:
        bridge_or_skip()
    except pytest.skip.Exception as skipped:
        names, reason = ["zenoh"], str(skipped.msg)
    ways, problems = {name: Way() for name in names}, []
    count = round(options.seconds * _RATE_HZ)
    for number in range(options.repeat):
        print(f"round {number + 1}: clients", file=sys.stderr)
        with Place() as place, _network(place, names) as network:
            with _echo(network):
                for name, answer in _feed(network, "plain", count).items():
                    ways[name].bare_ms.append(answer["round_trips_ms"])
            result, answers = _mesh(place, network, count, "arrival")
            for name, answer in answers.items():
                ways[name].mesh_ms.append(answer["round_trips_ms"])
                ways[name].points.append(answer["points"])
                ways[name].replaced += answer["missing"]
            problems += _rerun(place, result)
        with Place() as place, _network(place, names) as network:
            result, answers = _mesh(place, network, count, "t")
            for name, answer in answers.items():
                lost, moved = misplaced(_column(result, f"{name}.y"), answer["first"], count)
                ways[name].sent += count
                ways[name].lost += lost
                ways[name].misplaced += moved
                ways[name].late += answer["late"]
            problems += _rerun(place, result)
    rows = [way.row(name) for name, way in ways.items()]
    rows += [[_WAYS[name], f"not measured: {reason}", *[""] * (len(_HEADER) - 2)] for name in _WAYS if name not in ways]
    return [markdown_table(_HEADER, rows)], problems


@dataclass(frozen=True)
class Network:
    """The port of who listens for the clients, whose names are given, and the bridge for MQTT if it runs."""

    names: Sequence[str]
    ports: Bridge
    bridge: Launched | None

    def wait_for_link(self) -> None:
        """What comes to the bridge before its link to a mesh is lost."""
        if (bridge := self.bridge) is not None:
            wait_until(lambda: "ready" in bridge.output, "the link of the bridge")


@contextlib.contextmanager
def _network(place: Place, names: Sequence[str]) -> Iterator[Network]:
    ports = Bridge.on_free_ports()
    if "mqtt" not in names:
        yield Network(names, ports, None)
        return
    with running_bridge(place, ports) as bridge:
        yield Network(names, ports, bridge)


def _send_back(publisher: zenoh.Publisher, sample: zenoh.Sample) -> None:
    publisher.put(sample.payload)


@contextlib.contextmanager
def _echo(network: Network) -> Iterator[None]:
    """A session that listens, and sends back what it receives."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{network.ports.zenoh}"]))
    with zenoh.open(config) as session, contextlib.ExitStack() as stack:
        for name in network.names:
            publisher = stack.enter_context(session.declare_publisher(f"twin/{name}"))
            stack.enter_context(session.declare_subscriber(f"plant/{name}", partial(_send_back, publisher)))
        yield


def _feed(network: Network, role: str, count: int) -> dict[str, Any]:
    """What each client says, after both have sent their values at the same time."""
    rate_hz = _RATE_HZ if role == "timed" else _OUT_OF_STEP_HZ
    orders = {"role": role, "port": network.ports.zenoh, "count": count, "rate_hz": rate_hz, "ahead_s": _AHEAD_S}
    mqtt = {"mqtt": network.ports.mqtt}
    with contextlib.ExitStack() as stack:
        peers = {
            name: stack.enter_context(
                _peer({**orders, "key": f"plant/{name}", "back": f"twin/{name}", **(mqtt if name == "mqtt" else {})})
            )
            for name in network.names
        }
        return {name: peer.answer(0, count / _RATE_HZ + _MORE_S) for name, peer in peers.items()}


def _mesh(place: Place, network: Network, count: int, kind: str) -> tuple[Path, dict[str, Any]]:
    """The result of a paced run with an input for each client, and what the clients say."""
    connections = [
        entry
        for name in network.names
        for entry in (
            {"key": f"plant/{name}", "to": f"{name}.u", "time": kind},
            {"from": f"{name}.y", "key": f"twin/{name}"},
        )
    ]
    instances = {name: {"fmu": "Gain", "group": "inputs"} for name in network.names}
    mesh, result = _start(place, instances, connections, network.ports.zenoh, 3600.0, 1)
    network.wait_for_link()
    answers = _feed(network, "plain" if kind == "arrival" else "timed", count)
    for name, answer in answers.items():
        answer["late"] = _status(place, name)["late"]
    place.run("stop", "live")
    mesh.wait()
    return result, answers


def misplaced(column: Sequence[float], first: int, count: int) -> tuple[int, int]:
    """How many of the values 1, 2, ... are nowhere in a column, and how many are not where their times say.

    The first one is for the step from the point ``first``, so it is in the row of the next point.
    """
    found = {*column}
    lost = sum(number not in found for number in range(1, count + 1))
    right = sum(column[first + number] == number for number in range(1, count + 1) if first + number < len(column))
    return lost, count - lost - right


def _column(result: Path, name: str) -> list[float]:
    with result.open(encoding="utf-8", newline="") as file:
        rows = csv.reader(file)
        place = next(rows).index(name)
        return [float(row[place]) for row in rows]


# --- runs that are not paced by who sends


@dataclass
class Watched:
    """What was seen of the processes of a run.

    Attributes:
        megabytes: memory of all processes together, every second.
        open_files: the same of their open files.
        figures: what else was measured, by its name.
        problems: what is wrong.
    """

    megabytes: list[float] = field(default_factory=list)
    open_files: list[int] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    @contextlib.contextmanager
    def watching(self, place: Place) -> Iterator[None]:
        """Look at the processes of a place every second."""
        ended = threading.Event()

        def watch() -> None:
            processes = place.processes()
            while not ended.wait(1.0):
                with contextlib.suppress(psutil.Error):
                    self.megabytes.append(sum(own.memory_info().rss for own in processes) / 1e6)
                    self.open_files.append(sum(own.num_fds() for own in processes))

        thread = threading.Thread(target=watch)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def grown(self, part: float) -> tuple[float, float, int, int]:
        """Memory in MB and open files when this part of the run is over, and the most after that."""
        place = int(part * len(self.megabytes))
        files = self.open_files
        return self.megabytes[place], max(self.megabytes[place:]), files[place], max(files[place:])


def ahead(points: int) -> Watched:
    """A run that waits for a value at each point, and gets each before it needs it."""
    seen = Watched()
    with Place() as place:
        connections = [
            {"key": "plant/u", "to": "gain.u", "time": "t", "wait": True},
            {"from": "gain.y", "key": "twin/y", "every": 1.0},
        ]
        port = free_port()
        mesh, result = _start(place, {"gain": {"fmu": "Gain"}}, connections, port, points * _STEP_S, 0)
        wait_until(result.exists, "the first row")
        with seen.watching(place), _peer({"role": "ahead", "port": port, "count": points, "window": _WINDOW}) as peer:
            mesh.wait(points / 1000 + _MORE_S)
            peer.answer(0, _MORE_S)
        found = _SUMMARY.search(mesh.output)
        seen.figures = {
            "points/s": int(found[3]) if found else 0,
            "keys": keys_beside(result).stat().st_size / points,
            "result": result.stat().st_size / points,
        }
        with result.open(encoding="utf-8") as file:
            next(file)
            wrong = sum(float(line.rpartition(",")[2]) != max(number - 0.75, 0.0) for number, line in enumerate(file))
        seen.problems += [f"{wrong} values are not at their points"] if wrong else []
        seen.problems += _rerun(place, result, points / 1000 + _MORE_S)
    return seen


def _ahead_table(points: int, run: Watched) -> str:
    before, most, files, most_files = run.grown(0.25)
    figures = run.figures
    rows = [
        ("points, each with a value", f"{points:,}"),
        ("points/s", f"{figures['points/s']:,}"),
        ("memory of all processes after a quarter, MB", f"{before:.0f}"),
        ("most after that, MB", f"{most:.0f}"),
        ("open files after a quarter", files),
        ("most after that", most_files),
        ("kept for a rerun, bytes per value", f"{figures['keys']:.1f}"),
        ("result file, bytes per value", f"{figures['result']:.1f}"),
    ]
    return markdown_table(("long run", ""), rows)


def flooded(kind: str, seconds: float) -> Watched:
    """A paced run with an input that gets as many values as a program can send, on ``arrival`` or with times."""
    seen = Watched()
    with Place() as place:
        connections = [{"key": "plant/u", "to": "gain.u", "time": kind}, {"from": "gain.y", "key": "twin/y"}]
        port = free_port()
        mesh, result = _start(place, {"gain": {"fmu": "Gain"}}, connections, port, 3600.0, 1)
        wait_until(result.exists, "the first row")
        before, began = row_count(result), time.monotonic()
        with seen.watching(place), _peer({"role": "flood", "port": port, "seconds": seconds}) as peer:
            sent = peer.answer(0, seconds + _MORE_S)["sent"]
            points, took_s = row_count(result) - before, time.monotonic() - began
            status = _status(place, "gain")
        place.run("stop", "live")
        mesh.wait()
        seen.figures = {**status, "kind": kind, "rate": sent / seconds, "points": points / took_s}
        if status["received"] > sent:
            seen.problems.append(f"{status['received']} of {sent} values have arrived")
    return seen


def _status(place: Place, instance: str) -> dict[str, Any]:
    """What the mesh says of the key of an instance."""
    launched = place.run("status", f"live/{instance}", "--json")
    own: dict[str, Any] = json.loads(launched.output)["keys"][0]
    return own


def _flood_table(runs: Sequence[Watched]) -> str:
    rows = []
    for run in runs:
        before, most, files, most_files = run.grown(0.25)
        own = run.figures
        kind = "on arrival" if own["kind"] == "arrival" else "at its time"
        counts = [f"{own[name]:,}" for name in ("received", "replaced", "lost", "refused")]
        rates = f"{own['rate']:,.0f}", f"{own['points']:,.0f}"
        rows.append((kind, *rates, *counts, f"{before:.0f}", f"{most:.0f}", files, most_files))
    header = ("a value takes effect", "sent/s", "points/s of 1,000", "received", "replaced", "lost", "refused")
    return markdown_table((*header, "memory after a quarter, MB", "most after that, MB", "open files", "most"), rows)


def _start(  # noqa: PLR0913, PLR0917  one run
    place: Place, instances: dict[str, Any], connections: Sequence[Any], port: int, stop_time: float, factor: float
) -> tuple[Launched, Path]:
    config = write_config(
        place.folder,
        name="live",
        instances=instances,
        connections=connections,
        stop_time=stop_time,
        simulation={"step_size": _STEP_S, "real_time_factor": factor},
        zenoh={"listen": [f"tcp/127.0.0.1:{port}"]},
    )
    mesh = place.start("launch", config, "--no-progress")
    place.note()
    return mesh, config.with_suffix(".csv")


def _peer(orders: dict[str, Any]) -> Peer:
    common = {"key": "plant/u", "back": "twin/y", "step_s": _STEP_S}
    return Peer(Path(sys.executable), str(_PEER), {**common, **orders})


def _rerun(place: Place, result: Path, deadline_s: float = 0.0) -> list[str]:
    """What is wrong with a run that is repeated without the programs: its result has other bytes."""
    again = result.with_name("again.csv")
    launched = place.run("rerun", result, "--output", again, "--quiet", deadline_s=deadline_s or 3600.0)
    if launched.errors or not again.exists():
        return [f"the rerun has failed: {launched.errors}"]
    return [] if filecmp.cmp(result, again, shallow=False) else ["the rerun has other values"]


if __name__ == "__main__":
    sys.exit(main())
