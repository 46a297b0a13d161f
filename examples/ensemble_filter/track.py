"""Tracks a pendulum by an ensemble Kalman filter: angle, angular velocity and damping, from noisy angles.

The ensemble is a batch: each copy of the mesh is a pendulum that could be the real one. Between two measurements all
copies move on. A measurement moves each copy towards what it says, as far as the spread of the copies is larger than
the noise. From the root of the repository:

    python examples/ensemble_filter/track.py --plot results/tracked.png
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import fmu_mesh

STATE = ("pendulum.a", "pendulum.der(a)", "pendulum.d")
"""What is estimated, in rad, rad/s, 1/s. The damping is a parameter, so nothing but a measurement changes it."""

TRUE = (1.3, 0.5, 0.12)
"""Where the real pendulum begins, and its damping; only the measurements know it."""

GUESS, SPREAD = np.array([1.0, 0.0, 0.3]), np.array([0.3, 0.5, 0.1])
"""What is known at the start: mean and standard deviation."""

NOISE = 0.05
"""Standard deviation of the sensor in rad."""

POINTS = 20
"""Communication points between two measurements: 0.2 s."""

MEMBERS = 60

Array = NDArray[np.float64]


class Tracked(NamedTuple):
    """What was tracked; all rows are those of the measurements.

    Attributes:
        times: in s, of shape (rows,).
        measured: angles in rad, of shape (rows,).
        true: the real state, of shape (rows, 3).
        estimated: means of the ensemble, of shape (rows, 3).
        spread: standard deviations of the ensemble, of shape (rows, 3).
        unguided: means of the same ensemble without measurements, of shape (rows, 3).
    """

    times: Array
    measured: Array
    true: Array
    estimated: Array
    spread: Array
    unguided: Array


def main() -> None:
    """Track a pendulum, and show how well."""
    parser = argparse.ArgumentParser(description="Track a pendulum from noisy angles.")
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    tracked = track(options.seed)
    guided, unguided = errors(tracked.estimated, tracked.true), errors(tracked.unguided, tracked.true)
    print(f"angle: error {guided[0]:.4f} rad, without measurements {unguided[0]:.4f} rad; noise {NOISE} rad")
    print(f"angular velocity: error {guided[1]:.4f} rad/s, without measurements {unguided[1]:.4f} rad/s")
    print(f"damping: {tracked.estimated[-1, 2]:.3f} +- {tracked.spread[-1, 2]:.3f} 1/s, and {TRUE[2]} 1/s is true")
    if options.plot is not None:
        draw(options.plot, tracked)


def track(seed: int) -> Tracked:
    """Measure a pendulum, and track it."""
    random = np.random.default_rng(seed)
    mesh = fmu_mesh.load(Path(__file__).with_name("tracked_pendulum.yaml"))
    times, true = real(mesh)
    measured = true[:, 0] + random.normal(0.0, NOISE, len(times))
    ensemble = GUESS + SPREAD * random.standard_normal((MEMBERS, len(STATE)))
    with mesh.batch(MEMBERS) as batch:
        estimated, spread = filtered(batch, ensemble, measured, random)
        unguided, _ = filtered(batch, ensemble, np.full(len(times), np.nan), random)
    return Tracked(times, measured, true, estimated, spread, unguided)


def real(mesh: fmu_mesh.Mesh) -> tuple[Array, Array]:
    """The times of the measurements in s, and the states of the real pendulum then."""
    result = mesh.run(processes=False, record="memory", start_values=dict(zip(STATE, TRUE, strict=True)))
    moving = [result[name][POINTS::POINTS] for name in STATE[:2]]
    return result.times[POINTS::POINTS], np.column_stack([*moving, np.full(len(moving[0]), TRUE[2])])


def filtered(
    batch: fmu_mesh.Batch, ensemble: Array, measured: Array, random: np.random.Generator
) -> tuple[Array, Array]:
    """Mean and standard deviation of the ensemble after each measurement; NaN: there is none."""
    means, spreads = [], []
    batch.reset(start_values=dict(zip(STATE, ensemble.T, strict=True)))
    for angle in measured:
        batch.step(POINTS)
        ensemble = np.column_stack([batch.get(list(STATE[:2])), ensemble[:, 2]])
        if np.isfinite(angle):
            ensemble = corrected(ensemble, angle, random)
            # A state cannot be set in the middle of a run. So the copies begin anew from it: their time starts at 0
            # again, which is right for a model that does not depend on time.
            batch.reset(start_values=dict(zip(STATE, ensemble.T, strict=True)))
        means.append(ensemble.mean(axis=0))
        spreads.append(ensemble.std(axis=0, ddof=1))
    return np.array(means), np.array(spreads)


def corrected(ensemble: Array, angle: float, random: np.random.Generator) -> Array:
    """The ensemble after a measurement: the Kalman gain, with the covariance of the members.

    Each member sees the measurement with a noise of its own (Burgers et al., 1998): without it, the spread would become
    smaller than the error is.
    """
    off = ensemble - ensemble.mean(axis=0)
    covariance = off.T @ off[:, 0] / (len(ensemble) - 1)  # of each part of the state with the angle
    gain = covariance / (covariance[0] + NOISE**2)
    seen = angle + random.normal(0.0, NOISE, len(ensemble))
    return ensemble + np.outer(seen - ensemble[:, 0], gain)


def errors(estimated: Array, true: Array) -> Array:
    """The root mean square error of each part of the state in the second half."""
    half = len(true) // 2
    return np.sqrt(((estimated - true)[half:] ** 2).mean(axis=0))


def draw(path: Path, tracked: Tracked) -> None:
    """Draw the angle and the damping, with what the filter is sure of."""
    from matplotlib.figure import Figure  # noqa: PLC0415  only this needs it

    figure = Figure(figsize=(8.4, 5.6), dpi=120, layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
    times = tracked.times
    above.plot(times, tracked.measured, ".", color="0.6", markersize=4, label="measured")
    above.plot(times, tracked.true[:, 0], color="0.1", linewidth=1.0, label="real")
    above.plot(times, tracked.estimated[:, 0], color="C0", label="estimated")
    above.plot(times, tracked.unguided[:, 0], "--", color="C3", linewidth=1.0, label="without measurements")
    above.set_ylabel("angle in rad")
    above.legend(ncols=2, fontsize=8)
    mean, spread = tracked.estimated[:, 2], tracked.spread[:, 2]
    below.fill_between(times, mean - 2.0 * spread, mean + 2.0 * spread, color="C0", alpha=0.2, linewidth=0.0)
    below.plot(times, mean, color="C0", label="estimated, with 2 standard deviations")
    below.plot(times, tracked.true[:, 2], color="0.1", linewidth=1.0, label="real")
    below.set_ylabel("damping in 1/s")
    below.set_xlabel("time in s")
    below.legend(fontsize=8)
    for axes in (above, below):
        axes.grid(alpha=0.35)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


if __name__ == "__main__":
    main()
