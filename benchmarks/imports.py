"""`python -m benchmarks.imports`: how long it takes until a program can use fmu_mesh, and until the command answers.

Each program is started in turns with the others, so that a busy minute of the machine is shared by all. The table has
medians in ms of the wall clock and of the processor, and how many times as much time of the processor each one takes as
`fmu-mesh --version`: the median of the ratios of one round, which another load hardly changes.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

from benchmarks.publishing import Figures, add_write_docs, markdown_table, publish
from fmu_mesh.cli.main import COMMANDS

_WITH_NAMES = "import fmu_mesh; [getattr(fmu_mesh, name) for name in fmu_mesh.__all__]"
_CONFIG = "configs/pendulum_delay.yaml"
_COMMAND = str(Path(sys.executable).with_name("fmu-mesh"))
PROGRAMS = {
    'python -c "pass"': [sys.executable, "-c", "pass"],
    'python -c "import msgspec"': [sys.executable, "-c", "import msgspec"],
    'python -c "import fmu_mesh"': [sys.executable, "-c", "import fmu_mesh"],
    "the same, and all of its names": [sys.executable, "-c", _WITH_NAMES],
    "fmu-mesh --version": [_COMMAND, "--version"],
    "fmu-mesh --help": [_COMMAND, "--help"],
    **{f"fmu-mesh {name} --help": [_COMMAND, name, "--help"] for name in COMMANDS},
    f"fmu-mesh check {_CONFIG}": [_COMMAND, "check", _CONFIG],
    f"fmu-mesh launch {_CONFIG}": [_COMMAND, "launch", _CONFIG, "--quiet"],
}
BASE = "fmu-mesh --version"


def main() -> int:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.imports", description=__doc__)
    parser.add_argument("--rounds", type=int, default=21, help="how often each program is started (21)")
    add_write_docs(parser)
    options = parser.parse_args()
    return publish("imports", lambda: _measured(max(1, options.rounds)), write=options.write_docs)


def _measured(rounds: int) -> Figures:
    """The table of all programs."""
    times: dict[str, list[Times]] = {name: [] for name in PROGRAMS}
    for name, command in PROGRAMS.items():
        _times_of(command)  # the files are in the cache from here on
        print(f"warm: {name}", file=sys.stderr)
    for _ in range(rounds):
        for name, command in PROGRAMS.items():
            times[name].append(_times_of(command))
    rows = []
    for name, measured in times.items():
        wall, cpu = (statistics.median(one) * 1e3 for one in zip(*measured, strict=True))
        ratio = statistics.median(own.cpu / base.cpu for own, base in zip(measured, times[BASE], strict=True))
        rows.append((f"`{name}`", f"{wall:.0f}", f"{cpu:.0f}", f"{ratio:.2f}"))
    header = ("program", "ms", "ms of the processor", "times as long")
    return Figures(f"Medians of {rounds} interleaved rounds", markdown_table(header, rows))


class Times(NamedTuple):
    """Times in s of a program, from its start to its end: by the clock, and of the processor, with its children."""

    wall: float
    cpu: float


def _times_of(command: list[str]) -> Times:
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, timeout=60)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Times(time.perf_counter() - began, cpu)


if __name__ == "__main__":
    sys.exit(main())
