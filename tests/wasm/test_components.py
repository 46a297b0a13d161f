"""FMUs whose binary is a component of WebAssembly, after the draft FMI-LS-WASM."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

import fmu_mesh
from tests.fmus.packing import repacked
from tests.wasm.guests import SANDBOX, meshed

KINDS = {"co-simulation": "CoSimulation", "model-exchange": "ModelExchange"}
VALUES: dict[str, Any] = {
    "Float32": 1.25,
    "Float64": -2.5e300,
    "Int8": -128,
    "UInt8": 255,
    "Int16": -32768,
    "UInt16": 65535,
    "Int32": -(2**31),
    "UInt32": 2**32 - 1,
    "Int64": -(2**63),
    "UInt64": 2**64 - 1,
    "Boolean": True,
    "String": "grün",
    "Binary": b"\0\1\0",
}
FAULTS = {"trap": 1, "memory": 2, "error": 3, "endless": 4, "discard": 5}


def component(folder: Path, kind: Literal["co-simulation", "model-exchange"] = "co-simulation") -> Path:
    """The FMU of `component/probe.c`."""
    able = 'modelIdentifier="Probe" canGetAndSetFMUState="true" canSerializeFMUState="true"'
    numbers = [*list(VALUES)[:11], "Clock", "String", "Binary"]
    variables = [
        f'<{type_} name="{name}_{type_}" valueReference="{first + numbers.index(type_)}" causality="{causality}"'
        + (' variability="continuous"' if type_.startswith("Float") else "")
        + ("/>" if causality == "output" or type_ in {"String", "Binary"} else ' start="0"/>')
        for name, causality, first in (("u", "input", 10), ("y", "output", 110))
        for type_ in VALUES
    ]
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="Probe" instantiationToken="probe">
<{KINDS[kind]} {able}{' canHandleVariableCommunicationStepSize="true"' if kind == "co-simulation" else ""}/>
<ModelVariables>
<Float64 name="time" valueReference="0" causality="independent"/>
<Float64 name="x" valueReference="200" causality="output" initial="exact" start="0"/>
<Int32 name="fault" valueReference="201" causality="parameter" variability="tunable" start="0"/>
<Float64 name="slope" valueReference="202" causality="local" derivative="200"/>
{"".join(variables) if kind == "co-simulation" else ""}
</ModelVariables>
<ModelStructure><Output valueReference="200"/>
<ContinuousStateDerivative valueReference="202"/><EventIndicator valueReference="202"/></ModelStructure>
</fmiModelDescription>"""
    if kind == "co-simulation":
        text = text.partition("<ContinuousState")[0] + "</ModelStructure></fmiModelDescription>"
        outputs = "".join(f'<Output valueReference="{110 + numbers.index(type_)}"/>' for type_ in VALUES)
        text = text.replace("</ModelStructure>", f"{outputs}</ModelStructure>")
    own = Path(__file__).parent / "component" / f"{kind}.wasm"
    with zipfile.ZipFile(folder / "Probe.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", text)
        archive.write(own, "binaries/wasm32-wasip2/Probe.wasm")
    return folder / "Probe.fmu"


def test_values_of_each_type_go_in_and_out(tmp_path: Path) -> None:
    with meshed(component(tmp_path)).open() as system:
        for type_, value in VALUES.items():
            system.set(f"one.u_{type_}", value)
        system.step()

        seen = {type_: system.get(f"one.y_{type_}") for type_ in VALUES}

    assert seen == VALUES


@pytest.mark.parametrize("process", [None, SANDBOX])
def test_a_node_gives_the_floats_of_one_process(tmp_path: Path, process: dict[str, Any] | None) -> None:
    mesh = meshed(component(tmp_path), process, start_values={"u_Float64": 0.3})

    alone, apart = (mesh.run(record="memory", processes=processes)["one.x"] for processes in (False, True))

    expected = [0.0]
    for _ in range(10):
        expected.append(expected[-1] + 0.1 * 0.3)
    np.testing.assert_allclose(alone, expected, rtol=1e-12)
    np.testing.assert_array_equal(alone, apart)


def test_a_saved_state_gives_the_same_floats(tmp_path: Path) -> None:
    file = tmp_path / "at.state"
    mesh = meshed(component(tmp_path), start_values={"u_Float64": 0.3})
    with mesh.open() as system:
        system.step(3)
        system.save(file)
        state = system.save()
        system.step(4)
        expected = system.get("one.x")
        system.restore(state)
        system.step(4)
        assert system.get("one.x") == expected

    with mesh.open(state=file) as system:
        system.step(4)
        assert system.get("one.x") == expected


@pytest.mark.parametrize("solver", ["dopri5", "cvode"])
def test_equations_of_a_component_are_solved_with_events(tmp_path: Path, solver: str) -> None:
    mesh = meshed(component(tmp_path, "model-exchange"), solver={"name": solver})

    result = mesh.run(processes=False, record="memory")

    rising = np.minimum(result.times, 1.0 - result.times)
    np.testing.assert_allclose(result["one.x"], rising, atol=1e-6)


@pytest.mark.parametrize(
    ("fault", "words"),
    {
        "trap": "fmi3DoStep was stopped in its sandbox: wasm trap: wasm `unreachable` instruction executed",
        "memory": "no more memory",
        "error": "fmi3DoStep returned error",
        "discard": "fmi3DoStep returned discard",
    }.items(),
)
def test_a_fault_of_a_component_is_an_error(tmp_path: Path, fault: str, words: str) -> None:
    mesh = meshed(component(tmp_path), SANDBOX | {"memory": "64 MiB"}, start_values={"fault": FAULTS[fault]})

    with pytest.raises(fmu_mesh.StepFailed) as caught:
        mesh.run(processes=False, record="memory")

    assert (caught.value.instance, caught.value.point) == ("one", 0)
    assert words in str(caught.value)


def test_a_component_that_does_not_return_ends_its_node(tmp_path: Path) -> None:
    mesh = meshed(component(tmp_path), start_values={"fault": FAULTS["endless"]})
    mesh.configure(timeouts={"step": 2.0})

    with pytest.raises(fmu_mesh.FmuMeshError, match=r"point 0, .*has not returned for 2\.0 s from doStep"):
        mesh.run(record="memory")


def test_what_is_no_component_of_the_draft_is_refused(tmp_path: Path) -> None:
    fmu = repacked(tmp_path / "other.fmu", source=component(tmp_path, "model-exchange"), description=_as_co_simulation)

    with pytest.raises(
        fmu_mesh.LoadFailed, match=r"does not export fmi:fmi3/co-simulation@3\.0\.0, but fmi:fmi3/common"
    ):
        meshed(fmu).run(processes=False, record="memory")


def _as_co_simulation(text: str) -> str:
    return text.replace("ModelExchange", "CoSimulation")
