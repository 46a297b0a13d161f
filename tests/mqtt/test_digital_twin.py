"""The story of docs/digital-twin.md with the real bridge: its commands run in their order, and its words come true."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tests.helpers import Launched, Place, rows_of, wait_until
from tests.mqtt.mqtt_bridge import PROGRAM, Bridge, bridge_or_skip, ended, running_bridge
from tests.pages.blocks import ROOT, blocks_of
from tests.pages.test_pages import masked

PAGE = ROOT / "docs" / "digital-twin.md"
BLOCKS = [
    (block, after.text if after is not None and after.language == "text" else "")
    for block, after in pairwise([*blocks_of(PAGE), None])
    if block is not None and Path(__file__).name in block.detail
]
STORY = [(block, shown) for block, shown in BLOCKS if block.language == "sh"]
PARTS = [(yaml.safe_load(block.text), shown) for block, shown in BLOCKS if block.language == "yaml"]

GOES_ON = re.compile(rf"{PROGRAM}|fmu-mesh (launch .*--listen|dashboard)|mosquitto_sub|curl -N")
RPM = np.pi / 30.0


def test_the_page_begins_with_the_connections_of_its_configuration() -> None:
    file = yaml.safe_load((ROOT / "configs" / "pump_twin.yaml").read_text(encoding="utf-8"))

    assert PARTS[0][0] == {"connections": file["connections"]}


class Reader:
    """A person in a clone with a terminal for each command that goes on; the ports are free ones."""

    def __init__(self, place: Place) -> None:
        self.place, self.ports = place, Bridge.on_free_ports()
        self.meanwhile: dict[str, Launched] = {}
        self.told: list[Launched] = []
        for name in ("configs", "fmus", "bridges/zenoh"):
            shutil.copytree(ROOT / name, place.folder / name)
        config = place.folder / "bridges" / "zenoh" / "config.json5"
        config.write_text(self.ports.translated(config.read_text(encoding="utf-8")), encoding="utf-8")
        place.environment = {**place.environment, "PATH": f"{self._commands()}:{os.environ['PATH']}"}

    def _commands(self) -> Path:
        """The commands of the page: those of this environment, the bridge, and clients that know the port."""
        folder = self.place.folder / "bin"
        folder.mkdir()
        (folder / "fmu-mesh").symlink_to(Path(sys.executable).with_name("fmu-mesh"))
        (folder / PROGRAM).symlink_to(bridge_or_skip())
        for name in ("mosquitto_pub", "mosquitto_sub"):
            found = shutil.which(name)
            assert found is not None
            (folder / name).write_text(f'#!/bin/sh\nexec {shlex.quote(found)} -p {self.ports.mqtt} "$@"\n')
            (folder / name).chmod(0o755)
        return folder

    def type(self, line: str) -> None:
        """Run a line; one that goes on has told something."""
        process = self.place.start_command(["bash", "-c", f"exec {self.ports.translated(line)}"])
        self.told.append(process)
        if GOES_ON.match(line) is None:
            assert process.wait() == 0, process.story()
            return
        self.meanwhile[line] = process
        wait_until(lambda: process.output or process.errors or not process.running, f"something that '{line}' tells")
        assert process.running, process.story()

    def flows(self) -> int:
        """How many values of the flow the MQTT client shows."""
        return sum(
            own.output.count("twin/pump/flow") for line, own in self.meanwhile.items() if "mosquitto_sub" in line
        )

    def wait_for_flow(self, count: int) -> None:
        """The page says "at once"; of two speeds between two points only the second one would count."""
        wait_until(lambda: self.flows() >= count, f"flow {count} at the MQTT client")

    def leave(self, word: str) -> Launched:
        """End the command that goes on and has this word in its line."""
        line = next(line for line in self.meanwhile if word in line)
        process = self.meanwhile.pop(line)
        process.signal(signal.SIGINT)
        process.wait()
        return process


def test_the_story_goes_as_the_page_tells_it(place: Place) -> None:
    bridge_or_skip()
    reader = Reader(place)

    for line in (command.line for block, shown in STORY for command in block.commands(shown)):
        if line.startswith("fmu-mesh stop"):
            reader.leave("dashboard")
        flows = reader.flows()
        reader.type(line)
        if " plant/pump/speed" in line or line.endswith("/plant/pump/speed"):
            reader.wait_for_flow(flows + 1)
    twin = reader.meanwhile.pop(next(line for line in reader.meanwhile if "fmu-mesh launch" in line))
    assert twin.wait() == 0, twin.story()
    topics, events = reader.leave("mosquitto_sub").output, reader.leave("curl -N").output
    assert reader.leave(PROGRAM).errors == ""

    outputs = "\n".join(text for own in reader.told for text in (own.output, own.errors))
    missing = {*_words("".join(shown for _, shown in STORY))} - {*_words(outputs)}
    assert not missing, f"{missing} is not in\n{outputs}"
    assert _warnings(twin.errors) == [], twin.story()
    _assert_forecasts(place.folder / "results" / "pump_twin.csv", topics, events)
    assert _last_row(place.folder / "results" / "worse_fan.csv")[0] == 5.0


def _warnings(errors: str) -> list[str]:
    """All but that of the port of this host, which is meant."""
    warnings = [line for line in errors.splitlines() if "warning" in line]
    return [line for line in warnings if "every user of this host can set values" not in line]


def _assert_forecasts(result: Path, topics: str, events: str) -> None:
    """What readers have got is what is recorded, and the recorded speed is what the sensor has said."""
    rows = {round(row[0] * 10): row for row in rows_of(result)}
    by_topic = [json.loads(line.partition(" ")[2]) for line in topics.splitlines() if "forecast" in line]
    by_event = [json.loads(line[6:])["value"] for line in events.splitlines() if line.startswith("data:")]
    forecasts = [*by_topic, *(own for own in by_event if isinstance(own, dict))]

    assert len(by_topic) >= 2
    assert len(forecasts) > len(by_topic)
    for one in forecasts:
        assert one["point"] % 10 == 0
        assert (one["time"], one["value"]) == (rows[one["point"]][0], rows[one["point"]][4])
    flows = [float(line.partition(" ")[2]) for line in topics.splitlines() if "twin/pump/flow" in line]
    assert flows[-2:] == pytest.approx([36.0 * rpm * RPM / 300.0 for rpm in (2400, 2900)], rel=1e-15)
    assert {row[1] for row in rows.values()} == {0.0, 2400 * (np.pi / 30.0), 2900 * (np.pi / 30.0)}


def _last_row(result: Path) -> tuple[float, ...]:
    return rows_of(result)[-1]


def _words(text: str) -> Iterator[str]:
    """Lines without what differs from run to run."""
    yield from masked(re.sub(r'\d/[0-9a-f]{4,32}"', '0/ID"', text))


@pytest.fixture
def part(request: pytest.FixtureRequest, place: Place) -> tuple[Path, str]:
    """A part of the page in a complete file, and what the page shows after it."""
    own, shown = next((own, shown) for own, shown in PARTS if request.param in own["connections"][0])
    whole: dict[str, Any] = {
        "mesh": "part",
        "simulation": {"stop_time": 5.0, "step_size": 0.1},
        "instances": {"pump": {"fmu": str(ROOT / "fmus" / "Pump.fmu")}},
        "record": {"file": "part.csv", "variables": ["pump.speed"]},
    }
    file = place.folder / "part.yaml"
    file.write_text(yaml.safe_dump(whole | own), encoding="utf-8")
    return file, shown


def _seen(place: Place, ports: Bridge) -> None:
    """Wait until the bridge is linked to the mesh, which has declared its keys by then."""
    curl = ports.curl("fmu_mesh/*/mesh/status")
    wait_until(lambda: '"running"' in ended(place, curl).output, "the mesh, by HTTP")


@pytest.mark.parametrize("part", ["time"], indirect=True)
def test_values_with_times_are_a_line_through_these_times(place: Place, part: tuple[Path, str]) -> None:
    bridge_or_skip()
    ports = Bridge.on_free_ports()
    began = datetime(2026, 11, 29, 14, 0, tzinfo=UTC)
    sent = [(0.25 * number, 100.0 * number) for number in range(12)]
    lines = [json.dumps({"rpm": rpm, "at": (began + timedelta(seconds=at)).isoformat()}) for at, rpm in sent]
    endpoint = f"tcp/127.0.0.1:{ports.zenoh}"

    with running_bridge(place, ports):
        # Slowly, so that the half second of the delay is long even on a busy machine.
        mesh = place.start("launch", part[0], "--no-progress", "--listen", endpoint, "--real-time-factor", "0.2")
        _seen(place, ports)
        command = ports.publish("plant/pump/speed", "-q", "1", "-l")
        subprocess.run(command, input="\n".join(lines), text=True, check=True, timeout=60)
        assert mesh.wait() == 0, mesh.story()

    rows = rows_of(place.folder / "part.csv")
    kept = [json.loads(line) for line in (place.folder / "part.csv.keys.jsonl").read_text("utf-8").splitlines()]
    times = [one[2] for one in kept]
    assert _warnings(mesh.errors) == []
    assert [one[3] for one in kept] == [rpm * RPM for _, rpm in sent]
    # Seconds since 1970 have 52 bits, so the last one counts 2.4e-7 s.
    assert np.diff(times) == pytest.approx(0.25, abs=2 * 2**-22)
    assert times[0] == pytest.approx(0.1 * kept[0][1] + 0.5, abs=2 * 2**-22)
    expected = np.interp([time for time, _ in rows[:-1]], times, [one[3] for one in kept])
    assert [speed for _, speed in rows[1:]] == pytest.approx(list(expected), rel=1e-12, abs=1e-9)


@pytest.mark.parametrize("part", ["wait"], indirect=True)
def test_a_run_that_waits_uses_each_message_for_one_step(place: Place, part: tuple[Path, str]) -> None:
    bridge_or_skip()
    ports = Bridge.on_free_ports()
    endpoint = f"tcp/127.0.0.1:{ports.zenoh}"

    with running_bridge(place, ports):
        mesh = place.start("launch", part[0], "--no-progress", "--listen", endpoint, "--set-config", "timeouts.step=60")
        _seen(place, ports)
        lines = "".join(f'{{"rpm": {number}}}\n' for number in range(50))
        command = ports.publish("plant/pump/speed", "-q", "1", "-l")
        subprocess.run(command, input=lines, text=True, check=True, timeout=60)
        assert mesh.wait() == 0, mesh.story()

    assert [speed for _, speed in rows_of(place.folder / "part.csv")][1:] == [number * RPM for number in range(50)]


@pytest.mark.parametrize("part", ["wait"], indirect=True)
def test_a_run_that_waits_in_vain_ends_with_these_words(place: Place, part: tuple[Path, str]) -> None:
    mesh = place.run("launch", part[0], "--no-progress")

    assert mesh.wait() == 4
    [shown] = masked(part[1])
    assert " ".join(masked(mesh.message)).startswith(shown)


def test_a_run_goes_on_while_the_bridge_is_dead(place: Place) -> None:
    bridge_or_skip()
    ports = Bridge.on_free_ports()
    file, endpoint = place.folder / "twin.csv", f"tcp/127.0.0.1:{ports.zenoh}"
    config = ROOT / "configs" / "pump_twin.yaml"

    def speeds() -> list[float]:
        """Those in the rows that are complete by now."""
        return [float(line.split(",")[1]) for line in file.read_text("utf-8").split("\n")[1:-1]]

    def publish(rpm: int) -> None:
        ended(place, ports.publish("plant/pump/speed", "-q", "1", "-m", f'{{"rpm": {rpm}}}'))
        wait_until(lambda: speeds()[-1:] == [rpm * RPM], f"{rpm} rpm in the result")

    twin = place.start("launch", config, "--no-progress", "--listen", endpoint, "--output", file)
    with running_bridge(place, ports) as bridge:
        _seen(place, ports)
        wait_until(file.exists, "the first rows")
        publish(2400)
        bridge.signal(signal.SIGKILL)
        bridge.wait()
        known = len(speeds())
        wait_until(lambda: len(speeds()) > known + 5, "points without a bridge")
    with running_bridge(place, ports) as bridge:
        wait_until(lambda: "ready" in bridge.output, "the link of the second bridge")
        publish(2900)
    place.run("stop", "pump_twin")

    assert twin.wait() == 0, twin.story()
    assert _warnings(twin.errors) == []
    assert sorted(set(speeds())) == [0.0, 2400 * RPM, 2900 * RPM]
    assert speeds() == sorted(speeds())
