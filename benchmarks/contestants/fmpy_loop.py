"""FMPy in one process, as its users write it: `setReal`, `doStep`, `getReal` with lists, and the rows to a list."""

from __future__ import annotations

from time import perf_counter

from benchmarks.contestants.entry import main, versions
from benchmarks.contestants.fmu import Fmu, opened_all
from benchmarks.task import Outcome, Task

__all__: list[str] = []


def run(task: Task) -> Outcome:
    """Step all instances; timed is the loop alone."""
    with opened_all(task.system, task.stop_time) as (fmus, _):
        loop = _cycle if task.system.kind == "cycle" else _chain if len(fmus) == 2 else _long_chain
        started = perf_counter()
        rows = loop(fmus, task)
        seconds = perf_counter() - started
    names = [member.column for member in task.system.members]
    return Outcome(seconds, dict(zip(names, rows[-1], strict=True)), versions("fmpy"))


def _chain(fmus: list[Fmu], task: Task) -> list[tuple[float, ...]]:
    """Gauss-Seidel: the second instance takes what the first one has just computed."""
    (first, second), step_size = fmus, task.system.step_size
    source, source_outputs = first.fmu, first.outputs
    target, target_inputs, target_outputs = second.fmu, second.inputs, second.outputs
    rows: list[tuple[float, ...]] = []
    for point in range(task.points):
        time = point * step_size
        source.doStep(currentCommunicationPoint=time, communicationStepSize=step_size)
        values = source.getReal(source_outputs)
        target.setReal(target_inputs, values)
        target.doStep(currentCommunicationPoint=time, communicationStepSize=step_size)
        rows.append((values[0], target.getReal(target_outputs)[0]))
    return rows


def _long_chain(fmus: list[Fmu], task: Task) -> list[tuple[float, ...]]:
    """Gauss-Seidel with any number of instances."""
    step_size = task.system.step_size
    rows: list[tuple[float, ...]] = []
    for point in range(task.points):
        time, values, row = point * step_size, None, []
        for fmu in fmus:
            if values is not None:
                fmu.fmu.setReal(fmu.inputs, values)
            fmu.fmu.doStep(currentCommunicationPoint=time, communicationStepSize=step_size)
            values = fmu.fmu.getReal(fmu.outputs)
            row.append(values[0])
        rows.append(tuple(row))
    return rows


def _cycle(fmus: list[Fmu], task: Task) -> list[tuple[float, ...]]:
    """Jacobi: both take what the other had at the start of the step."""
    (a, b), step_size = fmus, task.system.step_size
    first, first_inputs, first_outputs = a.fmu, a.inputs, a.outputs
    second, second_inputs, second_outputs = b.fmu, b.inputs, b.outputs
    first_values, second_values = first.getReal(first_outputs), second.getReal(second_outputs)
    rows: list[tuple[float, ...]] = []
    for point in range(task.points):
        time = point * step_size
        first.setReal(first_inputs, second_values)
        second.setReal(second_inputs, first_values)
        first.doStep(currentCommunicationPoint=time, communicationStepSize=step_size)
        second.doStep(currentCommunicationPoint=time, communicationStepSize=step_size)
        first_values, second_values = first.getReal(first_outputs), second.getReal(second_outputs)
        rows.append((first_values[0], second_values[0]))
    return rows


if __name__ == "__main__":
    main(run)
