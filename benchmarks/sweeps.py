"""How many runs per second: a sweep of the main example against a loop over `launch --local`, and its memory.

python -m benchmarks.sweeps                 all ways, one after another, three times; medians
python -m benchmarks.sweeps --memory        10,000 variants: memory while they run, and how fast the table opens
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import psutil

from benchmarks.commands import Command, run_command
from benchmarks.environment import ROOT
from benchmarks.publishing import Figures, add_write_docs, markdown_table, publish

_CONFIG = ROOT / "configs" / "pendulum_delay.yaml"
_TIMEOUT_S = 300.0
_VARIANTS = 256
_LOOPED = 16
_LOOK_S = 0.05
_MANY = 10_000

_REPEATED = """
import fmu_mesh
with fmu_mesh.load("configs/pendulum_delay.yaml").repeated() as runs:
    for number in range(256):
        runs.run(start_values={"pendulum.d": 0.05 + 0.003 * number})
"""


def _fmu_mesh(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "fmu_mesh", *arguments]


def _looped(folder: Path, at_once: int) -> float:
    """Runs per second of a shell that starts `launch --local` for each variant, so many at a time."""
    command = _fmu_mesh("launch", str(_CONFIG), "--local", "--quiet", "--output", f"{folder}/{{}}.csv")
    values = "\n".join(f"{0.05 + 0.003 * number}" for number in range(_LOOPED))
    begin = time.perf_counter()
    loop = ["xargs", f"-P{at_once}", "-I{}", *command, "--set", "pendulum.d={}"]
    subprocess.run(loop, input=values, text=True, check=True, timeout=_TIMEOUT_S)
    return _LOOPED / (time.perf_counter() - begin)


def _swept(folder: Path, *more: str) -> float:
    """Runs per second of the command `sweep`, from its start to its end."""
    vary = ("--vary", "pendulum.d=0.05:0.8:16", "--vary", "delay.d=0.5:3:16", "--reduce", "max(pendulum.a)")
    own = tempfile.mkdtemp(dir=folder)
    command = _fmu_mesh("sweep", str(_CONFIG), *vary, "--folder", f"{own}/sweep", "--quiet", *more)
    return _VARIANTS / run_command(Command(command, ROOT), _TIMEOUT_S).seconds


def _repeated() -> float:
    """Runs per second of a program with `Mesh.repeated`, from its start to its end."""
    return _VARIANTS / run_command(Command([sys.executable, "-c", _REPEATED], ROOT), _TIMEOUT_S).seconds


def _rates(rounds: int) -> Figures:
    """The rate of each way, and its ratio to the loop."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        ways: dict[str, Callable[[], float]] = {
            "loop over `launch --local`, one after another": partial(_looped, folder, 1),
            "the same, two at a time": partial(_looped, folder, 2),
            "`sweep`": partial(_swept, folder),
            "`sweep --no-curves`": partial(_swept, folder, "--no-curves"),
            "`sweep --workers 1`": partial(_swept, folder, "--workers", "1"),
            "`sweep --dask`, two workers": partial(_swept, folder, "--dask", "--workers", "2"),
            "`sweep --processes`": partial(_swept, folder, "--processes"),
            "`Mesh.repeated` in one process, in memory": _repeated,
        }
        found: dict[str, list[float]] = {name: [] for name in ways}
        for _ in range(rounds):
            for name, way in ways.items():
                found[name].append(way())
    medians = {name: statistics.median(rates) for name, rates in found.items()}
    base = next(iter(medians.values()))
    rows = [(name, f"{rate:.1f}", f"{1e3 / rate:,.0f}", f"{rate / base:.1f}") for name, rate in medians.items()]
    header = ("way", "runs per second", "ms per run", "ratio")
    return Figures(f"Medians of {rounds} interleaved rounds", markdown_table(header, rows))


def _memory() -> Figures:
    """The memory of a sweep with many variants while it runs, and how long pandas takes to open its table."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "sweep"
        vary = ("--vary", "pendulum.d=0.05:0.8:100", "--vary", "delay.d=0.5:3:100")
        options = ("--no-curves", "--reduce", "max(pendulum.a)", "--reduce", "rms(delay.y)", "--stop-time", "4")
        command = _fmu_mesh("sweep", str(_CONFIG), *vary, *options, "--folder", str(folder), "--quiet")
        begin = time.perf_counter()
        with subprocess.Popen(command, cwd=ROOT) as process:
            rows = _watched(process, folder)
        seconds = time.perf_counter() - begin
        opened = _opened(folder / "table.csv")
    about = f"{_MANY:,} variants in {seconds:.1f} s; pandas opens {opened}"
    return Figures(
        about, markdown_table(("rows", "memory of the command, MB", "of the largest worker, MB"), rows, texts=0)
    )


def _watched(process: subprocess.Popen[bytes], folder: Path) -> list[tuple[str, str, str]]:
    """The resident memory of the command and of its largest worker at each thousand rows."""
    never, told, found = threading.Event(), 0, []
    rows = folder / "rows.jsonl"
    while process.poll() is None:
        never.wait(_LOOK_S)
        done = rows.read_bytes().count(b"\n") if rows.exists() else 0
        if done // 1000 > told:
            told = done // 1000
            own = psutil.Process(process.pid)
            workers = [child.memory_info().rss for child in own.children(recursive=True) if child.is_running()]
            found.append((f"{done:,}", f"{own.memory_info().rss / 1e6:.0f}", f"{max(workers) / 1e6:.0f}"))
    return found


def _opened(table: Path) -> str:
    import pandas as pd  # noqa: PLC0415  only this needs it

    begin = time.perf_counter()
    rows = len(pd.read_csv(table))
    return f"the table of {rows:,} rows, {table.stat().st_size / 1e6:.1f} MB, in {time.perf_counter() - begin:.3f} s"


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sweeps", description=__doc__.partition("\n")[0])
    parser.add_argument("--memory", action="store_true", help="10,000 variants: memory, and the table")
    parser.add_argument("--rounds", type=int, default=3, metavar="N", help="repetitions of each way (3)")
    add_write_docs(parser)
    options = parser.parse_args(arguments)
    if options.memory:
        return publish("many variants", _memory, write=options.write_docs)
    return publish("sweeps", lambda: _rates(options.rounds), write=options.write_docs)


if __name__ == "__main__":
    sys.exit(main())
