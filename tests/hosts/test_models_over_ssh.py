"""What instances on another host read goes there: folders of components, tables, FMUs in archives; what is missing."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final
from zipfile import ZipFile

import psutil
import pytest
import yaml

from tests.helpers import on_a_busy_machine
from tests.network_hosts import NetworkHost
from tests.ssh_hosts import NEEDS_SSH, PYTHON, SshHosts, ssh_hosts
from tests.ssh_meshes import mesh_over_ssh

pytestmark = NEEDS_SSH

COMPONENT: Final = """
from pathlib import Path

import fmu_mesh
from helper import gain

OFFSET = float(Path(__file__).with_name("data").joinpath("offset.txt").read_text())


class Amplifier(fmu_mesh.Component):
    u = fmu_mesh.Input()
    y = fmu_mesh.Output()

    def step(self, time, step_size):
        self.y = gain * self.u + OFFSET
"""

INSTANCES: Final[dict[str, dict[str, Any]]] = {
    "pendulum": {"fmu": "models.zip/DampedPendulum.fmu", "start_values": {"a": 1.3}, "host": "b"},
    "amplifier": {"python": "parts/amplifier.py:Amplifier", "step_size": 0.01, "host": "b"},
    "gain": {"fmu": "Gain.fmu", "host": "b"},
    "delay": {"fmu": "TransportDelay.fmu"},
}


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SshHosts]:
    with ssh_hosts(tmp_path_factory.mktemp("pair")) as entered:
        yield entered


def written(host: NetworkHost, deploy: dict[str, Any], **sections: object) -> Path:
    """A mesh whose models are of many kinds, in a folder of the host; its configuration."""
    shutil.rmtree(folder := host.folder / "own-clone" / "many", ignore_errors=True)
    (folder / "parts" / "data").mkdir(parents=True)
    (folder / "parts" / "amplifier.py").write_text(COMPONENT, encoding="utf-8")
    (folder / "parts" / "helper.py").write_text("gain = 2.5\n", encoding="utf-8")
    (folder / "parts" / "data" / "offset.txt").write_text("0.125", encoding="utf-8")
    (folder / "gains.csv").write_text("time,k\n0,1\n0.5,3\n1,2\n", encoding="utf-8")
    fmus = host.folder / "own-clone" / "fmus"
    for name in ("Gain", "TransportDelay"):
        shutil.copy(fmus / f"{name}.fmu", folder)
    with ZipFile(folder / "models.zip", "w") as archive:
        archive.write(fmus / "DampedPendulum.fmu", "DampedPendulum.fmu")
    content = {
        "mesh": "many",
        "simulation": {"stop_time": 2.0, "step_size": 0.01},
        "instances": INSTANCES,
        "connections": ["pendulum.a -> amplifier.u", "amplifier.y -> delay.x"],
        "scenario": {"values": {"gain.u": {"file": "gains.csv", "column": "k"}}},
        "record": {"file": "many.csv"},
        "deploy": {"hosts": {"b": {"ssh": "b", "python": PYTHON, **deploy}}},
        **sections,
    }
    (folder / "many.yaml").write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return folder / "many.yaml"


@pytest.mark.parametrize(
    "deploy",
    [{}, {"rows": "tcp"}, {"rows": "tcp", "ssh": "other", "address": "10.77.0.2"}],
    ids=["sockets", "tcp", "tcp to a name of ssh"],
)
def test_models_of_all_kinds_go_to_the_other_host(pair: SshHosts, deploy: dict[str, str]) -> None:
    here = pair["a"]
    config = written(here, deploy, zenoh={"insecure": "rows" in deploy})
    names = "Host other\n  HostName b\nHost *\n  StrictHostKeyChecking yes\n"  # only ssh knows the first one
    (here.home / ".ssh" / "config").write_text(names, encoding="utf-8")
    shutil.rmtree(pair["b"].folder / "own-clone" / "fmus", ignore_errors=True)

    results = []
    for options in ([], ["--local"]):
        launched = here.start("fmu-mesh", "launch", "many/many.yaml", "--no-progress", *options)
        assert launched.wait() == 0, launched.story()
        assert "by Zenoh" not in launched.errors
        results.append(config.with_name("many.csv").read_bytes())

    assert results[0] == results[1]
    assert len(results[0].splitlines()) == 202


def test_what_a_model_misses_there_is_told_before_anything_starts(pair: SshHosts) -> None:
    here = pair["a"]
    config = written(here, {})
    (modules := here.folder / "own-clone" / "modules").mkdir(exist_ok=True)
    (modules / "only_here.py").write_text("", encoding="utf-8")
    component = config.with_name("parts") / "amplifier.py"
    component.write_text(f"import only_here\n{COMPONENT}", encoding="utf-8")

    launched = here.start(
        "fmu-mesh",
        "launch",
        "many/many.yaml",
        "--no-progress",
        PYTHONPATH="/tmp/own-clone/modules",  # noqa: S108  of the host
    )

    assert launched.wait() == 2, launched.story()
    assert "b cannot run 'amplifier'" in launched.message
    assert "No module named 'only_here'" in launched.message
    assert not config.with_name("many.csv").exists()


def test_a_stopped_helper_is_woken_by_its_nodes_and_ends(pair: SshHosts) -> None:
    with mesh_over_ssh(pair, lasts_s=600.0, timeouts={"link": 3.0}) as mesh:
        launched = mesh.running()
        helper = next(one for one in pair["b"].processes() if "fmu_mesh.hosts.helper" in _line(one))

        helper.suspend()

        assert launched.wait() == 4, mesh.story()
        assert "the ssh connection to b was lost (silent for 3 s" in launched.message
        mesh.assert_nothing_left(on_a_busy_machine(8.0))


def _line(process: psutil.Process) -> str:
    try:
        return " ".join(process.cmdline())
    except psutil.Error:
        return ""
