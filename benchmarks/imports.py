"""`python -m benchmarks.imports`: how long it takes until a program can use fmu_mesh, and until the command answers.

Each program is started in turns with the others, so that a busy minute of the machine is shared by all. The table has
medians in ms, and how many times as long as `import msgspec` each one takes.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.publishing import Figures, add_write_docs, markdown_table, publish

_WITH_NAMES = "import fmu_mesh; [getattr(fmu_mesh, name) for name in fmu_mesh.__all__]"
_COMMAND = str(Path(sys.executable).with_name("fmu-mesh"))
PROGRAMS = {
    'python -c "pass"': [sys.executable, "-c", "pass"],
    'python -c "import msgspec"': [sys.executable, "-c", "import msgspec"],
    'python -c "import fmu_mesh"': [sys.executable, "-c", "import fmu_mesh"],
    "the same, and all of its names": [sys.executable, "-c", _WITH_NAMES],
    "fmu-mesh --version": [_COMMAND, "--version"],
    "fmu-mesh --help": [_COMMAND, "--help"],
}
BASE = 'python -c "import msgspec"'


def main() -> int:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.imports", description=__doc__)
    parser.add_argument("--rounds", type=int, default=21, help="how often each program is started (21)")
    add_write_docs(parser)
    options = parser.parse_args()
    return publish("imports", lambda: _measured(max(1, options.rounds)), write=options.write_docs)


def _measured(rounds: int) -> Figures:
    """The table of all programs."""
    seconds: dict[str, list[float]] = {name: [] for name in PROGRAMS}
    for name, command in PROGRAMS.items():
        _time_of(command)  # the files are in the cache from here on
        print(f"warm: {name}", file=sys.stderr)
    for _ in range(rounds):
        for name, command in PROGRAMS.items():
            seconds[name].append(_time_of(command))
    medians = {name: statistics.median(measured) for name, measured in seconds.items()}
    rows = [(f"`{name}`", f"{median * 1e3:.0f}", f"{median / medians[BASE]:.2f}") for name, median in medians.items()]
    return Figures(f"Medians of {rounds} interleaved rounds", markdown_table(("program", "ms", "times as long"), rows))


def _time_of(command: list[str]) -> float:
    """Time in s that a program takes from its start to its end."""
    began = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, timeout=60)
    return time.perf_counter() - began


if __name__ == "__main__":
    sys.exit(main())
