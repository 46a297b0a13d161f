"""What the bridge does with topics and URLs, and what it refuses."""

from __future__ import annotations

import base64
import json
import signal
import subprocess
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
import zenoh

from tests.helpers import Launched, Place, wait_until, write_config
from tests.mqtt.mqtt_bridge import CONFIG, Bridge, bridge_or_skip, ended, listening, running_bridge

JSON = ("-H", "content-type: application/json")
FILTER = CONFIG.read_text(encoding="utf-8").partition("  low_pass_filter: [")[2].partition("  ],\n")[0]


class Meeting:
    """A bridge, a session beside it as a mesh has one, and all samples that have come to it."""

    def __init__(self, place: Place, ports: Bridge, session: zenoh.Session, bridge: Launched) -> None:
        self.place, self.ports, self.session, self.bridge = place, ports, session, bridge
        self.samples: list[zenoh.Sample] = []
        self._subscriber = session.declare_subscriber("**", self.samples.append)
        wait_until(lambda: "ready" in bridge.output, "the link of the bridge")

    def payloads(self, key: str) -> list[bytes]:
        return [own.payload.to_bytes() for own in self.samples if str(own.key_expr) == key]

    def one(self, key: str) -> zenoh.Sample:
        return wait_until(lambda: next((own for own in self.samples if str(own.key_expr) == key), None), key)

    def published(self, topic: str, *arguments: str) -> int:
        return self.place.start_command(self.ports.publish(topic, *arguments)).wait()

    def wait_for_subscriber(self, key: str) -> None:
        with self.session.declare_publisher(key, allowed_destination=zenoh.Locality.REMOTE) as publisher:
            wait_until(lambda: publisher.matching_status.matching, key)  # type: ignore[attr-defined]  # the stub is wrong


@pytest.fixture
def meeting(place: Place) -> Iterator[Meeting]:
    bridge_or_skip()
    ports = Bridge.on_free_ports()
    with listening(ports.zenoh) as session, running_bridge(place, ports) as bridge:
        yield Meeting(place, ports, session, bridge)


def test_a_message_is_a_sample_under_its_topic_with_a_timestamp(meeting: Meeting) -> None:
    began = datetime.now(UTC)
    assert meeting.published("plant/pump 1/speed", "-q", "1", "-m", '{"rpm": 2400}') == 0

    sample = meeting.one("plant/pump 1/speed")

    assert sample.payload.to_bytes() == b'{"rpm": 2400}'
    assert str(sample.encoding) == "zenoh/bytes"
    assert sample.attachment is None
    assert sample.timestamp is not None
    # Zenoh's clock counts in steps of a few microseconds, and its first digit may be that of the millisecond before.
    came = sample.timestamp.get_time()
    assert began - timedelta(milliseconds=1) < came < datetime.now(UTC) + timedelta(milliseconds=1)


def test_all_messages_of_qos_1_arrive_in_their_order(meeting: Meeting) -> None:
    lines = "".join(f"{number}\n" for number in range(2000))
    command = meeting.ports.publish("plant/count", "-q", "1", "-l")

    subprocess.run(command, input=lines, text=True, check=True, timeout=60)

    wait_until(lambda: len(meeting.payloads("plant/count")) >= 2000, "2000 samples")
    assert meeting.payloads("plant/count") == [str(number).encode() for number in range(2000)]


@pytest.mark.parametrize("topic", ["/a/b", "a/b/", "a//b", "a/$b", "a/b?c", "a/b*c"])
def test_a_topic_that_is_no_key_ends_the_connection_of_its_client(meeting: Meeting, topic: str) -> None:
    refused = meeting.published(topic, "-q", "1", "-m", "x")
    accepted = meeting.published("a/next", "-q", "1", "-m", "y")

    assert refused != 0
    assert accepted == 0
    meeting.one("a/next")
    assert len(meeting.samples) == 1


@pytest.mark.parametrize("version", ["mqttv311", "mqttv5"])
def test_qos_2_is_refused(meeting: Meeting, version: str) -> None:
    client = meeting.place.start_command(meeting.ports.publish("a/b", "-V", version, "-q", "2", "-m", "x"))

    client.wait()
    assert meeting.published("a/next", "-q", "1", "-m", "y") == 0

    assert ("connection was lost" if version == "mqttv311" else "QoS not supported") in client.errors
    meeting.one("a/next")
    assert meeting.payloads("a/b") == []


def test_a_message_is_not_retained_for_later_subscribers(meeting: Meeting) -> None:
    assert meeting.published("a/b", "-q", "1", "-r", "-m", "kept") == 0

    late = meeting.place.start_command(meeting.ports.subscribe("-v", "-C", "1", "-t", "a/#"))
    meeting.wait_for_subscriber("a/c")
    meeting.session.put("a/c", "new")

    assert late.wait() == 0
    assert late.output == "a/c new\n"


def test_wildcards_of_topics_are_those_of_keys(meeting: Meeting) -> None:
    client = meeting.place.start_command(
        meeting.ports.subscribe("-v", "-C", "4", "-t", "twin/#", "-t", "plant/+/speed", "-t", "end")
    )
    for key in ("twin/pump/forecast", "plant/x/speed", "end"):
        meeting.wait_for_subscriber(key)

    for key in ("twin/pump/forecast", "twin", "plant/pump/x/speed", "plant/pump/speed", "other", "end"):
        meeting.session.put(key, f'{{"key": "{key}"}}', encoding="application/json")

    assert client.wait() == 0
    assert client.output.splitlines() == [
        f'{key} {{"key": "{key}"}}' for key in ("twin/pump/forecast", "twin", "plant/pump/speed", "end")
    ]


def test_a_put_and_a_get_of_http_are_those_of_zenoh(meeting: Meeting) -> None:
    def answer(query: zenoh.Query) -> None:
        query.reply(query.key_expr, '{"value": 1.5}', encoding="application/json")

    with meeting.session.declare_queryable("demo/value", answer):
        ended(meeting.place, meeting.ports.curl("plant/speed", "-X", "PUT", *JSON, "-d", '{"rpm": 2400}'))
        read = ended(meeting.place, meeting.ports.curl("demo/value")).output
        raw = ended(meeting.place, meeting.ports.curl("demo/value?_raw")).output

    sample = meeting.one("plant/speed")
    assert sample.payload.to_string() == '{"rpm": 2400}'
    assert str(sample.encoding) == "application/json"
    assert sample.timestamp is not None
    expected = {"key": "demo/value", "value": {"value": 1.5}, "encoding": "application/json", "timestamp": None}
    assert json.loads(read) == [expected]
    assert raw == '{"value": 1.5}'


def test_a_stream_of_http_has_each_sample_as_an_event(meeting: Meeting) -> None:
    stream = meeting.place.start_command(meeting.ports.curl("twin/**", "-N", "-H", "accept: text/event-stream"))
    meeting.wait_for_subscriber("twin/pump/forecast")

    for value in (1.5, 2.5):
        meeting.session.put("twin/pump/forecast", f'{{"value": {value}}}', encoding="application/json")

    def events() -> list[dict[str, Any]]:
        return [json.loads(line[6:]) for line in stream.output.split("\n")[:-1] if line.startswith("data: {")]

    wait_until(lambda: len(events()) == 2, "two events")
    assert meeting.published("twin/by mqtt", "-q", "1", "-m", "2.5") == 0
    wait_until(lambda: len(events()) == 3, "a third event")
    assert [(one["key"], one["value"]) for one in events()] == [
        ("twin/pump/forecast", {"value": 1.5}),
        ("twin/pump/forecast", {"value": 2.5}),
        ("twin/by mqtt", base64.b64encode(b"2.5").decode()),
    ]


@pytest.mark.parametrize("kept", ["with the filter", "without"])
def test_nothing_sets_or_stops_a_mesh_through_the_filter(place: Place, kept: str) -> None:
    bridge_or_skip()
    ports, is_filtered = Bridge.on_free_ports(), kept == "with the filter"
    text = CONFIG.read_text(encoding="utf-8")
    config = write_config(
        place.folder, instances={"gain": {"fmu": "Gain"}}, connections=[], simulation={"stop_time": None}
    )
    endpoint = f"tcp/127.0.0.1:{ports.zenoh}"
    mesh = place.start("launch", config, "--no-progress", "--real-time-factor", "1", "--listen", endpoint)
    with running_bridge(place, ports, text if is_filtered else text.replace(FILTER, "")) as bridge:
        wait_until(lambda: "ready" in bridge.output, "the link of the bridge")
        key, shown = "fmu_mesh/pair/gain/set/u", "fmu_mesh/pair/gain/in/u"
        wait_until(lambda: ended(place, ports.curl(shown)).output != "[]", "the mesh, by HTTP")

        ended(place, ports.curl(f"{key}?_raw", "-X", "POST", *JSON, "-d", "2.5"))
        by_post = json.loads(ended(place, ports.curl(shown)).output)[0]["value"]
        ended(place, ports.publish(key, "-q", "1", "-m", "3.5"))
        ended(place, ports.publish("fmu_mesh/pair/mesh/command", "-q", "1", "-m", '{"command": "stop"}'))
        # The answer comes after all that was sent before by the same link.
        by_topic = json.loads(ended(place, ports.curl(shown)).output or "[]")
        stop = json.dumps({"command": "stop"})
        ended(place, ports.curl("fmu_mesh/pair/mesh/command", "-X", "POST", *JSON, "-d", stop))
        state = ended(place, ports.curl("fmu_mesh/pair/mesh/status")).output

    if is_filtered:
        assert (by_post, by_topic[0]["value"]) == (0.0, 0.0)
        assert json.loads(state)[0]["value"]["state"] == "running"
        assert mesh.running
        mesh.signal(signal.SIGINT)
    else:
        assert by_post == 2.5
    mesh.wait()


def test_the_bridge_finds_the_next_mesh_at_the_same_port(place: Place) -> None:
    bridge_or_skip()
    ports = Bridge.on_free_ports()
    with running_bridge(place, ports) as bridge:
        with listening(ports.zenoh) as session:
            Meeting(place, ports, session, bridge)
        with listening(ports.zenoh) as session:
            second = Meeting(place, ports, session, bridge)

            def came() -> bool:
                assert second.published("a/b", "-q", "1", "-m", "x") == 0
                return bool(second.payloads("a/b"))

            wait_until(came, "a message in the second session")


def test_a_subscriber_gets_values_of_the_bridge_that_follows_a_killed_one(meeting: Meeting) -> None:
    client = meeting.place.start_command(meeting.ports.subscribe("-v", "-t", "twin/#"))
    meeting.wait_for_subscriber("twin/pump")
    meeting.bridge.signal(signal.SIGKILL)
    meeting.bridge.wait()
    assert meeting.published("a/b", "-q", "1", "-m", "lost") != 0

    with running_bridge(meeting.place, meeting.ports):
        meeting.wait_for_subscriber("twin/pump")
        meeting.session.put("twin/pump", "again")
        wait_until(lambda: client.output == "twin/pump again\n", "the value by the second bridge")

    assert meeting.samples[-1].payload.to_string() == "again"


def test_it_ends_with_its_pipe_but_not_without_one(place: Place) -> None:
    binary = bridge_or_skip()
    ports = Bridge.on_free_ports()
    with running_bridge(place, ports) as service:  # its standard input is /dev/null
        assert service.running
    command = [str(binary), str(place.folder / "bridge.json5")]

    done = subprocess.run(command, input="", capture_output=True, text=True, timeout=60, check=False)

    assert done.returncode == 0
    assert done.stdout == f"mqtt listens on 127.0.0.1:{ports.mqtt}\nrest listens on 127.0.0.1:{ports.http}\n"


@pytest.mark.parametrize(
    ("plugins", "code", "words"),
    [
        ("mqtt: {}", 2, 'plugins/mqtt/port has to be "ADDRESS:PORT"'),
        ("rest: {http_port: 8000}", 2, 'plugins/rest/http_port has to be "ADDRESS:PORT"'),
        ("", 2, "it has no section plugins"),
        ('mqtt: {port: "127.0.0.1:FREE", prot: 1}', 1, "unknown field `prot`"),
        ('rest: {http_port: "127.0.0.1:TAKEN"}', 1, "rest cannot listen on 127.0.0.1:TAKEN: Address already in use"),
        ('mqtt: {port: "127.0.0.1:TAKEN"}', 1, "mqtt cannot listen on 127.0.0.1:TAKEN: Address already in use"),
    ],
)
def test_a_configuration_that_cannot_work_is_refused(plugins: str, code: int, words: str, place: Place) -> None:
    binary = bridge_or_skip()
    ports = Bridge.on_free_ports()
    with listening(ports.zenoh):
        for name, port in (("FREE", ports.mqtt), ("TAKEN", ports.zenoh)):
            plugins, words = plugins.replace(name, str(port)), words.replace(name, str(port))
        file = place.folder / "bridge.json5"
        file.write_text(f"{{ plugins: {{ {plugins} }} }}", encoding="utf-8")

        refused = place.start_command([str(binary), str(file)])

        assert refused.wait() == code
    assert words in refused.output + refused.errors
