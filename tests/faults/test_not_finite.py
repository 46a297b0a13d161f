"""An output that is NaN or infinite ends a run at its point, with its source; a value that grows is told before."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

import fmu_mesh
from fmu_mesh.rings.library import LIBRARY_VARIABLE
from tests.fmus.event_fmus import build_event_fmu
from tests.fmus.helpers import FMUS, NO_COMPILER, build_test_fmu
from tests.helpers import BY_STREAMS, BY_ZENOH, Place, rows_of
from tests.onnx_models import write_identity

PARTS = '''"""Components of the tests."""

import math

import fmu_mesh


class Ramp(fmu_mesh.Component):
    """Counts its steps; NaN from `until` on."""

    until = fmu_mesh.Parameter(math.inf)
    start = fmu_mesh.Parameter(0.0)
    y = fmu_mesh.Output(start=0.0)
    y32 = fmu_mesh.Output(start=0.0, type="Float32")
    given = fmu_mesh.Input()

    def initialize(self):
        self.y = self.start

    def step(self, time, step_size):
        self.y = math.nan if self.y + 1.0 >= self.until else self.y + 1.0
        self.y32 = self.y


class Mass(fmu_mesh.Component):
    """A mass of 1 kg on a stiff spring and a damper to the other one."""

    x = fmu_mesh.Output(start=0.0)
    v = fmu_mesh.Output(start=0.0)
    other_x = fmu_mesh.Input()
    other_v = fmu_mesh.Input()
    first = fmu_mesh.Parameter(0.0)

    def initialize(self):
        self.x = self.first

    def step(self, time, step_size):
        force = 1.0e5 * (self.other_x - self.x) + 500.0 * (self.other_v - self.v)
        self.v += step_size * force
        self.x += step_size * self.v
'''
RAMP = {"python": "parts.py:Ramp"}
GAIN = {"fmu": f"{FMUS}/Gain.fmu", "start_values": {"k": 1e306}}
LAST_FINITE = 179  # times 1e306


def written(
    folder: Path,
    instances: Mapping[str, Mapping[str, Any]],
    connections: list[Any],
    *,
    record: Mapping[str, Any] | None = None,
    zenoh: Mapping[str, Any] | None = None,
    **simulation: Any,  # noqa: ANN401  of any key
) -> Path:
    """A configuration beside the components."""
    (folder / "parts.py").write_text(PARTS, encoding="utf-8")
    content = {
        "mesh": "m",
        "simulation": {"stop_time": 100.0, "step_size": 0.1, **simulation},
        "instances": instances,
        "connections": connections,
        "record": {"file": "m.csv", **(record or {})},
        "zenoh": zenoh or {},
    }
    path = folder / "mesh.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


def failure_of(path: Path) -> fmu_mesh.FmuMeshError:
    """The failure of a run in this process."""
    with pytest.raises(fmu_mesh.FmuMeshError) as raised:
        fmu_mesh.load(path).run(record="memory", processes=False)
    return raised.value


@pytest.mark.parametrize(
    ("options", "changes"),
    [
        ((), {}),
        (("--window", "1"), {}),
        (("--local",), {}),
        ((), {"zenoh": BY_STREAMS}),
        ((), {"zenoh": BY_ZENOH}),
        ((), {"group": "all"}),
        ((), {"library": "none"}),
    ],
    ids=["shared memory", "lockstep", "local", "streams", "frames", "group", "without the library"],
)
def test_an_infinite_output_ends_a_run_at_its_point(
    options: tuple[str, ...], changes: dict[str, Any], place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "library" in changes:
        monkeypatch.setenv(LIBRARY_VARIABLE, "none")
    group = {"group": changes["group"]} if "group" in changes else {}
    instances = {"ramp": RAMP | group, "gain": GAIN | group, "late": GAIN | {"start_values": {"k": 2.0}} | group}
    connections = ["ramp.y -> gain.u", "ramp.y -> late.u"]
    config = written(place.folder, instances, connections, zenoh=changes.get("zenoh"))

    done = place.run("launch", config, "--no-progress", *options)

    assert done.wait() == 3
    said = "instance gain, point 180, t = 18 s: output y is inf; its inputs were finite. If gain.y may be so, write"
    assert said in done.errors
    rows = rows_of(place.folder / "m.csv")
    assert [row[0] for row in rows] == [point * 0.1 for point in range(LAST_FINITE + 1)]
    assert rows[-1][1:] == (179.0, 179.0, 179e306, 358.0)


def test_the_input_that_was_not_finite_is_named_with_its_source(tmp_path: Path) -> None:
    connections = [{"from": "ramp.y", "to": "gain.u", "factor": -1e306}]
    config = written(tmp_path, {"ramp": RAMP, "gain": GAIN | {"start_values": {"k": 1.0}}}, connections)

    told: list[fmu_mesh.FmuMeshError] = []
    with fmu_mesh.load(config).open() as system, pytest.raises(fmu_mesh.NotFinite) as stepped:
        system.step(1000)
    told.append(stepped.value)
    with fmu_mesh.load(config).repeated() as runs, pytest.raises(fmu_mesh.NotFinite) as repeated:
        runs.run()
    told.append(repeated.value)
    with pytest.raises(fmu_mesh.NotFinite) as started:
        fmu_mesh.load(config).run(record="memory")
    told += [started.value, failure_of(config)]

    expected = "output y is -inf; its input u came as -inf from ramp.y"
    assert {(error.message, error.instance, error.variable, error.point) for error in told} == {
        (expected, "gain", "y", 180)
    }
    assert [len(error.result.times) for error in told[1:]] == [180, 180, 180]


def test_the_first_point_must_be_finite(place: Place) -> None:
    (place.folder / "m.csv").write_text("an older result\n", encoding="utf-8")
    start = {"start_values": {"start": 1e300}}
    connections = [{"from": "ramp.y", "to": "gain.u", "factor": 1e300}]
    config = written(place.folder, {"ramp": RAMP | start, "gain": GAIN}, connections)

    launched = place.run("launch", config, "--no-progress")

    assert launched.wait() == 3
    assert "instance gain, point 0, t = 0 s: output y is inf; its input u came as inf from ramp.y" in launched.errors
    assert (place.folder / "m.csv").read_text(encoding="utf-8") == "an older result\n"
    assert failure_of(config).message == "output y is inf; its input u came as inf from ramp.y"


def test_a_slow_instance_ends_the_run_at_its_own_point(place: Place) -> None:
    config = written(place.folder, {"ramp": RAMP, "gain": GAIN | {"step_size": 0.7}}, ["ramp.y -> gain.u"])

    done = place.run("launch", config, "--no-progress")

    assert done.wait() == 3
    assert "instance gain, point 182, t = 18.2 s: output y is inf" in done.errors
    rows = rows_of(place.folder / "m.csv")
    assert (len(rows), rows[-1][-1]) == (182, 175e306)
    assert failure_of(config).point == 182


def test_nan_is_recorded_where_it_is_meant(tmp_path: Path) -> None:
    ramp = RAMP | {"start_values": {"until": 5.0}}
    config = written(
        tmp_path, {"ramp": ramp | {"not_finite": "record"}, "gain": GAIN}, ["ramp.y -> gain.u"], stop_time=1.0
    )

    error = failure_of(config)
    config = written(tmp_path, {"ramp": ramp, "gain": GAIN}, ["ramp.y -> gain.u"], stop_time=1.0, not_finite="record")
    result = fmu_mesh.load(config).run(record="memory")

    assert (error.instance, error.point) == ("gain", 5)
    assert error.message == "output y is NaN; its input u came as NaN from ramp.y"
    assert [math.isnan(value) for value in result["gain.y"]] == [False] * 5 + [True] * 6


def test_a_recorded_parameter_may_be_infinite(tmp_path: Path) -> None:
    config = written(tmp_path, {"ramp": RAMP}, [], record={"variables": ["ramp.y", "param:ramp.until"]}, stop_time=1.0)

    result = fmu_mesh.load(config).run(record="memory", processes=False)

    assert result["ramp.until"].tolist() == [math.inf] * 11


def test_an_onnx_model_follows_the_same_rule(tmp_path: Path) -> None:
    write_identity(tmp_path / "same.onnx", "DOUBLE")
    connections = [{"from": "ramp.y", "to": "same.x", "factor": 1e306}]
    config = written(tmp_path, {"ramp": RAMP, "same": {"onnx": "same.onnx"}}, connections)

    error = failure_of(config)

    assert (error.point, error.message) == (180, "output y is inf; its input x came as inf from ramp.y")


@pytest.mark.skipif(NO_COMPILER is not None, reason=NO_COMPILER or "")
def test_an_array_of_float32_has_to_be_finite(tmp_path: Path) -> None:
    fmu = {"fmu": str(build_test_fmu("AllTypes3", tmp_path)), "start_values": {"columns": 1}}
    connections = [{"from": "ramp.y32", "to": "types.float32_array_in[2,1]", "factor": 1e36}]
    config = written(tmp_path, {"ramp": RAMP, "types": fmu}, connections)

    error = failure_of(config)
    with fmu_mesh.load(config).repeated() as runs, pytest.raises(fmu_mesh.NotFinite) as repeated:
        runs.run()

    told = "output float32_array_out[2,1] is inf; its input float32_array_in[2,1] came as inf from ramp.y32"
    assert (error.point, error.message) == (repeated.value.point, repeated.value.message) == (341, told)


@pytest.mark.skipif(NO_COMPILER is not None, reason=NO_COMPILER or "")
@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize(("solver", "derivative"), [("cvode", 1), ("dopri5", 2)])  # CVode has spoilt the states
def test_a_solver_that_gets_nan_names_the_input_and_its_source(
    solver: str,
    derivative: int,
    version: Any,  # noqa: ANN401  1 to 3
    tmp_path: Path,
) -> None:
    fmu = str(build_event_fmu("Oscillator", version, tmp_path))
    model = {"fmu": fmu, "kind": "model_exchange", "solver": {"name": solver}}
    ramp = RAMP | {"start_values": {"until": 5.0}, "not_finite": "record"}
    config = written(tmp_path, {"ramp": ramp, "model": model}, ["ramp.y -> model.u"])

    error = failure_of(config)

    assert error.exit_code == 3
    assert error.instance == "model"
    assert error.message.startswith(f"solver {solver}: ")
    assert f"; derivative {derivative} of 2 is nan; " in error.message
    assert error.message.endswith("; its input u came as NaN from ramp.y")


def test_a_row_of_a_sweep_has_the_error(tmp_path: Path) -> None:
    config = written(tmp_path, {"ramp": RAMP, "gain": GAIN}, ["ramp.y -> gain.u"])

    options: dict[str, Any] = {"reduce": ["max(gain.y)"], "folder": tmp_path / "sweep", "workers": 1}
    with fmu_mesh.sweep(config, {"gain.k": [1.0, 1e306]}, **options) as running:
        fine, failed = running.wait()

    assert (fine.exit_code, fine.message, failed.exit_code) == (0, "", 3)
    assert failed.message.startswith("instance gain, point 180, t = 18 s: output y is inf; its inputs were finite")


def test_values_from_outside_have_to_be_finite(tmp_path: Path) -> None:
    config = written(tmp_path, {"ramp": RAMP}, [], stop_time=1.0)
    mesh = fmu_mesh.load(config)

    with mesh.open() as system:
        with pytest.raises(fmu_mesh.CallRefused, match="expected a finite number, or `not_finite: record` for its"):
            system.set("ramp.given", math.nan)
        system.step()
    with pytest.raises(fmu_mesh.ConfigurationError, match="expected a finite number, or"):
        mesh.run(start_values={"ramp.start": -math.inf}, record="memory")
    mesh.scenario({"ramp.given": {"times": [0.0, 0.5], "values": [1.0, "NaN"]}})
    with pytest.raises(fmu_mesh.ConfigurationError, match=r"a value of 'ramp.given' at 0\.5 s that is not"):
        mesh.run(record="memory")
    mesh.configure(simulation={"step_size": 0.1, "stop_time": 1.0, "not_finite": "record"})
    with mesh.open() as system:
        system.set("ramp.given", math.nan)


def test_a_value_that_is_set_over_the_wire_has_to_be_finite(tmp_path: Path) -> None:
    config = written(tmp_path, {"ramp": RAMP}, [], stop_time=60.0, real_time_factor=1.0)

    with fmu_mesh.load(config).start(record="memory") as run:
        with pytest.raises(fmu_mesh.FmuMeshError, match="expected a finite number, or `not_finite: record`"):
            run.set("ramp.given", math.inf)
        run.set("ramp.given", 1.0)


def test_a_stiff_spring_explodes_and_is_told_twice(place: Place) -> None:
    mass = {"python": "parts.py:Mass"}
    ends = [("s1.x", "s2.other_x"), ("s1.v", "s2.other_v"), ("s2.x", "s1.other_x"), ("s2.v", "s1.other_v")]
    connections = [f"{source} -> {target}" for source, target in ends]
    instances: dict[str, Any] = {"s1": mass | {"start_values": {"first": 0.1}}, "s2": mass}
    config = written(place.folder, instances, connections, step_size=0.005, stop_time=10.0)

    ended = [place.run("launch", config, "--no-progress", *options) for options in ((), ("--local",))]
    calm = fmu_mesh.load(config).run(stop_time=0.15, record="memory", processes=False)

    for launched in ended:
        assert launched.wait() == 3
        assert "point 247, t = 1.235 s: output x is -inf; its inputs were finite" in launched.errors
        assert launched.errors.count("warning: s1.x grows by a factor of 17.3 per point") == 1
    assert len(rows_of(place.folder / "m.csv")) == 247
    (told,) = calm.warnings
    assert told == (
        "s1.v grows by a factor of 17.3 per point: it left its scale of 50 at point 2 (t = 0.01 s), and 1e6 times this "
        "scale at point 6 (t = 0.03 s). It belongs to the cycle s1, s2: a smaller step size may keep it stable."
    )


EXAMPLES = [
    path
    for folder in (
        "configs",
        "examples/cart_pole",
        "examples/calibration",
        "examples/components",
        "examples/ensemble_filter",
    )
    for path in sorted((FMUS.parent / folder).glob("*.yaml"))
    if "gazebo" not in path.name
]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_no_example_grows(path: Path) -> None:
    alone: dict[str, Any] = {"stop_time": 60.0, "keys_from": os.devnull} if path.stem == "pump_twin" else {}
    with fmu_mesh.load(path).repeated() as runs:
        result = runs.run(real_time_factor=0.0, **alone)

    assert result.warnings == ()
