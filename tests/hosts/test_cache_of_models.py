"""The files of models on the way to another host, and the cache there: what is sent, kept, damaged, used, and old."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import msgspec
import pytest

from fmu_mesh.errors import ConfigurationError
from fmu_mesh.hosts.cache import Cache
from fmu_mesh.hosts.content import Content
from fmu_mesh.run.run_plan import NodeRun, encoded
from tests.helpers import FMUS, write_config
from tests.planning import plan_run

COMPONENT = """
from pathlib import Path

import fmu_mesh
from helper import gain


class Amplifier(fmu_mesh.Component):
    u = fmu_mesh.Input()
    y = fmu_mesh.Output()

    def step(self, time, step_size):
        self.y = gain * self.u
"""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cache:
    monkeypatch.setenv("FMU_MESH_CACHE_DIR", str(tmp_path / "cache"))
    return Cache()


def content_of(folder: Path, **instances: dict[str, object]) -> tuple[Content, dict[str, NodeRun]]:
    """What nodes with these instances need, and what they get."""
    run = plan_run(write_config(folder, instances=instances, connections=[], name="mesh"))
    records = [Path(record.file) for record in run.plan.system.records]
    nodes = {name: run.node(name) for name in instances}
    return Content("b", [node.plan for node in nodes.values()], [], records), nodes


def sent(content: Content, cache: Cache) -> list[str]:
    """Send what is missing; returns its names."""
    missing = cache.missing(content.trees)
    for sha in missing:
        data = content.files[sha].read_bytes()
        cache.take(sha, data[:100], last=False)
        cache.take(sha, data[100:], last=True)
    cache.make(content.trees)
    return sorted(content.files[sha].name for sha in missing)


@pytest.fixture
def component(tmp_path: Path) -> Path:
    (folder := tmp_path / "own").mkdir()
    (folder / "amplifier.py").write_text(COMPONENT, encoding="utf-8")
    (folder / "helper.py").write_text("gain = 2.0\n", encoding="utf-8")
    (folder / "__pycache__").mkdir()
    (folder / "__pycache__" / "old.pyc").write_bytes(b"old")
    return folder


def test_each_file_of_a_component_is_sent_once_and_results_never(component: Path, cache: Cache) -> None:
    def offered() -> Content:
        return content_of(component, amplifier={"python": "amplifier.py:Amplifier", "step_size": 0.1})[0]

    first = sent(offered(), cache)
    (component / "mesh.csv").write_text("time\n", encoding="utf-8")
    (component / "helper.py").write_text("gain = 3.0\n", encoding="utf-8")
    second = sent(offered(), cache)

    assert {"amplifier.py", "helper.py"} <= {*first}
    assert "old.pyc" not in first
    assert second == ["helper.py"]
    assert sent(offered(), cache) == []


def test_paths_of_a_plan_lead_into_the_cache(tmp_path: Path, cache: Cache) -> None:
    gain = FMUS / "Gain.fmu"
    content, nodes = content_of(tmp_path, gain={"fmu": str(gain)})
    sent(content, cache)

    moved = msgspec.msgpack.decode(content.moved(encoded(nodes["gain"]), str(cache.trees)))

    path = Path(moved["plan"]["instances"][0]["fmu"])
    assert path.is_relative_to(cache.trees)
    assert path.read_bytes() == gain.read_bytes()


def test_a_damaged_content_is_sent_again(tmp_path: Path, cache: Cache) -> None:
    content, _ = content_of(tmp_path, gain={"fmu": "Gain"})
    sent(content, cache)
    [file] = cache.trees.glob("*/*.fmu")
    file.chmod(0o600)
    file.write_bytes(b"damaged")

    assert sent(content, Cache()) == ["Gain.fmu"]


def test_a_content_that_changed_on_the_way_is_refused(tmp_path: Path, cache: Cache) -> None:
    content, _ = content_of(tmp_path, gain={"fmu": "Gain"})
    [sha] = cache.missing(content.trees)

    with pytest.raises(OSError, match="changed on the way"):
        cache.take(sha, b"something else", last=True)
    cache.close()

    assert not [file for file in cache.folder.rglob("*") if file.is_file()]


def test_what_was_not_used_for_long_goes_unless_a_helper_uses_it(tmp_path: Path, cache: Cache) -> None:
    old, used, new = (
        content_of(tmp_path, one={"fmu": name})[0] for name in ("Gain", "TransportDelay", "DampedPendulum")
    )
    sent(old, nobody := Cache())
    nobody.close()
    sent(used, holder := Cache())
    long_ago = time.time() - 100 * 86400
    for place in [*cache.trees.iterdir(), *(cache.folder / "contents").iterdir()]:
        os.utime(place, (long_ago, long_ago))

    sent(new, cache)

    assert {place.name for place in cache.trees.iterdir()} == {*used.trees, *new.trees}
    assert {place.name for place in (cache.folder / "contents").iterdir()} == {*used.files, *new.files}
    assert holder.missing(used.trees) == ()


def test_a_folder_with_too_many_files_is_refused_with_what_to_do(component: Path) -> None:
    for number in range(10_001):
        (component / f"{number}.txt").touch()

    with pytest.raises(ConfigurationError, match="a folder of its own"):
        content_of(component, amplifier={"python": "amplifier.py:Amplifier", "step_size": 0.1})
    shutil.rmtree(component)
