"""Images and point clouds: `uint8[]` in messages, from Binary variables and arrays of UInt8, and back."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

import fmu_mesh
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.ros_wire.assembling import Assembler, Disassembler
from fmu_mesh.ros_wire.cdr import MAX_MESSAGE_SIZE, CdrError
from fmu_mesh.ros_wire.definitions import MessageTypes
from tests.helpers import Launched, Place, free_port, wait_until, write_config
from tests.planning import prepare
from tests.ros.peers import Peer, need
from tests.ros.ros_peer import Ros, ros_or_skip
from tests.ros.test_bag import messages_of
from tests.ros.test_gateway_messages import port, topic

IMAGE = "sensor_msgs/msg/Image"
CLOUD = "sensor_msgs/msg/PointCloud2"
DOMAIN = 7
MASK = bytes(range(250, 256)) + bytes(range(6))
POINTS = np.array([(1.5, -2.0), (3.25, 4.0)], "<f4").tobytes()

CAMERA = f"""
import fmu_mesh

class Camera(fmu_mesh.Component):
    image = fmu_mesh.Output(type="Binary")
    points = fmu_mesh.Output(type="UInt8", shape=16)
    levels = fmu_mesh.Output(type="UInt8", shape=4)
    mask = fmu_mesh.Input(type="Binary")
    grid = fmu_mesh.Input(type="UInt8", shape=4)

    def step(self, time, step_size):
        self.image = self.mask[::-1]
        self.points = list({POINTS!r})
        self.levels = self.grid[::-1]
"""

TOPICS: list[dict[str, Any]] = [
    {
        "topic": "/image",
        "type": IMAGE,
        "fields": {"data": "camera.image"},
        "constants": {"width": 4, "height": 3, "step": 4, "encoding": "mono8"},
        "frame_id": "lens",
    },
    {
        "topic": "/points",
        "type": CLOUD,
        "fields": {"data": "camera.points"},
        "constants": {
            "width": 2,
            "height": 1,
            "point_step": 8,
            "row_step": 16,
            "is_dense": True,
            **{
                f"fields[{at}].{key}": value
                for at, name in enumerate("xy")
                for key, value in {"name": name, "offset": 4 * at, "datatype": 7, "count": 1}.items()
            },
        },
        "frame_id": "lens",
    },
    {"topic": "/levels", "type": IMAGE, "fields": {"data": "camera.levels"}},
    {"topic": "/mask", "type": IMAGE, "fields": {"data": "camera.mask"}},
    {"topic": "/grid", "type": IMAGE, "fields": {"data": "camera.grid"}},
]


def camera(folder: Path, *topics: dict[str, Any], ros: dict[str, Any] | None = None, **sections: Any) -> Path:  # noqa: ANN401 what a file may hold
    (folder / "camera.py").write_text(CAMERA, encoding="utf-8")
    return write_config(
        folder,
        name="camera",
        instances={"camera": {"python": "camera.py:Camera"}},
        connections=(),
        ros={**(ros or {}), "topics": [*(topics or TOPICS)]},
        **{"simulation": {"step_size": 0.01}, **sections},
    )


def image_of(data: bytes) -> tuple[Any, bytes]:
    """An image, and its bytes as another library writes them."""
    store = get_typestore(Stores.ROS2_KILTED)
    header, time = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    own = store.types[IMAGE](
        header=header(stamp=time(sec=0, nanosec=0), frame_id=""),
        height=1,
        width=len(data),
        encoding="mono8",
        is_bigendian=0,
        step=len(data),
        data=np.frombuffer(data, np.uint8),
    )
    return own, bytes(store.serialize_cdr(own, IMAGE))


@pytest.mark.parametrize("data", [b"", MASK, bytes(3 * 1920 * 1080)], ids=["nothing", "a mask", "full HD"])
def test_binary_and_bytes_of_messages_are_equal_both_ways(data: bytes) -> None:
    types = MessageTypes("kilted")
    _, written = image_of(data)
    read = Disassembler(topic(IMAGE, port("data", kind="Binary"), direction="in"), types)

    assert read.values(written) == ([data], None)
    made = Assembler(topic(IMAGE, port("data", kind="Binary")), types).make([data], 0.0)
    image: Any = get_typestore(Stores.ROS2_KILTED).deserialize_cdr(made, IMAGE)
    assert image.data.tobytes() == data
    assert read.values(made)[0] == [data]


def test_message_that_is_too_large_for_others_is_not_made() -> None:
    assembler = Assembler(topic(IMAGE, port("data", kind="Binary")), MessageTypes("kilted"))

    with pytest.raises(CdrError, match="bytes are too many for a message"):
        assembler.make([bytes(MAX_MESSAGE_SIZE)], 0.0)


@pytest.mark.parametrize(
    ("message", "field", "variable"),
    [
        (IMAGE, "width", "image"),
        (IMAGE, "encoding", "image"),
        (IMAGE, "data[0]", "image"),
        ("std_msgs/msg/UInt16MultiArray", "data", "image"),
        ("std_msgs/msg/Int8MultiArray", "data", "image"),
        ("geometry_msgs/msg/PoseWithCovariance", "covariance", "mask"),
    ],
)
def test_other_fields_for_binary_are_refused(tmp_path: Path, message: str, field: str, variable: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        prepare(camera(tmp_path, {"topic": "/t", "type": message, "fields": {field: f"camera.{variable}"}}))

    assert f"'{field}' of '{message}' for 'camera.{variable}': only uint8[] holds a Binary" in str(caught.value)


def test_recorded_images_and_clouds_are_what_others_read(tmp_path: Path) -> None:
    variables = ["camera.image", "camera.points", "camera.mask"]
    scenario = {"values": {"camera.mask": {"times": [0.0, 0.02], "values": ["AQID", "BAU="]}}}
    config = camera(tmp_path, stop_time=0.05, record={"file": "camera.mcap", "variables": variables}, scenario=scenario)

    fmu_mesh.load(config).run(processes=False)

    messages = messages_of(tmp_path / "camera.mcap")
    images = [own for _, own in messages["/image"]]
    assert [bytes(own.data) for own in images] == [b"", b"\3\2\1", b"\3\2\1", *[b"\5\4"] * 3]
    first = images[1]
    assert (first.width, first.height, first.step, first.encoding) == (4, 3, 4, "mono8")
    assert (first.header.frame_id, first.header.stamp.nanosec) == ("lens", 10_000_000)
    cloud = messages["/points"][-1][1]
    assert [(own.name, own.offset, own.datatype, own.count) for own in cloud.fields] == [("x", 0, 7, 1), ("y", 4, 7, 1)]
    assert bytes(cloud.data) == POINTS
    assert (cloud.point_step, cloud.row_step, cloud.is_dense) == (8, 16, True)
    assert fmu_mesh.Result.read(tmp_path / "camera.mcap")["camera.image"].tolist() == [
        bytes(own.data) for own in images
    ]


@pytest.fixture
def ros(place: Place, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ros]:
    ros_or_skip()
    need("sensor_msgs")
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(place.folder / "run"))
    with Ros(place.folder / "log") as ros:
        yield ros


def test_images_flow_both_ways_in_real_ros(ros: Ros, place: Place) -> None:
    from sensor_msgs.msg import Image, PointCloud2  # noqa: PLC0415 only where ROS is installed

    config = camera(
        place.folder,
        ros={"profile": "rclpy"},
        stop_time=3600.0,
        simulation={"step_size": 0.01, "real_time_factor": 1.0},
    )
    place.start("launch", config)
    place.note()
    peer = ros.peer()
    pictures, images = ros.collect(peer, Image, "/image")
    scans, clouds = ros.collect(peer, PointCloud2, "/points")
    grids, levels = ros.collect(peer, Image, "/levels")
    masks, raster = peer.create_publisher(Image, "/mask", 10), peer.create_publisher(Image, "/grid", 10)
    node = ros.fmu(config=str(config))
    ros.until(lambda: str(node.trigger_configure()).endswith("SUCCESS"), "the mesh")
    node.trigger_activate()
    ros.matched(pictures, scans, grids, masks, raster)

    def turned() -> bool:
        masks.publish(Image(data=MASK))  # again: only one of the two ends may have found the other
        raster.publish(Image(data=[9, 8, 7, 255]))
        image = images and bytes(images[-1].data) == MASK[::-1]
        return bool(image and levels and list(levels[-1].data) == [255, 7, 8, 9])

    ros.until(turned, "the image and the levels")
    assert (images[-1].width, images[-1].encoding, images[-1].header.frame_id) == (4, "mono8", "lens")
    ros.until(lambda: clouds, "the point cloud")
    assert bytes(clouds[-1].data) == POINTS
    assert [own.name for own in clouds[-1].fields] == ["x", "y"]


def test_nodes_of_lyrical_and_a_mesh_exchange_images(place: Place) -> None:
    need("sensor_msgs", "xxhash")
    address = free_port()
    router = place.start("router", "--listen", f"tcp/127.0.0.1:{address}")
    wait_until(lambda: router.output, "the router")
    orders = {"port": address, "domain": DOMAIN, "subscribe": {"/image": IMAGE}, "publish": {"/mask": IMAGE}}
    config = camera(
        place.folder,
        ros={
            "profile": "rmw_zenoh",
            "domain": DOMAIN,
            "distribution": "kilted",
            "connect": [f"tcp/127.0.0.1:{address}"],
        },
        stop_time=3600.0,
        simulation={"step_size": 0.01, "real_time_factor": 1.0},
    )

    with Peer("rmw_zenoh_peer.py", "lyrical", orders | {"data": list(MASK)}) as peer:
        assert peer.answer(0)["declared"] == 2
        peer.say()
        assert peer.answer(1)["sent"] == {"/mask": "_buf_cpu"}, "there are no others, so it has its own key"
        launched = place.start("launch", config, "--no-progress")
        asked = iter(range(2, 1_000_000))

        def received() -> dict[str, Any] | None:
            number = next(asked)
            peer.say()
            answer = peer.answer(number)
            return answer if answer["received"].get("/image") == list(MASK[::-1]) else None

        answer = wait_until(received, "the image", 60.0)
        assert answer["sent"] == {"/mask": "usual"}
        status = place.run("status", "camera", "--json")
        assert status.wait() == 0, status.errors
        [view] = json.loads(status.output)["ros"]
        there = {own["topic"]: own["matched"] for own in view["topics"]}
    stop(launched, router)

    assert there == {**there, "/image": True, "/mask": True, "/points": False, "/grid": False}
    assert "refused" not in launched.errors, launched.errors


def stop(launched: Launched, router: Launched) -> None:
    launched.signal(signal.SIGINT)
    launched.wait()
    router.signal(signal.SIGTERM)
    router.wait()
