"""The cart pole through `Mesh.open()`: set, step and get as a learning program does it, and ways back to point 0."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import numpy as np

import fmu_mesh
from benchmarks.contestants.c_environment import OUTPUTS
from benchmarks.contestants.entry import FMUS, main, versions
from benchmarks.task import Outcome, Task

__all__ = ["run"]


def run(task: Task) -> Outcome:
    """Timed is the loop alone; `what` is `steps`, `batch`, `state`, `values` or `open`."""
    mesh = fmu_mesh.Mesh("environment", step_size=task.system.step_size, stop_time=None)
    mesh.add("cart", fmu=FMUS / "CartPole.fmu")
    if task.options["what"] == "batch":
        return _batch(mesh, task)
    if task.options["what"] == "batch_state":
        return _batch_states(mesh, task)
    with mesh.open() as system:
        system.reset()  # from now on there is a state of point 0
        loop = _LOOPS[task.options["what"]]
        started = perf_counter()
        last = loop(mesh, system, task.points)
        seconds = perf_counter() - started
    return Outcome(seconds, {"cart.theta": last}, versions("fmu-mesh", "numpy"))


def _batch(mesh: fmu_mesh.Mesh, task: Task) -> Outcome:
    copies = int(task.options["copies"])
    names = [f"cart.{name}" for name in OUTPUTS]
    threads, processes = (int(task.options.get(name, "1")) for name in ("threads", "processes"))
    with mesh.batch(copies, threads=threads, processes=processes) as batch:
        found = np.zeros((copies, len(names)))
        started = perf_counter()
        for _ in range(task.points // copies):
            batch.set("cart.force", np.where(found[:, 0] > 0.0, -1.0, 1.0))
            batch.step()
            batch.get(names, out=found)
        seconds = perf_counter() - started
    return Outcome(seconds, {names[0]: float(found[-1, 0])}, versions("fmu-mesh", "numpy"))


def _batch_states(mesh: fmu_mesh.Mesh, task: Task) -> Outcome:
    copies = int(task.options["copies"])
    with mesh.batch(copies, processes=1) as batch:
        batch.reset()  # from now on there are states of point 0
        found = np.zeros(copies)
        started = perf_counter()
        for _ in range(task.points // copies):
            batch.reset()
            batch.get("cart.theta", out=found)
        seconds = perf_counter() - started
    return Outcome(seconds, {"cart.theta": float(found[-1])}, versions("fmu-mesh", "numpy"))


def _steps(_mesh: fmu_mesh.Mesh, system: fmu_mesh.System, points: int) -> float:
    found = 0.0
    for _ in range(points):
        system.set("cart.force", -1.0 if found > 0.0 else 1.0)
        system.step()
        found = system.get("cart.theta")
    return found


def _states(_mesh: fmu_mesh.Mesh, system: fmu_mesh.System, points: int) -> float:
    found = 0.0
    for _ in range(points):
        system.reset()
        found = system.get("cart.theta")
    return found


def _values(_: fmu_mesh.Mesh, system: fmu_mesh.System, points: int) -> float:
    found = 0.0
    for point in range(points):
        system.reset({"cart.theta": 0.001 * point})
        found = system.get("cart.theta")
    return found


def _opens(mesh: fmu_mesh.Mesh, _: fmu_mesh.System, points: int) -> float:
    found = 0.0
    for point in range(points):
        with mesh.open({"cart.theta": 0.001 * point}) as system:
            found = system.get("cart.theta")
    return found


_LOOPS: dict[str, Callable[[fmu_mesh.Mesh, fmu_mesh.System, int], float]] = {
    "steps": _steps,
    "state": _states,
    "values": _values,
    "open": _opens,
}

if __name__ == "__main__":
    main(run)
