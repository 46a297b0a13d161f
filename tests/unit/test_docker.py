"""The files in docker/ keep their promises: small, pinned, not root, and one service per instance.

They are read, not run; `tests/equivalence/test_compose.py` and `tests/mqtt/test_twin_compose.py` run the commands, and
`tests/hosts/test_containers.py` the containers.
"""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
import zenoh
from dockerfile_parse import DockerfileParser

ROOT = Path(__file__).parents[2]
DOCKER = ROOT / "docker"
EXACT_VERSION = re.compile(r":\d+\.\d+\.\d+([.-][\w.-]+)?$")


@pytest.fixture(scope="module")
def instructions() -> list[tuple[str, str]]:
    parser = DockerfileParser(path=str(DOCKER / "Dockerfile"))
    return [(entry["instruction"], entry["value"]) for entry in parser.structure]


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    loaded = yaml.safe_load((DOCKER / "compose.yaml").read_text(encoding="utf-8"))
    assert isinstance(loaded, dict)
    return loaded


@pytest.fixture(scope="module")
def twin() -> dict[str, Any]:
    loaded = yaml.safe_load((DOCKER / "twin.compose.yaml").read_text(encoding="utf-8"))
    assert isinstance(loaded, dict)
    return loaded


@pytest.fixture(scope="module")
def mesh_config() -> dict[str, Any]:
    loaded = yaml.safe_load((DOCKER / "pendulum_delay.yaml").read_text(encoding="utf-8"))
    assert isinstance(loaded, dict)
    return loaded


def final_stage(instructions: list[tuple[str, str]]) -> list[tuple[str, str]]:
    last = max(index for index, (name, _) in enumerate(instructions) if name == "FROM")
    return instructions[last:]


def test_the_final_stage_takes_over_only_what_an_earlier_one_built(
    instructions: list[tuple[str, str]],
) -> None:
    stages = [value for name, value in instructions if name == "FROM"]
    copies = [value for name, value in final_stage(instructions) if name == "COPY"]

    assert len(stages) >= 2
    assert copies
    assert all(copy.startswith("--from=build ") for copy in copies)


def test_every_base_image_is_pinned_to_an_exact_version(instructions: list[tuple[str, str]]) -> None:
    images = [value.split()[0] for name, value in instructions if name == "FROM"]
    defaults = dict(value.split("=", 1) for name, value in instructions if name == "ARG")

    assert set(images) == {"${BASE}"}
    assert EXACT_VERSION.search(defaults["BASE"])


def test_the_image_runs_as_a_user_of_its_own(instructions: list[tuple[str, str]]) -> None:
    final = final_stage(instructions)
    users = [value for name, value in final if name == "USER"]
    created = " ".join(value for name, value in final if name == "RUN")

    assert users
    assert int(users[-1]) > 0
    assert re.search(rf"useradd .*--uid {users[-1]}\b", created)


def test_the_entry_point_is_the_command_of_the_package(instructions: list[tuple[str, str]]) -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]
    entry_points = [value for name, value in final_stage(instructions) if name == "ENTRYPOINT"]

    assert entry_points == ['["fmu-mesh"]']
    assert "fmu-mesh" in scripts


def test_whatever_the_build_copies_exists_and_reaches_the_build_context(
    instructions: list[tuple[str, str]],
) -> None:
    ignore = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    let_in = {line.removeprefix("!") for line in ignore if line.startswith("!")}
    copied = {
        source
        for name, value in instructions
        if name == "COPY" and not value.startswith("--from=")
        for source in value.split()[:-1]
    }

    assert "*" in ignore
    assert copied == let_in
    assert [source for source in copied if not (ROOT / source).exists()] == []


def test_every_dependency_of_the_package_has_an_exact_version_in_the_image() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (DOCKER / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = dict(line.lower().split("==") for line in lines if not line.startswith("#"))
    requirements = [*project["dependencies"], *project["optional-dependencies"]["security"]]
    needed = {re.split(r"[<>=\[;]", requirement)[0].lower() for requirement in requirements}

    assert needed <= pins.keys()


def test_the_job_in_docker_is_the_main_job(mesh_config: dict[str, Any]) -> None:
    main_job = yaml.safe_load((ROOT / "configs" / "pendulum_delay.yaml").read_text(encoding="utf-8"))

    assert {key: value for key, value in mesh_config.items() if key != "zenoh"} == main_job


def test_compose_has_a_router_a_node_per_instance_and_a_master(
    compose: dict[str, Any], mesh_config: dict[str, Any]
) -> None:
    commands = {name: service["command"] for name, service in compose["services"].items()}
    instances = set(mesh_config["instances"])

    assert commands.keys() == {"router", "master"} | instances
    assert {commands[instance][2] for instance in instances} == instances
    assert {commands[instance][0] for instance in instances} == {"node"}
    assert commands["master"][0] == "master"


def test_the_router_is_the_official_image_of_the_series_that_nodes_speak(compose: dict[str, Any]) -> None:
    image, _, version = compose["services"]["router"]["image"].partition(":")
    pins = (DOCKER / "constraints.txt").read_text(encoding="utf-8")

    assert image == "eclipse/zenoh"
    assert re.fullmatch(r"\d+\.\d+\.\d+", version)
    assert f"eclipse-zenoh=={version.rpartition('.')[0]}." in pins


def test_every_process_meets_the_others_at_the_router(compose: dict[str, Any], mesh_config: dict[str, Any]) -> None:
    listening = compose["services"]["router"]["command"]
    port = listening[listening.index("--listen") + 1].rpartition(":")[2]
    own = {name: service for name, service in compose["services"].items() if name != "router"}

    for service in own.values():
        command = service["command"]
        assert command[command.index("--connect") + 1] == f"tcp/router:{port}"
        assert service["depends_on"]["router"] == {"condition": "service_healthy"}
    assert mesh_config["zenoh"] == {"mode": "client", "connect": [f"tcp/router:{port}"], "insecure": True}
    assert port in compose["services"]["router"]["healthcheck"]["test"]


def test_a_container_that_ended_stays_ended_and_is_stopped_within_seconds(
    compose: dict[str, Any], twin: dict[str, Any]
) -> None:
    for service in (*compose["services"].values(), *twin["services"].values()):
        assert service["restart"] == "no"
        assert service["init"] is True
        assert int(service["stop_grace_period"].removesuffix("s")) <= 10


def test_the_results_outlive_the_master_in_a_volume(compose: dict[str, Any]) -> None:
    master = compose["services"]["master"]
    output = master["command"][master["command"].index("--output") + 1]

    assert "results" in compose["volumes"]
    assert f"results:{Path(output).parent}" in master["volumes"]


def test_nothing_is_open_to_the_network_of_the_host(compose: dict[str, Any]) -> None:
    assert compose["networks"] == {"mesh": {"internal": True}}
    for service in compose["services"].values():
        assert service["networks"] == ["mesh"]
        assert "ports" not in service
        assert "network_mode" not in service


def test_what_is_mounted_exists(compose: dict[str, Any], twin: dict[str, Any]) -> None:
    for whole in (compose, twin):
        for service in whole["services"].values():
            for volume in service.get("volumes", []):
                source = volume.split(":")[0]
                assert source in whole["volumes"] or (DOCKER / source).exists()


def test_the_ports_of_the_twin_are_published_for_its_host_only(twin: dict[str, Any]) -> None:
    services = twin["services"]

    assert services["bridge"]["ports"] == ["127.0.0.1:1883:1883", "127.0.0.1:8000:8000"]
    assert [name for name, service in services.items() if "ports" in service] == ["bridge"]
    assert [name for name, service in services.items() if service["networks"] != ["mesh"]] == ["bridge"]
    assert twin["networks"]["mesh"] == {"internal": True}


def test_router_and_image_of_the_twin_are_those_of_the_main_job(compose: dict[str, Any], twin: dict[str, Any]) -> None:
    router = compose["services"]["router"]
    version = router["image"].partition(":")[2]

    assert {name: twin["services"]["router"][name] for name in ("image", "command", "healthcheck")} == {
        name: router[name] for name in ("image", "command", "healthcheck")
    }
    assert twin["services"]["bridge"]["image"] == f"eclipse/zenoh-bridge-mqtt:{version}"
    assert twin["services"]["twin"]["build"] == compose["services"]["master"]["build"]


def test_the_bridge_in_docker_has_the_settings_of_the_one_outside() -> None:
    inside = zenoh.Config.from_file(str(DOCKER / "twin_bridge.json5"))
    outside = zenoh.Config.from_file(str(ROOT / "bridges" / "zenoh" / "config.json5"))

    for key in (
        "mode",
        "connect/timeout_ms",
        "connect/exit_on_failure",
        "connect/retry",
        "scouting",
        "low_pass_filter",
    ):
        assert inside.get_json(key) == outside.get_json(key), key
    assert json.loads(inside.get_json("plugins/mqtt")) == {"port": "0.0.0.0:1883"}
    assert json.loads(inside.get_json("plugins/rest")) == {"http_port": "0.0.0.0:8000"}
    assert json.loads(outside.get_json("plugins/mqtt")) == {"port": "127.0.0.1:1883"}
    assert json.loads(outside.get_json("plugins/rest")) == {"http_port": "127.0.0.1:8000"}
