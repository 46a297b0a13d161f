"""A run that loses processes and starts again: every row is there once, and the same as without a loss."""

from __future__ import annotations

import json
import os
import re
import signal
import time
from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import yaml

import fmu_mesh
from fmu_mesh.cli.main import main
from fmu_mesh.errors import ConfigurationError, MeshLost
from fmu_mesh.results.formats import read_result
from tests.helpers import (
    BY_ZENOH,
    FMUS,
    Launched,
    Place,
    on_a_busy_machine,
    row_count,
    rows_of,
    wait_until,
    write_config,
)
from tests.key_meshes import client, key_lines, put_values

POINTS = 4000

PARTS = """
import time
from pathlib import Path

import fmu_mesh
from fmu_mesh.errors import TerminationRequested

class Slow(fmu_mesh.Component):
    \"\"\"Takes its time, so that a test can kill at a point; its text changes with its value.\"\"\"
    u = fmu_mesh.Input()
    v = fmu_mesh.Input()
    y = fmu_mesh.Output()

    def step(self, now, step_size):
        self.y = 0.5 * self.y + 0.1 * self.u + 0.1 * self.v + 0.1
        time.sleep(0.0003)

class Saving(fmu_mesh.Component):
    \"\"\"Takes its time to give its state, so that a test can kill meanwhile.\"\"\"
    u = fmu_mesh.Input()
    y = fmu_mesh.Output()

    def step(self, now, step_size):
        self.y = 0.5 * self.y + 0.1 * self.u
        time.sleep(0.0003)

    def get_state(self):
        if not Path("saves").exists():
            Path("saves").touch()
            time.sleep(1.0)
        return {}

    def set_state(self, state):
        pass

class Landing(fmu_mesh.Component):
    \"\"\"Ends the simulation in a step that takes longer than it is until the next checkpoint.\"\"\"
    y = fmu_mesh.Output()

    def step(self, now, step_size):
        if now > 0.3005:
            Path("lands").touch()
            time.sleep(1.0)
            raise TerminationRequested("landed")
        self.y = now

class Clock(fmu_mesh.Component):
    y = fmu_mesh.Output()

    def step(self, now, step_size):
        self.y = time.time()
        time.sleep(0.0003)
"""


def written(place: Place, kind: str = "chain", **sections: Any) -> Path:  # noqa: ANN401  they are sections
    """The configuration of a mesh of this kind, that ends after `POINTS` points."""
    (place.folder / "parts.py").write_text(PARTS, encoding="utf-8")
    instances: dict[str, Any] = {
        "pendulum": {"fmu": str(FMUS / "DampedPendulum.fmu"), "start_values": {"a": 1.3}},
        "slow": {"python": "parts.py:Slow"},
        "gain": {"fmu": str(FMUS / "Gain.fmu"), "start_values": {"k": 0.5}},
    }
    connections = ["pendulum.a -> slow.u", "slow.y -> gain.u"]
    if kind == "cycle":
        del instances["pendulum"]
        connections = ["gain.y -> slow.u", "slow.y -> gain.u"]
    elif kind == "groups":
        for name in ("pendulum", "slow"):
            instances[name]["group"] = "both"
    elif kind == "rates":
        instances["pendulum"]["step_size"] = 0.004
        instances["gain"]["step_size"] = 0.002
    elif kind == "clock":
        instances["slow"] = {"python": "parts.py:Clock"}
        connections = ["slow.y -> gain.u"]
    elif kind == "saving":
        instances["slow"] = {"python": "parts.py:Saving"}
    elif kind == "landing":
        instances["slow"] = {"python": "parts.py:Landing"}
        connections = []
    simulation = {"stop_time": POINTS * 0.001, "step_size": 0.001, **sections.pop("simulation", {})}
    content = {
        "mesh": "again",
        "simulation": simulation,
        "instances": instances,
        "connections": connections,
        "record": {"file": "again.csv"},
        "recovery": {"mode": "restart"},
        **sections,
    }
    config = place.folder / "again.yaml"
    config.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return config


def undisturbed(config: Path, *options: str) -> bytes:
    """What a run in one process records, without recovery."""
    content = yaml.safe_load(config.read_text(encoding="utf-8"))
    del content["recovery"]
    other = config.with_name("other.yaml")
    other.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    result = config.with_name("other.csv")
    assert main(["launch", str(other), "--local", "--no-progress", "--output", str(result), *options]) == 0
    return result.read_bytes()


def killed(launched: Launched, result: Path, victim: str, rows: int) -> None:
    """Kill a process when the result has so many rows."""
    wait_until(lambda: row_count(result) > rows or not launched.running, f"{rows} rows")
    launched.child(victim).kill()


@pytest.mark.parametrize("victim", ["slow", "master", "fork"])
def test_a_killed_process_costs_no_row(place: Place, victim: str) -> None:
    config = written(place)
    launched = place.start("launch", config, "--no-progress")

    killed(launched, result := config.with_suffix(".csv"), victim, 500)

    said = launched.wait_for_error_line("starts again and goes on from point")
    assert "(restart 1 of 3)" in said
    assert launched.wait() == 0, launched.story()
    place.assert_nothing_left()
    assert result.read_bytes() == undisturbed(config)


@pytest.mark.parametrize("kind", ["cycle", "groups", "rates", "window 1", "by messages"])
def test_a_run_killed_twice_has_rows_of_one_that_was_not(place: Place, kind: str) -> None:
    sections: dict[str, Any] = {"zenoh": BY_ZENOH} if kind == "by messages" else {}
    sections |= {"simulation": {"window": 1}} if kind == "window 1" else {}
    config = written(place, kind, **sections)
    launched = place.start("launch", config, "--no-progress")

    killed(launched, result := config.with_suffix(".csv"), "both" if kind == "groups" else "slow", 500)
    launched.wait_for_error_line("restart 1 of 3")
    killed(launched, result, "master", 1500)

    assert launched.wait() == 0, launched.story()
    assert "restart 2 of 3" in launched.errors
    assert result.read_bytes() == undisturbed(config)


def test_a_process_killed_while_the_run_comes_back_counts(place: Place) -> None:
    config = written(place)
    launched = place.start("launch", config, "--no-progress")
    killed(launched, result := config.with_suffix(".csv"), "slow", 2000)

    for number in (1, 2):
        launched.wait_for_error_line(f"restart {number} of 3")
        launched.child("gain").kill()

    assert launched.wait() == 0, launched.story()
    assert "restart 3 of 3" in launched.errors
    assert result.read_bytes() == undisturbed(config)


def test_after_most_restarts_the_run_ends_and_keeps_its_rows(place: Place) -> None:
    config = written(place)
    launched = place.start("launch", config, "--restarts", "1", "--no-progress")
    result = config.with_suffix(".csv")

    killed(launched, result, "slow", 500)
    launched.wait_for_error_line("restart 1 of 1")
    before = row_count(result)
    launched.child("slow").kill()

    assert launched.wait() == 4
    place.assert_nothing_left()
    assert "This was attempt 2 of 2." in launched.errors
    rows = row_count(result)
    assert rows >= before > 500
    assert f"({rows} rows) is in '{result}'" in launched.errors


def test_a_component_that_reads_the_clock_is_named(place: Place) -> None:
    config = written(place, "clock", recovery={"mode": "restart", "checkpoint_s": None})
    launched = place.start("launch", config, "--no-progress")

    killed(launched, result := config.with_suffix(".csv"), "gain", 500)
    launched.wait_for_error_line("restart 1 of 3")
    before = result.read_bytes()

    assert launched.wait() == 3, launched.story()
    assert re.search(r"'slow' is not deterministic: point \d+, slow\.y was", launched.errors)  # after a checkpoint
    assert result.read_bytes() == before
    assert rows_of(result)


@pytest.mark.parametrize(("ending", "victim"), [("parquet", "master"), ("mcap", "slow")])
def test_other_formats_go_on_with_their_rows(place: Place, ending: str, victim: str) -> None:
    files = [{"file": f"again.{ending}"}, {"file": "again.csv"}]
    config = written(place, record=files)
    launched = place.start("launch", config, "--no-progress")

    killed(launched, csv := config.with_suffix(".csv"), victim, 1000)
    launched.wait_for_error_line("restart 1 of 3")
    killed(launched, csv, "gain", 2500)

    assert launched.wait() == 0, launched.story()
    place.assert_nothing_left()
    found, wanted = read_result(config.with_suffix(f".{ending}")), read_result(csv)
    assert found.times.tolist() == wanted.times.tolist()
    assert {name: own.tolist() for name, own in found.values.items()} == {
        name: own.tolist() for name, own in wanted.values.items()
    }
    assert len(found.times) == POINTS + 1
    assert not [*place.folder.glob("*.arrows")]


def test_values_and_pauses_are_given_again(place: Place) -> None:
    config = written(place, simulation={"real_time_factor": 2.0})
    launched = place.start("launch", config, "--no-progress")
    result = config.with_suffix(".csv")
    wait_until(lambda: row_count(result) > 100, "100 rows")
    with fmu_mesh.attach("again", connect=place.note().endpoints[0]) as run:
        run.set("slow.v", 3.0)
        run.set("gain.k", 0.25)
        point = run.pause(timeout=10.0).point
        launched.child("slow").kill()
        launched.wait_for_error_line("restart 1 of 3")
        wait_until(lambda: run.status.state == "paused" and run.status.restarts == 1, "a pause")
        assert run.status.point == point
        assert run.instance_status("slow").restarts == 1
        run.set("slow.v", 0.5)
        run.resume()
    killed(launched, result, "master", point + 200)

    assert launched.wait() == 0, launched.story()
    text = result.with_name("again.csv.json").read_text(encoding="utf-8")
    values = json.loads(text)["set"]
    assert sorted(value["value"] for value in values) == [0.25, 0.5, 3.0]  # two nodes have told them
    again = fmu_mesh.rerun(result, output=place.folder / "rerun.csv", allow_code=True)
    assert again["gain.y"].tolist() == fmu_mesh.Result.read(result)["gain.y"].tolist()


def test_values_of_keys_are_given_again(place: Place) -> None:
    connections = ["pendulum.a -> slow.u", "slow.y -> gain.u", {"key": "plant/v", "to": "slow.v"}]
    config = written(place, simulation={"real_time_factor": 4.0}, connections=connections)
    launched = place.start("launch", config, "--no-progress")
    result = config.with_suffix(".csv")

    for number, victim in enumerate(["slow", "master", "gain"]):
        wait_until(lambda: row_count(result) > 500 * (number + 1), "some rows")  # noqa: B023 it is called within the turn
        with client(place.note().endpoints[0]) as session:
            put_values(session, "plant/v", [float(number)])
            lines = result.with_name("again.csv.keys.jsonl")
            wait_until(lambda: lines.exists() and lines.read_bytes().count(b"\n") > number, "the value")  # noqa: B023 as above
        launched.child(victim).kill()
        launched.wait_for_error_line(f"restart {number + 1} of 3")

    assert launched.wait() == 0, launched.story()
    assert [line[3] for line in key_lines(result)] == [0.0, 1.0, 2.0]
    again = fmu_mesh.rerun(result, output=place.folder / "rerun.csv", allow_code=True)
    assert again["gain.y"].tolist() == fmu_mesh.Result.read(result)["gain.y"].tolist()


@pytest.mark.parametrize("victim", ["slow", "master"])
def test_who_is_attached_stays_attached(place: Place, victim: str) -> None:
    config = written(place)
    mesh = fmu_mesh.load(config)
    with mesh.start(output=place.folder / "own.csv") as run:
        points: list[int] = []
        pids: list[int] = []
        for sample in run.watch("gain.y"):
            points.append(sample.point)
            if not pids and sample.point > 500:
                pids.append(run.instance_info("slow").pid if victim == "slow" else run.info().pid)
                os.kill(pids[0], signal.SIGKILL)
        result = run.wait()

    assert points[-1] == POINTS
    assert len(result["gain.y"]) == POINTS + 1
    assert len([1 for before, after in pairwise(points) if after <= before]) <= 1  # it goes on near where it was


@pytest.mark.parametrize(
    ("section", "named"),
    [
        ([{"key": "a/b", "to": "gain.u", "wait": True}], "wait: true"),
        ([{"from": "slow.y", "key": "a/b", "congestion": "block"}], "congestion: block"),
    ],
)
def test_a_mesh_that_waits_for_others_is_not_restarted(place: Place, section: list[Any], named: str) -> None:
    config = written(place, connections=section)

    checked = place.run("check", config)

    assert checked.wait() == 2
    assert named in checked.message


def test_restarts_and_one_process_do_not_go_together(place: Place) -> None:
    launched = place.run("launch", written(place), "--local")

    assert launched.wait() == 2
    assert "`recovery.mode: restart` and --local do not go together" in launched.message


@pytest.mark.parametrize("kind", ["chain", "rates", "groups"])
@pytest.mark.parametrize("victim", ["slow", "master"])
def test_a_restart_begins_with_the_newest_checkpoint(place: Place, kind: str, victim: str) -> None:
    if kind == "groups" and victim == "slow":
        victim = "both"
    config = written(place, kind, recovery={"mode": "restart", "checkpoint_s": 0.05})
    launched = place.start("launch", config, "--no-progress")
    newest = wait_until(place.checkpoints, "a checkpoint")[-1]

    killed(launched, result := config.with_suffix(".csv"), victim, newest + 200)

    launched.wait_for_error_line("starts again and goes on from point")
    assert launched.wait() == 0, launched.story()
    (points,) = re.findall(r"^(\d+) points in", launched.story(), re.MULTILINE)
    assert 0 < int(points) <= POINTS - newest
    place.assert_nothing_left()
    assert result.read_bytes() == undisturbed(config)


def test_a_checkpoint_does_not_wait_for_a_sleeping_node(place: Place) -> None:
    took: list[float] = []
    with fmu_mesh.load(write_config(place.folder, stop_time=1e6)).start(output=place.folder / "own.csv") as run:
        run.wait_for("running")
        for _ in range(21):
            began = time.perf_counter()
            run.checkpoint(place.folder / "own.state", timeout=30.0)
            took.append(time.perf_counter() - began)

    assert sorted(took)[10] < on_a_busy_machine(0.1), took


@pytest.mark.parametrize("victim", ["slow", "gain", "master", "fork"])
def test_a_process_may_be_killed_while_states_are_saved(place: Place, victim: str) -> None:
    config = written(place, "saving", recovery={"mode": "restart", "checkpoint_s": 0.05})
    launched = place.start("launch", config, "--no-progress")
    wait_until((place.folder / "saves").exists, "a checkpoint under way")

    launched.child(victim).kill()

    launched.wait_for_error_line("restart 1 of 3")
    assert launched.wait() == 0, launched.story()
    place.assert_nothing_left()
    assert config.with_suffix(".csv").read_bytes() == undisturbed(config)


@pytest.mark.parametrize("asks", [True, False])
def test_a_simulation_may_end_while_a_checkpoint_is_under_way(place: Place, asks: bool) -> None:  # noqa: FBT001  a parameter
    config = written(place, "landing", recovery={"mode": "restart", "checkpoint_s": None if asks else 0.05})
    launched = place.start("launch", config, "--no-progress")
    with fmu_mesh.attach("again", connect=place.note().endpoints[0]) as run:
        wait_until((place.folder / "lands").exists, "the last step")
        refused = pytest.raises((ConfigurationError, MeshLost), match=r"no checkpoint any more|has ended")
        with refused if asks else nullcontext():
            _ = asks and run.checkpoint(place.folder / "late.state", timeout=30.0)

    assert launched.wait(30.0) == 0, launched.story()
    assert "landed" in launched.errors
    assert row_count(config.with_suffix(".csv")) == 302
    place.assert_nothing_left()
