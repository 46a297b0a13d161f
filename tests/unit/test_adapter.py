"""`FMIAdapter`: modes, clocks, input trajectories, types, refusals, and what is left behind.

Most tests use `Gain` with k = 1, whose output after a step is the input that the step was given.
"""

from __future__ import annotations

import logging
import math
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from fmu_mesh import FMIAdapter
from fmu_mesh.errors import CallRefused, FmuMeshError, InitializationFailed, LoadFailed, StepFailed
from fmu_mesh.instances.fmi.co_simulation.fmi2 import Fmi2Instance
from fmu_mesh.variables.model_description import Value
from tests.fmus.helpers import FMUS, find_fmu

GAIN = FMUS / "Gain.fmu"
PENDULUM = FMUS / "DampedPendulum.fmu"
UNIX_TIME = 1_700_000_000.123

Find = Callable[[str], Path]


@pytest.fixture(scope="module")
def find(tmp_path_factory: pytest.TempPathFactory) -> Find:
    base = tmp_path_factory.mktemp("fmus")
    return lambda name: find_fmu(name, base)


@pytest.fixture
def gain() -> Iterator[FMIAdapter]:
    with FMIAdapter(GAIN, 0.5) as adapter:
        yield adapter


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where temporary folders go during a test."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def changed_fmu(path: Path, folder: Path, old: str, new: str) -> Path:
    """A copy of an FMU with another text in its model description."""
    changed = folder / path.name
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(changed, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name == "modelDescription.xml":
                assert old.encode() in content
                content = content.replace(old.encode(), new.encode())
            target.writestr(name, content)
    return changed


def inputs_seen(adapter: FMIAdapter, steps: int) -> list[float]:
    """What each of the next steps was given."""
    seen = []
    for _ in range(steps):
        adapter.do_step()
        seen.append(float(adapter.get_output_value("y")))
    return seen


# ---- what the FMU is ----


def test_the_names_come_in_the_order_of_the_model_description() -> None:
    with FMIAdapter(PENDULUM) as pendulum, FMIAdapter(FMUS / "TransportDelay.fmu") as delay:
        assert pendulum.all_variable_names == ("a", "der(a)", "der(a,2)", "l", "d", "g")
        assert pendulum.output_variable_names == ("a", "der(a)", "der(a,2)")
        assert pendulum.parameter_names == ("l", "d", "g")
        assert pendulum.input_variable_names == ()
        assert delay.input_variable_names == ("x",)


def test_the_step_size_is_the_given_one_or_else_default_experiment_s() -> None:
    with FMIAdapter(PENDULUM) as own, FMIAdapter(PENDULUM, 0.02) as other:
        assert (own.step_size, own.default_experiment_step) == (0.002, 0.002)
        assert (other.step_size, other.default_experiment_step) == (0.02, 0.002)
        assert own.can_handle_variable_communication_step_size
        assert own.description.model_name == "DampedPendulum"


def test_two_adapters_of_one_fmu_do_not_know_of_each_other() -> None:
    with FMIAdapter(PENDULUM) as first, FMIAdapter(str(PENDULUM)) as second:
        first.set_initial_value("a", 0.5)
        first.exit_initialization_mode(0.0)
        first.do_step()

        assert second.is_in_initialization_mode
        assert second.get_output_value("a") == 1.5


# ---- initialization mode ----


def test_start_values_are_taken_in_initialization_mode_before_and_after_first_look() -> None:
    with FMIAdapter(PENDULUM) as pendulum:
        pendulum.set_initial_value("l", 2)
        pendulum.set_initial_value("a", 1.3)
        before = pendulum.get_output_value("a")
        pendulum.set_initial_value("a", 0.0)

        pendulum.exit_initialization_mode(0.0)

        assert before == 1.3
        assert pendulum.get_value("l") == 2.0
        assert [pendulum.get_output_value(name) for name in pendulum.output_variable_names] == [0.0, 0.0, 0.0]
        assert not pendulum.is_in_initialization_mode


def test_a_guess_for_an_early_fmu_is_refused_after_the_first_look(
    tmp_path: Path,
) -> None:
    text = (zipfile.ZipFile(PENDULUM).read("modelDescription.xml")).decode()
    velocity = text[text.index('name="der(a)"') :]
    old = velocity[: velocity.index(">")]
    assert 'initial="exact"' in old
    path = changed_fmu(PENDULUM, tmp_path, old, old.replace('initial="exact"', 'initial="approx"'))

    with FMIAdapter(path) as pendulum:
        pendulum.set_initial_value("der(a)", 0.1)
        assert pendulum.get_output_value("der(a)") == 0.1
        with pytest.raises(CallRefused, match="only be set before the first value is read"):
            pendulum.set_initial_value("der(a)", 0.2)


def test_input_that_is_known_at_start_is_there_when_initialization_mode_ends(gain: FMIAdapter) -> None:
    gain.set_input_value("u", 9.0, 1.0)
    gain.set_input_value("u", 10.0, 2.0)
    gain.set_input_value("u", 11.0, 4.0)

    gain.exit_initialization_mode(10.0)

    assert gain.get_value("u") == 2.0
    assert inputs_seen(gain, 4) == [2.0, 3.0, 4.0, 4.0]


# ---- the clocks ----


def test_the_fmu_starts_at_zero_whatever_the_caller_s_clock_says(monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[tuple[float, float]] = []
    monkeypatch.setattr(Fmi2Instance, "advance", lambda _self, time, step_size: steps.append((time, step_size)))

    with FMIAdapter(GAIN, 0.25) as adapter:
        adapter.exit_initialization_mode(17.0)
        start = adapter.simulation_time
        reached = [adapter.do_step(), adapter.do_step(), adapter.do_steps_until(18.0)]

    assert (start, reached) == (17.0, [17.25, 17.5, 18.0])
    assert steps == [(0.0, 0.25), (0.25, 0.25), (0.5, 0.25), (0.75, 0.25)]


def test_the_time_of_a_step_is_one_multiplication_and_never_a_sum(monkeypatch: pytest.MonkeyPatch) -> None:
    times: list[float] = []
    monkeypatch.setattr(Fmi2Instance, "advance", lambda _self, time, _step_size: times.append(time))

    with FMIAdapter(GAIN, 0.1) as adapter:
        adapter.exit_initialization_mode(0.0)
        reached = adapter.do_steps_until(1000.0)

    assert times == [k * 0.1 for k in range(10_000)]
    assert reached == 1000.0


def test_steps_of_mixed_sizes_do_not_drift_either() -> None:
    with FMIAdapter(GAIN, 0.1) as adapter:
        adapter.exit_initialization_mode(0.0)
        for _ in range(1000):
            adapter.do_step()
            adapter.do_step(0.3)

        assert adapter.simulation_time == float(1000 * (Fraction(0.1) + Fraction(0.3)))


def test_a_clock_of_unix_time_changes_no_float_of_the_result() -> None:
    def run(start: float) -> list[float]:
        with FMIAdapter(FMUS / "Integrator.fmu", 0.002) as adapter:
            adapter.exit_initialization_mode(start)
            for k in range(500):
                adapter.set_input_value("u", start + k * 0.002, k * k * 0.37)
            result = []
            for k in range(500):
                adapter.do_steps_until(start + (k + 1) * 0.002)
                result.append(float(adapter.get_output_value("y")))
            return result

    assert run(UNIX_TIME) == run(0.0)


@pytest.mark.parametrize("start", [0.0, UNIX_TIME])
def test_stamp_that_misses_start_of_step_by_rounding_only_is_in_time(start: float) -> None:
    with FMIAdapter(GAIN, 0.1, interpolate_input=False) as adapter:
        adapter.exit_initialization_mode(start)
        adapter.set_input_value("u", math.nextafter(start + 3 * 0.1, math.inf), 7.0)

        assert inputs_seen(adapter, 4) == [0.0, 0.0, 0.0, 7.0]


@pytest.mark.parametrize(
    ("time", "reached"),
    [
        (10.0, 10.0),
        (10.25, 10.0),
        (10.26, 10.5),
        (10.5, 10.5),
        (10.74, 10.5),
        (10.75, 10.5),
        (11.0, 11.0),
        (9.75, 10.0),
    ],
)
def test_steps_until_a_time_end_at_the_nearest_step(gain: FMIAdapter, time: float, reached: float) -> None:
    gain.exit_initialization_mode(10.0)

    assert gain.do_steps_until(time) == reached


def test_a_limit_of_steps_lets_the_caller_catch_up_in_pieces(gain: FMIAdapter) -> None:
    gain.exit_initialization_mode(0.0)

    assert [gain.do_steps_until(3.0, max_steps=4) for _ in range(3)] == [2.0, 3.0, 3.0]


def test_a_time_that_is_past_is_refused_and_changes_nothing(gain: FMIAdapter) -> None:
    gain.exit_initialization_mode(10.0)
    gain.do_steps_until(12.0)

    with pytest.raises(CallRefused, match=r"cannot step until 11\.7 s, because 12\.0 s is already reached"):
        gain.do_steps_until(11.7)

    assert gain.simulation_time == 12.0
    assert gain.do_step() == 12.5


# ---- input trajectories ----


def test_between_two_times_an_input_is_linear(gain: FMIAdapter) -> None:
    gain.exit_initialization_mode(0.0)
    gain.set_input_value("u", 1.0, 2.0)
    gain.set_input_value("u", 3.0, -2.0)

    assert inputs_seen(gain, 8) == [0.0, 1.0, 2.0, 1.0, 0.0, -1.0, -2.0, -2.0]


def test_without_interpolation_an_input_holds_until_the_next_time() -> None:
    with FMIAdapter(GAIN, 0.5, interpolate_input=False) as adapter:
        adapter.exit_initialization_mode(0.0)
        adapter.set_input_value("u", 1.0, 2.0)
        adapter.set_input_value("u", 1.6, 4.0)
        adapter.set_input_value("u", 3.0, -2.0)

        assert inputs_seen(adapter, 8) == [0.0, 0.0, 2.0, 2.0, 4.0, 4.0, -2.0, -2.0]


def test_the_initial_value_is_the_first_of_a_trajectory_that_begins_later(gain: FMIAdapter) -> None:
    gain.set_initial_value("u", 2.0)
    gain.exit_initialization_mode(17.0)
    gain.do_steps_until(20.0)

    gain.set_input_value("u", 21.0, 1.0)

    # It was 2 for as long as nothing else was known; from then on it is on the line from 2 at 17 s to 1 at 21 s.
    assert inputs_seen(gain, 3) == [1.25, 1.125, 1.0]


def test_a_second_value_for_the_same_time_replaces_the_first(gain: FMIAdapter) -> None:
    gain.exit_initialization_mode(UNIX_TIME)
    gain.set_input_value("u", UNIX_TIME, 1.0)
    gain.set_input_value("u", UNIX_TIME, 2.0)
    first = inputs_seen(gain, 1)
    gain.set_input_value("u", gain.simulation_time, 3.0)
    gain.set_input_value("u", gain.simulation_time, 4.0)

    assert (first, inputs_seen(gain, 1)) == ([2.0], [4.0])


def test_late_value_holds_from_next_step_unless_later_one_is_in_use() -> None:
    with FMIAdapter(GAIN, 0.5, interpolate_input=False) as adapter:
        adapter.exit_initialization_mode(0.0)
        adapter.set_input_value("u", 1.0, 1.0)
        adapter.do_steps_until(3.0)

        adapter.set_input_value("u", 2.2, 2.0)
        newer = inputs_seen(adapter, 1)
        adapter.set_input_value("u", 1.5, 3.0)
        older = inputs_seen(adapter, 1)

    assert (newer, older) == ([2.0], [2.0])


def test_a_value_from_before_the_start_holds_although_it_comes_late(gain: FMIAdapter) -> None:
    gain.set_initial_value("u", 2.0)
    gain.exit_initialization_mode(10.0)
    initial = inputs_seen(gain, 1)

    gain.set_input_value("u", 9.0, 3.0)
    gain.set_input_value("u", 8.0, 4.0)

    assert (initial, inputs_seen(gain, 2)) == ([2.0], [3.0, 3.0])


def test_a_trajectory_forgets_what_is_past(gain: FMIAdapter) -> None:
    gain.exit_initialization_mode(0.0)
    for k in range(2000):
        gain.set_input_value("u", k * 0.5, float(k))
        gain.do_step()

    assert len(gain._trajectories["u"]) <= 3
    assert gain.get_output_value("y") == 1999.0


def test_interpolation_never_leaves_the_range_of_the_two_values() -> None:
    with FMIAdapter(GAIN, 0.1) as adapter:
        adapter.exit_initialization_mode(0.0)
        for k in range(0, 300, 7):
            adapter.set_input_value("u", k * 0.1, 0.1 if k % 2 else 0.3)

        assert {value for value in inputs_seen(adapter, 294) if not 0.1 <= value <= 0.3} == set()


# ---- types ----


def test_every_type_can_be_set_and_read_and_only_real_is_interpolated(find: Find) -> None:
    later: dict[str, Value] = {
        "real": 3.0,
        "integer": -7,
        "boolean": True,
        "string": "gr\u00fcn",
        "enumeration": "high",
    }
    with FMIAdapter(find("AllTypes"), 0.5) as adapter:
        adapter.set_initial_value("integer_parameter", 5)
        adapter.exit_initialization_mode(0.0)
        for name, value in later.items():
            adapter.set_input_value(f"{name}_in", 1.0, value)
        rows = []
        for _ in range(3):
            adapter.do_step()
            rows.append([adapter.get_output_value(f"{name}_out") for name in later])

        parameter = adapter.get_value("integer_parameter")

    assert rows == [[0.0, 0, False, "", 1], [1.5, 0, False, "", 1], [3.0, -7, True, "gr\u00fcn", 3]]
    assert [type(value) for value in rows[2]] == [float, int, bool, str, int]
    assert parameter == 5


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("real_in", "1"),
        ("real_in", True),
        ("integer_in", 1.0),
        ("integer_in", True),
        ("integer_in", 2**31),
        ("boolean_in", 1),
        ("string_in", 1),
        ("enumeration_in", 4),
        ("enumeration_in", "hihg"),
    ],
)
def test_a_value_of_another_type_is_refused(find: Find, name: str, value: float | str) -> None:
    with FMIAdapter(find("AllTypes")) as adapter:
        expected = f"{name}: .* cannot be its value; expected a value of type"
        with pytest.raises(CallRefused, match=expected):
            adapter.set_input_value(name, 0.0, value)
        with pytest.raises(CallRefused, match=expected):
            adapter.set_initial_value(name, value)


def test_scalars_of_numpy_are_taken_for_what_they_are(find: Find) -> None:
    with FMIAdapter(find("AllTypes"), np.float64(0.5)) as adapter:
        adapter.exit_initialization_mode(np.int64(0))  # type: ignore[arg-type]  # what arrays of times hold
        adapter.set_input_value("real_in", np.float32(0.0), np.float32(0.5))  # type: ignore[arg-type]  # as above
        adapter.set_input_value("integer_in", 0, np.int32(3))  # type: ignore[arg-type]  # as above
        adapter.set_input_value("boolean_in", 0, np.True_)  # type: ignore[arg-type]  # as above
        adapter.set_input_value("enumeration_in", 0, np.int64(2))  # type: ignore[arg-type]  # as above
        adapter.do_step()

        values = [adapter.get_output_value(f"{name}_out") for name in ("real", "integer", "boolean", "enumeration")]
        assert values == [0.5, 3, True, 2]


def test_a_value_out_of_its_range_is_refused(tmp_path: Path) -> None:
    text = zipfile.ZipFile(GAIN).read("modelDescription.xml").decode()
    variable = text[text.index('name="u"') :]
    old = variable[: variable.index("/>")]

    with FMIAdapter(changed_fmu(GAIN, tmp_path, old, f'{old} min="-1" max="2"')) as adapter:
        adapter.set_input_value("u", 0.0, 2.0)
        with pytest.raises(CallRefused, match=r"u: 2\.5 is out of its range, -1\.0 to 2\.0"):
            adapter.set_input_value("u", 0.0, 2.5)


def test_a_tunable_parameter_changes_between_two_steps(gain: FMIAdapter) -> None:
    gain.exit_initialization_mode(0.0)
    gain.set_input_value("u", 0.0, 2.0)
    before = inputs_seen(gain, 1)

    gain.set_parameter_value("k", 3.0)

    assert (before, inputs_seen(gain, 1)) == ([2.0], [6.0])


# ---- wrong use ----


def test_a_refusal_is_value_error_and_one_of_ours_and_names_instance() -> None:
    with FMIAdapter(GAIN) as adapter, pytest.raises(ValueError, match=r"instance Gain@\d+") as caught:
        adapter.do_step()

    assert isinstance(caught.value, FmuMeshError)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    "call",
    [
        lambda adapter: adapter.do_step(),
        lambda adapter: adapter.do_steps_until(1.0),
        lambda adapter: adapter.set_parameter_value("k", 1.0),
        lambda adapter: adapter.simulation_time,
    ],
    ids=["do_step", "do_steps_until", "set_parameter_value", "simulation_time"],
)
def test_what_belongs_to_stepping_is_refused_in_initialization_mode(
    gain: FMIAdapter, call: Callable[[FMIAdapter], object]
) -> None:
    with pytest.raises(CallRefused, match=r"is in initialization mode. Call exit_initialization_mode first"):
        call(gain)

    assert gain.is_in_initialization_mode


def test_what_belongs_to_initialization_mode_is_refused_when_it_is_over(gain: FMIAdapter) -> None:
    gain.exit_initialization_mode(0.0)

    with pytest.raises(CallRefused, match=r"initialization mode is over.*set_parameter_value"):
        gain.set_initial_value("k", 2.0)
    with pytest.raises(CallRefused, match="initialization mode is over"):
        gain.exit_initialization_mode(0.0)

    assert gain.do_step() == 0.5


def test_a_closed_adapter_refuses_everything_but_closing_again(gain: FMIAdapter) -> None:
    gain.exit_initialization_mode(0.0)
    gain.close()
    gain.close()

    for call in (gain.do_step, lambda: gain.get_output_value("y"), lambda: gain.set_input_value("u", 0.0, 0.0)):
        with pytest.raises(CallRefused, match="the adapter is closed"):
            call()


def test_an_unknown_name_is_answered_with_the_nearest_one(gain: FMIAdapter) -> None:
    with FMIAdapter(PENDULUM) as pendulum:
        with pytest.raises(CallRefused, match=r"no variable 'der\(A\)'. Did you mean 'der\(a\)'\?"):
            pendulum.get_output_value("der(A)")
        with pytest.raises(CallRefused, match=r"no variable 'q'. Possible here: a, der\(a\), der\(a,2\), l, d, g"):
            pendulum.get_value("q")
    with pytest.raises(CallRefused, match=r"k: this tunable parameter is not an input. Possible here: u"):
        gain.set_input_value("k", 0.0, 1.0)
    with pytest.raises(CallRefused, match=r"u: this continuous input is not an output. Possible here: y"):
        gain.get_output_value("u")
    gain.exit_initialization_mode(0.0)
    with pytest.raises(CallRefused, match=r"u: this continuous input is not a tunable parameter. Possible here: k"):
        gain.set_parameter_value("u", 1.0)


@pytest.mark.parametrize("step_size", [0, 0.0, -0.1, float("nan"), float("inf"), "0.1", True])
def test_a_step_size_that_is_none_is_refused(gain: FMIAdapter, temporary: Path, step_size: float) -> None:
    gain.exit_initialization_mode(0.0)

    with pytest.raises(CallRefused, match="the step size is"):
        FMIAdapter(GAIN, step_size)
    with pytest.raises(CallRefused, match="the step size is"):
        gain.do_step(step_size)

    assert gain.simulation_time == 0.0
    assert list(temporary.iterdir()) == []


@pytest.mark.parametrize("time", [float("nan"), float("inf"), "0", None, True])
def test_a_time_that_is_none_is_refused(gain: FMIAdapter, time: float) -> None:
    with pytest.raises(CallRefused, match=r"the time is .* expected a finite number of seconds"):
        gain.exit_initialization_mode(time)
    with pytest.raises(CallRefused, match="the time is"):
        gain.set_input_value("u", time, 1.0)
    gain.exit_initialization_mode(0.0)
    with pytest.raises(CallRefused, match="the time is"):
        gain.do_steps_until(time)


def test_fewer_than_one_step_at_most_is_refused(gain: FMIAdapter) -> None:
    gain.exit_initialization_mode(0.0)

    with pytest.raises(CallRefused, match="max_steps is 0; expected 1 or more"):
        gain.do_steps_until(1.0, max_steps=0)


def test_an_fmu_with_one_step_size_only_refuses_another(tmp_path: Path) -> None:
    attribute = "canHandleVariableCommunicationStepSize"
    path = changed_fmu(GAIN, tmp_path, f'{attribute}="true"', f'{attribute}="false"')

    with FMIAdapter(path, 0.25) as adapter:
        adapter.exit_initialization_mode(0.0)
        assert not adapter.can_handle_variable_communication_step_size
        assert adapter.do_step(0.25) == 0.25
        with pytest.raises(CallRefused, match=r"a step of 0\.5 s is not one of 0\.25 s"):
            adapter.do_step(0.5)
        assert adapter.simulation_time == 0.25


def test_an_fmu_without_a_default_step_size_needs_one(tmp_path: Path) -> None:
    text = zipfile.ZipFile(GAIN).read("modelDescription.xml").decode()
    experiment = text[text.index("<DefaultExperiment") :]
    path = changed_fmu(GAIN, tmp_path, experiment[: experiment.index("/>") + 2], "")

    with pytest.raises(CallRefused, match=r"no default step size. Give one: FMIAdapter\(path, step_size\)"):
        FMIAdapter(path)
    with FMIAdapter(path, 0.1) as adapter:
        assert (adapter.step_size, adapter.default_experiment_step) == (0.1, None)


# ---- what an FMU does wrong, and what is left behind ----


def test_a_step_that_fails_names_point_and_time_and_ends_the_adapter(
    find: Find, caplog: pytest.LogCaptureFixture
) -> None:
    with FMIAdapter(find("Faulty"), 0.25) as adapter:
        adapter.set_initial_value("fail_at", 0.6)
        adapter.exit_initialization_mode(100.0)

        with caplog.at_level(logging.ERROR), pytest.raises(StepFailed, match="the reactor is empty") as caught:
            adapter.do_steps_until(105.0)
        with pytest.raises(CallRefused, match=r"the FMU has failed before. Only close\(\) is allowed now"):
            adapter.do_step()

    assert (caught.value.point, caught.value.time) == (2, 100.5)
    assert "the reactor is empty" in caplog.text


def test_an_fmu_that_does_not_start_says_why(find: Find) -> None:
    with FMIAdapter(find("Faulty")) as adapter:
        adapter.set_initial_value("fail_in_init", value=True)
        with pytest.raises(InitializationFailed, match="the reactor does not start"):
            adapter.exit_initialization_mode(0.0)


def test_closing_removes_the_temporary_folder_also_after_an_exception(temporary: Path) -> None:
    def use() -> None:
        with FMIAdapter(GAIN) as adapter:
            assert len(list(temporary.iterdir())) == 1
            adapter.do_step()

    with pytest.raises(CallRefused):
        use()

    assert list(temporary.iterdir()) == []


def test_forgetting_an_adapter_removes_the_temporary_folder(temporary: Path) -> None:
    adapter = FMIAdapter(GAIN)
    adapter.exit_initialization_mode(0.0)
    del adapter

    assert list(temporary.iterdir()) == []


def test_an_fmu_that_cannot_be_loaded_leaves_nothing_behind(temporary: Path, tmp_path: Path) -> None:
    strange = changed_fmu(GAIN, tmp_path, 'guid="', 'guid="x')

    with pytest.raises(LoadFailed, match="cannot be instantiated"):
        FMIAdapter(strange)
    with pytest.raises(LoadFailed, match="does not exist"):
        FMIAdapter(tmp_path / "missing.fmu")

    assert list(temporary.iterdir()) == []


@pytest.mark.parametrize("ending", ["", "raise KeyboardInterrupt", "sys.exit(3)"])
def test_the_end_of_the_program_removes_the_temporary_folder(tmp_path: Path, ending: str) -> None:
    program = (
        "import sys, fmu_mesh\n"
        f"adapter = fmu_mesh.FMIAdapter({str(GAIN)!r})\n"
        "adapter.exit_initialization_mode(0.0)\n"
        f"adapter.do_step()\n{ending}\n"
    )

    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program],
        env={"TMPDIR": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )

    assert done.stderr == "" or "KeyboardInterrupt" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_importing_the_package_does_not_import_the_adapter() -> None:
    program = "import sys, fmu_mesh\nprint({'fmpy', 'numpy', 'fmu_mesh.adapter'} & set(sys.modules))"

    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)

    assert done.stdout == "set()\n"


def test_the_package_has_no_other_lazy_names() -> None:
    import fmu_mesh  # noqa: PLC0415 the module itself, not what it exports

    with pytest.raises(AttributeError, match="has no attribute 'FmiAdapter'"):
        fmu_mesh.FmiAdapter  # noqa: B018 the look-up is what fails


def test_an_array_of_fmi_3_is_a_linear_input_by_shape(
    find: Find,
) -> None:
    with FMIAdapter(find("AllTypes3"), 0.5) as adapter:
        adapter.set_input_value("float64_array_in", 0.0, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
        adapter.set_input_value("float64_array_in", 1.0, [[3.0, 2.0, 3.0], [4.0, 5.0, 8.0]])
        adapter.set_input_value("string_array_in", 0.0, [["a", "b", "c"], ["d", "e", "f"]])
        adapter.exit_initialization_mode(0.0)
        adapter.do_steps_until(1.0)

        assert adapter.get_output_value("float64_array_out") == [[2.0, 2.0, 3.0], [4.0, 5.0, 7.0]]
        assert adapter.get_output_value("string_array_out") == [["a", "b", "c"], ["d", "e", "f"]]
        with pytest.raises(CallRefused, match=r"Float64\[2,3\]"):
            adapter.set_input_value("float64_array_in", 2.0, [1.0, 2.0])
