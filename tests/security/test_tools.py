"""Every tool comes to a mesh behind TLS with a certificate: by an option, a variable or the note of the mesh."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Iterator
from typing import Any, Final

import pytest

import fmu_mesh
from fmu_mesh.errors import CallRefused
from tests.dashboards import Dashboard
from tests.foxglove_client import FoxgloveClient
from tests.helpers import DEADLINE_S, Launched, Place, rows_of, wait_until, write_config
from tests.ros.ros_peer import Ros, ros_or_skip

pytest.importorskip("cryptography")
from fmu_mesh.wire.security.authority import Authority

KEY: Final = "fmu_mesh/tools"
WAYS: Final = ("option", "variable", "note")
READS: Final = {
    "ls": r"tools +(running|paused)",
    "ls tools/gain": r"gain",
    "status": r"mesh +tools",
    "status gain": r"instance +gain",
    "info tools": r"simulation +0 s to 3600 s",
    "info gain": r"model +Gain",
    "get gain.y gain.k": r"tools/gain/param/k +",
    "watch gain.k --count 1": r"tools/gain/param/k +",
    "top --once": r"tools: (running|paused)",
    "logs": r"",
    "wait": r"mesh 'tools' is (running|paused)",
    "graph tools": r"tools: 1 instance in 1 process",
}
"""What each tool that only reads says of the mesh."""

ACTS: Final = {
    "set gain.k 2.5": (r"gain/set/@by/alice/k holds from point", "setting a value"),
    "pause": (r"is paused at point", "'pause'"),
    "step 3": (r"is paused at point", "'step'"),
    "resume": (r"is running", "'resume'"),
    "play bag.mcap --topic /gain/y=gain.u --start 0": (r"played \d+ values of /gain/y", "'pause'"),
}
"""What each tool that acts says to an operator, and of an observer; in an order that makes sense."""


@pytest.fixture(scope="module")
def place() -> Iterator[Place]:
    """A place with certificates, a bag, and a mesh behind TLS that runs."""
    with Place() as place:
        lab = Authority.made(place.folder / "lab")
        lab.add("host1", "node", 60.0, ["localhost", "127.0.0.1"])
        lab.add("alice", "operator", 60.0)
        lab.add("bob", "observer", 60.0)
        one = {"gain": {"fmu": "Gain"}}
        bag = write_config(
            place.folder, name="bag", instances=one, connections=[], stop_time=0.05, record={"file": "bag.mcap"}
        )
        assert place.run("launch", bag, "--no-progress").wait() == 0
        config = write_config(
            place.folder,
            name="tools",
            instances=one,
            connections=[],
            stop_time=3600.0,
            simulation={"real_time_factor": 1, "step_size": 0.01},
            zenoh={"listen": ["tls/127.0.0.1:0"]},
            security={"folder": "lab/host1"},
        )
        launched = place.start("launch", config, "--no-progress")
        wait_until(lambda: " at tls/" in launched.errors, "the mesh")
        yield place
        assert place.run("stop").wait() == 0
        assert launched.wait() == 130, launched.story()
        place.assert_nothing_left()


def asked(place: Place, command: str, way: str, who: str) -> Launched:
    """A tool that comes in one of the ways; only the note is in the runtime folder of the mesh."""
    endpoint, folder, own = place.note().endpoints[-1], f"{place.folder}/lab/{who}", dict[str, str]()
    words = command.split()
    if way != "note":
        own["FMU_MESH_RUNTIME_DIR"] = f"{place.folder}/other"
        words += ["--connect", endpoint]
    if way == "option":
        words += ["--security", folder]
    elif way == "variable":
        own["FMU_MESH_SECURITY"] = folder
    before, place.environment = place.environment, place.environment | own
    try:
        return place.start(*words)
    finally:
        place.environment = before


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("command", READS)
def test_a_tool_that_reads_needs_an_observer(place: Place, command: str, way: str) -> None:
    done = asked(place, command, way, "bob")

    assert done.wait() == 0, done.story()
    assert re.search(READS[command], done.output), done.story()


@pytest.mark.parametrize("way", WAYS)
def test_a_tool_that_acts_needs_an_operator(place: Place, way: str) -> None:
    for command, (words, what) in ACTS.items():
        refused = asked(place, command, way, "bob") if way != "note" else None
        done = asked(place, command, way, "alice")

        assert done.wait() == 0, done.story()
        assert re.search(words.replace("alice", "local") if way == "note" else words, done.output), done.story()
        if refused is not None:
            assert refused.wait() == 2
            assert refused.message == f"fmu-mesh: you are observer 'bob'; {what} needs operator."


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("who", ["alice", "bob"])
def test_foxglove_may_set_what_its_certificate_may(place: Place, who: str, way: str) -> None:
    served = asked(place, "foxglove tools --port 0 --steer", way, who)
    [url] = wait_until(lambda: re.findall(r"ws://127\.0\.0\.1:\d+/\?token=[^\s,]+", served.output)[:1], "the address")

    with FoxgloveClient(url) as client:
        client.subscribe("/gain/y")
        client.until(lambda: client.values("/gain/y"), "a value")
        if who == "alice" or way == "note":
            assert client.set(gain__k=4.0) == {"gain.k": 4.0}
        else:
            client.set(gain__k=4.0)
            client.until(lambda: "setting a value needs operator" in " ".join(client.statuses()), "the refusal")
    served.signal(signal.SIGINT)
    assert served.wait() == 130, served.story()


@pytest.mark.parametrize("who", ["alice", "bob"])
def test_the_dashboard_shows_a_mesh_behind_tls(place: Place, who: str) -> None:
    endpoint = place.note().endpoints[-1]
    dashboard = Dashboard(place, "--port", "0", "--connect", endpoint, "--security", f"lab/{who}")

    wait_until(lambda: any(dashboard.curves(KEY, 1, gain__y=0)["gain.y"][one] for one in ("tl", "th")), "a curve")

    dashboard.process.signal(signal.SIGINT)
    assert dashboard.process.wait() == 130, dashboard.process.story()


@pytest.mark.parametrize("by", ["option", "variable"])
def test_a_program_attaches_as_what_its_certificate_says(
    place: Place, monkeypatch: pytest.MonkeyPatch, by: str
) -> None:
    endpoint = place.note().endpoints[-1]
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", f"{place.folder}/other")
    for who in ("alice", "bob"):
        folder = place.folder / "lab" / who
        monkeypatch.setenv("FMU_MESH_SECURITY", str(folder) if by == "variable" else "")
        with fmu_mesh.attach("tools", connect=endpoint, security=folder if by == "option" else None) as run:
            assert next(iter(run.watch("gain.y"))).point >= 0
            if who == "alice":
                run.set("gain.k", 3.0)
                continue
            with pytest.raises(CallRefused, match="you are observer 'bob'; setting a value needs operator"):
                run.set("gain.k", 3.0)


@pytest.mark.parametrize("who", ["host1", "alice"])
def test_the_gateway_node_needs_the_role_of_a_node(
    place: Place, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], who: str
) -> None:
    ros_or_skip()
    from std_msgs.msg import Float64  # noqa: PLC0415  only where ROS is installed

    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", f"{place.folder}/other")
    monkeypatch.setenv("FMU_MESH_SECURITY", f"{place.folder}/lab/{who}")
    with Ros(place.folder / "log") as ros:
        node = ros.fmu(config=str(place.folder / "tools.yaml"), connect=[place.note().endpoints[-1]])
        peer = ros.peer()
        _, messages = ros.collect(peer, Float64, "/gain/y")
        publisher = peer.create_publisher(Float64, "/gain/u", 10)
        configured = str(node.trigger_configure())
        if who != "host1":
            assert "SUCCESS" not in configured
            assert "you are operator 'alice'; a gateway to ROS needs node" in capfd.readouterr().err
            return
        assert configured.endswith("SUCCESS")
        node.trigger_activate()
        ros.matched(publisher)

        ros.until(lambda: messages, "a value in ROS")

        def is_set() -> bool:
            publisher.publish(Float64(data=0.125))  # the other end may not know this one yet
            return asked_value(place) == 0.125

        ros.until(is_set, "the value from ROS")
        assert "ROS" in place.run("status").output


def asked_value(place: Place) -> float:
    """The input of the mesh."""
    return float(json.loads(place.run("get", "gain.u", "--json").output)["value"])


@pytest.mark.parametrize("process", [{}, {"cpu_time": 100.0}], ids=["one process", "processes"])
def test_a_sweep_and_a_rerun_leave_the_port_alone(place: Place, process: dict[str, Any]) -> None:
    config = write_config(
        place.folder,
        name="again",
        instances={"gain": {"fmu": "Gain"}},
        connections=[],
        stop_time=0.01,
        zenoh={"listen": [place.note().endpoints[-1].replace("127.0.0.1", "localhost")]},
        security={"folder": "lab/host1"},
        process=process,
    )
    own = place.folder / f"swept{len(process)}"

    swept = place.run("sweep", config, "--vary", "gain.u=1:2:2", "--folder", own, "--workers", "2", "--no-progress")
    refused = place.run("launch", config, "--no-progress")
    launched = place.run("launch", config, "--listen", "tls/localhost:0", "--no-progress")
    again = place.run("rerun", config.with_suffix(".csv"), "--no-progress")

    assert "2 of 2 runs, 0 failed" in swept.output, swept.story()
    assert refused.wait() == 2
    assert "another process does" in refused.message
    assert launched.wait() == 0, launched.story()
    assert "every value is that of" in again.output, again.story()
    assert rows_of(place.folder / "again.rerun.csv") == rows_of(config.with_suffix(".csv"))


def test_a_mesh_behind_a_router_is_noted_with_its_certificate(place: Place) -> None:
    router = place.start("router", "--listen", "tls/localhost:0", "--security", "lab/host1")
    there = wait_until(lambda: re.findall(r"tls/\S+", router.output)[:1], "the router")[0]
    port, runtime = there.rpartition(":")[2], f"{place.folder}/second"
    before, place.environment = place.environment, place.environment | {"FMU_MESH_RUNTIME_DIR": runtime}
    config = write_config(
        place.folder,
        name="far",
        instances={"gain": {"fmu": "Gain"}},
        connections=[],
        stop_time=3600.0,
        simulation={"real_time_factor": 1},
        zenoh={"mode": "client", "connect": [f"tls/localhost:{port}"]},
        security={"folder": "lab/host1"},
    )
    try:
        launched = place.start("launch", config, "--no-progress")
        assert place.run("wait", "--timeout", str(DEADLINE_S)).wait() == 0
        done = place.run("set", "gain.k", "3")
        assert "far/gain/set/@by/host1/k holds from point" in done.output, done.story()
        assert place.run("stop").wait() == 0
        assert launched.wait() == 130, launched.story()
    finally:
        place.environment = before
    router.signal(signal.SIGINT)
    assert router.wait() == 0
