"""Inputs without a value: when they fall back, and that every float and the end of a run are those of one process."""

from __future__ import annotations

import csv
import json
import signal
from collections.abc import Mapping, Sequence
from pathlib import Path
from random import Random
from typing import Any

import pytest

import fmu_mesh
from tests.equivalence.test_scenarios import DISTRIBUTED, local_rows
from tests.fmus.helpers import NO_COMPILER, build_test_fmu
from tests.helpers import FMUS, Place, rows_of, wait_until, write_config

STEER = '''
import fmu_mesh

class Steer(fmu_mesh.Component):
    """A component with an array, a whole number and a text, none of which is connected."""
    speeds = fmu_mesh.Input([1.0, 2.0, 3.0], shape=3)
    gear = fmu_mesh.Input(1, type="Int32")
    mode = fmu_mesh.Input("manual", type="String")
    y = fmu_mesh.Output()

    def step(self, time, step_size):
        self.y = float(self.speeds.sum()) + self.gear + 1000.0 * len(self.mode)
'''
INSTANCES: Mapping[str, Mapping[str, Any]] = {
    "held": {"fmu": "Gain", "group": "fast", "inputs": {"u": {"timeout": {"after": 0.02, "then": "hold"}}}},
    "gain": {"fmu": "Gain", "group": "fast", "inputs": {"u": {"timeout": {"after": 0.0105, "then": 7}}}},
    "slow": {
        "fmu": "Gain",
        "step_size": 0.003,
        "start_values": {"u": -2.0},
        "inputs": {"u": {"timeout": {"after": 0.02, "then": "start"}}},
    },
    "line": {"fmu": "Integrator", "inputs": {"u": {"timeout": {"after": 0.1, "then": -1.0}}}},
    "dense": {"fmu": "Gain", "inputs": {"u": {"timeout": {"after": 0.08, "then": 5.0}}}},
    "steer": {
        "python": "steer.py:Steer",
        "inputs": {
            "speeds": {"timeout": {"after": 0.05, "then": [0, 0, 0]}},
            "gear": {"timeout": {"after": 0.03, "then": "start"}},
            "mode": {"timeout": {"after": 0.25, "then": "automatic"}},
        },
    },
}
VALUES = {
    "held.u": {"times": [0.0, 0.1], "values": [1.0, 2.0]},
    "gain.u": {"file": "drive.csv", "column": "speed", "time": "t"},
    "slow.u": {"times": [0.0104, 0.2, 0.2135], "values": [2.0, 3.0, 3.0]},
    "line.u": {"times": [0.05, 0.11, 0.15], "values": [0.0, 3.0, 1.0], "interpolation": "linear"},
    "dense.u": {"file": "dense.csv"},
    "steer.gear": {"times": [0.01 * k for k in range(5)] + [0.2], "values": [2] * 6},
    "steer.speeds": {"times": [0.06], "values": [[4, 5, 6]]},
}


def written(folder: Path, **sections: Any) -> Path:  # noqa: ANN401  as the file has them
    """Two rates, a group, a table with gaps, one with a value for each step, a line, and other types than Float64."""
    (folder / "steer.py").write_text(STEER)
    random = Random(39)  # noqa: S311 a table, and no secret
    times = sorted(random.uniform(-0.01, 0.3) for _ in range(40))
    (folder / "drive.csv").write_text("t,speed\n" + "".join(f"{t!r},{random.choice([1.5, 2.5])}\n" for t in times))
    dense = [0.001 * k for k in range(300) if not 150 <= k < 250]
    (folder / "dense.csv").write_text("time,u\n" + "".join(f"{t!r},{random.random()!r}\n" for t in dense))
    instances = {name: dict(own) for name, own in INSTANCES.items()}
    connections = ["gain.y -> integral.u", "dense.y -> sum.u1", "line.y -> sum.u2"]
    instances |= {"integral": {"fmu": "Integrator", "group": "fast"}, "sum": {"fmu": "Adder"}}
    sections = {"scenario": {"values": VALUES}, **sections}
    return write_config(folder, instances=instances, connections=connections, name="quiet", stop_time=0.3, **sections)


@DISTRIBUTED
def test_processes_give_the_floats_of_one_process(sections: Mapping[str, Any], place: Place) -> None:
    config = written(place.folder, **sections)

    launched = place.run("launch", config, "--no-progress")

    assert launched.wait() == 0, launched.errors
    assert config.with_suffix(".csv").read_bytes() == local_rows(config)
    assert launched.errors.count("gain at point") == 1, launched.errors
    assert "held at point 20: input 'u' has had no value since point 0: it holds after 0.02 s" in launched.errors


def test_stepping_by_hand_gives_the_floats_of_a_run(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(written(tmp_path))
    expected = mesh.run(processes=False, record="memory")

    with mesh.open() as system:
        rows = []
        for _ in range(300):
            system.step()
            rows.append([system.get(name) for name in ("gain.y", "slow.y", "dense.y", "steer.y", "integral.y")])

    for index, name in enumerate(("gain.y", "slow.y", "dense.y", "steer.y", "integral.y")):
        assert [row[index] for row in rows] == expected[name].tolist()[1:], name


def stepped_values(system: fmu_mesh.System, points: int) -> list[float]:
    """The output of the gain at each of the next points."""
    values = []
    for _ in range(points):
        system.step()
        values.append(system.get("gain.y"))
    return values


def used(times: Sequence[float], values: Sequence[float], after: int, then: float, points: int) -> list[float]:
    """What each step uses, from the definition: the newest value if it is younger than ``after`` steps, else ``then``.

    Times are in steps; before the first value there is the start value 0.
    """
    found = []
    for step in range(points):
        past = [(max(time, 0), value) for time, value in zip(times, values, strict=True) if time <= step]
        last, value = past[-1] if past else (0, 0.0)
        found.append(value if step - last < after else then)
    return found


@pytest.mark.parametrize("seed", range(12))
def test_any_times_and_any_timeout_give_what_the_definition_says(seed: int) -> None:
    random = Random(seed)  # noqa: S311 times, and no secret
    after, points = random.choice([1, 2, 3, 7, 64, 65, 100]), 400
    times = sorted(random.sample(range(-3, points), random.choice([1, 5, 40, 300])))
    values = [random.choice([1.0, 2.0]) for _ in times]
    mesh = fmu_mesh.Mesh("any", step_size=0.1, stop_time=points * 0.1)
    timeout = {"after": after * 0.1, "then": 9.0}
    mesh.add("gain", fmu=FMUS / "Gain.fmu", inputs={"u": {"timeout": timeout}})
    mesh.scenario({"gain.u": {"times": [time * 0.1 for time in times], "values": values}})

    got = mesh.run(processes=False, record="memory")["gain.y"].tolist()[1:]
    with mesh.open() as system:
        stepped = stepped_values(system, points)

    assert got == stepped == used(times, values, after, 9.0, points)


@pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
def test_values_of_all_types_and_arrays_fall_back(place: Place) -> None:
    new, old = build_test_fmu("AllTypes3", place.folder), build_test_fmu("AllTypes1", place.folder)
    then: dict[str, Any] = {
        "float32": 1e-40,
        "int8": -128,
        "uint64": 2**64 - 1,
        "boolean": True,
        "enumeration": "low",
        "string": "a b",
        "binary": "AP8=",
        "float64_array": [[1, 2, 3], [4, 5, 6]],
    }
    inputs = {f"{name}_in": {"timeout": {"after": 0.02, "then": value}} for name, value in then.items()}
    again = {"after": 0.01, "then": -3}
    instances = {
        "new": {"fmu": str(new), "inputs": inputs},
        "old": {"fmu": str(old), "inputs": {"integer_in": {"timeout": again}}},
    }
    config = write_config(
        place.folder,
        instances=instances,
        connections=(),
        name="types",
        stop_time=0.06,
        simulation={"step_size": 0.01},
        scenario={"values": {"new.int8_in": {"times": [0.01, 0.05], "values": [4, 4]}, "new.string_in": "x"}},
        record={"file": "types.csv", "variables": [*(f"new.{name}_out" for name in then), "old.integer_out"]},
    )

    launched = place.run("launch", config)

    assert launched.wait() == 0, launched.errors
    rows = config.with_suffix(".csv").read_bytes()
    assert rows == local_rows(config)
    columns = list(zip(*csv.reader(rows.decode().splitlines()), strict=True))
    eights = next(column for column in columns if column[0] == "new.int8_out")
    assert [int(cell) for cell in eights[3:]] == [4, 4, -128, -128, 4]
    texts = next(column for column in columns if column[0] == "new.string_out")
    assert list(texts[2:]) == ["x", "x", "a b", "a b", "a b", "a b"]
    assert b"18446744073709551615" in rows


STOPPING: Mapping[str, Any] = {
    "instances": {
        "gain": {"fmu": "Gain", "inputs": {"u": {"timeout": {"after": 0.05, "then": "stop"}}}},
        "pendulum": {"fmu": "DampedPendulum"},
        "slow": {"fmu": "Gain", "step_size": 0.002},
    },
    "connections": ["gain.y -> slow.u"],
    "scenario": {"values": {"gain.u": {"times": [0.0, 0.04, 0.06], "values": [1, 1, 2]}}},
}


TIMEOUT = {"instance": "gain", "variable": "u", "after": 0.05, "steps": 50, "points": 1, "value": None, "stops": True}


@pytest.mark.parametrize("window", [1, 7, "auto"])
def test_stop_ends_a_run_with_code_0_and_its_reason(window: int | str, place: Place) -> None:
    config = write_config(place.folder, name="quiet", simulation={"window": window}, stop_time=0.3, **STOPPING)

    launched, local = place.run("launch", config), place.run("launch", config, "--local", "--output", "local.csv")

    assert (launched.wait(), local.wait()) == (0, 0), (launched.errors, local.errors)
    word = "instance gain.u, point 110, t = 0.11 s: there was no value since point 60"
    assert word in launched.errors
    assert word in local.errors
    rows = config.with_suffix(".csv").read_bytes()
    assert rows == config.with_name("local.csv").read_bytes()
    assert len(rows.splitlines()) == 112


def test_a_slow_instance_stops_a_run_before_its_next_own_point(place: Place) -> None:
    inputs = {"u": {"timeout": {"after": 0.02, "then": "stop"}}}
    slow: dict[str, Any] = {"fmu": "Gain", "step_size": 0.003, "inputs": inputs}
    instances = {"slow": slow, "pendulum": {"fmu": "DampedPendulum"}}
    config = write_config(place.folder, instances=instances, connections=(), name="quiet", stop_time=0.3)

    launched = place.run("launch", config)

    assert launched.wait() == 0, launched.errors
    assert "slow.u, point 23, t = 0.023 s: there was no value since point 0" in launched.errors  # 21 is the seventh
    assert config.with_suffix(".csv").read_bytes() == local_rows(config)


def test_a_program_learns_what_has_ended_its_run(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(write_config(tmp_path, name="quiet", stop_time=0.3, **STOPPING))

    for processes in (False, True):
        outcome = mesh.run(processes=processes, record="memory").outcome
        assert outcome is not None
        ended = outcome.ended_by
        assert ended is not None
        assert (ended.instance, ended.variable, ended.point) == ("gain", "u", 110)
    with mesh.open() as system:
        system.step(300)
        assert (system.point, system.ended_by and system.ended_by.variable) == (110, "u")


def steered(then: object, *, real_time_factor: float = 1.0) -> fmu_mesh.Mesh:
    """A gain of 1 whose input falls back after 20 points of 10 ms."""
    mesh = fmu_mesh.Mesh("steered", step_size=0.01, stop_time=600.0, real_time_factor=real_time_factor)
    mesh.add("gain", fmu=FMUS / "Gain.fmu", inputs={"u": {"timeout": {"after": 0.2, "then": then}}})
    return mesh


def test_a_sender_that_stops_is_told_and_may_come_back(tmp_path: Path) -> None:
    with steered(0.0).start(output=tmp_path / "steered.csv") as run:
        points: list[int] = []
        for number in range(1, 6):
            wait_until(lambda: run.status.point > (points[-1] + 5 if points else 5), "the next points")
            points.append(run.set("gain.u", float(number)).point)
        # On a busy machine one of the values before it may have been too old as well.
        wait_until(lambda: run.instance_status("gain").timed_out == {"u": points[-1]}, "the timeout")
        status = run.instance_status("gain")
        assert f"no value for 'u' since point {points[-1]}" in status.activity
        # What has a past time would be older than the value that it has fallen back to.
        again = run.set("gain.u", 8.0, at=points[-1] * 0.01 + 0.1).point
        # That it is used can be seen for 0.2 s only, which a busy machine may miss: then it is the one that is too old.
        wait_until(lambda: run.instance_status("gain").timed_out == {"u": again}, "the second timeout")
        warned = [line.message for line in run.logs() if line.category == "timeout"]
        run.stop()
    sent = {**dict(zip(points, [1.0, 2.0, 3.0, 4.0, 5.0], strict=True)), again: 8.0}
    rows = [row[1] for row in rows_of(tmp_path / "steered.csv")]
    assert rows[1:] == used(list(sent), list(sent.values()), 20, 0.0, len(rows) - 1)
    assert len(warned) == 1
    assert again - points[-1] >= 20


def test_a_pause_does_not_count(tmp_path: Path) -> None:
    with steered(0.0, real_time_factor=0.0).start(output=tmp_path / "steered.csv", paused=True) as run:
        run.step(100)
        wait_until(lambda: run.status.point == 100, "point 100")
        run.set("gain.u", 3.0)
        for _ in range(19):
            run.step(1)
        wait_until(lambda: run.status.point == 119, "point 119")
        assert run.instance_status("gain").timed_out == {}
        run.step(2)
        wait_until(lambda: run.status.point == 121, "point 121")
        assert run.instance_status("gain").timed_out == {"u": 100}
        run.stop()

    rows = [row[1] for row in rows_of(tmp_path / "steered.csv")]
    assert rows == [0.0] * 101 + [3.0] * 20 + [0.0]


def test_a_value_set_by_hand_counts_from_its_time_on() -> None:
    with steered(9.0, real_time_factor=0.0).start(record="memory", paused=True) as run:
        run.set("gain.u", 1.0)
        run.set("gain.u", 2.0, at=0.35)
        run.step(60)
        wait_until(lambda: run.status.point == 60, "point 60")
        run.stop()
        result = run.wait()

    assert result["gain.y"].tolist() == [0.0] + [1.0] * 20 + [9.0] * 15 + [2.0] * 20 + [9.0] * 5


def test_a_system_stepped_by_hand_goes_back_to_its_timeout() -> None:
    with steered(9.0, real_time_factor=0.0).open() as system:
        system.step(10)
        system.set("gain.u", 1.0)
        system.step(15)
        state = system.save()
        ends = []
        for _ in range(2):
            system.restore(state)
            before = stepped_values(system, 6)
            system.set("gain.u", 2.0)
            ends.append(before + stepped_values(system, 21))

    assert ends[0] == ends[1] == [1.0] * 5 + [9.0] + [2.0] * 20 + [9.0]


def test_a_sender_that_stops_ends_a_run_without_a_stop_time(place: Place) -> None:
    inputs = {"u": {"timeout": {"after": 0.2, "then": "stop"}}}
    config = write_config(
        place.folder,
        instances={"gain": {"fmu": "Gain", "inputs": inputs}},
        connections=(),
        name="free",
        simulation={"stop_time": None, "step_size": 0.01, "real_time_factor": 1},
    )
    launched = place.start("launch", config, "--no-progress")
    place.note()
    with place.session() as session:
        points: list[int] = []

        def sent() -> bool:
            replies = session.get("fmu_mesh/free/gain/set/u", payload=str(float(len(points))))
            points.extend(json.loads(reply.ok.payload.to_bytes())["point"] for reply in replies if reply.ok is not None)
            return len(points) > 20 and points[-1] > 30

        wait_until(sent, "values for longer than the timeout")

    assert launched.wait() == 0, launched.errors
    last = points[-1]
    assert f"point {last + 20}" in launched.errors
    assert f"there was no value since point {last}, and it ends the run after 0.2 s" in launched.errors
    first = config.with_suffix(".csv")
    assert len(rows_of(first)) == last + 21
    again = place.run("rerun", first)
    assert again.wait() == 0, again.errors
    assert first.with_suffix(".rerun.csv").read_bytes() == first.read_bytes()


def test_check_and_info_show_the_timeout_of_an_input(place: Place) -> None:
    config = write_config(place.folder, name="quiet", stop_time=1000.0, simulation={"real_time_factor": 1}, **STOPPING)
    said = "ends the run after 0.05 s without a value"

    assert f"gain.u  {said}" in place.run("check", config).output
    planned = json.loads(place.run("check", config, "--json").output)["plan"]["instances"][0]["timeouts"]
    assert planned == [TIMEOUT]
    launched = place.start("launch", config, "--paused")
    place.note()
    assert f"timeouts     u: {said}" in place.run("info", "quiet/gain").output
    variables = json.loads(place.run("info", "quiet/gain", "--json").output)["variables"]
    assert {own["name"]: own.get("timeout") for own in variables} == {"u": said, "y": None, "k": None}
    launched.signal(signal.SIGINT)
    launched.wait()
