"""The cart pole through FMPy, as its users write an environment: `setReal`, `doStep`, `getReal`, and `reset`."""

from __future__ import annotations

from time import perf_counter

from benchmarks.contestants.c_environment import INPUT, OUTPUT, OUTPUTS
from benchmarks.contestants.entry import main, versions
from benchmarks.contestants.fmu import Fmu
from benchmarks.task import Member, Outcome, Task

__all__ = ["run"]


def run(task: Task) -> Outcome:
    """Timed is the loop alone; `what` is `steps`, `batch` or `values`."""
    if task.options["what"] == "batch":
        return _batch(task)
    cart = Fmu(Member("cart", "CartPole", INPUT, OUTPUT), None)
    try:
        cart.fmu.exitInitializationMode()
        loop = _steps if task.options["what"] == "steps" else _values
        started = perf_counter()
        last = loop(cart, task)
        seconds = perf_counter() - started
    finally:
        cart.close()
    return Outcome(seconds, {f"cart.{OUTPUT}": last}, versions("fmpy"))


def _batch(task: Task) -> Outcome:
    carts = [Fmu(Member("cart", "CartPole", INPUT, OUTPUT), None) for _ in range(int(task.options["copies"]))]
    step_size, found = task.system.step_size, [[0.0] * len(OUTPUTS) for _ in carts]
    references = [carts[0].references[name] for name in OUTPUTS]
    try:
        for cart in carts:
            cart.fmu.exitInitializationMode()
        started = perf_counter()
        for point in range(task.points // len(carts)):
            for number, cart in enumerate(carts):
                cart.fmu.setReal(cart.inputs, [-1.0 if found[number][0] > 0.0 else 1.0])
                cart.fmu.doStep(currentCommunicationPoint=point * step_size, communicationStepSize=step_size)
                found[number] = cart.fmu.getReal(references)
        seconds = perf_counter() - started
    finally:
        for cart in carts:
            cart.close()
    return Outcome(seconds, {f"cart.{OUTPUT}": found[-1][0]}, versions("fmpy"))


def _steps(cart: Fmu, task: Task) -> float:
    fmu, step_size, found = cart.fmu, task.system.step_size, 0.0
    for point in range(task.points):
        fmu.setReal(cart.inputs, [-1.0 if found > 0.0 else 1.0])
        fmu.doStep(currentCommunicationPoint=point * step_size, communicationStepSize=step_size)
        found = fmu.getReal(cart.outputs)[0]
    return found


def _values(cart: Fmu, task: Task) -> float:
    fmu, found = cart.fmu, 0.0
    for point in range(task.points):
        fmu.reset()
        fmu.setupExperiment(startTime=0.0)
        fmu.setReal(cart.outputs, [0.001 * point])
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        found = fmu.getReal(cart.outputs)[0]
    return found


if __name__ == "__main__":
    main(run)
