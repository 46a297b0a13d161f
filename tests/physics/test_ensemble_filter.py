"""`examples/ensemble_filter/`: a pendulum is tracked from noisy angles, and its damping is found."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from matplotlib import image

import fmu_mesh
from tests.helpers import Place

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "ensemble_filter"


def program() -> ModuleType:
    spec = importlib.util.spec_from_file_location("ensemble_filter_track", FOLDER / "track.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


TRACK = program()


@pytest.mark.parametrize("seed", range(1, 4))
def test_the_estimate_is_far_better_than_the_open_loop_and_the_sensor(seed: int) -> None:
    tracked = TRACK.track(seed)

    guided, unguided = TRACK.errors(tracked.estimated, tracked.true), TRACK.errors(tracked.unguided, tracked.true)
    assert (guided[:2] < unguided[:2] / 20.0).all()  # angle and angular velocity
    assert guided[2] < unguided[2] / 10.0  # damping
    assert guided[0] < TRACK.NOISE / 3.0
    # What it says of its own error is right: 99.7 of 100 normal errors are within three standard deviations.
    assert abs(tracked.estimated[-1, 2] - TRACK.TRUE[2]) < 3.0 * tracked.spread[-1, 2] < 0.02
    # And it had to be found: the guess is far off.
    assert abs(TRACK.GUESS[2] - TRACK.TRUE[2]) > 30.0 * tracked.spread[-1, 2]


def test_one_seed_gives_the_same_floats_again() -> None:
    assert [part.tolist() for part in TRACK.track(1)] == [part.tolist() for part in TRACK.track(1)]


def test_without_measurements_a_member_moves_as_its_own_run_does() -> None:
    mesh = fmu_mesh.load(FOLDER / "tracked_pendulum.yaml")
    members = TRACK.GUESS + TRACK.SPREAD * np.random.default_rng(1).standard_normal((3, 3))

    with mesh.batch(3) as batch:
        means, spreads = TRACK.filtered(batch, members, np.full(5, np.nan), np.random.default_rng(1))

    runs = [
        mesh.run(processes=False, record="memory", start_values=dict(zip(TRACK.STATE, member.tolist(), strict=True)))
        for member in members
    ]
    ends = np.array(
        [
            [*(run[name][5 * TRACK.POINTS] for name in TRACK.STATE[:2]), d]
            for run, d in zip(runs, members[:, 2], strict=True)
        ]
    )
    assert np.abs(means[-1] - ends.mean(axis=0)).max() < 1e-12
    assert np.abs(spreads[-1] - ends.std(axis=0, ddof=1)).max() < 1e-12


def test_a_correction_of_many_members_is_that_of_a_kalman_filter() -> None:
    """The gain of a large ensemble is the exact one, and the ensemble has the exact mean and covariance afterwards."""
    random, members = np.random.default_rng(1), 200_000
    before = np.array([[0.04, 0.03, 0.002], [0.03, 0.09, 0.001], [0.002, 0.001, 0.01]])
    mean, angle = np.array([0.2, -0.1, 0.3]), 0.35

    after = TRACK.corrected(random.multivariate_normal(mean, before, members), angle, random)

    gain = before[:, 0] / (before[0, 0] + TRACK.NOISE**2)
    exact = before - np.outer(gain, before[0])
    # Standard errors: a covariance has sqrt((ii * jj + ij^2) / members), and the gain is one over a variance.
    variances = before.diagonal()
    of_gain = np.sqrt((variances * variances[0] + before[0] ** 2) / members) / (before[0, 0] + TRACK.NOISE**2)
    of_mean = np.sqrt(exact.diagonal() / members + (of_gain * (angle - mean[0])) ** 2)
    assert (np.abs(after.mean(axis=0) - mean - gain * (angle - mean[0])) < 3.0 * of_mean).all()
    of_covariance = np.sqrt((np.outer(variances, variances) + before**2) / members)
    assert (np.abs(np.cov(after.T) - exact) < 3.0 * of_covariance).all()


def test_the_program_says_and_draws_what_it_tracked(place: Place) -> None:
    plot = place.folder / "new" / "tracked.png"

    done = place.start_command([sys.executable, str(FOLDER / "track.py"), "--plot", str(plot)])

    assert done.wait() == 0, done.story()
    found = re.search(r"damping: ([\d.]+) \+- ([\d.]+) 1/s, and 0\.12 1/s is true", done.output)
    assert found is not None
    assert abs(float(found[1]) - 0.12) < 3.0 * float(found[2])
    assert image.imread(plot).shape[0] > 100
