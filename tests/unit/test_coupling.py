"""What the sections of a physics engine mean as connections, and what is said where something does not fit."""

from __future__ import annotations

from pathlib import Path

import pytest

from fmu_mesh.config.loading import read_file
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.instances.configuration import examine_data
from fmu_mesh.instances.position_pid import describe_pid
from fmu_mesh.system.plan import Plan, make_plan
from fmu_mesh.system.system import build
from fmu_mesh.variables.model_description import Causality, ModelDescription, Variable
from tests.planning import parse

FILE = Path("/models/configs/mesh.yaml")
AXES = "xyz"


def description(*, inputs: tuple[str, ...] = (), outputs: tuple[str, ...] = ()) -> ModelDescription:
    """A model with these Real variables, all outputs of an engine known at once."""

    def variable(name: str, causality: Causality) -> Variable:
        return Variable(name, 0, "Float64", causality, "continuous", dependencies=() if "." in name else None)

    variables = (*(variable(name, "input") for name in inputs), *(variable(name, "output") for name in outputs))
    return ModelDescription("model", "model", "2.0", "co_simulation", "{1}", variables)


ACTUATOR = description(
    inputs=("actuatorInput", "jointPosition", "jointVelocity", "jointAcceleration"), outputs=("jointTorque", "current")
)
RENAMED = description(
    inputs=("voltage", "jointPosition", "jointVelocity", "jointAcceleration"), outputs=("jointTorque", "torque")
)
FLUID = description(
    inputs=tuple(f"relativeVelocity_{axis}" for axis in AXES),
    outputs=(*(f"fluidDynamicForce_{axis}" for axis in AXES), *(f"fluidDynamicMoment_{axis}" for axis in AXES)),
)
WORLD = description(
    inputs=(
        *("hip.effort", "hip.effort_command", "knee.effort", "knee.effort_command"),
        *(f"boat.{what}_{axis}" for what in ("force", "moment") for axis in AXES),
    ),
    outputs=(
        *(f"{joint}.{what}" for joint in ("hip", "knee") for what in ("position", "velocity", "acceleration")),
        *(f"boat.relative_velocity_{axis}" for axis in AXES),
    ),
)
DESCRIPTIONS = {
    "world": WORLD,
    "motor": ACTUATOR,
    "other": RENAMED,
    "fluid": FLUID,
    "pid": describe_pid(),
}


def text(world: str, connections: str = "", algorithm: str = "gauss_seidel") -> str:
    return f"""\
mesh: test
simulation: {{stop_time: 1, step_size: 0.1, algorithm: {algorithm}}}
instances:
  world: {{mujoco: world.xml, {world}}}
  motor: {{fmu: motor.fmu}}
  other: {{fmu: other.fmu}}
  fluid: {{fmu: fluid.fmu}}
  pid: {{controller: position_pid}}
connections: [{connections}]
record: {{file: null}}
"""


def plan(world: str, connections: str = "", algorithm: str = "gauss_seidel") -> Plan:
    return make_plan(build(parse(text(world, connections, algorithm), FILE), DESCRIPTIONS))


def shown(world: str, connections: str = "", algorithm: str = "gauss_seidel") -> list[str]:
    return [f"{c} {c.delay}" for c in plan(world, connections, algorithm).connections]


def findings(world: str, connections: str = "") -> list[str]:
    with pytest.raises(ConfigurationError) as error:
        plan(world, connections)
    return [f"{f.path}: {f.found}; expected {f.expected}; {f.suggestion}" for f in error.value.findings]


MOTOR = "actuators: [{name: m, joint: hip, instance: motor}]"
PID = "controllers: [{name: c, joint: hip, instance: pid}]"


def test_actuator_reads_its_joint_one_point_late_and_drives_it_at_once() -> None:
    assert shown(MOTOR) == [
        "world.hip.position -> motor.jointPosition 1",
        "world.hip.velocity -> motor.jointVelocity 1",
        "world.hip.acceleration -> motor.jointAcceleration 1",
        "motor.jointTorque -> world.hip.effort 0",
    ]


def test_the_order_is_controller_then_actuator_then_engine() -> None:
    made = plan(f"{MOTOR}, {PID}")

    assert [name for name in made.order if name in ("world", "motor", "pid")] == ["pid", "motor", "world"]
    assert "pid.effort -> motor.actuatorInput" in map(str, made.connections)
    assert "pid.effort -> world.hip.effort_command" in map(str, made.connections)


def test_jacobi_makes_all_of_it_one_point_late() -> None:
    assert {line[-1] for line in shown(f"{MOTOR}, {PID}", algorithm="jacobi")} == {"1"}


def test_what_any_instance_commands_goes_to_the_actuator_with_its_arithmetic() -> None:
    command = "{from: other.torque, to: world.hip.effort_command, factor: 2, offset: 1}"
    made = plan(MOTOR, command)

    [taken] = [c for c in made.connections if c.target.name == "actuatorInput"]
    assert (str(taken), taken.factor, taken.offset) == ("other.torque -> motor.actuatorInput", 2.0, 1.0)


def test_a_command_for_another_joint_does_not_go_to_the_actuator() -> None:
    assert not any("actuatorInput" in line for line in shown(MOTOR, "other.torque -> world.knee.effort_command"))


def test_what_is_not_enabled_is_not_there() -> None:
    assert shown("actuators: [{name: m, joint: nowhere, instance: nobody, enabled: false}]") == []


def test_fluid_dynamics_couple_velocity_force_and_moment() -> None:
    lines = shown("fluid_dynamics: [{name: f, link: boat, instance: fluid}]")

    assert [line for line in lines if line.endswith(" 1")] == [
        f"world.boat.relative_velocity_{axis} -> fluid.relativeVelocity_{axis} 1" for axis in AXES
    ]
    assert [line for line in lines if line.endswith(" 0")] == [
        f"fluid.fluidDynamic{what}_{axis} -> world.boat.{what.lower()}_{axis} 0"
        for what in ("Force", "Moment")
        for axis in AXES
    ]


def test_other_variable_names_take_the_place_of_the_default_ones() -> None:
    names = "variable_names: {actuatorInput: voltage, jointTorque: torque}"
    lines = shown(f"actuators: [{{name: m, joint: hip, instance: other, {names}}}], {PID}")

    assert "pid.effort -> other.voltage 0" in lines
    assert "other.torque -> world.hip.effort 0" in lines


def test_a_missing_variable_is_refused_by_name() -> None:
    assert findings("actuators: [{name: m, joint: hip, instance: other}]") == [
        (
            "instances.world.actuators[0]: 'other', which has no variable 'actuatorInput'; "
            "expected a Real input for 'actuatorInput' ('m'); it may have another name in `variable_names`; None"
        )
    ]


def test_a_wrong_name_is_refused_with_the_nearest() -> None:
    names = "variable_names: {actuatorInput: voltag, jointTork: torque}"

    found = findings(f"actuators: [{{name: m, joint: hip, instance: other, {names}}}]")

    assert [line.partition(";")[0] for line in found] == [
        "instances.world.actuators[0].variable_names.jointTork: the unknown name 'jointTork'",
        "instances.world.actuators[0].variable_names.actuatorInput: 'other', which has no variable 'voltag'",
    ]
    assert [line.rpartition("; ")[2] for line in found] == ["jointTorque", "voltage"]


def test_an_unknown_joint_body_or_instance_is_refused_with_the_nearest() -> None:
    found = findings(
        "actuators: [{name: m, joint: hipp, instance: motr}], fluid_dynamics: [{name: f, link: bote, instance: fluid}]"
    )

    assert found == [
        (
            "instances.world.fluid_dynamics[0].link: the unknown body 'bote' of 'world'; "
            "expected one of its bodies: boat; boat"
        ),
        (
            "instances.world.actuators[0].instance: the unknown instance 'motr'; "
            "expected one of the instances world, motor, other, fluid, pid; motor"
        ),
        (
            "instances.world.actuators[0].joint: the unknown joint 'hipp' of 'world'; "
            "expected one of its revolute and prismatic joints: hip, knee; hip"
        ),
    ]


def test_a_second_source_is_refused_with_both() -> None:
    [taken] = findings(MOTOR, "other.torque -> world.hip.effort")
    twice = findings("actuators: [{name: m, joint: hip, instance: motor}, {name: n, joint: hip, instance: motor}]")

    assert taken.startswith(
        "instances.world.actuators[0]: a second source for the input 'world.hip.effort': "
        "motor.jointTorque -> world.hip.effort, after other.torque -> world.hip.effort (connections[0])"
    )
    assert len(twice) == 4
    assert all(line.startswith("instances.world.actuators[1]: a second source for the input") for line in twice)


def test_a_start_value_for_a_command_that_nobody_takes_is_refused() -> None:
    [found] = findings(f"{MOTOR}, start_values: {{hip.effort_command: 2}}")

    assert found == (
        "instances.world.start_values.hip.effort_command: a start value for 'hip.effort_command', "
        "although the joint has the actuator 'm'; expected a start value of 'motor.actuatorInput'; None"
    )


def structure_of(world: str, folder: Path) -> list[str]:
    """Where the structure of a file is wrong."""
    path = folder / "mesh.yaml"
    path.write_text(text(world), encoding="utf-8")
    return [f"{finding.path}: {finding.found}; {finding.suggestion}" for finding in examine_data(read_file(path))[1]]


def test_all_that_is_wrong_with_the_structure_of_a_section_is_shown(tmp_path: Path) -> None:
    world = "actuators: [{joint: 3, instance: motor}], physics_steps: 0, keyfame: a"

    assert structure_of(world, tmp_path) == [
        "instances.world.actuators[0].joint: 3; None",
        "instances.world.actuators[0].name: missing; None",
        "instances.world.physics_steps: 0; None",
        "instances.world.keyfame: an unknown key; keyframe",
    ]


def test_an_instance_is_of_one_kind(tmp_path: Path) -> None:
    assert structure_of("fmu: a.fmu", tmp_path) == ["instances.world.mujoco: an unknown key; None"]
