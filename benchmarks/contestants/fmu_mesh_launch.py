"""fmu_mesh: `fmu-mesh launch` on a configuration written from the task; runs in the project's own environment.

Options: `window`; `group` = `one` puts all instances into one node; `local` = `yes` is `launch --local`; `record` =
`outputs` (the outputs that the system reads), `all` or `none`; `apart` = `streams` or `zenoh` is without shared memory;
`windows` = `yes` takes the FMUs with a library for Windows, which run under Wine;
`result` is the CSV file; `checkout` is the folder of another checkout with its `.venv`, whose fmu_mesh runs instead.
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
from benchmarks.windows import windows_fmu

__all__ = ["configuration", "launch_command", "launched"]

_ROOT = FMUS.parent
_SUMMARY = re.compile(r"^(\d+) points in ([0-9.]+) s: (\d+) points/s", re.MULTILINE)


def run(task: Task) -> Outcome:
    """Timed is what the summary line says: from the first grant to the last point, recording included."""
    return launched(configuration(task), task)


def launched(config: dict[str, Any], task: Task) -> Outcome:
    """The outcome of one launch of a configuration.

    Raises:
        RuntimeError: it failed, or printed no summary.
    """
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        command, root = launch_command(config, task.options, Path(folder))
        done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=110, cwd=root)
    if done.returncode:
        msg = f"exit code {done.returncode}: {done.stderr.strip()[-400:]}"
        raise RuntimeError(msg)
    found = _SUMMARY.search(done.stdout)
    if found is None or int(found[1]) != task.points:
        msg = f"no summary for {task.points} points: {done.stdout.strip()[-400:]}"
        raise RuntimeError(msg)
    # The summary has milliseconds and the rate; for a short run the rate is the finer of the two.
    seconds = task.points / int(found[3])
    used = {} if "checkout" in task.options else versions("fmu-mesh", "eclipse-zenoh", "fmpy", "msgspec", "numpy")
    return Outcome(seconds, versions=used, result_file=task.options.get("result"))


def launch_command(config: dict[str, Any], options: dict[str, str], folder: Path) -> tuple[list[str], Path]:
    """The command that launches a configuration, which is written into the folder; and where it has to run."""
    file = folder / "bench.yaml"
    file.write_text(json.dumps(config))  # JSON is YAML
    root = Path(options.get("checkout", _ROOT))
    python = str(root / ".venv" / "bin" / "python") if "checkout" in options else sys.executable
    local = ["--local"] if options.get("local") == "yes" else []
    return [python, "-m", "fmu_mesh", "launch", str(file), "--no-progress", *local], root


def configuration(task: Task) -> dict[str, Any]:
    """The configuration of a task."""
    system, options = task.system, task.options
    instances: dict[str, dict[str, Any]] = {}
    connections = []
    for index, member in enumerate(system.members):
        fmu = windows_fmu(member.fmu) if options.get("windows") == "yes" else FMUS / f"{member.fmu}.fmu"
        instances[member.name] = {"fmu": str(fmu), "start_values": member.start_values}
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
        "zenoh": {"streams": {"shared_memory": False}, "zenoh": {"shared_memory": False, "row_streams": False}}.get(
            options.get("apart", ""), {}
        ),
    }


if __name__ == "__main__":
    main(run)
