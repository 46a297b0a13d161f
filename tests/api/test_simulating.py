"""One FMU in one call: `fmu_mesh.simulate` beside FMPy's `simulate_fmu`, with inputs in all forms."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import fmpy
import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

import fmu_mesh
from tests.helpers import FMUS

Kind = Literal["co_simulation", "model_exchange"]
FMPY_KINDS = {"co_simulation": "CoSimulation", "model_exchange": "ModelExchange"}
JUMP: NDArray[Any] = np.array([(0.0, 0.0), (0.5, 1.0), (0.5, 3.0), (1.0, 2.0)], dtype=[("time", float), ("u", float)])


def simulated(fmu: Path, **options: Any) -> fmu_mesh.Result:  # noqa: ANN401  wrong ones as well
    return fmu_mesh.simulate(fmu, **{"processes": False, **options})


def of_fmpy(fmu: Path, **options: Any) -> NDArray[Any]:  # noqa: ANN401  it has no types
    found: NDArray[Any] = fmpy.simulate_fmu(str(fmu), validate=False, **options)
    return found


@pytest.mark.parametrize("name", ["DampedPendulum", "CartPole", "Integrator"])
def test_every_float_is_that_of_fmpy_where_its_steps_are_exact(name: str) -> None:
    ours = simulated(FMUS / f"{name}.fmu", stop_time=2.0, step_size=2**-7)
    theirs = of_fmpy(FMUS / f"{name}.fmu", stop_time=2.0, output_interval=2**-7)

    assert ours.times.tolist() == theirs["time"].tolist()
    for column in theirs.dtype.fields or ():
        assert column == "time" or ours[column].tolist() == theirs[column].tolist()


def test_other_steps_of_fmpy_differ_by_the_rounding_of_its_times() -> None:
    ours = simulated(FMUS / "DampedPendulum.fmu", stop_time=2.0, step_size=0.01)
    theirs = of_fmpy(FMUS / "DampedPendulum.fmu", stop_time=2.0, output_interval=0.01)

    assert ours.times.tolist() == theirs["time"].tolist()
    # FMPy's steps are differences of times: of 0.01 s, up to 2.1e-16 s too short.
    assert 0.0 < abs(ours["a"] - theirs["a"]).max() < 1e-14


@pytest.mark.parametrize(
    ("version", "kind"),
    [(1, "model_exchange"), (2, "model_exchange"), (3, "model_exchange"), (2, "co_simulation"), (3, "co_simulation")],
)
def test_each_version_and_kind_gives_what_fmpy_gives(
    version: Literal[1, 2, 3], kind: Kind, event_fmu: Callable[..., Path]
) -> None:
    fmu = event_fmu("Oscillator", version)

    ours = simulated(fmu, kind=kind, stop_time=5.0, step_size=0.125)
    theirs = of_fmpy(
        fmu, fmi_type=FMPY_KINDS[kind], stop_time=5.0, output_interval=0.125, record_events=False, set_stop_time=False
    )

    if kind == "co_simulation":
        assert ours["x"].tolist() == theirs["x"].tolist()
    else:  # two solvers; FMPy's has a tolerance of 1e-5, and errors of single steps add up
        assert abs(ours["x"] - theirs["x"]).max() < 1e-3


def test_what_is_left_out_is_that_of_the_default_experiment(event_fmu: Callable[..., Path]) -> None:
    told = simulated(FMUS / "DampedPendulum.fmu", output_interval=0.02)
    untold = simulated(event_fmu("Ball", 3))

    assert (told.times[0], told.times[-1], len(told.times)) == (0.0, 40.0, 2001)
    assert told.outcome is not None
    assert told.outcome.point == 20_000
    assert (untold.times[0], untold.times[-1], len(untold.times)) == (0.0, 1.0, 1001)  # the stop time as in FMPy


def forms(folder: Path) -> dict[str, Any]:
    """The same values over time in each form."""
    (folder / "u.csv").write_text("t,u\n0,0\n0.5,1\n0.5,3\n1,2\n", encoding="utf-8")
    frame = pd.DataFrame({"u": JUMP["u"]}, index=JUMP["time"])
    return {
        "a structured array": JUMP,
        "a frame with its times as index": frame,
        "a frame with a column of times": pd.DataFrame(JUMP),
        "a mapping": {"u": (JUMP["time"], JUMP["u"].tolist())},
        "a mapping with full names": {"Gain.u": (JUMP["time"].tolist(), JUMP["u"])},
        "a series": {"u": frame["u"]},
        "a table": folder / "u.csv",
        "the path of a table": "u.csv",
    }


def test_inputs_in_any_form_are_used_as_by_fmpy(folder: Path) -> None:
    expected = of_fmpy(FMUS / "Gain.fmu", stop_time=1.25, output_interval=0.125, input=JUMP)["y"].tolist()

    found = {
        form: simulated(FMUS / "Gain.fmu", stop_time=1.25, step_size=0.125, inputs=inputs)["y"].tolist()
        for form, inputs in forms(folder).items()
    }

    assert expected[4:7] == [0.75, 3.0, 2.75]  # a line to the jump, and one from there on
    assert found == dict.fromkeys(found, expected)


def test_constants_and_tunable_parameters_are_inputs_too() -> None:
    inputs = {"u": 2.0, "k": ([0.0, 0.5], [1.0, 5.0])}

    result = simulated(FMUS / "Gain.fmu", stop_time=1.0, step_size=0.25, inputs=inputs)

    assert result["y"].tolist() == [2.0, 2.0, 2.0, 10.0, 10.0]  # a parameter holds


def test_discrete_inputs_hold_and_continuous_ones_are_linear(event_fmu: Callable[..., Path]) -> None:
    inputs = np.array([(0.0, 0), (0.5, 4), (1.0, 8)], dtype=[("time", float), ("increment", int)])

    result = simulated(event_fmu("Stairs", 2), stop_time=1.0, step_size=0.25, inputs=inputs, record=["in:increment"])

    assert result["increment"].tolist() == [0, 0, 0, 4, 4]  # a row has the value that led to it


def test_names_of_the_only_instance_may_be_left_out(folder: Path) -> None:
    result = simulated(
        FMUS / "DampedPendulum.fmu",
        stop_time=0.1,
        start_values={"a": 1.3, "DampedPendulum.l": 2.0},
        record=["a", "der*", "param:l"],
        output="pendulum.csv",
    )

    for read in (result, fmu_mesh.Result.read("pendulum.csv")):
        assert read.names == [f"DampedPendulum.{name}" for name in ("a", "der(a)", "der(a,2)", "l")]
        assert (read["a"][0], read["l"][0]) == (1.3, 2.0)
        assert read["a"] is not None
        assert "a" in read
        assert "b" not in read
        assert len(read.plot("a", x="der(a)", annotate={(0.0, "a"): "start"}).axes) == 1
        assert read.compare(result, variables=["a"])
        with pytest.raises(fmu_mesh.UnknownName, match="means 2 columns"):
            read["der*"]
    assert [*folder.rglob("*.csv")] == [folder / "pendulum.csv"]


def test_in_a_result_of_several_instances_they_may_not() -> None:
    result = fmu_mesh.load(FMUS.parent / "configs" / "pendulum_delay.yaml").run(
        stop_time=0.1, record="memory", processes=False
    )

    assert "a" not in result
    with pytest.raises(fmu_mesh.UnknownName, match=r"Did you mean 'pendulum\.a'"):
        result["a"]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"output_interval": 0.003}, "`output_interval=0.003`"),
        ({"output_interval": -1.0}, "`output_interval=-1"),
        ({"step_size": 0.0}, "step_size"),
        ({"stop_time": -1.0}, "stop_time"),
        ({"stop_time": 1e300}, "earlier stop time"),
        ({"start_values": {"aa": 1.0}}, "Did you mean 'a'?"),
        ({"inputs": {"x": 1.0}}, "unknown variable 'x'"),
        ({"inputs": 3}, "`inputs`"),
        ({"inputs": "nothing.csv"}, "nothing.csv"),
        ({"inputs": {"a": ([0.0, 1.0], [1.0])}}, "'DampedPendulum.a', which is no input"),
        ({"kind": "model_exchange"}, "is for co-simulation"),
        ({"kind": "exchange"}, "Did you mean `kind='model_exchange'`?"),
        ({"outputinterval": 0.1}, "Did you mean `output_interval`?"),
        ({"record": ["aa"]}, "DampedPendulum.a"),
        ({"stop_time": 1e6, "output_interval": 0.002}, "memory"),
    ],
)
def test_a_wrong_option_is_refused_before_anything_starts(options: dict[str, Any], told: str) -> None:
    with pytest.raises((fmu_mesh.CallRefused, fmu_mesh.ConfigurationError)) as caught:
        simulated(FMUS / "DampedPendulum.fmu", **options)

    assert told in str(caught.value)


def test_what_has_no_end_does_not_stay_in_memory() -> None:
    mesh = fmu_mesh.Mesh.from_fmu(FMUS / "Gain.fmu", simulation={"step_size": 0.1})

    with pytest.raises(fmu_mesh.CallRefused, match="`stop_time`"):
        mesh.run(record="memory")
    with mesh.repeated() as runs, pytest.raises(fmu_mesh.CallRefused, match="`stop_time`"):
        runs.run()


def test_an_fmu_that_crashes_leaves_the_program_alive(tmp_path: Path) -> None:
    from tests.fmus.helpers import find_fmu  # noqa: PLC0415  builds with a compiler

    with pytest.raises(fmu_mesh.FmuMeshError) as caught:
        fmu_mesh.simulate(find_fmu("Faulty", tmp_path), start_values={"crash_at": 0.05})

    assert caught.value.result is not None
