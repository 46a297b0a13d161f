"""The commands of docker/compose.yaml, run as plain processes, give the result of one process, byte for byte.

A router of the Zenoh wheel stands in for the router's image; besides that only the host name and the paths of
the containers are replaced.
"""

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import yaml

DOCKER = Path(__file__).parents[2] / "docker"
RUN_DEADLINE_S = 50.0


@pytest.fixture
def router() -> Iterator[str]:
    """The endpoint of a router that runs as long as the test."""
    command = [sys.executable, str(Path(__file__).with_name("zenoh_router.py"))]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        endpoint = process.stdout.readline().strip()
        assert endpoint.startswith("tcp/127.0.0.1:")
        yield endpoint
        process.communicate(timeout=10)


@pytest.fixture
def compose() -> dict[str, Any]:
    loaded = yaml.safe_load((DOCKER / "compose.yaml").read_text(encoding="utf-8"))
    assert isinstance(loaded, dict)
    return loaded


def outside_of_containers(service: dict[str, Any], endpoint: str, results: Path) -> Callable[[str], str]:
    """Translate an argument of ``service`` to this machine: mounted paths and the host name of the router."""
    volumes = [volume.split(":")[:2] for volume in service["volumes"]]
    places = {inside: str(results if source == "results" else DOCKER / source) for source, inside in volumes}

    def replaced(argument: str) -> str:
        if argument.startswith("tcp/router:"):
            return endpoint
        for inside, place in places.items():
            if argument == inside or argument.startswith(f"{inside}/"):
                return place + argument.removeprefix(inside)
        return argument

    return replaced


def fmu_mesh(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "fmu_mesh", *arguments]


def test_the_services_of_compose_give_the_result_of_one_process(
    compose: dict[str, Any], router: str, tmp_path: Path
) -> None:
    reference = tmp_path / "local.csv"
    config = str(DOCKER / "pendulum_delay.yaml")
    local = fmu_mesh("launch", config, "--local", "--no-progress", "--output", str(reference))
    subprocess.run(local, check=True, timeout=RUN_DEADLINE_S)
    services = {name: service for name, service in compose["services"].items() if name != "router"}
    # The order of `depends_on`: the master comes last.
    ordered = sorted(services, key=lambda name: len(services[name]["depends_on"]))

    with ExitStack() as stack:
        running = {}
        for name in ordered:
            replaced = outside_of_containers(services[name], router, tmp_path)
            command = fmu_mesh(*map(replaced, services[name]["command"]))
            running[name] = stack.enter_context(subprocess.Popen(command, stdin=subprocess.DEVNULL))
            stack.callback(running[name].kill)
        exit_codes = {name: running[name].wait(RUN_DEADLINE_S) for name in reversed(ordered)}

    assert exit_codes == dict.fromkeys(services, 0)
    assert (tmp_path / "pendulum_delay.csv").read_bytes() == reference.read_bytes()
