"""The gateway node as a process: its states, one after the other and again, and Ctrl-C in each of them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO

import pytest

from fmu_mesh.ros_wire.rclpy_profile import RclpyProfile
from fmu_mesh.ros_wire.topics import Topic
from tests.helpers import DEADLINE_S, FMUS, Place, wait_until, write_config
from tests.ros.ros_peer import Ros, ros_or_skip

ros_or_skip()

CONFIGURE, CLEANUP, ACTIVATE, DEACTIVATE = 1, 2, 3, 4


@pytest.fixture
def ros(place: Place, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ros]:
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(place.folder / "run"))
    with Ros(place.folder / "log") as ros:
        yield ros


def configured(place: Place, name: str, fmu: str) -> Path:
    """A mesh of one FMU that runs until it is stopped."""
    return write_config(
        place.folder,
        name=name,
        instances={"unit": {"fmu": fmu}},
        connections=(),
        stop_time=3600.0,
        simulation={"step_size": 0.01, "real_time_factor": 1.0},
        ros={"profile": "rclpy"},
    )


@contextmanager
def launched(place: Place, config: Path) -> Iterator[None]:
    """A mesh that is running."""
    mesh = place.start("launch", config, "--no-progress")
    assert place.run("wait", config.stem).wait() == 0
    try:
        yield
    finally:
        mesh.signal(signal.SIGINT)
        mesh.wait()


class Node:
    """A gateway node as a process.

    Attributes:
        errors: what it has written so far.
        peer: has the clients of its services.
    """

    def __init__(self, ros: Ros, **parameters: object) -> None:
        from lifecycle_msgs.srv import ChangeState, GetState  # noqa: PLC0415 only where ROS is installed
        from rcl_interfaces.srv import DescribeParameters, ListParameters, SetParameters  # noqa: PLC0415 as above

        command = [sys.executable, "-m", "fmu_mesh.ros.node", "--ros-args", "-r", "__node:=own"]
        for name, value in parameters.items():
            command += ["-p", f"{name}:={value}"]
        self.errors = ""
        self._popen = subprocess.Popen(
            command, env={**os.environ, **ros.environment}, stderr=subprocess.PIPE, text=True
        )
        assert self._popen.stderr is not None
        self._reader = threading.Thread(target=self._read, args=(self._popen.stderr,), daemon=True)
        self._reader.start()
        self._ros = ros
        self.peer = peer = ros.peer()
        self._change = ChangeState, peer.create_client(ChangeState, "/own/change_state")
        self._state = GetState, peer.create_client(GetState, "/own/get_state")
        self._list = ListParameters, peer.create_client(ListParameters, "/own/list_parameters")
        self._set = SetParameters, peer.create_client(SetParameters, "/own/set_parameters")
        self._describe = DescribeParameters, peer.create_client(DescribeParameters, "/own/describe_parameters")

    def change(self, *transitions: int) -> None:
        """Go through these transitions, each of which has to succeed."""
        for transition in transitions:
            assert self.succeeds(transition), f"{transition}: {self.errors}"

    def succeeds(self, transition: int) -> bool:
        kind, client = self._change
        request = kind.Request()
        request.transition.id = transition
        return bool(self._ros.called(client, request, once=True).success)

    def state(self) -> str:
        kind, client = self._state
        return str(self._ros.called(client, kind.Request()).current_state.label)

    def parameters(self) -> list[str]:
        """Those of the instance `unit`."""
        kind, client = self._list
        names = self._ros.called(client, kind.Request()).result.names
        return sorted(name for name in names if name.startswith("unit."))

    def description(self, parameter: str) -> str:
        kind, client = self._describe
        return str(self._ros.called(client, kind.Request(names=[parameter])).descriptors[0].description)

    def set(self, parameter: str, value: float | str) -> str:
        """Set a parameter; why that was refused, or nothing."""
        from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue  # noqa: PLC0415 only with ROS

        if isinstance(value, str):
            own = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=value)
        else:
            own = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
        kind, client = self._set
        result = self._ros.called(client, kind.Request(parameters=[Parameter(name=parameter, value=own)])).results[0]
        assert result.successful == (not result.reason)
        return str(result.reason)

    def interrupted(self) -> int:
        """Press Ctrl-C; the exit code."""
        self._popen.send_signal(signal.SIGINT)
        return self.ended()

    def ended(self) -> int:
        """Wait for its end; the exit code."""
        code = self._popen.wait(DEADLINE_S)
        self._reader.join(DEADLINE_S)
        return code

    def says(self, text: str) -> None:
        """Wait until it has written this."""
        self._ros.until(lambda: text in self.errors, f"{text!r}; it wrote {self.errors}")

    def _read(self, pipe: IO[str]) -> None:
        with pipe:
            for line in pipe:
                self.errors += line

    def close(self) -> None:
        if self._popen.poll() is None:
            self._popen.kill()
            self.ended()


@contextmanager
def gateway(ros: Ros, **parameters: object) -> Iterator[Node]:
    node = Node(ros, **parameters)
    try:
        ros.known_to("/own", node.peer)
        yield node
    finally:
        node.close()


STATES: dict[str, Sequence[int]] = {
    "unconfigured": (),
    "inactive": (CONFIGURE,),
    "active": (CONFIGURE, ACTIVATE),
    "inactive again": (CONFIGURE, ACTIVATE, DEACTIVATE),
    "cleaned up": (CONFIGURE, ACTIVATE, DEACTIVATE, CLEANUP),
}


@pytest.mark.parametrize("transitions", STATES.values(), ids=STATES)
def test_ctrl_c_ends_it_in_every_state_without_error_or_traceback(
    ros: Ros, place: Place, transitions: Sequence[int]
) -> None:
    config = configured(place, "lab", "DampedPendulum")
    with launched(place, config), gateway(ros, config=config) as node:
        assert node.state() == "unconfigured"
        node.change(*transitions)

        assert node.interrupted() == 0

    assert "Traceback" not in node.errors
    assert "rror" not in node.errors


SHUT_DOWN_IN_A_CALLBACK = """
import sys
import rclpy
from fmu_mesh.ros.node import entry

def create_node():
    node = made()
    def use_it():
        rclpy.shutdown()
        node.get_publishers_info_by_topic("/clock")
    node.create_timer(0.01, use_it)
    return node

made, entry.create_node = entry.create_node, create_node
sys.exit(entry.main())
"""


def test_ros_that_is_shut_down_while_callback_uses_it_is_plain_end(ros: Ros) -> None:
    """After Ctrl-C a thread of rclpy shuts ROS down; here a callback does, so the order is always this."""
    done = subprocess.run(
        [sys.executable, "-c", SHUT_DOWN_IN_A_CALLBACK],
        env={**os.environ, **ros.environment},
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )

    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.usefixtures("ros")
def test_sample_that_comes_after_ros_was_shut_down_is_dropped_without_word() -> None:
    import rclpy  # noqa: PLC0415 only where ROS is installed
    from rclpy.serialization import serialize_message  # noqa: PLC0415 as above
    from std_msgs.msg import Float64  # noqa: PLC0415 as above

    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("own", context=context)
    topic = Topic("/y", "std_msgs/msg/Float64", "out", ())
    put = RclpyProfile(node).publish(topic)
    put(serialize_message(Float64(data=1.0)), 0.0)
    rclpy.shutdown(context=context)

    put(serialize_message(Float64(data=2.0)), 0.0)

    node.destroy_node()


def test_one_gateway_serves_one_run_after_another_and_another_mesh(ros: Ros, place: Place) -> None:
    first, second = configured(place, "lab", "DampedPendulum"), configured(place, "other", "Gain")
    peer = ros.peer()
    leave = (DEACTIVATE, CLEANUP)
    with gateway(ros, config=first) as node:
        for _run in range(2):
            with launched(place, first):
                node.change(CONFIGURE, ACTIVATE)
                assert node.parameters() == ["unit.d", "unit.g", "unit.l"]
                assert "fixed Real in m" in node.description("unit.l")
                assert (
                    node.set("unit.l", 2.0)
                    == "'unit.l' is a fixed parameter; only tunable ones can be set while it runs"
                )
                ros.until(lambda: peer.count_publishers("/unit/a") == 1, "its topic")
                node.change(*leave)
                assert node.parameters() == []
                ros.until(lambda: not peer.count_publishers("/unit/a") + peer.count_publishers("/clock"), "no topic")
        assert node.set("config", str(second)) == ""
        with launched(place, second):
            node.change(CONFIGURE, ACTIVATE)
            assert node.parameters() == ["unit.k"]
            assert node.set("unit.k", 2.0) == ""
            ros.until(lambda: peer.count_publishers("/unit/y") == 1, "its topic")
            node.change(*leave)

        assert node.interrupted() == 0

    assert "rror" not in node.errors


def test_a_node_whose_run_has_ended_is_configured_for_the_next(ros: Ros, place: Place) -> None:
    config = configured(place, "lab", "Gain")
    with gateway(ros, config=config) as node:
        with launched(place, config):
            node.change(CONFIGURE, ACTIVATE)
        ros.until(lambda: node.state() == "inactive", "the end of the mesh")
        with launched(place, config):
            assert not node.succeeds(ACTIVATE)
            node.change(CLEANUP, CONFIGURE, ACTIVATE)

            assert node.interrupted() == 0

    assert "the run of mesh 'lab' for which this node was configured has ended. Clean the node up" in node.errors
    assert "Traceback" not in node.errors


def test_activated_in_middle_of_a_run_clock_never_tells_time_before_that(ros: Ros, place: Place) -> None:
    from rosgraph_msgs.msg import Clock  # noqa: PLC0415 only where ROS is installed

    config = configured(place, "lab", "Gain")
    _, messages = ros.collect(ros.peer(), Clock, "/clock")
    with gateway(ros, config=config) as node, launched(place, config):
        node.change(CONFIGURE)
        for _turn in range(2):
            node.change(ACTIVATE)
            enough = len(messages) + 10
            ros.until(partial(_more_than, messages, enough), "the time")
            node.change(DEACTIVATE)
        node.interrupted()

    times = [message.clock.sec * 10**9 + message.clock.nanosec for message in messages]
    assert times[0] > 0
    assert times == sorted(times)


def _more_than(messages: list[object], count: int) -> bool:
    return len(messages) > count


def test_autostart_waits_for_a_mesh_that_is_late_and_answers_meanwhile(ros: Ros, place: Place) -> None:
    config = configured(place, "lab", "Gain")
    with gateway(ros, config=config, autostart="true") as node:
        node.says("waiting up to 60 s (autostart_timeout) for mesh 'lab': no mesh is running here.")
        assert node.state() == "unconfigured"

        with launched(place, config):
            ros.until(lambda: node.state() == "active", "the mesh")
            assert node.interrupted() == 0

    assert "ERROR" not in node.errors


def test_autostart_gives_up_in_time_and_says_what_to_do_then(ros: Ros, place: Place) -> None:
    config = configured(place, "lab", "Gain")
    with gateway(ros, config=config, autostart="true", autostart_timeout="0.5") as node:
        node.says("mesh 'lab' did not come within 0.5 s (autostart_timeout): no mesh is running here.")
        node.says("`ros2 lifecycle set /own configure`, then `ros2 lifecycle set /own activate`")
        with launched(place, config):
            node.change(CONFIGURE, ACTIVATE)

            assert node.interrupted() == 0


def test_ctrl_c_ends_a_node_that_waits_for_its_mesh(ros: Ros, place: Place) -> None:
    with gateway(ros, config=configured(place, "lab", "Gain"), autostart="true") as node:
        node.says("waiting up to 60 s")

        assert node.interrupted() == 0

    assert "Traceback" not in node.errors


@pytest.mark.parametrize("own", ["gateway", "fmu"])
def test_who_else_publishes_the_clock_is_named_with_the_way_out(ros: Ros, place: Place, own: str) -> None:
    from rosgraph_msgs.msg import Clock  # noqa: PLC0415 only where ROS is installed

    config = configured(place, "lab", "Gain")
    parameters: dict[str, object] = {"config": config}
    if own == "fmu":
        parameters = {"fmu_path": FMUS / "Gain.fmu", "step_size": "0.01", "publish_clock": "true"}
    ros.peer("simulator", namespace="/other").create_publisher(Clock, "/clock", 10)
    with launched(place, config), gateway(ros, **parameters) as node:
        node.change(CONFIGURE, ACTIVATE)
        node.says("the node '/other/simulator' publishes /clock, too")
        node.says(
            {"gateway": "here: `clock_rate: null` in the section `ros`", "fmu": "here: publish_clock: false"}[own]
        )
        if own == "gateway":
            line = "the node '/other/simulator' publishes /clock, too"
            wait_until(lambda: line in place.run("status", "lab").output, "the same line of `status`")

        assert node.interrupted() == 0

    assert node.errors.count("publishes /clock, too") == 1
