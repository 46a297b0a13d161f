"""Worlds of gazebo-fmi as configurations, where no Gazebo is: tags, names, files, and what is told about them.

With the real Gazebo, `test_gazebo_classic.py` runs the worlds of `examples/gazebo_fmi`.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

import fmu_mesh
from fmu_mesh.cli.main import main
from fmu_mesh.config.loading import PlainConfig
from fmu_mesh.errors import ConfigurationError, LoadFailed
from fmu_mesh.instances.gazebo.gazebo_section import GazeboClassicConfig
from fmu_mesh.instances.gazebo.gazebo_world import load_gazebo_world
from fmu_mesh.instances.gazebo.world_includes import WorldFile
from fmu_mesh.ssp.configuration_files import read_configuration
from tests.helpers import FMUS

EXAMPLES = FMUS.parent / "examples" / "gazebo_fmi"
DOUBLE = Path(__file__).with_name("gazebo_double.py")

ACTUATOR, FLUID = "libFMIActuatorPlugin.so", "libFMISingleBodyFluidDynamicsPlugin.so"
FIRST_LINK = "the code of gazebo-fmi always takes the first link of the model"
POSITION = "world.elbow.position"
JOINT = "<joint name='{}' type='{}'><axis><limit><effort>1</effort></limit></axis></joint>"


def plugin(*entries: str, file: str = ACTUATOR) -> str:
    tag = "actuator" if file == ACTUATOR else "single_body_fluid_dynamics"
    return f"<plugin name='p' filename='{file}'>\n{''.join(f'<{tag}>{entry}</{tag}>' for entry in entries)}</plugin>"


def actuator(joint: str = "elbow", more: str = "", name: str = "motor", fmu: str = "Damper.fmu") -> str:
    return f"<name>{name}</name><joint>{joint}</joint><fmu>{fmu}</fmu>{more}"


def model(
    *inner: str, name: str = "arm", joints: tuple[str, ...] = ("elbow",), links: tuple[str, ...] = ("rod",)
) -> str:
    parts = [f"<link name='{link}'/>" for link in links] + [JOINT.format(joint, "revolute") for joint in joints]
    return f"<model name='{name}'>{''.join(parts)}{''.join(inner)}</model>"


@pytest.fixture(autouse=True)
def resources(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """FMUs and models are found as Gazebo finds them."""
    monkeypatch.setenv("GAZEBO_RESOURCE_PATH", f"/nowhere:{FMUS}")
    monkeypatch.setenv("GAZEBO_MODEL_PATH", str(tmp_path / "models"))
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("FMU_MESH_GAZEBO", shlex.join([sys.executable, str(DOUBLE), "nothing"]))


@pytest.fixture
def world(tmp_path: Path) -> Callable[..., Path]:
    """Write a world; its first line is the world's, so the content begins in line 2."""

    def write(*content: str, name: str = "test.world", version: str = "1.6") -> Path:
        path = tmp_path / name
        text = "\n".join(content)
        path.write_text(f"<sdf version='{version}'><world name='w'>\n{text}\n</world></sdf>", encoding="utf-8")
        return path

    return write


@pytest.fixture
def included(tmp_path: Path) -> Callable[..., Path]:
    """Write a model that worlds can include."""

    def write(name: str, content: str, version: str = "1.6", file: str = "model.sdf") -> Path:
        folder = tmp_path / "models" / name
        folder.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text(f"<sdf version='{version}'>\n{content}</sdf>", encoding="utf-8")
        return folder / file

    return write


def section(plain: PlainConfig, instance: str = "world") -> dict[str, Any]:
    return dict(_data(plain)["instances"][instance])


def _data(plain: PlainConfig) -> dict[str, Any]:
    assert isinstance(plain.data, dict)
    return plain.data


def couplings(path: Path, key: str = "actuators") -> list[dict[str, Any]]:
    return [*section(read_configuration(path)).get(key, [])]


def told(path: Path) -> list[str]:
    """Findings and warnings, without the file."""
    plain = read_configuration(path)
    return [str(one).removeprefix(f"{path}:") for one in (*plain.findings, *plain.warnings)]


# ---- what a world says ----


@pytest.mark.parametrize(
    ("name", "coupled"),
    [
        ("damped_pendulum", ["joint_damper: pendulum_damped_via_fmi::joint"]),
        ("simple_electrical_actuator", ["joint_actuator: simple_electrical_actuator_model::joint"]),
        ("linear_friction", ["floating_cube_fluid_dynamics: link"]),
        ("position_regulation", ["upper_joint_actuator: upper_joint"]),
    ],
)
def test_check_reads_a_published_shape_where_no_gazebo_is(
    name: str, coupled: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FMU_MESH_GAZEBO", "no-such-program")
    path = EXAMPLES / f"{name}.world"

    code = main(["check", str(path)])

    page = capsys.readouterr().out
    assert code == 0, page
    assert page.endswith(f"OK: {path} can run.\n")
    assert "Gazebo classic does not run on this host: there is no 'no-such-program'" in page
    found = [*couplings(path), *couplings(path, "fluid_dynamics")]
    assert [f"{one['name']}: {one.get('joint') or one['link']}" for one in found] == coupled


def test_step_and_pace_are_those_of_the_world(world: Callable[..., Path]) -> None:
    physics = "<physics type='ode'><max_step_size>0.002</max_step_size>{}</physics>"
    paced = read_configuration(world(physics.format(""), model()))
    fast = read_configuration(world(physics.format("<real_time_update_rate>0</real_time_update_rate>")))
    usual = read_configuration(world(model()))

    assert [_data(one)["simulation"] for one in (paced, fast, usual)] == [
        {"stop_time": None, "step_size": 0.002, "real_time_factor": 2.0},
        {"stop_time": None, "step_size": 0.002, "real_time_factor": 0.0},
        {"stop_time": None, "step_size": 0.001, "real_time_factor": 1.0},
    ]


def test_all_tags_of_an_actuator_are_those_of_the_section(world: Callable[..., Path]) -> None:
    names = "<variable_names><actuatorInput name='u'/><!-- none --><jointTorque name='tau'/></variable_names>"
    more = f"<enabled>1</enabled><disable_velocity_effort_limits>True</disable_velocity_effort_limits>{names}"
    path = world(model(plugin(actuator(more=more)).replace("\n", "<verbose>true</verbose>")))

    assert couplings(path) == [
        {
            "name": "motor",
            "joint": "elbow",
            "disable_velocity_effort_limits": True,
            "variable_names": {"actuatorInput": "u", "jointTorque": "tau"},
            "instance": "motor",
        }
    ]
    assert section(read_configuration(path), "motor") == {"fmu": str(FMUS / "Damper.fmu")}
    assert told(path) == []


def test_the_five_old_tags_count_more_and_show_the_new_ones(world: Callable[..., Path]) -> None:
    variables = ("actuatorInput", "jointPosition", "jointVelocity", "jointAcceleration", "jointTorque")
    old = "".join(f"<{name}Name>{name[-3:]}</{name}Name>" for name in variables)
    path = world(model(plugin(actuator(more=f"<variable_names><jointTorque name='t'/></variable_names>{old}"))))

    [coupling] = couplings(path)

    assert coupling["variable_names"] == {name: name[-3:] for name in variables}
    assert told(path) == [
        f"3: <{name}Name> of the model 'arm': an old tag; expected "
        f'<variable_names><{name} name="{name[-3:]}"/></variable_names>'
        for name in variables
    ]


def test_a_disabled_actuator_is_as_if_it_were_not_there(world: Callable[..., Path]) -> None:
    path = world(model(plugin(actuator(more="<enabled>false</enabled>"), actuator(name="other"))))

    assert [one["name"] for one in couplings(path)] == ["other"]
    assert [*fmu_mesh.load(path).instances] == ["world", "elbow-pid", "other"]


def test_every_joint_has_a_controller_without_gains(world: Callable[..., Path]) -> None:
    path = world(model(name="left", joints=("elbow", "wrist")), model(name="right"))

    assert couplings(path, "controllers") == [
        {"name": "left::elbow", "joint": "left::elbow", "instance": "left-elbow-pid"},
        {"name": "wrist", "joint": "wrist", "instance": "wrist-pid"},
        {"name": "right::elbow", "joint": "right::elbow", "instance": "right-elbow-pid"},
    ]
    assert section(read_configuration(path), "wrist-pid") == {"controller": "position_pid"}


@pytest.mark.parametrize(
    ("wanted", "joint", "warning"),
    [
        ("elbow", "elbow", None),
        ("hand::knuckle", "knuckle", None),
        ("arm::hand::knuckle", "knuckle", None),
        ("knuckle", "knuckle", None),
        ("uckle", "knuckle", "'uckle' is the end of arm::hand::knuckle: the first one is used; expected a full name"),
        ("twin", "arm::hand::twin", "'twin' is the end of arm::hand::twin, arm::foot::twin: the first one is used"),
    ],
)
def test_a_joint_is_found_by_its_name_then_by_its_ending(
    wanted: str, joint: str, warning: str | None, world: Callable[..., Path]
) -> None:
    hand = model(name="hand", joints=("knuckle", "twin"), links=())
    path = world(model(hand, model(name="foot", joints=("twin",), links=()), plugin(actuator(wanted))))

    assert [one["joint"] for one in couplings(path)] == [joint]
    assert [warning in one for one in told(path)] == [True] if warning is not None else told(path) == []


def test_a_plugin_sees_only_the_joints_of_its_model(world: Callable[..., Path]) -> None:
    inner = model(name="hand", links=())
    path = world(model(name="left"), model(inner, plugin(actuator("left::elbow")), name="right", joints=("wrist",)))

    [finding] = told(path)
    expected = "no moving revolute or prismatic joint 'left::elbow'; expected one of wrist, hand::elbow"
    assert finding == f"4: <joint> of the model 'right': {expected}. Did you mean 'hand::elbow'?"


@pytest.mark.parametrize(
    ("wanted", "link", "warnings"),
    [
        ("rod", "rod", []),
        ("arm", "rod", [f"'arm::rod' is used; {FIRST_LINK}; expected one of rod, tip"]),
        ("tip", "tip", [f"'arm::tip' is used; {FIRST_LINK}"]),
    ],
)
def test_a_link_is_the_named_one_or_the_first(
    wanted: str, link: str, warnings: list[str], world: Callable[..., Path]
) -> None:
    entry = f"<name>drag</name><link>{wanted}</link><fmu>LinearFluidDrag.fmu</fmu>"
    path = world(model(plugin(entry, file=FLUID), links=("rod", "tip")))

    [coupling] = couplings(path, "fluid_dynamics")

    assert coupling == {"name": "drag", "link": link, "instance": "drag"}
    assert told(path) == [f"3: <link> of the model 'arm': {one}" for one in warnings]


def test_the_plugin_for_fluids_reads_one_entry_and_says_so(world: Callable[..., Path]) -> None:
    entry = "<name>drag</name><link>rod</link><fmu>LinearFluidDrag.fmu</fmu>"
    path = world(model(plugin(entry, entry, file=FLUID)))

    assert len(couplings(path, "fluid_dynamics")) == 1
    [warning] = told(path)
    tag = "<single_body_fluid_dynamics>"
    assert warning == f"3: {tag} of the model 'arm': a second one has no effect; expected one {tag}"


# ---- names and files ----


def test_names_of_actuators_that_two_models_share_have_the_model(world: Callable[..., Path]) -> None:
    both = [model(plugin(actuator(), actuator("elbow", name="world")), name=name) for name in ("left", "right")]
    path = world(*both, model(plugin(actuator(name="a b")), name="third"))

    assert [one["instance"] for one in couplings(path)] == [
        "left-motor",
        "left-world",
        "right-motor",
        "right-world",
        "a-32-b",
    ]


def test_an_actuator_may_have_the_name_of_the_world(world: Callable[..., Path]) -> None:
    path = world(model(plugin(actuator(name="world"), actuator(name=""))))

    assert [one["instance"] for one in couplings(path)] == ["arm-world", "elbow"]


def test_an_fmu_beside_the_world_comes_before_others(world: Callable[..., Path], tmp_path: Path) -> None:
    path = world(model(plugin(actuator())))
    (tmp_path / "Damper.fmu").write_bytes((FMUS / "Damper.fmu").read_bytes())

    assert section(read_configuration(path), "motor") == {"fmu": "Damper.fmu"}


def test_an_fmu_may_lie_in_a_model(world: Callable[..., Path], included: Callable[..., Path]) -> None:
    folder = included("arm", "<model name='arm'/>").parent
    (folder / "own.fmu").write_bytes((FMUS / "Damper.fmu").read_bytes())
    path = world(model(plugin(actuator(fmu="model://arm/own.fmu"))))

    assert section(read_configuration(path), "motor") == {"fmu": str(folder / "own.fmu")}


def test_a_world_becomes_a_file_that_says_the_same(world: Callable[..., Path], tmp_path: Path) -> None:
    path, target = (
        world(model(plugin(actuator(more="<jointTorqueName>jointTorque</jointTorqueName>")))),
        tmp_path / "a.yaml",
    )

    assert main(["convert", str(path), str(target)]) == 0

    converted, read = _data(read_configuration(target)), _data(read_configuration(path))
    assert {**converted, "instances": 0} == {**read, "instances": 0}
    assert section(read_configuration(target)) == section(read_configuration(path))


# ---- what is wrong ----


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        ("<joint>elbow</joint><fmv>a</fmv>", "<actuator> of the model 'arm': no <fmu>, but the unknown tag <fmv>"),
        ("<joint> </joint><fmu>Damper.fmu</fmu>", "<actuator> of the model 'arm': no <joint>; expected <joint>"),
        (
            actuator("elbov"),
            "no moving revolute or prismatic joint 'elbov'; expected one of elbow. Did you mean 'elbow'?",
        ),
        (
            actuator(fmu="Dampr.fmu"),
            "<fmu> of the model 'arm': no such file 'Dampr.fmu'; expected a file beside the world",
        ),
        (actuator(fmu="Dampr.fmu"), f"GAZEBO_RESOURCE_PATH (/nowhere, {FMUS}). Did you mean 'Damper.fmu'?"),
        (actuator(fmu="a" * 5000), "<fmu> of the model 'arm': no such file 'aaaaaaaa"),
        (actuator(more="<enabled>maybe</enabled>"), "<enabled> of the model 'arm': 'maybe'; expected true or false"),
        (actuator(more="<variable_names><jointTorque/></variable_names>"), "<jointTorque> without a name"),
    ],
)
def test_an_entry_that_cannot_be_used_is_named_with_its_line(
    entry: str, expected: str, world: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    path = world(model(plugin(entry)))

    assert main(["check", str(path)]) == 2

    message = capsys.readouterr().err
    assert f"{path}:3: " in message
    assert expected in message


def test_a_wrong_name_of_a_variable_has_the_line_of_its_actuator(
    world: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    names = "<variable_names><jointTork name='t'/><jointTorque name='tau'/></variable_names>"
    path = world(model(plugin(actuator(more=names))))

    assert main(["check", str(path)]) == 2

    message = capsys.readouterr().err
    assert f"{path}:3: instances.world.actuators[0].variable_names.jointTork: the unknown name" in message
    assert "Did you mean 'jointTorque'?" in message
    assert "which has no variable 'tau'" in message


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (
            actuator(more="<disable_velocity_effort_limit>1</disable_velocity_effort_limit>"),
            "<disable_velocity_effort_limits>",
        ),
        (actuator(more="<gear>100</gear>"), "one of name, joint, fmu, variable_names, enabled"),
        (actuator(more="<joint>other</joint>"), "one <joint>"),
    ],
)
def test_a_tag_without_effect_is_told_with_its_line(content: str, expected: str, world: Callable[..., Path]) -> None:
    [warning] = told(world(model(plugin(content))))

    assert warning.startswith("3: <")
    assert "has no effect; expected " in warning
    assert expected in warning


def test_a_plugin_without_an_entry_is_refused(world: Callable[..., Path]) -> None:
    assert told(world(model(plugin().replace("\n", "<actuatr/>")))) == [
        "2: <plugin> of the model 'arm': a plugin without an entry; expected <actuator>",
        "2: <actuatr> of the model 'arm': the unknown tag has no effect; expected <actuator>",
    ]


@pytest.mark.parametrize("content", ["<world", "<sdf version='1.6'><model name='m'/></sdf>"])
def test_a_file_that_is_no_world_is_one_error(content: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "no.world"
    path.write_text(content, encoding="utf-8")

    assert main(["check", str(path)]) == 2
    assert str(path) in capsys.readouterr().err


def test_a_variant_of_a_package_cannot_be_chosen(world: Callable[..., Path]) -> None:
    with pytest.raises(ConfigurationError, match="is no package"):
        read_configuration(world(model()), ssd="VarB")


def test_fluid_dynamics_with_bullet_are_refused(world: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> None:
    entry = "<link>rod</link><fmu>LinearFluidDrag.fmu</fmu>"
    path = world("<physics type='bullet'/>", model(plugin(entry, file=FLUID)))

    assert main(["check", str(path)]) == 2
    assert "Bullet, with which Gazebo applies no forces to links" in capsys.readouterr().err


# ---- what Gazebo gets ----


def test_gazebo_never_gets_the_plugins_and_others_stay(world: Callable[..., Path]) -> None:
    path = world(model(plugin(actuator()), "<plugin name='other' filename='libother.so'/>"))

    read = load_gazebo_world(path)
    coupled = load_gazebo_world(path, GazeboClassicConfig(gazebo_classic="", actuators=actuators_of(path)))

    assert b"FMIActuatorPlugin" not in read.text
    assert b"libother.so" in read.text
    assert [note for note in read.description.problems if "gazebo-fmi" in note] == [
        f"the plugins of gazebo-fmi are not loaded: `fmu-mesh launch {path.name}` has their FMUs as instances"
    ]
    assert not [note for note in coupled.description.problems if "gazebo-fmi" in note]


def actuators_of(path: Path) -> Any:  # noqa: ANN401  the sections of any kind have them
    loaded = fmu_mesh.load(path).check().require().loaded
    return loaded.config.engines["world"].actuators


# ---- includes ----


def test_an_included_model_has_its_plugins_and_what_the_include_says(
    world: Callable[..., Path], included: Callable[..., Path]
) -> None:
    arm = included("arm", model(plugin(actuator(more="<gear>1</gear>")), "<pose>1 0 0 0 0 0</pose>"), version="1.5")
    left = "<include><uri>model://arm</uri><name>left</name><pose>0 1 0 0 0 0</pose></include>"
    right = f"<include><uri>model://arm</uri><name>right</name>{plugin(actuator(name='second'))}</include>"
    path = world(left, right, f"<include><uri>file://{arm}</uri><name>still</name><static>1</static></include>")

    read = load_gazebo_world(path)

    assert [joint.scoped for joint in read.joints] == ["left::elbow", "right::elbow"]
    assert read.element.findtext("model[@name='left']/pose") == "0 1 0 0 0 0"
    assert read.element.findtext("model[@name='right']/pose") == "1 0 0 0 0 0"
    assert [(one["name"], one["joint"], one["instance"]) for one in couplings(path)] == [
        ("motor", "left::elbow", "left-motor"),
        ("motor", "right::elbow", "right-motor"),
        ("second", "right::elbow", "second"),
    ]
    assert [line for line in told(path) if "gear" in line] == [
        f"{arm}:3: <gear> of the model '{name}': the unknown tag has no effect; expected one of name, joint, fmu, "
        "variable_names, enabled, disable_velocity_effort_limits, actuatorInputName, jointPositionName and 3 more"
        for name in ("left", "right", "still")
    ]


def test_a_model_includes_others_and_its_plugin_finds_their_joints(
    world: Callable[..., Path], included: Callable[..., Path], tmp_path: Path
) -> None:
    included("hand", model(name="hand", joints=("knuckle",)))
    (tmp_path / "local").mkdir()
    (tmp_path / "local" / "model.sdf").write_text(
        f"<sdf version='1.6'>{model('<include><uri>model://hand</uri></include>', plugin(actuator('knuckle')))}</sdf>",
        encoding="utf-8",
    )
    path = world("<include><uri>local</uri></include>")

    assert [one["joint"] for one in couplings(path)] == ["knuckle"]
    assert [joint.scoped for joint in load_gazebo_world(path).joints] == ["arm::elbow", "arm::hand::knuckle"]


def test_the_newest_version_that_gazebo_reads_is_included(
    world: Callable[..., Path], included: Callable[..., Path]
) -> None:
    for version in ("1.4", "1.6", "1.9"):
        included("arm", model(joints=(f"of_{version[2:]}",)), version, f"arm-{version}.sdf")
    named = "".join(f"<sdf version='{version}'>arm-{version}.sdf</sdf>" for version in ("1.9", "1.6", "1.4"))
    manifest = included("arm", "", file="model.config")
    manifest.write_text(f"<model>{named}</model>", encoding="utf-8")

    read = load_gazebo_world(world("<include><uri>model://arm</uri></include>"))

    assert [joint.name for joint in read.joints] == ["of_6"]


def test_the_content_of_a_world_has_that_of_its_models(
    world: Callable[..., Path], included: Callable[..., Path]
) -> None:
    path = world("<include><uri>model://arm</uri></include>")
    included("arm", model())
    first = WorldFile(path).sha256
    again = WorldFile(path).sha256
    included("arm", model(joints=("wrist",)))

    assert first == again != WorldFile(path).sha256


@pytest.mark.parametrize(
    ("models", "expected"),
    [
        ({}, "includes a model (model://a), not found in "),
        ({"a": f"<model><include><uri>{'b' * 5000}</uri></include></model>"}, "includes a model (bbbbbbbb"),
        ({"a": "<light name='l'/>"}, "is no SDF file with a model"),
        ({"a": "<model"}, "cannot be read"),
        ({"a": model("<include><uri>model://a</uri></include>")}, "inside more than 100 other models"),
        (
            {
                name: model(*(f"<include><uri>model://{inner}</uri><name>{i}</name></include>" for i in range(9)))
                for name, inner in zip("abcdefgh", "bcdefgh_", strict=True)
            }
            | {"_": f"<model name='m'><!--{' ' * 100_000}--></model>"},
            "have more than 16777216 bytes",
        ),
        ({"a": "<model name='other'/>"}, "2 models 'other'"),
    ],
)
def test_models_that_cannot_be_included_are_an_error(
    models: Mapping[str, str], expected: str, world: Callable[..., Path], included: Callable[..., Path]
) -> None:
    for name, content in models.items():
        included(name, content)
    path = world("<model name='other'/><include><uri>model://a</uri></include>")

    with pytest.raises(LoadFailed) as caught:
        load_gazebo_world(path)

    assert expected in caught.value.message


def test_versions_in_which_a_joint_means_something_else_are_not_mixed(
    world: Callable[..., Path], included: Callable[..., Path]
) -> None:
    included("arm", model(), version="1.4")
    included("box", "<model name='box'><link name='box'/></model>", version="1.4")

    assert load_gazebo_world(world("<include><uri>model://box</uri></include>")).links
    with pytest.raises(LoadFailed, match=r"is SDF 1\.4, and .* is SDF 1\.6: joints and frames may mean something else"):
        load_gazebo_world(world("<include><uri>model://arm</uri></include>"))


# ---- runs ----


def test_a_target_that_is_set_moves_a_joint_through_its_actuator(world: Callable[..., Path]) -> None:
    mesh = fmu_mesh.load(world(model(plugin(actuator(fmu="SimpleElectricalActuator.fmu")))))

    with mesh.start(paused=True, record="memory") as run:
        run.set("elbow-pid.p", 10.0)
        run.set("elbow-pid.target", 1.0)
        run.step(3)
        volts, torque, position = (run.get(name) for name in ("elbow-pid.effort", "motor.jointTorque", POSITION))
        run.stop()
        result = run.wait()

    assert volts == pytest.approx(10.0, abs=1e-3)
    assert torque > 0.0
    assert position > 0.0
    assert list(result.times) == [0.0, 0.001, 0.002, 0.003]
