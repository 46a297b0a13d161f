"""The controller of a joint: what it asks for, step by step, and that it goes back to a state."""

from __future__ import annotations

import math

import pytest

from fmu_mesh.errors import StepFailed
from fmu_mesh.instances.position_pid import PidInstance, describe_pid
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.layout import Layout

INPUTS = ("target", "position", "velocity")


class Controller:
    """A controller with rings, stepped by 0.5 s."""

    def __init__(self, **start_values: float) -> None:
        self.instance = PidInstance("pid")
        self.inputs = Ring(Layout.of([(name, "Float64") for name in INPUTS]), 2)
        self.outputs = Ring(Layout.of([(name, "Float64") for name in ("effort",)]), 2)
        self.instance.enter_initialization(0.0, 10.0, start_values)
        self.instance.exit_initialization()
        self.instance.bind(self.inputs, (self.outputs,), TimeGrid(0.0, 0.5, 20), 1)
        self.step = 0

    def go(self, target: float, position: float = 0.0, velocity: float = 0.0) -> float:
        self.inputs.part("Float64")[self.step & 1] = (target, position, velocity)
        self.instance.do_step(self.step)
        self.step += 1
        return float(self.outputs.part("Float64")[self.step & 1, 0])


def test_the_gains_are_tunable_and_the_target_is_an_input() -> None:
    variables = {variable.name: variable for variable in describe_pid().variables}

    assert {name for name, v in variables.items() if v.variability == "tunable"} == {
        *("p", "i", "d", "effort_limit", "integral_limit")
    }
    assert [name for name, v in variables.items() if v.causality == "input"] == list(INPUTS)


def test_each_gain_has_its_part() -> None:
    assert Controller(p=10.0).go(1.0, 0.25) == 7.5
    assert Controller(d=3.0).go(1.0, 0.25, 2.0) == -6.0
    controller = Controller(i=4.0)
    assert [controller.go(1.0), controller.go(1.0), controller.go(0.0)] == [2.0, 4.0, 4.0]


def test_a_jump_of_the_target_gives_no_kick() -> None:
    controller = Controller(p=1.0, d=1000.0)

    assert [controller.go(0.0), controller.go(1.0), controller.go(1.0)] == [0.0, 1.0, 1.0]


def test_gains_can_be_set_between_steps() -> None:
    controller = Controller(p=10.0)
    assert controller.go(1.0) == 10.0

    controller.instance.set_values({"p": 109.0})

    assert controller.go(1.0) == 109.0


def test_limits_hold_and_the_integral_does_not_wind_up() -> None:
    limited = Controller(p=10.0, effort_limit=4.0)
    assert (limited.go(1.0), limited.go(-1.0)) == (4.0, -4.0)
    wound = Controller(i=1.0, integral_limit=0.75)
    assert [wound.go(1.0), wound.go(1.0), wound.go(1.0), wound.go(-0.5)] == [0.5, 0.75, 0.75, 0.5]


def test_before_the_first_step_the_effort_is_that_of_the_start_values() -> None:
    controller = Controller(p=10.0, d=2.0, target=1.0, position=0.5, velocity=1.0)

    assert controller.instance.get_values(["effort", "p"]) == [3.0, 10.0]
    assert controller.outputs.part("Float64")[0, 0] == 3.0


def test_it_goes_back_to_a_state() -> None:
    controller = Controller(p=1.0, i=2.0, effort_limit=9.0)
    controller.go(1.0)
    state = controller.instance.get_state()
    later = [controller.go(1.0), controller.go(0.5)]

    other = Controller()
    other.instance.set_state(state)

    assert [other.go(1.0), other.go(0.5)] == later


def test_an_input_that_is_no_number_ends_the_run_with_its_name() -> None:
    with pytest.raises(StepFailed) as error:
        Controller(p=1.0).go(1.0, math.nan)

    assert (error.value.instance, error.value.variable) == ("pid", "position")
