"""What the host makes of a MuJoCo model: variables, the effort it owns, forces on bodies, states and errors.

Most worlds here are without gravity and damping and are integrated by MuJoCo's Euler method, whose step is known on
paper: ``v' = v + h F/m`` and ``q' = q + h v'``. Where that is one rounded product the floats are equal; `approx` stands
where MuJoCo solves a linear system on the way and rounds once or twice more.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from fmu_mesh.config.instance_sections import ActuatorConfig
from fmu_mesh.errors import LoadFailed, StepFailed
from fmu_mesh.instances.mujoco.mujoco_section import MujocoConfig
from fmu_mesh.instances.mujoco.mujoco_world import load_world
from tests.physics.mujoco_worlds import Driven, body, slider, write_world

HINGE = (
    "<body name='arm'><joint name='joint' axis='0 0 1'/><inertial pos='1 0 0' mass='1' diaginertia='.001 .001 .001'/>"
    "</body>"
)
URDF = """\
<robot name="arm">
  <link name="base"/>
  <link name="upper"><inertial><mass value="1"/><origin xyz="0 0 -1"/>
    <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.001"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="5" velocity="9"/></joint>
</robot>
"""
SECTION = MujocoConfig(mujoco="world.xml")


def actuator(*, disable_limits: bool = False, enabled: bool = True) -> MujocoConfig:
    """A section with an actuator of the joint `slide`."""
    entry = ActuatorConfig(
        name="motor", joint="slide", instance="motor", enabled=enabled, disable_velocity_effort_limits=disable_limits
    )
    return MujocoConfig(mujoco="world.xml", actuators=[entry])


# --- the description


def test_a_model_is_described_as_an_fmu_is(tmp_path: Path) -> None:
    sensors = "<sensor><framepos name='where' objtype='body' objname='arm'/><clock name='clock'/></sensor>"
    motor = "<actuator><motor name='motor' joint='joint'/></actuator>"
    path = write_world(tmp_path, HINGE + slider(), rest=sensors + motor)

    description = load_world(path, SECTION).description

    variables = {variable.name: variable for variable in description.variables}
    assert (description.model_name, description.kind) == ("test", "physics_engine")
    assert description.generation_tool is not None
    assert description.generation_tool.startswith("MuJoCo ")
    assert description.can_get_and_set_state
    joint = ["position", "velocity", "acceleration", "effort_applied", "effort_command", "effort"]
    assert [variables[f"joint.{name}"].unit for name in joint] == ["rad", "rad/s", "rad/s2", "N.m", "N.m", "N.m"]
    assert [variables[f"slide.{name}"].unit for name in joint] == ["m", "m/s", "m/s2", "N", "N", "N"]
    assert [variables[f"joint.{name}"].causality for name in joint] == ["output"] * 4 + ["input"] * 2
    assert {"where.value[1]", "where.value[2]", "where.value[3]", "clock.value", "motor.control", "motor.force"} <= set(
        variables
    )
    assert {"arm.orientation_w", "arm.relative_velocity_x", "arm.force_x", "arm.moment_z", "wind_y"} <= set(variables)
    assert [variable.value_reference for variable in description.variables] == list(range(len(variables)))


def test_a_urdf_is_a_world_with_the_limits_of_its_joints(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(URDF, encoding="utf-8")
    world = Driven(path, ["shoulder.effort"], ["shoulder.effort_applied"])

    assert world.go(shoulder_effort=7.0) == {"shoulder.effort_applied": 5.0}


def test_a_model_that_cannot_be_loaded_says_why(tmp_path: Path) -> None:
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody><body><joint axel='1 0 0'/></body></worldbody></mujoco>", encoding="utf-8")

    with pytest.raises(LoadFailed, match="unrecognized attribute: 'axel'"):
        load_world(broken, SECTION)
    with pytest.raises(LoadFailed, match="No such file"):
        load_world(tmp_path / "absent.xml", SECTION)


def test_without_mujoco_the_way_out_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)

    with pytest.raises(LoadFailed, match=r"worlds of MuJoCo need the library mujoco"):
        load_world(write_world(tmp_path, slider()), SECTION)


def test_an_unknown_keyframe_is_refused_with_the_nearest(tmp_path: Path) -> None:
    path = write_world(tmp_path, slider(), rest="<keyframe><key name='moving' qvel='1'/></keyframe>")

    with pytest.raises(LoadFailed, match=r"no keyframe 'movin', but moving.*Did you mean 'moving'"):
        load_world(path, MujocoConfig(mujoco="world.xml", keyframe="movin"))


# --- where it starts


def test_it_starts_at_the_keyframe_with_start_values_on_top(tmp_path: Path) -> None:
    keys = "<keyframe><key name='moving' qpos='3' qvel='2'/></keyframe>"
    path = write_world(tmp_path, slider(), rest=keys)
    config = MujocoConfig(mujoco="world.xml", keyframe="moving")
    names = ["slide.position", "slide.velocity", "slide.acceleration", "sledge.position_x"]

    world = Driven(path, outputs=names, config=config, start_values={"slide.velocity": -1.0})

    assert list(world.read().values()) == [3.0, -1.0, 0.0, 3.0]
    start = {v.name: v.start for v in load_world(path, config).description.variables}
    assert (start["slide.position"], start["slide.velocity"]) == (3.0, 2.0)


# --- the effort that it owns


def test_the_effort_of_a_step_is_exactly_what_the_mesh_gave(tmp_path: Path) -> None:
    names = ["slide.velocity", "slide.effort_applied", "slide.acceleration"]
    world = Driven(write_world(tmp_path, slider()), ["slide.effort"], names)

    pushed = world.go(slide_effort=4.0)
    coasting = world.go(slide_effort=0.0)

    assert list(pushed.values()) == [0.002, 4.0, 2.0]
    assert list(coasting.values()) == [0.002, 0.0, 0.0]


def test_an_effort_that_somebody_else_left_in_the_engine_is_gone(tmp_path: Path) -> None:
    world = Driven(write_world(tmp_path, slider()), ["slide.effort"], ["slide.velocity"])
    world.instance._data.qfrc_applied[:] = 100.0
    world.instance._data.xfrc_applied[:] = 100.0

    assert world.go() == {"slide.velocity": 0.0}


def test_a_command_is_applied_where_no_actuator_stands_between(tmp_path: Path) -> None:
    path, inputs = write_world(tmp_path, slider()), ["slide.effort", "slide.effort_command"]
    bare = Driven(path, inputs, ["slide.effort_applied"])
    driven = Driven(path, inputs, ["slide.effort_applied"], config=actuator())
    disabled = Driven(path, inputs, ["slide.effort_applied"], config=actuator(enabled=False))

    given = {"slide_effort": 1.0, "slide_effort_command": 8.0}

    assert bare.go(**given) == {"slide.effort_applied": 9.0}
    assert driven.go(**given) == {"slide.effort_applied": 1.0}
    assert disabled.go(**given) == {"slide.effort_applied": 9.0}


def test_a_command_that_is_set_where_an_actuator_stands_between_is_told(tmp_path: Path) -> None:
    driven = Driven(write_world(tmp_path, slider()), config=actuator())

    driven.instance.set_values({"slide.effort_command": 1.0})

    assert driven.messages == [
        "'slide.effort_command' was set, but the joint has an actuator: set the actuator's own input"
    ]


def test_the_effort_keeps_the_limits_of_the_joint_unless_they_are_disabled(tmp_path: Path) -> None:
    path = write_world(tmp_path, slider("axis='1 0 0' actuatorfrcrange='-3 5'"))
    limited = Driven(path, ["slide.effort"], ["slide.effort_applied"], config=actuator())
    free = Driven(path, ["slide.effort"], ["slide.effort_applied"], config=actuator(disable_limits=True))

    assert limited.go(slide_effort=7.0) == {"slide.effort_applied": 5.0}
    assert limited.go(slide_effort=-7.0) == {"slide.effort_applied": -3.0}
    assert free.go(slide_effort=7.0) == {"slide.effort_applied": 7.0}


def test_a_prismatic_joint_moves_along_its_own_axis(tmp_path: Path) -> None:
    names = ["slide.position", "sledge.position_x", "sledge.position_y", "sledge.linear_velocity_y"]
    world = Driven(write_world(tmp_path, slider("axis='0 1 0'")), ["slide.effort"], names)

    after = world.go(1000, slide_effort=2.0)

    # h² F/m (1 + 2 + … + 1000) = 0.5005 m, and 1 m/s; a thousand roundings of at most half a unit in the last place.
    assert after["slide.position"] == pytest.approx(0.5005, abs=1e-12)
    assert after["sledge.position_x"] == 0.0
    assert after["sledge.position_y"] == after["slide.position"]
    assert after["sledge.linear_velocity_y"] == pytest.approx(1.0, abs=1e-12)


def test_actuators_of_the_model_are_driven_by_their_control(tmp_path: Path) -> None:
    motor = "<actuator><motor name='motor' joint='slide' gear='3'/></actuator>"
    path = write_world(tmp_path, slider(), rest=motor)
    world = Driven(path, ["motor.control"], ["slide.velocity", "motor.force"])

    assert list(world.go(motor_control=2.0).values()) == [0.003, 2.0]
    assert list(world.go().values()) == [0.003, 0.0]


# --- forces on bodies


def test_a_force_acts_along_the_axes_of_the_body(tmp_path: Path) -> None:
    quarter = "euler='0 0 90'"
    names = [f"cube.linear_velocity_{axis}" for axis in "xyz"]
    world = Driven(write_world(tmp_path, body(pose=quarter)), ["cube.force_x"], names)

    velocity = list(world.go(cube_force_x=4.0).values())

    assert velocity == pytest.approx([0.0, 0.002, 0.0], abs=1e-15)


def test_a_force_acts_at_origin_and_turns_body_whose_centre_is_elsewhere(tmp_path: Path) -> None:
    inertial = "pos='0 1 0' mass='2' diaginertia='1 1 1'"
    names = ["cube.angular_velocity_z", "cube.linear_velocity_x"]
    world = Driven(write_world(tmp_path, body(inertial=inertial)), ["cube.force_x", "cube.moment_z"], names)

    turned = world.go(cube_force_x=4.0)

    # About the centre of mass: the arm is -1 m, so M = 4 N m; the origin gets F/m h plus the share of the turn.
    assert turned["cube.angular_velocity_z"] == pytest.approx(0.004, rel=1e-12)
    assert turned["cube.linear_velocity_x"] == pytest.approx(0.002 + 0.004, rel=1e-5)
    undone = Driven(write_world(tmp_path, body(inertial=inertial)), ["cube.force_x", "cube.moment_z"], names)
    assert undone.go(cube_force_x=4.0, cube_moment_z=-4.0)["cube.angular_velocity_z"] == pytest.approx(0.0, abs=1e-15)


def test_a_force_turns_with_its_body_within_a_step(tmp_path: Path) -> None:
    # 1000 rad/s turn the body by half a turn in 3.14 ms: with three steps of the engine the forces nearly cancel.
    keys = "<keyframe><key name='spin' qpos='0 0 0 1 0 0 0' qvel='0 0 0 0 0 1000'/></keyframe>"
    path = write_world(tmp_path, body(), rest=keys)
    config = MujocoConfig(mujoco="world.xml", keyframe="spin", physics_steps=628)
    world = Driven(path, ["cube.force_x"], ["cube.linear_velocity_x"], config=config, step_size=2 * math.pi / 1000)

    # A full turn in 628 steps: the sum of the unit vectors is zero, up to the attitude's own rounding.
    assert world.go(cube_force_x=2000.0)["cube.linear_velocity_x"] == pytest.approx(0.0, abs=1e-9)


def test_wind_and_relative_velocity_are_in_the_axes_of_the_body(tmp_path: Path) -> None:
    keys = "<keyframe><key name='moving' qpos='0 0 0 1 0 0 0' qvel='0 3 0 0 0 0'/></keyframe>"
    path = write_world(tmp_path, body(pose="euler='0 0 90'"), rest=keys.replace("1 0 0 0'", "0.5 0 0 0.5'"))
    names = [f"cube.{what}_{axis}" for what in ("wind", "relative_velocity") for axis in "xyz"]
    config = MujocoConfig(mujoco="world.xml", keyframe="moving")
    world = Driven(path, ["wind_y", "wind_z"], names, config=config)

    after = list(world.go(wind_y=1.0, wind_z=0.5).values())

    assert after == pytest.approx([1.0, 0.0, 0.5, 2.0, 0.0, -0.5], abs=1e-15)


@pytest.mark.parametrize("seed", range(5))
def test_velocities_are_how_positions_change(tmp_path: Path, seed: int) -> None:
    random = np.random.default_rng(seed)
    attitude, velocity = random.normal(size=4), random.normal(size=6)
    state = " ".join(map(str, (*random.normal(size=3), *attitude / np.linalg.norm(attitude))))
    keys = f"<keyframe><key name='k' qpos='{state}' qvel='{' '.join(map(str, velocity))}'/></keyframe>"
    inertial = "pos='0.3 -0.2 0.1' mass='2' diaginertia='1 1.2 1.5'"
    path = write_world(tmp_path, body(inertial=inertial), rest=keys)
    names = [f"cube.{what}_{axis}" for what in ("position", "linear_velocity") for axis in "xyz"]
    config = MujocoConfig(mujoco="world.xml", keyframe="k")

    world = Driven(path, outputs=names, config=config, step_size=1e-6)
    before, after = np.array(list(world.read().values())), np.array(list(world.go().values()))

    # Over 1 us a velocity of a few m/s changes by some 1e-6 of itself, and a position of 1 m is exact to 1e-16 m.
    assert (after[:3] - before[:3]) / 1e-6 == pytest.approx(before[3:], abs=1e-4)


def test_a_wind_that_is_connected_is_felt_at_the_first_point(tmp_path: Path) -> None:
    description = load_world(write_world(tmp_path, body()), SECTION).description

    felt = {v.name for v in description.variables if v.dependencies == ("wind_x", "wind_y", "wind_z")}

    assert felt == {f"cube.{what}_{axis}" for what in ("wind", "relative_velocity") for axis in "xyz"}


@pytest.mark.parametrize("seed", range(5))
def test_velocities_in_body_axes_are_those_of_sensors(tmp_path: Path, seed: int) -> None:
    random = np.random.default_rng(seed)
    attitude, velocity = random.normal(size=4), random.normal(size=6)
    state = " ".join(map(str, (*random.normal(size=3), *attitude / np.linalg.norm(attitude))))
    keys = f"<keyframe><key name='k' qpos='{state}' qvel='{' '.join(map(str, velocity))}'/></keyframe>"
    sensors = "<sensor><velocimeter name='v' site='s'/><gyro name='w' site='s'/></sensor>"
    cube = body(inertial="pos='0.3 -0.2 0.1' mass='2' diaginertia='1 1.2 1.5'").replace(
        "<inertial", "<site name='s'/><inertial"
    )
    own = [f"cube.body_{what}_velocity_{axis}" for what in ("linear", "angular") for axis in "xyz"]
    measured = [f"{name}.value[{number}]" for name in "vw" for number in (1, 2, 3)]

    world = Driven(
        write_world(tmp_path, cube, rest=keys + sensors),
        outputs=[*own, *measured],
        config=MujocoConfig(mujoco="world.xml", keyframe="k"),
    )

    for values in (list(world.read().values()), list(world.go(10).values())):
        assert values[:6] == pytest.approx(values[6:], rel=1e-12, abs=1e-12)
    assert world.instance.get_values(own) == values[:6]
    assert list(world.read().values())[3:6] != velocity[3:].tolist()


# --- the state of a free body

# A half turn about x: the products of its matrix with a vector are exact.
POSE, TWIST = [1.0, 2.0, 3.0, 0.0, 1.0, 0.0, 0.0], [0.25, -0.5, 0.75, 1.5, -2.5, 0.125]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"cube.state": [*POSE, *TWIST]}, [*POSE, *TWIST]),
        ({"cube.pose": POSE, "cube.twist": TWIST}, [*POSE, *TWIST]),
        ({"cube.twist": TWIST, "cube.pose": POSE}, [*POSE, *TWIST]),
        ({"cube.pose": [*POSE[:4], 3.0, 0.0, 0.0]}, [*POSE, *[0.0] * 6]),
        ({"cube.twist": TWIST}, [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, *TWIST]),
        ({"cube.pose": [0.0] * 7}, [0.0, 0.0, 0.0, 1.0, *[0.0] * 9]),
    ],
)
def test_next_step_begins_with_the_state_that_was_set(
    tmp_path: Path, given: dict[str, list[float]], expected: list[float]
) -> None:
    path = write_world(tmp_path, slider() + body(inertial="pos='0 0 0' mass='2' diaginertia='1 2 3'"))
    names = [f"cube.{what}" for what in ("position_x", "orientation_y", "linear_velocity_z", "angular_velocity_x")]
    driven = Driven(path, ["slide.effort"], [*names, "slide.position"])
    before = driven.go(7, slide_effort=2.0)
    driven.instance.set_values(given)

    assert driven.instance.get_values(["cube.state", "cube.twist", "slide.position"]) == [
        expected,
        expected[7:],
        before["slide.position"],
    ]
    engine = mujoco.MjData(driven.instance._model)
    mujoco.mj_setState(driven.instance._model, engine, whole(driven), mujoco.mjtState.mjSTATE_INTEGRATION)
    half_turn = -1.0 if expected[4] else 1.0
    engine.qpos[1:8] = expected[:7]
    engine.qvel[1:7] = [*expected[7:11], half_turn * expected[11], half_turn * expected[12]]
    after = driven.go(3, slide_effort=2.0)
    for _ in range(3):
        mujoco.mj_step(driven.instance._model, engine)
    mujoco.mj_kinematics(driven.instance._model, engine)

    assert driven.instance.get_values(["cube.pose"]) == [[*engine.xpos[2].tolist(), *engine.xquat[2].tolist()]]
    assert after["cube.position_x"] == engine.qpos[1]
    assert after["slide.position"] == engine.qpos[0]


def whole(driven: Driven) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.zeros(mujoco.mj_stateSize(driven.instance._model, kind))
    mujoco.mj_getState(driven.instance._model, driven.instance._data, state, kind)
    return state


def test_free_bodies_have_a_state_that_can_be_a_start_value(tmp_path: Path) -> None:
    keys = "<keyframe><key name='k' qpos='1 2 3 0 2 0 0 0' qvel='1 2 3 4 5 6 0'/></keyframe>"
    path = write_world(tmp_path, body() + slider(), rest=keys)
    config = MujocoConfig(mujoco="world.xml", keyframe="k")
    variables = {own.name: own for own in load_world(path, config).description.variables}

    state = variables["cube.state"]
    assert (state.causality, state.variability, state.shape) == ("parameter", "tunable", (13,))
    assert state.start == [1.0, 2.0, 3.0, 0.0, 1.0, 0.0, 0.0, 1.0, 2.0, 3.0, 4.0, -5.0, -6.0]
    assert (variables["cube.pose"].start, variables["cube.twist"].start) == (state.start[:7], state.start[7:])
    assert "sledge.state" not in variables
    placed = Driven(path, config=config, start_values={"cube.pose": [5.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]})
    assert placed.instance.get_values(["cube.state"]) == [[5.0, 0.0, 0.0, 1.0, *[0.0] * 3, *state.start[7:]]]


# --- time and steps


def test_the_engine_takes_as_few_steps_as_none_is_longer_than_models(tmp_path: Path) -> None:
    path = write_world(tmp_path, slider(), rest="<sensor><clock name='clock'/></sensor>")
    found = {}
    for step_size in (0.0005, 0.001, 0.0025, 0.01):
        world = Driven(path, outputs=["clock.value"], step_size=step_size)
        found[step_size] = (world.instance._substeps, world.instance._model.opt.timestep)
        assert world.go()["clock.value"] == pytest.approx(step_size, rel=1e-15)

    assert found == {0.0005: (1, 0.0005), 0.001: (1, 0.001), 0.0025: (3, 0.0025 / 3), 0.01: (10, 0.001)}


def test_physics_steps_are_free(tmp_path: Path) -> None:
    path = write_world(tmp_path, slider())
    config = MujocoConfig(mujoco="world.xml", physics_steps=4)
    world = Driven(path, ["slide.effort"], ["slide.position", "slide.velocity"], config=config)

    after = world.go(slide_effort=2.0)

    # Four steps of h/4 of semi-implicit Euler: (1 + 2 + 3 + 4) (h/4)² F/m.
    assert after["slide.position"] == pytest.approx(10 * 0.00025**2, rel=1e-14)
    assert after["slide.velocity"] == pytest.approx(0.001, rel=1e-14)


# --- sensors


def test_position_sensors_show_the_point_and_acceleration_sensors_the_last_step(tmp_path: Path) -> None:
    sledge = slider().replace("<inertial", "<site name='s'/><inertial")
    sensors = "<sensor><jointpos name='where' joint='slide'/><accelerometer name='feel' site='s'/></sensor>"
    names = ["slide.position", "where.value", "feel.value[1]"]
    world = Driven(write_world(tmp_path, sledge, rest=sensors), ["slide.effort"], names)

    assert world.read()["feel.value[1]"] == 0.0
    after = world.go(slide_effort=4.0)
    assert after["where.value"] == after["slide.position"] != 0.0
    assert after["feel.value[1]"] == pytest.approx(2.0, rel=1e-14)
    assert world.instance.get_values(["feel.value[1]"]) == [after["feel.value[1]"]]


def test_what_is_read_changes_nothing_of_what_happens(tmp_path: Path) -> None:
    # A box that falls on a floor and slides: contacts, friction and the solver's warm start.
    path = write_world(
        tmp_path,
        "<geom type='plane' size='5 5 1'/><body name='box' pos='0 0 0.4' euler='10 20 30'><freejoint/>"
        "<geom type='box' size='0.1 0.2 0.3' mass='1'/></body>",
        rest="<sensor><subtreecom name='com' body='box'/></sensor>",
    )
    path.write_text(path.read_text().replace("0 0 0' timestep", "0 0 -9.81' timestep").replace("contact='disable'", ""))
    little = Driven(path, ["box.force_x"], ["box.position_x"])
    much = Driven(path, ["box.force_x"], ["box.position_x", "box.angular_velocity_z", "com.value[3]"])

    for _ in range(40):
        much.instance.get_values(["com.value[1]", "box.relative_velocity_x"])
        assert little.go(20, box_force_x=1.0)["box.position_x"] == much.go(20, box_force_x=1.0)["box.position_x"]


# --- state


def test_from_a_state_the_same_steps_give_the_same_floats(tmp_path: Path) -> None:
    sledge = slider().replace("<inertial", "<site name='s'/><inertial")
    sensors = "<sensor><accelerometer name='feel' site='s'/></sensor>"
    path = write_world(tmp_path, sledge + body("cube"), rest=sensors)
    inputs = ["slide.effort", "cube.force_x", "cube.moment_z", "wind_x"]
    names = [
        "slide.position",
        "slide.acceleration",
        "slide.effort_applied",
        "feel.value[1]",
        "cube.relative_velocity_x",
    ]
    world = Driven(path, inputs, names)
    given = {"slide_effort": 3.0, "cube_force_x": 1.0, "cube_moment_z": 0.5, "wind_x": 0.25}
    world.go(7, **given)
    state, here = world.instance.get_state(), world.read()
    later = world.go(9, **given)

    other = Driven(path, inputs, names)
    other.instance.set_state(state)
    other.step = 7
    other.instance.bind(other.inputs, (other.outputs,), other.grid, 1, 7)

    assert other.read() == here
    assert other.go(9, **given) == later
    world.instance.set_state(state)
    world.step = 7
    world.instance.bind(world.inputs, (world.outputs,), world.grid, 1, 7)
    assert world.read() == here
    assert world.go(9, **given) == later


def test_bytes_that_are_no_state_are_refused(tmp_path: Path) -> None:
    world = Driven(write_world(tmp_path, slider()))

    with pytest.raises(StepFailed, match="16 bytes are no state"):
        world.instance.set_state(bytes(16))


# --- errors


@pytest.mark.parametrize("name", ["slide.effort", "motor.control"])
def test_an_input_that_is_no_number_ends_the_run_with_its_name(tmp_path: Path, name: str) -> None:
    motor = "<actuator><motor name='motor' joint='slide'/></actuator>"
    world = Driven(write_world(tmp_path, slider(), rest=motor), [name], ["slide.position"])

    with pytest.raises(StepFailed) as error:
        world.go(**{name.replace(".", "_"): math.nan})

    assert (error.value.instance, error.value.variable) == ("world", name)


def test_a_world_that_flies_apart_ends_run_and_does_not_start_again(tmp_path: Path) -> None:
    world = Driven(write_world(tmp_path, slider("axis='1 0 0' damping='1e9'")), ["slide.effort"], ["slide.position"])

    with pytest.raises(StepFailed, match="MuJoCo says") as error:
        world.go(100, slide_effort=1.0)

    assert error.value.variable == "slide.acceleration"


NAMELESS = """
<mujoco>
  <worldbody>
    <body name='b'>
      <joint name='shoulder' type='ball'/><geom size='0.1'/>
      <body><joint/><geom size='0.1'/></body>
    </body>
    <body><freejoint name='float'/><geom size='0.1'/></body>
  </worldbody>
  <sensor><clock/></sensor>
</mujoco>"""

FUSED = """
<robot name='r'>
  <link name='base'/>
  <link name='arm'>
    <inertial><mass value='1'/><inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/></inertial>
  </link>
  <link name='camera'/>
  <joint name='turn' type='continuous'><parent link='base'/><child link='arm'/></joint>
  <joint name='mount' type='fixed'><parent link='arm'/><child link='camera'/></joint>
</robot>"""


@pytest.mark.parametrize(
    ("text", "notes"),
    [
        (
            NAMELESS,
            (
                "the joint 'shoulder' is simulated, and has no variables, as it is a ball joint",
                "joints without a name have no variables; there are 1",
                "sensors without a name have no variables; there are 1",
            ),
        ),
        (FUSED, ("links that a fixed joint makes part of another have no variables: base, camera",)),
    ],
    ids=["MJCF", "URDF"],
)
def test_what_of_a_model_has_no_variables_is_told(text: str, notes: tuple[str, ...], tmp_path: Path) -> None:
    path = tmp_path / "model.xml"
    path.write_text(text, encoding="utf-8")

    description = load_world(path, MujocoConfig(mujoco="")).description

    assert description.problems == notes
    assert ("turn.position" in {v.name for v in description.variables}) == ("robot" in text)
