"""`System`: what may be called when, by whom and with what; what is left behind; and how fast a step is."""

from __future__ import annotations

import gc
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from msgspec.structs import replace

import fmu_mesh
from fmu_mesh.api.open_system import System
from fmu_mesh.api.system_state import SystemState
from fmu_mesh.errors import CallRefused, ConfigurationError, InitializationFailed, StepFailed, UnknownName
from fmu_mesh.instances.fmi.fmu_instance import FmuInstance
from tests.fmus.helpers import NO_COMPILER, build_test_fmu
from tests.helpers import DEADLINE_S, wait_until, write_config
from tests.planning import plan_run

EventFmu = Callable[..., Path]

PENDULUM_AND_GAIN: dict[str, Any] = {
    "instances": {"pendulum": {"fmu": "DampedPendulum"}, "gain": {"fmu": "Gain"}, "free": {"fmu": "Gain"}},
    "connections": ["pendulum.a -> gain.u"],
}


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for temporary files, in which nothing may be left."""
    folder = tmp_path / "tmp"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def opened(folder: Path, **changes: Any) -> System:  # noqa: ANN401 arguments of `write_config`
    return System(plan_run(write_config(folder, **(PENDULUM_AND_GAIN | changes))))


@pytest.fixture
def system(tmp_path: Path, temporary: Path) -> Iterator[System]:
    """A pendulum that feeds a gain, and a gain that nothing feeds; 1000 points of 1 ms."""
    with opened(tmp_path) as system:
        yield system
    assert not list(temporary.iterdir())


# ---- time


def test_a_system_is_at_its_first_point_and_ends_at_its_last(system: System) -> None:
    assert (system.point, system.time, system.last_point, system.ended_by) == (0, 0.0, 1000, None)

    system.step()
    assert (system.point, system.time) == (1, 0.001)
    system.step(999)
    assert (system.point, system.time) == (1000, 1.0)

    with pytest.raises(
        CallRefused, match=r"given 1 points, and 0 are left until the stop time 1 s\. Raise `stop_time`"
    ):
        system.step()
    assert system.get("pendulum.a") != 1.0


def test_steps_past_the_end_are_refused_as_a_whole(system: System) -> None:
    system.step(990)

    with pytest.raises(CallRefused, match="step was given 11 points, and 10 are left"):
        system.step(11)

    assert system.point == 990
    system.step(np.int64(10))  # type: ignore[arg-type]  # as arrays have them
    assert system.point == 1000


@pytest.mark.parametrize("points", [0, -1])
def test_a_step_over_no_point_is_refused(system: System, points: int) -> None:
    with pytest.raises(CallRefused, match=f"given {points} points; expected 1 or more"):
        system.step(points)


def test_a_system_without_a_stop_time_has_no_last_point(tmp_path: Path) -> None:
    with opened(tmp_path, stop_time=None) as system:
        system.step(5000)

        assert (system.point, system.last_point) == (5000, None)


def test_a_mesh_opens_with_start_values_of_the_call(tmp_path: Path, temporary: Path) -> None:
    mesh = fmu_mesh.load(write_config(tmp_path))
    with mesh.open() as first, mesh.open({"pendulum.a": 0.5}) as second:
        assert (first.get("pendulum.a"), second.get("pendulum.a")) == (1.5, 0.5)

    with pytest.raises(ConfigurationError, match="unknown variable 'm' of instance 'pendulum'"):
        mesh.open({"pendulum.m": 1.0})
    assert not list(temporary.iterdir())


# ---- values


def test_a_value_that_is_set_holds_from_the_next_step_on(system: System) -> None:
    system.set("free.u", 3)
    system.set("free.k", np.float64(2.5))
    assert (system.get("free.u"), system.get("free.k")) == (3.0, 2.5)

    system.step()
    assert system.get("free.y") == 7.5
    system.set("free.k", 1.0)
    system.step(5)
    assert system.get("free.y") == 3.0


def test_several_values_are_set_at_once_or_none(system: System) -> None:
    system.set_many({"free.u": 3, "free.k": np.float32(2.5)})
    assert (system.get("free.u"), system.get("free.k")) == (3.0, 2.5)
    system.set_many({})

    for name, value, reason in (
        ("gain.u", 1.0, "it is connected to 'pendulum'"),
        ("free.U", 1.0, "Did you mean 'free.u'?"),
        ("free.k", "one", "'one' is no Real value for it"),
        ("free.k", float("nan"), "expected a finite number"),
        ("free.k", float("inf"), "expected a finite number"),
        ("free.k", 10**400, "expected a number"),
    ):
        with pytest.raises(CallRefused, match=re.escape(reason)):
            system.set_many({"free.u": 9.0, name: value})
    with pytest.raises(CallRefused, match="expected a mapping of values by name"):
        system.set_many([("free.u", 9.0)])  # type: ignore[arg-type]  # what is tested

    assert system.get("free.u") == 3.0
    system.step()
    assert system.get("free.y") == 7.5


def test_values_set_at_once_are_one_event_of_their_fmu(
    tmp_path: Path, event_fmu: EventFmu, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where an FMU has no events, each is a call of its own, which takes less time."""
    calls: list[list[str]] = []
    set_values = FmuInstance.set_values

    def counted(own: FmuInstance, values: Mapping[str, Any]) -> None:
        calls.append([*values])
        set_values(own, values)

    monkeypatch.setattr(FmuInstance, "set_values", counted)
    stairs = {"fmu": str(event_fmu("Stairs", 3)), "start_values": {"period": 0.125}}
    with opened(tmp_path, instances={"stairs": stairs, "free": {"fmu": "Gain"}}, connections=[]) as system:
        calls.clear()

        system.set_many({"stairs.increment": 2, "free.u": 1.0, "stairs.end": 9, "free.k": 2.0})

        assert calls == [["increment", "end"]]
        assert [system.get(name) for name in ("stairs.increment", "free.u", "free.k")] == [2, 1.0, 2.0]


@pytest.mark.parametrize("value", [True, None, "1", [1.0], np.array([1.0]), float("nan"), 1j, "INF"])
def test_wrong_values_are_refused_however_often(system: System, value: object) -> None:
    system.set("free.u", 1.0)
    for _ in range(2):
        with pytest.raises(CallRefused, match=r"^instance free\.u: "):
            system.set("free.u", value)
        assert system.get("free.u") == 1.0


@pytest.mark.parametrize("value", [2, 2.0, np.float64(2), np.float32(2), np.int32(2), np.array(2.0)])
def test_numbers_of_every_kind_are_set_as_floats(system: System, value: object) -> None:
    system.set("free.u", value)

    assert repr(system.get("free.u")) == "2.0"


@pytest.mark.parametrize("name", [5, None, ["free.u"], b"free.u"])
def test_what_is_no_text_names_no_variable(system: System, name: Any) -> None:  # noqa: ANN401 what is tested
    with pytest.raises(UnknownName):
        system.get(name)
    with pytest.raises(UnknownName):
        system.set(name, 1.0)


def test_setting_something_changes_no_other_float(tmp_path: Path) -> None:
    names = ("pendulum.a", "gain.y", "pendulum.der(a)")
    with opened(tmp_path) as system:
        system.step(100)
        expected = [system.get(name) for name in names]

    with opened(tmp_path) as system:
        for _ in range(100):
            system.set("free.u", system.get("pendulum.a"))
            system.step()
            system.get("free.y")

        assert [system.get(name) for name in names] == expected


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("gain.u", 1.0, "instance gain.u: it is connected to 'pendulum'; only unconnected inputs can be set"),
        ("pendulum.l", 1.0, "instance pendulum.l: it is a fixed parameter; only tunable ones can be set while it runs"),
        ("pendulum.a", 1.0, "instance pendulum.a: it is no input and no parameter, so it cannot be set"),
        ("free.u", "one", "instance free.u: 'one' is no Real value for it; expected a number"),
        ("free.u", None, "is no Real value for it; expected a number"),
        ("free.u", [1.0], "instance free.u: a list is no Real value for it; expected a number"),
        ("fre.u", 1.0, "there is no instance 'fre', which 'fre.u' names. Did you mean 'free'?"),
        ("free.U", 1.0, "instance free: there is no variable 'U'. Did you mean 'free.u'?"),
        ("free", 1.0, "instance free: there is no variable ''. There are "),
    ],
)
def test_what_cannot_be_set_is_refused_with_the_reason(system: System, name: str, value: object, reason: str) -> None:
    with pytest.raises(CallRefused) as refused:
        system.set(name, value)

    assert reason in str(refused.value)
    system.step()


@pytest.mark.parametrize("name", ["pendulum", "pendulum.b", "other.a", "", ".", "pendulum.a[1]"])
def test_a_name_of_nothing_is_refused(system: System, name: str) -> None:
    with pytest.raises(UnknownName, match="there is no"):
        system.get(name)


@pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
def test_arrays_are_arrays_of_the_caller(tmp_path: Path) -> None:
    fmu = str(build_test_fmu("AllTypes3", tmp_path))
    with opened(tmp_path, instances={"it": {"fmu": fmu, "start_values": {"columns": 2}}}, connections=[]) as system:
        given = np.array([[1.0, 2.0], [3.0, 4.0]])
        system.set("it.float64_array_in", given)
        system.set("it.boolean_array_in", [[True, False], [False, True]])
        given[0, 0] = 9.0
        system.step()

        first = system.get("it.float64_array_out")
        system.set("it.float64_array_in", first + 1.0)
        system.step()

        assert first.tolist() == [[1.0, 2.0], [3.0, 4.0]]
        assert system.get("it.float64_array_out").tolist() == [[2.0, 3.0], [4.0, 5.0]]
        assert system.get("it.float64_array_out[2,1]") == 4.0
        assert system.get("it.boolean_array_out").dtype == np.bool_
        with pytest.raises(
            CallRefused, match=r"it\.float64_array_in: a list is no Float64\[2,2\] value for it; expected a"
        ):
            system.set("it.float64_array_in", [1.0, 2.0])
        with pytest.raises(CallRefused, match=r"there is no variable 'float64_array_in.1,1.'"):
            system.set("it.float64_array_in[1,1]", 1.0)


def test_a_slower_instance_uses_value_in_step_that_is_not_complete_yet(tmp_path: Path) -> None:
    instances = {"slow": {"fmu": "Integrator", "step_size": 0.004}, "gain": {"fmu": "Gain"}}
    with opened(tmp_path, instances=instances, connections=["slow.y -> gain.u"]) as system:
        system.step(3)
        system.set("slow.u", 1.0)
        assert system.get("slow.y") == 0.0
        system.step()

        assert system.get("slow.y") == 0.004


# ---- states


def test_a_state_holds_what_was_set(system: System) -> None:
    system.set("free.u", 3.0)
    state = system.save()
    system.set("free.u", 4.0)
    system.step(10)

    for _ in range(2):
        system.restore(state)
        assert (system.point, system.get("free.u")) == (0, 3.0)
        system.step()
        assert system.get("free.y") == 3.0


def test_what_follows_from_a_value_that_was_set_is_back_with_state(tmp_path: Path) -> None:
    controller = {"controller": "position_pid", "start_values": {"p": 2.0}}
    config = write_config(tmp_path, **PENDULUM_AND_GAIN)
    content = yaml.safe_load(config.read_text(encoding="utf-8"))
    content |= {"instances": {"pid": controller}, "connections": []}
    config.write_text(yaml.safe_dump(content), encoding="utf-8")
    with System(plan_run(config)) as system:
        system.set("pid.target", 1.0)
        state = system.save()
        assert system.get("pid.effort") == 2.0
        system.step()
        system.set("pid.target", 5.0)
        assert system.get("pid.effort") == 10.0

        system.restore(state)

        assert system.get("pid.effort") == 2.0


def test_a_state_can_be_restored_ahead(system: System) -> None:
    early = system.save()
    system.step(500)
    late, angle = system.save(), system.get("pendulum.a")

    system.restore(early)
    assert system.point == 0
    system.restore(late)

    assert (system.point, late.point, system.get("pendulum.a")) == (500, 500, angle)


def test_an_fmu_without_states_is_named_and_everything_else_works(tmp_path: Path, event_fmu: EventFmu) -> None:
    old = {"fmu": str(event_fmu("Ball", 1)), "kind": "model_exchange"}
    instances = {"pendulum": {"fmu": "DampedPendulum"}, "one": old, "two": old}
    with opened(tmp_path, instances=instances, connections=[]) as system:
        with pytest.raises(CallRefused, match="the state of one, two cannot be saved, as the model description says"):
            system.save()

        system.step(10)
        assert system.get("one.h") < 1.0


def test_states_are_freed_with_their_objects(system: System) -> None:
    kept = system._local._kept
    for _ in range(10):
        system.restore(system.save())
    assert len(kept) == 1
    with system.save() as state:
        system.step()
    assert state.closed
    states = [system.save() for _ in range(5)]
    assert len(kept) == 5

    with pytest.raises(CallRefused, match="needs a state that this system has saved, and that is not closed"):
        system.restore(state)
    states[0].close()
    states[0].close()
    system.restore(states[1])

    assert len(kept) == 4


def test_a_state_of_another_system_is_refused(system: System, tmp_path: Path) -> None:
    with opened(tmp_path) as other:
        foreign = other.save()
        with pytest.raises(CallRefused, match="needs a state that this system has saved"):
            system.restore(foreign)
        with pytest.raises(CallRefused, match="needs a state that this system has saved"):
            system.restore("no state")  # type: ignore[arg-type]  # what is tested
    foreign.close()


def test_a_state_may_be_lost_on_another_thread_and_outlive_its_system(tmp_path: Path) -> None:
    system = opened(tmp_path)
    states = [system.save(), system.save()]
    thread = threading.Thread(target=states.pop)
    thread.start()
    thread.join()

    assert len(system._local._kept) == 2  # an FMU is called on its own thread only
    last = system.save()
    assert len(system._local._kept) == 2
    system.close()
    assert not system._local._kept
    last.close()


# ---- from the first point again


def test_a_reset_loads_nothing_and_leaves_the_other_systems_alone(tmp_path: Path, temporary: Path) -> None:
    with opened(tmp_path) as system, opened(tmp_path) as other:
        loaded, files = system._models.loads, sorted(temporary.rglob("*"))
        for start_values in (None, {}, {"pendulum.a": 0.5}, None, {"pendulum.a": 0.7}):
            system.set("free.u", 3.0)
            system.step(10)
            system.reset(start_values)
            assert (system.point, system.get("free.u")) == (0, 0.0)
            assert system.get("pendulum.a") == ({"pendulum.a": 1.5} | (start_values or {}))["pendulum.a"]

        assert (system._models.loads, sorted(temporary.rglob("*"))) == (loaded, files)
        assert (other.point, other.get("free.u")) == (0, 0.0)


def test_states_stay_after_a_reset_to_a_state_only(system: System) -> None:
    before = system.save()
    system.reset()
    with pytest.raises(CallRefused, match="the state is gone, because a reset has initialized the instances again"):
        system.restore(before)

    system.step(10)
    state, angle = system.save(), system.get("pendulum.a")
    system.reset()
    system.restore(state)
    assert (system.point, system.get("pendulum.a")) == (10, angle)

    system.reset({"pendulum.a": 0.5})
    with pytest.raises(CallRefused, match="the state is gone"):
        system.restore(state)
    before.close()
    state.close()
    with pytest.raises(CallRefused, match="that is not closed"):
        system.restore(state)
    system.restore(system.save())


@pytest.mark.parametrize(
    ("start_values", "reason"),
    [
        ({"pendulum.m": 1.0}, "unknown variable 'm' of instance 'pendulum'"),
        ({"other.a": 1.0}, "other"),
        ({"pendulum.a": "much"}, "'much' for the Real 'a'"),
        ({"pendulum.l": float("nan")}, "'NaN' for 'l', which is out of its range"),
    ],
)
def test_wrong_start_values_of_a_reset_change_nothing(
    tmp_path: Path, start_values: dict[str, Any], reason: str
) -> None:
    mesh = fmu_mesh.load(write_config(tmp_path, **PENDULUM_AND_GAIN))
    with mesh.open() as system:
        system.step(5)
        state, names = system.save(), [*start_values]
        for _ in range(2):
            with pytest.raises(ConfigurationError, match=re.escape(reason)) as refused:
                system.reset(start_values)
            with pytest.raises(ConfigurationError, match=f"^{re.escape(str(refused.value))}$"):
                mesh.open(start_values)
            assert system.point == 5
        system.restore(state)
        system.reset({name: 0.5 for name in names if name == "pendulum.a"})  # whose names are known from now on
        with pytest.raises(ConfigurationError, match=re.escape(reason)):
            system.reset(start_values)


def test_start_values_of_a_reset_come_on_top_of_those_of_open(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(write_config(tmp_path, **PENDULUM_AND_GAIN))
    with mesh.open({"pendulum.a": 0.25, "free.k": 4.0}) as system:
        for given, expected in (
            ({"free.k": 5.0}, (0.25, 5.0)),
            ({"pendulum.a": 0.5}, (0.5, 4.0)),
            (None, (0.25, 4.0)),
        ):
            system.reset(given)
            assert (system.get("pendulum.a"), system.get("free.k")) == expected
        with pytest.raises(CallRefused, match="start_values"):
            system.reset(5)  # type: ignore[arg-type]  # what is tested


# ---- who may call, and when


CALLS: dict[str, Callable[[System, SystemState], object]] = {
    "step": lambda system, _state: system.step(),
    "get": lambda system, _state: system.get("pendulum.a"),
    "set": lambda system, _state: system.set("free.u", 1.0),
    "save": lambda system, _state: system.save(),
    "restore": lambda system, state: system.restore(state),
    "set_many": lambda system, _state: system.set_many({"free.u": 1.0}),
}
LIVE_CALLS = CALLS | {"reset": lambda system, _state: system.reset()}


@pytest.mark.parametrize("call", LIVE_CALLS)
def test_a_closed_system_refuses_every_call_and_can_be_closed_again(system: System, call: str) -> None:
    state = system.save()
    system.close()
    system.close()

    with pytest.raises(CallRefused, match=f"^{call} is not possible, because the system is closed"):
        LIVE_CALLS[call](system, state)
    assert system.time == 0.0


@pytest.mark.parametrize("call", [*LIVE_CALLS, "close"])
def test_another_thread_is_refused(system: System, call: str) -> None:
    state = system.save()
    refused: list[CallRefused] = []

    def call_it() -> None:
        try:
            system.close() if call == "close" else LIVE_CALLS[call](system, state)
        except CallRefused as error:
            refused.append(error)

    thread = threading.Thread(target=call_it)
    thread.start()
    thread.join()

    assert f"{call} is not possible here, because a system belongs to the thread that made it" in str(refused[0])
    system.step()


def test_each_thread_may_have_a_system_of_its_own(tmp_path: Path, temporary: Path) -> None:
    run = plan_run(write_config(tmp_path))
    found: list[list[float]] = []

    def step_it() -> None:
        with System(run) as system:
            state = system.save()
            for _ in range(3):
                system.restore(state)
                system.step(1000)
            found.append([system.get("pendulum.a"), system.get("delay.y")])

    threads = [threading.Thread(target=step_it) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert len(found) == 4
    assert all(row == found[0] for row in found)
    assert not list(temporary.iterdir())


def test_failed_step_has_instance_point_and_time_and_only_close_is_allowed(
    tmp_path: Path, faulty: Path, temporary: Path
) -> None:
    instances = {
        "pendulum": {"fmu": "DampedPendulum"},
        "faulty": {"fmu": str(faulty), "start_values": {"fail_at": 0.5}},
    }
    with opened(tmp_path, instances=instances, connections=["pendulum.a -> faulty.u"]) as system:
        system.step(400)
        angle = system.get("pendulum.a")

        with pytest.raises(StepFailed, match="the reactor is empty") as failed:
            system.step(200)

        assert (failed.value.instance, failed.value.point, failed.value.time) == ("faulty", 500, 0.5)
        assert (system.point, angle != 0.0) == (500, True)
        for name, call in CALLS.items():
            with pytest.raises(
                CallRefused, match=rf"^{name} is not possible, because an instance has failed before\. Only"
            ):
                call(system, None)  # type: ignore[arg-type]  # it is not looked at
    assert not list(temporary.iterdir())


def test_what_cannot_be_opened_leaves_nothing_behind(tmp_path: Path, faulty: Path, temporary: Path) -> None:
    instances = {"free": {"fmu": "Gain"}, "faulty": {"fmu": str(faulty), "start_values": {"fail_in_init": True}}}
    try:
        with pytest.raises(InitializationFailed) as failed:
            opened(tmp_path, instances=instances, connections=[])
    finally:
        assert not list(temporary.iterdir())
    assert failed.value.instance == "faulty"


def test_an_fmu_that_asks_to_end_ends_the_steps_but_not_looking(tmp_path: Path, event_fmu: EventFmu) -> None:
    stairs = {"fmu": str(event_fmu("Stairs", 3)), "start_values": {"period": 0.125, "end": 3}}
    instances = {"stairs": stairs, "free": {"fmu": "Gain"}}
    with opened(tmp_path, instances=instances, connections=[]) as system:
        state = system.save()
        system.step(1000)

        assert system.ended_by is not None
        assert (system.ended_by.instance, system.point) == ("stairs", 375)
        assert system.get("stairs.counter") == 3
        for name in ("step", "set", "save"):
            with pytest.raises(CallRefused, match=f"{name} is not possible, because 'stairs' has asked to end"):
                CALLS[name](system, state)
        system.restore(state)
        assert system.ended_by is None
        system.step(200)
        assert (system.point, system.get("stairs.counter")) == (200, 1)


def test_ctrl_c_ends_a_step_and_system_can_go_back_to_state(tmp_path: Path) -> None:
    with opened(tmp_path, stop_time=None) as system:
        system.step(50)
        angle, state = system.get("pendulum.a"), system.save()
        system.step(100)
        later = system.get("pendulum.a")

        def interrupt() -> None:
            wait_until(lambda: system.point >= 500, "some steps")
            signal.raise_signal(signal.SIGINT)

        thread = threading.Thread(target=interrupt)
        thread.start()
        with pytest.raises(KeyboardInterrupt):
            system.step(10**9)
        thread.join()

        assert system.point >= 500
        with pytest.raises(CallRefused, match=r"because the last call was interrupted in the middle\. Restore"):
            system.get("pendulum.a")
        system.reset()
        assert (system.point, system.get("pendulum.a")) == (0, 1.5)
        system.step(50)
        assert system.get("pendulum.a") == angle
        state = system.save()
        system.step(1)
        system.restore(state)
        assert (system.point, system.get("pendulum.a")) == (50, angle)
        system.step(100)
        assert system.get("pendulum.a") == later


def test_ctrl_c_between_two_calls_changes_nothing(system: System) -> None:
    system.step(100)
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)

    system.step()
    assert system.point == 101


def test_two_instances_of_an_fmu_that_allows_one_per_process_are_refused(tmp_path: Path) -> None:
    config = write_config(tmp_path, **PENDULUM_AND_GAIN)
    run = plan_run(config)
    instances = {
        name: replace(own, description=replace(own.description, only_once_per_process=True))
        for name, own in run.plan.system.instances.items()
    }
    plan = replace(run.plan, system=replace(run.plan.system, instances=instances))

    with pytest.raises(ConfigurationError, match=r"'gain' and 'free' cannot run in one process: .* Run the mesh in"):
        System(replace(run, plan=plan))


# ---- what is left behind


def test_a_system_that_is_lost_is_closed(tmp_path: Path, temporary: Path) -> None:
    system = opened(tmp_path)
    state = system.save()
    assert len(list(temporary.iterdir())) == 1

    del system
    gc.collect()

    assert not list(temporary.iterdir())
    state.close()


PROGRAM = """
import sys, threading
import fmu_mesh
from fmu_mesh.api.open_system import System

run = fmu_mesh.load(sys.argv[1]).plan()
kept = [System(run)]
kept[0].step(10)
state = kept[0].save()
if sys.argv[2] == "thread":  # it ends before the program does
    thread = threading.Thread(target=lambda: kept.append(System(run)))
    thread.start()
    thread.join()
if sys.argv[2] == "error":
    raise SystemExit(f"{kept[0].get('pendulum.a')}")
"""


@pytest.mark.parametrize("end", ["well", "thread", "error"])
def test_a_program_that_ends_without_closing_leaves_nothing(tmp_path: Path, temporary: Path, end: str) -> None:
    config = write_config(tmp_path, **PENDULUM_AND_GAIN)

    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", PROGRAM, config, end],
        env=os.environ | {"TMPDIR": str(temporary)},
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )

    assert done.returncode == (end == "error"), done.stderr
    assert "Traceback" not in done.stderr
    assert not list(temporary.iterdir())


def test_the_process_stays_as_it_was(tmp_path: Path, faulty: Path) -> None:
    folder, handler = Path.cwd(), signal.getsignal(signal.SIGINT)
    threads = threading.active_count()
    with opened(tmp_path, instances={"faulty": {"fmu": str(faulty)}}, connections=[]) as system:
        system.step(10)
        assert threading.active_count() == threads

    assert (Path.cwd(), signal.getsignal(signal.SIGINT)) == (folder, handler)
