"""What a connection costs before the run, with many of them: two FMUs that feed each other through all their variables.

Reading, checking and planning is timed, and nothing is run. The cost of a connection must not depend on how many there
are: the figure to look at is the ratio of the largest system to the smallest.
"""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import fmu_mesh
from benchmarks.contestants.entry import FMUS
from benchmarks.publishing import Figures, markdown_table

__all__ = ["measured"]

_HEADER = ("connections", "inputs and outputs of each FMU", "to a plan, s", "us per connection", "ratio")
_DECLARED = (
    '<ScalarVariable name="u{0}" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>'
    '<ScalarVariable name="y{0}" valueReference="1" causality="output" initial="calculated"><Real/></ScalarVariable>'
)


@dataclass
class Width:
    """A number of connections, and how long each round took."""

    connections: int
    seconds: list[float] = field(default_factory=list)

    @property
    def each_us(self) -> float:
        """The median per connection."""
        return 1e6 * statistics.median(self.seconds) / self.connections


def measured(rounds: int) -> Figures:
    """The table, of medians of interleaved rounds."""
    widths = [Width(2_000), Width(20_000)]
    with tempfile.TemporaryDirectory(prefix="connections-") as folder:
        files = [_written(width.connections // 2, Path(folder)) for width in widths]
        for number in range(rounds):
            for width, file in zip(widths, files, strict=True):
                print(f"round {number + 1}: {width.connections} connections", file=sys.stderr)
                started = time.perf_counter()
                fmu_mesh.load(file).plan()
                width.seconds.append(time.perf_counter() - started)
    rows = [
        (
            f"{width.connections:,}",
            f"{width.connections // 2:,}",
            f"{statistics.median(width.seconds):.2f}",
            f"{width.each_us:.0f}",
            f"{width.each_us / widths[0].each_us:.2f}",
        )
        for width in widths
    ]
    return Figures(f"Medians of {rounds} interleaved rounds", markdown_table(_HEADER, rows, texts=0))


def _written(count: int, folder: Path) -> Path:
    """The configuration of two FMUs with so many inputs and outputs each, all of them connected."""
    fmu = folder / f"wide_{count}.fmu"
    with zipfile.ZipFile(FMUS / "Gain.fmu") as old, zipfile.ZipFile(fmu, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            data = old.read(name)
            new.writestr(name, _widened(data.decode(), count) if name == "modelDescription.xml" else data)
    config = {
        "mesh": "wide",
        "simulation": {"stop_time": 1, "step_size": 0.1},
        "instances": {"first": {"fmu": str(fmu)}, "second": {"fmu": str(fmu)}},
        "connections": [f"first.y{n} -> second.u{n}" for n in range(count)]
        + [f"second.y{n} -> first.u{n}" for n in range(count)],
        "record": {"file": None},
    }
    file = folder / f"wide_{count}.yaml"
    file.write_text(json.dumps(config, indent=1))  # JSON is YAML
    return file


def _widened(description: str, count: int) -> str:
    """The model description with more variables; each output depends on the input of its number."""
    first = description.count("<ScalarVariable") + 1
    unknowns = "".join(f'<Unknown index="{first + 2 * n + 1}" dependencies="{first + 2 * n}"/>' for n in range(count))
    declared = "".join(_DECLARED.format(n) for n in range(count))
    for end, more in (("</ModelVariables>", declared), ("</Outputs>", unknowns), ("</InitialUnknowns>", unknowns)):
        description = description.replace(end, more + end)
    return description
