"""`foxglove` shows a running mesh to clients that speak the protocol of Foxglove."""

from __future__ import annotations

import csv
import json
import re
import signal
from pathlib import Path
from urllib.parse import urlsplit

import psutil
import pytest
from websockets.exceptions import InvalidHandshake
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from fmu_mesh.cli.main import main
from fmu_mesh.foxglove import relay
from tests.foxglove_client import FoxgloveClient
from tests.helpers import DEADLINE_S, Launched, Place, assert_readable, rows_of, wait_until, write_config

TALKER = """
import fmu_mesh

class Talker(fmu_mesh.Component):
    text = fmu_mesh.Output(type="String")
    number = fmu_mesh.Output()

    def step(self, time, step_size):
        self.number += 1.0
        self.text = "x" * 10_000
"""


def start(place: Place, *arguments: str | Path) -> tuple[Launched, str]:
    """Start the command at a free port; returns it with the address of the server."""
    served = place.start("foxglove", *arguments, "--port", "0")
    [url] = wait_until(
        lambda: re.findall(r"ws://127\.0\.0\.1:\d+/\?token=[^\s,]+", served.output)[:1], "the address of the server"
    )
    return served, url


def paced(place: Place, **simulation: float) -> Path:
    """A pendulum and a delay in real time."""
    return write_config(
        place.folder, stop_time=3600.0, simulation={"real_time_factor": 1.0, "step_size": 0.01, **simulation}
    )


def gains(place: Place) -> Path:
    """A gain that feeds another one, in real time."""
    return write_config(
        place.folder,
        instances={"first": {"fmu": "Gain"}, "second": {"fmu": "Gain"}},
        connections=["first.y -> second.u"],
        stop_time=3600.0,
        simulation={"real_time_factor": 1.0, "step_size": 0.01},
    )


def test_values_are_the_recorded_ones_at_their_simulation_times(place: Place) -> None:
    mesh = place.start("launch", paced(place), "--no-progress")
    _, url = start(place, "pair")

    with FoxgloveClient(url) as client:
        client.subscribe("/pendulum/a", "/delay/y", "/mesh/status")
        client.until(lambda: min(len(client.messages[topic]) for topic in ("/pendulum/a", "/delay/y")) >= 20, "values")
        place.run("stop", "pair")
        client.until(client.ended, "the end")

    assert mesh.wait() == 130
    rows = rows_of(place.folder / "pair.csv")
    header = next(csv.reader((place.folder / "pair.csv").read_text().splitlines()))
    for topic, name in (("/pendulum/a", "pendulum.a"), ("/delay/y", "delay.y")):
        column = header.index(name)
        shown = [value for value in client.values(topic) if value[1] < len(rows)]  # a node may be ahead of the stop
        assert len(shown) >= 20
        assert shown == [(round(rows[point][0] * 1e9), point, rows[point][column]) for _, point, _ in shown]
        points = [point for _, point, _ in shown]
        assert points == list(range(points[0], points[0] + len(points)))
    assert client.times == sorted(client.times)
    assert client.messages["/mesh/status"]


def test_a_channel_says_what_its_variable_is(place: Place) -> None:
    place.start("launch", paced(place), "--no-progress")
    _, url = start(place, "pair", "--variables", "pendulum.*", "delay.y")

    with FoxgloveClient(url) as client:
        client.until(lambda: "/delay/y" in client.channels, "the topics")

        angle = client.channels["/pendulum/a"]
        schema = json.loads(angle["schema"])
        assert (angle["encoding"], angle["schemaEncoding"], schema["title"]) == ("json", "jsonschema", "pendulum.a")
        assert schema["properties"]["value"] == {
            "type": "number",
            "description": "Angle from the lower rest position in rad",
        }
        assert angle["metadata"]["unit"] == "rad"
        assert "/pendulum/d" in client.channels
        assert [topic for topic in client.channels if topic.startswith("/delay/")] == ["/delay/y"]


def test_parameters_are_those_that_can_be_set_and_setting_them_changes_mesh(place: Place) -> None:
    place.start("launch", gains(place), "--no-progress")
    _, url = start(place, "pair", "--steer")

    with FoxgloveClient(url) as client, FoxgloveClient(url) as other:
        other.subscribe("/second/y")
        client.subscribe("/second/y")
        before = client.parameters()
        other.send(op="subscribeParameterUpdates", parameterNames=["first.u", "second.k"])
        answer = client.set(first__u=3, second__k=2.0)
        client.until(lambda: client.value("/second/y") == 6.0, "the values that were set")
        other.until(lambda: other.value("/second/y") == 6.0, "the values that were set")
        place.run("set", "second.k", "4")
        other.until(lambda: other.updated().get("second.k") == 4.0, "what another program set")
        client.set(second__u=1.0)
        client.until(lambda: [text for text in client.statuses() if "second.u" in text], "the refusal")
        client.set(first__u="much")
        client.until(lambda: [text for text in client.statuses() if "much" in text], "the refusal")

    assert before == {"first.u": 0.0, "first.k": 1.0, "second.k": 1.0}
    assert answer == {"first.u": 3.0, "second.k": 2.0}


def test_nothing_can_be_set_without_steer(place: Place) -> None:
    place.start("launch", gains(place), "--no-progress")
    _, url = start(place, "pair")

    with FoxgloveClient(url) as client:
        client.until(lambda: "/second/y" in client.channels, "the topics")
        assert client.set(second__k=5.0) == {"second.k": 1.0}
        client.until(lambda: [text for text in client.statuses() if "--steer" in text], "the refusal")


def test_a_client_that_comes_while_the_mesh_is_paused_sees_current_values(place: Place) -> None:
    mesh = place.start("launch", paced(place), "--paused", "--no-progress")
    _, url = start(place, "pair")

    with FoxgloveClient(url) as client:
        client.subscribe("/delay/y")
        client.until(lambda: client.values("/delay/y"), "the current value")
        with FoxgloveClient(url) as other:
            other.subscribe("/delay/y", "/pendulum/a")
            other.until(lambda: other.values("/delay/y") and other.values("/pendulum/a"), "the current values")
            assert other.values("/pendulum/a")[0] == (0, 0, 1.5)
        place.run("stop", "pair")

    assert mesh.wait() == 130


def test_the_mesh_may_start_later_and_again(place: Place) -> None:
    config = paced(place)
    served, url = start(place)

    with FoxgloveClient(url) as client:
        client.until(lambda: client.info, "the server")
        sessions = [client.info["sessionId"]]
        for _ in range(2):
            mesh = place.start("launch", config, "--no-progress")
            client.until(lambda: client.info["sessionId"] not in sessions, "a new session")
            client.until(lambda: "/delay/y" in client.channels, "its topics")
            client.subscribe("/delay/y")
            sessions.append(client.info["sessionId"])
            client.messages.clear()
            client.until(lambda: len(client.messages["/delay/y"]) > 3, "values")
            assert client.values("/delay/y")[0][1] < 1000
            place.run("stop", "pair")
            client.until(client.ended, "the end")
            assert mesh.wait() == 130
            client.texts.clear()
        assert len({*sessions}) == 3

    served.signal(signal.SIGINT)
    assert served.wait() == 130
    place.assert_nothing_left()


def test_a_client_that_does_not_read_slows_nobody(place: Place) -> None:
    # A text of 10 kB in each message fills the buffers of the operating system soon.
    (place.folder / "talker.py").write_text(TALKER)
    config = write_config(
        place.folder,
        instances={"talker": {"python": "talker.py:Talker"}},
        connections=[],
        stop_time=3600.0,
        simulation={"real_time_factor": 1.0, "step_size": 0.002},
    )
    mesh = place.start("launch", config, "--no-progress")
    _, url = start(place, "pair")

    with FoxgloveClient(url) as stuck, FoxgloveClient(url) as client:
        stuck.subscribe("/talker/text", "/talker/number")
        client.subscribe("/talker/text", "/talker/number")
        client.until(lambda: len(client.messages["/talker/number"]) >= 3000, "many values")
        number = client.values("/talker/number")
        place.run("stop", "pair")
        client.until(client.ended, "the end")
        stuck.until(stuck.ended, "the end")

    assert mesh.wait() == 130
    assert all(value == float(point) for _, point, value in number)
    assert [point for _, point, _ in number] == sorted({point for _, point, _ in number})
    assert len(stuck.messages["/talker/number"]) < len(client.messages["/talker/number"])


def test_log_messages_are_shown_also_those_from_before(place: Place) -> None:
    place.start("launch", paced(place), "--no-progress")
    _, url = start(place, "pair")

    with FoxgloveClient(url) as client, place.session() as session:
        client.until(lambda: "/delay/y" in client.channels, "the topics")
        session.put("fmu_mesh/pair/delay/set/x", "1.0")
        wait_until(lambda: "is connected to" in place.run("logs", "pair").output, "the message in the log")
        client.subscribe("/log")
        client.until(lambda: client.messages["/log"], "the message from before")
        session.put("fmu_mesh/pair/delay/set/y", "1.0")  # another key: refusals at one key in a short time are one line
        client.until(lambda: len(client.messages["/log"]) == 2, "the next message")

    assert client.channels["/log"]["schemaName"] == "foxglove.Log"
    before, after = (data for _, data in client.messages["/log"])
    assert b"is connected to 'pendulum'" in before
    assert b"'delay.y'" in after


def test_times_before_zero_are_shifted(place: Place) -> None:
    place.start("launch", paced(place, start_time=-2.5), "--no-progress")
    served, url = start(place, "pair")

    with FoxgloveClient(url) as client:
        client.subscribe("/delay/y")
        client.until(lambda: client.values("/delay/y"), "values")
        stamp, point, _ = client.values("/delay/y")[0]
        assert stamp == point * 10_000_000

    wait_until(lambda: "its times are 2.5 s later" in served.output, "the message about it")


def test_wrong_usage_is_said_in_one_sentence(place: Place) -> None:
    place.start("launch", paced(place), "--no-progress")
    _, url = start(place, "pair")
    port = urlsplit(url).port

    taken = place.run("foxglove", "pair", "--port", str(port))
    pattern = place.run("foxglove", "pair", "--port", "0", "--variables", "pendulum.nothing")
    number = place.run("foxglove", "--port", "70000")

    assert [done.wait() for done in (taken, pattern, number)] == [2, 2, 2]
    assert f"port {port} of 127.0.0.1 is taken by another program. `--port 0` takes a free one." in taken.message
    assert "has no variable 'nothing'" in pattern.message
    assert "'70000' is no port: expected 0 to 65535" in number.message
    for done in (taken, pattern, number):
        assert_readable(done.message)


def test_the_missing_extra_is_named(place: Place) -> None:
    site = place.folder / "site"
    site.mkdir()
    (site / "foxglove.py").write_text("raise ImportError('not here')")
    place.environment = {**place.environment, "PYTHONPATH": f"{site}:{place.environment.get('PYTHONPATH', '')}"}

    done = place.run("foxglove")

    assert done.wait() == 2
    assert "-m pip install 'foxglove-sdk>=0.30'`" in done.message
    assert_readable(done.message)


def test_other_hosts_are_warned_about(place: Place) -> None:
    served = place.start("foxglove", "--host", "0.0.0.0", "--port", "0")  # noqa: S104  that is what it warns about

    wait_until(lambda: "whoever can reach this host at 0.0.0.0" in served.errors, "the warning")


# --- who may connect


def gets_in(url: str, origin: str | None = None) -> bool:
    try:
        page = Origin(origin) if origin is not None else None
        with connect(
            url, origin=page, subprotocols=[Subprotocol("foxglove.sdk.v1")], open_timeout=DEADLINE_S
        ) as socket:
            return "serverInfo" in str(socket.recv(timeout=DEADLINE_S))
    except (InvalidHandshake, EOFError):
        return False


def test_only_those_who_know_the_token_and_pages_of_known_origins_connect(place: Place) -> None:
    _, url = start(place, "--steer", "--origin", "https://foxglove.example.org")
    without, _, token = url.partition("?")

    assert gets_in(url)
    for origin in ("https://app.foxglove.dev", "http://localhost:8080", "https://foxglove.example.org"):
        assert gets_in(url, origin)
        assert not gets_in(without, origin)
    for origin in ("https://evil.example", "null", "https://app.foxglove.dev.evil.example", "file://"):
        assert not gets_in(url, origin)
    for wrong in (without, f"{without}?token=", f"{url}x", f"{without}other/?{token[:-1]}", f"{without}?token=%ff"):
        assert not gets_in(wrong)
    assert gets_in(url)


def test_nobody_passes_by_the_token_at_the_port_behind_it(place: Place) -> None:
    served, url = start(place)
    ports = [
        connection.laddr.port
        for connection in psutil.Process(served.pid).net_connections(kind="inet")
        if connection.status == psutil.CONN_LISTEN and connection.laddr.port != urlsplit(url).port
    ]

    for port in ports:
        with pytest.raises(TimeoutError):
            connect(f"ws://127.0.0.1:{port}", subprotocols=[Subprotocol("foxglove.sdk.v1")], open_timeout=2.0)

    assert len(ports) == 1
    assert gets_in(url)


def test_without_filters_for_sockets_it_ends_with_a_way_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(relay, "_SO_ATTACH_FILTER", 9999)  # an option that no kernel has
    before = listening_ports()

    assert main(["foxglove", "--port", "0"]) == 2

    told = capsys.readouterr().err
    assert "the kernel lets nobody protect the server with a socket filter: Protocol not available." in told
    assert "Start it with --connect where a usual Linux kernel runs" in told
    assert listening_ports() == before


def listening_ports() -> list[int]:
    """The ports at which this process listens."""
    return [one.laddr.port for one in psutil.Process().net_connections("tcp") if one.status == psutil.CONN_LISTEN]
