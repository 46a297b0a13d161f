"""Scenarios in real processes: every float is that of one process, whatever the placement, the models, the pauses."""

from __future__ import annotations

import math
import re
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

import fmu_mesh
from tests.fmus.helpers import NO_COMPILER, build_test_fmu
from tests.helpers import BY_STREAMS, BY_ZENOH, FMUS, Place, row_count, rows_of, wait_until, write_config

STEER = '''
import fmu_mesh

class Steer(fmu_mesh.Component):
    """A component whose input and parameter can be set."""
    gain = fmu_mesh.Parameter(1.0, tunable=True)
    u = fmu_mesh.Input(unit="rad")
    y = fmu_mesh.Output(unit="rad")

    def step(self, time, step_size):
        self.y = self.gain * self.u
'''

INSTANCES: Mapping[str, Mapping[str, Any]] = {
    "gain": {"fmu": "Gain", "group": "fast"},
    "integral": {"fmu": "Integrator", "group": "fast"},
    "slow": {"fmu": "Gain", "step_size": 0.003},
    "steer": {"python": "steer.py:Steer"},
    "first": {"fmu": "Integrator", "start_values": {"k": -2.0}},
    "second": {"fmu": "Integrator", "start_values": {"y": 1.0}},
}
CONNECTIONS = ["gain.y -> integral.u", "slow.y -> steer.u", "first.y -> second.u", "second.y -> first.u"]
SCENARIO = {
    "values": {
        "gain.u": {"file": "drive.csv", "column": "speed", "time": "t", "interpolation": "linear"},
        "slow.u": {"times": [-1.0, 0.0104, 0.2], "values": [0.5, 2.0, -1.0]},
        "slow.k": 2.5,
    },
    "events": [
        {"at": 0.1, "set": {"steer.gain": 3.0, "integral.k": -0.5}},
        {"at": 0.25, "set": {"first.k": 0.25, "gain.k": 1e-3, "slow.u": 7.0}},
    ],
}


def written(folder: Path, **sections: Any) -> Path:  # noqa: ANN401  as the file has them
    """A mesh with two rates, a group, a cycle over two nodes, a component, and a scenario for all of them."""
    (folder / "steer.py").write_text(STEER)
    rows = "".join(f"{time!r},{math.sin(20 * time)!r},x\n" for time in (-0.01 + 0.0041 * row for row in range(80)))
    (folder / "drive.csv").write_text(f"t,speed,note\n{rows}")
    instances = {name: dict(own) for name, own in INSTANCES.items()}
    sections = {"scenario": SCENARIO, **sections}
    return write_config(folder, instances=instances, connections=CONNECTIONS, name="m", stop_time=0.3, **sections)


def local_rows(config: Path) -> bytes:
    output = config.with_name("local.csv")
    fmu_mesh.load(config).run(processes=False, output=output)
    return output.read_bytes()


DISTRIBUTED = pytest.mark.parametrize(
    "sections",
    [
        {},
        {"zenoh": BY_STREAMS},
        {"zenoh": BY_ZENOH},
        {"simulation": {"window": 1, "algorithm": "jacobi"}},
        {"simulation": {"window": 7, "start_time": 0.0}},
    ],
    ids=["rings", "streams", "frames", "lockstep", "window of 7"],
)


@DISTRIBUTED
def test_processes_give_the_floats_of_one_process(sections: Mapping[str, Any], place: Place) -> None:
    config = written(place.folder, **sections)

    launched = place.run("launch", config, "--no-progress")

    assert launched.wait() == 0, launched.errors
    rows = config.with_suffix(".csv").read_bytes()
    assert rows == local_rows(config)
    assert len(set(rows.splitlines())) == 302


def test_a_scenario_of_its_own_replaces_that_of_the_configuration(place: Place) -> None:
    config = written(place.folder, simulation={"window": 64})
    own = place.folder / "elsewhere" / "own.yaml"
    own.parent.mkdir()
    own.write_text("values: {gain.u: {file: u.csv}}\n")
    (own.parent / "u.csv").write_text("time,u\n0,1\n0.1,2\n0.1,3\n")

    launched = place.run("launch", config, "--no-progress", "--scenario", own)

    assert launched.wait() == 0, launched.errors
    gains = [row[1] for row in rows_of(config.with_suffix(".csv"))]
    assert gains == [1.0] * 101 + [3.0] * 200


def test_a_run_that_is_paused_and_stepped_by_hand_follows_its_scenario(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(written(tmp_path))
    expected = mesh.run(record="memory", processes=False)

    with mesh.start(record="memory", paused=True) as run:
        for points in (1, 1, 98, 1, 1, 47):
            run.step(points)
        run.resume()
        result = run.wait()

    for name in ("gain.y", "integral.y", "slow.y", "steer.y", "first.y", "second.y"):
        assert result[name].tobytes() == expected[name].tobytes(), name


def test_a_value_set_by_hand_holds_until_next_change_that_scenario_prescribes() -> None:
    """A gain of 1: what it gives at a point is what it was given for the step to this point."""
    mesh = fmu_mesh.Mesh("steered", step_size=0.01, stop_time=0.3)
    mesh.add("gain", fmu=FMUS / "Gain.fmu")
    mesh.scenario(
        {"gain.u": {"times": [0.0, 0.1, 0.2], "values": [1.0, 2.0, 3.0]}, "gain.k": {"times": [0.25], "values": [10.0]}}
    )

    with mesh.start(record="memory", paused=True) as run:
        run.step(4)
        run.wait_for("paused", 60.0)
        wait_until(lambda: run.status.point == 4, "point 4")
        late = run.set("gain.u", 6.0, at=0.02)
        first = run.set("gain.u", 7.0)
        second = run.set("gain.u", 8.0, at=0.145)
        third = run.set("gain.k", 0.5, at=0.22)
        run.resume()
        result = run.wait()

    assert [answer.point for answer in (late, first, second, third)] == [4, 4, 15, 22]
    assert [answer.late for answer in (late, first, second, third)] == [True, False, False, False]
    expected = [1.0] * 5 + [7.0] * 6 + [2.0] * 5 + [8.0] * 5 + [3.0] * 2 + [1.5] * 3 + [30.0] * 5
    assert result["gain.y"].tolist() == expected


def test_set_at_time_that_is_past_says_from_when_on_value_holds(place: Place) -> None:
    config = write_config(place.folder, instances={"gain": {"fmu": "Gain"}}, connections=(), name="free", stop_time=1.0)
    launched = place.start("launch", config, "--paused")
    place.note()
    assert place.run("step", "free", "50").wait() == 0

    def stepped() -> bool:
        asked = place.run("get", "gain.y", "--json")
        return asked.wait() == 0 and '"point":50' in asked.output.replace(" ", "")

    wait_until(stepped, "point 50")
    late, ahead = place.run("set", "gain.u", "3", "--at", "0.02"), place.run("set", "gain.u", "4", "--at", "0.0605")

    assert (late.wait(), ahead.wait()) == (0, 0), (late.errors, ahead.errors)
    assert "t = 0.02 s was past; it holds from t = 0.05 s (point 50) instead" in late.output
    assert "holds from point 61 on (t = 0.061 s)" in ahead.output
    launched.signal(signal.SIGINT)
    launched.wait()


def test_a_run_that_is_started_again_follows_its_scenario_again(place: Place) -> None:
    config = written(place.folder, simulation={"real_time_factor": 0.2})
    expected = local_rows(written(place.folder))
    written(place.folder, simulation={"real_time_factor": 0.2})
    launched = place.start("launch", config, "--restarts", "1")
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 120, "rows after the first event")

    launched.child("slow").kill()

    assert re.search("slow.* was lost", launched.wait_for_error_line("starts again"))
    assert launched.wait() == 0, launched.errors
    assert config.with_suffix(".csv").read_bytes() == expected


EventFmu = Callable[..., Path]


@pytest.mark.parametrize(("version", "kind"), [(1, "model_exchange"), (2, "model_exchange"), (3, "model_exchange")])
def test_models_with_events_follow_a_scenario(version: int, kind: str, place: Place, event_fmu: EventFmu) -> None:
    instances = {"oscillator": {"fmu": str(event_fmu("Oscillator", version)), "kind": kind}}
    scenario = {
        "values": {"oscillator.u": {"times": [0, 0.1, 0.2], "values": [0, 3, -1], "interpolation": "linear"}},
    }
    config = write_config(place.folder, instances=instances, connections=(), name="m", stop_time=0.3, scenario=scenario)

    launched = place.run("launch", config)

    assert launched.wait() == 0, launched.errors
    assert config.with_suffix(".csv").read_bytes() == local_rows(config)


@pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
def test_values_of_all_types_and_arrays_follow_a_scenario(place: Place) -> None:
    fmus = {name: str(build_test_fmu(name, place.folder)) for name in ("AllTypes3", "AllTypes", "AllTypes1")}
    instances = {
        "new": {"fmu": fmus["AllTypes3"]},
        "old": {"fmu": fmus["AllTypes"]},
        "older": {"fmu": fmus["AllTypes1"]},
    }
    (place.folder / "table.csv").write_text("time;flag;number;text\n0;true;-3;a\n0.02;0;7.0;b c\n")
    table = {"file": "table.csv"}
    scenario = {
        "values": {
            "new.float32_in": {"times": [0, 0.02], "values": [0.1, 1e-40]},
            "new.int8_in": {**table, "column": "number"},
            "new.boolean_in": {**table, "column": "flag"},
            "new.string_in": {**table, "column": "text"},
            "new.enumeration_in": {"times": [0.01, 0.03], "values": ["low", "reverse"]},
            "new.float64_array_in": {
                "times": [0, 0.04],
                "values": [[[1, 2, 3], [4, 5, 6]], [[6, 5, 4], [3, 2, 1]]],
                "interpolation": "linear",
            },
            "old.real_in": {"times": [0, 0.05], "values": [0, 1], "interpolation": "linear"},
            "old.string_in": {"times": [0.01], "values": ["x"]},
            "older.integer_in": {"times": [0, 0.02], "values": [1, -1]},
            "older.boolean_in": {"times": [0.02], "values": [True]},
        },
        "events": [{"at": 0.025, "set": {"new.binary_in": "AP8=", "new.uint64_in": 2**64 - 1}}],
    }
    outputs = ["float32", "int8", "boolean", "string", "enumeration", "float64_array", "binary", "uint64"]
    record = {"file": "m.csv", "variables": [f"new.{name}_out" for name in outputs]}
    record["variables"] += ["old.real_out", "old.string_out", "older.integer_out", "older.boolean_out"]  # type: ignore[operator]  # a list
    config = write_config(
        place.folder,
        instances=instances,
        connections=(),
        name="m",
        stop_time=0.06,
        simulation={"step_size": 0.01},
        scenario=scenario,
        record=record,
    )

    launched = place.run("launch", config)

    assert launched.wait() == 0, launched.errors
    rows = config.with_suffix(".csv").read_bytes()
    assert rows == local_rows(config)
    assert b"18446744073709551615" in rows


def test_table_that_changes_after_run_was_planned_ends_run_with_its_name(tmp_path: Path) -> None:
    config = written(tmp_path)
    mesh = fmu_mesh.load(config)
    plan = mesh.plan()
    with (tmp_path / "drive.csv").open("a") as file:
        file.write("0.4,1.0,late\n")

    with pytest.raises(fmu_mesh.FmuMeshError, match=r"drive\.csv' has changed since the run was planned"):
        fmu_mesh.Run.start(plan).wait()


def test_a_parquet_file_gives_the_floats_of_the_csv(tmp_path: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow", reason="the package pyarrow is not installed")
    parquet = pytest.importorskip("pyarrow.parquet")
    config = written(tmp_path)
    mesh = fmu_mesh.load(config)
    expected = mesh.run(record="memory")["gain.y"]
    lines = [line.split(",") for line in (tmp_path / "drive.csv").read_text().splitlines()[1:]]
    columns = {"t": [float(line[0]) for line in lines], "speed": [float(line[1]) for line in lines]}
    parquet.write_table(pyarrow.table(columns), tmp_path / "drive.parquet")
    mesh.scenario({"gain.u": {"file": "drive.parquet", "column": "speed", "time": "t", "interpolation": "linear"}})

    assert mesh.run(record="memory")["gain.y"].tobytes() == expected.tobytes()


def test_the_result_of_a_run_drives_another_one(tmp_path: Path) -> None:
    """What a Jacobi connection gives at a point is what a table of the results gives there."""
    coupled = fmu_mesh.load(FMUS.parent / "configs/pendulum_delay.yaml")
    coupled.configure(simulation={"algorithm": "jacobi", "stop_time": 1.0})
    expected = coupled.run(output=tmp_path / "coupled.csv", start_values={"delay.d": 0.1})
    alone = fmu_mesh.Mesh("alone", step_size=0.002, stop_time=1.0)
    alone.add("delay", fmu=FMUS / "TransportDelay.fmu", start_values={"d": 0.1})
    alone.scenario({"delay.x": {"file": tmp_path / "coupled.csv", "column": "pendulum.a"}})

    assert alone.run(record="memory")["delay.y"].tobytes() == expected["delay.y"].tobytes()
