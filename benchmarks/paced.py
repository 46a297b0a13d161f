"""What a paced run costs: CPU time of each process of pendulum -> delay at 100 Hz, in percent of one core.

Run it with `python -m benchmarks.paced`, here and with `--python FOLDER/.venv/bin/python` of another checkout in turn.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, Final

import psutil
import yaml

from benchmarks.environment import ROOT
from tests.helpers import wait_until

_WAYS: Final[dict[str, dict[str, bool]]] = {
    "rings": {},
    "streams": {"shared_memory": False},
    "zenoh": {"shared_memory": False, "row_streams": False},
}
_ROLES: Final = ("master", "pendulum", "delay")
_FIRST_ROWS: Final = 100


def cpu_s(process: psutil.Process) -> float:
    """How long all threads of a process have run, in s; the ticks of `cpu_times` are too coarse."""
    tasks = [*Path(f"/proc/{process.pid}/task").iterdir()]
    return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks) / 1e9


def measured(python: str, way: str, rate: float, seconds: float, folder: Path) -> dict[str, float]:
    """Percent of one core by role, over some seconds of one run."""
    config: dict[str, Any] = yaml.safe_load((ROOT / "configs" / "pendulum_delay.yaml").read_text())
    for instance in config["instances"].values():
        instance["fmu"] = str((ROOT / "configs" / instance["fmu"]).resolve())
    config["simulation"] |= {"stop_time": 1e4, "step_size": 1 / rate, "real_time_factor": 1}
    config |= {"mesh": f"paced_{way}", "zenoh": _WAYS[way], "record": {"file": str(rows := folder / f"{way}.csv")}}
    (file := folder / f"{way}.yaml").write_text(yaml.safe_dump(config))
    rows.unlink(missing_ok=True)
    command = [python, "-m", "fmu_mesh", "launch", str(file), "--no-progress"]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as launched:
        try:
            wait_until(lambda: rows.exists() and rows.read_bytes().count(b"\n") > _FIRST_ROWS, "the first rows")
            children = [
                (child, " ".join(child.cmdline()).split())
                for child in psutil.Process(launched.pid).children(recursive=True)
            ]
            roles = {role: child for child, words in children for role in _ROLES if role in words}
            before, began = {role: cpu_s(process) for role, process in roles.items()}, time.monotonic()
            threading.Event().wait(seconds)  # what is measured
            elapsed_s = time.monotonic() - began
            return {role: 100 * (cpu_s(roles[role]) - before[role]) / elapsed_s for role in _ROLES}
        finally:
            os.kill(launched.pid, signal.SIGTERM)


def main() -> None:
    """Measure and print one line for each way."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paced", description=__doc__)
    parser.add_argument("--ways", nargs="+", choices=_WAYS, default=[*_WAYS], help="how rows travel")
    parser.add_argument("--rate", type=float, default=100.0, help="points per second (default: 100)")
    parser.add_argument("--seconds", type=float, default=8.0, help="of each run (default: 8)")
    parser.add_argument("--repeat", type=int, default=3, help="runs of which the median is shown (default: 3)")
    parser.add_argument("--python", nargs="+", default=[sys.executable], help="of checkouts, which run in turn")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="paced-") as folder:
        for way in options.ways:
            runs = [
                [measured(python, way, options.rate, options.seconds, Path(folder)) for python in options.python]
                for _ in range(options.repeat)
            ]
            for number, python in enumerate(options.python):
                shares = [f"{role} {statistics.median(run[number][role] for run in runs):5.2f}" for role in _ROLES]
                print(f"{way:8} {'  '.join(shares)}  % of a core  {python}")


if __name__ == "__main__":
    main()
