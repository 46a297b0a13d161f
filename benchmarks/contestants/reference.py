"""The in-process reference, and no contestant: every row of a system, in the plainest way there is.

The option `clock`: `summed` gives the reference of a program that adds step sizes up.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from benchmarks.contestants.fmu import opened_all
from benchmarks.task import Task

__all__ = ["rows_of"]


def rows_of(task: Task) -> tuple[list[list[float]], list[float | None]]:
    """All rows, from point 0 on, and the value of each connected input in Initialization Mode."""
    system = task.system
    with opened_all(system, task.stop_time) as (fmus, inputs):
        values = [fmu.get() for fmu in fmus]
        rows = [list(values)]
        time = 0.0
        for point in range(task.points):
            for stage in system.stages():
                used = list(values)
                for index in stage:
                    source = system.source_of(index)
                    if source is not None:
                        fmus[index].set(used[source])
                    fmus[index].fmu.doStep(time, system.step_size)
                    values[index] = fmus[index].get()
            rows.append(list(values))
            summed = task.options.get("clock") == "summed"
            time = time + system.step_size if summed else (point + 1) * system.step_size
    return rows, inputs


def _main() -> None:
    rows, inputs = rows_of(Task.from_json(Path(sys.argv[1]).read_text()))
    Path(sys.argv[2]).write_text(json.dumps({"rows": rows, "initial_inputs": inputs}))
    print("{}")


if __name__ == "__main__":
    _main()
