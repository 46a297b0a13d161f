"""`on_failure: hold` and `disable`: an instance fails, the run goes on, and all say so from that point on."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fmu_mesh
from fmu_mesh.rings.library import LIBRARY_VARIABLE
from fmu_mesh.run.options import PlanOptions
from tests.helpers import BY_STREAMS, BY_ZENOH, Place, wait_until, write_config
from tests.plain_run import PlainRun
from tests.planning import prepare

PARTS = '''"""Components of the tests."""

import math

import fmu_mesh


class Tank(fmu_mesh.Component):
    """Counts its steps; after 0.2 s a step fails, or gives NaN."""

    level = fmu_mesh.Output(start=0.0)
    name = fmu_mesh.Output(start="full", type="String")
    field = fmu_mesh.Output(start=[1.0, 2.0], shape=(2,))
    nan = fmu_mesh.Parameter(False)
    valve = fmu_mesh.Input(0.0)

    def step(self, time, step_size):
        self.level += 1.0 + self.valve
        self.field = [self.level, -self.level]
        self.name = f"at {time:g}"
        if time > 0.2005 and self.nan:
            self.level = math.nan
        elif time > 0.2005:
            raise ValueError("the tank is empty")
'''
HOLD = {"on_failure": "hold"}
RAMP = {"times": [0.0, 0.5], "values": [0.0, 5.0], "interpolation": "linear"}
DISABLED = {"on_failure": {"disable": {"y": -1.0}}}


def held_system(
    folder: Path,
    faulty: Path,
    on_failure: Mapping[str, Any],
    fail_at: float = 0.3,
    **sections: Any,  # noqa: ANN401  of any key
) -> Path:
    """Instances that fail by a status, an exception and NaN; two of them have a scenario."""
    (folder / "parts.py").write_text(PARTS, encoding="utf-8")
    group = sections.pop("group", {})
    tank = {"python": "parts.py:Tank", "on_failure": {"disable": {"name": "none", "field": [0.5, 0.25]}}}
    return write_config(
        folder,
        instances={
            "pendulum": {"fmu": "DampedPendulum", **group},
            "faulty": {"fmu": str(faulty), "start_values": {"fail_at": fail_at}, **on_failure, **group},
            "gain": {"fmu": "Gain", "start_values": {"k": 2.0}, **group},
            "raises": tank | group,
            "nan": tank | {"start_values": {"nan": True}, "step_size": 0.002} | group,
            "ramped": {"fmu": str(faulty), "start_values": {"fail_at": 0.33}, **HOLD, **group},
            "changed": {"fmu": str(faulty), **HOLD, **group},
        },
        connections=[
            "pendulum.a -> faulty.u",
            "faulty.y -> gain.u",
            "gain.y -> raises.valve",
            "raises.level -> nan.valve",
        ],
        stop_time=0.5,
        scenario={
            "values": {"ramped.u": RAMP, "changed.u": RAMP},
            "events": [{"at": 0.25, "set": {"changed.fail_at": 0.1}}, {"at": 0.4, "set": {"ramped.slow": 0.0}}],
        },
        record={"file": "pair.csv", "variables": ["*.*", "raises.name", "nan.name"]},
        **sections,
    )


def plain_rows(config: Path) -> bytes:
    """The result in the plainest way."""
    output = config.with_name("plain.csv")
    PlainRun(prepare(config, PlanOptions(output=output))).run()
    return output.read_bytes()


@pytest.mark.parametrize(
    ("options", "changes"),
    [
        ((), {}),
        (("--window", "1"), {}),
        (("--window", "16"), {}),
        (("--local",), {}),
        ((), {"zenoh": BY_STREAMS}),
        ((), {"zenoh": BY_ZENOH}),
        ((), {"group": {"group": "all"}}),
        ((), {"library": "none"}),
    ],
    ids=["shared memory", "lockstep", "window 16", "local", "streams", "frames", "group", "without the library"],
)
def test_rows_of_failed_instances_are_those_of_one_process(
    options: tuple[str, ...], changes: dict[str, Any], place: Place, faulty: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if changes.pop("library", None):
        monkeypatch.setenv(LIBRARY_VARIABLE, "none")
        place.environment[LIBRARY_VARIABLE] = "none"
    config = held_system(place.folder, faulty, DISABLED, **changes)

    launched = place.run("launch", config, "--no-progress", *options)

    assert launched.wait() == 0, launched.story()
    assert config.with_suffix(".csv").read_bytes() == plain_rows(config)
    found = fmu_mesh.Result.read(config.with_suffix(".csv")).metadata
    points = {what: {name: own["point"] for name, own in found[what].items()} for what in ("held", "disabled")}
    assert points == {
        "held": {"ramped": 330, "changed": 250},
        "disabled": {"faulty": 300, "raises": 201, "nan": 202},
    }
    assert "faulty at point 300: it has failed: fmi2DoStep returned error" in launched.errors
    assert "warning: faulty, from point 300 on: it has failed" in launched.output + launched.errors
    place.assert_nothing_left()


@pytest.mark.parametrize(("on_failure", "after"), [(HOLD, None), (DISABLED, -1.0)], ids=["hold", "disable"])
def test_outputs_hold_or_have_their_substitutes(
    tmp_path: Path, faulty: Path, on_failure: Mapping[str, Any], after: float | None
) -> None:
    config = held_system(tmp_path, faulty, on_failure)
    result = fmu_mesh.load(config).run(processes=False)
    undisturbed = held_system(tmp_path, faulty, on_failure, fail_at=10.0)
    without = fmu_mesh.load(undisturbed).run(record="memory", processes=False)

    y, last = result["faulty.y"], without["faulty.y"][300]
    np.testing.assert_array_equal(y[:301], without["faulty.y"][:301])
    assert set(y[301:]) == {last if after is None else after}
    np.testing.assert_array_equal(result["gain.y"][301:], 2.0 * y[301:])
    assert {*result["raises.field[1]"][202:]} == {0.5}
    assert len(set(result["raises.level"][202:])) == 1
    assert np.isfinite(result["nan.level"]).all()
    assert result.metadata["held" if after is None else "disabled"]["faulty"]["point"] == 300


def test_a_failure_without_on_failure_ends_the_run_as_before(tmp_path: Path, faulty: Path) -> None:
    config = held_system(tmp_path, faulty, {})

    with pytest.raises(fmu_mesh.FmuError, match="fmi2DoStep returned error"):
        fmu_mesh.load(config).run(record="memory", processes=False)


def test_status_of_a_held_instance_says_since_when_and_why(place: Place, faulty: Path) -> None:
    config = held_system(place.folder, faulty, HOLD, simulation={"stop_time": None})
    launched = place.start("launch", config, "--no-progress")

    def failed() -> str:
        told = place.run("status", "faulty", "--json")
        return str(json.loads(told.output).get("failed", "")) if told.wait() == 0 else ""

    said = wait_until(failed, "a failed instance")

    assert said.startswith("held since point 300: fmi2DoStep returned error")
    assert place.run("stop", "pair").wait() == 0
    assert launched.wait() == 0


def test_a_state_says_whether_its_instance_has_failed(tmp_path: Path, faulty: Path) -> None:
    config = held_system(tmp_path, faulty, HOLD)

    with fmu_mesh.load(config).open() as system:
        system.step(250)
        before = system.save()
        system.step(100)
        after, expected = system.save(), system.get("gain.y")
        system.step(50)
        system.restore(after)
        system.step(50)
        assert system.get("gain.y") == expected
        system.restore(before)
        system.step(10)
        again = system.get("gain.y")
        system.step(10)
        assert system.get("gain.y") != again


def test_copies_hold_their_outputs_and_are_reset(tmp_path: Path, faulty: Path) -> None:
    config = held_system(tmp_path, faulty, HOLD)
    times = [0.1, 10.0, 0.4]

    with fmu_mesh.load(config).batch(3) as batch:
        batch.set("faulty.fail_at", times)
        batch.step(500)
        found = batch.get("faulty.y")
        assert math.isnan(batch.get("faulty.u")[0])
        batch.reset()
        batch.step(250)
        after = batch.get("faulty.y")

    for own, fail_at in zip(found, times, strict=True):
        mesh = fmu_mesh.load(held_system(tmp_path, faulty, HOLD, fail_at=fail_at))
        assert mesh.run(record="memory", processes=False)["faulty.y"][-1] == own
    assert len(set(after)) == 1


@pytest.mark.parametrize(
    ("substitutes", "found"),
    [
        ({"z": 1.0}, "the unknown variable 'z' of instance 'faulty'"),
        ({"u": 1.0}, "'u', an input with initial 'exact'"),
        ({"y": "open"}, "'open' for the Real 'y'"),
        ({"y": [1.0]}, "a list for the Real 'y'"),
        ({"y": math.inf}, "inf"),
    ],
    ids=["unknown", "no output", "type", "shape", "not finite"],
)
def test_a_wrong_substitute_is_a_finding(
    tmp_path: Path, faulty: Path, substitutes: Mapping[str, object], found: str
) -> None:
    config = held_system(tmp_path, faulty, {"on_failure": {"disable": substitutes}})

    with pytest.raises(fmu_mesh.ConfigurationError) as raised:
        prepare(config)

    [finding] = raised.value.findings
    assert finding.path == f"instances.faulty.on_failure.disable.{next(iter(substitutes))}"
    assert finding.found == found
