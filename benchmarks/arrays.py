"""What an array costs on its way from one component in Python to another one, against numpy alone.

Run it with `python -m benchmarks.arrays`. One component puts out a field of numbers, another one adds them up; recorded
is the sum. The peer is a loop with the same work and one copy of the field. Rounds are interleaved. All sums have to be
equal.
"""

from __future__ import annotations

import argparse
import itertools
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import fmu_mesh
from benchmarks.models.fields import SIZES, numpy_alone
from benchmarks.publishing import Figures, add_write_docs, markdown_table, publish

__all__ = ["configuration", "main"]

_PEER = "numpy alone"
_WAYS: dict[str, tuple[str, ...]] = {
    "launch --local": ("--local",),
    "launch": (),
    "launch, without shared memory": ("--set-config", "zenoh.shared_memory=false"),
}
_STEP_SIZE_S = 0.03125
_MOST_POINTS = 20_000
_DEADLINE_S = 600
_HEADER = ("way", "numbers", "points", "us per point", "ratio")


def configuration(size: int, points: int) -> dict[str, Any]:
    """A mesh of a source and a sum, each in a process of its own."""
    models = Path(__file__).with_name("models") / "fields.py"
    return {
        "mesh": "fields",
        "simulation": {"stop_time": points * _STEP_SIZE_S, "step_size": _STEP_SIZE_S},
        "instances": {
            "source": {"python": f"{models}:Source{size}"},
            "sum": {"python": f"{models}:Sum{size}"},
        },
        "connections": [{"from": "source.field", "to": "sum.field", "delay": 1}],
        "record": {"variables": ["sum.total"]},
    }


def _measured(way: str, size: int, points: int, folder: Path) -> tuple[float, list[float]]:
    """Microseconds per point, and the sums at all points but the first."""
    if way == _PEER:
        began = time.perf_counter()
        sums = numpy_alone(size, points, _STEP_SIZE_S)
        return 1e6 * (time.perf_counter() - began) / points, sums
    file, result = folder / "fields.yaml", folder / "fields.csv"
    file.write_text(json.dumps(configuration(size, points)))  # JSON is YAML
    command = [
        sys.executable,
        "-m",
        "fmu_mesh",
        "launch",
        str(file),
        "--no-progress",
        "--json",
        "--output",
        str(result),
    ]
    done = subprocess.run([*command, *_WAYS[way]], check=False, capture_output=True, text=True, timeout=_DEADLINE_S)
    outcome = json.loads(done.stdout)
    if done.returncode:
        raise RuntimeError(f"{way}: {outcome['error']['message']}")
    return 1e6 * outcome["seconds"] / points, fmu_mesh.Result.read(result)["sum.total"][1:].tolist()


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure all sizes; 1 if a sum differs from that of numpy alone."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.arrays", description=__doc__)
    parser.add_argument("--sizes", nargs="+", type=int, choices=SIZES, default=SIZES, metavar="N", help=f"{SIZES}")
    parser.add_argument("--megabytes", type=int, default=4000, metavar="N", help="what a run moves (4000)")
    parser.add_argument("--repeat", type=int, default=5, metavar="N", help="interleaved rounds (5)")
    add_write_docs(parser)
    options = parser.parse_args(arguments)
    points = {size: min(_MOST_POINTS, max(10, options.megabytes * 1_000_000 // (8 * size))) for size in options.sizes}
    return publish("arrays", lambda: _all(points, options.repeat), write=options.write_docs)


def _all(points: Mapping[int, int], rounds: int) -> Figures:
    """Medians of every way; ``points`` by the size of the field."""
    figures: dict[tuple[int, str], list[float]] = {}
    problems: dict[str, None] = {}
    with tempfile.TemporaryDirectory(prefix="arrays-") as folder:
        for _, size in itertools.product(range(rounds), points):
            expected: list[float] = []
            for way in (_PEER, *_WAYS):
                cost, sums = _measured(way, size, points[size], Path(folder))
                figures.setdefault((size, way), []).append(cost)
                if sums != (expected := expected or sums):
                    problems[f"{way} has other sums than numpy alone for {size} numbers"] = None
    rows = []
    for (size, way), costs in figures.items():
        cost, least = statistics.median(costs), statistics.median(figures[size, _PEER])
        rows.append((way, f"{size:,}", f"{points[size]:,}", f"{cost:,.1f}", f"{cost / least:.2f}"))
    return Figures(f"Medians of {rounds} interleaved rounds", markdown_table(_HEADER, rows), problems=[*problems])


if __name__ == "__main__":
    sys.exit(main())
