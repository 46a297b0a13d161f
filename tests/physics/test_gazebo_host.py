"""The host for Gazebo classic without Gazebo: worlds, variables, efforts, and every way in which its process may fail.

The process is `tests/physics/gazebo_double.py`; with the real one, `test_gazebo_classic.py` does the same things.
"""

from __future__ import annotations

import shlex
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pytest

from fmu_mesh.cli.main import main
from fmu_mesh.config.instance_sections import ActuatorConfig
from fmu_mesh.config.mesh import TimeoutsConfig
from fmu_mesh.errors import FmuError, InitializationFailed, LoadFailed, StepFailed
from fmu_mesh.instances.gazebo.gazebo_classic import GazeboClassicInstance
from fmu_mesh.instances.gazebo.gazebo_section import GazeboClassicConfig
from fmu_mesh.instances.gazebo.gazebo_world import load_gazebo_world
from fmu_mesh.rings.ring import Ring
from fmu_mesh.run.options import PlanOptions
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.layout import Layout
from tests.helpers import FMUS
from tests.plain_run import PlainRun
from tests.planning import prepare

WORLDS = Path(__file__).resolve().parents[2] / "configs" / "worlds"
DOUBLE = Path(__file__).with_name("gazebo_double.py")

JOINT = "<joint name='{name}' type='{kind}'><axis><limit><effort>{effort}</effort></limit></axis></joint>"


def write_world(folder: Path, content: str) -> Path:
    path = folder / "world.sdf"
    path.write_text(f"<sdf version='1.6'><world name='test'>{content}</world></sdf>", encoding="utf-8")
    return path


def arm(name: str = "arm", joint: str = "elbow", effort: float = -1.0, kind: str = "revolute") -> str:
    return f"<model name='{name}'><link name='rod'/>{JOINT.format(name=joint, effort=effort, kind=kind)}</model>"


@pytest.fixture
def fault(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Say what goes wrong in the process."""

    def choose(kind: str) -> None:
        monkeypatch.setenv("FMU_MESH_GAZEBO", shlex.join([sys.executable, str(DOUBLE), kind]))

    choose("nothing")
    return choose


class Driven:
    """One instance that is stepped by a test, with a step size of 0.01 s by default."""

    def __init__(
        self,
        path: Path,
        inputs: Sequence[str],
        outputs: Sequence[str],
        config: GazeboClassicConfig | None = None,
        start_values: Mapping[str, float] | None = None,
        timeouts: TimeoutsConfig = TimeoutsConfig(),  # noqa: B008  a frozen Struct
    ) -> None:
        own = config or GazeboClassicConfig(gazebo_classic="")
        self.instance = GazeboClassicInstance(path, "world", own, timeouts)
        self.inputs = Ring(Layout.of([(name, "Float64") for name in inputs]), 4)
        self.outputs = Ring(Layout.of([(name, "Float64") for name in outputs]), 4)
        self.instance.enter_initialization(0.0, 1.0, start_values or {})
        self.instance.exit_initialization()
        grid = TimeGrid(start_time=0.0, step_size=0.01, last_point=100)
        self.instance.bind(self.inputs, [self.outputs], grid, 1)
        self.step = 0

    def take(self, *values: float) -> list[float]:
        """Take a step with these inputs; return the outputs."""
        self.inputs.part("Float64")[self.step & self.inputs.mask] = values
        self.instance.do_step(self.step)
        self.step += 1
        return [*map(float, self.outputs.part("Float64")[self.step & self.outputs.mask])]


# ---- worlds ----


@pytest.mark.parametrize("name", ["damped_pendulum", "electrical_actuator", "fluid_body"])
def test_an_example_world_has_the_joints_and_bodies_of_its_twin(name: str) -> None:
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    model = mujoco.MjModel.from_xml_path(str(WORLDS / f"{name}.xml"))
    bodies = {model.body(number).name: float(model.body_mass[number]) for number in range(1, model.nbody)}
    joints = {model.joint(number).name for number in range(model.njnt)} - {""}

    variables = load_gazebo_world(WORLDS / f"{name}.sdf", GazeboClassicConfig(gazebo_classic="")).description.variables

    names = {variable.name for variable in variables}
    assert {name.removesuffix(".effort") for name in names if name.endswith(".effort")} == joints
    assert {name.removesuffix(".force_x") for name in names if name.endswith(".force_x")} == set(bodies)
    assert set(bodies.values()) == {1.0}


def test_names_that_two_models_share_are_told_apart_by_the_model(tmp_path: Path) -> None:
    path = write_world(tmp_path, arm("left") + arm("right") + arm("third", "wrist", kind="prismatic"))

    description = load_gazebo_world(path, GazeboClassicConfig(gazebo_classic="")).description

    positions = [v for v in description.variables if v.name.endswith(".position")]
    assert [(v.name, v.unit) for v in positions] == [
        ("left::elbow.position", "rad"),
        ("right::elbow.position", "rad"),
        ("wrist.position", "m"),
    ]
    assert [v.value_reference for v in description.variables] == [*range(len(description.variables))]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("no xml", "cannot be read: Start tag expected"),
        ("<sdf version='1.6'><model name='m'/></sdf>", "is no SDF file with one world"),
        (
            "<sdf version='1.6'><world name='w'><include><uri>model://house</uri></include></world></sdf>",
            "includes a model (model://house)",
        ),
        (
            "<sdf><world><include><uri>model://a</uri></include><model><include><uri>b/Sunny</uri></include></model></world></sdf>",
            "includes models (model://a, b/Sunny)",
        ),
        (
            "<sdf version='1.6'><world name='w'><world name='v'/><joint name='j' type='fixed'/></world></sdf>",
            "cannot be simulated with Gazebo classic: the world 'v' in a world; the joint 'j' outside of a model",
        ),
        (
            "<sdf><world><model name='m'><model name='n'><joint name='j' type='hinge'/></model></model></world></sdf>",
            "the joint 'm::n::j' of the type 'hinge'",
        ),
        (
            "<sdf><world><model name='my arm'><link name='a'/></model></world></sdf>",
            "a space in the name 'my arm::a'",
        ),
        (
            "<sdf version='1.6'><world name='w'><physics><max_step_size>fast</max_step_size></physics></world></sdf>",
            "has 'fast' where a number should be",
        ),
        (
            f"<sdf version='1.6'><world name='w'>{'<model>' * 5000}{'</model>' * 5000}</world></sdf>",
            "elements are nested more than 255 deep",
        ),
        (
            "<!DOCTYPE l [<!ENTITY a 'b'>]><sdf version='1.6'><world name='&a;'/></sdf>",
            "declares a document type, with which XML can expand without limit",
        ),
    ],
)
def test_a_file_that_gazebo_could_not_load_by_itself_is_refused(text: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "world.sdf"
    path.write_text(text, encoding="utf-8")

    with pytest.raises(LoadFailed) as caught:
        load_gazebo_world(path, GazeboClassicConfig(gazebo_classic=""))

    assert expected in caught.value.message


@pytest.mark.parametrize(
    "uri",
    [
        "model://{name}",
        "model://{name}/",
        "https://fuel.gazebosim.org/1.0/OpenRobotics/models/{title}",
        "https://fuel.ignitionrobotics.org/1.0/OpenRobotics/models/{quoted}/3",
        "https://fuel.gazebosim.org/1.0/openrobotics/models/{title}/tip",
    ],
)
def test_the_sun_and_the_ground_need_no_file(uri: str, tmp_path: Path) -> None:
    sun, ground = (
        uri.format(name=name, title=title, quoted=title.replace(" ", "%20"))
        for name, title in (("sun", "Sun"), ("ground_plane", "Ground Plane"))
    )
    included = f"<include><uri>{sun}</uri></include><include><uri>{ground}</uri><name>floor</name></include>"

    world = load_gazebo_world(write_world(tmp_path, included + arm()), GazeboClassicConfig(gazebo_classic=""))

    root = ET.fromstring(world.text)  # noqa: S314  written above
    assert [model.get("name") for model in root.findall("world/model")] == ["floor", "arm"]
    assert root.find("world/model[@name='floor']/link/collision/geometry/plane") is not None
    assert list(root.iter("include")) == []
    assert len(world.description.problems) == 2
    assert [link.name for link in world.links] == ["rod"]


def test_file_in_which_nothing_is_changed_goes_to_gazebo_as_it_is(tmp_path: Path) -> None:
    path = write_world(tmp_path, arm())

    world = load_gazebo_world(path, GazeboClassicConfig(gazebo_classic=""))

    assert world.text == path.read_bytes()
    assert world.description.problems == ()


def test_a_continuous_joint_is_a_revolute_one_without_limits_of_its_position(tmp_path: Path) -> None:
    limit = "<limit><lower>-1</lower><upper>1</upper><effort>5</effort></limit>"
    content = f"<model name='m'><joint name='j' type='continuous'><axis>{limit}</axis></joint></model>"

    world = load_gazebo_world(write_world(tmp_path, content), GazeboClassicConfig(gazebo_classic=""))

    [joint] = world.joints
    assert (joint.scoped, joint.revolute, joint.effort_limit) == ("m::j", True, 5.0)
    root = ET.fromstring(world.text)  # noqa: S314  written above
    assert [element.get("type") for element in root.iter("joint")] == ["revolute"]
    assert [element.tag for element in root.find(".//limit") or ()] == ["effort"]


def test_models_in_models_have_their_joints_and_links(tmp_path: Path) -> None:
    inner = f"<model name='hand'>{arm('finger', 'knuckle')}<link name='palm'/></model>"
    content = f"<model name='robot'><link name='base'/>{inner}</model>" + arm("other", "knuckle")

    world = load_gazebo_world(write_world(tmp_path, content), GazeboClassicConfig(gazebo_classic=""))

    assert [(joint.scoped, joint.name) for joint in world.joints] == [
        ("robot::hand::finger::knuckle", "robot::hand::finger::knuckle"),
        ("other::knuckle", "other::knuckle"),
    ]
    assert {link.scoped for link in world.links} == {
        "robot::base",
        "robot::hand::palm",
        "robot::hand::finger::rod",
        "other::rod",
    }


def test_check_warns_of_a_missing_or_empty_model_by_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], fault: Callable[[str], None]
) -> None:
    fault("nothing")
    kinds = ("ball", "universal", "screw", "revolute2", "gearbox", "fixed", "revolute")
    joints = "".join(f"<joint name='{kind}_joint' type='{kind}'/>" for kind in kinds)
    mesh = "<collision name='hull'><geometry><mesh><uri>model://hull.dae</uri></mesh></geometry></collision>"
    write_world(
        tmp_path,
        f"<model name='m'>{joints}<link name='l'>{mesh}<sensor name='eye' type='camera'/></link></model>"
        f"<model name='wall'><static>true</static><joint name='door' type='revolute'/></model>"
        "<plugin name='p' filename='libwind.so'/><include><uri>model://sun</uri></include>",
    )
    config = tmp_path / "mesh.yaml"
    config.write_text(
        "mesh: m\nsimulation: {stop_time: 1, step_size: 0.01}\ninstances:\n  world: {gazebo_classic: world.sdf}\n",
        encoding="utf-8",
    )

    assert main(["check", str(config)]) == 0

    page = capsys.readouterr().out
    warned = [line.removeprefix("  world: world.sdf: ") for line in page.partition("Warnings\n")[2].splitlines()]
    assert [line for line in warned if line.startswith(("the", "left"))] == [
        "left out, as a light moves nothing: the included 'model://sun'",
        *(
            f"the joint 'm::{kind}_joint' is simulated, and has no variables, as it is a {kind} joint"
            for kind in ("ball", "universal", "screw", "revolute2", "gearbox")
        ),
        "the collision 'm::hull' is not simulated unless Gazebo finds model://hull.dae",
        "the joint 'wall::door' has no variables: its model is static",
        "the sensor 'eye' has no variables",
        "the plugin 'libwind.so' does nothing unless Gazebo finds it",
    ]


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        ("no-such-program --flag", "there is no 'no-such-program'"),
        (
            "/bin/sh -c 'echo the library is missing >&2; exit 3'",
            "ended with 3; the last it wrote is: the library is missing",
        ),
        ("/bin/true", "its process has ended with 0"),
    ],
)
def test_check_finds_that_gazebo_is_missing_after_it_has_shown_the_plan(
    command: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FMU_MESH_GAZEBO", command)
    write_world(tmp_path, arm())
    text = "mesh: m\nsimulation: {stop_time: 1, step_size: 0.01}\ninstances:\n  world: {gazebo_classic: world.sdf%s}\n"
    here, elsewhere = tmp_path / "here.yaml", tmp_path / "elsewhere.yaml"
    here.write_text(text % "", encoding="utf-8")
    elsewhere.write_text(text % ", host: workstation", encoding="utf-8")

    code = main(["check", str(here)])
    said = capsys.readouterr()
    other = main(["check", str(elsewhere)])

    assert (code, other) == (2, 0)
    assert "world.elbow.position" in said.out
    assert "can run" not in said.out
    assert "instances.world.gazebo_classic: Gazebo classic does not run on this host" in said.err
    assert reason in said.err
    assert "FMU_MESH_GAZEBO" in said.err


def test_a_missing_world_is_a_finding_in_its_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "mesh.yaml"
    config.write_text(
        "mesh: m\nsimulation: {stop_time: 1, step_size: 0.01}\ninstances:\n  world: {gazebo_classic: none.sdf}\n",
        encoding="utf-8",
    )

    code = main(["check", str(config)])

    message = capsys.readouterr().err
    assert code == 2
    assert "instances.world.gazebo_classic" in message
    assert "an SDF world for Gazebo classic 11" in message


# ---- steps ----


@pytest.mark.usefixtures("fault")
def test_a_step_applies_effort_and_command_and_tells_what_it_applied(tmp_path: Path) -> None:
    inputs = ["elbow.effort", "elbow.effort_command"]
    outputs = ["elbow.position", "elbow.velocity", "elbow.acceleration", "elbow.effort_applied"]
    driven = Driven(write_world(tmp_path, arm()), inputs, outputs)

    first, second = driven.take(2.0, 1.0), driven.take(0.0, 0.0)
    driven.instance.close()

    # Ten steps of 1 ms of a mass of 1 kg; the sums are rounded.
    assert first == pytest.approx([3.0 * 1e-6 * 55, 0.03, 3.0, 3.0], rel=1e-14)
    assert second[1:] == [first[1], 0.0, 0.0]  # nothing of the first step's effort is left


@pytest.mark.usefixtures("fault")
def test_behind_an_actuator_the_command_is_not_applied(tmp_path: Path) -> None:
    config = GazeboClassicConfig(
        gazebo_classic="", actuators=[ActuatorConfig(name="motor", instance="motor", joint="elbow")]
    )
    inputs = ["elbow.effort", "elbow.effort_command"]
    driven = Driven(write_world(tmp_path, arm()), inputs, ["elbow.effort_applied"], config)

    applied = driven.take(2.0, 100.0)
    driven.instance.close()

    assert applied == [2.0]


@pytest.mark.usefixtures("fault")
@pytest.mark.parametrize(("disabled", "applied"), [("", -1.5), ("disabled", -7.0)])
def test_the_effort_is_limited_as_the_file_says_unless_limits_are_disabled(
    disabled: str, applied: float, tmp_path: Path
) -> None:
    actuator = ActuatorConfig(
        name="motor", instance="motor", joint="elbow", disable_velocity_effort_limits=disabled != ""
    )
    config = GazeboClassicConfig(gazebo_classic="", actuators=[actuator])
    driven = Driven(write_world(tmp_path, arm(effort=1.5)), ["elbow.effort"], ["elbow.effort_applied"], config)

    values = driven.take(-7.0)
    driven.instance.close()

    assert values == [applied]


@pytest.mark.usefixtures("fault")
def test_velocity_against_the_wind_is_in_the_axes_of_the_link(tmp_path: Path) -> None:
    outputs = ["rod.position_z", "rod.orientation_w", "rod.angular_velocity_z"]
    vectors = ("relative_velocity", "wind", "body_linear_velocity", "body_angular_velocity")
    relative = [f"rod.{what}_{axis}" for what in vectors for axis in "xyz"]
    driven = Driven(write_world(tmp_path, arm()), [], [*outputs, *relative], start_values={"wind_x": 2.0})

    values = driven.take()
    asked = driven.instance.get_values(relative)
    driven.instance.close()

    # The link's x axis is the world's y axis, and its y axis the world's -x axis; it moves with (0.5, 0.25, 0).
    assert values[:3] == [3.0, 0.5**0.5, 1.0]
    assert values[3:] == pytest.approx([0.25, 1.5, 0.0, 0.0, -2.0, 0.0, 0.25, -0.5, 0.0, 0.0, 0.0, 1.0], abs=1e-15)
    assert asked == values[3:]


@pytest.mark.usefixtures("fault")
def test_a_position_cannot_be_set_and_the_message_says_why(tmp_path: Path) -> None:
    instance = GazeboClassicInstance(write_world(tmp_path, arm()), "world", GazeboClassicConfig(gazebo_classic=""))

    with pytest.raises(InitializationFailed, match="cannot be set: Gazebo starts a world with the values of its file"):
        instance.enter_initialization(0.0, 1.0, {"elbow.position": 1.0})
    instance.close()


# ---- what goes wrong ----


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("start", "its process has ended with 1; the last it wrote is: no such engine"),
        ("refuse", "the world has no joint arm::elbow"),
    ],
)
def test_a_world_that_does_not_load_is_error_with_gazebo_s_words(
    kind: str, expected: str, fault: Callable[[str], None], tmp_path: Path
) -> None:
    fault(kind)

    with pytest.raises(LoadFailed) as caught:
        GazeboClassicInstance(write_world(tmp_path, arm()), "world", GazeboClassicConfig(gazebo_classic=""))

    assert expected in caught.value.message
    assert "FMU_MESH_GAZEBO" in (caught.value.hint or "")


def test_without_the_program_the_error_says_what_to_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("FMU_MESH_GAZEBO", "no-such-program --flag")

    with pytest.raises(LoadFailed, match="there is no 'no-such-program'") as caught:
        GazeboClassicInstance(write_world(tmp_path, arm()), "world", GazeboClassicConfig(gazebo_classic=""))

    assert "bridges/gazebo_classic" in (caught.value.hint or "")


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("die", "its process has ended with 1; the last it wrote is: the engine is broken"),
        ("hang", "it has not answered for 0.3 s"),
        ("nan", "not finite any more"),
    ],
)
def test_a_step_that_fails_is_an_error_and_leaves_no_process(
    kind: str, expected: str, fault: Callable[[str], None], tmp_path: Path
) -> None:
    fault(kind)
    timeouts = TimeoutsConfig(step=0.3)
    driven = Driven(write_world(tmp_path, arm()), ["elbow.effort"], ["elbow.position"], timeouts=timeouts)
    driven.take(1.0)

    with pytest.raises(StepFailed) as caught:
        driven.take(1.0)
    driven.instance.close()
    driven.instance.close()

    assert expected in caught.value.message
    assert driven.instance._process._process.returncode is not None
    with pytest.raises(FmuError, match="it was ended"):
        driven.take(1.0)


@pytest.mark.usefixtures("fault")
def test_an_input_that_is_no_number_is_named(tmp_path: Path) -> None:
    driven = Driven(write_world(tmp_path, arm()), ["elbow.effort_command"], ["elbow.position"])

    with pytest.raises(StepFailed) as caught:
        driven.take(float("nan"))
    driven.instance.close()

    assert caught.value.variable == "elbow.effort_command"


@pytest.mark.usefixtures("fault")
def test_couplings_drive_a_joint_as_they_do_with_the_other_engine(tmp_path: Path) -> None:
    write_world(tmp_path, arm())
    config = tmp_path / "mesh.yaml"
    config.write_text(
        f"""
mesh: m
simulation: {{stop_time: 0.02, step_size: 0.01}}
instances:
  world:
    gazebo_classic: world.sdf
    controllers: [{{name: c, joint: elbow, instance: pid}}]
    actuators: [{{name: a, joint: elbow, instance: motor}}]
  pid: {{controller: position_pid, start_values: {{p: 10, d: 3, target: 1}}}}
  motor: {{fmu: {FMUS}/SimpleElectricalActuator.fmu}}
record: {{file: result.csv, variables: [motor.jointTorque, world.elbow.effort_applied]}}
""",
        encoding="utf-8",
    )

    PlainRun(prepare(config, PlanOptions())).run()

    rows = [line.split(",") for line in (tmp_path / "result.csv").read_text(encoding="utf-8").splitlines()[1:]]
    assert [float(applied) for _, _, applied in rows[1:]] == [float(torque) for _, torque, _ in rows[1:]]
    assert float(rows[1][1]) > 0.0
