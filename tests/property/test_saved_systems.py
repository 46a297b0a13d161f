"""However often a system goes back to its states: its floats are those of the same steps and settings in one go."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from fmu_mesh.api.open_system import System
from fmu_mesh.api.system_state import SystemState
from tests.helpers import FMUS, examples
from tests.planning import plan_run

H = 0.01
OUTPUTS = (
    "slow.y",
    "fast.y",
    "delayed.y",
    "sum.y",
    "oscillator.x",
    "level.s",
    "stairs.counter",
    "free.y",
    "pid.effort",
)
OTHERS = ("slow.u", "fast.k", "oscillator.y", "pid.p", "sum.u1")  # those that no row has
KEPT = ("Integrator", "TransportDelay", "Adder", "Gain")

Row = list[object]


@pytest.fixture(scope="module")
def systems(
    tmp_path_factory: pytest.TempPathFactory, event_fmu: Callable[..., Path]
) -> Iterator[tuple[System, System]]:
    """Two open systems of one configuration.

    A cycle of two rates, a memory, an input that is a line within a step, events in both kinds of FMUs, a component of
    ours, and inputs and parameters that can be set.
    """
    instances: dict[str, dict[str, Any]] = {
        "slow": {"fmu": "Integrator", "start_values": {"k": -2.0}, "step_size": 3 * H},
        "fast": {"fmu": "Integrator", "start_values": {"y": 1.0}},
        "delayed": {"fmu": "TransportDelay", "start_values": {"d": 0.055}, "step_size": 2 * H},
        "sum": {"fmu": "Adder"},
        "oscillator": {"fmu": str(event_fmu("Oscillator", 2)), "kind": "model_exchange"},
        "level": {"fmu": str(event_fmu("Integral", 3)), "kind": "model_exchange"},
        "stairs": {"fmu": str(event_fmu("Stairs", 3)), "start_values": {"period": 0.07}},
        "free": {"fmu": "Gain"},
        "pid": {"controller": "position_pid", "start_values": {"p": 3.0, "i": 2.0}},
    }
    connections: list[Any] = [
        "slow.y -> fast.u",
        "fast.y -> slow.u",
        "fast.y -> delayed.x",
        "delayed.y -> sum.u1",
        "slow.y -> sum.u2",
        {"from": "sum.y", "to": "oscillator.u", "extrapolation": "linear"},
        "sum.y -> pid.position",
        "sum.y -> level.u",
    ]
    for instance in instances.values():
        if instance.get("fmu") in KEPT:
            instance["fmu"] = str(FMUS / f"{instance['fmu']}.fmu")
    content = {
        "mesh": "saved",
        "simulation": {"stop_time": None, "step_size": H},
        "instances": instances,
        "connections": connections,
        "record": {"file": "saved.csv", "variables": list(OUTPUTS)},
    }
    config = tmp_path_factory.mktemp("saved") / "saved.yaml"
    config.write_text(yaml.safe_dump(content), encoding="utf-8")
    run = plan_run(config)
    with System(run) as first, System(run) as second:
        first.reset()  # so that later ones go back to the state of point 0, and the other states stay
        yield first, second


actions = st.lists(
    st.one_of(
        st.tuples(st.just("step"), st.integers(1, 20)),
        st.tuples(st.just("save"), st.none()),
        st.tuples(st.just("reset"), st.none()),
        st.tuples(st.just("restore"), st.integers(0, 5)),
        st.tuples(st.just("close"), st.integers(0, 5)),
        st.tuples(st.just("get"), st.sampled_from(OTHERS)),
        st.tuples(st.sampled_from(["free.u", "free.k", "fast.k", "pid.target", "pid.i"]), st.floats(-3.0, 3.0)),
        st.tuples(st.just("stairs.increment"), st.integers(0, 3)),
    ),
    max_size=25,
)


def row(system: System) -> Row:
    return [system.point, system.time, *(system.get(name) for name in (*OUTPUTS, *OTHERS))]


@given(actions)
@settings(max_examples=examples(200), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_system_that_went_back_equals_one_that_did_not(  # noqa: C901  one case for each action
    systems: tuple[System, System], drawn: list[tuple[str, Any]]
) -> None:
    system, other = systems
    start = system.save()
    history: list[tuple[str, Any]] = []
    first = row(system)
    rows = [first]
    saved: list[tuple[SystemState, list[tuple[str, Any]], list[Row], Row]] = []
    for action, argument in drawn:
        match action:
            case "save":
                saved.append((system.save(), list(history), list(rows), row(system)))
            case "restore" if saved:
                state, earlier, rows_before, there = saved[argument % len(saved)]
                system.restore(state)
                history, rows = list(earlier), list(rows_before)
                assert repr(row(system)) == repr(there)
            case "reset":
                system.reset()
                history, rows = [], [row(system)]
                assert repr(rows) == repr([first])
            case "close" if len(saved) > 1:
                saved.pop(argument % len(saved))[0].close()
            case "get":
                system.get(argument)
            case "step":
                take(system, history, rows, argument)
            case "restore" | "close":
                continue
            case _:
                system.set(action, argument)
                history.append((action, argument))
    take(system, history, rows, 7)  # what was restored last has consequences

    beginning = other.save()
    expected = [row(other)]
    for action, argument in history:
        if action == "step":
            take(other, [], expected, argument)
        else:
            other.set(action, argument)

    assert repr(rows) == repr(expected)
    event(f"{len([name for name, _ in drawn if name == 'restore'])} times back")
    system.restore(start)
    other.restore(beginning)


def take(system: System, history: list[tuple[str, Any]], rows: list[Row], points: int) -> None:
    for _ in range(points):
        system.step()
        rows.append(row(system))
    history.append(("step", points))
