"""Which checkpoints of a run are kept: a restart begins with one of which the result files have all rows before it."""

from __future__ import annotations

from pathlib import Path

import pytest
from msgspec.structs import replace

from fmu_mesh.files import Kept
from fmu_mesh.results.block_file import BlockFile
from fmu_mesh.run.options import PlanOptions
from fmu_mesh.run.run_plan import RunPlan
from fmu_mesh.run.state_file import STATE, again_from_checkpoint, drop_older, keeper, state_bytes
from tests.helpers import write_config
from tests.planning import plan_run


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunPlan:
    """A run that writes a row of each point."""
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(tmp_path / "run"))
    config = write_config(tmp_path, recovery={"mode": "restart"})
    planned = replace(plan_run(config, PlanOptions()), run="own", max_restarts=3)
    planned.kept_in.mkdir(parents=True, exist_ok=True)
    return planned


def kept_points(run: RunPlan) -> list[int]:
    return sorted(int(file.stem) for file in run.kept_in.glob(f"*{STATE}"))


def write(run: RunPlan, *points: int) -> None:
    keep = keeper(run, None)
    for point in points:
        keep(point, state_bytes(run, point, dict.fromkeys(run.contents, b"")))


def test_checkpoints_wait_for_rows_however_many_there_are(run: RunPlan) -> None:
    write(run, 100, 200, 300, 400, 500)

    drop_older(run.kept_in, run.plan, [Kept(rows=250)], 0)

    assert kept_points(run) == [200, 300, 400, 500]
    again = again_from_checkpoint(run, run.kept_in, [250])
    assert again.plan.grid.first_point == 200


def test_no_checkpoint_goes_before_there_are_rows(run: RunPlan) -> None:
    write(run, 100, 200, 300)

    drop_older(run.kept_in, run.plan, [Kept()], 0)

    assert kept_points(run) == [100, 200, 300]
    assert again_from_checkpoint(run, run.kept_in, [0]).plan.grid.first_point == 0


def test_a_run_without_files_keeps_the_newest_checkpoint(run: RunPlan) -> None:
    system = replace(run.plan.system, records=())

    write(replace(run, plan=replace(run.plan, system=system)), 100, 200, 300)

    assert kept_points(run) == [300]


def test_a_checkpoint_that_is_being_written_is_left_alone(run: RunPlan) -> None:
    write(run, 100, 200)
    draft = run.kept_in / f"300.unfinished{STATE}"
    draft.write_bytes(b"FMUSTATE")

    drop_older(run.kept_in, run.plan, [Kept(rows=1000)], 0)

    assert draft.exists()
    assert again_from_checkpoint(run, run.kept_in, [1000]).plan.grid.first_point == 200


def test_where_files_cannot_go_on_there_are_no_checkpoints(run: RunPlan, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run.checkpoint_s == 0.2

    monkeypatch.delattr(BlockFile, "resume")

    assert run.checkpoint_s is None
