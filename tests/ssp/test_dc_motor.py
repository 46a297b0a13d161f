"""A DC motor of two models for model exchange reaches its steady state."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import pytest

import fmu_mesh
from tests.ssp.dc_motor import steady_state
from tests.ssp.own_systems import SYSTEMS, make_package
from tests.ssp.reference_run import run_system
from tests.ssp.reference_system import read_system

SPEED, CURRENT = steady_state(voltage=12.0, torque=-0.5, resistance=0.5, constant=0.1, damping=0.001)


def test_the_closed_form_is_that_of_the_public_system() -> None:
    assert pytest.approx((90.47619047619048, 5.904761904761905), rel=1e-15) == (SPEED, CURRENT)


def test_the_reference_reaches_the_steady_state(tmp_path: Path) -> None:
    own = SYSTEMS["dc motor"]()
    system = read_system(make_package(own, tmp_path), tmp_path / "unpacked")

    outputs, rows = run_system(system, step_size=own.step_size, stop_time=own.stop_time)

    assert [fmu.kind for fmu in system.fmus.values()] == ["model_exchange", "model_exchange", *["co_simulation"] * 2]
    last = {name: value for (_, name), value in zip(outputs, rows[-1][1:], strict=True)}
    assert (last["w"], last["I"]) == pytest.approx((SPEED, CURRENT), rel=1e-11)


@pytest.mark.parametrize("algorithm", ["jacobi", "gauss_seidel"])
def test_the_mesh_reaches_the_steady_state_by_model_exchange(
    algorithm: Literal["jacobi", "gauss_seidel"], tmp_path: Path
) -> None:
    package = make_package(SYSTEMS["dc motor"](), tmp_path)

    mesh = fmu_mesh.load(package)
    result = mesh.run(processes=False, record="memory", step_size=0.001, stop_time=3.0, algorithm=algorithm)

    assert (result["SuT-rotor.w"][-1], result["SuT-winding.I"][-1]) == pytest.approx((SPEED, CURRENT), rel=1e-11)
