"""A mesh that a program steps by itself gives the floats of `launch` and of `--local`, in every column of every row."""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import fmu_mesh
from fmu_mesh.api.open_system import System
from fmu_mesh.run.options import PlanOptions
from tests.equivalence import test_equivalence as meshes
from tests.equivalence import test_events as events
from tests.equivalence import test_initialization as loops
from tests.equivalence import test_types as types
from tests.equivalence.reference import read_csv
from tests.fmus.event_fmus import Version
from tests.fmus.helpers import NO_COMPILER
from tests.helpers import Place
from tests.planning import plan_run

EventFmu = Callable[..., Path]
Rows = list[list[Any]]


def opened(config: Path, *start_values: str) -> System:
    return System(plan_run(config, PlanOptions(start_values=start_values)))


def rows_stepped(system: System, columns: list[str], sizes: tuple[int, ...] = (1,)) -> Rows:
    """The time and the values of all points from this one on; each `step` takes the next of ``sizes``, in turn."""
    rows = []
    while True:
        rows.append([system.time, *(system.get(name) for name in columns)])
        left = (system.last_point or 0) - system.point
        if not left or system.ended_by:
            return rows
        system.step(min(sizes[len(rows) % len(sizes)], left))


def assert_the_same_floats(place: Place, config: Path) -> None:
    """Stepped by this process, and run as `--local`, which other tests compare with processes."""
    content = meshes.in_this_process(place, config)
    header, *lines = csv.reader(io.StringIO(content.decode(), newline=""))
    with opened(config) as system:
        rows = rows_stepped(system, header[1:])
    assert len(rows) == len(lines)
    for row, line in zip(rows, lines, strict=True):
        assert repr(row) == repr([read(cell, value) for cell, value in zip(line, row, strict=True)])


def read(cell: str, value: object) -> object:
    """A cell of a CSV file as a value of the type of ``value``."""
    match value:
        case bool():
            return {"true": True, "false": False}[cell]
        case float() | int() | str():
            return type(value)(cell)
        case _:
            return base64.b64decode(cell)


# ---- every kind of system


@pytest.mark.parametrize("algorithm", [meshes.GAUSS_SEIDEL, meshes.JACOBI])
@pytest.mark.parametrize("name", [meshes.PENDULUM, meshes.CHAIN, meshes.CYCLE])
def test_a_chain_and_a_cycle_give_the_same_floats(name: str, algorithm: str, place: Place) -> None:
    assert_the_same_floats(place, meshes.rewritten(name, place.folder, meshes.shortened(600, algorithm)))


def test_the_main_job_gives_the_same_floats_in_processes_too(place: Place) -> None:
    config = meshes.CONFIGS / f"{meshes.PENDULUM}.yaml"

    assert_the_same_floats(place, config)
    assert meshes.launched(place, config) == meshes.in_this_process(place, config)


@pytest.mark.parametrize("algorithm", [meshes.GAUSS_SEIDEL, meshes.JACOBI])
def test_instances_with_step_sizes_of_their_own_give_the_same_floats(algorithm: str, place: Place) -> None:
    config = meshes.written(meshes.multi_rate(algorithm, meshes.APART, meshes.H), place.folder)

    assert_the_same_floats(place, config)


def test_a_loop_at_the_start_gives_the_same_floats(place: Place) -> None:
    assert_the_same_floats(place, loops.ring(place.folder, 3.0, relaxation=0.25))


@pytest.mark.parametrize(
    "kinds", [events.ALL_1, events.ALL_2, events.ALL_3, events.MIXED], ids=["FMI 1", "FMI 2", "FMI 3", "mixed"]
)
@pytest.mark.parametrize("extrapolation", ["hold", "linear"])
def test_events_and_linear_inputs_give_the_same_floats(
    kinds: Mapping[str, tuple[Version, str]], extrapolation: str, place: Place, event_fmu: EventFmu
) -> None:
    content = events.system(event_fmu, kinds, **({"extrapolation": "linear"} if extrapolation == "linear" else {}))
    if extrapolation == "linear" and kinds["integral"] == (2, "co_simulation"):
        content["connections"][1].pop("extrapolation", None)
    config = place.folder / "mesh.yaml"
    config.write_text(yaml.safe_dump({"mesh": "m", "record": {"file": "m.csv"}, **content}), encoding="utf-8")

    assert_the_same_floats(place, config)


def test_models_that_turn_out_to_be_stiff_give_the_same_floats(place: Place, event_fmu: EventFmu) -> None:
    content = events.stiff_system(event_fmu)
    del content["instances"]["moving"]  # its FMI has no states
    content["connections"] = content["connections"][:2]
    config = meshes.written(content, place.folder)
    columns = ["always.T", "always.F", "late.T", "late.F", "never.T", "never.F"]

    assert_the_same_floats(place, config)

    with opened(config) as system:
        start = system.save()
        first = rows_stepped(system, columns)
        system.restore(start)
        system.step(25)
        state = system.save()
        second = rows_stepped(system, columns)
        system.restore(start)
        third = rows_stepped(system, columns)
        system.restore(state)
        fourth = rows_stepped(system, columns)

    assert first == third
    assert second == fourth
    assert first[25] == second[0]


@pytest.mark.parametrize("version", [2, 3])
def test_each_copy_and_each_reset_find_out_anew_what_is_stiff(
    version: Version, place: Place, event_fmu: EventFmu
) -> None:
    heater = {"fmu": str(event_fmu("Heater", version)), "kind": "model_exchange"}
    content = {"simulation": {"stop_time": 3.0, "step_size": 0.1}, "instances": {"heater": heater}, "connections": []}
    config = meshes.written(content, place.folder)
    columns, late = ["heater.T", "heater.F"], [0.0, 1.05, 100.0]
    alone = []
    for start in late:
        with opened(config, f"heater.late={start}") as system:
            alone.append([row[1:] for row in rows_stepped(system, columns)])

    with fmu_mesh.load(config).batch(len(late)) as batch:
        found = []
        for _ in range(2):
            batch.reset(start_values={"heater.late": late})
            rows = [[batch.get(name).tolist() for name in columns]]
            for _ in range(30):
                batch.step(1)
                rows.append([batch.get(name).tolist() for name in columns])
            found.append([[[column[copy] for column in row] for row in rows] for copy in range(len(late))])

    assert found == [alone, alone]
    assert alone[0] != alone[1] != alone[2]


@pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
def test_all_types_and_arrays_give_the_same_values(place: Place) -> None:
    config = types.written(place.folder)

    assert_the_same_floats(place, config)

    with opened(config) as system:
        system.step(3)
        for name, first in types.FIRST.items():
            array = system.get(f"b.{name}_array_out")
            assert isinstance(array, np.ndarray)
            assert array.shape == (2, 3)
            assert array.flatten().tolist() == first[-1:] + first[:-1]
            assert system.get(f"b.{name}_array_out[2,3]") == first[4]


def test_many_points_in_one_call_are_those_of_many_calls(place: Place) -> None:
    config = meshes.written(meshes.multi_rate(meshes.GAUSS_SEIDEL, meshes.APART, meshes.H), place.folder)
    columns = ["pendulum.a", "slow_2.y", "slow_5.y", "slow_3.y", "fast.y", "sum.y"]
    with opened(config) as system:
        every = {row[0]: row for row in rows_stepped(system, columns)}

    with opened(config) as system:
        some = rows_stepped(system, columns, (7, 1, 3))

    assert len(some) < len(every) == 401
    assert all(row == every[row[0]] for row in some)


def test_two_systems_of_one_configuration_do_not_disturb_each_other(place: Place) -> None:
    config = meshes.rewritten(meshes.CYCLE, place.folder, meshes.shortened(50, meshes.GAUSS_SEIDEL))
    columns = ["position.y", "velocity.y"]
    with opened(config) as alone:
        expected = rows_stepped(alone, columns)
    with opened(config) as one, opened(config, "position.y=5") as other:
        found: Rows = []
        for _ in expected:
            found.append([one.time, *(one.get(name) for name in columns)])
            if one.point < (one.last_point or 0):
                other.step()
                one.step()

        assert found == expected
        assert other.get("position.y") != one.get("position.y")


# ---- back to a state


MULTI_RATE = ["pendulum.a", "slow_2.y", "slow_5.y", "slow_3.y", "fast.y", "sum.y", "sum.u1", "fast.k"]


@pytest.mark.parametrize("at", [0, 1, 7, 11, 30])
@pytest.mark.parametrize("algorithm", [meshes.GAUSS_SEIDEL, meshes.JACOBI])
def test_a_state_within_the_steps_of_slower_instances_is_complete(at: int, algorithm: str, place: Place) -> None:
    config = meshes.written(meshes.multi_rate(algorithm, meshes.APART, meshes.H), place.folder)
    with opened(config) as system:
        expected = rows_stepped(system, MULTI_RATE)

    with opened(config) as system:
        if at:
            system.step(at)
        state = system.save()
        first = rows_stepped(system, MULTI_RATE)
        system.restore(state)
        second = rows_stepped(system, MULTI_RATE)
        system.restore(state)
        system.step(13)
        system.restore(state)
        third = rows_stepped(system, MULTI_RATE)

    assert first == second == third == expected[at:]


@pytest.mark.parametrize("kinds", [events.ALL_2, events.ALL_3], ids=["FMI 2", "FMI 3"])
@pytest.mark.parametrize("solver", ["auto", "cvode", "euler"])
def test_models_with_events_and_linear_inputs_go_back_to_a_state(
    kinds: Mapping[str, tuple[Version, str]], solver: str, place: Place, event_fmu: EventFmu
) -> None:
    content = events.system(event_fmu, kinds, extrapolation="linear")
    for section in content["instances"].values():
        section["solver"] = {"name": solver}
    config = meshes.written(content, place.folder)
    columns = ["ball.h", "ball.v", "oscillator.x", "integral.s", "stairs.counter", "ball.bounces"]
    with opened(config) as system:
        expected = rows_stepped(system, columns)

    with opened(config) as system:
        system.step(97)
        state = system.save()
        first = rows_stepped(system, columns)
        system.restore(state)
        second = rows_stepped(system, columns)

    assert first == second
    assert first[0] == expected[97]
    if solver != "cvode":  # which starts anew where a state is taken
        assert first == expected[97:]


def test_co_simulation_in_fmi_3_with_events_goes_back_to_a_state(place: Place, event_fmu: EventFmu) -> None:
    kinds: events.Kinds = dict.fromkeys(events.NAMES, (3, "co_simulation"))
    config = meshes.written(events.system(event_fmu, kinds), place.folder)
    columns = ["ball.h", "oscillator.x", "integral.s", "stairs.counter"]
    with opened(config) as system:
        expected = rows_stepped(system, columns)

    with opened(config) as system:
        system.step(97)
        state = system.save()
        system.step(110)
        system.restore(state)

        assert rows_stepped(system, columns) == expected[97:]


def test_a_mujoco_world_goes_back_to_a_state(place: Place) -> None:
    config = meshes.CONFIGS / "electrical_actuator.yaml"
    columns = plan_columns(config)
    with opened(config) as system:
        system.step(40)
        state = system.save()
        system.step(60)
        expected = [system.get(name) for name in columns]
        system.restore(state)
        system.step(60)

        assert [system.get(name) for name in columns] == expected
    place.assert_nothing_left()


def plan_columns(config: Path) -> list[str]:
    return [f"{instance}.{name}" for instance, name in plan_run(config).plan.system.recorded]


# ---- what an FMU asks for


@pytest.mark.parametrize("kind", ["co_simulation", "model_exchange"])
@pytest.mark.parametrize("version", [2, 3])
def test_fmu_that_asks_to_end_leaves_system_at_last_point_of_all(
    version: Version, kind: str, place: Place, event_fmu: EventFmu
) -> None:
    """The third stair is at 0.93 s, which is point 93 but for rounding."""
    content: dict[str, Any] = {
        "simulation": {"stop_time": 1000.0, "step_size": 0.01},
        "instances": {
            "stairs": {
                "fmu": str(event_fmu("Stairs", version)),
                "kind": kind,
                "start_values": {"period": 0.31, "end": 3},
            },
            "oscillator": {"fmu": str(event_fmu("Oscillator", 2))},
        },
        "connections": [],
        "record": {"variables": ["oscillator.x", "stairs.counter"]},
    }
    config = meshes.written(content, place.folder)
    local = meshes.in_this_process(place, config)

    with opened(config) as system:
        state = system.save()
        first = rows_stepped(system, ["oscillator.x", "stairs.counter"])
        ended = system.ended_by
        system.restore(state)
        assert system.ended_by is None
        second = rows_stepped(system, ["oscillator.x", "stairs.counter"])

    assert ended is not None
    assert (ended.instance, ended.point) == ("stairs", len(first) - 2)
    assert first == second
    assert [list(row) for row in read_csv(local)[1]] == first[:-1]
    assert first[-1] == first[-2]
