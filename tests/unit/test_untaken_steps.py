"""Steps of FMI 1.0 and 2.0 that are not simply taken: discarded, pending, or with derivatives of inputs."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from fmu_mesh.cli.main import main
from fmu_mesh.errors import StepFailed, TerminationRequested
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.opening import open_instance, stepped
from fmu_mesh.instances.fmi.step_options import StepOptions
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.coupling_rule import CouplingRule
from fmu_mesh.system.layout import Layout
from fmu_mesh.system.linear_inputs import LinearInput
from tests.fmus.helpers import find_fmu
from tests.fmus.packing import repacked
from tests.helpers import write_config
from tests.unit.test_steps import running

Steps = Callable[[int], Path]
VERSIONS = [1, 2]
RETRY = StepOptions(retry_discarded_steps=True)


@pytest.fixture(scope="module")
def steps(tmp_path_factory: pytest.TempPathFactory) -> Steps:
    """The FMU whose steps are discarded or pending, in FMI 1.0 or 2.0."""
    folder = tmp_path_factory.mktemp("steps")
    return lambda version: find_fmu(f"Steps{version}", folder)


def without(flag: str, fmu: Path, target: Path) -> Path:
    """The FMU without a capability."""
    return repacked(target, source=fmu, description=lambda text: text.replace(f'{flag}="true"', f'{flag}="false"'))


# ---- discarded


@pytest.mark.parametrize("version", VERSIONS)
def test_discarded_step_is_taken_in_smaller_ones_if_fmu_can_and_may(version: int, steps: Steps, tmp_path: Path) -> None:
    with running(steps(version), tmp_path, "co_simulation", 0.25, RETRY, longest_step=0.0625, polls=0) as instance:
        instance.do_step(0)
        instance.do_step(1)

        assert instance.get_values(["reached", "attempts"]) == [0.5, 2 * (2 + 4)]


def test_what_fmi_1_repeats_it_repeats_without_wish_because_it_costs_nothing(steps: Steps, tmp_path: Path) -> None:
    with running(steps(1), tmp_path, "co_simulation", 0.25, longest_step=0.2) as instance:
        instance.advance(0.0, 0.25)

        assert instance.get_values(["reached", "attempts"]) == [0.25, 3]


@pytest.mark.parametrize("options", [StepOptions(), RETRY], ids=["as it is", "retrying"])
def test_a_step_from_a_restored_state_does_not_end_the_run_again(
    options: StepOptions, event_fmu: Callable[..., Path], tmp_path: Path
) -> None:
    with running(event_fmu("Stairs", 2), tmp_path, "co_simulation", 0.25, options, end=2) as stairs:
        state = stairs.get_state()
        for step in range(8):
            stairs.do_step(step)
        with pytest.raises(TerminationRequested):
            stairs.do_step(8)

        stairs.set_state(state)
        stairs.do_step(0)

        stairs.free_state(state)


@pytest.mark.parametrize("flag", ["canRejectSteps", "canHandleVariableCommunicationStepSize"])
def test_discarded_step_that_fmi_1_cannot_repeat_fails_with_last_successful_time(
    flag: str, steps: Steps, tmp_path: Path
) -> None:
    fmu = without(flag, steps(1), tmp_path / "fixed.fmu")

    with (
        running(fmu, tmp_path, "co_simulation", 0.25, longest_step=0.2) as instance,
        pytest.raises(
            StepFailed, match=r"^instance m: fmiDoStep returned discard; the last successful time is 0.2 s; "
        ),
    ):
        instance.do_step(0)


def test_a_discarded_step_of_fmi_2_fails_with_its_time_and_advice(steps: Steps, tmp_path: Path) -> None:
    with (
        running(steps(2), tmp_path, "co_simulation", 0.25, longest_step=0.2) as instance,
        pytest.raises(StepFailed) as caught,
    ):
        instance.do_step(0)

    assert str(caught.value) == (
        "instance m: fmi2DoStep returned discard; the last successful time is 0.2 s; the FMU says: the step is too "
        "long. Smaller steps (`step_size`), or `retry_discarded_steps: true` in a configuration, may help."
    )


@pytest.mark.parametrize("version", VERSIONS)
def test_fmu_that_does_not_tell_how_far_it_got_fails_all_same(version: int, steps: Steps, tmp_path: Path) -> None:
    fmu = without("canHandleVariableCommunicationStepSize", steps(version), tmp_path / "fixed.fmu")

    with (
        running(fmu, tmp_path, "co_simulation", 0.25, longest_step=0.2, mute=1) as instance,
        pytest.raises(StepFailed, match=r"DoStep returned discard; the FMU says: the step is too long"),
    ):
        instance.do_step(0)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_step_that_is_always_discarded_says_how_small_it_was_tried(
    version: int, steps: Steps, tmp_path: Path
) -> None:
    with (
        running(steps(version), tmp_path, "co_simulation", 0.25, RETRY, longest_step=1e-9) as instance,
        pytest.raises(StepFailed, match=r"DoStep returned discard down to 1/1024 of the step; .*the step is too long"),
    ):
        instance.do_step(0)


def test_check_refuses_retrying_if_an_fmu_of_fmi_1_cannot_repeat(
    steps: Steps, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fmu = without("canRejectSteps", steps(1), tmp_path / "fixed.fmu")
    config = write_config(tmp_path, instances={"m": {"fmu": str(fmu), "retry_discarded_steps": True}}, connections=[])

    assert main(["check", str(config)]) == 2

    assert "true, but the FMU cannot repeat a step (canRejectSteps); expected false" in capsys.readouterr().err


def test_message_that_comes_at_every_step_is_shown_few_times_and_counted(
    steps: Steps, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fmu = {"fmu": str(steps(1)), "start_values": {"longest_step": 0.0005}}
    config = write_config(tmp_path, instances={"m": fmu}, connections=[], stop_time=0.02)

    assert main(["launch", "--local", "--no-progress", str(config)]) == 0

    said = capsys.readouterr().err.splitlines()
    assert said == [
        *(f"m at point {point}: the step is too long" for point in range(5)),
        "m: the step is too long (15 more times)",
    ]


# ---- linear inputs


@pytest.mark.parametrize(("version", "name", "sign"), [(1, "u", 1.0), (2, "u", 1.0), (1, "opposite_u", -1.0)])
@pytest.mark.parametrize("delay", [0, 1])
def test_an_input_is_linear_within_a_step(
    version: int, name: str, sign: float, delay: int, steps: Steps, tmp_path: Path
) -> None:
    options = StepOptions(linear_inputs=(LinearInput(name, CouplingRule(delay, 1, 1)),))
    description = read_description(steps(version))
    inputs, outputs = Ring(Layout.of([(name, "Float64")]), 8), Ring(Layout.of([("y", "Float64")]), 8)
    for row in range(8):
        inputs.put(row, name, row * 0.5)
    with closing(open_instance(steps(version), "m", description, tmp_path, options=options)) as inner:
        instance = stepped(inner, options)
        instance.enter_initialization(0.0, None, {})
        instance.exit_initialization()
        instance.bind(inputs, (outputs,), TimeGrid(0.0, 0.25, 8), 1)
        for step in range(4):
            instance.do_step(step)

    # Of delay 0 a row is the value at the end of its step; of delay 1 that at its start, from where it goes on.
    expected = [0.0, 0.5, 1.0, 1.5] if delay == 0 else [0.0, 1.0, 1.5, 2.0]
    assert [outputs.value(step, "y") for step in range(1, 5)] == [sign * value for value in expected]


@pytest.mark.parametrize(
    ("delay", "source_points", "points", "expected"),
    [
        (1, 4, 1, [0.0, 0.0, 0.0, 0.0, 1.25, 1.5, 1.75, 2.0, 2.25]),
        (0, 4, 1, [0.0, 0.0, 0.0, 1.0, 1.25, 1.5, 1.75, 2.0, 2.25]),
        (1, 2, 3, [0.0, 3.0, 4.5, 6.0]),
        (0, 2, 3, [1.5, 3.0, 4.5, 6.0]),
        (1, 1, 4, [0.0, 8.0, 12.0]),
        (0, 1, 4, [4.0, 8.0, 12.0]),
    ],
)
def test_a_line_follows_the_steps_of_its_source(
    delay: int, source_points: int, points: int, expected: list[float], steps: Steps, tmp_path: Path
) -> None:
    rule = CouplingRule(delay, source_points, points)
    options = StepOptions(linear_inputs=(LinearInput("u", rule),))
    inputs, outputs = Ring(Layout.of([("u", "Float64")]), 1), Ring(Layout.of([("y", "Float64")]), 1)
    found = []
    with closing(open_instance(steps(2), "m", read_description(steps(2)), tmp_path, options=options)) as inner:
        instance = stepped(inner, options)
        instance.enter_initialization(0.0, None, {})
        instance.exit_initialization()
        instance.bind(inputs, (outputs,), TimeGrid(0.0, 0.25, 100), points)
        for step in range(len(expected)):
            inputs.put(0, "u", float(rule.row_for(step)))  # the source grows by 1 in each of its own steps
            instance.do_step(step)
            found.append(outputs.value(0, "y"))

    assert found == expected


@pytest.mark.parametrize("version", VERSIONS)
def test_a_discarded_step_with_a_linear_input_is_a_failure(version: int, steps: Steps, tmp_path: Path) -> None:
    options = StepOptions(linear_inputs=(LinearInput("u", CouplingRule(1, 1, 1)),))

    with running(steps(version), tmp_path, "co_simulation", 0.25, options, longest_step=0.2) as instance:
        instance.set_input_derivatives({"u": 0.0})
        with pytest.raises(StepFailed, match=r"DoStep returned discard; .*Smaller steps \(`step_size`\) may help"):
            instance.do_step(0)


# ---- pending


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("options", [StepOptions(), RETRY], ids=["as it is", "retrying"])
def test_a_pending_step_is_waited_for(version: int, options: StepOptions, steps: Steps, tmp_path: Path) -> None:
    with running(steps(version), tmp_path, "co_simulation", 0.25, options, polls=3) as instance:
        instance.do_step(0)
        instance.advance(0.25, 0.25)

        assert instance.get_values(["reached", "attempts"]) == [0.5, 2]


@pytest.mark.parametrize("version", VERSIONS)
def test_a_pending_step_may_be_discarded_later_and_is_taken_in_parts(
    version: int, steps: Steps, tmp_path: Path
) -> None:
    with running(steps(version), tmp_path, "co_simulation", 0.25, RETRY, polls=2, longest_step=0.2) as instance:
        instance.do_step(0)

        assert instance.get_values(["reached", "attempts"]) == [0.25, 3]


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize(
    ("ends_as", "mute", "says"),
    [
        (3, 0, r"DoStep returned error; the FMU gave no message"),
        (0, 1, r"DoStep returned pending, and fmi2?GetStatus does not tell when the step is done"),
    ],
    ids=["fails", "does not tell"],
)
def test_a_pending_step_that_does_not_end_well_is_a_failure(
    ends_as: int, mute: int, says: str, version: int, steps: Steps, tmp_path: Path
) -> None:
    with (
        running(steps(version), tmp_path, "co_simulation", 0.25, polls=2, ends_as=ends_as, mute=mute) as instance,
        pytest.raises(StepFailed, match=says),
    ):
        instance.do_step(0)
