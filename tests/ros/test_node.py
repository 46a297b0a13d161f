"""The ROS node against `fmi_adapter_node`: each of its behaviours, and each of its defects, mended.

Time is simulated and set by the test, wherever it matters.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import zipfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from fmu_mesh import FMIAdapter
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.instances.fmi.co_simulation.fmi2 import Fmi2Instance
from fmu_mesh.ros.node.node_topics import topics_of
from fmu_mesh.ros_wire.ros_names import ros_name
from tests.fmus.helpers import find_fmu
from tests.fmus.packing import repacked
from tests.helpers import DEADLINE_S, FMUS
from tests.ros.ros_peer import Ros, ros_or_skip

ros_or_skip()

PENDULUM = str(FMUS / "DampedPendulum.fmu")
DELAY = str(FMUS / "TransportDelay.fmu")
GAIN = str(FMUS / "Gain.fmu")
MS = 1_000_000


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Ros]:
    with Ros(tmp_path / "log") as ros:
        yield ros


class SimulatedTime:
    """The source of `/clock`, and of inputs at its times."""

    def __init__(self, ros: Ros, node: Any) -> None:
        from rosgraph_msgs.msg import Clock  # noqa: PLC0415 only where ROS is installed

        self._ros = ros
        self._kind = Clock
        self._clock = node.get_clock()
        self._publisher = ros.peer("time").create_publisher(Clock, "/clock", 10)
        ros.matched(self._publisher)

    def set(self, time_ms: float) -> None:
        """Let it be so late, and wait until the node knows."""
        time = round(time_ms * MS)
        message = self._kind()
        message.clock.sec, message.clock.nanosec = divmod(time, 1_000_000_000)
        self._publisher.publish(message)
        self._ros.until(lambda: self._clock.now().nanoseconds == time, f"the node's clock at {time_ms} ms")


def float64(value: float) -> Any:
    from std_msgs.msg import Float64  # noqa: PLC0415 only where ROS is installed

    return Float64(data=value)


def state_of(node: Any) -> str:
    return str(node._state_machine.current_state[1])


def start(node: Any) -> None:
    node.trigger_configure()
    node.trigger_activate()
    assert state_of(node) == "active"


class Said:
    """What nodes of this process have said."""

    def __init__(self, capture: pytest.CaptureFixture[str]) -> None:
        self._capture = capture
        self._text = ""

    def of(self, words: str) -> list[str]:
        """The lines with these words."""
        self._text += self._capture.readouterr().err
        return [line for line in self._text.splitlines() if words in line]


@pytest.fixture
def said(capfd: pytest.CaptureFixture[str]) -> Said:
    return Said(capfd)


# ---- what is as in fmi_adapter ----


@pytest.mark.parametrize(
    ("fmu", "publishers", "subscriptions"),
    [
        (PENDULUM, {"/a", "/der_a_", "/der_a_2_"}, set()),
        (DELAY, {"/y"}, {"/x"}),
    ],
)
def test_outputs_are_publishers_and_inputs_subscriptions_of_float64(
    ros: Ros, fmu: str, publishers: set[str], subscriptions: set[str]
) -> None:
    node = ros.fmu(fmu_path=fmu)
    peer = ros.peer()

    node.trigger_configure()

    def topics(of: Any) -> dict[str, list[str]]:
        return {name: types for name, types in of("fmi_adapter_node", "/") if "std_msgs/msg/Float64" in types}

    assert set(ros.until(lambda: topics(peer.get_publisher_names_and_types_by_node), "publishers")) == publishers
    assert set(topics(peer.get_subscriber_names_and_types_by_node)) == subscriptions


def test_every_variable_is_a_parameter_and_those_that_are_set_initialize_fmu(ros: Ros) -> None:
    # A whole number for a Real is what a file that says `l: 2` gives.
    node = ros.fmu(fmu_path=PENDULUM, l=2, d=0.001, a=1.3)

    node.trigger_configure()

    names = ("a", "der_a_", "der_a_2_", "l", "d", "g")
    assert [node.has_parameter(name) for name in names] == [True] * 6
    assert node.get_parameter("g").value is None
    driver = node.managed._driver
    assert [driver.adapter.get_value(name) for name in ("l", "d", "a", "g")] == [2.0, 0.001, 1.3, 9.81]


def test_a_parameter_that_fmi_forbids_to_set_is_set_with_a_warning(
    ros: Ros, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The pendulum of fmi_adapter declares its angle as an output with initial 'calculated'; ours takes it as well."""

    def calculated(text: str) -> str:
        name = text.index('name="a"')
        own = text[name:].replace('initial="exact"', 'initial="calculated"', 1).replace(' start="1.5"', "", 1)
        return text[:name] + own

    fmu = repacked(tmp_path / "pendulum.fmu", source=FMUS / "DampedPendulum.fmu", description=calculated)
    node = ros.fmu(fmu_path=str(fmu), a=1.3)

    node.trigger_configure()

    assert state_of(node) == "inactive"
    assert node.managed._driver.adapter.get_value("a") == 1.3
    assert "'a', an output with initial 'calculated': FMI 2.0 (2.2.7) does not allow setting it" in caplog.text


def test_the_parameters_of_the_node_have_the_defaults_of_fmi_adapter(ros: Ros) -> None:
    node = ros.fmu()

    assert [node.get_parameter(name).value for name in ("fmu_path", "step_size", "update_period")] == ["", 0.0, 0.01]


def test_run_gives_floats_of_loop_of_steps_and_one_message_per_update(ros: Ros) -> None:
    with FMIAdapter(PENDULUM) as pendulum:
        pendulum.exit_initialization_mode(0.0)
        expected = {0: float(pendulum.get_output_value("a"))}
        for point in range(1, 101):
            pendulum.do_step()
            expected[point] = float(pendulum.get_output_value("a"))
    node = ros.fmu(fmu_path=PENDULUM, use_sim_time=True, stamped=True, update_period=0.002)
    peer = ros.peer()
    time = SimulatedTime(ros, node)
    from geometry_msgs.msg import PointStamped  # noqa: PLC0415 only where ROS is installed

    subscription, messages = ros.collect(peer, PointStamped, "a_stamped")
    node.trigger_configure()
    ros.matched(subscription)
    node.trigger_activate()
    got: dict[int, float] = {}

    def came(point: int) -> bool:
        for message in messages:
            stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            index, rest = divmod(stamp - 1000 * MS, 2 * MS)
            assert rest == 0
            assert got.setdefault(index, message.point.x) == message.point.x
        messages.clear()
        return point in got

    for point in range(101):
        time.set(1000 + 2 * point)
        ros.until(partial(came, point), f"point {point}")

    assert got == expected


def test_a_node_that_is_not_active_takes_no_step_and_publishes_nothing(ros: Ros) -> None:
    node = ros.fmu(fmu_path=GAIN, step_size=0.01, use_sim_time=True, k=1.0)
    peer = ros.peer()
    time = SimulatedTime(ros, node)
    subscription, messages = ros.collect(peer, type(float64(0.0)), "y")
    node.trigger_configure()
    ros.matched(subscription)

    time.set(1000)
    ros.turn(0.1)
    before = list(messages)
    node.trigger_activate()
    ros.until(lambda: messages, "a message of an active node")
    node.trigger_deactivate()
    ros.turn(0.05)
    messages.clear()
    steps = node.managed._driver._steps
    time.set(5000)
    ros.turn(0.1)

    assert (before, messages, node.managed._driver._steps) == ([], [], steps)
    node.trigger_activate()
    time.set(5010)
    ros.until(lambda: node.managed._driver._steps == steps + 1, "the step after the pause")


def test_the_lifecycle_is_driven_by_the_services_of_a_managed_node(ros: Ros) -> None:
    from lifecycle_msgs.srv import ChangeState, GetState  # noqa: PLC0415 only where ROS is installed

    ros.fmu(fmu_path=PENDULUM)
    peer = ros.peer()
    change = peer.create_client(ChangeState, "/fmi_adapter_node/change_state")
    get = peer.create_client(GetState, "/fmi_adapter_node/get_state")
    states = []
    for transition in ("configure", "activate", "deactivate", "cleanup", "configure", "cleanup", "shutdown"):
        request = ChangeState.Request()
        request.transition.label = transition
        assert ros.called(change, request, once=True).success, transition
        states.append(ros.called(get, GetState.Request()).current_state.label)

    assert states == ["inactive", "active", "inactive", "unconfigured", "inactive", "unconfigured", "finalized"]


# ---- what fmi_adapter does wrong ----


def variables(tmp_path: Path, *names: str) -> str:
    """The pendulum with other names for its outputs a, der(a) and der(a,2)."""
    changed = tmp_path / "Named.fmu"
    with zipfile.ZipFile(PENDULUM) as source, zipfile.ZipFile(changed, "w") as target:
        for entry in source.namelist():
            content = source.read(entry)
            if entry == "modelDescription.xml":
                for old, new in zip(("a", "der(a)", "der(a,2)"), names, strict=True):
                    assert f'name="{old}"'.encode() in content
                    content = content.replace(f'name="{old}"'.encode(), f'name="{new}"'.encode())
            target.writestr(entry, content)
    return str(changed)


@pytest.mark.parametrize(
    ("names", "complaint", "mended"),
    [
        (("x[1]", "x(1)", "z"), "the variables 'x[1]', 'x(1)' all become 'x_1_'", "x(1): second"),
        (("1st", "y", "z"), "the variable '1st' becomes '1st', which starts with a digit", "1st: first"),
        (("update_period", "y", "z"), "names of parameters of this node: update_period", "update_period: period"),
    ],
)
def test_name_that_ros_cannot_have_is_refused_with_way_out_which_works(
    ros: Ros, said: Said, tmp_path: Path, names: tuple[str, str, str], complaint: str, mended: str
) -> None:
    node = ros.fmu(fmu_path=variables(tmp_path, *names))
    node.trigger_configure()
    lines = ros.until(lambda: said.of(complaint), "the complaint")

    assert state_of(node) == "unconfigured"
    assert "'VARIABLE: NAME'" in lines[0]
    assert "parameter 'names'" in lines[0]
    import rclpy  # noqa: PLC0415 only where ROS is installed

    node.set_parameters([rclpy.Parameter("names", value=[mended])])
    node.trigger_configure()
    assert state_of(node) == "inactive"
    assert node.has_parameter(mended.split(": ")[1])


def test_the_stop_time_ends_the_run_there_and_deactivates_the_node(ros: Ros) -> None:
    node = ros.fmu(fmu_path=PENDULUM, use_sim_time=True, stop_time=0.1, stamped=True)
    peer = ros.peer()
    time = SimulatedTime(ros, node)
    from geometry_msgs.msg import PointStamped  # noqa: PLC0415 only where ROS is installed

    subscription, messages = ros.collect(peer, PointStamped, "a_stamped")
    start(node)
    ros.matched(subscription)
    time.set(1000)
    ros.until(lambda: messages, "a first message")

    time.set(9000)
    ros.until(lambda: state_of(node) == "inactive", "the end")

    def last() -> tuple[int, int]:
        return messages[-1].header.stamp.sec, messages[-1].header.stamp.nanosec

    # The middleware may still have the last message when the node is inactive.
    ros.until(lambda: last() >= (1, 100 * MS), "the message of the last step")
    assert last() == (1, 100 * MS)


def test_simulated_time_that_jumps_back_starts_the_fmu_again(ros: Ros, said: Said) -> None:
    node = ros.fmu(fmu_path=PENDULUM, use_sim_time=True)
    peer = ros.peer()
    time = SimulatedTime(ros, node)
    subscription, messages = ros.collect(peer, type(float64(0.0)), "a")
    start(node)
    ros.matched(subscription)
    time.set(1000)
    ros.until(lambda: messages and messages[-1].data == 1.5, "the start value")
    time.set(3000)
    ros.until(lambda: messages[-1].data != 1.5, "another value")

    time.set(500)

    ros.until(lambda: messages[-1].data == 1.5, "the start value again")
    ros.until(lambda: said.of("time has jumped back by 2.500 s"), "a word about it")
    assert state_of(node) == "active"


def test_an_input_holds_from_its_messages_stamp_and_the_second_equal_counts(ros: Ros) -> None:
    from geometry_msgs.msg import PointStamped  # noqa: PLC0415 only where ROS is installed

    node = ros.fmu(fmu_path=GAIN, step_size=0.1, use_sim_time=True, stamped=True, k=1.0)
    peer = ros.peer()
    time = SimulatedTime(ros, node)
    publisher = peer.create_publisher(PointStamped, "u_stamped", 10)
    start(node)
    ros.matched(publisher)
    time.set(1000)
    driver = node.managed._driver
    ros.until(lambda: driver.started, "the start")
    for value in (5.0, 7.0):
        message = PointStamped()
        message.header.stamp.sec, message.header.stamp.nanosec = 1, 100 * MS
        message.point.x = value
        publisher.publish(message)
    ros.until(lambda: len(driver.adapter._trajectories.get("u", ())) == 2, "both messages")

    time.set(1100)
    ros.until(lambda: driver._steps == 1, "the first step")
    first = driver.adapter.get_value("y")
    time.set(1200)
    ros.until(lambda: driver._steps == 2, "the second step")

    assert (first, driver.adapter.get_value("y")) == (0.0, 7.0)


def test_catching_up_is_bounded_per_update_and_told(ros: Ros, said: Said) -> None:
    node = ros.fmu(fmu_path=GAIN, step_size=0.001, use_sim_time=True, max_steps=100, update_period=0.05)
    time = SimulatedTime(ros, node)
    start(node)
    time.set(1000)
    driver = node.managed._driver
    ros.until(lambda: driver.started, "the start")

    time.set(1450)
    steps: set[int] = set()

    def finished() -> bool:
        steps.add(driver._steps)
        return 450 in steps

    ros.until(finished, "all steps")

    assert steps <= {0, 100, 200, 300, 400, 450}
    ros.until(lambda: said.of("0.350 s behind after 100 steps"), "a word about it")


def test_every_type_has_its_topic_and_its_parameter(ros: Ros, tmp_path: Path) -> None:
    import std_msgs.msg  # noqa: PLC0415 only where ROS is installed

    values: dict[str, tuple[str, Any]] = {
        "real": ("Float64", 2.5),
        "integer": ("Int32", -7),
        "boolean": ("Bool", True),
        "string": ("String", "grün"),
        "enumeration": ("Int64", 3),
    }
    fmu = str(find_fmu("AllTypes", tmp_path))
    node = ros.fmu(
        fmu_path=fmu, step_size=0.01, integer_parameter=5, string_parameter="x", enumeration_parameter="high"
    )
    peer = ros.peer()
    got: dict[str, Any] = {}
    publishers, subscriptions = {}, []
    for name, (kind, _) in values.items():
        message = getattr(std_msgs.msg, kind)
        publishers[name] = peer.create_publisher(message, f"{name}_in", 10)
        keep = lambda message, name=name: got.update({name: message.data})  # noqa: E731 one line says it
        subscriptions.append(peer.create_subscription(message, f"{name}_out", keep, 10))
    start(node)
    ros.matched(*publishers.values(), *subscriptions)

    for name, (kind, value) in values.items():
        publishers[name].publish(getattr(std_msgs.msg, kind)(data=value))

    ros.until(lambda: got == {name: value for name, (_, value) in values.items()}, f"all values, but {got}")
    driver = node.managed._driver
    names = ("integer_parameter", "string_parameter", "enumeration_parameter")
    assert [driver.adapter.get_value(name) for name in names] == [5, "x", 3]


def test_a_tunable_parameter_changes_at_run_time_and_a_fixed_is_refused(ros: Ros) -> None:
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue  # noqa: PLC0415 only where ROS is installed
    from rcl_interfaces.srv import SetParameters  # noqa: PLC0415 as above

    node = ros.fmu(fmu_path=GAIN, step_size=0.01, k=1.0)
    peer = ros.peer()
    subscription, messages = ros.collect(peer, type(float64(0.0)), "y")
    publisher = peer.create_publisher(type(float64(0.0)), "u", 10)
    client = peer.create_client(SetParameters, "/fmi_adapter_node/set_parameters")
    start(node)
    ros.matched(subscription, publisher)
    publisher.publish(float64(2.0))
    ros.until(lambda: messages and messages[-1].data == 2.0, "the input at the output")

    def set_to(name: str, value: ParameterValue) -> Any:
        return ros.called(client, SetParameters.Request(parameters=[Parameter(name=name, value=value)])).results[0]

    accepted = set_to("k", ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=3.0))
    ros.until(lambda: messages[-1].data == 6.0, "the new gain")
    wrong = set_to("k", ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="much"))
    output = set_to("y", ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=3.0))

    assert accepted.successful
    assert (wrong.successful, output.successful) == (False, False)
    assert "'much' cannot be its value; expected a value of type Real" in wrong.reason
    assert "this continuous output is not a tunable parameter" in output.reason
    assert node.get_parameter("k").value == 3.0


def test_fields_of_one_message_are_variables_in_both_directions(ros: Ros) -> None:
    from geometry_msgs.msg import TwistStamped  # noqa: PLC0415 only where ROS is installed

    node = ros.fmu(
        fmu_path=str(FMUS / "Adder.fmu"),
        step_size=0.01,
        messages=[
            "/vel_des: {type: geometry_msgs/msg/TwistStamped, fields: {twist.linear.x: u1, twist.angular.z: u2}}",
            "/vel_des_fil: {type: geometry_msgs/msg/TwistStamped, fields: {twist.linear.y: y}}",
        ],
    )
    peer = ros.peer()
    publisher = peer.create_publisher(TwistStamped, "/vel_des", 10)
    subscription, messages = ros.collect(peer, TwistStamped, "/vel_des_fil")
    start(node)
    ros.matched(publisher, subscription)
    message = TwistStamped()
    message.header.stamp = peer.get_clock().now().to_msg()
    message.twist.linear.x, message.twist.angular.z = 0.25, 1.5

    def arrives() -> bool:
        publisher.publish(message)  # again: only one of the two ends may have found the other
        return bool(messages) and messages[-1].twist.linear.y == 1.75

    ros.until(arrives, "the sum")

    stamps = [m.header.stamp.sec * 1_000_000_000 + m.header.stamp.nanosec for m in messages]
    assert stamps == sorted(stamps)
    assert {name for name, _ in peer.get_topic_names_and_types()} & {"/u1", "/u2", "/y"} == set()


def test_an_element_of_an_array_of_messages_is_variable_in_both_directions(ros: Ros) -> None:
    from geometry_msgs.msg import Pose, PoseArray  # noqa: PLC0415 only where ROS is installed

    node = ros.fmu(
        fmu_path=str(FMUS / "Gain.fmu"),
        step_size=0.01,
        messages=[
            "/given: {type: geometry_msgs/msg/PoseArray, fields: {'poses[1].position.x': u}}",
            "/taken: {type: geometry_msgs/msg/PoseArray, fields: {'poses[2].position.y': y}}",
        ],
    )
    peer = ros.peer()
    publisher = peer.create_publisher(PoseArray, "/given", 10)
    subscription, messages = ros.collect(peer, PoseArray, "/taken")
    start(node)
    ros.matched(publisher, subscription)
    message = PoseArray(poses=[Pose(), Pose()])
    message.poses[1].position.x = 0.25
    publisher.publish(message)

    ros.until(lambda: messages and messages[-1].poses[2].position.y == 0.25, "the element")
    publisher.publish(PoseArray(poses=[Pose()]))  # without the element: it is left out
    after = len(messages)
    ros.until(lambda: len(messages) > after + 3, "a node that goes on")

    assert [len(own.poses) for own in messages] == [3] * len(messages)
    assert messages[-1].poses[2].position.y == 0.25
    assert state_of(node) == "active"


@pytest.mark.parametrize(
    ("parameters", "complaint"),
    [
        ({}, "the parameter 'fmu_path' is not set"),
        ({"fmu_path": "no.fmu"}, "'no.fmu'"),
        ({"fmu_path": PENDULUM, "step_size": -1.0}, "the parameter 'step_size' is -1.0"),
        ({"fmu_path": PENDULUM, "update_period": 0.0}, "the parameter 'update_period' is 0.0"),
        ({"fmu_path": PENDULUM, "l": "long"}, "'long' cannot be its value"),
        ({"fmu_path": PENDULUM, "messages": ["/t: {type: std_msgs/msg/Float64, fields: {dat: a}}"]}, "no field 'dat'"),
        ({"fmu_path": PENDULUM, "messages": ["/t: {type: no_msgs/msg/No, fields: {data: a}}"]}, "'no_msgs'"),
        ({"fmu_path": PENDULUM, "messages": ["/t: {type: std_msgs/msg/Float64, fields: {data: b}}"]}, "'b' in '/t'"),
        (
            {"fmu_path": PENDULUM, "messages": ["/t: {type: geometry_msgs/msg/PoseArray, fields: {'poses[0]': a}}"]},
            "'poses[0]' of 'geometry_msgs/msg/PoseArray' is no single value",
        ),
        (
            {
                "fmu_path": PENDULUM,
                "messages": ["/t: {type: std_msgs/msg/Float64MultiArray, fields: {'data[-1]': a}}"],
            },
            "has no field 'data[-1]': an index is a whole number from 0 to 65535",
        ),
        (
            {
                "fmu_path": PENDULUM,
                "messages": ["/t: {type: std_msgs/msg/Float64MultiArray, fields: {'data[65536]': a}}"],
            },
            "has no field 'data[65536]': an index is a whole number from 0 to 65535",
        ),
        (
            {
                "fmu_path": PENDULUM,
                "messages": ["/t: {type: geometry_msgs/msg/PoseWithCovariance, fields: {'covariance[36]': a}}"],
            },
            "has no field 'covariance[36]': an index is a whole number from 0 to 35",
        ),
        ({"fmu_path": PENDULUM, "publish_clock": True, "use_sim_time": True}, "publish /clock and run by it"),
    ],
)
def test_what_is_wrong_is_told_and_leaves_the_node_unconfigured(
    ros: Ros, said: Said, parameters: dict[str, Any], complaint: str
) -> None:
    node = ros.fmu(**parameters)

    node.trigger_configure()

    ros.until(lambda: said.of(complaint), complaint)
    assert state_of(node) == "unconfigured"


def test_an_fmu_that_fails_is_told_and_node_can_be_configured_again(ros: Ros, said: Said, faulty: Path) -> None:
    node = ros.fmu(fmu_path=str(faulty), step_size=0.01, fail_at=0.05)
    start(node)

    ros.until(lambda: state_of(node) == "unconfigured", "the end of the FMU")

    lines = ros.until(lambda: said.of("the reactor is empty"), "the FMU's own words")
    assert re.search(r"instance Faulty@\d+, point 5, t = ", lines[0])
    node.trigger_configure()
    assert state_of(node) == "inactive"


def test_the_fmu_is_called_from_one_thread_only(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    threads: set[str] = set()
    for method in ("__init__", "enter_initialization", "exit_initialization", "advance", "get_values", "close"):
        original = getattr(Fmi2Instance, method)

        def watched(*args: Any, original: Any = original, **kwargs: Any) -> Any:
            threads.add(threading.current_thread().name)
            return original(*args, **kwargs)

        monkeypatch.setattr(Fmi2Instance, method, watched)
    node = ros.fmu(fmu_path=PENDULUM)
    start(node)
    ros.until(lambda: node.managed._driver._steps > 3, "some steps")

    node.trigger_deactivate()
    node.trigger_cleanup()

    assert threads == {"fmu_0"}


# ---- a process of its own ----


def process(ros: Ros, temporary: Path, **parameters: Any) -> subprocess.Popen[str]:
    """A node that runs an FMU and starts by itself, with its files in a folder of its own."""
    temporary.mkdir()
    command = [sys.executable, "-m", "fmu_mesh.ros.node", "--ros-args", "-r", "__node:=own", "-r", "__ns:=/lab"]
    for name, value in {"autostart": "true", **parameters}.items():
        command += ["-p", f"{name}:={value}"]
    environment = {**os.environ, **ros.environment, "TMPDIR": str(temporary)}
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


def test_a_process_is_source_of_time_for_others_and_leaves_nothing_behind(ros: Ros, tmp_path: Path) -> None:
    import rclpy  # noqa: PLC0415 only where ROS is installed

    temporary = tmp_path / "temporary"
    node = process(ros, temporary, fmu_path=PENDULUM, publish_clock="true", real_time_factor="10.0")
    try:
        follower = ros.peer("follower")
        follower.set_parameters([rclpy.Parameter("use_sim_time", value=True)])
        subscription, messages = ros.collect(follower, type(float64(0.0)), "/lab/a")
        ros.matched(subscription)
        ros.until(lambda: follower.get_clock().now().nanoseconds > 2_000 * MS, "two seconds of simulated time")
        ros.until(lambda: messages, "the angle")
        assert follower.get_clock().now().nanoseconds < 600_000 * MS
        assert list(temporary.iterdir())
        node.send_signal(signal.SIGTERM)
        assert node.wait(DEADLINE_S) == 0
    finally:
        node.kill()
        node.communicate()
    assert list(temporary.iterdir()) == []


def test_while_fmu_hangs_node_answers_and_its_end_is_bounded_and_clean(ros: Ros, tmp_path: Path, faulty: Path) -> None:
    from lifecycle_msgs.srv import GetState  # noqa: PLC0415 only where ROS is installed
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue  # noqa: PLC0415 as above
    from rcl_interfaces.srv import SetParameters  # noqa: PLC0415 as above

    temporary = tmp_path / "temporary"
    node = process(ros, temporary, fmu_path=faulty, step_size="0.01")
    try:
        peer = ros.peer()
        subscription, messages = ros.collect(peer, type(float64(0.0)), "/lab/y")
        ros.matched(subscription)
        state = peer.create_client(GetState, "/lab/own/get_state")
        parameters = peer.create_client(SetParameters, "/lab/own/set_parameters")
        ros.until(lambda: messages, "a first message")
        now = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=0.0)
        request = SetParameters.Request(parameters=[Parameter(name="hang_at", value=now)])
        assert ros.called(parameters, request).results[0].successful

        def answers_and_nothing_else() -> bool:
            """Whether the node answers again and again, for a second at least, and does not finish one step."""
            before = len(messages)
            for _ in range(100):
                ros.turn(0.01)
                assert ros.called(state, GetState.Request()).current_state.label == "active"
            return len(messages) == before

        ros.until(answers_and_nothing_else, "a step that hangs")
        node.send_signal(signal.SIGTERM)
        assert node.wait(DEADLINE_S) == 3
    finally:
        node.kill()
        _, errors = node.communicate()
    assert "the FMU did not return within 5 s" in errors
    assert list(temporary.iterdir()) == []


HANGING_ROS = """
import sys, threading
import rclpy
from fmu_mesh.ros.node import entry

entry._END_S = 0.5
rclpy.try_shutdown = threading.Event().wait
spin = rclpy.spin

def spin_for_a_while(*node):
    threading.Timer(2.0, rclpy.shutdown).start()
    spin(*node)

rclpy.spin = spin_for_a_while
sys.exit(entry.main(["--ros-args", "-p", "fmu_path:=" + sys.argv[1], "-p", "autostart:=true"]))
"""


def test_a_middleware_that_hangs_at_shutdown_ends_with_the_nodes_code(ros: Ros, tmp_path: Path) -> None:
    environment = {**os.environ, **ros.environment, "TMPDIR": str(tmp_path)}

    done = subprocess.run(
        [sys.executable, "-c", HANGING_ROS, GAIN],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=DEADLINE_S,
    )

    assert "fmu_mesh.ros.node: ROS was not shut down within 0.5 s; the process ends without it" in done.stderr
    assert "in wait" in done.stderr  # the call that hangs, for a report
    assert done.returncode == 0
    assert list(tmp_path.glob("fmu*")) == []


def test_a_misspelt_parameter_is_told_with_the_nearest_right_one(ros: Ros, said: Said) -> None:
    node = ros.fmu(fmu_path=PENDULUM, update_perid=0.1, l=2.0)

    node.trigger_configure()

    assert "'update_perid' is set, but is no variable of the FMU; did you mean 'update_period'?" in said.of("perid")[0]
    assert said.of("the parameter 'l'") == []


@pytest.mark.parametrize(
    ("argument", "says"),
    [
        ("update_period:=1", "Trying to set parameter 'update_period' to '1' of type 'INTEGER'"),
        ("fmu_path=Gain.fmu", "fmu_path=Gain.fmu"),
    ],
)
def test_wrong_arguments_of_the_process_are_told_without_a_traceback(ros: Ros, argument: str, says: str) -> None:
    command = [sys.executable, "-m", "fmu_mesh.ros.node", "--ros-args", "-p", argument]

    done = subprocess.run(
        command, env={**os.environ, **ros.environment}, capture_output=True, text=True, check=False, timeout=DEADLINE_S
    )

    assert done.returncode == 2
    assert "fmu_mesh.ros.node: " in done.stderr
    assert says in done.stderr
    assert "Traceback" not in done.stderr


def test_without_ros_the_module_says_how_to_get_it() -> None:
    program = "import sys; sys.modules['rclpy'] = None; from fmu_mesh.ros.node import main; sys.exit(main([]))"

    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)

    assert done.returncode == 2
    assert done.stderr.startswith("fmu_mesh.ros.node: the ROS package 'rclpy' cannot be imported")
    assert "source /opt/ros/DISTRO/setup.bash" in done.stderr


def test_an_array_in_field_of_one_value_is_refused_with_its_name(tmp_path: Path) -> None:
    with FMIAdapter(find_fmu("AllTypes3", tmp_path), 0.01) as adapter:
        description = adapter.description
    [array, *_] = [v.name for v in description.with_causality("output") if v.shape]
    entry = f"/m: {{type: std_msgs/msg/Float64, fields: {{data: '{array}'}}}}"

    with pytest.raises(ConfigurationError, match=f"'{re.escape(array)}' in '/m' is an array"):
        topics_of(description, {}, [entry], stamped=False)


def test_an_array_is_a_multi_array_with_its_elements_row_by_row(ros: Ros, tmp_path: Path) -> None:
    from std_msgs.msg import Float64MultiArray  # noqa: PLC0415 only where ROS is installed

    with FMIAdapter(find_fmu("AllTypes3", tmp_path), 0.01) as adapter:
        arrays = [v for v in adapter.description.variables if v.shape and v.type == "Float64"]
    [array_in] = [v for v in arrays if v.causality == "input"][:1]
    [array_out] = [v for v in arrays if v.causality == "output"][:1]
    node = ros.fmu(fmu_path=str(find_fmu("AllTypes3", tmp_path)), step_size=0.01)
    peer = ros.peer()
    publisher = peer.create_publisher(Float64MultiArray, ros_name(array_in.name), 10)
    subscription, messages = ros.collect(peer, Float64MultiArray, ros_name(array_out.name))
    start(node)
    ros.matched(publisher, subscription)
    values = [0.5 + k for k in range(array_in.size)]

    publisher.publish(Float64MultiArray(data=values))

    ros.until(lambda: messages and list(messages[-1].data) == values, f"{values}, but {messages[-1:]}")
