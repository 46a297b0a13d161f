"""A run with an instance that has no state loses processes: other nodes play their rows up to a checkpoint."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import yaml

import fmu_mesh
from fmu_mesh.results.played_rows import PLAYED_ROWS, rows_to_play
from tests.faults.test_fmu_files import MOUNT, NEEDS_MOUNTS, ROOMY
from tests.faults.test_restarting import killed, undisturbed
from tests.faults.test_resuming import cut_off, on_disk
from tests.fmus.event_fmus import build_event_fmu
from tests.fmus.packing import repacked
from tests.helpers import BY_STREAMS, BY_ZENOH, FMUS, Launched, Place, row_count, wait_until

POINTS = 4000

PARTS = """
import os
from pathlib import Path
import fmu_mesh

STEPS = os.open(Path(__file__).parent / "steps", os.O_WRONLY | os.O_CREAT | os.O_APPEND)

class Slow(fmu_mesh.Component):
    \"\"\"Counts its steps in a file.\"\"\"
    fail_at = fmu_mesh.Parameter(1e9)
    u = fmu_mesh.Input()
    v = fmu_mesh.Input()
    y = fmu_mesh.Output()
    flag = fmu_mesh.Output(type="Boolean")

    def step(self, now, step_size):
        if now > self.fail_at:
            raise ValueError("it is late")
        self.y = 0.5 * self.y + 0.1 * self.u + 0.1 * self.v + 0.1
        self.flag = self.y > 0.3
        os.write(STEPS, b".")

class Says(fmu_mesh.Component):
    y = fmu_mesh.Output(start="nothing", type="String")

    def step(self, now, step_size):
        self.y = str(now)
"""


def written(place: Place, kind: str = "chain", **sections: Any) -> Path:  # noqa: ANN401  they are sections
    """The configuration of a mesh in which `lacks` has no state, and `slow` counts its steps."""
    (place.folder / "parts.py").write_text(PARTS, encoding="utf-8")
    lacks = repacked(
        place.folder / "Lacks.fmu",
        source=FMUS / "Integrator.fmu",
        description=lambda text: re.sub(r' can(Serialize|GetAndSet)FMU[sS]tate="true"', "", text),
    )
    instances: dict[str, Any] = {
        "pendulum": {"fmu": str(FMUS / "DampedPendulum.fmu"), "start_values": {"a": 1.3}},
        "lacks": {"fmu": str(lacks)},
        "slow": {"python": "parts.py:Slow"},
        "gain": {"fmu": str(FMUS / "Gain.fmu"), "start_values": {"k": 0.5}},
    }
    connections: list[Any] = ["pendulum.a -> lacks.u", "lacks.y -> slow.u", "slow.y -> gain.u"]
    if kind == "cycle":
        connections = ["gain.y -> lacks.u", "lacks.y -> slow.u", "slow.y -> gain.u"]
    elif kind == "groups":
        for name in ("slow", "gain"):
            instances[name]["group"] = "both"
        connections[-1:] = ["slow.y -> gain.u", "gain.y -> slow.v"]
    elif kind == "rates":
        instances["pendulum"]["step_size"] = 0.004
        instances["slow"]["step_size"] = 0.002
        instances["gain"]["step_size"] = 0.003
    elif kind in {"group of rates", "group that goes ahead"}:
        for name, step in (("slow", 0.001), ("gain", 0.002)):
            instances[name] |= {"group": "both", "step_size": step}
        delay, way = (None, "hold") if kind == "group of rates" else (1, "midpoint")
        connections[-1:] = [{"from": "slow.y", "to": "gain.u", "delay": delay}]
        connections += [{"from": "gain.y", "to": "slow.v", "extrapolation": way}]
    elif kind == "cvode":
        solved = build_event_fmu("Oscillator", 2, place.folder, only="model_exchange")
        instances["lacks"] = {"fmu": str(solved), "solver": {"name": "cvode"}}
        connections[:2] = ["pendulum.a -> lacks.u", "lacks.x -> slow.u"]
    elif kind == "held":
        instances["slow"] |= {"on_failure": "hold", "start_values": {"fail_at": 0.4}}
        ramp = {"times": [0.0, 3.0], "values": [0.0, 5.0], "interpolation": "linear"}
        sections["scenario"] = {"values": {"slow.v": ramp}}
    output = "x" if kind == "cvode" else "y"
    content = {
        "mesh": "again",
        "simulation": {
            "stop_time": POINTS * 0.001,
            "step_size": 0.001,
            "real_time_factor": 1.0,  # so there is time to kill, and nobody is far ahead
            **sections.pop("simulation", {}),
        },
        "instances": instances,
        "connections": connections,
        "record": {"file": "again.csv", "variables": ["gain.y", f"lacks.{output}"]},
        "recovery": {"mode": "restart", "checkpoint_s": 1.0},
        **sections,
    }
    config = place.folder / "again.yaml"
    config.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return config


def checkpoint_after(place: Place, launched: Launched, rows: int) -> int:
    """Wait for a checkpoint behind so many rows; returns its point."""
    folder = place.folder

    def newest() -> int:
        files = [*folder.glob("run/*/*.state"), *folder.glob("kept/*.state")]
        return max((int(file.stem) for file in files if file.stem.isdecimal()), default=0)

    return wait_until(lambda: at if (at := newest()) > rows else not launched.running, "a checkpoint")


def steps_of(place: Place) -> int:
    return (place.folder / "steps").stat().st_size


WAYS: dict[str, dict[str, Any]] = {
    "window 1": {"simulation": {"window": 1}},
    "streams": {"zenoh": BY_STREAMS},
    "messages": {"zenoh": BY_ZENOH},
}


@pytest.mark.parametrize(
    ("kind", "victim"),
    [
        *(("chain", victim) for victim in ("slow", "lacks", "master", "fork")),
        ("cycle", "slow"),
        ("groups", "both"),
        ("rates", "master"),
        ("group of rates", "both"),
        ("group that goes ahead", "both"),
        ("cvode", "lacks"),
        ("held", "gain"),
        ("window 1", "master"),
        ("streams", "slow"),
        ("messages", "slow"),
        ("messages", "master"),
    ],
)
def test_nodes_with_a_state_play_their_rows(place: Place, kind: str, victim: str) -> None:
    config = written(place, kind, **WAYS.get(kind, {}))
    launched = place.start("launch", config, "--no-progress")
    at = checkpoint_after(place, launched, 100)

    killed(launched, result := config.with_suffix(".csv"), victim, at + 200)

    launched.wait_for_error_line("starts again and goes on from point")
    assert launched.wait() == 0, launched.story()
    place.assert_nothing_left()
    if kind != "held":
        own = POINTS // 2 if kind == "rates" else POINTS
        assert own <= steps_of(place) < own + POINTS - at, (at, steps_of(place))
    assert result.read_bytes() == undisturbed(config, "--real-time-factor", "0")


def has_come_back(run: fmu_mesh.Run, restarts: int) -> bool:
    with suppress(fmu_mesh.FmuMeshError):  # no master is there
        return run.status.restarts == restarts and run.status.state == "running"
    return False


def test_set_values_and_further_losses(place: Place) -> None:
    config = written(place, recovery={"mode": "restart", "checkpoint_s": 1.5, "max_restarts": 5})
    launched = place.start("launch", config, "--no-progress")
    result = config.with_suffix(".csv")
    wait_until(lambda: row_count(result) > 100, "100 rows")
    with fmu_mesh.attach("again", connect=place.note().endpoints[0]) as run:
        run.set("slow.v", 3.0)
        run.set("gain.k", 0.25)
        at = checkpoint_after(place, launched, 100)
        killed(launched, result, "slow", at + 50)
        launched.wait_for_error_line("restart 1 of 5")
        launched.child("lacks").kill()  # while others play
        launched.wait_for_error_line("restart 2 of 5")
        wait_until(lambda: has_come_back(run, restarts=2), "the third attempt")
        sample = next(iter(run.watch("slow.v")))  # only the instance has it
        assert (sample.value, sample.point > at) == (3.0, True)
        run.set("slow.v", 0.5)
    killed(launched, result, "master", row_count(result) + 300)

    assert launched.wait() == 0, launched.story()
    assert "restart 3 of 5" in launched.errors
    again = fmu_mesh.rerun(result, output=place.folder / "rerun.csv", allow_code=True)
    assert again["gain.y"].tolist() == fmu_mesh.Result.read(result)["gain.y"].tolist()
    assert len(again["gain.y"]) == POINTS + 1


def test_a_run_that_lost_everything_plays_its_rows(place: Place) -> None:
    config = written(place, recovery={"directory": "kept", "checkpoint_s": 1.0})
    launched = place.start("launch", config, "--no-progress")
    at = checkpoint_after(place, launched, 100)
    wait_until(lambda: on_disk(config).get("played", 0) > at, "rows on the disk")
    cut_off(place, launched)
    rows = rows_to_play(config.with_name("kept") / PLAYED_ROWS)
    before = steps_of(place)

    resumed = place.run("launch", config, "--resume", "--no-progress")

    assert resumed.wait() == 0, resumed.story()
    place.assert_nothing_left()
    assert rows > at
    assert steps_of(place) - before <= POINTS - at
    assert not (config.with_name("kept") / PLAYED_ROWS).exists()
    assert config.with_suffix(".csv").read_bytes() == undisturbed(config, "--real-time-factor", "0")


def test_rows_are_kept_without_a_result(place: Place) -> None:
    config = written(place, record=[])
    launched = place.start("launch", config, "--no-progress")
    at = checkpoint_after(place, launched, 100)
    (file,) = place.folder.glob(f"run/*/{PLAYED_ROWS}")
    wait_until(lambda: rows_to_play(file) > at + 200, "rows")

    launched.child("gain").kill()

    assert launched.wait() == 0, launched.story()
    place.assert_nothing_left()
    assert POINTS <= steps_of(place) < 2 * POINTS - at


@NEEDS_MOUNTS
def test_a_full_disk_costs_the_checkpoints_only(place: Place) -> None:
    config = written(place)
    prefix = ("unshare", "--mount", "sh", "-c", MOUNT, "sh", "size=900k", ROOMY)
    launched = place.start("launch", config, "--no-progress", prefix=prefix)

    assert launched.wait() == 0, launched.story()
    assert re.search(
        r"there are no more checkpoints: the rows for a restart \(.*\) cannot be written: No space", launched.errors
    )
    assert row_count(config.with_suffix(".csv")) == POINTS + 1


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"connections": [{"key": "a/v", "to": "slow.v"}]}, "with values of keys, all is calculated again"),
        (
            {"instances": {"lacks": {"fmu": "Lacks.fmu"}}, "connections": [], "record": {}},
            "no other instance could go on without it",
        ),
        (
            {
                "instances": {
                    "says": {"python": "parts.py:Says"},
                    "lacks": {"fmu": "Lacks.fmu"},
                    "gain": {"fmu": str(FMUS / "Gain.fmu")},
                },
                "connections": [],
                "record": {"file": "again.csv", "variables": ["says.y", "gain.y"]},
            },
            "all steps of says are taken again: its rows have texts",
        ),
        ({"recovery": {"mode": "restart", "checkpoint_s": None}}, "slow, gain: can be written lacks: cannot"),
        (
            {},
            "these go on from a checkpoint: pendulum, slow, gain; 48 bytes a point are kept after a loss, all steps of",
        ),
    ],
)
def test_check_says_who_goes_on(place: Place, changes: dict[str, Any], why: str) -> None:
    checked = place.run("check", written(place, **changes))

    assert checked.wait() == 0, checked.story()
    assert why in " ".join(checked.output.split())
