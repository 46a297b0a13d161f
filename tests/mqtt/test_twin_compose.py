"""The commands of docker/twin.compose.yaml, run as plain processes: a sensor in, a forecast out.

Our bridge stands in for the official image, and `fmu-mesh router` for the router's; besides that only the addresses and
the paths of the containers are replaced.
"""

from __future__ import annotations

import json
import signal
import sys

import yaml

from tests.helpers import Place, rows_of, wait_until
from tests.mqtt.mqtt_bridge import Bridge, bridge_or_skip, ended, running_bridge
from tests.pages.blocks import ROOT

DOCKER = ROOT / "docker"


def test_the_services_of_the_compose_file_are_a_twin(place: Place) -> None:
    bridge_or_skip()
    services = yaml.safe_load((DOCKER / "twin.compose.yaml").read_text(encoding="utf-8"))["services"]
    ports = Bridge.on_free_ports()
    endpoint = f"tcp/127.0.0.1:{ports.zenoh}"
    config = (DOCKER / "twin_bridge.json5").read_text(encoding="utf-8")
    assert services["bridge"]["command"] == ["-c", "/bridge.json5"]
    mounted = dict(volume.split(":")[1::-1] for volume in services["twin"]["volumes"])
    file = mounted["/configs/pump_twin.yaml"]
    command = [str(DOCKER / file) if own == "/configs/pump_twin.yaml" else own for own in services["twin"]["command"]]

    router = place.start_command([sys.executable, "-m", "fmu_mesh", "router", "--listen", endpoint])
    for inside, outside in (("tcp/router:7447", endpoint), ("0.0.0.0:1883", ":1883"), ("0.0.0.0:8000", ":8000")):
        assert inside in config
        config = config.replace(inside, outside if "tcp" in outside else f"127.0.0.1{outside}")
    with running_bridge(place, ports, ports.translated(config)) as bridge:
        wait_until(lambda: "ready" in bridge.output, "the link of the bridge")
        reader = place.start_command(ports.subscribe("-v", "-t", "twin/#"))
        twin = place.start(
            *[endpoint if own == "tcp/router:7447" else own for own in command], "--output", place.folder / "twin.csv"
        )
        wait_until(lambda: "twin/pump/flow" in reader.output, "the first flow")
        # Without a header, curl says that the content is that of a form.
        ended(place, ports.curl("plant/pump/speed", "-X", "PUT", "-d", '{"rpm": 2400}'))
        wait_until(lambda: reader.output.count("twin/pump/flow") == 2, "the flow of the measured speed")
        known = reader.output.count("twin/pump/forecast")
        wait_until(lambda: reader.output.count("twin/pump/forecast") > known, "a forecast after it")
        place.run("stop", "pump_twin")
        assert twin.wait() == 0, twin.story()
    router.signal(signal.SIGINT)
    router.wait()

    rows = rows_of(place.folder / "twin.csv")
    lines = [line.partition(" ") for line in reader.output.splitlines()]
    forecasts = [json.loads(payload) for key, _, payload in lines if key == "twin/pump/forecast"]
    assert [one["value"] for one in forecasts] == [rows[one["point"]][4] for one in forecasts]
    assert forecasts[-1]["value"] > 50.0
