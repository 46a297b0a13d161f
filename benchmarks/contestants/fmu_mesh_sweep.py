"""fmu_mesh: `fmu_mesh.sweep` over the main example, two workers, no curves, one reduction.

Option `checkout`: as in `fmu_mesh_launch`; `reset` = `yes`: instances are reset between two variants; `timed` = `rows`:
the time of all variants at the rate from the first hundred on, without the start of the workers and the table.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from benchmarks.contestants.c_sweep import FIRST, POINTS, STEP, check
from benchmarks.contestants.entry import FMUS, main, versions
from benchmarks.task import Outcome, Task

__all__ = ["run"]

_DEADLINE_S = 110
_PROGRAM = """
import json, sys, tempfile, time
import fmu_mesh
from fmu_mesh import sweep

first, step, count, points, reset, rows_only = json.loads(sys.argv[1])
with tempfile.TemporaryDirectory() as folder:
    options = {"stop_time": points * 0.002, "curves": False, "reduce": ["max(pendulum.a)"], "workers": 2}
    vary = {"pendulum.d": [first + number * step for number in range(count)]}
    began = time.perf_counter()
    with sweep("configs/pendulum_delay.yaml", vary, folder=f"{folder}/s", reset=reset, **options) as running:
        while rows_only and (done := running.progress.done) < 100:
            time.sleep(0.002)
        started = time.perf_counter()
        while rows_only and (now := running.progress.done) < count:
            time.sleep(0.002)
        ended = time.perf_counter()
        result = running.wait()
    seconds = (ended - started) * count / (count - done) if rows_only else time.perf_counter() - began
    print(json.dumps([seconds, [row.values["max(pendulum.a)"] for row in result]]))
"""


def run(task: Task) -> Outcome:
    """Timed is what a program waits for, from the call of `sweep` to the table; `points` is the number of variants.

    Raises:
        RuntimeError: it failed, or a value is not that of the plain loop.
    """
    root = Path(task.options.get("checkout", FMUS.parent))
    python = str(root / ".venv" / "bin" / "python") if "checkout" in task.options else sys.executable
    options = task.options.get("reset") == "yes", task.options.get("timed") == "rows"
    asked = json.dumps([FIRST, STEP, task.points, POINTS, *options])
    command = [python, "-c", _PROGRAM, asked]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=_DEADLINE_S, cwd=root)
    if done.returncode:
        msg = f"exit code {done.returncode}: {done.stderr.strip()[-400:]}"
        raise RuntimeError(msg)
    seconds, values = json.loads(done.stdout)
    check(values)
    used = {} if "checkout" in task.options else versions("fmu-mesh", "fmpy", "msgspec", "numpy")
    return Outcome(seconds, versions=used)


if __name__ == "__main__":
    main(run)
