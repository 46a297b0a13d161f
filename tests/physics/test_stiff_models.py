"""The solver `auto`: `dopri5` where a model is not stiff, CVode from where it turns out to be, decided by its steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest

import fmu_mesh
from fmu_mesh.errors import FmuError, StepFailed
from fmu_mesh.instances.contract import LogMessage
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.fmu_instance import FmuInstance
from fmu_mesh.instances.fmi.opening import open_instance
from fmu_mesh.instances.fmi.step_options import SolverName, SolverSettings, StepOptions
from fmu_mesh.rings import native
from fmu_mesh.rings.library import LIBRARY_VARIABLE
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.layout import Layout
from fmu_mesh.system.run_metadata import metadata_of
from fmu_mesh.variables.value_types import Value
from tests.fmus.chatty_fmus import chatty_fmu
from tests.fmus.event_fmus import Version
from tests.helpers import write_config
from tests.planning import plan_run

pytestmark = pytest.mark.skipif(native.library is None, reason="the library with the solver is not built here")

EventFmu = Callable[..., Path]
STEPS = 60
STIFF: Mapping[str, Mapping[str, Value]] = {
    "from the start": {},
    "from 3.05 s on": {"late": 3.05},
    "as it moves": {"mu": 100.0, "x": 0.1},  # along its limit cycle, but not at first
}


class Model(NamedTuple):
    """An instance at work, with rings of one row."""

    instance: FmuInstance
    outputs: Ring
    messages: list[LogMessage]

    def steps(self, first: int, last: int) -> list[bytes]:
        """The rows of these steps."""
        found = []
        for step in range(first, last):
            self.instance.do_step(step)
            found.append(b"".join(part.tobytes() for part in self.outputs.parts))
        return found

    def told(self) -> list[tuple[int, str]]:
        """The steps in which the solver said something, and what."""
        return [(one.step, one.message) for one in self.messages if one.category == "solver"]


@contextmanager
def model(
    fmu: Path,
    folder: Path,
    start_values: Mapping[str, Value],
    solver: SolverName = "auto",
    tolerance: float = 1e-6,
    step_size: float = 0.1,
) -> Iterator[Model]:
    description, messages = read_description(fmu, kind="model_exchange"), list[LogMessage]()
    options = StepOptions(SolverSettings(solver, tolerance))
    with closing(open_instance(fmu, "m", description, folder, messages.append, options=options)) as instance:
        instance.enter_initialization(0.0, None, start_values)
        instance.exit_initialization()
        inputs, outputs = (Ring(Layout.of(description.with_causality(one)), 1) for one in ("input", "output"))
        instance.bind(inputs, (outputs,), TimeGrid(0.0, step_size, 1000), 1)
        yield Model(instance, outputs, messages)


def stiff_model(event_fmu: EventFmu, case: str, version: Version) -> tuple[Path, float]:
    """The FMU of a case, and its step size in s."""
    name, step_size = ("Oscillator", 1.0) if case == "as it moves" else ("Heater", 0.1)
    return event_fmu(name, version), step_size


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize("name", ["Oscillator", "Ball", "Stairs", "Integral", "Winding"])
def test_a_model_that_is_not_stiff_has_the_floats_of_dopri5(
    name: str, version: Version, event_fmu: EventFmu, tmp_path: Path
) -> None:
    rows, told = [], []
    for solver in ("auto", "dopri5"):
        with model(event_fmu(name, version), tmp_path / solver, {}, solver, step_size=0.01) as own:
            rows.append(own.steps(0, 200))
            told += own.told()

    assert rows[0] == rows[1]
    assert told == []


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize("case", STIFF)
def test_a_model_that_turns_out_to_be_stiff_goes_on_with_cvode(
    case: str, version: Version, event_fmu: EventFmu, tmp_path: Path
) -> None:
    fmu, step_size = stiff_model(event_fmu, case, version)
    with model(fmu, tmp_path / "a", STIFF[case], step_size=step_size) as own:
        own.steps(0, STEPS)
        [(step, message)] = own.told()
        first = own.instance.get_values([v.name for v in own.instance.description.with_causality("output")])
        completed = own.instance.get_values(["completed_steps"])
    with model(fmu, tmp_path / "b", STIFF[case], "dopri5", step_size=step_size) as own:
        own.steps(0, STEPS)
        others = own.instance.get_values(["completed_steps"])
    with model(fmu, tmp_path / "c", STIFF[case], "cvode", 1e-10, step_size) as own:
        own.steps(0, STEPS)
        exact = own.instance.get_values([v.name for v in own.instance.description.with_causality("output")])

    assert step == {"from the start": 0, "from 3.05 s on": 30, "as it moves": 0}[case]
    assert message.startswith("the model is stiff: dopri5 needs steps of ")
    assert message.endswith(" s to stay stable. cvode goes on from here")
    assert first == pytest.approx(exact, rel=1e-3, abs=1e-4)  # a tolerance of 1e-6 for each of some hundred steps
    assert 10 * completed[0] < others[0] or case == "as it moves"  # type: ignore[operator]  # integers


@pytest.mark.parametrize("way", ["processes", "a group", "one process", "zenoh"])
def test_metadata_say_at_which_point_a_model_was_stiff(event_fmu: EventFmu, tmp_path: Path, way: str) -> None:
    mesh = fmu_mesh.Mesh("heaters", step_size=0.1, stop_time=6.0)
    heater, group = str(event_fmu("Heater", 2)), "both" if way == "a group" else None
    mesh.add("early", fmu=heater, kind="model_exchange", group=group)
    mesh.add("late", fmu=heater, kind="model_exchange", start_values={"late": 3.05}, step_size=0.2, group=group)
    mesh.add("calm", fmu=str(event_fmu("Winding", 2)), kind="model_exchange")
    if way == "zenoh":
        mesh.configure(zenoh={"shared_memory": False, "row_streams": False})
    file = tmp_path / "heaters.csv"
    mesh.run(output=file, processes=way != "one process")
    found = fmu_mesh.Result.read(file).metadata["stiff"]
    assert {name: own["point"] for name, own in found.items()} == {"early": 0, "late": 30}
    assert all(own["message"].endswith("cvode goes on from here") for own in found.values())


@pytest.mark.parametrize("processes", [True, False])
def test_what_an_fmu_calls_its_solver_makes_it_not_stiff(tmp_path: Path, *, processes: bool) -> None:
    logs = 'instance->logger(instance->environment, instance->name, fmi2Warning, "solver", "slow");'
    once = f'if (strcmp(function, "fmi2DoStep") == 0) {{ {logs} }}'
    mesh = fmu_mesh.Mesh("own", step_size=0.1, stop_time=1.0)
    mesh.add("stairs", fmu=str(chatty_fmu(2, tmp_path, "co_simulation", once)))
    mesh.run(output=tmp_path / "own.csv", processes=processes)
    assert "stiff" not in fmu_mesh.Result.read(tmp_path / "own.csv").metadata


@pytest.mark.parametrize(("step_size", "leaves"), [(0.01, False), (0.1, True)])
def test_a_few_short_steps_between_two_points_are_no_reason(
    step_size: float, *, leaves: bool, event_fmu: EventFmu, tmp_path: Path
) -> None:
    """With a time constant of 1 ms, steps are 3 ms long. CVode, which begins anew at each point, takes as many."""
    with model(event_fmu("Winding", 2), tmp_path, {"L": 1e-3, "w": 1.0}, step_size=step_size) as own:
        for step in range(100):
            own.instance.set_values({"U": 0.1 * step})
            own.steps(step, step + 1)

        assert bool(own.told()) == leaves


def test_steps_that_get_too_short_are_left_to_cvode(event_fmu: EventFmu, tmp_path: Path) -> None:
    """At 1e6 s, times differ by 1e-10 s, and the time constant is 1e-12 s; the current is almost where it goes."""
    fmu, found = event_fmu("Winding", 2), {}
    for solver in ("auto", "dopri5"):
        options = StepOptions(SolverSettings(solver))
        description = read_description(fmu, kind="model_exchange")
        with closing(open_instance(fmu, "m", description, tmp_path / solver, options=options)) as own:
            own.enter_initialization(1e6, None, {"L": 1e-12, "U": 1.0, "I": 1.0 - 1e-9})
            own.exit_initialization()
            try:
                own.advance(1e6, 1.0)
                found[solver] = own.get_values(["I"])
            except StepFailed as error:
                found[solver] = [error.message]

    assert found["auto"] == [pytest.approx(1.0, abs=1e-6)]
    assert "makes no progress" in str(found["dopri5"])


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize(("late", "refused"), [(3.05, 4.0), (5.0, 4.0)], ids=["by CVode", "by dopri5"])
def test_a_failed_evaluation_ends_the_run_with_the_words_of_the_fmu(
    late: float, refused: float, version: Version, event_fmu: EventFmu, tmp_path: Path
) -> None:
    def run(solver: SolverName) -> None:
        values = {"late": late, "refused": refused}
        with model(event_fmu("Heater", version), tmp_path / solver, values, solver) as own:
            own.steps(0, STEPS)

    told = []
    for solver in ("auto", "cvode"):
        with pytest.raises(StepFailed) as caught:
            run(solver)
        told.append(caught.value.message)

    assert told[0] == told[1]
    assert "returned discard" in told[0]


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("case", STIFF)
def test_a_state_knows_which_solver_goes_on_from_it(
    case: str, version: Version, event_fmu: EventFmu, tmp_path: Path
) -> None:
    """From one before the change, the change comes again at its step; from one after it, there is none."""
    fmu, step_size = stiff_model(event_fmu, case, version)
    with model(fmu, tmp_path / "a", STIFF[case], step_size=step_size) as own:
        before = own.instance.get_state()
        early = own.steps(0, 40)
        after = own.instance.get_state()
        late = own.steps(40, STEPS)
        own.instance.set_state(before)
        again = own.steps(0, 40)
        own.instance.set_state(after)
        late_again = own.steps(40, STEPS)
        told = own.told()
        data = own.instance.serialize_state(before)
        with pytest.raises(FmuError, match="CVode solves it, whose history is no state"):
            own.instance.serialize_state(after)
        for state in (before, after):
            own.instance.free_state(state)
    with model(fmu, tmp_path / "b", STIFF[case], step_size=step_size) as own:
        state = own.instance.deserialize_state(data)
        own.instance.set_state(state)
        own.instance.free_state(state)
        found = own.steps(0, 40), own.told()

    assert again == early
    assert late_again == late
    assert found == (early, told[:1])
    assert told == [told[0]] * 2


def test_without_the_library_auto_is_cvode_for_all_who_look(
    event_fmu: EventFmu, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The digest differs, too: hosts with and without the library do not share a run of other floats."""
    models = {"m": {"fmu": str(event_fmu("Oscillator", 2)), "kind": "model_exchange"}, "gain": {"fmu": "Gain"}}
    config = write_config(tmp_path, instances=models, connections=[])
    told, digests = [], []
    for library in ("", "none"):
        monkeypatch.setenv(LIBRARY_VARIABLE, library)
        run = plan_run(config)
        [record] = run.plan.system.records
        told.append(metadata_of(run.loaded, run.plan.system, record).models["m"].computed_by)
        digests.append(run.plan.digest)

    assert told == ["FMI 2.0 model exchange, auto 1e-06", "FMI 2.0 model exchange, cvode 1e-06"]
    assert digests[0] != digests[1]
