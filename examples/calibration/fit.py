"""Finds the damping and the length of a pendulum from a bag of measured angles, by least squares.

Each iteration needs the model with the present parameters, and its derivatives by all of them. These are runs with
parameters beside the present ones: copies of the mesh, which are stepped together as one batch.

From the root of the repository, after `measure.py`:

    python examples/calibration/fit.py results/measured.mcap --plot results/calibration.png
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from scipy.optimize import least_squares

import fmu_mesh

NAMES = ("pendulum.d", "pendulum.l")
START = (0.1, 1.0)
"""Where the search begins: 1/s, m."""

BESIDE = 1e-4 * np.array(START)
"""How far beside the present parameters a derivative is taken; far above the error of the solver in the FMU."""

OFFSETS = np.vstack([np.zeros(len(NAMES)), np.diag(BESIDE), np.diag(-BESIDE)])
"""The parameters of each copy, less the present ones."""

COPIES = len(OFFSETS)

Array = NDArray[np.float64]


class Fit(NamedTuple):
    """What was found.

    Attributes:
        values: the estimates, in the order of `NAMES`.
        errors: their standard errors.
        noise: standard deviation of the residuals in rad.
        batches: how often the copies were run.
        times: the time of each row of the model in s.
        angles: the angle of the model with the estimates in rad.
    """

    values: Array
    errors: Array
    noise: float
    batches: int
    times: Array
    angles: Array


def main() -> None:
    """Read the bag, fit the model, and draw both."""
    parser = argparse.ArgumentParser(description="Fit the pendulum to a bag.")
    parser.add_argument("bag", type=Path)
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args()
    times, angles = read(options.bag, "/joint_states", "pendulum")
    found = fitted(times, angles)
    for name, value, error in zip(NAMES, found.values, found.errors, strict=True):
        print(f"{name} = {value:.4f} +- {error:.4f}")
    print(f"noise {found.noise:.4f} rad, {found.batches} batches of {COPIES} runs")
    if options.plot is not None:
        draw(options.plot, times, angles, found)


def read(bag: Path, topic: str, joint: str) -> tuple[Array, Array]:
    """The times of the stamps in s, beginning at 0, and the positions of a joint in rad."""
    stamps, positions = [], []
    with AnyReader([bag]) as reader:
        connections = [connection for connection in reader.connections if connection.topic == topic]
        for connection, _, data in reader.messages(connections):
            message: Any = reader.deserialize(data, connection.msgtype)
            stamps.append(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)
            positions.append(message.position[message.name.index(joint)])
    return (np.array(stamps) - stamps[0]) / 1e9, np.array(positions)


class Model:
    """The pendulum with the parameters of an iteration and those beside them, in one batch.

    Args:
        batch: the copies.
        times: when the angle was measured, in s.
        angles: what was measured, in rad.
    """

    def __init__(self, batch: fmu_mesh.Batch, times: Array, angles: Array) -> None:
        self.batches = 0
        self._batch = batch
        self._times, self._angles = times, angles
        self._at = np.full(len(NAMES), np.nan)

    def residuals(self, values: Array) -> Array:
        """What the model is off at each measurement in rad, with these parameters."""
        return self._computed(values)[0]

    def derivatives(self, values: Array) -> Array:
        """The derivatives of the residuals by the parameters: a row for each measurement."""
        return self._computed(values)[1]

    def run(self, values: Array) -> tuple[Array, Array]:
        """Run all copies: the times of the rows in s, and angles in rad of shape (rows, copies)."""
        batch = self._batch
        self.batches += 1
        batch.reset(start_values=dict(zip(NAMES, (values + OFFSETS).T, strict=True)))
        times, rows = [batch.time[0]], [batch.get("pendulum.a")]
        while not batch.done.any():
            batch.step()
            times.append(batch.time[0])
            rows.append(batch.get("pendulum.a"))
        return np.array(times), np.array(rows)

    def _computed(self, values: Array) -> tuple[Array, Array]:
        """Residuals and derivatives: least_squares asks for both at the same parameters, one after the other."""
        if not np.array_equal(values, self._at):
            times, rows = self.run(values)
            middle, *beside = (np.interp(self._times, times, one) for one in rows.T)
            above, below = np.array(beside).reshape(2, len(NAMES), -1)
            self._kept = middle - self._angles, ((above - below) / (2.0 * BESIDE[:, None])).T
            self._at = values.copy()
        return self._kept


def fitted(times: Array, angles: Array) -> Fit:
    """The damping and the length with the least squares of the residuals."""
    with fmu_mesh.load(Path(__file__).with_name("pendulum.yaml")).batch(COPIES) as batch:
        model = Model(batch, times, angles)
        limits = [0.0, 0.1], [np.inf, np.inf]
        found = least_squares(model.residuals, START, model.derivatives, bounds=limits, x_scale=START)
        batches = model.batches
        row_times, rows = model.run(found.x)
    noise = np.sqrt(2.0 * found.cost / (len(times) - len(START)))
    errors = noise * np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))
    return Fit(found.x, errors, float(noise), batches, row_times, rows[:, 0])


def draw(path: Path, times: Array, angles: Array, found: Fit) -> None:
    """Draw measured and fitted angles, and below them what remains."""
    from matplotlib.figure import Figure  # noqa: PLC0415  only this needs it

    figure = Figure(figsize=(8.4, 5.0), dpi=120, layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    above.plot(times, angles, ".", color="0.6", markersize=4, label="measured")
    damping, length = found.values
    above.plot(found.times, found.angles, color="C0", label=f"fitted: d = {damping:.4f} 1/s, l = {length:.4f} m")
    above.set_ylabel("angle in rad")
    above.legend()
    below.plot(times, angles - np.interp(times, found.times, found.angles), ".", color="0.4", markersize=3)
    below.axhspan(-2.0 * found.noise, 2.0 * found.noise, color="C0", alpha=0.15, label="2 standard deviations")
    below.set_ylabel("residual in rad")
    below.set_xlabel("time in s")
    below.legend(loc="upper right", fontsize=8)
    for axes in (above, below):
        axes.grid(alpha=0.35)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


if __name__ == "__main__":
    main()
