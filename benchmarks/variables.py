"""What an FMU with very many variables costs: threads, start and memory of a run, and the commands that read it.

The FMU is Gain with more local variables, each of them its output. A run has eleven points, so it is all start. Figures
are medians of interleaved rounds; the time of a command is that of the whole process.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import fmu_mesh
from benchmarks.contestants.entry import FMUS
from benchmarks.publishing import Figures, markdown_table

__all__ = ["COUNTS", "measured"]

COUNTS = (10, 1_000, 10_000, 60_000)
_DECLARED = '<ScalarVariable name="net[{0}].x" valueReference="1" causality="local"><Real/></ScalarVariable>'
_FIGURES = (
    ("start of a run with `launch`, s", "launch"),
    ("the same with `--local`, s", "local"),
    ("ratio", "ratio"),
    ("threads of the node", "threads"),
    ("memory of the node, MB", "memory"),
    ("`check`, s", "check"),
    ("`inspect --json`, s", "inspect"),
    ("`graph --output g.svg`, s", "graph"),
    ("`convert` to an .ssp, s", "write SSP"),
    ("`check` of the .ssp, s", "read SSP"),
    ("`sweep` of 4 runs, s", "sweep"),
    ("`watch` of 1,000 variables until the first value, s", "watch"),
)


@dataclass
class Width:
    """A number of local variables, its files, and what was measured."""

    count: int
    folder: Path
    seen: dict[str, list[float]] = field(default_factory=dict)

    @property
    def config(self) -> Path:
        """The configuration of one instance."""
        return self.folder / "wide.yaml"

    def write(self) -> None:
        """Write the FMU and the configuration."""
        self.folder.mkdir()
        declared = "".join(_DECLARED.format(number) for number in range(self.count))
        with zipfile.ZipFile(FMUS / "Gain.fmu") as old, zipfile.ZipFile(self.folder / "wide.fmu", "w", 8) as new:
            for name in old.namelist():
                data = old.read(name)
                if name == "modelDescription.xml":
                    data = data.replace(b"</ModelVariables>", declared.encode() + b"</ModelVariables>")
                new.writestr(name, data)
        config = {
            "mesh": f"wide_{self.count}",
            "simulation": {"stop_time": 1.0, "step_size": 0.1},
            "instances": {"wide": {"fmu": "wide.fmu", "start_values": {"u": 1.0}}},
            "record": {"file": "wide.csv"},
        }
        self.config.write_text(json.dumps(config))  # JSON is YAML

    def note(self, what: str, figure: float) -> None:
        """One more figure."""
        self.seen.setdefault(what, []).append(figure)

    def measure(self) -> None:
        """One round."""
        config, swept = str(self.config), tempfile.mkdtemp(dir=self.folder) + "/swept"
        for what, command in (
            ("launch", ("launch", config, "--no-progress")),
            ("local", ("launch", config, "--no-progress", "--local")),
            ("check", ("check", config)),
            ("inspect", ("inspect", str(self.folder / "wide.fmu"), "--json")),
            ("graph", ("graph", config, "--output", str(self.folder / "g.svg"))),
            ("write SSP", ("convert", config, str(self.folder / "wide.ssp"), "--force")),
            ("read SSP", ("check", str(self.folder / "wide.ssp"))),
            ("sweep", ("sweep", config, "--vary", "wide.k=1,2,3,4", "--folder", swept, "--no-progress")),
        ):
            self.note(what, _seconds(command, self.folder))
        self.note("ratio", self.seen["launch"][-1] / self.seen["local"][-1])
        with fmu_mesh.load(config).start(record="memory", paused=True, stop_time=1000.0) as run:
            run.wait_for("paused")
            node = Path("/proc") / str(run.instance_info("wide").pid)
            self.note("threads", len([*(node / "task").iterdir()]))
            self.note("memory", _pss_mb(node))
            names = [f"wide.net[{number}].x" for number in range(min(self.count, 1_000))]
            started = time.perf_counter()
            with run.watch(*names) as samples:
                run.step(1)
                next(samples)
            self.note("watch", time.perf_counter() - started)


def measured(rounds: int) -> Figures:
    """The table of medians of interleaved rounds."""
    with tempfile.TemporaryDirectory(prefix="variables-") as folder:
        widths = [Width(count, Path(folder) / str(count)) for count in COUNTS]
        for width in widths:
            width.write()
        for number in range(rounds):
            for width in widths:
                print(f"round {number + 1}: {width.count} variables", file=sys.stderr)
                width.measure()
    rows = [
        [text, *(_figure(what, statistics.median(width.seen[what])) for width in widths)] for text, what in _FIGURES
    ]
    header = ("local variables", *(f"{count:,}" for count in COUNTS))
    return Figures(f"Medians of {rounds} interleaved rounds", markdown_table(header, rows))


def _figure(what: str, figure: float) -> str:
    show: Callable[[float], str] = "{:,.0f}".format if what in ("threads", "memory") else "{:.2f}".format
    return show(figure)


def _seconds(command: tuple[str, ...], folder: Path) -> float:
    started = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "fmu_mesh", *command],
        check=False,
        capture_output=True,
        text=True,
        timeout=600,
        cwd=folder,
    )
    if done.returncode:
        msg = f"fmu-mesh {' '.join(command)}: exit code {done.returncode}: {done.stderr.strip()[-400:]}"
        raise RuntimeError(msg)
    return time.perf_counter() - started


def _pss_mb(process: Path) -> float:
    lines = (process / "smaps_rollup").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("Pss:"))
