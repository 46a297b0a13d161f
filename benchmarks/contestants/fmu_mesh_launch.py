"""fmu_mesh: `fmu-mesh launch` on a configuration written from the task; runs in the project's own environment.

Options: `window`; `group` = `one` puts all instances into one node; `record` = `outputs` (the outputs that the system
reads), `all` or `none`; `result` is the CSV file.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.contestants.entry import FMUS, main, versions
from benchmarks.task import Outcome, Task

__all__ = ["configuration"]

_SUMMARY = re.compile(r"^(\d+) points in ([0-9.]+) s: (\d+) points/s", re.MULTILINE)


def run(task: Task) -> Outcome:
    """Timed is what the summary line says: from the first grant to the last point, recording included."""
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        config = Path(folder, "bench.yaml")
        config.write_text(json.dumps(configuration(task)))  # JSON is YAML
        command = [sys.executable, "-m", "fmu_mesh", "launch", str(config), "--no-progress"]
        done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=110)
    if done.returncode:
        msg = f"exit code {done.returncode}: {done.stderr.strip()[-400:]}"
        raise RuntimeError(msg)
    found = _SUMMARY.search(done.stdout)
    if found is None or int(found[1]) != task.points:
        msg = f"no summary for {task.points} points: {done.stdout.strip()[-400:]}"
        raise RuntimeError(msg)
    # The summary has milliseconds and the rate; for a short run the rate is the finer of the two.
    seconds = task.points / int(found[3])
    used = versions("eclipse-zenoh", "fmpy", "msgspec", "numpy")
    return Outcome(seconds, versions=versions("fmu-mesh") | used, result_file=task.options.get("result"))


def configuration(task: Task) -> dict[str, Any]:
    """The configuration of a task."""
    system, options = task.system, task.options
    instances: dict[str, dict[str, Any]] = {}
    connections = []
    for index, member in enumerate(system.members):
        instances[member.name] = {"fmu": str(FMUS / f"{member.fmu}.fmu"), "start_values": member.start_values}
        if options.get("group") == "one":
            instances[member.name]["group"] = "together"
        source = system.source_of(index)
        if source is not None:
            connections.append(f"{system.members[source].column} -> {member.name}.{member.input}")
    simulation: dict[str, Any] = {
        "stop_time": task.stop_time,
        "step_size": system.step_size,
        "algorithm": system.algorithm,
    }
    if "window" in options:
        simulation["window"] = int(options["window"])
    record: dict[str, Any] = {"file": options.get("result")}
    if options.get("record", "outputs") == "outputs":
        record["variables"] = [member.column for member in system.members]
    return {
        "mesh": "bench",
        "simulation": simulation,
        "instances": instances,
        "connections": connections,
        "record": record,
    }


if __name__ == "__main__":
    main(run)
