"""The cart pole through `Mesh.open()`: set, step and get as a learning program does it, and ways back to point 0."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import fmu_mesh
from benchmarks.contestants.entry import FMUS, main, versions
from benchmarks.task import Outcome, Task

__all__ = ["run"]


def run(task: Task) -> Outcome:
    """Timed is the loop alone; `what` is `steps`, `state`, `values` or `open`."""
    mesh = fmu_mesh.Mesh("environment", step_size=task.system.step_size, stop_time=None)
    mesh.add("cart", fmu=FMUS / "CartPole.fmu")
    with mesh.open() as system:
        system.reset()  # from now on there is a state of point 0
        loop = _LOOPS[task.options["what"]]
        started = perf_counter()
        last = loop(mesh, system, task.points)
        seconds = perf_counter() - started
    return Outcome(seconds, {"cart.theta": last}, versions("fmu-mesh", "numpy"))


def _steps(_: fmu_mesh.Mesh, system: fmu_mesh.System, points: int) -> float:
    found = 0.0
    for _ in range(points):
        system.set("cart.force", -1.0 if found > 0.0 else 1.0)
        system.step()
        found = system.get("cart.theta")
    return found


def _states(_: fmu_mesh.Mesh, system: fmu_mesh.System, points: int) -> float:
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
