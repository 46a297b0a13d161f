"""Whatever sets values in a mesh with security does it under its name, and each of them is one entry of the audit."""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, Final

import pytest

import fmu_mesh
from fmu_mesh.dashboard.mesh_follower import MeshFollower
from tests.foxglove_client import FoxgloveClient
from tests.helpers import FMUS, Place, free_port, wait_until, write_config
from tests.house import PACKAGE
from tests.ros.peers import Peer, need

pytest.importorskip("cryptography")
from fmu_mesh.wire.security.authority import Authority

_BY: Final = re.compile(r"fmu_mesh/pair/\w+/set/@by/(\w+)(/\w+)?")
_VALUES: Final = 50


@pytest.fixture
def endpoint(place: Place) -> Iterator[str]:
    """Where a mesh with security and topics of ROS runs, whose gateway reaches ROS through a router."""
    need("zenoh_ros2_sdk", "mcap", "rosbags", "foxglove")
    lab, port = Authority.made(place.folder / "lab"), free_port()
    lab.add("lab", "node", 60.0, ["localhost", "127.0.0.1"])
    lab.add("alice", "operator", 60.0)
    router = place.start("router", "--listen", f"tcp/127.0.0.1:{port}")
    wait_until(lambda: router.output, "the router")
    topics = [{"topic": "/speed", "variable": "topic.u"}]
    config = write_config(
        place.folder,
        instances={name: {"fmu": "Gain"} for name in WRITERS},
        connections=[],
        stop_time=3600.0,
        simulation={"real_time_factor": 1, "step_size": 0.01},
        zenoh={"listen": ["tls/127.0.0.1:0"]},
        security={"folder": "lab/lab"},
        ros={"profile": "rmw_zenoh", "domain": 7, "connect": [f"tcp/127.0.0.1:{port}"], "topics": topics},
    )
    (place.folder / "port").write_text(str(port))
    launched = place.start("launch", config, "--no-progress")
    yield launched.wait_for_error_line("mesh 'pair' at").rpartition(" at ")[2].strip()
    assert place.run("stop", "pair").wait() == 0
    launched.wait()


@contextmanager
def peer(place: Place, implementation: str, **orders: object) -> Iterator[Peer]:
    port = int((place.folder / "port").read_text())
    with Peer("rmw_zenoh_peer.py", implementation, {"port": port, "domain": 7, **orders}) as own:
        own.answer(0)
        yield own


def by_command(place: Place, endpoint: str) -> None:
    for value in range(_VALUES // 10):
        told = place.run("set", "command.u", str(value), "--connect", endpoint, "--security", "lab/alice")
        assert told.wait() == 0, told.story()


def by_program(place: Place, endpoint: str) -> None:
    with fmu_mesh.attach(connect=endpoint, security=place.folder / "lab/alice") as run:
        for value in range(_VALUES):
            run.set("program.u", float(value))


def by_page(place: Place, endpoint: str) -> None:
    follower = MeshFollower("fmu_mesh/pair", {"connect": endpoint, "security": place.folder / "lab/alice"})
    try:
        wait_until(lambda: follower.view.status, "the mesh")
        for value in range(_VALUES):
            follower.ask(partial(_set_one, float(value)))
    finally:
        follower.close()


def _set_one(value: float, run: fmu_mesh.Run) -> None:
    run.set("page.u", value)


def by_foxglove(place: Place, endpoint: str) -> None:
    how = ("--steer", "--port", "0", "--connect", endpoint, "--security", "lab/alice")
    served = place.start("foxglove", *how)
    find = re.compile(r"ws://127\.0\.0\.1:\d+/\?token=[^\s,]+")
    [url] = wait_until(lambda: find.findall(served.output)[:1], "the address of the server")
    with FoxgloveClient(url) as client:
        wait_until(lambda: "foxglove.u" in client.parameters(), "the mesh")
        for value in range(_VALUES):
            assert client.set(**{"foxglove.u": float(value)}) == {"foxglove.u": float(value)}


def by_bag(place: Place, endpoint: str) -> None:
    mesh = fmu_mesh.load(FMUS.parent / "configs/pendulum_delay.yaml")
    mesh.run(processes=False, stop_time=0.2, output=place.folder / "a.mcap")
    with fmu_mesh.attach(connect=endpoint, security=place.folder / "lab/alice") as run:
        start = run.status.time + 1.0
        run.play(place.folder / "a.mcap", topics=["/pendulum/a=bag.u"], start=start)
        run.resume()


def by_topic(place: Place, endpoint: str) -> None:
    with (
        peer(place, "sdk", subscribe={}, publish={"/speed": "std_msgs/msg/Float64"}, count=1) as own,
        fmu_mesh.attach(connect=endpoint, security=place.folder / "lab/alice") as run,
    ):
        for number in range(_VALUES):
            own.say(number=number)
        wait_until(lambda: run.get("topic.u") > 1.0, "values of a topic of ROS")


def by_parameter(place: Place, endpoint: str) -> None:
    assert endpoint
    with peer(place, "parameters", node="/pair") as own:
        for number in range(1, 6):
            own.say(order={"set": ["parameter.k", float(number)]})
            assert own.answer(number)["answer"] == [True, ""]


WRITERS: Final[dict[str, tuple[Callable[[Place, str], None], str]]] = {
    "command": (by_command, "alice"),
    "program": (by_program, "alice"),
    "page": (by_page, "alice"),
    "foxglove": (by_foxglove, "alice"),
    "bag": (by_bag, "alice"),
    "topic": (by_topic, "local"),
    "parameter": (by_parameter, "local"),
}
"""By the instance that they set: what sets it, and in whose name; the gateway is a part of the run."""


def test_every_writer_of_ours_sets_in_its_name_and_is_one_entry(place: Place, endpoint: str) -> None:
    for write, _ in WRITERS.values():
        write(place, endpoint)
    with fmu_mesh.attach(connect=endpoint, security=place.folder / "lab/alice") as run:
        entries = [own for own in run.audit().entries if own.what == "set"]
        warned = [line.message for line in run.logs() if line.category == "set"]

    found: dict[str, list[tuple[Any, ...]]] = {}
    for own in entries:
        match = _BY.fullmatch(own.key)
        assert match is not None, own
        assert own.last_time > own.time
        found.setdefault(own.text.partition(".")[0], []).append((match[1], own.number > 4))
    assert found == {name: [(who, True)] for name, (_, who) in WRITERS.items()}
    assert warned == []


_USERS: Final = {
    "node/answering.py": 1,  # takes what comes by the old keys, without security
    "node/streams.py": 1,  # publishes values
    "ros/gateway/gateway.py": 2,  # subscribes to values
    "ros/gateway/parameter_services.py": 1,  # asks for the value of a parameter
}
"""How often a module asks for the key of a value: on some of them values could be set before."""


def test_no_other_module_uses_the_keys_on_which_values_could_be_set() -> None:
    found: Counter[str] = Counter()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and re.search(r"(keys|names)\.variables?$", ast.unparse(node.func)):
                found[path.relative_to(PACKAGE).as_posix()] += 1

    assert found == _USERS
