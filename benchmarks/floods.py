"""What floods by people with a certificate, and by strangers, cost a run; with `--write-docs`, their table.

Run it with `python -m benchmarks.floods`. The mesh listens with TLS, and the one who floods it comes by that port: an
observer, an operator, or a stranger. Each flood is another process on the same machine; beside it runs the mesh without
one, in turn. Every result has the bytes of `launch --local`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import signal
import socket
import statistics
import sys
import threading
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import psutil
import yaml
import zenoh

from benchmarks.publishing import Figures, add_write_docs, markdown_table, publish
from fmu_mesh.wire.security.identity import CA, CERTIFICATE, KEY
from tests.helpers import DEADLINE_S, FMUS, Launched, Place, wait_until, write_config

__all__ = ["FLOODS", "Flooded", "flooded", "main", "visitor"]

KEYS: Final = 200
"""So many outputs the instance `wide` has."""

_ROOT: Final = "fmu_mesh/flood"
_EVERY: Final = 100
_expected: Final[dict[tuple[int, float], str]] = {}
_LARGE: Final = 100_000_000
_CONNECTIONS: Final = 200
_AT_ONCE: Final = 16
_SUMMARY: Final = re.compile(r"^(\d+) points in ([0-9.]+) s", re.MULTILINE)
_OUTPUT: Final = (
    '<ScalarVariable name="y{0}" valueReference="1" causality="output" variability="continuous" initial="calculated">'
    "<Real/></ScalarVariable>"
)


# --- who floods: a process of its own


def visitor(folder: Path, endpoint: str) -> zenoh.Session:
    """A plain client with the certificate of a folder."""
    config = zenoh.Config()
    tls = {
        "root_ca_certificate": str(folder / CA),
        "enable_mtls": True,
        "connect_certificate": str(folder / CERTIFICATE),
        "connect_private_key": str(folder / KEY),
    }
    settings = {"mode": "client", "connect/endpoints": [endpoint], "transport/link/tls": tls}
    for key, value in {**settings, "scouting/multicast/enabled": False}.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def _ask(key: str) -> Callable[[Path, str], Iterator[None]]:
    """Ask again and again, with several questions on the way."""

    def flood(lab: Path, endpoint: str) -> Iterator[None]:
        session = visitor(lab / "bob", endpoint)
        assert sum(reply.ok is not None for reply in session.get(f"{_ROOT}/{key}", timeout=DEADLINE_S))
        while True:
            for replies in [session.get(f"{_ROOT}/{key}", timeout=DEADLINE_S) for _ in range(_AT_ONCE)]:
                for _ in replies:
                    pass
            yield

    return flood


def _put(who: str, key: str, payload: bytes) -> Callable[[Path, str], Iterator[None]]:
    def flood(lab: Path, endpoint: str) -> Iterator[None]:
        session = visitor(lab / who, endpoint)
        while True:
            session.put(f"{_ROOT}/{key}", payload, congestion_control=zenoh.CongestionControl.BLOCK)
            yield

    return flood


def _subscribe(signal_then: signal.Signals | None) -> Callable[[Path, str], Iterator[None]]:
    """Subscribe to everything; and be stopped, or read it."""

    def flood(lab: Path, endpoint: str) -> Iterator[None]:
        session = visitor(lab / "bob", endpoint)
        came: list[object] = []
        keys = [f"{_ROOT}/*/{kind}" for kind in ("out/**", "status", "log")]
        subscribers = [session.declare_subscriber(key, came.append) for key in keys]
        wait_until(lambda: _answer(session, f"{_ROOT}/*/status?subscribed") and came, "a first sample")
        yield
        if signal_then is not None:
            os.kill(os.getpid(), signal_then)
        for subscriber in subscribers:
            wait_until(lambda: False, "the end", 3600.0)
            subscriber.undeclare()

    return flood


def _connect(greeting: bytes) -> Callable[[Path, str], Iterator[None]]:
    """Open connections, say something that is not TLS, or nothing, and hang up."""

    def flood(_lab: Path, endpoint: str) -> Iterator[None]:
        host, _, port = endpoint.partition("/")[2].rpartition(":")
        while True:
            with ExitStack() as stack:
                for _ in range(_CONNECTIONS):
                    with suppress(OSError):
                        own = stack.enter_context(socket.create_connection((host, int(port)), timeout=1.0))
                        own.sendall(greeting)
                yield

    return flood


FLOODS: Final[Mapping[str, tuple[str, Callable[[Path, str], Iterator[None]]]]] = {
    "all": (f"queries of an observer for {KEYS} values each", _ask("*/out/**")),
    "one": ("queries of an observer for one value each", _ask("delay/out/y")),
    "state": ("queries of an observer for the state of all instances", _ask("*/status")),
    "sets": ("settings of an operator", _put("alice", "wide/set/@by/alice/u", b"1.0")),
    "large": ("puts of an observer with 100 MB, which are forbidden", _put("bob", "wide/in/u", bytes(_LARGE))),
    "stopped": ("an observer that subscribes to all, and is stopped", _subscribe(signal.SIGSTOP)),
    "follows": ("an observer that subscribes to all", _subscribe(None)),
    "garbage": (f"{_CONNECTIONS} connections at a time without TLS", _connect(b"GET / HTTP/1.1\r\n\r\n")),
    "mute": (f"{_CONNECTIONS} connections at a time that say nothing", _connect(b"")),
}


@contextmanager
def _flooding(place: Place, name: str, lab: Path, endpoint: str) -> Iterator[None]:
    """Another process floods meanwhile; from its first message on."""
    command = [sys.executable, "-m", "benchmarks.floods", "--flood", name, str(lab), endpoint]
    place.environment["PYTHONPATH"] = str(Path(__file__).parents[1])
    flooder = place.start_command(command)
    try:
        wait_until(lambda: "flooding" in flooder.output, f"'{name}': {flooder.errors}")
        yield
    finally:
        flooder.close()


# --- the runs


@dataclass
class Flooded:
    """What was seen of the runs of one kind, with one flood or without.

    Attributes:
        seconds: of each run, from its start to its last point, in s.
        megabytes: what the process that listens had at most beyond what it had before, in each run, in MB.
        problems: what is wrong.
    """

    seconds: list[float] = field(default_factory=list)
    megabytes: list[float] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def wide(folder: Path) -> Path:
    """An FMU with many outputs."""
    path, outputs = folder / "Wide.fmu", [_OUTPUT.format(number) for number in range(KEYS - 3)]
    unknowns = "".join(f'<Unknown index="{4 + number}"/>' for number in range(len(outputs)))
    with zipfile.ZipFile(FMUS / "Gain.fmu") as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            if name == "modelDescription.xml":
                data = data.replace(b"</ModelVariables>", "".join(outputs).encode() + b"</ModelVariables>")
                data = data.replace(b"</Outputs>", unknowns.encode() + b"</Outputs>")
                data = data.replace(b"</InitialUnknowns>", unknowns.encode() + b"</InitialUnknowns>")
            new.writestr(name, data)
    return path


def flooded(flood: str | None, way: str, points: int, factor: float, seen: Flooded | None = None) -> Flooded:
    """Run a mesh beside a flood; None: without one.

    Args:
        flood: one of `FLOODS`.
        way: how rows go between its processes: `memory` or `zenoh`.
        points: of 1 ms.
        factor: the real-time factor; 0: as fast as possible.
        seen: where it is noted.
    """
    from fmu_mesh.wire.security.authority import Authority  # noqa: PLC0415  it needs an optional library

    seen = seen if seen is not None else Flooded()
    with Place() as place:
        authority = Authority.made(place.folder / "lab")
        authority.add("host", "node", 1.0, ["127.0.0.1"])
        authority.add("alice", "operator", 1.0)
        authority.add("bob", "observer", 1.0)
        config = write_config(
            place.folder,
            name="flood",
            instances={
                "pendulum": {"fmu": "DampedPendulum"},
                "delay": {"fmu": "TransportDelay", "start_values": {"d": 0.1}},
                "wide": {"fmu": str(wide(place.folder)), "start_values": {"u": 1.0}},
            },
            stop_time=points / 1000,
            simulation={"real_time_factor": factor},
            record={
                "file": "flood.csv",
                "variables": ["pendulum.a", "delay.y", "wide.y"],
                "every": 1 if factor else _EVERY,
            },
            zenoh={"listen": ["tls/127.0.0.1:0"], "shared_memory": way == "memory"},
            security={"folder": "lab/host"},
        )
        result = config.with_suffix(".csv")
        mesh = place.start("launch", config, "--no-progress", "--paused")
        endpoint = mesh.wait_for_error_line("mesh 'flood' at").rpartition(" at ")[2].strip()
        with ExitStack() as stack:
            session = stack.enter_context(place.session())
            state = f"{_ROOT}/mesh/status"
            wait_until(lambda: _answer(session, state).get("state") == "paused", "a mesh at rest")
            listener = [mesh.child(name) for name in ("master", "pendulum", "delay", "wide")]
            before = sum(own.memory_info().rss for own in listener)
            if flood is not None:
                stack.enter_context(_flooding(place, flood, authority.folder, endpoint))
            began = time.monotonic()
            _answer(session, f"{_ROOT}/mesh/command/@by/local", b'{"command":"resume"}')
            seen.megabytes.append(_most(mesh, listener, before) / 1e6)
            elapsed = time.monotonic() - began
        mesh.wait()
        summary = _SUMMARY.search(mesh.output)
        if summary is None or int(summary[1]) != points:
            seen.problems.append(f"{flood}, {way}: {mesh.story()}")
            return seen
        expected = _expected.get((points, factor))
        digest = hashlib.sha256(result.read_bytes()).hexdigest()
        if expected is None:
            result.unlink()
            local = yaml.safe_load(config.read_text())
            local["simulation"]["real_time_factor"] = 0
            config.write_text(yaml.safe_dump(local))
            assert place.run("launch", config, "--local", "--no-progress").wait() == 0
            expected = _expected[points, factor] = hashlib.sha256(result.read_bytes()).hexdigest()
        print(f"  {flood} {way} factor {factor:g}: {summary[2]} s by the summary, {elapsed:.2f} s", file=sys.stderr)
        seen.seconds.append(elapsed)
        seen.problems += [f"{flood}, {way}: another result"] if digest != expected else []
    return seen


def _most(mesh: Launched, listener: Sequence[psutil.Process], before: int) -> int:
    """Wait for the end of a mesh, and return what its processes had at most beyond ``before``, in bytes."""
    most, pause = 0, threading.Event()
    with suppress(psutil.Error):
        while mesh.running and mesh.output.count("points in") == 0:
            most = max(most, sum(own.memory_info().rss for own in listener) - before)
            pause.wait(0.01)
    return most


def _answer(session: zenoh.Session, key: str, payload: bytes | None = None) -> dict[str, Any]:
    for reply in session.get(key, payload=payload, timeout=DEADLINE_S):
        if reply.ok is not None:
            found: dict[str, Any] = json.loads(reply.ok.payload.to_bytes())
            return found
    return {}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; 1 if a row is missing, late or wrong."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.floods", description=__doc__)
    parser.add_argument(
        "--floods", nargs="+", choices=FLOODS, default=[*FLOODS], metavar="FLOOD", help=", ".join(FLOODS)
    )
    parser.add_argument("--ways", nargs="+", choices=("memory", "zenoh"), default=["memory", "zenoh"])
    parser.add_argument("--seconds", type=float, default=4.0, metavar="S", help="of a paced run (4)")
    parser.add_argument(
        "--points", type=int, default=3_000_000, metavar="N", help="of a run as fast as possible (3,000,000)"
    )
    parser.add_argument("--repeat", type=int, default=3, metavar="N", help="interleaved rounds (3)")
    parser.add_argument("--flood", nargs=3, metavar=("FLOOD", "LAB", "ENDPOINT"), help="be the one who floods")
    add_write_docs(parser)
    options = parser.parse_args(arguments)
    if options.flood is not None:
        name, lab, endpoint = options.flood
        for number, _ in enumerate(FLOODS[name][1](Path(lab), endpoint)):
            if not number:
                print("flooding", flush=True)
        return 0
    return publish("floods", lambda: _all(options), write=options.write_docs)


def _all(options: argparse.Namespace) -> Figures:
    runs = [("paced", round(1000 * options.seconds), 1.0), ("as fast as possible", options.points, 0.0)]
    seen: dict[tuple[str | None, str, str], Flooded] = {}
    for _ in range(options.repeat):
        for way in options.ways:
            for run, points, factor in runs:
                for flood in (None, *options.floods):
                    own = seen.setdefault((flood, way, run), Flooded())
                    flooded(flood, way, points, factor, own)
    rows = []
    for flood in (None, *options.floods):
        cells = []
        for way in options.ways:
            for run, *_ in runs:
                own, without = seen[flood, way, run], seen[None, way, run]
                if own.seconds and without.seconds:
                    seconds = statistics.median(own.seconds)
                    cells += [f"{seconds:.2f}", f"{seconds / statistics.median(without.seconds):.2f}"]
                else:
                    cells += ["-", "-"]
        most = max((most for way in options.ways for run, *_ in runs for most in seen[flood, way, run].megabytes))
        rows.append((FLOODS[flood][0] if flood else "none", *cells, f"{most:.0f}"))
    header = [
        "flood",
        *(cell for way in options.ways for run, *_ in runs for cell in (f"{run}, rows by {way}, s", "times")),
    ]
    table = markdown_table([*header, "memory, MB"], rows)
    about = f"Medians of {options.repeat} interleaved rounds"
    return Figures(about, table, problems=[problem for own in seen.values() for problem in own.problems])


if __name__ == "__main__":
    sys.exit(main())
