"""Any mesh of FMUs gives, as a package of SSP and back, the same plan and a result file of the same bytes."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

import fmu_mesh
from fmu_mesh.config.base import NAME_PATTERN
from fmu_mesh.ssp.system_reading import read_system
from fmu_mesh.system.plan import Plan
from fmu_mesh.variables.units import Linear
from tests.fmus.helpers import find_fmu
from tests.helpers import FMUS, examples
from tests.ssp.unit_fmus import with_units

H = 0.125

INPUTS = {
    "Gain": ("u",),
    "Adder": ("u1", "u2"),
    "Integrator": ("u",),
    "TransportDelay": ("x",),
    "Degrees": ("u",),
    "Radians": ("u",),
    "AllTypes": ("real_in", "integer_in", "boolean_in", "enumeration_in"),
}
"""The inputs of each FMU."""

OUTPUTS = {"AllTypes": ("real_out", "integer_out", "boolean_out", "enumeration_out")}
"""The outputs of the FMUs that have another one than `y`."""

PARAMETERS = {"Gain": "k", "Integrator": "k", "TransportDelay": "d", "Degrees": "k", "AllTypes": "real_parameter"}

_KINDS = {"integer": "Integer", "boolean": "Boolean", "enumeration": "Enumeration"}
_VALUES = {
    "Integer": st.integers(-3, 3),
    "Boolean": st.booleans(),
    "Enumeration": st.sampled_from(["low", "middle", "high"]),
}

numbers = st.one_of(st.sampled_from([0.0, -0.0, 1.0, 5e-324, 1.7976931348623157e308, 0.1, -1e-5]), st.floats(-1e3, 1e3))
names = st.one_of(
    st.from_regex(NAME_PATTERN, fullmatch=True),
    st.sampled_from(
        ["a-b", "a-45-b", "a--b", "_-49-x", "_-x", "DP-32-C", "a-0-b", "a-1114112-b", "x-", "_", "M-E-S-H"]
    ),
).filter(lambda name: name != "mesh" and name == name.strip() and len(name) < 30)


def type_of(variable: str) -> str:
    return _KINDS.get(variable.partition("_")[0], "Real")


@st.composite
def maps(draw: st.DrawFn, kind: str) -> dict[str, Any]:
    """The entries of a `map`; other values stay as they are."""
    entries = draw(st.dictionaries(_VALUES[kind], _VALUES[kind], max_size=3))
    words = {True: "true", False: "false"}
    return {words[have] if isinstance(have, bool) else str(have): want for have, want in entries.items()}


@st.composite
def sections(draw: st.DrawFn, fmu: str) -> dict[str, Any]:
    """The section of one instance, with the name of its FMU."""
    section: dict[str, Any] = {"fmu": fmu}
    starts: dict[str, Any] = {}
    if fmu in PARAMETERS and draw(st.booleans()):
        starts[PARAMETERS[fmu]] = abs(draw(numbers)) if fmu == "TransportDelay" else draw(numbers)
    for variable in INPUTS[fmu]:
        if draw(st.integers(0, 3)) == 0:
            starts[variable] = draw(_VALUES.get(type_of(variable), numbers))
    if fmu == "AllTypes" and draw(st.booleans()):
        alphabet = st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"], exclude_characters="\ufffe\uffff")
        starts["string_in"] = draw(st.text(alphabet | st.sampled_from("\t\n\r <>&\"'"), max_size=8))
    if starts:
        section["start_values"] = starts
    optional = {
        "step_size": st.sampled_from([H, 2 * H, 3 * H]),
        "group": st.sampled_from(["g1", "g2"]),
        "kind": st.just("co_simulation"),
        "strict": st.booleans(),
        "interpolation": st.sampled_from(["hold", "linear"]),
    }
    return section | {key: draw(values) for key, values in optional.items() if draw(st.integers(0, 3)) == 0}


@st.composite
def meshes(draw: st.DrawFn) -> dict[str, Any]:
    """The values of a configuration with the names of FMUs as their paths."""
    own = draw(st.lists(names, min_size=1, max_size=5, unique=True))
    instances = {name: draw(sections(draw(st.sampled_from(sorted(INPUTS))))) for name in own}
    ends = [(name, variable) for name in own for variable in INPUTS[instances[name]["fmu"]]]
    connections: list[Any] = []
    for name, variable in draw(st.permutations(ends)):
        source = draw(st.sampled_from(own))
        outputs = OUTPUTS.get(instances[source]["fmu"], ("y",))
        kind = type_of(variable)
        fitting = [output for output in outputs if type_of(output) == kind]
        if not fitting or draw(st.booleans()):
            continue
        connection: dict[str, Any] = {"from": f"{source}.{fitting[0]}", "to": f"{name}.{variable}"}
        if kind == "Real":
            optional: Mapping[str, Any] = {"factor": numbers, "offset": numbers, "ignore_units": st.booleans()}
            connection |= {key: draw(values) for key, values in optional.items() if draw(st.booleans())}
        elif draw(st.booleans()):
            connection["map"] = draw(maps(kind))
        if draw(st.booleans()):
            connection["delay"] = 1
        short = f"{connection['from']} -> {connection['to']}"
        connections.append(short if len(connection) == 2 and draw(st.booleans()) else connection)
    simulation: dict[str, Any] = {"step_size": H, "stop_time": draw(st.sampled_from([6, 1.5, 3.0]))}
    if draw(st.booleans()):
        simulation["algorithm"] = draw(st.sampled_from(["jacobi", "gauss_seidel"]))
    if draw(st.booleans()):
        simulation |= {"start_time": -3.0, "window": draw(st.sampled_from(["auto", 1, 7]))}
    more: dict[str, Any] = {
        "group": st.sampled_from([None, "auto"]),
        "record": st.sampled_from([{"every": 3}, {"variables": ["*"]}, [{"file": "a.csv"}, {"file": "b/c.csv"}], []]),
        "initialization": st.just({"iterations": 20, "relaxation": 0.5}),
        "timeouts": st.just({"step": 30}),
    }
    return {
        "mesh": draw(names),
        "simulation": simulation,
        "instances": instances,
        "connections": connections,
        **{key: draw(values) for key, values in more.items() if draw(st.booleans())},
    }


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("fmus")
    made = {
        "AllTypes": find_fmu("AllTypes", folder),
        "Degrees": with_units(folder, "Degrees", "deg", 'rad="1" factor="0.017453292519943295"'),
        "Radians": with_units(folder, "Radians", "rad", 'rad="1"'),
    }
    return {name: made.get(name, FMUS / f"{name}.fmu") for name in INPUTS}


@given(drawn=meshes(), version=st.sampled_from(["1.0", "2.0", None]))
@settings(max_examples=examples(150), suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
def test_a_mesh_and_its_package_are_one_system(
    fmus: dict[str, Path], drawn: dict[str, Any], version: Literal["1.0", "2.0"] | None
) -> None:
    with tempfile.TemporaryDirectory() as created:
        folder = Path(created)
        for section in drawn["instances"].values():
            section["fmu"] = str(fmus[section["fmu"]])
        mesh = fmu_mesh.Mesh("empty", step_size=1.0, stop_time=1.0)
        plain = mesh.configuration._replace(data=drawn, file=folder / "mesh.yaml")
        mesh = fmu_mesh.Mesh.from_configuration(plain)
        expected = outcome_of(mesh, folder / "first.csv")
        if isinstance(expected, fmu_mesh.ConfigurationError):
            event("no valid mesh")
            with pytest.raises(fmu_mesh.ConfigurationError):
                mesh.to_ssp(folder / "system.ssp", version=version)
            assert not (folder / "system.ssp").exists()
            return

        mesh.to_ssp(folder / "system.ssp", version=version)
        read = read_system(folder / "system.ssp")
        same = fmu_mesh.Mesh.from_configuration(read)

        assert not read.findings
        assert content_of(same.plan().plan) == content_of(mesh.plan().plan)
        assert outcome_of(same, folder / "second.csv") == expected
        same.to_ssp(folder / "again.ssp")
        assert (folder / "again.ssp").read_bytes() == (folder / "system.ssp").read_bytes()
        event("a run that failed" if isinstance(expected, str) else "a run")


def outcome_of(mesh: fmu_mesh.Mesh, file: Path) -> bytes | str | fmu_mesh.ConfigurationError:
    """The result file; the message of the error that ended the run; or the error that prevented it."""
    try:
        mesh.run(output=str(file), processes=False)
    except fmu_mesh.ConfigurationError as error:
        return error
    except fmu_mesh.FmuMeshError as error:
        return str(error).replace(file.name, "result.csv")
    return file.read_bytes()


def content_of(plan: Plan) -> list[object]:
    """A plan without the paths of its FMUs, and without what only describes its connections."""
    instances = [
        (
            one.name,
            one.description,
            repr(one.start_values),
            one.step_points,
            one.node,
            plan.system.config.is_strict(plan.system.config.instances[one.name]),
            plan.system.config.instances[one.name].interpolation,
        )
        for one in plan.system.instances.values()
    ]
    connections = [
        (str(one), repr(Linear() if (own := Linear(one.factor, one.offset)).identity else own), one.map, one.delay)
        for one in plan.connections
    ]
    records = plan.system.records
    config = plan.system.config
    return [
        config.mesh,
        plan.grid,
        instances,
        connections,
        records,
        plan.initialization,
        plan.window,
        [config.group, config.initialization, config.timeouts],
    ]
