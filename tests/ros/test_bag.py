"""Recording into MCAP and playing a bag: what is in the file, read by others, and what comes of it as input."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fmu_mesh
from fmu_mesh.cli.main import main
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.ros.bags.bag import Bag, BagSample
from fmu_mesh.ros.bags.playing import Played, schedule
from fmu_mesh.ros_wire.cdr import Codec
from fmu_mesh.ros_wire.definitions import MessageTypes
from fmu_mesh.ros_wire.topics import Port, Topic
from fmu_mesh.simtime import ENDLESS, TimeGrid
from fmu_mesh.variables.model_description import Variable
from tests.fmus.helpers import find_fmu
from tests.helpers import FMUS, Launched, Place, rows_of, wait_until, write_config

pytest.importorskip("mcap", reason="the package mcap is not installed; pip install '.[test]'")

MS = 1_000_000
ARRAY = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
TWIST = {
    "topics": [
        {
            "topic": "/state",
            "type": "geometry_msgs/msg/TwistStamped",
            "fields": {"twist.linear.x": "pendulum.a", "twist.angular.z": "delay.y"},
            "frame_id": "base",
        },
        "pendulum.der(a)",
    ],
    "clock_rate": 50.0,
}


def messages_of(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """What an independent reader finds in an MCAP: (log time in ns, message) by topic."""
    from mcap.reader import make_reader  # noqa: PLC0415 an optional dependency
    from mcap_ros2.decoder import DecoderFactory  # noqa: PLC0415 as above

    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        for _, channel, message, decoded in make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            assert message.publish_time == message.log_time
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


def bytes_of(path: Path) -> list[tuple[str, int, bytes]]:
    from mcap.reader import make_reader  # noqa: PLC0415 an optional dependency

    with path.open("rb") as file:
        return [
            (channel.topic, message.log_time, message.data) for _, channel, message in make_reader(file).iter_messages()
        ]


def run(*arguments: str | Path) -> None:
    assert main([str(argument) for argument in arguments]) == 0


# ---- recording ----


def test_an_mcap_has_the_floats_of_csv_at_times_of_their_points(tmp_path: Path) -> None:
    config = write_config(tmp_path, stop_time=0.5, simulation={"step_size": 0.002})
    run("launch", config, "--local", "--no-progress")
    run("launch", config, "--local", "--no-progress", "--output", tmp_path / "pair.mcap")

    found = messages_of(tmp_path / "pair.mcap")

    rows = rows_of(tmp_path / "pair.csv")
    topics = ["/pendulum/a", "/pendulum/der_a_", "/pendulum/der_a_2_", "/delay/y"]
    assert sorted(found) == sorted([*topics, "/clock"])
    for column, topic in enumerate(topics, start=1):
        assert [message.data for _, message in found[topic]] == [row[column] for row in rows], topic
        assert [stamp for stamp, _ in found[topic]] == [k * 2 * MS for k in range(251)]
    assert [stamp for stamp, _ in found["/clock"]] == [k * 10 * MS for k in range(51)]
    assert all(m.clock.sec * 1_000_000_000 + m.clock.nanosec == stamp for stamp, m in found["/clock"])


def test_real_processes_record_the_messages_of_one_process(place: Place) -> None:
    config = write_config(place.folder, stop_time=0.5, record={"file": "pair.mcap"}, ros=TWIST)
    local = place.run("launch", config, "--local", "--output", place.folder / "local.mcap")
    distributed = place.run("launch", config)

    assert (local.wait(), distributed.wait()) == (0, 0), (local.errors, distributed.errors)
    assert "pair.mcap (501 rows)" in distributed.output
    assert bytes_of(place.folder / "pair.mcap") == bytes_of(place.folder / "local.mcap")


def test_a_topic_of_the_ros_section_is_recorded_with_simulation_time(tmp_path: Path) -> None:
    config = write_config(tmp_path, stop_time=0.1, ros=TWIST)
    run("launch", config, "--local", "--no-progress")
    run("launch", config, "--local", "--no-progress", "--output", tmp_path / "pair.mcap")

    found = messages_of(tmp_path / "pair.mcap")

    rows = rows_of(tmp_path / "pair.csv")
    # `der(a,2)` has no topic in the section, and so the one that it has by default.
    assert sorted(found) == ["/clock", "/pendulum/der_a_", "/pendulum/der_a_2_", "/state"]
    states = found["/state"]
    assert [(m.twist.linear.x, m.twist.angular.z) for _, m in states] == [(row[1], row[4]) for row in rows]
    assert [m.header.stamp.sec * 1_000_000_000 + m.header.stamp.nanosec for _, m in states] == [s for s, _ in states]
    assert {m.header.frame_id for _, m in states} == {"base"}
    assert len(found["/clock"]) == 6


def test_an_instance_with_larger_steps_has_messages_at_its_own_points_only(tmp_path: Path) -> None:
    instances: dict[str, dict[str, Any]] = {"fast": {"fmu": "Gain"}, "slow": {"fmu": "Gain", "step_size": 0.004}}
    record = {"file": "pair.mcap"}
    config = write_config(
        tmp_path, stop_time=0.02, instances=instances, connections=("fast.y -> slow.u",), record=record
    )

    run("launch", config, "--local", "--no-progress")

    found = messages_of(tmp_path / "pair.mcap")
    assert [stamp // MS for stamp, _ in found["/slow/y"]] == [0, 4, 8, 12, 16, 20]
    assert [stamp // MS for stamp, _ in found["/fast/y"]] == list(range(21))


def test_an_array_is_one_message_with_its_dimensions(tmp_path: Path) -> None:
    instances = {"all": {"fmu": str(find_fmu("AllTypes3", tmp_path)), "start_values": {"float64_array_in": ARRAY}}}
    record = {"file": "pair.mcap", "variables": ["all.float64_array_out"]}
    config = write_config(tmp_path, stop_time=0.003, instances=instances, connections=(), record=record)

    run("launch", config, "--local", "--no-progress")

    found = messages_of(tmp_path / "pair.mcap")
    arrays = [message for _, message in found["/all/float64_array_out"]]
    assert [list(message.data) for message in arrays][1:] == [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]] * 3
    assert [(own.size, own.stride) for own in arrays[0].layout.dim] == [(2, 6), (3, 3)]


def test_the_schemas_and_channels_are_those_of_ros2_bag(tmp_path: Path) -> None:
    from mcap.reader import make_reader  # noqa: PLC0415 an optional dependency
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 an optional dependency

    config = write_config(tmp_path, stop_time=0.01, record={"file": "pair.mcap"}, ros=TWIST)
    run("launch", config, "--local", "--no-progress")

    with (tmp_path / "pair.mcap").open("rb") as file:
        reader = make_reader(file)
        header, summary = reader.get_header(), reader.get_summary()

    assert summary is not None
    assert header.profile == "ros2"
    store = get_typestore(Stores.ROS2_JAZZY)
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        assert (channel.message_encoding, schema.encoding) == ("cdr", "ros2msg")
        assert channel.metadata["topic_type_hash"] == store.hash_rihs01(schema.name)
        assert "reliability: reliable" in channel.metadata["offered_qos_profiles"]


def test_the_messages_are_read_by_ros_itself(tmp_path: Path) -> None:
    from tests.ros.ros_peer import ros_or_skip  # noqa: PLC0415 only this test needs it

    ros_or_skip()
    from geometry_msgs.msg import TwistStamped  # noqa: PLC0415 only where ROS is installed
    from rclpy.serialization import deserialize_message  # noqa: PLC0415 as above

    config = write_config(tmp_path, stop_time=0.01, ros=TWIST)
    run("launch", config, "--local", "--no-progress")
    run("launch", config, "--local", "--no-progress", "--output", tmp_path / "pair.mcap")

    states = [
        deserialize_message(data, TwistStamped)
        for topic, _, data in bytes_of(tmp_path / "pair.mcap")
        if topic == "/state"
    ]

    rows = rows_of(tmp_path / "pair.csv")
    assert [(m.twist.linear.x, m.twist.angular.z) for m in states] == [(row[1], row[4]) for row in rows]


@pytest.mark.parametrize(
    ("sections", "complaint"),
    [
        ({"simulation": {"start_time": -1.0}}, "an MCAP of times before 0"),
        ({"instances": {"1a": {"fmu": "Gain"}}, "connections": ()}, "1a"),
    ],
)
def test_what_an_mcap_cannot_hold_is_told_by_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], sections: dict[str, Any], complaint: str
) -> None:
    config = write_config(tmp_path, stop_time=1.0, record={"file": "pair.mcap"}, **sections)

    assert main(["check", str(config)]) == 2

    assert complaint in capsys.readouterr().err


def test_a_missing_package_is_told_by_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mcap.writer", None)

    assert main(["check", str(write_config(tmp_path, record={"file": "pair.mcap"}))]) == 2

    assert "recordings into .mcap need the library mcap" in capsys.readouterr().err


def test_what_is_no_recording_of_a_mesh_is_not_plotted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.mcap").touch()

    assert main(["plot", str(tmp_path / "x.mcap")]) == 2

    assert "x.mcap' is no result file: it does not begin as an MCAP does" in capsys.readouterr().err


# ---- playing ----


GRID = TimeGrid(0.0, 0.01, 100)


def at(ms: float, value: float, instance: str = "gain") -> BagSample:
    return BagSample(round(ms * MS), instance, "u", value)


@pytest.mark.parametrize(
    ("samples", "points"),
    [
        ([at(0, 1.0), at(10, 2.0), at(20, 3.0)], {0: 1.0, 1: 2.0, 2: 3.0}),
        ([at(20, 3.0), at(0, 1.0)], {0: 1.0, 2: 3.0}),
        ([at(10.000001, 1.0), at(19.999999, 2.0)], {1: 1.0, 2: 2.0}),
        ([at(10.1, 1.0)], {2: 1.0}),
        ([at(5, 1.0), at(7, 2.0), at(10, 3.0)], {1: 3.0}),
        ([at(990, 1.0), at(1000, 2.0), at(5000, 2.0)], {99: 1.0}),
    ],
    ids=["on points", "in any order", "a nanosecond off", "between points", "the last of one point", "after the end"],
)
def test_a_sample_holds_from_first_point_that_is_not_before_its_stamp(
    samples: list[BagSample], points: dict[int, float]
) -> None:
    moments, merged, beyond = schedule(samples, GRID, {"gain": 1}, start=None)

    assert {moment.point: moment.values["gain", "u"] for moment in moments} == points
    assert len(moments) + merged + beyond == len(samples)


@pytest.mark.parametrize(("point", "played"), [(0, 1), (2 * 10**8, 5)])
def test_a_mesh_without_stop_time_has_no_unix_times(point: int, played: int) -> None:
    """At point 2e8 of 10 ms, two million seconds are nearly over."""
    grid = TimeGrid(0.0, 0.01, ENDLESS)
    samples = [BagSample(round(time * 1e9), "gain", "u", 1.0) for time in (5.0, 1.1e6, 1.5e6, 2e6, 2.9e6, 1.7e9)]

    moments, _, beyond = schedule(samples, grid, {"gain": 1}, start=None, point=point)

    assert (len(moments), beyond) == (played, 6 - played)


def test_stamps_of_another_clock_are_moved_to_begin_at_the_start() -> None:
    samples = [BagSample(1_700_000_000_000_000_000 + k * 10 * MS, "gain", "u", float(k)) for k in range(5)]

    moments, _, _ = schedule(samples, GRID, {"gain": 1}, start=0.02)

    assert [(moment.point, moment.values["gain", "u"]) for moment in moments] == [(2 + k, float(k)) for k in range(5)]


def test_an_instance_with_larger_steps_is_given_value_at_its_own_points() -> None:
    moments, merged, _ = schedule([at(10, 1.0), at(20, 2.0), at(50, 3.0)], GRID, {"gain": 4}, start=None)

    assert ([(m.point, m.values["gain", "u"]) for m in moments], merged) == ([(4, 2.0), (8, 3.0)], 1)


@pytest.fixture
def delay(place: Place) -> tuple[Place, Path, Launched]:
    """A mesh of the delay alone that rests at its first point."""
    instances = {"delay": {"fmu": "TransportDelay", "start_values": {"d": 0.1, "x": 1.5}}}
    config = write_config(place.folder, instances=instances, connections=(), name="played", stop_time=0.4)
    launched = place.start("launch", config, "--paused")
    place.note()
    return place, config, launched


def test_a_recorded_output_as_input_gives_every_float_of_the_connection(delay: tuple[Place, Path, Launched]) -> None:
    place, _, launched = delay
    jacobi = {"algorithm": "jacobi"}
    coupled = write_config(place.folder, name="coupled", simulation=jacobi, stop_time=0.4)
    assert place.run("launch", coupled, "--local").wait() == 0
    assert place.run("launch", coupled, "--local", "--output", place.folder / "a.mcap").wait() == 0

    played = place.run("play", place.folder / "a.mcap", "--topic", "/pendulum/a=delay.x")
    launched.wait()

    assert (played.wait(), launched.wait()) == (0, 0), (played.errors, launched.errors)
    assert "played 400 values of /pendulum/a from point 0 to point 399" in played.output
    assert "1 values are at or after the end" in played.output
    names = [row[4] for row in rows_of(place.folder / "coupled.csv")]
    assert [row[1] for row in rows_of(place.folder / "played.csv")] == names


def test_a_program_plays_a_bag_to_a_mesh_that_it_started(tmp_path: Path) -> None:
    coupled = fmu_mesh.load(FMUS.parent / "configs/pendulum_delay.yaml")
    coupled.configure(simulation={"algorithm": "jacobi", "stop_time": 0.4})
    delay = {"delay.d": 0.1}
    expected = coupled.run(processes=False, record="memory", start_values=delay)["delay.y"]
    coupled.run(processes=False, output=tmp_path / "a.mcap")
    mesh = fmu_mesh.Mesh("played", step_size=0.002, stop_time=0.4)
    mesh.add("delay", fmu=FMUS / "TransportDelay.fmu", start_values={"d": 0.1, "x": 1.3})
    mesh.record("delay.y")

    with mesh.start(paused=True, record="memory") as run:
        played = run.play(tmp_path / "a.mcap", topics=["/pendulum/a=delay.x"])
        found = run.wait()["delay.y"]

    assert played == Played(200, ["/pendulum/a"], first=0, last=199, merged=0, past=0, beyond=1)
    np.testing.assert_array_equal(found, expected)


def test_a_bag_of_ros2_with_headers_is_played_by_their_stamps(delay: tuple[Place, Path, Launched]) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: PLC0415 an optional dependency
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 an optional dependency

    place, _, launched = delay
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    name = "geometry_msgs/msg/TwistStamped"
    zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    bag = place.folder / "drive"
    with Writer(bag, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/vel_des", name, typestore=store)
        for k in range(5):
            stamp = types["builtin_interfaces/msg/Time"](sec=1_700_000_000, nanosec=k * 50 * MS)
            twist = types["geometry_msgs/msg/Twist"](types["geometry_msgs/msg/Vector3"](float(k), 0.0, 0.0), zero)
            message = types[name](types["std_msgs/msg/Header"](stamp, "base"), twist)
            # It was recorded late, each message by another time.
            logged = 1_700_000_100_000_000_000 + k * k * 1000 * MS
            writer.write(connection, logged, store.serialize_cdr(message, name))

    early = place.run("play", bag, "--topic", "vel_des:twist.linear.x=delay.x")
    played = place.run("play", bag, "--topic", "vel_des:twist.linear.x=delay.x", "--start", "0.0")
    launched.wait()

    assert (early.wait(), played.wait(), launched.wait()) == (2, 0, 0), (early.errors, played.errors, launched.errors)
    assert "Say when the first one is, as with `--start 0`" in early.errors
    rows = rows_of(place.folder / "played.csv")
    # The delay of 100 ms shows each of the values 100 ms after its stamp.
    assert [rows[k][1] for k in (140, 190, 240, 290, 340)] == [0.0, 1.0, 2.0, 3.0, 4.0]


def test_what_cannot_be_played_is_told(
    delay: tuple[Place, Path, Launched], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    place, _, _ = delay
    bag = place.folder / "a.mcap"
    config = write_config(place.folder, name="coupled", stop_time=0.01)
    run("launch", config, "--local", "--no-progress", "--output", bag)
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(place.folder / "run"))
    wait_until(lambda: main(["status", "played"]) == 0, "the mesh")
    cases = [
        (["no.mcap"], "the bag 'no.mcap' does not exist"),
        ([str(bag)], f"no topic of '{bag}' is one that the mesh subscribes to"),
        ([str(bag), "--topic", "/pendulum/b=delay.x"], "Did you mean '/pendulum/a'?"),
        ([str(bag), "--topic", "/pendulum/a=delay.z"], "the unknown variable 'z' of instance 'delay'"),
        ([str(bag), "--topic", "/pendulum/a:date=delay.x"], "has no field 'date'"),
        ([str(bag), "--topic", "nothing"], "expected TOPIC=INSTANCE.VARIABLE"),
    ]
    capsys.readouterr()

    said = {complaint: (main(["play", *arguments]), capsys.readouterr().err) for arguments, complaint in cases}

    for complaint, (code, error) in said.items():
        assert code == 2, error
        assert complaint in error


WHEEL = "builtin_interfaces/Time stamp\nfloat64 speed\n"
WHEEL_IDL = f"""{"=" * 80}
IDL: lab_msgs/msg/Wheel
module lab_msgs {{ module msg {{ struct Wheel {{ builtin_interfaces::msg::Time stamp; double speed; }}; }}; }};
{"=" * 80}
IDL: builtin_interfaces/msg/Time
module builtin_interfaces {{ module msg {{ struct Time {{ long sec; unsigned long nanosec; }}; }}; }};
"""


@pytest.mark.parametrize("definition", [WHEEL, WHEEL_IDL], ids=["msg", "idl"])
def test_messages_are_read_by_the_definitions_in_the_bag_without_running_them(definition: str, tmp_path: Path) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: PLC0415 an optional dependency

    types = MessageTypes(custom={"lab_msgs/msg/Wheel": WHEEL})
    message = {"stamp": {"sec": 1, "nanosec": 2}, "speed": 0.5}
    with Writer(tmp_path / "wheel", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection(
            "/wheel",
            "lab_msgs/msg/Wheel",
            msgdef=definition,
            rihs01=types.type_hash("lab_msgs/msg/Wheel"),
        )
        writer.write(connection, 7, Codec(types, "lab_msgs/msg/Wheel").encode(message))
    variable = Variable("u", 0, "Float64", "input", "continuous")
    topic = Topic("/wheel", "lab_msgs/msg/Wheel", "in", (Port("speed", "gain", variable, "in"),))
    sys.modules.pop("rosbags.usertypes", None)  # what rosbags makes of definitions that it registers

    with Bag(tmp_path / "wheel") as bag:
        found = list(bag.samples([topic], "header"))

    assert found == [BagSample(7, "gain", "u", 0.5)]
    assert "rosbags.usertypes" not in sys.modules


# ---- a bag in a scenario ----


@pytest.mark.parametrize("start", [None, 0.013])
@pytest.mark.parametrize("step_size", [0.001, 0.003], ids=["each step", "larger steps"])
def test_bag_in_scenario_gives_floats_of_playing_it_into_mesh_paused(
    start: float | None, step_size: float, tmp_path: Path
) -> None:
    """The messages of the bag come every 2 ms, with stamps of simulation time from 0 s on."""
    pytest.importorskip("rosbags", reason="the package rosbags is not installed; pip install '.[test]'")
    coupled = fmu_mesh.load(FMUS.parent / "configs/pendulum_delay.yaml")
    coupled.configure(simulation={"stop_time": 0.2})
    coupled.run(processes=False, output=tmp_path / "a.mcap")

    def mesh() -> fmu_mesh.Mesh:
        made = fmu_mesh.Mesh("played", step_size=0.001, stop_time=0.3)
        made.add("gain", fmu=FMUS / "Gain.fmu", start_values={"u": 0.25}, step_size=step_size)
        return made

    with mesh().start(paused=True, record="memory") as run:
        run.play(tmp_path / "a.mcap", topics=["/pendulum/a=gain.u"], start=start)
        played = run.wait()["gain.y"]
    steered = mesh()
    more = {"start": start} if start is not None else {}
    steered.scenario({"gain.u": {"file": tmp_path / "a.mcap", "topic": "/pendulum/a", **more}})

    assert steered.run(record="memory")["gain.y"].tobytes() == played.tobytes()
    assert steered.run(record="memory", processes=False)["gain.y"].tobytes() == played.tobytes()
    assert len(set(played.tolist())) > 50


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"topic": "/pendulum/b"}, "the unknown topic '/pendulum/b' of"),
        ({"topic": "/pendulum/a:twist"}, "gain.u.topic: 'std_msgs/msg/Float64' has no field 'twist'"),
        ({"topic": "/pendulum/a", "column": "a"}, "'column' for a bag"),
        ({}, "values.gain.u.topic: missing"),
    ],
)
def test_what_cannot_come_from_a_bag_is_a_finding(given: dict[str, str], expected: str, tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="the package rosbags is not installed; pip install '.[test]'")
    coupled = fmu_mesh.load(FMUS.parent / "configs/pendulum_delay.yaml")
    coupled.run(processes=False, stop_time=0.01, output=tmp_path / "a.mcap")
    mesh = fmu_mesh.Mesh("played", step_size=0.001, stop_time=0.3)
    mesh.add("gain", fmu=FMUS / "Gain.fmu")
    mesh.scenario({"gain.u": {"file": tmp_path / "a.mcap", **given}})

    [found] = mesh.check().findings

    assert expected in str(found)


def two_gains(folder: Path) -> fmu_mesh.Mesh:
    """Two gains, and `a.mcap` with the messages of a pendulum."""
    pytest.importorskip("rosbags", reason="the package rosbags is not installed; pip install 'fmu-mesh[test]'")
    coupled = fmu_mesh.load(FMUS.parent / "configs/pendulum_delay.yaml")
    coupled.run(processes=False, stop_time=0.02, output=folder / "a.mcap")
    mesh = fmu_mesh.Mesh("played", step_size=0.002, stop_time=0.02)
    mesh.add("first", fmu=FMUS / "Gain.fmu")
    mesh.add("second", fmu=FMUS / "Gain.fmu")
    return mesh


def test_one_topic_of_a_bag_goes_to_several_inputs(tmp_path: Path) -> None:
    mesh, file = two_gains(tmp_path), tmp_path / "a.mcap"

    with mesh.start(paused=True, record="memory") as run:
        run.play(file, topics=["/pendulum/a=first.u", "/pendulum/a=second.u"])
        played = run.wait()
    mesh.scenario({f"{name}.u": {"file": file, "topic": "/pendulum/a"} for name in ("first", "second")})
    prescribed = mesh.run(processes=False, record="memory")

    for result in (played, prescribed):
        assert result["first.y"].tolist() == result["second.y"].tolist() == played["first.y"].tolist()
        assert len(set(result["first.y"].tolist())) > 5


def test_each_wrong_entry_of_one_bag_is_told_at_its_place(tmp_path: Path) -> None:
    mesh = two_gains(tmp_path)
    mesh.scenario({f"{n}.u": {"file": tmp_path / "a.mcap", "topic": f"/pendulum/a:{n}"} for n in ("first", "second")})

    findings = mesh.check().findings

    assert [(one.path, one.found.rpartition(" has no ")[2].partition(",")[0]) for one in findings] == [
        ("scenario.values.first.u.topic", "field 'first'"),
        ("scenario.values.second.u.topic", "field 'second'"),
    ]


def test_joints_of_a_bag_are_recorded_and_played_by_their_names(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="the package rosbags is not installed; pip install 'fmu-mesh[test]'")
    file = tmp_path / "arm.mcap"
    coupled = fmu_mesh.load(FMUS.parent / "configs/pendulum_delay.yaml")
    fields = {"position[name=rod]": "pendulum.a", "position[name='late [1]']": "delay.y"}
    states = {"topic": "/joint_states", "type": "sensor_msgs/msg/JointState", "fields": fields}
    coupled.configure(ros={"topics": [states]}, simulation={"stop_time": 0.02})
    expected = coupled.run(processes=False, record="memory")
    coupled.run(processes=False, output=file)
    mesh = fmu_mesh.Mesh("played", step_size=0.002, stop_time=0.02)
    mesh.add("rod", fmu=FMUS / "Gain.fmu")
    mesh.add("other", fmu=FMUS / "Gain.fmu", start_values={"u": 0.25})

    with mesh.start(paused=True, record="memory") as run:
        run.play(file, topics=["/joint_states:position[name=rod]=rod.u"])
        played = run.wait()
    mesh.scenario({"rod.u": {"file": file, "topic": "/joint_states:position[name=rod]"}})
    prescribed = mesh.run(processes=False, record="memory")
    read = fmu_mesh.Result.read(file)

    assert [own.name for _, own in messages_of(file)["/joint_states"]] == [["rod", "late [1]"]] * 11
    for name in ("pendulum.a", "delay.y"):
        np.testing.assert_array_equal(read[name], expected[name])
    for result in (played, prescribed):
        np.testing.assert_array_equal(result["rod.y"][1:], expected["pendulum.a"][:-1])
        assert set(result["other.y"].tolist()[1:]) == {0.25}


@pytest.mark.parametrize(
    ("choice", "says"),
    [
        ("/joint_states:position[name=none]=rod.u", "no message of /joint_states in"),
        ("/joint_states:position[nam=rod]=rod.u", "'nam' is no text that tells its elements apart"),
    ],
)
def test_joint_that_a_bag_lacks_is_told(choice: str, says: str, tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="the package rosbags is not installed; pip install 'fmu-mesh[test]'")
    coupled = fmu_mesh.load(FMUS.parent / "configs/pendulum_delay.yaml")
    states = {
        "topic": "/joint_states",
        "type": "sensor_msgs/msg/JointState",
        "fields": {"position[name=rod]": "pendulum.a"},
    }
    coupled.configure(ros={"topics": [states]}, simulation={"stop_time": 0.02})
    coupled.run(processes=False, output=tmp_path / "arm.mcap")
    mesh = fmu_mesh.Mesh("played", step_size=0.002, stop_time=0.02)
    mesh.add("rod", fmu=FMUS / "Gain.fmu")

    with mesh.start(paused=True, record="memory") as run, pytest.raises(ConfigurationError, match=re.escape(says)):
        run.play(tmp_path / "arm.mcap", topics=[choice])
