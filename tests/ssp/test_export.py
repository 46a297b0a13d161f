"""Export to SSP: a package gives the run that its mesh gives, is valid, and other tools read it."""

from __future__ import annotations

import io
import json
import os
import resource
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import fmpy.ssp.simulation
import fmpy.ssp.ssd
import pyssp_standard
import pytest
from lxml import etree

import fmu_mesh
from fmu_mesh.ssp.naming import instance_name
from fmu_mesh.ssp.system_reading import read_system
from tests.equivalence.test_types import written as written_types
from tests.fmus.helpers import find_fmu
from tests.fmus.packing import repacked, unpacked
from tests.helpers import FMUS, Place, write_config
from tests.ssp.unit_fmus import with_units

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
WITH_FMUS_ONLY = ("chain8", "cycle2", "path_filter", "pendulum_delay", "pendulum_ros")
MAIN = "SystemStructure.ssd"
OURS = "io.github.fmu-mesh"

_NAMESPACE = "http://ssp-standard.org/SSP1/SystemStructure"
NAMES = {
    "ssd": f"{_NAMESPACE}Description",
    "ssc": f"{_NAMESPACE}Common",
    "ssv": f"{_NAMESPACE}ParameterValues",
}
RESOURCES = Path(pyssp_standard.__file__).parent / "resources"

Version = Literal["1.0", "2.0"]


def loaded(path: Path, ssd: str | None = None) -> fmu_mesh.Mesh:
    return fmu_mesh.Mesh.from_configuration(read_system(path, ssd))


def files_of(package: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(package) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def description_of(package: Path) -> Any:  # noqa: ANN401  lxml ships no types
    return etree.fromstring(files_of(package)[MAIN])


def annotation_of(package: Path) -> dict[str, Any]:
    (element,) = description_of(package).xpath(f"//ssc:Annotation[@type='{OURS}']/*", namespaces=NAMES)
    content: dict[str, Any] = json.loads(element.text)
    return content


def rows_of(mesh: fmu_mesh.Mesh, file: Path, **options: Any) -> bytes:  # noqa: ANN401  those of a run
    mesh.run(output=str(file), processes=False, **options)
    return file.read_bytes()


def assert_equal(mesh: fmu_mesh.Mesh, other: fmu_mesh.Mesh, folder: Path, **options: Any) -> None:  # noqa: ANN401  those of a run
    """Both meshes have one plan, but for the paths of their files, and give one result file."""
    first, second = mesh.plan(**options).plan, other.plan(**options).plan
    assert other.name == mesh.name
    assert second.grid == first.grid
    assert [*second.system.instances] == [*first.system.instances]
    for name, instance in first.system.instances.items():
        same = second.system.instances[name]
        assert (same.start_values, same.step_points, same.node) == (
            instance.start_values,
            instance.step_points,
            instance.node,
        )
        assert same.scenario == instance.scenario
    assert second.connections == first.connections
    assert second.initialization == first.initialization
    assert [(one.variables, one.first, one.every) for one in second.system.records] == [
        (one.variables, one.first, one.every) for one in first.system.records
    ]
    rows = rows_of(other, folder / "other.csv", **options)
    assert rows == rows_of(mesh, folder / "first.csv", **options)
    assert rows.count(b"\n") > 2


# --- the same run


@pytest.mark.parametrize("version", ["1.0", "2.0"])
@pytest.mark.parametrize("name", WITH_FMUS_ONLY)
def test_a_package_gives_the_run_of_its_mesh(name: str, version: Version, tmp_path: Path) -> None:
    mesh = fmu_mesh.load(CONFIGS / f"{name}.yaml")

    lost = mesh.to_ssp(tmp_path / "system.ssp", version=version)

    assert lost == ()
    assert_equal(mesh, loaded(tmp_path / "system.ssp"), tmp_path, stop_time=0.5)


def test_every_type_of_fmi_is_kept_in_a_package_of_ssp_2(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(written_types(tmp_path))

    mesh.to_ssp(tmp_path / "system.ssp", version="2.0")

    assert_equal(mesh, loaded(tmp_path / "system.ssp"), tmp_path)


def test_what_ssp_cannot_say_is_kept_in_our_annotation(tmp_path: Path) -> None:
    config = write_config(
        tmp_path,
        instances={
            "slow": {"fmu": "Integrator", "step_size": 0.004, "group": "both", "start_values": {"y": 1, "k": -1.0}},
            "fast": {"fmu": "Gain", "group": "both", "interpolation": "linear"},
            "last": {"fmu": "Gain", "host": None, "start_values": {"k": 3}},
        },
        connections=[],
        name="many-keys",
        simulation={"start_time": 0.5, "algorithm": "jacobi", "window": 8, "real_time_factor": 0, "catch_up": None},
        scenario={"values": {"last.u": {"times": [0.6, 0.7], "values": [1, 2.5]}}, "events": []},
        timeouts={"step": 30},
        limits={"entries": 1000},
        initialization={"tolerance": 1e-6},
        zenoh={"key_prefix": "lab"},
    )
    mesh = fmu_mesh.load(config)
    mesh.record(file="a.csv", every=2)
    mesh.record("slow.y", "in:fast.*", file="b.csv", start=0.7, also=True)
    mesh.connect("slow.y", "fast.u", factor=-2.5, offset=1e-3, delay=0)
    mesh.connect("fast.y", "slow.u", delay=1)

    mesh.to_ssp(tmp_path / "system.ssp")
    same = loaded(tmp_path / "system.ssp")

    assert_equal(mesh, same, tmp_path)
    first, second = mesh.plan().loaded.config, same.plan().loaded.config
    for key in ("mesh", "simulation", "group", "initialization", "scenario", "zenoh", "timeouts", "limits", "strict"):
        assert getattr(second, key) == getattr(first, key)
    assert [Path(record.file).name for record in same.plan().plan.system.records] == ["a.csv", "b.csv"]
    assert {Path(record.file).parent for record in same.plan().plan.system.records} == {tmp_path}
    assert second.connections == first.connections


def test_the_algorithm_is_written_even_if_it_is_the_usual_one(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(write_config(tmp_path))

    mesh.to_ssp(tmp_path / "system.ssp")

    assert annotation_of(tmp_path / "system.ssp")["simulation"] == {"algorithm": "gauss_seidel", "step_size": 0.001}
    assert not loaded(tmp_path / "system.ssp").configuration.needed


def test_a_mesh_without_an_end_has_none_in_its_package(tmp_path: Path) -> None:
    mesh = fmu_mesh.Mesh("endless", step_size=0.1, stop_time=None)
    mesh.add("gain", fmu=FMUS / "Gain.fmu")

    mesh.to_ssp(tmp_path / "system.ssp")

    assert "stopTime" not in description_of(tmp_path / "system.ssp")[-1].attrib
    assert loaded(tmp_path / "system.ssp").plan(output="none.csv").plan.system.config.simulation.stop_time is None


def test_a_scenario_in_a_file_of_its_own_goes_into_the_package(tmp_path: Path) -> None:
    (tmp_path / "scenario.yaml").write_text("values: {gain.u: {times: [0, 0.2], values: [1, 2]}}\n", encoding="utf-8")
    mesh = fmu_mesh.load(write_config(tmp_path, instances={"gain": {"fmu": "Gain"}}, connections=[]))
    mesh.scenario(file="scenario.yaml")

    mesh.to_ssp(tmp_path / "system.ssp")
    (tmp_path / "scenario.yaml").rename(tmp_path / "elsewhere.yaml")
    same = loaded(tmp_path / "system.ssp")
    (tmp_path / "elsewhere.yaml").rename(tmp_path / "scenario.yaml")

    assert_equal(mesh, same, tmp_path)


def test_a_package_runs_in_processes_as_its_mesh_does(place: Place) -> None:
    config = write_config(place.folder)
    mesh = fmu_mesh.load(config)
    mesh.to_ssp(place.folder / "system.ssp")

    mesh.run(output=str(place.folder / "first.csv"))
    loaded(place.folder / "system.ssp").run(output=str(place.folder / "second.csv"))

    assert (place.folder / "second.csv").read_bytes() == (place.folder / "first.csv").read_bytes()


# --- units, enumerations, maps


def test_units_are_defined_and_converted_as_before(tmp_path: Path) -> None:
    mesh = fmu_mesh.Mesh("units", step_size=0.1, stop_time=1.0)
    mesh.add("degrees", fmu=with_units(tmp_path, "Degrees", "deg", 'rad="1" factor="0.017453292519943295"'))
    mesh.add("radians", fmu=with_units(tmp_path, "Radians", "rad", 'rad="1"'))
    mesh.add("other", fmu=with_units(tmp_path, "Other", "deg", 'K="1"'))  # another unit of the same name
    mesh.add("bare", fmu=FMUS / "Gain.fmu")
    mesh.scenario({"degrees.u": {"times": [0, 1], "values": [10, 20], "interpolation": "linear"}})
    mesh.connect("degrees.y", "radians.u", factor=3.0, offset=0.25)
    mesh.connect("radians.y", "other.u", ignore_units=True)
    mesh.connect("other.y", "bare.u")

    mesh.to_ssp(tmp_path / "system.ssp")

    root = description_of(tmp_path / "system.ssp")
    units = {unit.get("name"): dict(unit[0].attrib) for unit in root.xpath("ssd:Units/ssc:Unit", namespaces=NAMES)}
    assert units == {"deg": {"rad": "1", "factor": "0.017453292519943295"}, "rad": {"rad": "1"}}
    same = loaded(tmp_path / "system.ssp")
    assert not same.configuration.warnings
    assert_equal(mesh, same, tmp_path)
    assert [one.get("ignore_units") for one in same.configuration.data["connections"]] == [None, True, None]  # type: ignore[index, call-overload, union-attr]  # a mapping with a list


def test_enumerations_and_maps_are_kept(tmp_path: Path) -> None:
    fmu = find_fmu("AllTypes", tmp_path)
    mesh = fmu_mesh.Mesh("maps", step_size=0.1, stop_time=1.0)
    text = 'a "b" <c>\n\té'
    starts = {"enumeration_in": "high", "boolean_in": True, "integer_in": -7, "string_in": text, "real_in": 3}
    mesh.add("first", fmu=fmu, start_values=starts)
    mesh.add("second", fmu=fmu, start_values={"enumeration_in": 2, "string_in": ""})
    mesh.connect("first.enumeration_out", "second.enumeration_in", map={"high": "low", "low": "middle"})
    mesh.connect("first.boolean_out", "second.boolean_in", map={"true": False})
    mesh.connect("first.integer_out", "second.integer_in", map={"-7": 12, "0": 3})
    mesh.record("first.*_out", "second.*_out", "in:second.*", file=str(tmp_path / "all.csv"))

    mesh.to_ssp(tmp_path / "system.ssp")

    same = loaded(tmp_path / "system.ssp")
    assert not same.configuration.warnings
    assert_equal(mesh, same, tmp_path)


def test_a_map_between_boolean_and_numbers_is_refused(tmp_path: Path) -> None:
    fmu = find_fmu("AllTypes", tmp_path)
    mesh = fmu_mesh.Mesh("maps", step_size=0.1, stop_time=1.0)
    mesh.add("first", fmu=fmu)
    mesh.connect("first.boolean_out", "first.integer_in", map={"true": 5})

    with pytest.raises(fmu_mesh.ConfigurationError, match=r"connections\[0\]\.map: a map from Boolean to Integer"):
        mesh.to_ssp(tmp_path / "system.ssp")


# --- names


@pytest.mark.parametrize(
    ("name", "element"),
    [
        ("gain", "gain"),
        ("DP-32-Controller", "DP Controller"),
        ("my-gain", "my-gain"),
        ("left-motor-2", "left-motor-2"),
        ("_-50-nd", "2nd"),
        ("x--y", "x--y"),
        ("end-", "end-"),
        ("a-99999999999999999999-b", "a-99999999999999999999-b"),
        ("a-7-b", "a-7-b"),  # a control character
        ("a-55296-b", "a-55296-b"),  # no character at all
        ("_", "_"),
    ],
)
def test_an_instance_keeps_its_name(name: str, element: str, tmp_path: Path) -> None:
    mesh = fmu_mesh.Mesh("names", step_size=0.1, stop_time=0.3)
    mesh.add(name, fmu=FMUS / "Gain.fmu", group="g", start_values={"k": 2.0})
    mesh.add("plain", fmu=FMUS / "Integrator.fmu")
    mesh.connect(f"{name}.y", "plain.u", delay=1)
    mesh.record(f"{name}.y", "plain.y", file="names.csv")

    mesh.to_ssp(tmp_path / "system.ssp")

    names = description_of(tmp_path / "system.ssp").xpath("//ssd:Component/@name", namespaces=NAMES)
    assert names == [element, "plain"]
    assert_equal(mesh, loaded(tmp_path / "system.ssp"), tmp_path)


def test_elements_have_names_of_their_own(tmp_path: Path) -> None:
    mesh = fmu_mesh.Mesh("names", step_size=0.1, stop_time=0.3)
    for number, name in enumerate(("my-gain", instance_name(["my-gain"]), instance_name(["my-gain_"]))):
        mesh.add(name, fmu=FMUS / "Gain.fmu", start_values={"k": float(number)})

    mesh.to_ssp(tmp_path / "system.ssp")

    names = description_of(tmp_path / "system.ssp").xpath("//ssd:Component/@name", namespaces=NAMES)
    assert names == ["my-gain__", "my-gain", "my-gain_"]
    assert_equal(mesh, loaded(tmp_path / "system.ssp"), tmp_path)


# --- files


def test_two_exports_have_the_same_bytes(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    for folder, mode, time in ((first, 0o600, 1_000_000_000), (second, 0o755, 2_000_000_000)):
        folder.mkdir()
        (folder / "Gain.fmu").write_bytes((FMUS / "Gain.fmu").read_bytes())
        (folder / "Gain.fmu").chmod(mode)
        os.utime(folder / "Gain.fmu", (time, time))
        unpacked(folder / "open", source=FMUS / "Integrator.fmu")
        for file in (folder / "open").rglob("*"):
            os.utime(file, (time, time))
        mesh = fmu_mesh.load(
            write_config(folder, instances={"a": {"fmu": "Gain.fmu"}, "b": {"fmu": "open"}}, connections=["a.y -> b.u"])
        )
        mesh.to_ssp(folder / "system.ssp")
        mesh.to_ssp(folder / "again.ssp")

    packages = [folder / name for folder in (first, second) for name in ("system.ssp", "again.ssp")]
    assert len({package.read_bytes() for package in packages}) == 1
    with zipfile.ZipFile(packages[0]) as archive:
        assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
        assert {entry.external_attr >> 16 for entry in archive.infolist()} == {0o100644}


def test_fmus_with_equal_content_are_one_file_and_others_have_names(tmp_path: Path) -> None:
    files = {"one": "Gain.fmu", "two": "Gain.fmu", "three": "GAIN.fmu", "four": "a b%.fmu"}
    places = {folder: tmp_path / folder / file for folder, file in files.items()}
    for path in places.values():
        path.parent.mkdir()
    places["one"].write_bytes((FMUS / "Gain.fmu").read_bytes())
    places["two"].write_bytes((FMUS / "Gain.fmu").read_bytes())
    repacked(places["three"], add={"extra/three.txt": b"3"})
    repacked(places["four"], add={"extra/four.txt": b"4"})
    mesh = fmu_mesh.Mesh("files", step_size=0.1, stop_time=0.2)
    for name, path in places.items():
        mesh.add(name, fmu=path)

    mesh.to_ssp(tmp_path / "system.ssp")

    content = files_of(tmp_path / "system.ssp")
    assert [*content] == [MAIN, "resources/Gain.fmu", "resources/GAIN_2.fmu", "resources/a_b_.fmu"]
    for name, source in (("one", "Gain"), ("three", "GAIN_2"), ("four", "a_b_")):
        assert content[f"resources/{source}.fmu"] == places[name].read_bytes()
    assert_equal(mesh, loaded(tmp_path / "system.ssp"), tmp_path)


def test_an_unpacked_fmu_is_packed(tmp_path: Path) -> None:
    folder = unpacked(tmp_path / "open", source=FMUS / "Integrator.fmu")
    mesh = fmu_mesh.Mesh("open", step_size=0.1, stop_time=1.0)
    mesh.add("integrator", fmu=folder, start_values={"u": 2.0})

    mesh.to_ssp(tmp_path / "system.ssp")

    with zipfile.ZipFile(io.BytesIO(files_of(tmp_path / "system.ssp")["resources/open.fmu"])) as packed:
        assert {name: packed.read(name) for name in packed.namelist()} == {
            file.relative_to(folder).as_posix(): file.read_bytes() for file in folder.rglob("*") if file.is_file()
        }
    assert_equal(mesh, loaded(tmp_path / "system.ssp"), tmp_path)


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """No file that this process writes becomes larger."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_an_export_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(CONFIGS / "pendulum_delay.yaml")
    package = tmp_path / "system.ssp"
    with files_of_at_most(10_000), pytest.raises(fmu_mesh.ConfigurationError, match=r"system\.ssp' cannot be written"):
        mesh.to_ssp(package)
    assert [*tmp_path.iterdir()] == []

    package.write_bytes(b"an older one")
    with files_of_at_most(10_000), pytest.raises(fmu_mesh.ConfigurationError, match=r"system\.ssp' cannot be written"):
        mesh.to_ssp(package)
    assert [*tmp_path.iterdir()] == [package]
    assert package.read_bytes() == b"an older one"


def test_a_package_in_a_folder_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(CONFIGS / "pendulum_delay.yaml")

    with pytest.raises(fmu_mesh.ConfigurationError, match=r"cannot be written: No such file"):
        mesh.to_ssp(tmp_path / "none" / "system.ssp")
    with pytest.raises(fmu_mesh.ConfigurationError, match=r"no name of a package\. Let it end in '\.ssp'"):
        mesh.to_ssp(tmp_path / "system.zip")


# --- what cannot be said


def found_in(error: fmu_mesh.ConfigurationError) -> list[str]:
    return [f"{finding.path}: {finding.found}; {finding.expected}" for finding in error.findings]


def test_everything_that_cannot_go_into_a_package_is_named_at_once(tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_text("time,u\n0,1\n", encoding="utf-8")
    config = write_config(
        tmp_path,
        instances={
            "gain": {"fmu": "Gain"},
            "world": {"mujoco": "world.xml"},
            "pid": {"controller": "position_pid"},
        },
        connections=[],
        scenario={"values": {"gain.u": {"file": "table.csv"}}},
        zenoh={"config": "zenoh.json5"},
    )

    with pytest.raises(fmu_mesh.ConfigurationError) as caught:
        fmu_mesh.load(config).to_ssp(tmp_path / "system.ssp")

    values = "`times` and `values`, or no entry for this variable"
    only = "only FMUs: SSP has no components of other kinds. Export the mesh without it"
    no_place = "which has no place in a package"
    assert sorted(found_in(caught.value)) == [
        f"instances.pid: 'pid', which is no FMU but has the key 'controller'; {only}",
        f"instances.world: 'world', which is no FMU but has the key 'mujoco'; {only}",
        f"scenario.values.gain.u: values from the file 'table.csv', {no_place}; {values}",
        f"zenoh.config: the file 'zenoh.json5', {no_place}; the keys of the section `zenoh`, such as `connect`",
    ]
    assert all(finding.line is not None for finding in caught.value.findings)
    assert not (tmp_path / "system.ssp").exists()


def test_what_needs_ssp_2_is_named_with_its_variable(tmp_path: Path) -> None:
    fmu = find_fmu("AllTypes3", tmp_path)
    mesh = fmu_mesh.Mesh("types", step_size=0.1, stop_time=1.0)
    mesh.add("a", fmu=fmu, start_values={"int8_in": 3, "float64_array_in": [[1, 2, 3], [4, 5, 6]], "float64_in": 1.5})
    mesh.add("b", fmu=fmu, start_values={"int32_in": 5, "string_in": "text", "enumeration_in": "low"})
    mesh.connect("a.float32_out", "b.float32_in")
    mesh.connect("a.float64_array_out[1,2]", "b.float64_in")
    mesh.connect("a.boolean_out", "b.boolean_in")

    with pytest.raises(fmu_mesh.ConfigurationError) as caught:
        mesh.to_ssp(tmp_path / "system.ssp")

    assert found_in(caught.value) == [
        f'{place}; SSP 2.0, as with `version="2.0"`'
        for place in (
            "instances.a.start_values.int8_in: a start value of type Int8 for 'int8_in'",
            "instances.a.start_values.float64_array_in: a start value of type Float64[2,3] for 'float64_array_in'",
            "connections[0]: a.float32_out -> b.float32_in, where 'float32_out' is of type Float32",
            "connections[0]: a.float32_out -> b.float32_in, where 'float32_in' is of type Float32",
            "connections[1]: a.float64_array_out[1,2] -> b.float64_in, which connects an element of an array",
        )
    ]
    mesh.to_ssp(tmp_path / "system.ssp", version="2.0")
    assert_equal(mesh, loaded(tmp_path / "system.ssp"), tmp_path)


def test_an_fmu_of_fmi_3_with_unused_variables_fits_ssp_1(tmp_path: Path) -> None:
    mesh = fmu_mesh.Mesh("types", step_size=0.1, stop_time=1.0)
    starts = {"float64_in": 1.5, "int32_in": -5, "boolean_in": True, "string_in": "x", "binary_in": "AQID"}
    mesh.add("a", fmu=find_fmu("AllTypes3", tmp_path), start_values=starts)

    mesh.to_ssp(tmp_path / "system.ssp")

    connectors = description_of(tmp_path / "system.ssp").xpath("//ssd:Connector/@name", namespaces=NAMES)
    assert {"float64_in", "string_out", "enumeration_in", "binary_parameter"} <= {*connectors}
    assert not [name for name in connectors if name.startswith(("int8", "float32")) or "array" in name]
    assert_equal(mesh, loaded(tmp_path / "system.ssp"), tmp_path)


def test_a_control_character_in_a_start_value_is_refused(tmp_path: Path) -> None:
    mesh = fmu_mesh.Mesh("text", step_size=0.1, stop_time=1.0)
    mesh.add("a", fmu=find_fmu("AllTypes", tmp_path), start_values={"string_in": "bell \a"})

    with pytest.raises(fmu_mesh.ConfigurationError, match=r"a\.start_values\.string_in: a control character"):
        mesh.to_ssp(tmp_path / "system.ssp")


# --- other readers


def schema(name: str, version: Version) -> Any:  # noqa: ANN401  lxml ships no types
    folder = RESOURCES if version == "1.0" else RESOURCES / "ssp2"
    return etree.XMLSchema(file=str(folder / f"SystemStructure{name}.xsd"))


def assert_valid(package: Path, version: Version) -> None:
    root = description_of(package)
    assert root.get("version") == version
    schema("Description", version).assertValid(root)
    for own in root.iter(f"{{{NAMES['ssv']}}}ParameterSet"):
        assert own.get("version") == version
        schema("ParameterValues", version).assertValid(etree.fromstring(etree.tostring(own)))


@pytest.mark.parametrize("version", ["1.0", "2.0"])
@pytest.mark.parametrize("name", WITH_FMUS_ONLY)
def test_the_description_is_valid_for_the_schemas_of_its_version(name: str, version: Version, tmp_path: Path) -> None:
    fmu_mesh.load(CONFIGS / f"{name}.yaml").to_ssp(tmp_path / "system.ssp", version=version)

    assert_valid(tmp_path / "system.ssp", version)


def test_a_description_with_every_type_is_valid_for_the_schemas(tmp_path: Path) -> None:
    fmu_mesh.load(written_types(tmp_path)).to_ssp(tmp_path / "system.ssp", version="2.0")

    assert_valid(tmp_path / "system.ssp", "2.0")


def test_fmpy_reads_and_simulates_a_package(tmp_path: Path) -> None:
    """FMPy knows no start values in a package, no step size, and steps with the values of the last point."""
    mesh = fmu_mesh.Mesh("swinging", step_size=0.125, stop_time=1.0, algorithm="jacobi")
    mesh.add("pendulum", fmu=FMUS / "DampedPendulum.fmu")
    mesh.add("gain", fmu=FMUS / "Gain.fmu")
    mesh.connect("pendulum.a", "gain.u")

    mesh.to_ssp(tmp_path / "system.ssp")
    description = fmpy.ssp.ssd.read_ssd(str(tmp_path / "system.ssp"))
    rows = fmpy.ssp.simulation.simulate_ssp(str(tmp_path / "system.ssp"), stop_time=1.0, step_size=0.125)

    assert [component.name for component in description.system.elements] == ["pendulum", "gain"]
    result = mesh.run(record="memory", processes=False)
    # A row of FMPy has the values at the end of its step. In its first step every input is 0.
    assert rows["pendulum.a"].tolist() == result["pendulum.a"][1:].tolist()
    assert rows["gain.y"][1:].tolist() == result["gain.y"][2:].tolist()
    assert len(set(rows["gain.y"].tolist())) == 8
