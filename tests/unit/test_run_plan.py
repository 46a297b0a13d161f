"""The plan of a run as a file: what other processes read from it is what was planned."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from msgspec.structs import replace

from fmu_mesh.errors import ConfigurationError, LoadFailed
from fmu_mesh.instances.fmi.archive.archive import sha256_of
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.opening import open_instance
from fmu_mesh.instances.fmi.step_options import Terms
from fmu_mesh.run.options import PlanOptions
from fmu_mesh.run.run_plan import RunPlan, read_node, read_run
from tests.helpers import FMUS
from tests.planning import plan_run

CONFIGS = FMUS.parent / "configs"


@pytest.fixture
def run() -> RunPlan:
    return plan_run(CONFIGS / "pendulum_delay.yaml", PlanOptions(window=64, output=Path("/tmp/other.csv")))  # noqa: S108 nothing is written there


def test_what_is_read_is_what_was_written(run: RunPlan, tmp_path: Path) -> None:
    assert read_run(run.write(tmp_path)) == run


@pytest.mark.parametrize("name", ["pendulum", "delay"])
def test_a_node_reads_its_own_part(run: RunPlan, tmp_path: Path, name: str) -> None:
    again = replace(run, run="4711", restarts=2)

    node = read_node(again.write(tmp_path), name)

    assert node == again.node(name)
    assert (node.run, node.plan.attempt.number, list(node.models)) == ("4711", 3, [name])


def test_values_that_json_does_not_have_stay_what_they_are(run: RunPlan, tmp_path: Path) -> None:
    system = run.plan.system
    own = system.instances["pendulum"]
    values = {"no number": math.nan, "infinite": -math.inf, "bytes": b"\xff\x00", "text": "/w=="}
    changed = replace(system, instances={**system.instances, "pendulum": replace(own, start_values=values)})

    read = read_run(replace(run, plan=replace(run.plan, system=changed)).write(tmp_path))

    assert repr(read.plan.system.instances["pendulum"].start_values) == repr(values)


@pytest.mark.parametrize("data", [b"", b"\xc1", b"{}", b"\x80", b"\x91" * 5000])
def test_a_file_that_is_no_run_plan_is_refused(tmp_path: Path, data: bytes) -> None:
    file = tmp_path / "run.plan"
    file.write_bytes(data)

    for read in (lambda: read_run(file), lambda: read_node(file, "pendulum")):
        with pytest.raises(ConfigurationError, match="is no run plan of this version"):
            read()


def test_an_fmu_that_is_another_one_than_was_planned_is_refused(tmp_path: Path) -> None:
    fmu = FMUS / "Gain.fmu"
    description, other = read_description(fmu), sha256_of(FMUS / "TransportDelay.fmu")

    with pytest.raises(LoadFailed, match="is not the FMU that this run was planned with"):
        open_instance(fmu, "gain", description, tmp_path, terms=Terms(content=other))

    open_instance(fmu, "gain", description, tmp_path, terms=Terms(content=sha256_of(fmu))).close()
