"""Groups that are solved, where it does not work: each has an end, with the group, the point and the names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh.errors import StepFailed
from fmu_mesh.run.options import PlanOptions
from tests.fmus.helpers import find_fmu
from tests.helpers import Place, row_count, wait_until, write_config
from tests.plain_run import PlainRun
from tests.planning import prepare
from tests.solved_systems import LINKS, PARTS, contradiction, driven_masses, masses

SIMULATION = {"step_size": 0.01}


def test_a_group_without_a_solution_ends_with_its_largest_differences(place: Place) -> None:
    config = write_config(place.folder, **contradiction(place.folder))

    launched = place.run("launch", config, "--no-progress")

    assert launched.wait() == 3, launched.story()
    assert "instance echo, point 1, t = 0.01 s: the group 'g' has no solution that 20 tries find:" in launched.message
    assert "echo.u is " in launched.message
    assert "A smaller step size may help, or a larger `tolerance` of the group." in launched.message
    assert row_count(config.with_suffix(".csv")) == 2
    place.assert_nothing_left()


def test_a_large_tolerance_takes_what_is_near(tmp_path: Path) -> None:
    config = write_config(tmp_path, **contradiction(tmp_path, tolerance=2.0))

    assert len(fmu_mesh.load(config).run(processes=False, record="memory").times) == 101


def test_a_loop_of_gain_1_has_no_jacobian(tmp_path: Path) -> None:
    (tmp_path / "parts.py").write_text(PARTS, encoding="utf-8")
    direct = {"y": {"u": 1.0}}
    instances = {
        "a": {"python": "parts.py:Late", "group": {"name": "g", "solve": "newton"}, "feedthrough": direct},
        "b": {"python": "parts.py:Late", "group": "g", "feedthrough": direct},
    }
    config = write_config(tmp_path, instances=instances, connections=["a.y -> b.u", "b.y -> a.u"])

    with pytest.raises(StepFailed, match=r"point 0, .*the values of .* do not follow from each other: the group 'g'"):
        fmu_mesh.load(config).run(processes=False)


def test_an_fmu_that_does_not_go_back_is_named(event_fmu: Callable[..., Path], tmp_path: Path) -> None:
    instances = masses(event_fmu("LinearPart", 2))
    instances["two"]["start_values"] = {**instances["two"]["start_values"], "stays": 1}
    config = write_config(tmp_path, instances=instances, connections=LINKS, simulation=SIMULATION)

    with pytest.raises(StepFailed) as error:
        fmu_mesh.load(config).run(processes=False)

    assert (error.value.instance, error.value.point) == ("two", 5)
    assert "fmi2SetFMUstate returned error" in str(error.value)
    assert "leave out `solve`" in str(error.value)


def test_a_tolerance_of_step_control_that_cannot_be_met_is_said(event_fmu: Callable[..., Path], tmp_path: Path) -> None:
    instances = masses(event_fmu("LinearPart", 2), step_control={"tolerance": 1e-9})
    instances["two"]["start_values"] = {**instances["two"]["start_values"], "e": 1e5, "c": 1e3}
    config = write_config(tmp_path, instances=instances, connections=LINKS, simulation=SIMULATION)

    with pytest.raises(
        StepFailed, match=r"instance one, point 0, .*the tolerance 1e-09 of `step_control` cannot be met"
    ):
        fmu_mesh.load(config).run(processes=False)


def test_a_member_that_hangs_in_a_try_is_named(place: Place) -> None:
    (place.folder / "parts.py").write_text(PARTS, encoding="utf-8")
    config = write_config(
        place.folder,
        instances={
            "echo": {
                "python": "parts.py:Loop",
                "start_values": {"gain": 0.5},
                "group": {"name": "g", "solve": "newton"},
            },
            "faulty": {"fmu": str(find_fmu("Faulty", place.folder)), "group": "g", "start_values": {"hang_at": 0.0205}},
        },
        connections=["echo.y -> faulty.u", "faulty.y -> echo.u"],
        timeouts={"step": 1.0},
    )

    launched = place.run("launch", config, "--no-progress")

    assert launched.wait() == 3, launched.story()
    assert "instance faulty, point 20, t = 0.02 s: the FMU has not returned for 1." in launched.message
    place.assert_nothing_left(within_s=10.0)


def test_a_killed_node_with_a_group_starts_again_with_the_same_floats(
    event_fmu: Callable[..., Path], place: Place
) -> None:
    content = driven_masses(event_fmu("LinearPart", 2), place.folder, step_control={"tolerance": 1e-3})
    config = write_config(
        place.folder,
        name="driven",
        **content,
        stop_time=20.0,
        simulation={**SIMULATION, "real_time_factor": 4.0},
        recovery={"mode": "restart", "checkpoint_s": 0.3},
    )
    launched, result = place.start("launch", config, "--no-progress"), config.with_suffix(".csv")
    wait_until(lambda: row_count(result) > 400, "400 rows")

    launched.child("g").kill()

    assert launched.wait() == 0, launched.story()
    output = place.folder / "plain.csv"
    PlainRun(prepare(config, PlanOptions(output=output))).run()
    assert result.read_bytes() == output.read_bytes()
    assert "again" in launched.errors
