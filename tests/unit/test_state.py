"""States through all that is around an instance: deadlines, linear inputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Literal, cast

import pytest

from fmu_mesh.config.mesh import TimeoutsConfig
from fmu_mesh.errors import FmuError, FmuMeshError, TerminationRequested
from fmu_mesh.instances.call_guard import CallWatch, Guarded
from fmu_mesh.instances.contract import Instance
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.co_simulation.fmi2 import Fmi2Instance
from fmu_mesh.instances.fmi.fmu_instance import Bookkeeping, FmuInstance
from fmu_mesh.instances.fmi.opening import open_instance, stepped
from fmu_mesh.instances.fmi.step_options import SolverSettings, StepOptions
from fmu_mesh.instances.instance_wrapper import AroundInstance, packed, unpacked
from fmu_mesh.node.inputs import TimedInputs
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.coupling_rule import CouplingRule
from fmu_mesh.system.layout import Layout
from fmu_mesh.system.linear_inputs import LinearInput
from fmu_mesh.variables.model_description import Kind
from fmu_mesh.variables.value_types import Value
from tests.fmus.event_fmus import Version
from tests.helpers import DEADLINE_S, FMUS

EventFmu = Callable[..., Path]
Rows = list[tuple[Value, ...]]

MODELS: list[tuple[str, Version, Kind, str]] = [
    ("Integral", 2, "co_simulation", "u"),
    ("Integral", 2, "model_exchange", "u"),
    ("Integral", 3, "model_exchange", "u"),
    ("Stairs", 3, "co_simulation", "increment"),
    ("Stairs", 2, "model_exchange", "increment"),
]


class Overrun(Exception):
    """A call had no deadline, or a wrong one."""


def no_overrun(error: FmuError) -> None:
    raise Overrun(str(error))


class Stepped:
    """A guarded FMU at its first point, with inputs that no ring has: they are set before the step of their time."""

    def __init__(self, fmu: Path, folder: Path, kind: Kind, watch: CallWatch, start_values: dict[str, Value]) -> None:
        self.later: dict[int, dict[str, Value]] = {}
        self.watch = watch
        description = read_description(fmu, kind=kind)
        self.outputs = Ring(Layout.of(description.with_causality("output")), 64)

        timeouts = TimeoutsConfig(call=DEADLINE_S, step=DEADLINE_S)
        self.instance = Guarded("m", lambda: open_instance(fmu, "m", description, folder), watch, timeouts)
        self.instance.enter_initialization(0.0, 100.0, start_values)
        self.instance.exit_initialization()
        self.instance.bind(Ring(Layout.of([]), 64), (self.outputs,), TimeGrid(0.0, 0.1, 400), 1)

    def rows(self, first: int, end: int) -> Rows:
        """Take own steps ``first .. end - 1``; the outputs after each of them."""
        found: Rows = []
        for step in range(first, end):
            if step in self.later:
                self.instance.set_values(self.later[step])
            self.instance.do_step(step)
            found.append(tuple(self.outputs.value(step + 1, name) for name in self.outputs.layout.names))
        return found

    def set(self, name: str, value: int, step: int) -> None:
        self.later[step] = {name: float(value) if name == "u" else value}


@contextmanager
def stepped_fmu(fmu: Path, folder: Path, kind: Kind, **start_values: Value) -> Iterator[Stepped]:
    with closing(CallWatch(no_overrun)) as watch:
        made = Stepped(fmu, folder, kind, watch, start_values)
        with closing(made.instance):
            yield made


@pytest.mark.parametrize(("model", "version", "kind", "name"), MODELS)
def test_a_guarded_instance_goes_back_to_its_state(
    model: str, version: Version, kind: Kind, name: str, event_fmu: EventFmu, tmp_path: Path
) -> None:
    with stepped_fmu(event_fmu(model, version), tmp_path, kind) as one:
        one.set(name, 2, 4)
        one.set(name, 5, 10)
        one.rows(0, 5)
        state = one.instance.get_state()
        there = one.rows(5, 20)
        one.set(name, 7, 20)  # after the state: the state knows nothing of it
        one.rows(20, 22)

        one.instance.set_state(state)

        assert one.rows(5, 20) == there
        assert len(set(there)) > 1
        one.instance.free_state(state)


@pytest.mark.parametrize(("model", "version", "kind", "name"), MODELS)
def test_another_guarded_instance_goes_on_from_a_serialized_state(
    model: str, version: Version, kind: Kind, name: str, event_fmu: EventFmu, tmp_path: Path
) -> None:
    fmu = event_fmu(model, version)
    with stepped_fmu(fmu, tmp_path, kind) as one:
        one.set(name, 2, 4)
        one.set(name, 5, 10)
        one.rows(0, 5)
        state = one.instance.get_state()
        data = one.instance.serialize_state(state)
        one.instance.free_state(state)
        there = one.rows(5, 20)

    with stepped_fmu(fmu, tmp_path, kind) as other:
        other.set(name, 5, 10)
        state = other.instance.deserialize_state(data)
        other.instance.set_state(state)

        assert other.rows(5, 20) == there
        other.instance.free_state(state)


def test_an_fmu_of_fmi_1_without_a_state_is_refused_by_name(event_fmu: EventFmu, tmp_path: Path) -> None:
    with (
        stepped_fmu(event_fmu("Ball", 1), tmp_path, "model_exchange") as one,
        pytest.raises(FmuError, match="cannot get and set its state, as its model description says") as raised,
    ):
        one.instance.get_state()

    assert raised.value.instance == "m"


@pytest.mark.parametrize("version", [2, 3])
def test_a_model_that_asked_to_end_is_not_stepped_after_its_state(
    version: Version, event_fmu: EventFmu, tmp_path: Path
) -> None:
    with stepped_fmu(event_fmu("Stairs", version), tmp_path, "model_exchange", end=2) as one:
        with pytest.raises(TerminationRequested):
            one.rows(0, 40)
        one.instance.free_state(one.instance.get_state())

        with pytest.raises(TerminationRequested):
            one.rows(40, 41)


def test_what_is_no_state_is_refused(event_fmu: EventFmu, tmp_path: Path) -> None:
    with stepped_fmu(event_fmu("Integral", 2), tmp_path, "co_simulation") as one:
        with pytest.raises(TypeError, match="str is no state of this instance"):
            one.instance.set_state("no state")
        with pytest.raises(FmuMeshError, match="this is no state of an instance"):
            one.instance.deserialize_state(b"no state")


def test_values_of_keys_have_no_past_so_there_is_no_state(tmp_path: Path) -> None:
    path = FMUS / "Gain.fmu"
    timed = TimedInputs(Fmi2Instance(path, "gain", read_description(path), tmp_path), "hold", keys={"u": False})

    with pytest.raises(FmuError, match="keys of Zenoh give values to u, and these have no past"):
        timed.get_state()
    timed.close()


def test_a_kind_of_instance_without_states_says_so() -> None:
    class Stateless:
        name = "plant"

    around = AroundInstance(cast("Instance", Stateless()))

    with pytest.raises(FmuError, match="its state cannot be kept") as raised:
        around.get_state()

    assert raised.value.instance == "plant"


def test_a_call_about_a_state_has_a_deadline() -> None:
    found: list[FmuError] = []
    watch = CallWatch(found.append)

    class Slow:
        def __getattr__(self, name: str) -> Callable[..., object]:
            def wait(*_arguments: object) -> object:
                while not found:  # the watch ends it, or the timeout of the test
                    pass
                return None

            return wait if name == "get_state" else lambda *_arguments: None

    with closing(watch):
        guarded = Guarded("plant", lambda: cast("Instance", Slow()), watch, TimeoutsConfig(call=0.05, step=0.05))
        guarded.bind(Ring(Layout.of([]), 1), (), TimeGrid(0.0, 0.1, 1), 1)

        guarded.get_state()

    assert [error.instance for error in found] == ["plant"]
    assert found[0].hint is not None
    assert "`timeouts.step`" in found[0].hint


@pytest.mark.parametrize("row", [(b"\x00\xff",), (["text", ""],), ([b"\x00", b"bytes"],)])
def test_the_inputs_of_the_last_event_come_back_as_they_were(row: tuple[Any, ...]) -> None:
    kept = Bookkeeping(3, 0.1, row=row, ticks=(None, 2.0))

    assert unpacked(packed(kept, b"of the FMU"), Bookkeeping, "m") == (kept, b"of the FMU")


def linear(fmu: Path, folder: Path, ring: Ring, solver: Literal["cvode", "dopri5"]) -> tuple[FmuInstance, Any]:
    options = StepOptions(linear_inputs=(LinearInput("u", CouplingRule(1, 1, 1)),), solver=SolverSettings(solver))
    inner = open_instance(fmu, "m", read_description(fmu, kind="model_exchange"), folder, options=options)
    instance: Any = stepped(inner, options)
    instance.enter_initialization(0.0, 10.0, {})
    instance.exit_initialization()
    outputs = Ring(Layout.of(inner.description.with_causality("output")), 32)
    instance.bind(ring, (outputs,), TimeGrid(0.0, 0.1, 100), 1)
    return inner, instance


@pytest.mark.parametrize("model", ["Integral", "Oscillator", "Ball"])
@pytest.mark.parametrize("solver", ["cvode", "dopri5"])
def test_a_line_that_began_after_a_state_is_forgotten_with_it(
    solver: Literal["cvode", "dopri5"], model: str, event_fmu: EventFmu, tmp_path: Path
) -> None:
    fmu = event_fmu(model, 2)
    ring = Ring(Layout.of(read_description(fmu).with_causality("input")), 32)
    for row in range(32):
        ring.put(row, "u", 1.0 if row < 8 else math.sin(row))
    inner, instance = linear(fmu, tmp_path, ring, solver)
    names = [variable.name for variable in inner.description.variables]

    def values(first: int, end: int) -> list[list[Value]]:
        found = []
        for step in range(first, end):
            instance.do_step(step)
            found.append(inner.get_values(names))
        return found

    with closing(inner):
        values(0, 5)
        state = instance.get_state()
        there = values(5, 20)

        instance.set_state(state)

        assert values(5, 20) == there
        instance.free_state(state)
