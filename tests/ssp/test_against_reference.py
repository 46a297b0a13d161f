"""A mesh that is launched from a package equals a plain loop over an independent reading of it, in every float."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers import Place
from tests.ssp.comparing import differences
from tests.ssp.own_systems import SYSTEMS, make_folder, make_package
from tests.ssp.reference_run import run_system
from tests.ssp.reference_system import read_system, solver_of


@pytest.mark.parametrize("algorithm", ["jacobi", "gauss_seidel"])
@pytest.mark.parametrize("name", SYSTEMS)
def test_a_launched_package_equals_a_plain_loop(name: str, algorithm: str, place: Place) -> None:
    own = SYSTEMS[name]()
    package = make_package(own, place.folder)
    system = read_system(package, place.folder / "unpacked")
    outputs, rows = run_system(system, step_size=own.step_size, stop_time=own.stop_time, algorithm=algorithm)

    result = place.folder / "result.csv"
    solver = [f"--set-config={key}={value}" for key, value in solver_of(system).items()]
    done = launch(place, package, result, "--step-size", str(own.step_size), "--algorithm", algorithm, *solver)

    assert done == 0, place.story()
    assert differences(result, outputs, rows) == []


@pytest.mark.parametrize("name", ["nested", "parameters"])
def test_a_folder_and_its_description_are_the_same_mesh_as_the_package(name: str, place: Place) -> None:
    own = SYSTEMS[name]()
    package, folder = make_package(own, place.folder), make_folder(own, place.folder / "folder")

    results = []
    for number, source in enumerate((package, folder, folder / "SystemStructure.ssd")):
        results.append(place.folder / f"{number}.csv")
        options = ("--local", "--step-size", str(own.step_size), "--algorithm", "jacobi")
        assert launch(place, source, results[-1], *options) == 0, place.story()

    assert len({result.read_bytes() for result in results}) == 1


def launch(place: Place, package: Path, result: Path, *options: str) -> int:
    return place.run("launch", package, "--output", result, "--no-progress", *options).wait()
