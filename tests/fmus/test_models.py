"""What the example FMUs and the test-only FMUs compute, each against an answer found by other means."""

from __future__ import annotations

import math
import random
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from fmpy.fmi1 import FMICallException

from tests.fmus.harness import Message, Unit, Value
from tests.fmus.reference import Pendulum, angle_after

ROOT = Path(__file__).resolve().parents[2]
DISCARD, ERROR = 2, 3
LAST_SUCCESSFUL_TIME, TERMINATED = 2, 3

Find = Callable[[str], Path]


def varying_steps(stop_time: float, longest: float) -> list[float]:
    """Return random but repeatable step sizes (s) that reach ``stop_time`` and a little more."""
    source, steps, reached = random.Random(3), list[float](), 0.0  # noqa: S311 - no secret
    while reached < stop_time:
        steps.append(source.uniform(longest / 100, longest))
        reached += steps[-1]
    return steps


# ---- DampedPendulum ----

ACCURACY = 1e-9
"""rad, after 40 s."""


def swing(unit: Unit, pendulum: Pendulum, steps: Sequence[float]) -> float:
    """Take the steps from rest time 0 and return the time (s) reached."""
    values = {"a": pendulum.a, "der(a)": pendulum.velocity, "l": pendulum.l, "d": pendulum.d, "g": pendulum.g}
    unit.start(values)
    reached = 0.0
    for step_size in steps:
        unit.step(reached, step_size)
        reached += step_size
    return reached


@pytest.mark.parametrize(
    "steps",
    [
        pytest.param([0.002] * 20_000, id="2 ms, the default"),
        pytest.param([0.02] * 2_000, id="20 ms"),
        pytest.param([1 / 30] * 1_200, id="1/30 s"),
        pytest.param([0.5] * 80, id="0.5 s"),
        pytest.param([40.0], id="one step of 40 s"),
        pytest.param(varying_steps(40.0, 0.05), id="varying steps up to 50 ms"),
    ],
)
@pytest.mark.parametrize(
    "pendulum",
    [
        pytest.param(Pendulum(), id="defaults"),
        pytest.param(Pendulum(a=1.3, l=2.0, d=0.001), id="the pendulum_delay example"),
        pytest.param(Pendulum(a=3.0, d=0.0), id="nearly upright, undamped"),
        pytest.param(Pendulum(a=1.5, l=0.1, d=0.05), id="short"),
        pytest.param(Pendulum(a=0.0, velocity=10.0), id="going over the top"),
    ],
)
def test_the_pendulum_is_accurate_at_any_communication_step_size(
    pendulum: Pendulum, steps: list[float], folder: Find
) -> None:
    with Unit(folder("DampedPendulum")) as unit:
        reached = swing(unit, pendulum, steps)

        assert unit.real("a") == pytest.approx(angle_after(pendulum, reached), rel=0, abs=ACCURACY)


def test_an_undamped_pendulum_keeps_its_exact_period(folder: Find) -> None:
    pendulum = Pendulum(a=2.0, d=0.0)
    quarter = pendulum.period() / 4

    with Unit(folder("DampedPendulum")) as unit:
        swing(unit, pendulum, [quarter] * 41)

        assert unit.real("a") == pytest.approx(0.0, abs=ACCURACY)


def test_the_acceleration_fits_the_equation_from_initialization_mode_on(folder: Find) -> None:
    with Unit(folder("DampedPendulum")) as unit:
        unit.setup()
        unit.set("a", 0.5)
        unit.set("der(a)", 2.0)
        unit.set("l", 4.0)

        assert unit.real("der(a,2)") == pytest.approx(-9.81 / 4.0 * math.sin(0.5) - 0.1 * 2.0, rel=1e-15)

        unit.fmi.exitInitializationMode()
        unit.step(0.0, 0.1)
        a, velocity = unit.real("a"), unit.real("der(a)")

        assert unit.real("der(a,2)") == pytest.approx(-9.81 / 4.0 * math.sin(a) - 0.1 * velocity, rel=1e-15)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"l": 0.0}, "l is 0 m but has to be greater than 0"),
        ({"l": -1.0}, "l is -1 m but has to be greater than 0"),
        ({"l": math.nan}, "but has to be greater than 0"),
        ({"d": 1e5}, "move faster than 10000 1/s"),
        ({"g": math.nan}, "move faster than 10000 1/s"),
    ],
)
def test_a_pendulum_that_cannot_be_solved_is_refused_with_its_values(
    values: dict[str, float], expected: str, folder: Find
) -> None:
    with Unit(folder("DampedPendulum")) as unit:
        message = failing_start(unit, values)

    assert expected in message.text
    assert message.status == ERROR


def failing_start(unit: Unit, values: dict[str, float]) -> Message:
    with pytest.raises(FMICallException, match="fmi2ExitInitializationMode"):
        unit.start(values)
    return unit.messages[-1]


# ---- TransportDelay ----


def delayed(unit: Unit, d: float, x: Callable[[float], float], steps: Sequence[float]) -> list[tuple[float, float]]:
    """Run with x as the value at the end of each step (as Gauss-Seidel sets it); return rows of (time, y)."""
    unit.start({"d": d, "x": x(0.0)})
    reached, rows = 0.0, []
    for step_size in steps:
        unit.set("x", x(reached + step_size))
        unit.step(reached, step_size)
        reached += step_size
        rows.append((reached, unit.real("y")))
    return rows


@pytest.mark.parametrize("d", [0.0, 0.001, 0.03, 0.1, 0.25, 2.33])
@pytest.mark.parametrize(
    "steps",
    [
        pytest.param([0.1] * 60, id="equal steps"),
        pytest.param(varying_steps(6.0, 0.2), id="varying steps"),
    ],
)
def test_a_ramp_comes_out_exactly_d_later_whatever_the_steps(steps: list[float], d: float, folder: Find) -> None:
    with Unit(folder("TransportDelay")) as unit:
        rows = delayed(unit, d, lambda t: 3.0 + 2.0 * t, steps)

    assert [y for _, y in rows] == pytest.approx([3.0 + 2.0 * max(0.0, t - d) for t, _ in rows], rel=1e-12)


def test_a_delay_of_whole_steps_gives_the_very_samples_back(folder: Find) -> None:
    with Unit(folder("TransportDelay")) as unit:
        rows = delayed(unit, 1.0, math.sin, [0.125] * 100)

    assert [y for _, y in rows] == [math.sin(max(0.0, t - 1.0)) for t, _ in rows]


def test_without_a_delay_y_is_x_after_the_step(folder: Find) -> None:
    with Unit(folder("TransportDelay")) as unit:
        rows = delayed(unit, 0.0, math.cos, varying_steps(5.0, 0.1))

    assert [y for _, y in rows] == [math.cos(t) for t, _ in rows]


def test_before_delay_has_passed_y_is_x_of_end_of_initialization_mode(folder: Find) -> None:
    with Unit(folder("TransportDelay")) as unit:
        unit.setup(start_time=10.0)
        unit.set("d", 0.5)
        unit.set("x", 7.0)
        at_start = unit.real("y")
        unit.fmi.exitInitializationMode()

        rows = unit.run([(0.125, 1.0)] * 6, start_time=10.0)

    assert at_start == 7.0
    assert [row["y"] for row in rows] == [7.0, 7.0, 7.0, 7.0, 1.0, 1.0]


def test_a_long_delay_takes_memory_for_its_length_and_no_more(folder: Find) -> None:
    with Unit(folder("TransportDelay")) as unit:
        unit.start({"d": 8.0})
        unit.run([(0.0078125, 1.0)] * 2_000)
        size_early = len(stored_state(unit))

        rows = unit.run([(0.0078125, 2.0)] * 6_000, start_time=15.625)

        assert len(stored_state(unit)) == size_early < 50_000
        assert [row["y"] for row in rows].count(1.0) == 1024


def stored_state(unit: Unit) -> bytes:
    state = unit.fmi.getFMUstate()
    stored: bytes = unit.fmi.serializeFMUstate(state)
    unit.fmi.freeFMUstate(state)
    return stored


@pytest.mark.parametrize("d", [-0.1, math.nan, math.inf])
def test_a_delay_that_is_negative_or_not_finite_is_refused(d: float, folder: Find) -> None:
    with Unit(folder("TransportDelay")) as unit:
        assert "has to be finite and not negative" in failing_start(unit, {"d": d}).text


def test_steps_too_short_to_be_told_apart_do_no_harm(folder: Find) -> None:
    with Unit(folder("TransportDelay")) as unit:
        unit.start({"d": 0.0}, start_time=100.0)

        rows = unit.run([(1e-15, 4.0), (1e-15, 5.0), (1.0, 6.0)], start_time=100.0)

    assert [row["y"] for row in rows] == [4.0, 5.0, 6.0]


# ---- Gain, Adder, Integrator ----


def test_a_gain_can_be_tuned_between_steps_and_acts_at_next_one(folder: Find) -> None:
    with Unit(folder("Gain")) as unit:
        unit.start({"k": 2.0, "u": 3.0})
        at_start = unit.real("y")
        unit.set("k", -1.0)
        before_the_step = unit.real("y")

        unit.step(0.0, 0.1)

        assert (at_start, before_the_step, unit.real("y")) == (6.0, 6.0, -3.0)


def test_an_adder_adds(folder: Find) -> None:
    with Unit(folder("Adder")) as unit:
        unit.start({"u1": 0.1, "u2": 0.2})
        at_start = unit.real("y")
        unit.set("u1", 5.0)

        unit.step(0.0, 0.1)

        assert (at_start, unit.real("y")) == (0.1 + 0.2, 5.2)


def test_an_integrator_holds_its_input_over_the_step(folder: Find) -> None:
    with Unit(folder("Integrator")) as unit:
        unit.start({"u": 4.0, "y": 1.0, "k": 0.5})
        at_start = unit.real("y")

        rows = unit.run([(0.25, 4.0), (0.5, -1.0)])

    assert [at_start, *(row["y"] for row in rows)] == [1.0, 1.5, 1.25]


# ---- the FMUs that only tests use ----


def test_every_type_goes_through_and_parameters_keep_their_values(folder: Find) -> None:
    values: dict[str, Value] = {
        "real": -0.5,
        "integer": -(2**31),
        "boolean": True,
        "string": "Grüße 100 %",
        "enumeration": 3,
    }

    with Unit(folder("AllTypes")) as unit:
        unit.start()
        for kind, value in values.items():
            unit.set(f"{kind}_in", value)
            unit.set(f"{kind}_parameter", value)
        before_the_step = unit.get("string_out")
        unit.step(0.0, 0.1)

        assert {kind: unit.get(f"{kind}_out") for kind in values} == values
        assert {kind: unit.get(f"{kind}_parameter") for kind in values} == values
        assert (before_the_step, unit.get("steps")) == ("", 1)


def test_a_text_that_is_too_long_is_refused_and_not_cut(folder: Find) -> None:
    with Unit(folder("AllTypes")) as unit:
        unit.start()
        unit.set("string_in", "x" * 1023)

        with pytest.raises(FMICallException):
            unit.set("string_in", "x" * 1024)

        assert unit.messages[-1].text == 'fmi2SetString: "string_in" takes at most 1023 bytes'


def test_faulty_is_a_plain_unit_by_default(folder: Find) -> None:
    with Unit(folder("Faulty")) as unit:
        rows = unit.start().run([(0.5, 1.0), (0.5, 2.0)])

    assert [row["y"] for row in rows] == [1.0, 2.0]


def test_faulty_fails_with_a_message_in_step_that_ends_after_fail_at(folder: Find) -> None:
    with Unit(folder("Faulty")) as unit:
        unit.start({"fail_at": 0.5})
        unit.step(0.0, 0.5)

        with pytest.raises(FMICallException) as caught:
            unit.step(0.5, 0.5)

    assert caught.value.status == ERROR
    assert unit.messages == [Message("unit", ERROR, "logStatusError", "the reactor is empty")]


def test_a_discarded_step_can_be_asked_about_and_taken_back(folder: Find) -> None:
    with Unit(folder("Faulty")) as unit:
        unit.start({"discard_at": 0.75})
        unit.step(0.0, 0.5)
        state = unit.fmi.getFMUstate()

        with pytest.raises(FMICallException) as caught:
            unit.step(0.5, 0.5)
        last_time = unit.fmi.getRealStatus(LAST_SUCCESSFUL_TIME)
        wants_to_end = unit.fmi.getBooleanStatus(TERMINATED)
        unit.fmi.setFMUstate(state)
        unit.fmi.freeFMUstate(state)
        unit.step(0.5, 0.25)

    assert (caught.value.status, last_time, wants_to_end) == (DISCARD, 0.5, False)
    assert unit.messages == [Message("unit", DISCARD, "logStatusDiscard", "the step does not converge")]


def test_faulty_fails_in_initialization_mode_where_asked_to(folder: Find) -> None:
    with Unit(folder("Faulty")) as unit:
        assert failing_start(unit, {"fail_in_init": True}).text == "the reactor does not start"


def test_a_slow_step_takes_its_time(folder: Find) -> None:
    with Unit(folder("Faulty")) as unit:
        unit.start({"slow": 0.05})
        begin = time.perf_counter()

        unit.step(0.0, 0.1)

        assert time.perf_counter() - begin >= 0.05


def one_step_in_a_process(folder: Path, fault: str) -> subprocess.Popen[str]:
    """Start a process that says "stepping" and then takes a step in which ``fault`` strikes."""
    program = f"""
        import resource
        from pathlib import Path
        from tests.fmus.harness import Unit
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with Unit(Path({str(folder)!r})) as unit:
            unit.start({{{fault!r}: 0.0}})
            print("stepping", flush=True)
            unit.step(0.0, 0.1)
    """
    return subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(program)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )


def test_faulty_crashes_its_process(folder: Find) -> None:
    with one_step_in_a_process(folder("Faulty"), "crash_at") as process:
        assert process.wait(timeout=30) == -signal.SIGABRT


def test_faulty_hangs_until_its_process_is_killed(folder: Find) -> None:
    with one_step_in_a_process(folder("Faulty"), "hang_at") as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "stepping\n"

        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(timeout=0.3)

        process.kill()
        assert process.wait(timeout=30) == -signal.SIGKILL
