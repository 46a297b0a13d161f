"""The `ros` section: which topics follow from it, and all that can be wrong with it, each with the way out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import fmu_mesh
from fmu_mesh.config.loading import read_file
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.instances.configuration import examine_data
from fmu_mesh.ros.gateway.mapping import resolve
from fmu_mesh.ros_wire.topics import RosPlan
from fmu_mesh.variables.model_description import ModelDescription, Variable
from tests.fmus.helpers import find_fmu
from tests.helpers import FMUS, write_config
from tests.planning import prepare

WORLDS = Path(__file__).resolve().parents[2] / "configs" / "worlds"
TWIST = "geometry_msgs/msg/TwistStamped"


def planned(folder: Path, **ros: Any) -> RosPlan:  # noqa: ANN401 what a file may hold
    """The plan of a mesh of a pendulum, a delay that it feeds, and a gain that nothing feeds."""
    return plan_of(configured(folder, **ros))


def plan_of(path: Path) -> RosPlan:
    """The plan of a file, with what its instances say of themselves."""
    plan = prepare(path)
    loaded = examine_data(read_file(path))[0]
    descriptions = {name: own.description for name, own in plan.system.instances.items()}
    found = resolve(loaded, descriptions, loaded.findings(), loaded.findings())
    assert found is not None
    return found


def configured(folder: Path, **ros: Any) -> Path:  # noqa: ANN401 what a file may hold
    return write_config(
        folder,
        instances={
            "pendulum": {"fmu": "DampedPendulum"},
            "delay": {"fmu": "TransportDelay"},
            "gain": {"fmu": "Gain", "step_size": 0.004},
        },
        ros=ros,
    )


def test_without_topics_all_outputs_and_unconnected_inputs_have_one(tmp_path: Path) -> None:
    plan = planned(tmp_path, namespace="/robot")

    assert [(topic.name, topic.direction, topic.message) for topic in plan.topics] == [
        ("/robot/pendulum/a", "out", "std_msgs/msg/Float64"),
        ("/robot/pendulum/der_a_", "out", "std_msgs/msg/Float64"),
        ("/robot/pendulum/der_a_2_", "out", "std_msgs/msg/Float64"),
        ("/robot/delay/y", "out", "std_msgs/msg/Float64"),
        ("/robot/gain/u", "in", "std_msgs/msg/Float64"),
        ("/robot/gain/y", "out", "std_msgs/msg/Float64"),
    ]
    assert {"pendulum.l", "pendulum.d", "delay.d", "gain.k"} <= {parameter.name for parameter in plan.parameters}
    assert (plan.node, plan.clock_points) == ("pair", 10)


def coupled(folder: Path, ros: str, *, controlled: bool) -> Path:
    """An arm of Gazebo with an actuator, fluid dynamics and, where it is ``controlled``, a controller."""
    pid = "[{name: c, joint: weak, instance: pid}]" if controlled else "[]"
    path = folder / "arm.yaml"
    path.write_text(
        f"""
mesh: arm
simulation: {{stop_time: 1, step_size: 0.01}}
instances:
  world:
    gazebo_classic: {WORLDS}/electrical_actuator.sdf
    controllers: {pid}
    actuators: [{{name: a, joint: weak, instance: motor}}]
    fluid_dynamics: [{{name: f, link: weak_arm, instance: drag}}]
  pid: {{controller: position_pid}}
  motor: {{fmu: {FMUS}/SimpleElectricalActuator.fmu}}
  drag: {{fmu: {FMUS}/LinearFluidDrag.fmu}}
ros: {ros}
""",
        encoding="utf-8",
    )
    return path


@pytest.mark.parametrize("controlled", [True, False])
def test_inputs_that_controllers_actuators_and_fluid_dynamics_drive_are_not_subscribed(
    tmp_path: Path, *, controlled: bool
) -> None:
    plan = plan_of(coupled(tmp_path, "{}", controlled=controlled))

    subscribed = {topic.name for topic in plan.topics if topic.direction == "in"}
    world = {name for name in subscribed if name.startswith("/world/weak")}
    assert world == set()
    assert {"/world/tuned_effort", "/world/tuned_effort_command", "/world/bare_effort"} <= subscribed
    assert {name for name in subscribed if not name.startswith("/world/")} == (
        {"/pid/target"} if controlled else {"/pid/target", "/pid/position", "/pid/velocity", "/motor/actuatorInput"}
    )


@pytest.mark.parametrize(
    ("reference", "expected"),
    [
        ("world.weak.effort", "an input without a connection"),
        ("world.weak_arm.force_x", "an input without a connection"),
        ("world.weak.effort_command", "'motor.actuatorInput': the joint 'weak' has the actuator 'a'"),
    ],
)
def test_an_input_that_a_coupling_drives_is_refused_as_a_topic(tmp_path: Path, reference: str, expected: str) -> None:
    config = coupled(tmp_path, f"{{topics: [{reference}]}}", controlled=False)

    with pytest.raises(ConfigurationError) as caught:
        prepare(config)

    assert f"the connected input '{reference}'; expected {expected}" in str(caught.value)


def test_an_array_of_which_one_element_is_connected_is_not_subscribed(tmp_path: Path) -> None:
    fmu = str(find_fmu("AllTypes3", tmp_path))
    path = write_config(
        tmp_path,
        instances={"a": {"fmu": fmu}, "b": {"fmu": fmu, "start_values": {"columns": 5}}},
        connections=["a.float64_array_out[2,1] -> b.float64_array_in[1,5]"],
        ros={},
    )

    topics = {topic.name: topic for topic in plan_of(path).topics}

    assert "/a/float64_array_in" in topics
    assert "/b/float64_array_in" not in topics
    assert topics["/b/float32_array_in"].ports[0].variable.shape == (2, 5)


def test_topics_are_set_by_hand_for_a_variable_instance_or_several_variables(tmp_path: Path) -> None:
    fields = {"twist.linear.x": "pendulum.a", "twist.angular.z": "gain.y"}

    plan = planned(
        tmp_path,
        profile="rmw_zenoh",
        clock_rate=None,
        topics=[
            "delay.y",
            {"variable": "gain", "topic": "/g", "reliability": "best_effort"},
            {"topic": "state", "type": TWIST, "fields": fields, "frame_id": "base", "profile": "ros2dds"},
            {"topic": "/narrow", "variable": "pendulum.a", "type": "std_msgs/msg/Float32"},
        ],
    )

    assert [(topic.name, topic.profile, plan.types.has_header(topic.message)) for topic in plan.topics] == [
        ("/delay/y", "rmw_zenoh", False),
        ("/g/u", "rmw_zenoh", False),
        ("/g/y", "rmw_zenoh", False),
        ("/state", "ros2dds", True),
        ("/narrow", "rmw_zenoh", False),
    ]
    assert [(port.path, port.instance, port.step_points) for port in plan.topics[3].ports] == [
        ("twist.linear.x", "pendulum", 1),
        ("twist.angular.z", "gain", 4),
    ]
    assert plan.clock_points is None


@pytest.mark.parametrize(
    ("ros", "message"),
    [
        ({"node": "a/b"}, "ros.node: 'a/b': a slash; expected letters"),
        ({"namespace": "robot"}, "ros.namespace: 'robot'; expected a name that starts with a slash"),
        ({"clock_rate": 0}, "ros.clock_rate: 0; expected a rate > 0 in Hz"),
        ({"connect": []}, "ros.connect: no endpoint; expected where the bridge"),
        ({"messages": {"Wheel": "w.msg"}}, "ros.messages.Wheel: 'Wheel'; expected the full name of a message type"),
        ({"messages": {"lab_msgs/msg/Wheel": "w.msg"}}, "'w.msg', which cannot be read (No such file or directory)"),
        ({"topics": ["pendlum.a"]}, "the unknown instance 'pendlum'; expected one of the instances"),
        ({"topics": ["pendlum.a"]}, "Did you mean 'pendulum'?"),
        ({"topics": ["pendulum.der(b)"]}, "the unknown variable 'der(b)' of instance 'pendulum'"),
        ({"topics": ["delay.x"]}, "the connected input 'delay.x'; expected an input without a connection"),
        ({"topics": ["gain.k"]}, "'gain.k', a parameter; expected an output"),
        ({"topics": [{"topic": "/x"}]}, "neither `variable` nor `fields`; expected one of them"),
        ({"topics": [{"variable": "delay.y", "topic": "/1a"}]}, "'/1a': the part '1a' starts with a digit"),
        ({"topics": ["delay.y", "delay"]}, "the topic '/delay/y' for 'delay.y' and for 'delay.y'"),
        (
            {"topics": [{"variable": "delay.y", "topic": "/x"}, {"variable": "gain.u", "topic": "/x", "type": TWIST}]},
            "'geometry_msgs/msg/TwistStamped' has no field 'data'",
        ),
        (
            {"topics": [{"variable": "delay.y", "type": "std_msgs/msg/Flot64"}]},
            "the unknown message type 'std_msgs/msg/Flot64'; expected one of ROS. Did you mean 'std_msgs/msg/Float64'?",
        ),
        (
            {"topics": [{"variable": "delay.y", "type": "std_msgs/msg/Int32"}]},
            "'data' of 'std_msgs/msg/Int32' for 'delay.y': Float64 into int32 may lose something",
        ),
        (
            {"topics": [{"variable": "delay.y", "type": "std_msgs/msg/Float64MultiArray"}]},
            "one value into an array; write an index, such as data[0]",
        ),
        ({"topics": [{"fields": {"data": "delay.y"}}]}, "no `topic`; expected a topic"),
        ({"topics": [{"variable": "gain", "type": TWIST}]}, "one type for all topics of the instance 'gain'"),
        (
            {"topics": [{"topic": "/v", "type": TWIST, "fields": {"twist.linear.q": "delay.y"}}]},
            "has no field 'twist.linear.q'; expected one of",
        ),
        (
            {"topics": [{"topic": "/v", "type": TWIST, "fields": {"twist.linear": "delay.y"}}]},
            "'twist.linear' of 'geometry_msgs/msg/TwistStamped' for 'delay.y': it is a message itself",
        ),
        (
            {
                "topics": [
                    {"topic": "/v", "type": TWIST, "fields": {"twist.linear.x": "delay.y", "twist.linear.y": "gain.u"}}
                ]
            },
            "the output 'delay.y' and the input 'gain.u' in one message; expected a topic for each direction",
        ),
    ],
)
def test_what_is_wrong_is_told_with_the_way_out(tmp_path: Path, ros: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        prepare(configured(tmp_path, **ros))

    assert message in str(caught.value)


JOINTS, PRIMITIVE, TF = "sensor_msgs/msg/JointState", "shape_msgs/msg/SolidPrimitive", "tf2_msgs/msg/TFMessage"


def mapped(message: str, fields: dict[str, str], **more: Any) -> dict[str, Any]:  # noqa: ANN401 what a file may hold
    return {"topics": [{"topic": "/t", "type": message, "fields": fields, **more}]}


@pytest.mark.parametrize(
    ("ros", "message"),
    [
        (mapped(TF, {"transforms.transform.rotation.w": "delay.y"}), "write an index, such as transforms[0].transform"),
        (
            mapped(TF, {"transforms[0].transform.rotation.q": "delay.y"}),
            "has no field 'transforms[0].transform.rotation.q'",
        ),
        (mapped(TF, {"transforms[0].transform": "delay.y"}), "it is a message itself"),
        (mapped(TF, {"transforms[-1].transform.rotation.w": "delay.y"}), "an index is a whole number from 0 to 65535"),
        (mapped(TF, {"transforms[99999999].transform.rotation.w": "gain.u"}), "a whole number from 0 to 65535"),
        (mapped(PRIMITIVE, {"dimensions[3]": "gain.u"}), "an index is a whole number from 0 to 2"),
        (mapped(JOINTS, {"position[100000]": "delay.y"}), "an index is a whole number from 0 to 65535"),
        (mapped(JOINTS, {"position": "delay.y"}), "one value into an array; write an index, such as data[0]"),
        (
            mapped(JOINTS, {"position[1]": "delay.y", "position[01]": "gain.y"}),
            "'position[01]', which 'position[1]' gives already; expected a value once for each field",
        ),
        (
            mapped(JOINTS, {"position[0]": "delay.y"}, constants={"header.stamp.sec": 5}),
            "'header.stamp.sec', which is the simulation time",
        ),
        (
            mapped(JOINTS, {"position[0]": "delay.y"}, constants={"name[0]": 5}),
            "5 for 'name[0]' of 'sensor_msgs/msg/JointState'; expected a value of the type string",
        ),
        (
            mapped(JOINTS, {"position[0]": "delay.y"}, constants={"names[0]": "x"}),
            "has no field 'names[0]'; expected one of",
        ),
        (mapped(JOINTS, {"position[0]": "delay.y"}, constants={"effort": 1.0}), "expected a field of one value"),
        (mapped(JOINTS, {"position[0]": "delay.y"}, constants={"effort[0]": True}), "a value of the type float64"),
        (mapped(PRIMITIVE, {"dimensions[0]": "delay.y"}, constants={"type": 300}), "'type' cannot be 300"),
        (mapped(JOINTS, {"position[0]": "gain.u"}, constants={"name[0]": "a"}), "a topic that is subscribed"),
        (
            mapped(JOINTS, {"position[nam=elbow]": "gain.u"}),
            "apart; expected one of position[name=elbow]. Did you mean 'position[name=elbow]'?",
        ),
        (
            mapped(JOINTS, {"position[name=elbow]": "delay.y", "position[0]": "gain.y"}),
            "'position[0]', which 'position[name=elbow]' gives already",
        ),
        (
            mapped(TF, {"transforms[child_frame_id=a].transform": "delay.y"}),
            "'transforms[child_frame_id=a].transform' of 'tf2_msgs/msg/TFMessage' for 'delay.y': it is a message",
        ),
        (
            mapped(
                TF,
                {"transforms[child_frame_id=a].transform.rotation.w": "delay.y"},
                constants={"transforms[child_frame_id=a].child_frame_id": "b"},
            ),
            "'transforms[child_frame_id=a].child_frame_id', which '[…=a]' gives already",
        ),
        (
            mapped(JOINTS, {"position[name=elbow]": "delay.y"}, constants={"name[0]": "elbow", "name[1]": "elbow"}),
            "constants: 'elbow' at 'name[1]', and at 'name[0]'; expected each key once",
        ),
    ],
)
def test_what_could_not_be_sent_or_received_is_told_by_check(tmp_path: Path, ros: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        prepare(configured(tmp_path, **ros))

    assert message in str(caught.value)


def test_array_that_has_not_as_many_elements_as_its_field_is_told(tmp_path: Path) -> None:
    fields = {"covariance": "a.float64_array_out"}
    path = write_config(
        tmp_path,
        instances={"a": {"fmu": str(find_fmu("AllTypes3", tmp_path)), "start_values": {"columns": 5}}},
        connections=[],
        ros=mapped("geometry_msgs/msg/PoseWithCovariance", fields),
    )

    with pytest.raises(ConfigurationError, match="it has 36 elements, and the variable 10"):
        prepare(path)


def test_elements_of_arrays_of_messages_are_topics_in_both_directions(tmp_path: Path) -> None:
    out = {"transforms[0].transform.translation.x": "pendulum.a", "transforms[1].transform.rotation.w": "delay.y"}
    names = {"transforms[0].child_frame_id": "rod", "transforms[1].child_frame_id": "late"}

    plan = planned(
        tmp_path,
        topics=[
            {"topic": "/tf", "type": TF, "fields": out, "constants": names, "frame_id": "world"},
            {"topic": "/poses", "type": "geometry_msgs/msg/PoseArray", "fields": {"poses[3].position.x": "gain.u"}},
        ],
    )

    assert [(topic.name, topic.direction) for topic in plan.topics] == [("/tf", "out"), ("/poses", "in")]
    assert plan.topics[0].constants == tuple(names.items())


def test_published_keys_become_indexes_and_constants_of_plan(tmp_path: Path) -> None:
    fields = {"position[name=weak]": "pendulum.a", "position[name=bare]": "delay.y", "velocity[name=bare]": "gain.y"}

    [made] = planned(tmp_path, **mapped(JOINTS, fields, constants={"name[0]": "bare"})).topics

    assert [port.path for port in made.ports] == ["position[1]", "position[0]", "velocity[0]"]
    assert str(made.constants) == "(('name[0]', 'bare'), ('name[1]', 'weak'), ('velocity[1]', nan))"


@pytest.mark.parametrize(
    ("message", "field", "by_key"),
    [
        (JOINTS, "position[0]", "position[name=…]"),
        (TF, "transforms[1].transform.rotation.w", "transforms[child_frame_id=…].transform.rotation.w"),
        (JOINTS, "position[name=elbow]", None),
        ("geometry_msgs/msg/PoseArray", "poses[0].position.x", None),
    ],
)
def test_index_into_subscribed_table_is_a_warning_with_spelling_by_key(
    tmp_path: Path, message: str, field: str, by_key: str | None
) -> None:
    checked = fmu_mesh.load(configured(tmp_path, **mapped(message, {field: "gain.u"}))).check()

    warnings = [text for text in checked.warnings if "ros.topics" in text]
    where = (
        f"ros.topics[0].fields.{field}: '{field}' of '{message}', whose elements may come in any order; expected a key"
    )
    assert [text.partition(": ")[2] for text in warnings] == ([] if by_key is None else [f"{where}: {by_key}"])


def test_index_into_published_table_is_no_warning(tmp_path: Path) -> None:
    ros = mapped(JOINTS, {"position[0]": "delay.y"}, constants={"name[0]": "elbow"})

    assert not [text for text in fmu_mesh.load(configured(tmp_path, **ros)).check().warnings if "ros" in text]


def test_names_that_collide_or_start_with_a_digit_are_found_together(tmp_path: Path) -> None:
    loaded = examine_data(read_file(configured(tmp_path, topics=["pendulum", "delay.nothing"])))[0]
    variables = tuple(
        Variable(name=name, value_reference=number, type="Float64", causality="output", variability="continuous")
        for number, name in enumerate(["b.x", "b_x", "1st", "fine"])
    )
    model = ModelDescription(
        model_name="m", model_identifier="m", fmi_version="2.0", kind="co_simulation", guid="g", variables=variables
    )
    findings = loaded.findings()

    plan = resolve(loaded, {"pendulum": model, "delay": model}, findings, loaded.findings())

    texts = [str(finding) for finding in findings]
    assert len(texts) == 3
    assert "in 'pendulum' the variables 'b.x', 'b_x' all become 'b_x'; expected a name of your choice" in texts[0]
    assert "{topic: /a_name, variable: 'pendulum.b.x'}" in texts[0]
    assert "the variable '1st' becomes '1st', which starts with a digit" in texts[1]
    assert "the unknown variable 'nothing'" in texts[2]
    assert plan is not None
    assert [topic.name for topic in plan.topics] == ["/pendulum/fine"]
