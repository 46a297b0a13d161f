"""What a lock costs between hosts: a chain of two processes that share no memory, with certificates and without.

Run it with `python -m benchmarks.tls`. Both processes are on this machine and meet at a port of loopback. With
certificates, rows go by Zenoh over TLS, and all rules of the roles count; beside it run the same by Zenoh over TCP, and
the row streams that there would be without certificates. Every result has the bytes of `launch --local`.
"""

from __future__ import annotations

import argparse
import re
import statistics
import sys
from collections.abc import Mapping, Sequence
from typing import Any, Final

from benchmarks.publishing import Figures, add_write_docs, markdown_table, publish
from tests.helpers import Place, free_port, write_config

__all__ = ["main"]

_WAYS: Final[Mapping[str, tuple[str, Mapping[str, Any]]]] = {
    "row streams over TCP": ("tcp", {}),
    "Zenoh over TCP": ("tcp", {"row_streams": False}),
    "Zenoh over TLS, with rules": ("tls", {}),
}
_SUMMARY: Final = re.compile(r"^(\d+) points in ([0-9.]+) s: ", re.MULTILINE)
_STEP_SIZE: Final = 0.001


def _speed(way: str, points: int, window: int | None, problems: list[str]) -> float:
    """Points a second of one run."""
    from fmu_mesh.wire.security.authority import Authority  # noqa: PLC0415  it needs an optional library

    protocol, zenoh = _WAYS[way]
    with Place() as place:
        secured: dict[str, Any] = {}
        if protocol == "tls":
            authority = Authority.made(place.folder / "lab")
            for name in ("one", "other"):
                authority.add(name, "node", 1.0, ["127.0.0.1"])
            secured = {"security": {"folder": "lab/one"}}
        simulation = {"step_size": _STEP_SIZE, **({"window": window} if window else {})}
        config = write_config(
            place.folder,
            stop_time=points * _STEP_SIZE,
            simulation=simulation,
            zenoh={"shared_memory": False, **zenoh},
            **secured,
        )
        result, runtime = config.with_suffix(".csv"), place.environment["FMU_MESH_RUNTIME_DIR"]
        assert place.run("launch", config, "--local", "--no-progress").wait() == 0
        expected = result.read_bytes()
        there = f"{protocol}/127.0.0.1:{free_port()}"
        started = [place.start("master", config, "--no-progress", "--listen", there)]
        started += [place.start("node", config, "pendulum")]
        place.environment |= {"FMU_MESH_RUNTIME_DIR": f"{runtime}2"}
        if secured:
            place.environment |= {"FMU_MESH_SECURITY": str(place.folder / "lab" / "other")}
        started += [place.start("node", config, "delay", "--connect", there)]
        codes = [one.wait() for one in started]
        summary = _SUMMARY.search(started[0].output)
        if any(codes) or summary is None or result.read_bytes() != expected:
            problems.append(f"{way}: {[one.story() for one in started]}")
            return float("nan")
        print(f"  {way}, {points} points: {summary[2]} s", file=sys.stderr)
        return int(summary[1]) / float(summary[2])


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; 1 if a result is another one."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.tls", description=__doc__)
    parser.add_argument("--repeat", type=int, default=5, metavar="N", help="interleaved rounds (5)")
    parser.add_argument("--points", type=int, default=2_000_000, metavar="N", help="of a chain (2,000,000)")
    parser.add_argument("--few", type=int, default=5_000, metavar="N", help="of a chain with window 1 (5,000)")
    add_write_docs(parser)
    options = parser.parse_args(arguments)
    return publish("tls", lambda: _all(options), write=options.write_docs)


def _all(options: argparse.Namespace) -> Figures:
    runs = {"a chain": (options.points, None), "a chain with window 1": (options.few, 1)}
    seen: dict[tuple[str, str], list[float]] = {}
    problems: list[str] = []
    for _ in range(options.repeat):
        for name, (points, window) in runs.items():
            for way in _WAYS:
                seen.setdefault((name, way), []).append(_speed(way, points, window, problems))
    rows = [
        (name, *(f"{statistics.median(seen[name, way]):,.0f}" for way in _WAYS), f"{_ratio(name, seen):.2f}")
        for name in runs
    ]
    header = ["points/s", *_WAYS, "TLS takes so many times Zenoh over TCP"]
    return Figures(
        about=f"medians of {options.repeat} interleaved rounds",
        tables=markdown_table(header, rows),
        problems=tuple(problems),
    )


def _ratio(name: str, seen: Mapping[tuple[str, str], Sequence[float]]) -> float:
    """Of the time."""
    _, plain, locked = _WAYS
    return statistics.median(seen[name, plain]) / statistics.median(seen[name, locked])


if __name__ == "__main__":
    sys.exit(main())
