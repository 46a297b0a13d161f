"""Six complete programs, as a user writes them, each as a process of its own."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

from tests.helpers import Launched, Place

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = Path(__file__).parent / "programs"


@pytest.fixture
def clone(place: Place) -> Place:
    """A place with the files that the programs use."""
    for name in ("configs", "fmus"):
        shutil.copytree(ROOT / name, place.folder / name)
    return place


def run(place: Place, program: str) -> Launched:
    done = place.start_command([sys.executable, str(shutil.copy(PROGRAMS / f"{program}.py", place.folder))])
    assert done.wait() == 0, done.errors
    assert not done.errors
    place.assert_nothing_left(10.0)
    return done


def test_one_fmu_is_simulated_in_one_call_that_writes_nothing(clone: Place) -> None:
    assert run(clone, "one_call").output == "1.3 10.0\n"
    assert {path.name for path in clone.folder.iterdir()} == {"configs", "fmus", "one_call.py", "run", "tmp"}


def test_a_file_is_run_and_its_results_are_arrays(clone: Place) -> None:
    done = run(clone, "run_a_file")

    assert done.output.startswith("40.0 1.3 rad 20000 points in ")
    assert (clone.folder / "angles.png").stat().st_size > 10_000
    assert (clone.folder / "results" / "pendulum_delay.csv").exists()


def test_a_mesh_without_a_file_has_a_component_in_python(clone: Place) -> None:
    done = run(clone, "component")

    values = [float(text) for text in done.output.replace("[", " ").replace("]", " ").replace("...", " ").split()]
    assert len(values) > 5
    assert any(value != 0.0 for value in values)


def test_a_run_is_started_steered_and_waited_for(clone: Place) -> None:
    value, point = run(clone, "steer").output.split()

    assert float(value) in (0.0, 3.0)
    assert int(point) < 1000


def test_a_mesh_is_stepped_by_hand(clone: Place) -> None:
    time, _ = run(clone, "step_by_hand").output.split()

    assert float(time) == 1.0


def test_a_mesh_that_somebody_else_started_is_attached_to(clone: Place) -> None:
    launched = clone.start("launch", clone.folder / "configs" / "pendulum_delay.yaml", "--real-time-factor", "4")
    assert clone.run("wait", "pendulum_delay").wait() == 0

    done = clone.start_command([sys.executable, str(PROGRAMS / "attach.py")])

    assert done.wait() == 0, done.errors
    values = [float(line) for line in done.output.splitlines()]
    assert len(values) > 1
    assert launched.wait() == 0
    clone.assert_nothing_left(10.0)
