"""The skeleton of the example FMUs: calling sequence, messages and FMU state (FMI 2.0.4, 4.2.4)."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.fmus.harness import VARYING_STEPS, Unit, refusal
from tests.fmus.helpers import KEPT_FMUS, TEST_FMUS

ERROR = 3

every_fmu = pytest.mark.parametrize("name", [*KEPT_FMUS, *TEST_FMUS])
every_kept_fmu = pytest.mark.parametrize("name", KEPT_FMUS)

Find = Callable[[str], Path]


# ---- the calling sequence ----


def in_init(unit: Unit) -> None:
    unit.setup()


def stepping(unit: Unit) -> None:
    unit.start()


def terminated(unit: Unit) -> None:
    unit.start().fmi.terminate()


def failed(unit: Unit) -> None:
    unit.start()
    refusal(unit, lambda: unit.step(0.0, -1.0))


def instantiated(_unit: Unit) -> None:
    pass


@pytest.mark.parametrize(
    ("prepare", "call", "expected"),
    [
        (
            instantiated,
            lambda u: u.fmi.enterInitializationMode(),
            "fmi2SetupExperiment has to be called before",
        ),
        (instantiated, lambda u: u.fmi.exitInitializationMode(), 'not allowed in the state "instantiated"'),
        (instantiated, lambda u: u.step(0.0, 0.1), 'not allowed in the state "instantiated"'),
        (instantiated, lambda u: u.get("y"), 'not allowed in the state "instantiated"'),
        (instantiated, lambda u: u.fmi.setupExperiment(startTime=math.nan), "start time has to be finite"),
        (instantiated, lambda u: u.setup(1.0, stop_time=0.5), "stop time 0.5 s is before the start time 1 s"),
        (in_init, lambda u: u.step(0.0, 0.1), 'not allowed in the state "initialization mode"'),
        (in_init, lambda u: u.fmi.setupExperiment(), 'not allowed in the state "initialization mode"'),
        (in_init, lambda u: u.fmi.terminate(), 'not allowed in the state "initialization mode"'),
        (stepping, lambda u: u.fmi.enterInitializationMode(), 'not allowed in the state "step complete"'),
        (stepping, lambda u: u.step(0.0, 0.0), "step size is 0 s but has to be greater than 0"),
        (stepping, lambda u: u.step(0.0, -0.5), "step size is -0.5 s but has to be greater than 0"),
        (stepping, lambda u: u.step(0.0, math.nan), "but has to be greater than 0"),
        (stepping, lambda u: u.step(0.0, math.inf), "but has to be greater than 0"),
        (stepping, lambda u: u.step(0.5, 0.1), "point is 0.5 s but the instance is at 0 s"),
        (stepping, lambda u: u.step(math.nan, 0.1), "but the instance is at 0 s"),
        (stepping, lambda u: u.fmi.getReal([77]), "unknown value reference 77 (the highest is 2)"),
        (stepping, lambda u: u.fmi.setReal([3], [1.0]), "unknown value reference 3 (the highest is 2)"),
        (stepping, lambda u: u.fmi.getInteger([0]), 'value reference 0 is "u", which is a Real'),
        (stepping, lambda u: u.fmi.setString([0], ["1"]), 'value reference 0 is "u", which is a Real'),
        (stepping, lambda u: u.fmi.fmi2GetReal(u.fmi.component, None, 1, None), "a null pointer"),
        (stepping, lambda u: u.fmi.cancelStep(), "not supported"),
        (stepping, lambda u: u.fmi.getRealOutputDerivatives([1], [1]), "not supported"),
        (stepping, lambda u: u.fmi.setDebugLogging(1, ["logNoise"]), 'unknown log category "logNoise"'),
        (terminated, lambda u: u.step(0.0, 0.1), 'not allowed in the state "terminated"'),
        (terminated, lambda u: u.set("u", 1.0), 'not allowed in the state "terminated"'),
        (failed, lambda u: u.step(0.0, 0.1), 'not allowed in the state "error"'),
        (failed, lambda u: u.fmi.terminate(), 'not allowed in the state "error"'),
    ],
)
def test_a_call_that_the_fmi_forbids_is_an_error_that_says_why(
    prepare: Callable[[Unit], None], call: Callable[[Unit], object], expected: str, folder: Find
) -> None:
    with Unit(folder("Gain")) as unit:
        prepare(unit)

        message = refusal(unit, lambda: call(unit))

        assert expected in message.text
        assert (message.instance_name, message.status, message.category) == ("unit", ERROR, "logStatusError")


def test_step_past_stop_time_is_error_and_one_onto_it_is_not(folder: Find) -> None:
    with Unit(folder("Gain")) as unit:
        unit.setup(stop_time=0.3).fmi.exitInitializationMode()
        for k in range(3):
            unit.step(k * 0.1, 0.1)

        message = refusal(unit, lambda: unit.step(0.3, 0.1))

        assert "the step ends at 0.40000000000000002 s, after the stop time" in message.text


def test_a_foreign_guid_gives_no_instance_and_a_message(folder: Find) -> None:
    with Unit(folder("Gain")) as unit:
        unit.fmi.guid = "{100%}"
        own = unit.fmi.component

        with pytest.raises(Exception, match="Failed to instantiate"):
            unit.fmi.instantiate(callbacks=unit.callbacks)

        unit.fmi.component = own
        assert unit.messages[-1].text.endswith(", not {100%%}")


def test_model_exchange_functions_are_not_there(folder: Find) -> None:
    with Unit(folder("Gain")) as unit:
        assert not hasattr(unit.fmi.dll, "fmi2NewDiscreteStates")
        assert not hasattr(unit.fmi.dll, "apply_start_values")


def test_calls_are_logged_only_while_debug_logging_asks_for_them(folder: Find) -> None:
    with Unit(folder("Gain"), logging_on=True) as unit:
        unit.start()
        unit.fmi.setDebugLogging(1, ["logStatusError"])
        unit.step(0.0, 0.1)

        calls = [message.text for message in unit.messages if message.category == "logAll"]

    assert calls == [
        "fmi2SetupExperiment",
        "fmi2EnterInitializationMode",
        "fmi2ExitInitializationMode",
        "fmi2SetDebugLogging",
    ]


@every_kept_fmu
def test_not_a_number_is_passed_on_and_no_error(name: str, folder: Find) -> None:
    with Unit(folder(name)) as unit:
        unit.start()

        unit.run([(0.5, math.nan), (0.5, math.nan), (0.5, math.nan)])

        causalities = {variable.name: variable.causality for variable in unit.description.modelVariables}
        outputs = [unit.real(variable) for variable, causality in causalities.items() if causality == "output"]
        assert unit.messages == []
        assert any(map(math.isnan, outputs)) == ("input" in causalities.values())


@every_kept_fmu
def test_a_reset_instance_behaves_like_a_new_one(name: str, folder: Find) -> None:
    with Unit(folder(name)) as unit:
        first = unit.start(start_time=2.0).run(VARYING_STEPS, start_time=2.0)

        unit.fmi.reset()

        assert unit.start(start_time=2.0).run(VARYING_STEPS, start_time=2.0) == first


@every_kept_fmu
def test_two_instances_in_one_process_do_not_know_each_other(name: str, folder: Find) -> None:
    with Unit(folder(name)) as alone:
        expected = alone.start().run(VARYING_STEPS)

    with Unit(folder(name)) as first, Unit(folder(name)) as second:
        first.start()
        second.start().run([(0.7, 5.0)])

        assert first.run(VARYING_STEPS) == expected


# ---- the FMU state ----

HALF = len(VARYING_STEPS) // 2
HALF_TIME = 0.0
for _step_size, _ in VARYING_STEPS[:HALF]:
    HALF_TIME += _step_size


@every_kept_fmu
def test_an_instance_goes_on_bit_by_bit_from_a_stored_state(name: str, folder: Find) -> None:
    with Unit(folder(name)) as unit:
        unit.start().run(VARYING_STEPS[:HALF])
        state = unit.fmi.getFMUstate()
        expected = unit.run(VARYING_STEPS[HALF:], HALF_TIME)

        unit.fmi.setFMUstate(state)
        unit.fmi.freeFMUstate(state)

        assert unit.run(VARYING_STEPS[HALF:], HALF_TIME) == expected


@every_kept_fmu
def test_another_instance_goes_on_bit_by_bit_from_serialized_bytes(name: str, folder: Find) -> None:
    with Unit(folder(name)) as unit:
        unit.start().run(VARYING_STEPS[:HALF])
        state = unit.fmi.getFMUstate()
        stored = unit.fmi.serializeFMUstate(state)
        unit.fmi.freeFMUstate(state)
        expected = unit.run(VARYING_STEPS[HALF:], HALF_TIME)

    with Unit(folder(name)) as other:
        state = other.fmi.deSerializeFMUstate(stored)
        other.fmi.setFMUstate(state)
        other.fmi.freeFMUstate(state)

        assert other.run(VARYING_STEPS[HALF:], HALF_TIME) == expected


@every_fmu
def test_equal_runs_store_equal_bytes(name: str, folder: Find) -> None:
    stored = []
    for _ in range(2):
        with Unit(folder(name)) as unit:
            unit.start().run(VARYING_STEPS[:HALF])
            stored.append(unit.fmi.serializeFMUstate(unit.fmi.getFMUstate()))

    assert stored[0] == stored[1]


def test_a_stored_state_brings_an_instance_back_after_an_error(folder: Find) -> None:
    with Unit(folder("Integrator")) as unit:
        unit.start({"y": 2.0})
        state = unit.fmi.getFMUstate()
        refusal(unit, lambda: unit.step(0.0, -1.0))

        unit.fmi.setFMUstate(state)
        unit.fmi.freeFMUstate(state)
        unit.set("u", 1.0)
        unit.step(0.0, 0.5)

        assert unit.real("y") == 2.5


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (lambda stored: stored[:20], "20 bytes are too few"),
        (lambda stored: stored[:-1], "damaged or come from another FMU"),
        (lambda stored: stored[:-3] + b"\x7f" + stored[-2:], "damaged or come from another FMU"),
        (lambda stored: stored + b"\0", "damaged or come from another FMU"),
    ],
)
def test_damaged_bytes_are_refused(damage: Callable[[bytes], bytes], expected: str, folder: Find) -> None:
    with Unit(folder("TransportDelay")) as unit:
        unit.start().run(VARYING_STEPS[:50])
        stored = unit.fmi.serializeFMUstate(unit.fmi.getFMUstate())

        message = refusal(unit, lambda: unit.fmi.deSerializeFMUstate(damage(stored)))

        assert expected in message.text


def test_the_state_of_another_model_is_refused(folder: Find) -> None:
    with Unit(folder("Gain")) as gain, Unit(folder("Adder")) as adder:
        stored = gain.start().fmi.serializeFMUstate(gain.fmi.getFMUstate())
        adder.start()

        message = refusal(adder, lambda: adder.fmi.deSerializeFMUstate(stored))

        assert "come from another FMU" in message.text
