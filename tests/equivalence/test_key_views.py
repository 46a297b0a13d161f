"""What commands show of Zenoh keys at ends of connections while a mesh runs."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh

from fmu_mesh.cli.main import main
from tests.helpers import FMUS, Launched, Place, wait_until
from tests.key_meshes import client, key_lines, put_values, status_of, stepped_router, written

_ENDLESS = {"stop_time": 600.0, "real_time_factor": 1}


@contextmanager
def seen(place: Place) -> Iterator[tuple[Launched, zenoh.Session]]:
    """A mesh with a key at each end that has got a value, and something else, and a session beside it."""
    connections = [
        "pump.y -> tank.u",
        {"key": "plant/flow", "to": "pump.u", "field": "sensors[0].value"},
        {"from": "pump.y", "key": "twin/y", "on": "change", "encoding": "text"},
    ]
    with stepped_router(place) as (_, endpoint), client(endpoint) as session:
        zenoh_section = {"mode": "client", "connect": [endpoint]}
        members = {"pump": {"fmu": "Gain"}, "tank": {"fmu": "Gain"}}
        path = written(place, "seen", members, connections, simulation=_ENDLESS, zenoh=zenoh_section)
        launched = place.start("launch", path, "--no-progress")
        wait_until(lambda: status_of(session, "seen", "pump").get("state") == "running", "a mesh that runs")
        put_values(session, "plant/flow", [b"{}"])  # before another one can take its place
        wait_until(lambda: keys_of(session)["plant/flow"]["refused"] == 1, "a value that is refused")
        put_values(session, "plant/flow", [b'{"sensors": [{"value": 2.5}]}'])
        wait_until(lambda: keys_of(session)["twin/y"]["received"] == 2, "a value that is published")
        yield launched, session
        place.run("stop", "seen")
        launched.wait()


def keys_of(session: zenoh.Session) -> dict[str, dict[str, object]]:
    """What the status of the pump says of each key."""
    return {own["key"]: own for own in status_of(session, "seen", "pump")["keys"]}


def test_commands_show_rate_and_refused_values_of_keys(place: Place) -> None:
    flow = r"plant/flow -> pump\.u +auto sensors\[0\]\.value +on arrival"
    with seen(place):
        outputs = {
            command: place.run(*command.split()).output
            for command in ("ls seen", "status seen", "status seen/pump", "top seen --once", "graph seen")
        }
        info = place.run("info", "seen/pump").output

    for command, output in outputs.items():
        text = re.sub(r",\s+", " ", output)  # the graph has commas, and breaks lines
        assert re.search(flow + r" +[\d.e+]+/s,? 1 refused", text), f"{command}\n{output}"
        assert re.search(r"pump\.y -> twin/y +text +on change +[\d.e+]+/s", text), f"{command}\n{output}"
    assert re.search(f"^key +{flow}$", info, re.MULTILINE)
    assert "2 keys" in outputs["graph seen"]


def test_the_picture_of_a_running_mesh_has_its_keys(place: Place) -> None:
    with seen(place):
        place.run("graph", "seen", "--output", "seen.svg")
        graph = json.loads(place.run("graph", "seen", "--json").output)

    picture = (place.folder / "seen.svg").read_text(encoding="utf-8")
    assert 'data-instance="key plant/flow"' in picture
    assert '<g class="edge" data-source="pump" data-target="key twin/y">' in picture
    assert [own["refused"] for own in graph["keys"]] == [1, 0]


def test_an_fmu_on_the_command_line_gets_and_publishes_keys(place: Place) -> None:
    with stepped_router(place) as (_, endpoint), client(endpoint) as session:
        published: list[float] = []
        subscriber = session.declare_subscriber(
            "twin/y", lambda sample: published.append(json.loads(sample.payload.to_bytes())["value"])
        )
        command = ["run", FMUS / "Gain.fmu", "--set", "k=2", "--subscribe", "u=plant/*/flow", "--publish", "y=twin/y"]
        launched = place.start(*command, "--name", "pump", "--output", "pump.csv", "--connect", endpoint)
        put_values(session, "plant/pump/flow", [3.5])
        wait_until(lambda: 7.0 in published, "an output that the value has reached")
        place.run("stop", "pump")
        launched.wait()
        subscriber.undeclare()

    assert [(name, value) for name, _, _, value in key_lines(place.folder / "pump.csv")] == [("pump.u", 3.5)]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--subscribe", "u"], "--subscribe: 'u' is no variable and key such as u=plant/pump/flow"),
        (["--publish", "=a/b"], "--publish: '=a/b' is no variable and key"),
        (["--subscribe", "x=a/b"], "--subscribe x=a/b: connections[0].to: the unknown variable 'x' of instance 'Gain'"),
        (["--publish", "y=a/*"], "--publish y=a/*: connections[0].key: 'a/*'; expected one key, without wildcards"),
    ],
)
def test_a_wrong_key_on_the_command_line_is_told_by_flag(
    flags: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main(["run", str(FMUS / "Gain.fmu"), "--stop-time", "1", *flags])

    assert code == 2
    assert message in capsys.readouterr().err


def test_check_says_where_kept_values_come_from(place: Place) -> None:
    path = written(place, "kept", {"pump": {"fmu": "Gain"}}, [{"key": "plant/flow", "to": "pump.u"}])
    kept: Path = place.folder / "kept.csv.keys.jsonl"
    kept.write_text('["pump.u",3,null,2.0]\n')

    output = place.run("check", path, "--keys-from", kept).output

    assert "  plant/flow -> pump.u  auto  on arrival\n  their values come from kept.csv.keys.jsonl\n" in output
