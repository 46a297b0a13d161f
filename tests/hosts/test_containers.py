"""Containers: the image, `docker/compose.yaml`, and what `render compose` writes, run by podman-compose.

`.ci/long containers` makes the images, and gives Podman a storage of its own. An image that stands for the router's has
its name, so the files are run as they are.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import psutil
import pytest

from fmu_mesh.wire.security.authority import Authority
from tests.helpers import DEADLINE_S, FAILING, FMUS, Place, row_count, wait_until, write_config

pytestmark = pytest.mark.skipif(
    "FMU_MESH_CONTAINERS" not in os.environ, reason="it needs images and Podman; `.ci/long containers` has them"
)

DOCKER = Path(__file__).resolve().parents[2] / "docker"


class Containers:
    """The containers of one compose file. Use it as a context manager: at its end, nothing may be left.

    Args:
        place: where Podman is started.
        file: the compose file.
    """

    def __init__(self, place: Place, file: Path) -> None:
        self._place = place
        self._file = file
        self._devices = _devices()

    def compose(self, *words: str) -> str:
        """What podman-compose prints; it ends with 0 whatever the containers do."""
        done = self._place.start_command(["podman-compose", "-p", "pair", "-f", str(self._file), *words])
        assert done.wait() == 0, done.story()
        return done.output

    def podman(self, *words: str) -> str:
        """What Podman prints, which must not fail."""
        done = self._place.start_command(["podman", *words])
        assert done.wait() == 0, done.story()
        return done.output

    def start(self, *nodes: str) -> None:
        """Start the master, then the nodes: with Podman's name server, a node may not find a name that comes later."""
        self.compose("run", "-d", "--no-deps", "--name", "pair-master", "master")
        self.compose("up", "-d", *nodes)

    def exit_code(self, container: str) -> int:
        """The exit code of a container, once it has ended."""
        return int(self.podman("wait", container))

    def words(self, container: str) -> str:
        """What a container has written."""
        done = self._place.start_command(["podman", "logs", container])
        assert done.wait() == 0, done.story()
        return done.output + done.errors

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            for container in self.podman("ps", "--all", "--format", "{{.Names}}").split():
                self.podman("logs", "--timestamps", container)  # for the report
        self.compose("down", "-v")
        self.podman("network", "rm", "--force", "pair_mesh")  # which `down` of Debian's podman-compose leaves
        assert self.podman("ps", "--all", "--quiet") == ""
        assert self.podman("volume", "ls", "--quiet") == ""
        assert self.podman("network", "ls", "--format", "{{.Name}}").split() == ["podman"]  # which is Podman's own
        assert _devices() == self._devices
        self._place.assert_nothing_left(DEADLINE_S)


def _devices() -> set[str]:
    """The network devices that Podman has made."""
    return {name for name in psutil.net_if_addrs() if name.startswith("podman")}


@pytest.fixture
def place() -> Iterator[Place]:
    with Place() as own:
        yield own


def mesh(
    place: Place,
    *,
    instances: Mapping[str, Mapping[str, Any]] | None = None,
    memory: str | None = None,
    stop_time: float = 20.0,
    real_time_factor: float = 0.0,
) -> Path:
    """Write a mesh of these instances, or of a pair with its models beside it; results get a folder of their own."""
    for name in ("DampedPendulum", "TransportDelay"):
        shutil.copy(FMUS / f"{name}.fmu", place.folder)
    pair = {
        "pendulum": {"fmu": "DampedPendulum.fmu", "process": {"memory": memory} if memory else {}},
        "delay": {"fmu": "TransportDelay.fmu", "start_values": {"d": 0.1}},
    }
    return write_config(
        place.folder,
        instances=instances or pair,
        connections=() if instances else ("pendulum.a -> delay.x",),
        stop_time=stop_time,
        simulation={"real_time_factor": real_time_factor},
        record={"file": "results/pair.csv"},
    )


def rendered(place: Place, config: Path, *, secured: bool = False) -> Path:
    """The compose file of a mesh, with certificates of an authority of this test or without."""
    words = ["--insecure"]
    if secured:
        authority = Authority.made(place.folder / "lab")
        authority.add("master", "node", 1.0, ["pair-master"])
        authority.add("node", "node", 1.0, [])
        words = ["--security", "lab"]
    file = place.folder / "compose.yaml"
    done = place.run("render", "compose", config, *words, "-o", file)
    assert done.wait() == 0, done.story()
    return file


def reference(place: Place, config: Path) -> bytes:
    """The result of a mesh in one process."""
    done = place.run("launch", config, "--local", "--output", "local.csv")
    assert done.wait() == 0, done.story()
    return (place.folder / "local.csv").read_bytes()


def test_the_compose_file_gives_the_result_of_one_process(place: Place) -> None:
    local = reference(place, DOCKER / "pendulum_delay.yaml")

    with Containers(place, DOCKER / "compose.yaml") as containers:
        containers.compose("up", "-d", "--no-build")

        assert containers.exit_code("pair_master_1") == 0, containers.words("pair_master_1")
        assert [containers.exit_code(f"pair_{node}_1") for node in ("pendulum", "delay")] == [0, 0]
        containers.podman("cp", "pair_pendulum_1:/results/pendulum_delay.csv", str(place.folder))
        assert (place.folder / "pendulum_delay.csv").read_bytes() == local


@pytest.mark.parametrize("secured", [False, True])
def test_rendered_services_give_the_result_of_launch(place: Place, *, secured: bool) -> None:
    local = reference(place, mesh(place))
    file = rendered(place, mesh(place, memory="512 MiB"), secured=secured)

    with Containers(place, file) as containers:
        containers.start("pendulum", "delay")

        assert containers.exit_code("pair-master") == 0, containers.words("pair-master")
        assert ("tls/" if secured else "tcp/") in containers.words("pair-master")
        assert [containers.exit_code(f"pair_{node}_1") for node in ("pendulum", "delay")] == [0, 0]
        assert (place.folder / "results" / "pair.csv").read_bytes() == local
        memory = containers.podman("inspect", "--format", "{{.HostConfig.Memory}}", "pair_pendulum_1")
        assert int(memory) == (512 << 20) + (256 << 20)


@pytest.mark.parametrize("secured", [False, True])
def test_a_killed_container_ends_the_run_with_code_four(place: Place, *, secured: bool) -> None:
    file = rendered(place, mesh(place, stop_time=1e4, real_time_factor=1.0), secured=secured)

    with Containers(place, file) as containers:
        containers.start("pendulum", "delay")
        wait_until(lambda: row_count(place.folder / "results" / "pair.csv") > 0, "rows")
        containers.podman("kill", "pair_delay_1")

        assert containers.exit_code("pair-master") == 4
        assert re.search(r"instance delay, point \d+, t = .*: node 'delay' was lost", containers.words("pair-master"))
        assert [containers.exit_code(f"pair_{node}_1") for node in ("pendulum", "delay")] == [4, 137]


def test_a_killed_master_ends_its_nodes(place: Place) -> None:
    file = rendered(place, mesh(place, stop_time=1e4, real_time_factor=1.0))

    with Containers(place, file) as containers:
        containers.start("pendulum", "delay")
        wait_until(lambda: row_count(place.folder / "results" / "pair.csv") > 0, "rows")
        containers.podman("kill", "pair-master")

        assert [containers.exit_code(f"pair_{node}_1") for node in ("pendulum", "delay")] == [4, 4]


def test_a_failing_instance_gives_the_master_code_three(place: Place) -> None:
    (place.folder / "failing.py").write_text(FAILING, encoding="utf-8")
    file = rendered(place, mesh(place, instances={"tank": {"python": "failing.py:Failing"}}))

    with Containers(place, file) as containers:
        containers.start("tank")

        assert containers.exit_code("pair-master") == 3
        assert "the tank is empty" in containers.words("pair-master")
