"""Model exchange, events and linear inputs over processes: every float is that of a run in one process.

The FMUs abort the process on a call that the state machine of their FMI version forbids, so these runs prove the
calling sequences, too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

import fmu_mesh
from fmu_mesh.run.options import PlanOptions
from tests.fmus.event_fmus import Version
from tests.helpers import Place
from tests.plain_run import PlainRun
from tests.planning import prepare

EventFmu = Callable[..., Path]


def both_ways(place: Place, content: Mapping[str, Any], *arguments: str) -> tuple[bytes, bytes]:
    """The result of a launched run, and that of the same plan in this process."""
    config = place.folder / "mesh.yaml"
    config.write_text(yaml.safe_dump({"mesh": "m", **content}, sort_keys=False), encoding="utf-8")
    launched = place.start("launch", config, "--no-progress", "--output", place.folder / "launched.csv", *arguments)
    assert launched.wait(50.0) == 0, launched.errors
    PlainRun(prepare(config, PlanOptions(output=place.folder / "local.csv"))).run()
    return (place.folder / "launched.csv").read_bytes(), (place.folder / "local.csv").read_bytes()


def system(
    event_fmu: EventFmu, kinds: Mapping[str, tuple[Version, str]], solver: str = "auto", **connection: str
) -> dict[str, Any]:
    """A ball, whose height drives an oscillator, whose state is integrated; and stairs that go up by its events."""
    settings = {"name": solver, "relative_tolerance": 1e-7}
    models = {"ball": "Ball", "oscillator": "Oscillator", "integral": "Integral", "stairs": "Stairs"}
    instances = {}
    for name, model in models.items():
        version, kind = kinds[name]
        section: dict[str, Any] = {"fmu": str(event_fmu(model, version)), "kind": kind}
        if kind == "model_exchange":
            section["solver"] = settings
        instances[name] = section
    instances["stairs"]["start_values"] = {"period": 0.31}
    return {
        "simulation": {"stop_time": 3.0, "step_size": 0.01},
        "instances": instances,
        "connections": [
            {"from": "ball.h", "to": "oscillator.u", **connection},
            {"from": "oscillator.x", "to": "integral.u", **connection},
            "integral.above -> stairs.increment",
        ],
    }


Kinds = dict[str, tuple[Version, str]]
NAMES = ("ball", "oscillator", "integral", "stairs")
ALL_1: Kinds = dict.fromkeys(NAMES, (1, "model_exchange"))
ALL_2: Kinds = dict.fromkeys(NAMES, (2, "model_exchange"))
ALL_3: Kinds = dict.fromkeys(NAMES, (3, "model_exchange"))
MIXED: Kinds = {
    "ball": (3, "co_simulation"),
    "oscillator": (1, "model_exchange"),
    "integral": (2, "co_simulation"),
    "stairs": (3, "co_simulation"),
}


@pytest.mark.parametrize("kinds", [ALL_1, ALL_2, ALL_3, MIXED], ids=["FMI 1", "FMI 2", "FMI 3", "mixed"])
@pytest.mark.parametrize("solver", ["auto", "cvode"])
def test_a_chain_with_events_gives_the_same_floats(
    solver: str, kinds: Mapping[str, tuple[Version, str]], place: Place, event_fmu: EventFmu
) -> None:
    launched, local = both_ways(place, system(event_fmu, kinds, solver))

    assert launched == local
    assert len(launched.splitlines()) == 302


@pytest.mark.parametrize("arguments", [("--window", "1"), ("--window", "3"), ("--local",)], ids=" ".join)
@pytest.mark.parametrize("group", [None, "all"])
def test_complete_steps_in_c_give_the_same_floats_wherever_they_are(
    arguments: tuple[str, ...], group: str | None, place: Place, event_fmu: EventFmu
) -> None:
    content = system(event_fmu, {**ALL_2, "oscillator": ALL_3["oscillator"], "ball": ALL_1["ball"]})
    for section in content["instances"].values():
        section["group"] = group
    content["connections"].append({"from": "integral.s", "to": "ball.u", "delay": 1, "factor": -0.5})

    launched, local = both_ways(place, content, *arguments)

    assert launched == local
    assert len(launched.splitlines()) == 302


@pytest.mark.parametrize("arguments", [(), ("--window", "1"), ("--local",), ("--local", "--window", "3")], ids=" ".join)
@pytest.mark.parametrize("group", [None, "all"])
def test_models_that_turn_out_to_be_stiff_give_the_same_floats(
    arguments: tuple[str, ...], group: str | None, place: Place, event_fmu: EventFmu
) -> None:
    content = stiff_system(event_fmu)
    for section in content["instances"].values():
        section["group"] = group

    launched, local = both_ways(place, content, *arguments)

    assert launched == local
    told = place.run("launch", place.folder / "mesh.yaml", "--no-progress", *arguments).errors
    stiff = [line.partition(":")[0] for line in told.splitlines() if "the model is stiff" in line]
    assert sorted(stiff) == ["always at point 0", "late at point 10", "moving at point 0"]
    fmu_mesh.rerun(place.folder / "launched.csv")
    assert (place.folder / "launched.rerun.csv").read_bytes() == launched


def stiff_system(event_fmu: EventFmu) -> dict[str, Any]:
    """Models that are stiff always, from a time on, as they move, and never."""
    heater = {"fmu": str(event_fmu("Heater", 2)), "kind": "model_exchange"}
    moving = {"fmu": str(event_fmu("Oscillator", 1)), "start_values": {"mu": 1000.0, "x": 0.1}}
    return {
        "simulation": {"stop_time": 4.0, "step_size": 0.1},
        "instances": {
            "always": heater,
            "late": heater | {"fmu": str(event_fmu("Heater", 3)), "start_values": {"late": 1.02}},
            "never": heater | {"start_values": {"late": 100.0}},
            "moving": moving,
        },
        "connections": [
            {"from": "always.F", "to": "late.u", "factor": 0.1},
            {"from": "late.F", "to": "never.u", "factor": 0.1},
            {"from": "never.T", "to": "moving.u"},
            {"from": "moving.x", "to": "always.u", "factor": 0.01, "delay": 1},
        ],
    }


@pytest.mark.parametrize("algorithm", ["jacobi", "gauss_seidel"])
@pytest.mark.parametrize("solver", ["auto", "cvode"])
def test_linear_inputs_give_the_same_floats(solver: str, algorithm: str, place: Place, event_fmu: EventFmu) -> None:
    kinds: Kinds = {**ALL_3, "integral": (2, "co_simulation")}
    content = system(event_fmu, kinds, solver, extrapolation="linear")
    content["simulation"] |= {"algorithm": algorithm, "window": 7}
    content["instances"]["ball"]["step_size"] = 0.03  # a line over three steps of its target

    launched, local = both_ways(place, content)

    assert launched == local


@pytest.mark.parametrize(
    ("version", "more"), [(2, {}), (2, {"retry_discarded_steps": True}), (3, {})], ids=["FMI 2", "retrying", "FMI 3"]
)
def test_the_step_at_whose_end_an_fmu_asks_to_end_is_row(
    version: Version, more: Mapping[str, Any], place: Place, event_fmu: EventFmu
) -> None:
    """The third stair is at 3 s; an FMU of FMI 2.0 discards the step that ends there, and it has got to its end."""
    start_values = {"period": 1.0, "end": 3}
    content = {
        "simulation": {"stop_time": 1000.0, "step_size": 0.25},
        "instances": {
            "stairs": {"fmu": str(event_fmu("Stairs", version)), "start_values": start_values, **more},
            "oscillator": {"fmu": str(event_fmu("Oscillator", 2))},
        },
        "connections": [],
    }

    launched, local = both_ways(place, content)

    assert launched == local
    header, *rows = [line.split(b",") for line in launched.splitlines()]
    assert len(rows) == 13
    assert rows[-1][0] == b"3.0"
    assert rows[-1][header.index(b"stairs.counter")] == b"3"


@pytest.mark.parametrize("solver", ["auto", "cvode"])
def test_fmu_that_asks_to_end_ends_run_at_its_point_for_all(solver: str, place: Place, event_fmu: EventFmu) -> None:
    content = system(event_fmu, ALL_2, solver)
    content["instances"]["stairs"]["start_values"] |= {"end": 3, "increment": 1}
    content["connections"].pop()
    content["simulation"]["stop_time"] = 1000.0

    launched, local = both_ways(place, content)

    # The third stair is at 0.93 s: the step that begins at 0.92 s is the last complete one.
    assert launched == local
    assert launched.splitlines()[-1].startswith(b"0.93,")
