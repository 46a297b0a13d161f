"""An FMU that fails, crashes or hangs: which instance, at which point and time, and what it said itself."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import pytest

from fmu_mesh.cli.output.flag_words import in_flags
from fmu_mesh.instances.fmi.co_simulation.discarded_steps import RETRY
from fmu_mesh.rings.library import LIBRARY_VARIABLE
from tests.fmus import event_fmus
from tests.fmus.chatty_fmus import chatty_fmu
from tests.fmus.helpers import NO_COMPILER, find_fmu
from tests.helpers import BY_STREAMS, BY_ZENOH, Place, row_count, rows_of, wait_until, write_config


def with_faulty(
    place: Place,
    faulty: Path,
    start_values: Mapping[str, float | bool],
    *,
    simulation: Mapping[str, float] | None = None,
    timeouts: Mapping[str, float] | None = None,
    zenoh: Mapping[str, bool] | None = None,
) -> Path:
    """A pendulum that feeds the FMU with faults for two seconds in steps of 1 ms."""
    return write_config(
        place.folder,
        instances={
            "pendulum": {"fmu": "DampedPendulum"},
            "faulty": {"fmu": str(faulty), "start_values": dict(start_values)},
        },
        connections=["pendulum.a -> faulty.u"],
        stop_time=2.0,
        simulation=simulation or {},
        timeouts=timeouts or {},
        zenoh=zenoh or {},
    )


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])
@pytest.mark.parametrize(
    ("fault", "status", "says"),
    [
        ("fail_at", "error", "the reactor is empty. "),
        (
            "discard_at",
            "discard; the last successful time is 1 s",
            f"the step does not converge. {in_flags(RETRY)} ",
        ),
    ],
)
def test_failed_step_is_told_with_instance_point_time_and_message_of_fmu(
    place: Place, faulty: Path, fault: str, status: str, says: str, options: tuple[str, ...]
) -> None:
    config = with_faulty(place, faulty, {fault: 1.0})

    launched = place.run("launch", config, *options)

    assert launched.wait() == 3
    rows = rows_of(config.with_suffix(".csv"))
    assert launched.errors.splitlines()[-1] == (
        f"fmu-mesh: instance faulty, point 1000, t = 1 s: fmi2DoStep returned {status}; the FMU says: {says}"
        f"What was recorded up to then ({len(rows)} rows) is in '{config.with_suffix('.csv')}'."
    )
    assert launched.errors.count(says.partition(".")[0]) == 1
    assert "Traceback" not in launched.errors
    assert [row[0] for row in rows] == [point * 0.001 for point in range(1001)]
    place.assert_nothing_left()


@pytest.mark.parametrize("simulation", [{}, {"window": 1}, {"real_time_factor": 1}], ids=["auto", "lockstep", "paced"])
@pytest.mark.parametrize("zenoh", [{}, BY_STREAMS, BY_ZENOH], ids=["shared", "streams", "zenoh"])
def test_when_an_fmu_fails_all_rows_before_are_kept(
    place: Place, faulty: Path, simulation: dict[str, float], zenoh: Mapping[str, bool]
) -> None:
    """The other node hears of it, and has rows that it had not sent yet: nobody steps on them."""
    config = with_faulty(place, faulty, {"fail_at": 0.5}, simulation=simulation, zenoh=zenoh)

    launched = place.run("launch", config)

    assert launched.wait() == 3
    assert [row[0] for row in rows_of(config.with_suffix(".csv"))] == [point * 0.001 for point in range(501)]
    place.assert_nothing_left()


@pytest.mark.parametrize("zenoh", [{}, BY_STREAMS, BY_ZENOH], ids=["shared", "streams", "zenoh"])
def test_node_that_is_killed_in_long_step_has_sent_everything_before_it(
    place: Place, faulty: Path, zenoh: Mapping[str, bool]
) -> None:
    config = write_config(
        place.folder,
        instances={"slow": {"fmu": str(faulty), "start_values": {"hang_at": 0.2}}, "gain": {"fmu": "Gain"}},
        connections=["slow.y -> gain.u"],
        stop_time=2.0,
        zenoh=zenoh,
    )
    launched = place.start("launch", config)
    wait_until(lambda: row_count(config.with_suffix(".csv")) == 201, "all rows, while the step is under way")

    launched.child("slow").kill()

    assert launched.wait() == 4
    assert [row[0] for row in rows_of(config.with_suffix(".csv"))] == [point * 0.001 for point in range(201)]
    place.assert_nothing_left()


def test_nobody_waits_long_for_rows_of_a_node_whose_fmu_hangs(place: Place, faulty: Path) -> None:
    config = write_config(
        place.folder,
        instances={
            "stuck": {"fmu": str(faulty), "start_values": {"hang_at": 0.2}},
            # Near: it leads the other by what that steps in half a second, which is little on a busy machine.
            "failing": {"fmu": str(faulty), "start_values": {"fail_at": 0.21}},
        },
        connections=[],
        stop_time=2.0,
    )

    launched = place.run("launch", config)

    assert launched.wait() == 3
    assert launched.message.startswith("fmu-mesh: instance failing, point 210, t = 0.21 s: ")
    rows = rows_of(config.with_suffix(".csv"))
    assert [row[0] for row in rows] == [point * 0.001 for point in range(len(rows))]
    assert 1 <= len(rows) <= 201
    place.assert_nothing_left()


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])
@pytest.mark.parametrize("name", ["Steps1", "Steps2"])
def test_a_step_that_is_pending_for_ever_ends_at_deadline_of_step(
    place: Place, tmp_path: Path, name: str, options: tuple[str, ...]
) -> None:
    instances = {"pump": {"fmu": str(find_fmu(name, tmp_path)), "start_values": {"polls": -1}}}
    config = write_config(place.folder, instances=instances, connections=[], timeouts={"step": 2.0})

    launched = place.run("launch", config, *options)

    assert launched.wait() == 3
    assert launched.message.startswith("fmu-mesh: instance pump, point 0, t = 0 s: the FMU has not returned for ")
    assert f" s from doStep{'' if options else '; its process is ended'}. " in launched.message
    place.assert_nothing_left()


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])
def test_an_fmu_that_fails_in_initialization_mode_is_told_with_its_instance(
    place: Place, faulty: Path, options: tuple[str, ...]
) -> None:
    launched = place.run("launch", with_faulty(place, faulty, {"fail_in_init": True}), *options)

    assert launched.wait() == 3
    assert launched.errors.splitlines()[-1] == (
        "fmu-mesh: instance faulty: fmi2ExitInitializationMode returned error; "
        "the FMU says: the reactor does not start."
    )
    assert "Traceback" not in launched.errors
    place.assert_nothing_left()


def test_an_fmu_that_aborts_takes_only_its_own_process_with_it(place: Place, faulty: Path) -> None:
    config = with_faulty(place, faulty, {"crash_at": 1.0})

    launched = place.run("launch", config)

    assert launched.wait() == 4
    rows = rows_of(config.with_suffix(".csv"))
    assert len(rows) <= 1001
    assert "instance faulty, point " in launched.message
    assert "its process was ended by SIGABRT" in launched.message
    place.assert_nothing_left()


def test_an_fmu_that_does_not_return_meets_the_deadline_of_a_step(place: Place, faulty: Path) -> None:
    config = with_faulty(place, faulty, {"hang_at": 1.0}, timeouts={"step": 2.0})

    launched = place.run("launch", config)

    assert launched.wait() == 3
    where, _, rest = launched.message.partition(": the FMU has not returned for ")
    assert where == "fmu-mesh: instance faulty, point 1000, t = 1 s"
    assert float(rest.partition(" s from doStep")[0]) >= 2.0
    assert "`timeouts.step`" in launched.message
    assert len(rows_of(config.with_suffix(".csv"))) == 1001
    place.assert_nothing_left()


def test_status_is_answered_while_an_fmu_does_not_return(place: Place, faulty: Path) -> None:
    launched = place.start("launch", with_faulty(place, faulty, {"hang_at": 1.0}))

    with place.session() as session:

        def status_of(instance: str, activity: str) -> dict[str, Any] | None:
            for reply in session.get(f"fmu_mesh/pair/{instance}/status", timeout=5.0):
                if reply.ok is not None:
                    status: dict[str, Any] = json.loads(reply.ok.payload.to_bytes())
                    return status if activity in status["activity"] else None
            return None

        hanging = "in doStep at point 1000 for "
        status = wait_until(lambda: status_of("faulty", hanging), "the status of an FMU that hangs")
        neighbour = wait_until(lambda: status_of("pendulum", "waiting at point"), "the status of an FMU that waits")
    launched.signal(signal.SIGINT)

    assert (status["state"], status["point"], status["time"]) == ("running", 1000, 1.0)
    assert "waiting at point" in neighbour["activity"]
    assert launched.wait() == 130
    place.assert_nothing_left()


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])
def test_fmu_that_asks_to_end_simulation_is_named_and_nothing_has_failed(
    place: Place, event_fmu: Callable[..., Path], options: tuple[str, ...]
) -> None:
    """Its steps are five points long: the outputs hold to the last point before the step that it did not finish."""
    config = write_config(
        place.folder,
        instances={
            "pendulum": {"fmu": "DampedPendulum"},
            "stairs": {
                "fmu": str(event_fmu("Stairs", 2)),
                "start_values": {"period": 0.0125, "end": 3},
                "step_size": 0.005,
            },
        },
        connections=[],
        stop_time=1000.0,
    )

    launched = place.run("launch", config, *options)

    assert launched.wait() == 0
    assert "instance stairs, point 39, t = 0.039 s: the FMU asked to end the simulation" in launched.errors
    rows = rows_of(config.with_suffix(".csv"))
    assert [row[0] for row in rows] == [point * 0.001 for point in range(40)]
    place.assert_nothing_left()


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])
def test_a_failed_step_of_several_points_names_the_point_where_it_began(
    place: Place, faulty: Path, options: tuple[str, ...]
) -> None:
    slow = {"fmu": str(faulty), "start_values": {"fail_at": 0.022}, "step_size": 0.01}
    config = write_config(
        place.folder, instances={"slow": slow, "gain": {"fmu": "Gain"}}, connections=["slow.y -> gain.u"]
    )

    launched = place.run("launch", config, *options)

    assert launched.wait() == 3
    assert launched.message.startswith("fmu-mesh: instance slow, point 20, t = 0.02 s: fmi2DoStep returned error; ")


GEARS = """
import fmu_mesh

class Gears(fmu_mesh.Component):
    gear = fmu_mesh.Output(type="Enumeration", items={"low": 1, "many": 300})
    first = fmu_mesh.Parameter(1)

    def initialize(self):
        self.gear = self.first

    def step(self, time, step_size):
        self.gear = 1 if time < 0.0025 else 300

class Clutch(fmu_mesh.Component):
    int8_in = fmu_mesh.Input(type="Int8")
    int8_out = fmu_mesh.Output(type="Int8")

    def step(self, time, step_size):
        self.int8_out = self.int8_in
"""


@pytest.mark.parametrize("clutch", ["FMU", "component"])
@pytest.mark.parametrize("first", [1, 300], ids=["at a point", "at the start"])
@pytest.mark.parametrize("way", ["in C", "in Python", "local"])
def test_a_number_beyond_type_of_its_input_ends_run_with_both_ends(
    place: Place, tmp_path: Path, clutch: str, first: int, way: str
) -> None:
    """A model puts out an Enumeration that is none of its items, and an Int8 can be each of these."""
    (place.folder / "gears.py").write_text(GEARS)
    config = write_config(
        place.folder,
        instances={
            "gears": {"python": "gears.py:Gears", "start_values": {"first": first}},
            "through": {"fmu": str(find_fmu("AllTypes", tmp_path))},
            "clutch": {"fmu": str(find_fmu("AllTypes3", tmp_path))},
        },
        connections=["gears.gear -> through.enumeration_in", "through.enumeration_out -> clutch.int8_in"],
        stop_time=0.01,
        record={"file": "pair.csv", "variables": ["clutch.int8_out"]},
    )
    text = config.read_text()
    if clutch == "component":
        text = text.replace(f"fmu: {find_fmu('AllTypes3', tmp_path)}", "python: gears.py:Clutch")
    config.write_text(text)
    if way == "in Python":
        place.environment[LIBRARY_VARIABLE] = "none"

    launched = place.run("launch", config, *(["--local"] if way == "local" else []))

    assert launched.wait() == 3
    where = "instance clutch.int8_in" + (", point 3, t = 0.003 s" if first == 1 else "")
    assert launched.message.startswith(
        f"fmu-mesh: {where}: 'through.enumeration_out' is 300, which is out of the range of Int8. "
        "Its model declares no such item."
    )
    if first == 1:
        assert len(rows_of(config.with_suffix(".csv"))) == 4
    place.assert_nothing_left()


FATAL_IN = {
    "fmi1 initialize": (1, "model_exchange", "fmiInitialize"),
    "fmi1 derivatives": (1, "model_exchange", "fmiGetDerivatives"),
    "fmi2 exit": (2, "co_simulation", "fmi2ExitInitializationMode"),
    "fmi2 step": (2, "co_simulation", "fmi2DoStep"),
    "fmi2 derivatives": (2, "model_exchange", "fmi2GetDerivatives"),
    "fmi2 terminate": (2, "co_simulation", "fmi2Terminate"),
    "fmi3 exit": (3, "co_simulation", "fmi3ExitInitializationMode"),
    "fmi3 step": (3, "co_simulation", "fmi3DoStep"),
    "fmi3 derivatives": (3, "model_exchange", "fmi3GetContinuousStateDerivatives"),
}


@pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
@pytest.mark.parametrize(("version", "kind", "function"), FATAL_IN.values(), ids=FATAL_IN)
def test_after_fatal_no_function_of_an_instance_is_called(
    place: Place, version: Literal[1, 2, 3], kind: str, function: str
) -> None:
    """This FMU aborts at a call that its state forbids, and after fatal it has none, so that all are forbidden."""
    name = f"fmi{version}.c"
    source = (event_fmus.SOURCES / name).read_text(encoding="utf-8")
    head, body = re.split(rf"(?<=\n)(?=fmi\dStatus (?:EXPORT\()?{function}\b)", source)
    body = body.replace("{\n", "{\n    ((Instance *)" + f"c)->mode = 0;\n    return fmi{version}Fatal;\n", 1)
    fmu = place.folder / "ball.fmu"
    event_fmus.event_source_fmu("Ball", version, fmu, add={f"sources/{name}": head + body})
    config = write_config(
        place.folder, instances={"ball": {"fmu": str(fmu), "kind": kind}}, connections=[], stop_time=0.01
    )

    launched = place.run("launch", config, "--local")

    assert launched.wait() == (0 if function == "fmi2Terminate" else 3)
    assert "ended its process" not in launched.errors
    assert (f"{function} returned fatal" in launched.errors) is (function != "fmi2Terminate")


def test_an_error_message_right_before_a_crash_is_shown(place: Place) -> None:
    logs = 'instance->logger(instance->environment, instance->name, fmi2Error, "a", "the pump is dry");'
    once = f'if (strcmp(function, "fmi2DoStep") == 0 && instance->model.time > 0.5) {{ {logs} abort(); }}'
    config = write_config(
        place.folder,
        instances={"pump": {"fmu": str(chatty_fmu(2, place.folder, "co_simulation", once))}},
        connections=[],
        stop_time=1.0,
    )

    launched = place.run("launch", config)

    assert launched.wait() == 4
    assert "pump at point 501: the pump is dry" in launched.errors
    assert "its process was ended by SIGABRT" in launched.errors
