"""mosaik: its scheduler in this process, one simulator process per FMU over its JSON sockets."""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from time import perf_counter
from typing import Any

import mosaik  # type: ignore[import-not-found] # of the peers
import mosaik_api_v3  # type: ignore[import-not-found] # of the peers

from benchmarks.contestants.entry import main, versions
from benchmarks.contestants.fmu import Fmu
from benchmarks.task import Outcome, Task

__all__: list[str] = []

_META = {
    "api_version": "3.0",
    "type": "time-based",
    "models": {"Fmu": {"public": True, "params": ["task", "index", "report"], "attrs": ["input", "output"]}},
}


def run(task: Task) -> Outcome:
    """Timed from the first simulator's first step to the last one's last step."""
    system = task.system
    program = f"{sys.executable} -m benchmarks.contestants.mosaik_scenario %(addr)s"
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        reports = [Path(folder, str(index)) for index in range(len(system.members))]
        with mosaik.World({"Fmu": {"cmd": program, "cwd": str(Path.cwd())}}) as world:
            entities = [
                world.start("Fmu").Fmu(task=task.to_json(), index=index, report=str(report))
                for index, report in enumerate(reports)
            ]
            jacobi = system.algorithm == "jacobi"
            for index, entity in enumerate(entities):
                source = system.source_of(index)
                if source is not None:
                    shifted = {"time_shifted": True, "initial_data": {"output": task.initial_inputs[index]}}
                    world.connect(entities[source], entity, ("output", "input"), **(shifted if jacobi else {}))
            world.run(until=task.points, print_progress=False)
        ends = [json.loads(report.read_text()) for report in reports]
    seconds = max(end["end"] for end in ends) - min(end["start"] for end in ends)
    last = {member.column: end["last"] for member, end in zip(system.members, ends, strict=True)}
    return Outcome(seconds, last, versions("mosaik", "fmpy"))


class _Simulator(mosaik_api_v3.Simulator):  # type: ignore[misc] # Any, where mosaik is not installed
    """One FMU; one unit of mosaik's time is one communication step."""

    def __init__(self) -> None:
        super().__init__(_META)
        self._start = 0.0
        self._end = 0.0
        self._value = 0.0

    def create(self, _num: int, _model: str, *, task: str, index: int, report: str) -> list[dict[str, str]]:
        parsed = Task.from_json(task)
        self._step_size = parsed.system.step_size
        self._report = Path(report)
        self._instance = Fmu(parsed.system.members[index], parsed.stop_time)
        value = parsed.initial_inputs[index]
        if value is not None:
            self._instance.set(value)
        self._instance.fmu.exitInitializationMode()
        return [{"eid": "fmu", "type": "Fmu"}]

    def step(self, time: int, inputs: dict[str, Any], _max_advance: int) -> int:
        if not time:
            self._start = perf_counter()
        instance = self._instance
        for values in inputs.get("fmu", {}).get("input", {}).values():
            instance.fmu.setReal(instance.inputs, [values])
        instance.fmu.doStep(currentCommunicationPoint=time * self._step_size, communicationStepSize=self._step_size)
        self._value = instance.fmu.getReal(instance.outputs)[0]
        self._end = perf_counter()
        return time + 1

    def get_data(self, _outputs: dict[str, list[str]]) -> dict[str, dict[str, float]]:
        return {"fmu": {"output": self._value}}

    def finalize(self) -> None:
        self._instance.close()
        self._report.write_text(json.dumps({"start": self._start, "end": self._end, "last": self._value}))


if __name__ == "__main__":
    if ":" in sys.argv[1]:
        mosaik_api_v3.start_simulation(_Simulator())
    else:
        main(run)
