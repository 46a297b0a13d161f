"""The tolerance that a co-simulation FMU is told, in a process of its own as in this one."""

from __future__ import annotations

import csv

import pytest

from tests.equivalence.test_events import both_ways
from tests.fmus.helpers import find_fmu
from tests.fmus.packing import repacked
from tests.helpers import Place


@pytest.mark.parametrize("name", ["Steps2", "Events3"])
def test_an_fmu_gets_the_tolerance_of_its_instance_its_experiment_or_none(name: str, place: Place) -> None:
    fmu = find_fmu(name, place.folder / "fmus")
    default = repacked(
        place.folder / "default.fmu",
        source=fmu,
        description=lambda text: text.replace("<DefaultExperiment ", '<DefaultExperiment tolerance="1e-5" '),
    )
    content = {
        # Without rounding: Events3 wants each step to start exactly where it is.
        "simulation": {"stop_time": 1.0, "step_size": 0.125},
        "instances": {
            "own": {"fmu": str(default), "tolerance": 1e-8},
            "default": {"fmu": str(default)},
            "none": {"fmu": str(fmu)},
        },
        "connections": [],
    }

    launched, local = both_ways(place, content)

    assert launched == local
    [*_, last] = csv.DictReader(launched.decode().splitlines())
    told = {instance: float(last[f"{instance}.tolerance"]) for instance in ("own", "default", "none")}
    assert told == {"own": 1e-8, "default": 1e-5, "none": -1.0}
    check = place.run("check", place.folder / "mesh.yaml")
    assert f"default.fmu (FMI {name[-1]}.0, tolerance 1e-08)" in check.output
