"""A system that was reset has the floats of one that was just opened: of every kind, from every mode, many times."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

import fmu_mesh
from fmu_mesh.api.open_system import System
from fmu_mesh.errors import CallRefused, ConfigurationError, FmuError, StepFailed
from fmu_mesh.instances.fmi.loaded_fmu import LoadedFmu
from fmu_mesh.run.run_plan import RunPlan
from tests.all_systems import SYSTEMS, written_system
from tests.fmus.helpers import NO_COMPILER, build_test_fmu
from tests.helpers import FMUS
from tests.planning import plan_run

Rows = list[list[Any]]


def plan_of(folder: Path, instances: Mapping[str, Any], connections: list[str], **sections: Any) -> RunPlan:  # noqa: ANN401 sections of a configuration
    """A mesh of 10 ms steps that records what is connected."""
    content = {
        "mesh": "again",
        "simulation": {"step_size": 0.01, "stop_time": None},
        "instances": instances,
        "connections": connections,
        "record": {"file": "again.csv"},
        **sections,
    }
    path = folder / "again.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return plan_run(path)


def rows_of(system: System, points: int = 40) -> Rows:
    """All recorded values from this point on, as text, which tells -0.0 and NaN."""
    names = [".".join(column) for column in system._plan.system.recorded]
    rows = [[system.point, *(repr(system.get(name)) for name in names)]]
    for _ in range(points):
        if system.point == system.last_point or system.ended_by:
            break
        system.step()
        rows.append([system.point, *(repr(system.get(name)) for name in names)])
    return rows


def changed_values(system: System, seed: int) -> dict[str, float]:
    """Other values for a third of the numbers that a start value may have, near those that they have."""
    found: dict[str, float] = {}
    for name, instance in system._plan.system.instances.items():
        for place, variable in enumerate(instance.description.variables):
            value = instance.start_values.get(variable.name, variable.start)
            if not isinstance(value, float) or variable.type != "Float64" or not variable.settable_before_start:
                continue
            if (place + seed) % 3 == 0 and abs(value) < 1e6:
                found[f"{name}.{variable.name}"] = value * (1.0 + 2.0**-20 * (place + 1))
    return found


SOLVED = {"consistent", "masses"}
"""The systems whose loops are solved at every point."""


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_reset_system_equals_a_new_one(name: str, tmp_path: Path) -> None:
    run = plan_run(written_system(name, tmp_path))
    with System(run) as system:
        expected = rows_of(system)
        for points in (40, 1, 40):  # by initialization, and then by the states of point 0 where there are such
            system.reset()
            assert (system.point, system.ended_by) == (0, None)
            assert rows_of(system, points) == expected[: points + 1]


@pytest.mark.parametrize("name", SYSTEMS)
def test_other_start_values_give_floats_of_system_opened_with_them(name: str, tmp_path: Path) -> None:
    mesh = fmu_mesh.load(written_system(name, tmp_path))
    with mesh.open() as system:
        expected, accepted = rows_of(system), 0
        for seed in range(3):  # the names differ; the second time they are known
            for _ in range(2):
                values = changed_values(system, seed)
                try:
                    opened = mesh.open(values)
                except (ConfigurationError, FmuError) as error:
                    with pytest.raises(type(error), match=f"^{re.escape(str(error))}$"):
                        system.reset(values)
                    continue
                with opened as other:
                    wanted = rows_of(other)
                refused = ""
                try:
                    system.reset(values)
                except ConfigurationError as error:  # other start values, other formulas of the solved loops
                    refused = str(error)
                if refused:
                    assert name in SOLVED
                    assert "its outputs would depend directly on inputs in another way" in refused
                    continue
                assert rows_of(system) == wanted
                accepted += bool(values)
        assert accepted or name in {"text and arrays", *SOLVED}
        system.reset()
        assert rows_of(system) == expected


@pytest.mark.parametrize("name", ["pendulum_delay", "damped_pendulum", "balance"])
def test_no_instance_is_opened_again(name: str, tmp_path: Path) -> None:
    """FMUs of FMI 2.0, worlds of MuJoCo and models in ONNX stay as they are loaded."""
    with System(plan_run(written_system(name, tmp_path))) as system:
        opened, expected = dict(system._guards), rows_of(system, 5)

        system.reset()

        assert rows_of(system, 5) == expected
        assert all(system._guards[instance] is guard for instance, guard in opened.items())


# ---- from every mode


def test_an_fmu_that_cannot_be_reset_gets_new_instances(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LoadedFmu, "reset", lambda _model: False)
    with System(plan_of(tmp_path, integrators(), ["first.y -> second.u"])) as system:
        expected, loaded, made = rows_of(system), system._models.loads, list[bool]()
        instantiate = LoadedFmu.instantiate

        def counting(model: LoadedFmu, **arguments: object) -> None:
            made.append(not model.has_instance)
            instantiate(model, **arguments)

        monkeypatch.setattr(LoadedFmu, "instantiate", counting)
        for values in (None, {"first.k": 2.0}, None):
            system.set("first.u", 5.0)
            system.step(3)
            system.reset(values)
            if not values:
                assert rows_of(system) == expected

        assert made == [True] * 6  # two instances, three times
        assert system._models.loads == loaded


def integrators() -> dict[str, Any]:
    return {
        "first": {"fmu": str(FMUS / "Integrator.fmu"), "start_values": {"y": 1.0, "u": 1.0}},
        "second": {"fmu": str(FMUS / "Integrator.fmu")},
    }


def test_system_that_failed_begins_again_with_fmu_loaded_anew(tmp_path: Path, faulty: Path) -> None:
    instances = integrators() | {"faulty": {"fmu": str(faulty), "start_values": {"fail_at": 0.1}}}
    with System(plan_of(tmp_path, instances, ["first.y -> second.u", "first.y -> faulty.u"])) as system:
        expected = rows_of(system, 8)
        state = system.save()
        for _ in range(2):
            with pytest.raises(StepFailed):
                system.step(100)
            with pytest.raises(CallRefused, match=r"failed before\. Only reset\(\) and close\(\) are allowed now"):
                system.get("first.y")

            system.reset()

            assert rows_of(system, 8) == expected
        with pytest.raises(CallRefused, match="the state is gone, because a reset has initialized the instances again"):
            system.restore(state)


def test_start_values_that_fail_leave_only_another_reset(tmp_path: Path, faulty: Path) -> None:
    instances = integrators() | {"faulty": {"fmu": str(faulty)}}
    with System(plan_of(tmp_path, instances, ["first.y -> second.u"])) as system:
        expected = rows_of(system)

        with pytest.raises(fmu_mesh.InitializationFailed) as failed:
            system.reset({"faulty.fail_in_init": True})

        assert failed.value.instance == "faulty"
        with pytest.raises(CallRefused, match="an instance has failed before"):
            system.step()
        system.reset()
        assert rows_of(system) == expected


@pytest.mark.parametrize(
    ("version", "kind"),
    [(1, "model_exchange"), (2, "model_exchange"), (3, "model_exchange"), (3, "co_simulation")],
)
def test_an_fmu_that_asked_to_end_begins_again(
    version: int, kind: str, tmp_path: Path, event_fmu: Callable[..., Path]
) -> None:
    stairs = {"fmu": str(event_fmu("Stairs", version)), "kind": kind, "start_values": {"period": 0.04, "end": 3}}
    with System(plan_of(tmp_path, {"stairs": stairs, **integrators()}, ["first.y -> second.u"])) as system:
        expected = rows_of(system)
        assert system.ended_by is not None
        for _ in range(3):
            system.reset()
            assert system.ended_by is None
            assert rows_of(system) == expected


@pytest.mark.parametrize("version", [1, 2, 3])
def test_what_is_stiff_is_found_out_anew_after_a_reset(
    version: int, tmp_path: Path, event_fmu: Callable[..., Path]
) -> None:
    fmu = {"fmu": str(event_fmu("Heater", version)), "kind": "model_exchange", "start_values": {"late": 0.12}}
    with System(plan_of(tmp_path, {"one": fmu, **integrators()}, ["first.y -> one.u"])) as system:
        expected = rows_of(system)
        for points in (17, 40, 40):
            system.reset()
            assert rows_of(system, points) == expected[: points + 1]
        system.reset({"one.late": 0.0})
        assert rows_of(system)[-1] != expected[-1]


@pytest.mark.parametrize("solver", ["auto", "cvode", "dopri5"])
@pytest.mark.parametrize("version", [1, 2, 3])
def test_model_exchange_begins_again_with_each_solver(
    version: int, solver: str, tmp_path: Path, event_fmu: Callable[..., Path]
) -> None:
    fmu = {"fmu": str(event_fmu("Oscillator", version)), "kind": "model_exchange", "solver": {"name": solver}}
    with System(
        plan_of(tmp_path, {"one": fmu, "two": fmu, **integrators()}, ["first.y -> one.u", "one.x -> two.u"])
    ) as system:
        expected = rows_of(system)
        for points in (17, 40, 40):
            system.reset()
            assert rows_of(system, points) == expected[: points + 1]


# ---- what was set, and inputs without values


def test_what_was_set_and_when_is_gone(tmp_path: Path) -> None:
    instances = integrators()
    instances["first"]["inputs"] = {"u": {"timeout": {"after": 0.1, "then": 0.5}}}
    with System(plan_of(tmp_path, instances, ["first.y -> second.u"])) as system:
        expected = rows_of(system)
        for _ in range(3):
            system.set_many({"first.u": 7.0, "first.k": 2.0, "second.k": 3.0})
            system.step(5)
            system.set("first.u", 8.0)
            system.step(7)

            system.reset()

            assert rows_of(system) == expected
        system.reset({"first.u": 2.0})  # from which it falls back
        assert system.get("first.u") == 2.0
        assert rows_of(system)[-1] != expected[-1]


def test_a_scenario_begins_again(tmp_path: Path) -> None:
    scenario = {"events": [{"at": 0.05, "set": {"first.u": 3.0}}, {"at": 0.1, "set": {"second.k": 2.0}}]}
    run = plan_of(tmp_path, integrators(), ["first.y -> second.u"], scenario=scenario)
    with System(run) as system:
        expected = rows_of(system)
        for _ in range(2):
            system.set("first.u", 9.0)
            system.step(7)
            system.reset()
            assert rows_of(system) == expected
        system.reset({"first.y": 5.0})
        assert system.get("first.y") == 5.0


@pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
def test_sizes_of_arrays_cannot_change_in_a_reset(tmp_path: Path) -> None:
    fmu = {"fmu": str(build_test_fmu("AllTypes3", tmp_path)), "start_values": {"columns": 2}}
    with System(plan_of(tmp_path, {"it": fmu}, [])) as system:
        system.reset({"it.float64_array_in": [[1.0, 2.0], [3.0, 4.0]]})
        system.reset({"it.float64_array_in": [[5.0, 6.0], [7.0, 8.0]]})
        assert system.get("it.float64_array_in").tolist() == [[5.0, 6.0], [7.0, 8.0]]
        system.reset({"it.float64_array_in[2,1]": 9.0})
        assert system.get("it.float64_array_in")[1, 0] == 9.0
        system.step()
        with pytest.raises(fmu_mesh.ConfigurationError, match="cannot be reset: it would have other sizes"):
            system.reset({"it.columns": 3})

        assert system.point == 1
        system.step()
