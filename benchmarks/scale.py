"""`python -m benchmarks.scale`: what a point costs with more and more instances, and what a plan costs before it.

A chain `Integrator -> Gain -> Gain -> …`, each instance in a process of its own, or in groups; recorded is the last
output. Sizes are interleaved, figures are medians. Every result is compared with that of `launch --local`, row by row.
`--connections` is what a connection costs before the run (`benchmarks.connections`), `--variables` what an FMU with
very many variables costs (`benchmarks.variables`), each in a table of its own.
"""

from __future__ import annotations

import argparse
import itertools
import json
import re
import statistics
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks import connections, variables
from benchmarks.contestants.entry import FMUS
from benchmarks.publishing import Figures, add_write_docs, markdown_table, publish

_SUMMARY = re.compile(r"^\d+ points in [0-9.]+ s: (\d+) points/s", re.MULTILINE)
_HEADER = ("instances", "nodes", "points", "points/s", "us per point and instance")


@dataclass
class Size:
    """A size of the chain, and what was measured with it.

    Attributes:
        nodes: processes of nodes; as many as instances, or the groups they are dealt into.
    """

    instances: int
    nodes: int
    points: int
    rates: list[float] = field(default_factory=list)

    def row(self) -> tuple[str, ...]:
        """The medians."""
        rate = statistics.median(self.rates)
        cost = 1e6 / rate / self.instances
        return (str(self.instances), str(self.nodes), f"{self.points:,}", f"{rate:,.0f}", f"{cost:.2f}")


SIZES = (
    Size(2, 2, 20_000),
    Size(8, 8, 20_000),
    Size(16, 16, 10_000),
    Size(32, 32, 10_000),
    Size(64, 64, 5_000),
    Size(64, 8, 10_000),
    Size(256, 8, 5_000),
    Size(256, 2, 5_000),
)


def configuration(size: Size, result: Path) -> dict[str, Any]:
    """The chain of this size."""
    instances: dict[str, dict[str, Any]] = {
        "source": {"fmu": str(FMUS / "Integrator.fmu"), "start_values": {"u": 1.0, "k": 0.7}}
    }
    for number in range(1, size.instances):
        instances[f"gain_{number}"] = {"fmu": str(FMUS / "Gain.fmu"), "start_values": {"k": 1.01}}
    names = list(instances)
    if size.nodes < size.instances:
        for number, name in enumerate(names):
            instances[name]["group"] = f"group_{number * size.nodes // size.instances}"
    return {
        "mesh": "scale",
        "simulation": {"stop_time": size.points * 0.001, "step_size": 0.001},
        "instances": instances,
        "connections": [f"{source}.y -> {target}.u" for source, target in itertools.pairwise(names)],
        "record": {"file": str(result), "variables": [f"{names[-1]}.y"]},
    }


def measure(size: Size, folder: Path) -> None:
    """Run it once.

    Raises:
        RuntimeError: the run failed, or its result is not that of one process.
    """
    config, result, local = folder / "scale.yaml", folder / "distributed.csv", folder / "local.csv"
    config.write_text(json.dumps(configuration(size, result)))  # JSON is YAML
    command = [sys.executable, "-m", "fmu_mesh", "launch", str(config), "--no-progress"]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=170)
    found = _SUMMARY.search(done.stdout)
    if done.returncode or found is None:
        msg = f"{size.instances} instances: exit code {done.returncode}: {done.stderr.strip()[-400:]}"
        raise RuntimeError(msg)
    subprocess.run([*command, "--local", "--output", str(local)], check=True, capture_output=True, timeout=170)
    if result.read_bytes() != local.read_bytes():
        msg = f"{size.instances} instances in {size.nodes} nodes: the result is not that of one process"
        raise RuntimeError(msg)
    size.rates.append(int(found[1]))


def main() -> int:
    """Measure all sizes."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scale", description=__doc__)
    parser.add_argument("--repeat", type=int, default=3, metavar="N", help="interleaved rounds (3)")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--connections", action="store_true", help="only what a connection costs before the run")
    what.add_argument("--variables", action="store_true", help="only what an FMU with very many variables costs")
    add_write_docs(parser)
    options = parser.parse_args()
    measured = {"connections": connections.measured, "variables": variables.measured, "scale": _measured}
    block = "connections" if options.connections else "variables" if options.variables else "scale"
    return publish(block, lambda: measured[block](options.repeat), write=options.write_docs)


def _measured(rounds: int) -> Figures:
    """The table of all sizes."""
    with tempfile.TemporaryDirectory(prefix="scale-") as folder:
        for number in range(rounds):
            for size in SIZES:
                print(f"round {number + 1}: {size.instances} instances, {size.nodes} nodes", file=sys.stderr)
                measure(size, Path(folder))
    table = markdown_table(_HEADER, [size.row() for size in SIZES], texts=0)
    return Figures(f"Medians of {rounds} interleaved rounds", table)


if __name__ == "__main__":
    sys.exit(main())
