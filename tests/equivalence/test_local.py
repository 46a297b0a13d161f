"""A run in one process: paced by the wall clock, without a result, and ended while an FMU does not return."""

from __future__ import annotations

import re
import signal
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import msgspec
import pytest

from fmu_mesh.config.loading import LoadedConfig
from fmu_mesh.errors import FmuError, Interrupted, StepFailed
from fmu_mesh.results.record_files import open_results
from fmu_mesh.run.repeated import RepeatedRuns
from fmu_mesh.run.run_plan import RunPlan
from fmu_mesh.system.plan import Plan
from tests.helpers import Place, row_count, rows_of, wait_until, write_config
from tests.planning import plan_run
from tests.scenarios.scenario import Counter, Scenario

MODES = pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])


def seconds_in(output: str) -> float:
    found = re.search(r"points in ([\d.]+) s", output)
    assert found is not None, output
    return float(found[1])


@pytest.mark.parametrize("options", [(), ("--real-time-factor", "2")], ids=["file", "option"])
def test_the_wall_clock_holds_a_run_in_one_process_too(place: Place, options: tuple[str, ...]) -> None:
    """The step that ends at point 601 begins at point 600, 0.3 s after the first."""
    simulation = {} if options else {"real_time_factor": 2}
    config = write_config(place.folder, stop_time=0.601, simulation=simulation)
    paced, free = place.folder / "paced.csv", place.folder / "free.csv"

    slow = place.run("launch", config, "--local", "--output", paced, *options)
    fast = place.run("launch", config, "--local", "--output", free, "--real-time-factor", "0")

    assert (slow.wait(), fast.wait()) == (0, 0), slow.errors
    assert seconds_in(slow.output) >= 0.3
    assert paced.read_bytes() == free.read_bytes()


def test_a_paced_local_run_shows_its_rows_and_ends_by_ctrl_c(place: Place) -> None:
    config = write_config(place.folder, stop_time=10_000.0, simulation={"real_time_factor": 1, "step_size": 0.01})
    result = config.with_suffix(".csv")
    launched = place.start("launch", config, "--local")
    wait_until(lambda: row_count(result) > 30, "rows")

    launched.signal(signal.SIGINT)

    assert launched.wait() == 130
    rows = rows_of(result)
    assert len(rows) < 1000
    assert f"({len(rows)} rows) is in '{result}'" in launched.message
    place.assert_nothing_left()


def test_a_step_that_waits_for_the_wall_clock_does_not_hang(place: Place) -> None:
    simulation = {"real_time_factor": 1, "step_size": 2.5}
    config = write_config(
        place.folder,
        instances={"gain": {"fmu": "Gain"}},
        connections=[],
        stop_time=5.0,
        simulation=simulation,
        timeouts={"step": 1.0},
    )

    launched = place.run("launch", config, "--local")

    assert launched.wait() == 0, launched.errors
    assert len(rows_of(config.with_suffix(".csv"))) == 3


@MODES
def test_without_a_result_file_an_output_may_be_unconnected(place: Place, options: tuple[str, ...]) -> None:
    launched = place.run("launch", write_config(place.folder, record={"file": None}), *options)

    assert launched.wait() == 0, launched.errors
    assert "result" not in launched.output
    assert "1000 points in" in launched.output


class Ended(Counter):
    """An instance whose fourth step is given up from outside, as by Ctrl-C when an FMU does not return.

    Args:
        give_up: what is called then, on another thread.
    """

    def __init__(self, plan: Plan, name: str, give_up: Callable[[], None]) -> None:
        super().__init__(plan, name)
        self._give_up = give_up

    def do_step(self, step: int) -> None:
        if step == 3:
            thread = threading.Thread(target=self._give_up)
            thread.start()
            thread.join()
            raise StepFailed("the process has ended here", instance="b")
        super().do_step(step)


def test_rows_before_a_hanging_step_are_kept(tmp_path: Path) -> None:
    result = tmp_path / "result.csv"
    plan = Scenario(("a -> b",), points=10).plan(record=True)
    records = (msgspec.structs.replace(plan.system.records[0], file=str(result)),)
    plan = msgspec.structs.replace(plan, system=msgspec.structs.replace(plan.system, records=records))
    loaded = LoadedConfig(plan.system.config, Path())
    found: list[str] = []

    def give_up() -> None:
        runs.save(Interrupted("interrupted"))
        found.append(result.read_text())

    runs = RepeatedRuns(
        tmp_path, open_instance=lambda name: Ended(plan, name, give_up) if name == "b" else Counter(plan, name)
    )
    with closing(runs), pytest.raises(StepFailed):
        runs.run(RunPlan(loaded, plan, {}), lambda: open_results(loaded, plan.system))

    assert found == ["time,a.point,b.point\n" + "".join(f"{k}.0,{k}.0,{k}.0\n" for k in range(4))]
    assert result.read_text() == found[0]


def test_what_lasts_between_two_points_is_no_hang(tmp_path: Path) -> None:
    """A slow disk, or whoever hears of the progress: the instance that stepped last has returned."""
    run = plan_run(write_config(tmp_path, stop_time=2.0, timeouts={"step": 0.5}))
    hangs: list[FmuError] = []
    waited: list[bool] = []

    def progress(point: int) -> None:
        if point > 0 and not waited:
            waited.append(threading.Event().wait(1.5))

    (folder := tmp_path / "runs").mkdir()
    with closing(RepeatedRuns(folder, progress=progress, on_hang=hangs.append)) as runs:
        outcome = runs.run(run, lambda: open_results(run.loaded, run.plan.system))

    assert (outcome.point, waited, hangs) == (2000, [False], [])
