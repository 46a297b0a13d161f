"""What recording costs: a mesh whose steps take about a microsecond, with and without a result file.

Run it with `python -m benchmarks.recording`; `--formats` are endings of result files, and `none`. Rounds are
interleaved, so what else the machine does meets all of them. The rate is that from the first grant to the last point,
so the time of the whole command is shown as well: a writer that is behind at the last point needs it.
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
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.contestants.entry import FMUS
from benchmarks.publishing import Figures, add_write_docs, markdown_table, publish

__all__ = ["Recorded", "configuration", "main"]

_NOTHING = "none"
_HEADER = ("result file", "points", "points/s", "of the rate without", "whole command, s", "file, MB")
_SLOW = {"mcap": 20}
"""Formats that take fewer points, by this factor."""

_DEADLINE_S = 600
_STEP_SIZE_S = 0.03125


@dataclass
class Recorded:
    """A format, and what each round has shown.

    Attributes:
        rates: points per second.
        commands_s: time of the whole command in s.
        megabytes: size of the file in MB.
        problem: why it cannot be measured; empty if it can.
    """

    format: str
    rates: list[float] = field(default_factory=list)
    commands_s: list[float] = field(default_factory=list)
    megabytes: float = 0.0
    problem: str = ""

    def row(self, points: int, without: float) -> tuple[str, ...]:
        """The row of the table; ``without`` is the rate without a result file, 0 if it was not measured."""
        if self.problem:
            return (self.format, self.problem, "", "", "", "")
        rate = statistics.median(self.rates)
        share = f"{100.0 * rate / without:.0f} %" if without else ""
        command_s = statistics.median(self.commands_s)
        return (self.format, f"{points:,}", f"{rate:,.0f}", share, f"{command_s:.2f}", f"{self.megabytes:.1f}")


def configuration(instances: int, points: int) -> dict[str, Any]:
    """Pendulums in one node, with all their outputs recorded; a step of 30 ms takes one of them a microsecond."""
    names = [f"pendulum_{number}" for number in range(instances)]
    return {
        "mesh": "recording",
        "simulation": {"stop_time": points * _STEP_SIZE_S, "step_size": _STEP_SIZE_S},
        "instances": {
            name: {
                "fmu": str(FMUS / "DampedPendulum.fmu"),
                "group": "pendulums",
                "start_values": {"a": 1.0 + number / instances},
            }
            for number, name in enumerate(names)
        },
        "record": {"variables": [f"{name}.*" for name in names]},
    }


def measure(recorded: Recorded, config: Path, points: int) -> None:
    """Run the mesh once with a result file of this format."""
    file = config.with_name(f"recording.{recorded.format}")
    chosen = ["--set-config", "record.file=null"] if recorded.format == _NOTHING else ["--output", str(file)]
    chosen += ["--stop-time", str(points * _STEP_SIZE_S)]
    command = [sys.executable, "-m", "fmu_mesh", "launch", str(config), "--no-progress", "--json", *chosen]
    started = time.perf_counter()
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=_DEADLINE_S)
    wall_s = time.perf_counter() - started
    outcome = json.loads(done.stdout)
    if done.returncode:
        recorded.problem = str(outcome["error"]["message"]).rpartition("', ")[2]  # without the path
        return
    recorded.rates.append(points / outcome["seconds"])
    recorded.commands_s.append(wall_s)
    if file.exists():
        recorded.megabytes = file.stat().st_size / 1e6
        file.unlink()


def main(arguments: list[str] | None = None) -> int:
    """Measure all formats."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.recording", description=__doc__)
    parser.add_argument(
        "--formats",
        nargs="+",
        default=[_NOTHING, "csv", "parquet", "mcap"],
        metavar="ENDING",
        help="none csv parquet mcap",
    )
    parser.add_argument("--instances", type=int, default=1, metavar="N", help="instances with three outputs each (1)")
    parser.add_argument("--points", type=int, default=1_000_000, metavar="N", help="points of a run (1000000)")
    parser.add_argument("--repeat", type=int, default=5, metavar="N", help="interleaved rounds (5)")
    add_write_docs(parser)
    options = parser.parse_args(arguments)
    return publish("recording", lambda: _all(options), write=options.write_docs)


def _all(options: argparse.Namespace) -> Figures:
    """Medians of every format."""
    measured = [Recorded(name) for name in options.formats]
    points = {name: options.points // _SLOW.get(name, 1) for name in options.formats}
    with tempfile.TemporaryDirectory(prefix="recording-") as folder:
        config = Path(folder) / "recording.yaml"
        config.write_text(json.dumps(configuration(options.instances, options.points)))  # JSON is YAML
        for number, recorded in itertools.product(range(options.repeat), measured):
            if not recorded.problem:
                print(f"round {number + 1}: {recorded.format}", file=sys.stderr)
                measure(recorded, config, points[recorded.format])
    rates = {one.format: statistics.median(one.rates) for one in measured if one.rates}
    rows = [one.row(points[one.format], rates.get(_NOTHING, 0.0)) for one in measured]
    about = f"{options.instances} instances with three outputs each, medians of {options.repeat} interleaved rounds"
    problems = [f"{one.format}: {one.problem}" for one in measured if one.problem]
    return Figures(about, markdown_table(_HEADER, rows), problems=problems)


if __name__ == "__main__":
    sys.exit(main())
