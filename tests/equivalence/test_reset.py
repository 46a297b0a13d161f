"""A mesh that was reset: its next result is that of a fresh run in every byte, and the one before is complete."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import psutil
import pytest

import fmu_mesh
from fmu_mesh.errors import ConfigurationError, FmuError, FmuMeshError, MeshLost
from tests.all_systems import FEATURES, SYSTEMS, written_system
from tests.equivalence.test_every_way import in_one_process
from tests.fmus.helpers import find_fmu
from tests.helpers import BY_STREAMS, BY_ZENOH, DEADLINE_S, Place, row_count, wait_until, write_config
from tests.unit.test_repeated import allowing_one, counting_fmu

WAYS = [pytest.param(way, name, id=f"{name}-streams") for name in FEATURES for way in [BY_STREAMS]]
WAYS += [pytest.param(way, name, id=f"{name}-zenoh") for name in FEATURES for way in [BY_ZENOH]]
WAYS += [pytest.param({}, name, id=name) for name in SYSTEMS]


@pytest.mark.parametrize(("way", "name"), WAYS)
def test_every_system_gives_its_floats_again(tmp_path: Path, name: str, way: Mapping[str, bool]) -> None:
    config = written_system(name, tmp_path / "system", zenoh=way)
    expected = in_one_process(config)

    with fmu_mesh.load(config).start(paused=True) as run:
        run.wait_for("paused", DEADLINE_S)
        before = run.step(max(1, run.status.last_point // 3)).point
        again = run.reset()
        assert (again.state, again.point, again.resets) == ("paused", 0, 1)
        run.resume()
        last = run.wait(DEADLINE_S)

    assert config.with_name("system-2.csv").read_bytes() == expected
    first = config.with_name("system.csv").read_bytes()
    assert expected.startswith(first)
    [ended] = run.results
    assert ended.outcome is not None
    assert (ended.outcome.point, ended.outcome.rows) == (before, len(ended.times))
    assert ended.metadata["ended_by"] == f"reset by a command at point {before}"
    assert last.outcome is not None
    assert last.outcome.rows == len(last.times)


def _has_rows(file: Path) -> bool:
    return row_count(file) > 100


def test_start_values_of_a_reset_are_those_of_a_fresh_run(tmp_path: Path) -> None:
    config = write_config(tmp_path, stop_time=0.5)
    other = {"pendulum.a": 0.75, "delay.d": 0.25}
    mesh = fmu_mesh.load(config)
    fresh = mesh.run(start_values=other, output=tmp_path / "fresh.csv")

    with mesh.start(paused=True) as run:
        run.step(20)
        run.reset(start_values={"pendulum.l": 3.0})  # those of a reset are gone with the next one
        run.reset(start_values=other)
        run.step(20)
        run.reset()
        run.reset(start_values=other)
        run.resume()
        last = run.wait(DEADLINE_S)

    assert last.outcome is not None
    assert last.outcome.file == str(tmp_path / "pair-5.csv")
    assert (tmp_path / "pair-5.csv").read_bytes() == (tmp_path / "fresh.csv").read_bytes()
    assert last.metadata["start_values"] == fresh.metadata["start_values"]
    again = fmu_mesh.rerun(tmp_path / "pair-5.csv")
    assert again["pendulum.a"].tolist() == fresh["pendulum.a"].tolist()


def test_a_running_mesh_is_reset_and_runs_on_in_the_same_processes(place: Place) -> None:
    config = write_config(place.folder, stop_time=1000.0, simulation={"real_time_factor": 1.0})
    launched = place.start("launch", config)
    place.note()
    wait_until(partial(_has_rows, place.folder / "pair.csv"), "rows of the first run")
    before = {process.pid for process in place.processes()}

    for number in (2, 3):
        asked = place.run("reset", "pair", "--set", f"pendulum.a=0.{number}")
        assert (asked.wait(), asked.output.split(" at point")[0]) == (0, "mesh 'pair' is running"), asked.story()
        wait_until(partial(_has_rows, place.folder / f"pair-{number}.csv"), "rows of the next run")
        second = (place.folder / f"pair-{number}.csv").read_text().splitlines()[1]
        assert second.split(",")[:2] == ["0.0", f"0.{number}"]

    launcher_and_roles = {process.pid for process in place.processes()}
    assert launcher_and_roles == before
    assert json.loads(place.run("status", "pair", "--json").output)["resets"] == 2
    assert place.run("stop", "pair").wait() == 0
    assert launched.wait() == 130
    assert "reset 1 at point" in launched.errors
    assert launched.errors.count("result: pair") == 2
    place.assert_nothing_left(DEADLINE_S)


def test_values_that_were_set_are_gone_after_a_reset(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(write_config(tmp_path, instances={"gain": {"fmu": "Gain"}}, connections=(), stop_time=0.1))
    with mesh.start(paused=True) as run:
        run.set("gain.u", 3.0)
        run.set("gain.k", 2.0, at=0.05)
        run.step(10)
        assert run.get("gain.y") == 3.0
        run.reset()
        run.step(70)
        assert run.get("gain.y") == 0.0
        assert run.get("gain.k") == 1.0
        run.resume()
        assert run.wait(DEADLINE_S)["gain.y"].tolist() == [0.0] * 101


def test_an_input_falls_back_to_the_start_value_of_the_reset(tmp_path: Path) -> None:
    gain = {"fmu": "Gain", "inputs": {"u": {"timeout": {"after": 0.02, "then": "start"}}}}
    mesh = fmu_mesh.load(write_config(tmp_path, instances={"gain": gain}, connections=(), stop_time=0.1))
    with mesh.start(paused=True) as run:
        run.step(10)
        run.reset(start_values={"gain.u": 4.0})
        run.set("gain.u", 7.0)
        run.resume()
        column = run.wait(DEADLINE_S)["gain.y"].tolist()

    assert column == [4.0, *[7.0] * 20, *[4.0] * 80]


def test_a_reset_that_cannot_be_done_changes_nothing(tmp_path: Path) -> None:
    config = write_config(tmp_path, stop_time=0.1)
    with fmu_mesh.load(config).start(paused=True) as run:
        run.step(10)
        wrongs: list[tuple[dict[str, float | str], str]] = [
            ({"pendulum.b": 1.0}, "unknown variable 'b'"),
            ({"pendulun.a": 1.0}, "Did you mean 'pendulum'"),
            ({"pendulum.a": "much"}, "much"),
            ({"pendulum": 1.0}, "instance.variable"),
        ]
        for wrong, words in wrongs:
            with pytest.raises(ConfigurationError, match=words):
                run.reset(start_values=wrong)
        assert (run.status.state, run.status.point, run.status.resets) == ("paused", 10, 0)
        run.resume()
        assert len(run.wait(DEADLINE_S).times) == 101
        with pytest.raises(MeshLost, match="has ended"):
            run.reset()
    with fmu_mesh.load(config).start(processes=False) as local, pytest.raises(FmuMeshError):
        local.reset()
    assert [path.name for path in sorted(tmp_path.glob("*.csv"))] == ["pair.csv"]


def test_sizes_stay_in_a_reset(tmp_path: Path) -> None:
    config = written_system("types", tmp_path / "system")
    with fmu_mesh.load(config).start(paused=True) as run:
        run.step(1)
        with pytest.raises(ConfigurationError, match="other sizes"):
            run.reset(start_values={"c.columns": 3, "c.uint16_array_in": [[1, 2, 3], [4, 5, 6]]})
        assert run.status.resets == 0
        run.stop()


def test_an_instance_that_cannot_begin_again_ends_the_run_with_its_name(tmp_path: Path) -> None:
    faulty = find_fmu("Faulty", tmp_path)
    mesh = fmu_mesh.Mesh("faulty", step_size=0.1, stop_time=100.0)
    mesh.add("bad", fmu=faulty)
    mesh.add("gain", fmu="fmus/Gain.fmu")
    with mesh.start(output=tmp_path / "rows.csv", paused=True) as run:
        run.step(5)
        with pytest.raises(FmuError, match="bad") as raised:
            run.reset(start_values={"bad.fail_in_init": True})
        assert raised.value.exit_code == 3
        with pytest.raises(FmuError, match="bad"):
            run.wait(DEADLINE_S)
    assert row_count(tmp_path / "rows.csv") == 6


MODULE = """
import fmu_mesh

STEPS = []

class Counter(fmu_mesh.Component):
    starts = []
    lag = fmu_mesh.Parameter(0.0)
    y = fmu_mesh.Output()

    def initialize(self):
        threading.Event().wait(self.lag)
        self.starts.append(self)
        self.y = 1000.0 * len(self.starts)

    def step(self, time, step_size):
        STEPS.append(time)
        self.y = 1000.0 * len(self.starts) + len(STEPS)
"""


@pytest.mark.parametrize("description", [str, allowing_one], ids=["many", "one a process"])
def test_what_code_keeps_outside_of_its_instance_begins_again(
    tmp_path: Path, description: Callable[[str], str]
) -> None:
    (tmp_path / "counter.py").write_text(f"import threading{MODULE}")
    mesh = fmu_mesh.Mesh("counted", step_size=0.1, stop_time=100.0)
    mesh.add("component", python=f"{tmp_path / 'counter.py'}:Counter")
    mesh.add("fmu", fmu=counting_fmu(tmp_path, description))
    with mesh.start(record=(), paused=True) as run:
        for _ in range(3):
            assert (run.get("component.y"), run.get("fmu.y")) == (1000.0, 1001.0)
            run.step(5)
            assert (run.get("component.y"), run.get("fmu.y")) == (1005.0, 1001.0)
            run.reset()
        run.stop()


def test_a_node_that_is_lost_during_a_reset_ends_the_run(tmp_path: Path) -> None:
    (tmp_path / "counter.py").write_text(f"import threading{MODULE}")
    instances = {"counter": {"python": "counter.py:Counter"}, "gain": {"fmu": "Gain"}}
    config = write_config(tmp_path, instances=instances, connections=(), stop_time=1000.0)
    with fmu_mesh.load(config).start(paused=True) as run, ThreadPoolExecutor() as others:
        run.step(5)
        gain = psutil.Process(run.instance_info("gain").pid)
        reset = others.submit(run.reset, start_values={"counter.lag": 60.0})
        wait_until(lambda: run.status.resets == 1 and run.status.state == "initializing", "the next run")
        gain.kill()

        with pytest.raises(MeshLost, match="gain"):
            reset.result(DEADLINE_S)
        with pytest.raises(MeshLost, match="'gain' was lost: its process was ended by SIGKILL"):
            run.wait(DEADLINE_S)
    assert row_count(config.with_suffix(".csv")) == 6


@pytest.mark.parametrize("way", [{}, BY_STREAMS, BY_ZENOH], ids=["shared memory", "streams", "zenoh"])
def test_many_resets_take_no_more_memory_and_threads(tmp_path: Path, way: Mapping[str, bool]) -> None:
    config = write_config(tmp_path, stop_time=10.0, zenoh=way)
    with fmu_mesh.load(config).start(paused=True) as run:
        sizes = []
        for count in range(60):
            run.step(5)
            run.reset()
            if count in (20, 59):
                there = [run.info().pid, *(run.instance_info(name).pid for name in ("pendulum", "delay"))]
                own = [psutil.Process(pid) for pid in there]
                sizes.append([(one.num_threads(), one.num_fds(), one.memory_info().rss >> 20) for one in own])
        run.stop()
    for before, after in zip(*sizes, strict=True):
        # One may be there at this moment, of a thread or of a file; a leak would show 39 times.
        assert after[0] - before[0] < 5, sizes
        assert after[1] - before[1] < 5, sizes
        assert after[2] - before[2] < 20, sizes
