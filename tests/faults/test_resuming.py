"""A run whose launcher was killed too, or whose host lost its power: `--resume` goes on with it, or says why not."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import signal
import subprocess
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import psutil
import pytest
import yaml

import fmu_mesh
from fmu_mesh.cli.main import main
from fmu_mesh.results.formats import read_result
from fmu_mesh.wire.journal import JOURNAL, whole_lines
from tests.helpers import FMUS, Launched, Place, assert_readable, examples, row_count, wait_until

POINTS = 1500

PARTS = """
import fmu_mesh

class Filter(fmu_mesh.Component):
    v = fmu_mesh.Input()
    y = fmu_mesh.Output()

    def step(self, now, step_size):
        self.y = 0.5 * self.y + 0.1 * self.v + 0.1 * now
"""


def written(place: Place, ending: str = "csv", **sections: Any) -> Path:  # noqa: ANN401  they are sections
    """The configuration of a mesh that keeps what `--resume` needs."""
    (place.folder / "parts.py").write_text(PARTS, encoding="utf-8")
    shutil.copy(FMUS / "Gain.fmu", place.folder)
    content = {
        "mesh": "resumed",
        "simulation": {"stop_time": POINTS * 0.001, "step_size": 0.001},
        "instances": {
            "filter": {"python": "parts.py:Filter"},
            "gain": {"fmu": "Gain.fmu", "start_values": {"k": 0.5}},
        },
        "connections": ["filter.y -> gain.u"],
        "record": {"file": f"resumed.{ending}"},
        "recovery": {"directory": "kept"},
        **sections,
    }
    config = place.folder / "resumed.yaml"
    config.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return config


def undisturbed(config: Path, result: Path) -> Path:
    """What a run in one process records, without recovery."""
    content = yaml.safe_load(config.read_text(encoding="utf-8"))
    del content["recovery"]
    other = config.with_name("other.yaml")
    other.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    assert main(["launch", str(other), "--local", "--no-progress", "--output", str(result)]) == 0
    return result


def on_disk(config: Path) -> dict[str, Any]:
    """What the disk has for sure, as the directory says."""
    lines = whole_lines(config.with_name("kept") / "on_disk").lines
    found: dict[str, Any] = json.loads(lines[0]) if lines else {"files": [[0, 0]], "journals": {}}
    return found


def cut_off(place: Place, launched: Launched) -> None:
    """End everything at once, as a power cut does."""
    for process in [psutil.Process(launched.pid), *place.processes()]:
        with suppress(psutil.NoSuchProcess):
            process.kill()
    launched.close()


def begun(place: Place, config: Path) -> Launched:
    """A run of which the disk has rows; it is slow, and goes on at any pace."""
    launched = place.start("launch", config, "--no-progress", "--real-time-factor", "0.2")
    wait_until(lambda: on_disk(config)["files"][0][0] > 0 or not launched.running, "rows on the disk")
    return launched


@pytest.mark.parametrize("ending", ["csv", "parquet", "mcap"])
def test_a_run_that_lost_everything_goes_on(place: Place, ending: str) -> None:
    config = written(place, ending)
    cut_off(place, begun(place, config))

    resumed = place.run("launch", config, "--resume", "--no-progress")

    assert resumed.wait() == 0, resumed.story()
    assert "the run is resumed, and goes on from point" in resumed.errors + resumed.output
    result, other = config.with_suffix(f".{ending}"), place.folder / f"other.{ending}"
    found, wanted = read_result(result), read_result(undisturbed(config, other))
    assert found.times.tolist() == wanted.times.tolist()
    assert [own.tolist() for own in found.values.values()] == [own.tolist() for own in wanted.values.values()]
    assert ending != "csv" or result.read_bytes() == other.read_bytes()
    place.assert_nothing_left()
    again = place.run("launch", config, "--resume")
    assert again.wait() == 2
    assert "there is no run to resume in" in again.message


def test_a_run_that_was_restarted_can_be_resumed(place: Place) -> None:
    config = written(place, recovery={"mode": "restart", "directory": "kept"})
    launched = begun(place, config)
    launched.child("master").kill()
    launched.wait_for_error_line("restart 1 of 3")
    before = row_count(config.with_suffix(".csv"))
    wait_until(lambda: row_count(config.with_suffix(".csv")) > before or not launched.running, "a new row")
    cut_off(place, launched)

    resumed = place.run("launch", config, "--resume", "--no-progress")

    assert resumed.wait() == 0, resumed.story()
    wanted = undisturbed(config, place.folder / "other.csv").read_bytes()
    assert config.with_suffix(".csv").read_bytes() == wanted


def test_a_run_is_resumed_from_its_newest_whole_checkpoint(place: Place) -> None:
    config = written(place, recovery={"directory": "kept", "checkpoint_s": 0.05}, connections=["gain.y -> filter.v"])
    kept, launched = config.with_name("kept"), begun(place, config)

    def usable() -> list[int]:
        """The points of checkpoints of which the disk has all rows."""
        rows = on_disk(config)["files"][0][0]
        return [point for point in place.checkpoints() if point <= rows]

    wait_until(lambda: usable() or not launched.running, "a checkpoint with its rows")
    cut_off(place, launched)
    oldest, *others = usable()
    for point in others:
        damaged = kept / f"{point}.state"
        damaged.write_bytes(damaged.read_bytes()[:-1])

    resumed = place.run("launch", config, "--resume", "--no-progress")

    assert resumed.wait() == 0, resumed.story()
    (points,) = re.findall(r"^(\d+) points in", resumed.story(), re.MULTILINE)
    assert int(points) == POINTS - oldest < POINTS
    wanted = undisturbed(config, place.folder / "other.csv").read_bytes()
    assert config.with_suffix(".csv").read_bytes() == wanted
    assert not [*kept.glob("*.state")]


class CutOff(NamedTuple):
    """A run that was cut off after a value was set: its files, and what it records when it goes on."""

    place: Place
    config: Path
    files: dict[Path, bytes]
    wanted: bytes


@pytest.fixture(scope="module")
def cut() -> Iterator[CutOff]:
    with Place() as place:
        config = written(place)
        launched = begun(place, config)
        with fmu_mesh.attach("resumed", connect=place.note().endpoints[0]) as run:
            run.set("filter.v", 3.0)
        wait_until(lambda: any(on_disk(config)["journals"].values()), "the value on the disk")
        rows = row_count(config.with_suffix(".csv"))
        assert rows < POINTS
        cut_off(place, launched)
        kept = config.with_name("kept")
        own = [config.with_suffix(".csv"), config.with_name("resumed.csv.json"), kept / "run", kept / "on_disk"]
        paths = [*own, *kept.glob(f"journals/*{JOURNAL}")]
        files = {path: path.read_bytes() for path in paths}
        resumed = place.run("launch", config, "--resume", "--no-progress")
        assert resumed.wait() == 0, resumed.story()
        metadata = json.loads(config.with_name("resumed.csv.json").read_text(encoding="utf-8"))
        assert [value["value"] for value in metadata["set"]] == [3.0]
        yield CutOff(place, config, files, config.with_suffix(".csv").read_bytes())


@pytest.mark.parametrize("seed", range(examples(20)))
def test_files_cut_at_any_byte_give_no_wrong_row(cut: CutOff, seed: int) -> None:
    chance, (place, config, files, wanted) = random.Random(seed), cut  # noqa: S311  places in files
    results = [config.with_suffix(".csv"), config.with_name("resumed.csv.json")]
    damaged = results if seed % 2 else chance.sample([*files], 1 + seed % 4 // 2)
    for path, data in files.items():
        path.write_bytes(data[: chance.randrange(len(data))] if path in damaged else data)

    resumed = place.run("launch", config, "--resume", "--no-progress")

    code, result = resumed.wait(), config.with_suffix(".csv").read_bytes()
    if code == 0:
        assert result == wanted
    else:
        assert code in (2, 3), resumed.story()
        assert_readable(resumed.message)
        assert wanted.startswith(result[: result.rfind(b"\n") + 1])
    if not {*damaged} - {*results}:
        assert code == 0, resumed.story()


@pytest.mark.parametrize("what", ["configuration", "model", "file"])
def test_a_run_that_changed_is_refused(cut: CutOff, what: str) -> None:
    place, config, files, _ = cut
    for path, data in files.items():
        path.write_bytes(data)
    model = place.folder / "Gain.fmu"
    before, options = model.read_bytes(), list[str]()
    if what == "model":
        with zipfile.ZipFile(model, "a") as archive:
            archive.writestr("resources/new.txt", "another")
    else:
        options = ["--set", "gain.k=2.0"] if what == "configuration" else ["--output", str(place.folder / "b.csv")]

    resumed = place.run("launch", config, "--resume", *options)
    model.write_bytes(before)

    assert resumed.wait() == 2, resumed.story()
    words = {"configuration": "another configuration", "model": "another model of 'gain'", "file": "resumed.csv'"}
    assert "cannot be resumed: it" in resumed.message
    assert words[what] in resumed.message


def test_an_unfinished_run_is_not_replaced(cut: CutOff) -> None:
    place, config, files, _ = cut
    for path, data in files.items():
        path.write_bytes(data)

    launched = place.run("launch", config)

    assert launched.wait() == 2
    assert "has a run of mesh 'resumed' that has not ended" in launched.message
    assert "--resume" in launched.message
    assert "remove the folder" in launched.message
    assert config.with_suffix(".csv").read_bytes() == files[config.with_suffix(".csv")]


def test_a_directory_has_one_run_at_a_time(place: Place) -> None:
    config = written(place, simulation={"stop_time": 60.0, "step_size": 0.001})
    launched = begun(place, config)

    second = place.run("launch", config, "--resume")

    assert second.wait() == 2
    assert "another run uses `recovery.directory`" in second.message
    launched.signal(signal.SIGINT)
    assert launched.wait() == 130
    assert "`--resume` goes on with it" in launched.errors
    resumed = place.run("launch", config, "--resume", "--no-progress")
    assert resumed.wait() == 0, resumed.story()
    assert row_count(config.with_suffix(".csv")) == 60001


def test_a_full_disk_ends_the_run_in_words(place: Place) -> None:
    config = written(place, simulation={"stop_time": 60.0, "step_size": 0.001})
    kept = config.with_name("kept")
    kept.mkdir()
    mounting = ["unshare", *(["-m"] if os.getuid() == 0 else ["-rm"]), "sh", "-c"]
    mount = f"mount -t tmpfs -o size=8k,mode=700 tmpfs {kept}"
    if subprocess.run([*mounting, mount], check=False, capture_output=True).returncode:
        pytest.skip("no file system can be mounted here")

    paced = "--no-progress", "--real-time-factor", "1"
    launched = place.start("launch", config, *paced, prefix=[*mounting, f'{mount} && exec "$@"', "sh"])

    assert launched.wait() == 2, launched.story()
    assert f"`recovery.directory` ('{kept}') cannot be written: No space left on device" in launched.errors
    assert row_count(config.with_suffix(".csv")) > 0


def test_resuming_needs_a_directory_and_files(place: Place) -> None:
    config = written(place, recovery={})
    without = place.run("launch", config, "--resume")
    assert without.wait() == 2
    assert "`recovery: {directory: DIR}` keeps" in without.message

    mesh = fmu_mesh.load(written(place))
    with pytest.raises(fmu_mesh.ConfigurationError, match="without a result file"):
        mesh.run(record="memory")


def test_a_node_in_a_sandbox_keeps_no_journal(place: Place) -> None:
    config = written(place, process={"sandbox": "bubblewrap"})

    checked = place.run("check", config)

    assert checked.wait() == 2, checked.story()
    found = "recovery.directory: 'kept', and 'filter' runs in a sandbox, from where nothing can be written there"
    assert found in checked.errors
