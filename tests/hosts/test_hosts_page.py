"""The commands of `docs/hosts.md`, and those of the README for several hosts, typed on two hosts as they stand.

Each host has a real sshd, and is what the page calls `lab2`, or the host where a reader types `launch`. With
`FMU_MESH_HOSTS`, the page's installation is typed, too: into a new virtual environment, from wheels, as there is no
network to a package index. Otherwise `~/mesh` there is the environment of these tests.
"""

from __future__ import annotations

import importlib.metadata
import os
import shutil
import signal
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import psutil
import pytest
import yaml
from hatchling.builders.wheel import WheelBuilder
from msgspec.structs import replace
from packaging.requirements import Requirement

from tests.helpers import Launched, wait_until
from tests.network_hosts import NetworkHost
from tests.pages.blocks import ROOT, Block, blocks_of
from tests.ssh_hosts import NEEDS_SSH, ssh_hosts

pytestmark = NEEDS_SSH

IS_LONG: Final = "FMU_MESH_HOSTS" in os.environ
INSTALL_S: Final = 300.0
ADDRESSES: Final = {"192.168.1.2": "10.77.0.1", "192.168.1.3": "10.77.0.2"}
"""Of both hosts here, by those of the page."""

BLOCKS: Final = blocks_of(ROOT / "docs" / "hosts.md")
LOCAL: Final = "one_host.csv"
README: Final = (ROOT / "README.md").read_text(encoding="utf-8")


def block(beginning: str) -> Block:
    """A block of the page, with the addresses of both hosts."""
    [found] = [one for one in BLOCKS if one.text.startswith(beginning)]
    text = found.text
    for shown, own in ADDRESSES.items():
        text = text.replace(shown, own)
    return replace(found, text=text)


def typed(host: NetworkHost, line: str) -> Launched:
    """A command as a reader types it, with the environment of fmu_mesh active."""
    paths = ["/tmp/home/mesh/bin", f"{sys.prefix}/bin", os.environ["PATH"]]  # noqa: S108  of the host
    return host.start("sh", "-c", line, PATH=":".join(paths))


def done(launched: Launched, deadline_s: float = 60.0) -> Launched:
    assert launched.wait(deadline_s) == 0, launched.story()
    return launched


def needed(name: str, found: dict[str, importlib.metadata.Distribution]) -> None:
    """Find the distributions that one needs, and those that they need."""
    for text in importlib.metadata.requires(name) or ():
        requirement = Requirement(text)
        if requirement.name not in found and (requirement.marker is None or requirement.marker.evaluate({"extra": ""})):
            found[requirement.name] = importlib.metadata.distribution(requirement.name)
            needed(requirement.name, found)


def packed(distribution: importlib.metadata.Distribution, folder: Path) -> None:
    """Make a wheel of what is installed here; pip there makes its commands again."""
    about = distribution.read_text("WHEEL") or ""
    tag = next(line.removeprefix("Tag: ") for line in about.splitlines() if line.startswith("Tag: "))
    name = distribution.metadata["Name"].replace("-", "_").replace(".", "_")
    with zipfile.ZipFile(folder / f"{name}-{distribution.version}-{tag}.whl", "w") as wheel:
        for path in distribution.files or ():
            if path.parts[0] != ".." and "__pycache__" not in path.parts:
                wheel.write(str(path.locate()), str(path))


def install(here: NetworkHost, shared: Path) -> None:
    """Type the installation of the page."""
    (wheels := shared / "wheels").mkdir()
    found: dict[str, importlib.metadata.Distribution] = {}
    needed("fmu-mesh", found)
    for distribution in found.values():
        packed(distribution, wheels)
    [*WheelBuilder(str(ROOT)).build(directory=str(here.folder / "own-clone"), versions=["standard"])]
    for command in block("ssh user@lab2 python3 -m venv mesh").commands(None):
        done(typed(here, command.line), INSTALL_S)


@pytest.fixture(scope="module")
def labs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[NetworkHost, NetworkHost]]:
    """The host where a reader types, and lab2, which has nothing but fmu_mesh."""
    with ssh_hosts(folder := tmp_path_factory.mktemp("labs"), ("lab1", "lab2")) as entered:
        here, there = entered.hosts
        if IS_LONG:
            own = f"PATH={sys.base_prefix}/bin:/usr/bin:/bin PIP_NO_INDEX=1 PIP_FIND_LINKS=/mnt/wheels"
            entered.serve(there, {"SetEnv": own})
            install(here, folder / "shared")
        else:
            (there.home / "mesh").symlink_to(sys.prefix)
        for part in ("configs", "fmus"):
            shutil.move(there.folder / "own-clone" / part, there.folder / "kept" / part)
        yield here, there


def written(host: NetworkHost, changes: dict[str, Any] | None = None) -> None:
    """The file of the page, with these changes; a host of `deploy` keeps the entries that are not changed."""
    file = block("mesh: two_hosts")
    content = yaml.safe_load(file.text)
    for section, own in (changes or {}).items():
        if section == "deploy" and own["hosts"]["lab2"]:
            own["hosts"]["lab2"] = content["deploy"]["hosts"]["lab2"] | own["hosts"]["lab2"]
        content[section] = own
    text = yaml.safe_dump(content, sort_keys=False) if changes else file.text
    (host.folder / "own-clone" / file.detail).write_text(text, encoding="utf-8")


def fragment(beginning: str) -> dict[str, Any]:
    """A part of a file that the page shows."""
    content: dict[str, Any] = yaml.safe_load(block(beginning).text)
    return content


def results(host: NetworkHost) -> tuple[bytes, bytes]:
    """The results of one host and of two; the second one is removed."""
    folder = host.folder / "own-clone" / "results"
    both = (folder / LOCAL).read_bytes(), (folder / "two_hosts.csv").read_bytes()
    (folder / "two_hosts.csv").unlink()
    return both


@pytest.fixture(scope="module")
def compared(labs: tuple[NetworkHost, NetworkHost]) -> tuple[NetworkHost, NetworkHost, list[Launched]]:
    """The five commands of the page, each of which has succeeded."""
    here, there = labs
    written(here)
    commands = block("ssh -o BatchMode=yes user@lab2 true").commands(None)
    return here, there, [done(typed(here, command.line)) for command in commands]


def test_five_commands_lead_from_one_host_to_two(
    compared: tuple[NetworkHost, NetworkHost, list[Launched]],
) -> None:
    here, there, commands = compared

    assert len(commands) == 5
    assert commands[1].output.split()[-1] == importlib.metadata.version("fmu-mesh")
    assert "equal" in commands[-1].output
    one, two = results(here)
    assert one == two
    assert [path.name for path in (there.home / ".cache" / "fmu_mesh" / "hosts").rglob("TransportDelay*")]
    if IS_LONG:
        assert [*(there.home / "mesh" / "lib").glob("python*/site-packages/fmu_mesh/api")]


def test_check_shows_who_runs_where(labs: tuple[NetworkHost, NetworkHost]) -> None:
    here, _ = labs
    written(here)
    command, *shown = block("$ fmu-mesh check two_hosts.yaml").text.splitlines()

    checked = done(typed(here, command.removeprefix("$ ")))

    assert {*shown} - {"..."} <= {*checked.output.splitlines()}


def test_rows_go_directly_where_the_file_says_so(
    compared: tuple[NetworkHost, NetworkHost, list[Launched]],
) -> None:
    here, _, _ = compared
    written(here, fragment("zenoh: {insecure: true}"))

    launched = done(typed(here, "fmu-mesh launch two_hosts.yaml"))

    assert "by Zenoh" not in launched.errors
    one, two = results(here)
    assert one == two


@pytest.fixture
def with_files(labs: tuple[NetworkHost, NetworkHost]) -> Iterator[None]:
    """Lab2 has the files and the models, too."""
    _, there = labs
    for part in ("configs", "fmus"):
        shutil.copytree(there.folder / "kept" / part, there.folder / "own-clone" / part)
    yield
    for part in ("configs", "fmus"):
        shutil.rmtree(there.folder / "own-clone" / part)


@pytest.mark.usefixtures("with_files")
def test_a_person_starts_the_nodes_of_a_host_without_ssh(
    compared: tuple[NetworkHost, NetworkHost, list[Launched]],
) -> None:
    here, there, _ = compared
    for host in (here, there):
        written(host, fragment("deploy: {hosts: {lab2: {}}}"))
    launch, shown, last = block("$ fmu-mesh launch two_hosts.yaml --listen").text.splitlines()

    launched = typed(here, launch.removeprefix("$ "))
    wait_until(lambda: "start on" in launched.errors or not launched.running, "the command of lab2")
    assert shown in launched.errors.splitlines(), launched.story()
    by_hand = typed(there, shown.partition(": ")[2])

    done(launched)
    done(by_hand)
    assert last in launched.errors.splitlines()
    one, two = results(here)
    assert one == two


@pytest.mark.usefixtures("with_files")
def test_the_commands_of_the_readme_run_over_two_hosts(labs: tuple[NetworkHost, NetworkHost]) -> None:
    here, there = labs
    [own] = [one for one in blocks_of(ROOT / "README.md") if one.text.startswith("fmu-mesh master CONFIG")]
    lines = [command.line.replace("CONFIG", "configs/pendulum_delay.yaml") for command in own.commands(None)]
    master, pendulum, delay = lines
    router = "fmu-mesh router --listen tcp/0.0.0.0:7447 --insecure"
    assert f"`{router}`" in README
    result = here.folder / "own-clone" / "results" / "pendulum_delay.csv"
    done(typed(here, "fmu-mesh launch configs/pendulum_delay.yaml --local"))
    expected = result.read_bytes()
    result.unlink()

    meeting = typed(here, router)
    wait_until(lambda: meeting.output or meeting.errors or not meeting.running, "a router that listens")
    parts = [typed(here, master), typed(here, pendulum), typed(there, delay)]

    for part in parts:
        done(part)
    assert result.read_bytes() == expected
    for process in psutil.Process(meeting.pid).children(recursive=True):  # of `nsenter`, which passes nothing on
        process.send_signal(signal.SIGINT)
    assert meeting.wait() in {0, -signal.SIGINT}, meeting.story()
