"""A user's program that runs a configuration file, as type checkers see it."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import fmu_mesh


def largest(file: Path) -> float:
    """The largest delayed angle."""
    mesh = fmu_mesh.load(file)
    check = mesh.check(stop_time=1.0)
    for finding in check.findings:
        place: str = finding.path
        print(place, finding.suggestion)
    result: fmu_mesh.Result = mesh.run(stop_time=1.0, record="memory", window=64, start_values={"pendulum.a": 1.0})
    times: NDArray[np.float64] = result.times
    values: NDArray[Any] = result["delay.y"]
    unit: str | None = result.units["pendulum.a"]
    print(times[-1], unit, result.summary, list(result))
    alone: fmu_mesh.Result = fmu_mesh.simulate(file, stop_time=1.0, start_values={"a": 1.3}, inputs={"u": 1.0})
    print(alone["a"])
    return float(values.max())


def mistaken(mesh: fmu_mesh.Mesh) -> None:
    """What a type checker has to find."""
    _ = mesh.run(stop_time="1.0")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    _ = mesh.run(stop=1.0)  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]


if __name__ == "__main__":
    print(largest(Path("configs/pendulum_delay.yaml")))
