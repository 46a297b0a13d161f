"""A system that begins again at point 0: every run has the floats and errors of a run of its own."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fmu_mesh
from fmu_mesh.errors import ConfigurationError, FmuError, NotFinite
from fmu_mesh.rings import native
from fmu_mesh.run.hosted_system import HostedSystem
from fmu_mesh.run.resetting import OtherStartValues
from tests.fmus.helpers import FMUS
from tests.helpers import PAIR, examples, write_config
from tests.onnx_models import write_network

ENGINES = pytest.mark.parametrize(
    "library",
    [pytest.param(True, marks=pytest.mark.skipif(native.library is None, reason="no library")), False],
    ids=["C", "Python"],
)


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """For each run, whether its instances were opened anew."""
    found: list[bool] = []
    original = HostedSystem.open

    def counting(self: HostedSystem) -> None:
        found.append(self.loads)
        original(self)

    monkeypatch.setattr(HostedSystem, "open", counting)
    return found


def alone(mesh: fmu_mesh.Mesh, values: Mapping[str, Any], **options: Any) -> fmu_mesh.Result:  # noqa: ANN401  those of `run`
    """A run with models of its own."""
    with mesh.repeated() as runs:
        return runs.run(start_values=values, **options)


def assert_same(found: fmu_mesh.Result, expected: fmu_mesh.Result) -> None:
    assert found.times.tobytes() == expected.times.tobytes()
    for name in expected:
        assert np.asarray(found[name]).tobytes() == np.asarray(expected[name]).tobytes()


@ENGINES
@pytest.mark.parametrize("reset", [False, True], ids=["new", "reset"])
def test_runs_that_begin_again_have_the_floats_of_runs_alone(
    tmp_path: Path, opened: list[bool], monkeypatch: pytest.MonkeyPatch, *, library: bool, reset: bool
) -> None:
    if not library:
        monkeypatch.setattr(native, "library", None)
    mesh = fmu_mesh.load(write_config(tmp_path))
    variants = [{"pendulum.d": d, "delay.d": e} for d, e in ((0.1, 0.25), (0.7, 0.25), (0.1, 0.1), (0.1, 0.25))]
    expected = [alone(mesh, values) for values in variants]
    opened.clear()

    with mesh.repeated(reset=reset) as runs:
        found = [runs.run(start_values=values) for values in variants]

    assert opened == [True, False, False, False]
    for one, other in zip(found, expected, strict=True):
        assert_same(one, other)
    assert found[0]["delay.y"].tobytes() == found[3]["delay.y"].tobytes() != found[1]["delay.y"].tobytes()


def test_random_values_and_lengths_have_the_floats_of_runs_alone(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(write_config(tmp_path))
    damping = st.floats(0.0, 2.0)
    run = st.tuples(
        damping, st.floats(0.01, 0.5), st.sampled_from([0.05, 0.3]), st.sampled_from(["pendulum.d", "pendulum.l"])
    )

    with mesh.repeated() as runs:

        @settings(max_examples=examples(25), deadline=None)
        @given(st.lists(run, min_size=1, max_size=4))
        def check(wanted: list[tuple[float, float, float, str]]) -> None:
            for d, delay, stop_time, name in wanted:
                values = {name: 0.5 + d, "delay.d": delay}
                assert_same(
                    runs.run(start_values=values, stop_time=stop_time), alone(mesh, values, stop_time=stop_time)
                )

        check()


def test_what_changes_more_than_a_number_is_planned_anew(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(write_config(tmp_path))
    own = OtherStartValues(mesh.plan(start_values={"pendulum.d": 0.1}, record="memory"))

    assert own.taken({"pendulum.d": 0.5}) == {"pendulum": {"d": 0.5}}
    assert own.taken({"pendulum.d": 2}) == {"pendulum": {"d": 2.0}}
    for name, value in (("pendulum.d", "0.5"), ("pendulum.d", float("nan")), ("pendulum.g", 9.0), ("pendulum.x", 1.0)):
        assert own.taken({name: value}) is None

    with mesh.repeated() as runs:
        runs.run(start_values={"pendulum.d": 0.1})
        with pytest.raises(ConfigurationError, match="'soon' for the Real 'd'"):
            runs.run(start_values={"pendulum.d": "soon"})
        assert_same(runs.run(start_values={"pendulum.d": 0.2}), alone(mesh, {"pendulum.d": 0.2}))


def test_the_plan_of_a_scenario_uses_start_values_itself(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(write_config(tmp_path))
    mesh.add("gain", fmu=str(FMUS / "Gain.fmu"))
    scenario = {"events": [{"at": 0.1, "set": {"gain.u": 1.0}}]}

    plain = mesh.plan(start_values={"pendulum.d": 0.1})
    prescribed = mesh.plan(start_values={"pendulum.d": 0.1}, scenario=scenario)

    assert OtherStartValues(plain).taken({"pendulum.d": 0.5}) is not None
    assert OtherStartValues(prescribed).taken({"pendulum.d": 0.5}) is None


def test_a_network_begins_again_without_being_opened(tmp_path: Path, opened: list[bool]) -> None:
    pytest.importorskip("onnxruntime")
    write_network(tmp_path / "policy.onnx", inputs=2)
    mesh = fmu_mesh.load(write_config(tmp_path))
    mesh.add("policy", onnx="policy.onnx")
    mesh.connect("pendulum.a", "policy.observation[1]")
    variants = [{"pendulum.d": d} for d in (0.1, 0.7, 0.1)]
    expected = [alone(mesh, values) for values in variants]
    opened.clear()

    with mesh.repeated() as runs:
        found = [runs.run(start_values=values) for values in variants]

    assert opened == [True, False, False]
    for one, other in zip(found, expected, strict=True):
        assert_same(one, other)


def test_another_file_of_a_model_is_loaded_by_the_next_run(tmp_path: Path) -> None:
    fmu = tmp_path / "model.fmu"
    shutil.copy(FMUS / "DampedPendulum.fmu", fmu)
    mesh = fmu_mesh.load(write_config(tmp_path, instances={**PAIR, "pendulum": {"fmu": str(fmu)}}))

    with mesh.repeated() as runs:
        runs.run(start_values={"pendulum.d": 0.1})
        shutil.copy(FMUS / "Gain.fmu", fmu)
        with pytest.raises(ConfigurationError):
            runs.run(start_values={"pendulum.d": 0.2})


def test_a_program_may_change_its_folder_between_two_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = fmu_mesh.load(write_config(tmp_path))

    with mesh.repeated() as runs:
        for number in range(3):
            (own := tmp_path / f"{number}").mkdir()
            monkeypatch.chdir(own)
            runs.run(start_values={"pendulum.d": 0.1 * number}, stop_time=0.1)
            assert Path.cwd() == own
        monkeypatch.chdir(tmp_path)
    assert Path.cwd() == tmp_path


def test_after_a_failure_the_next_run_opens_all_instances(faulty: Path, tmp_path: Path, opened: list[bool]) -> None:
    config = write_config(tmp_path, instances={"f": {"fmu": str(faulty)}}, connections=[], stop_time=0.01)
    mesh = fmu_mesh.load(config)

    with mesh.repeated() as runs:
        fine = [runs.run(start_values={"f.fail_at": 1e9}) for _ in range(2)]
        with pytest.raises(FmuError, match=r"instance f, point 4, t = 0\.004 s: fmi2DoStep returned error") as failed:
            runs.run(start_values={"f.fail_at": 0.0045})
        again = runs.run(start_values={"f.fail_at": 1e9})

    assert opened == [True, False, False, True]
    assert failed.value.result is not None
    assert len(failed.value.result.times) == 5
    assert_same(fine[1], fine[0])
    assert_same(again, fine[0])


def test_a_value_that_is_not_finite_ends_a_run_that_began_again(tmp_path: Path) -> None:
    gain = {"fmu": str(FMUS / "Gain.fmu"), "start_values": {"u": 1e300}}
    mesh = fmu_mesh.load(write_config(tmp_path, instances={"gain": gain}, connections=[], stop_time=0.01))

    with mesh.repeated() as runs:
        assert runs.run(start_values={"gain.k": 2.0})["gain.y"][-1] == 2e300
        with pytest.raises(NotFinite, match="output y is inf;"):
            runs.run(start_values={"gain.k": 1e300})
        assert runs.run(start_values={"gain.k": 3.0})["gain.y"][-1] == 3e300
