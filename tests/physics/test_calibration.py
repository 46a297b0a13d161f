"""`examples/calibration/`: the parameters of a pendulum are found from a bag of measured angles."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from matplotlib import image
from rosbags.highlevel import AnyReader

import fmu_mesh
from tests.helpers import Place

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "calibration"


def program(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"calibration_{name}", FOLDER / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


MEASURE, FIT = program("measure"), program("fit")
TRUE = np.array([MEASURE.DAMPING, MEASURE.LENGTH])


@pytest.mark.parametrize("seed", range(1, 6))
def test_the_known_parameters_are_within_three_standard_errors(seed: int) -> None:
    """An estimate from noisy data has an error, and its standard error says how large it is.

    Three of them are what 99.7 of 100 estimates are within: this follows from the normal distribution of the noise, and
    was not chosen so that the test passes. The seeds are fixed, so the test gives the same result each time.
    """
    found = FIT.fitted(*MEASURE.measured(seed))

    assert (np.abs(found.values - TRUE) < 3.0 * found.errors).all()
    # The errors themselves are right: that of the noise is 1 / sqrt(2 * 500), so three of them are 10 %.
    assert 0.9 * MEASURE.NOISE < found.noise < 1.1 * MEASURE.NOISE
    assert (found.errors < 0.01 * TRUE).all()
    # And the parameters were found: the search began far away.
    assert (np.abs(np.array(FIT.START) - TRUE) > 30.0 * found.errors).all()


def test_without_noise_the_parameters_are_exact_up_to_the_interpolation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MEASURE, "NOISE", 0.0)

    found = FIT.fitted(*MEASURE.measured(1))

    # Both sides interpolate the same rows in the same way, so the residuals vanish with the parameters; the search ends
    # when a step changes a parameter by less than 1e-8 of it.
    assert np.abs(found.values / TRUE - 1.0).max() < 1e-7


def test_the_copies_of_an_iteration_are_runs_with_their_parameters() -> None:
    mesh = fmu_mesh.load(FOLDER / "pendulum.yaml")
    times, angles = MEASURE.measured(1)
    with mesh.batch(FIT.COPIES) as batch:
        model = FIT.Model(batch, times, angles)
        row_times, rows = model.run(TRUE)
        derivatives = model.derivatives(TRUE)

    for offsets, row in zip(FIT.OFFSETS, rows.T, strict=True):
        start_values = dict(zip(FIT.NAMES, (TRUE + offsets).tolist(), strict=True))
        result = mesh.run(processes=False, record="memory", start_values=start_values)
        assert (row_times.tolist(), row.tolist()) == (result.times.tolist(), result["pendulum.a"].tolist())
    # At an extreme of the free pendulum, more damping means a smaller angle; a longer one is behind.
    assert derivatives.shape == (len(times), 2)
    assert np.abs(derivatives).min(axis=0).max() < 1e-9 < np.abs(derivatives).max()


def test_both_programs_run_and_show_what_they_found(place: Place) -> None:
    bag, plot = place.folder / "measured.mcap", place.folder / "new" / "fit.png"

    measured = place.start_command([sys.executable, str(FOLDER / "measure.py"), "--output", str(bag)])
    assert measured.wait() == 0, measured.story()
    fitted = place.start_command([sys.executable, str(FOLDER / "fit.py"), str(bag), "--plot", str(plot)])
    assert fitted.wait() == 0, fitted.story()

    shown = re.findall(r"pendulum\.(\w) = ([\d.]+) \+- ([\d.]+)", fitted.output)
    assert [name for name, _, _ in shown] == ["d", "l"]
    for (_, value, error), true in zip(shown, TRUE, strict=True):
        assert abs(float(value) - true) < 3.0 * float(error)  # as above
    assert image.imread(plot).shape[0] > 100


def test_the_bag_has_the_angles_as_joint_states_with_unix_stamps(tmp_path: Path) -> None:
    times, angles = MEASURE.measured(1)
    bag = tmp_path / "measured.mcap"

    MEASURE.write(bag, times, angles)

    with AnyReader([bag]) as reader:
        assert {name: info.msgtype for name, info in reader.topics.items()} == {
            "/joint_states": "sensor_msgs/msg/JointState"
        }
        assert reader.start_time == MEASURE.BEGIN
    read_times, read_angles = FIT.read(bag, "/joint_states", "pendulum")
    assert read_angles.tolist() == angles.tolist()
    assert np.abs(read_times - times).max() <= 0.5e-9 * 1.001  # a stamp has whole nanoseconds
