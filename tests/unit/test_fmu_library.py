"""The library of an FMU: whose functions it uses, which it may lack, and which libraries it finds."""

from __future__ import annotations

import ctypes
import subprocess
import zipfile
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh import FMIAdapter
from fmu_mesh.errors import FmuError, LoadFailed
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.fmu_library import MISSING, FmuLibrary
from fmu_mesh.instances.fmi.opening import open_instance
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.layout import Layout
from fmu_mesh.variables.model_description import Kind
from fmu_mesh.variables.value_types import Value
from fmus.build import find_compiler
from tests.fmus.event_fmus import Version
from tests.fmus.helpers import FMUS, NO_COMPILER
from tests.fmus.packing import repacked

EventFmu = Callable[..., Path]

needs_compiler = pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))

KINDS: list[tuple[Version, Kind]] = [
    (1, "model_exchange"),
    (2, "co_simulation"),
    (2, "model_exchange"),
    (3, "co_simulation"),
    (3, "model_exchange"),
]
OPTIONAL = (
    "CancelStep",
    "DeserializeFMUState",
    "DeSerializeFMUstate",
    "FreeFMUState",
    "FreeFMUstate",
    "FreeInstance",
    "FreeModelInstance",
    "GetFMUState",
    "GetFMUstate",
    "GetNominalContinuousStates",
    "GetNominalsOfContinuousStates",
    "GetString",
    "GetStringStatus",
    "Reset",
    "SetDebugLogging",
    "SetFMUState",
    "SetFMUstate",
    "SetString",
    "Terminate",
)


LEAST = """
#include <stddef.h>
int Py_IsInitialized(void) {{ return 42; }}
void *fmi2Instantiate(void) {{ static int it; return &it; }}
int fmi2SetupExperiment(void) {{ return 0; }}
int fmi2EnterInitializationMode(void) {{ return 0; }}
int fmi2ExitInitializationMode(void) {{ return 0; }}
int fmi2SetReal(void) {{ return 0; }}
int fmi2DoStep(void) {{ return 0; }}
int fmi2GetReal(void *c, const unsigned r[], size_t n, double y[]) {{ while (n--) y[n] = {y}; return 0; }}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Where the library of an extracted FMU lies."""
    made = tmp_path / "fmu" / "binaries" / "linux64"
    made.mkdir(parents=True)
    return made


@pytest.fixture
def opened() -> Iterator[Callable[..., FmuLibrary]]:
    """Loads a library, which is unloaded at the end."""
    loaded: list[FmuLibrary] = []

    def load(path: Path, *, deep_binding: bool = True) -> FmuLibrary:
        loaded.append(FmuLibrary(path, deep_binding=deep_binding))
        return loaded[-1]

    yield load
    for library in loaded:
        library.close()


def compiled(path: Path, code: str, *options: str) -> Path:
    """The library ``path``, compiled without what would bind its names when it is linked."""
    source = path.with_suffix(".c")
    source.write_text(code, encoding="utf-8")
    command = [
        *find_compiler(),
        "-shared",
        "-fPIC",
        "-w",
        "-O0",
        "-fno-builtin",
        "-o",
        str(path),
        str(source),
        *options,
    ]
    subprocess.run(command, check=True)
    source.unlink()
    return path


def is_loaded(part: str) -> bool:
    return part in Path("/proc/self/maps").read_text(encoding="utf-8")


def without(fmu: Path, target: Path, *functions: str) -> Path:
    """The same FMU, whose library has these functions under another name: nobody finds them."""
    with zipfile.ZipFile(fmu) as archive:
        (name,) = [one for one in archive.namelist() if one.endswith(".so")]
        library = archive.read(name)
    for function in functions:
        for prefix in (b"fmi", b"fmi2", b"fmi3"):
            whole = prefix + function.encode()
            library = library.replace(whole + b"\0", whole[:-1] + b"#\0")
    return repacked(target, source=fmu, keep=lambda entry: entry != name, add={name: library})


def rows_of(fmu: Path, kind: Kind, folder: Path) -> list[list[Value]]:
    """The outputs of an FMU after each of 20 steps."""
    folder.mkdir()
    description = read_description(fmu, kind=kind)
    names = [variable.name for variable in description.with_causality("output")]
    outputs = Ring(Layout.of(description.with_causality("output")), 64)
    with closing(open_instance(fmu, "it", description, folder)) as instance:
        instance.enter_initialization(0.0, None, {})
        instance.exit_initialization()
        instance.bind(Ring(Layout.of([]), 1), (outputs,), TimeGrid(0.0, 0.125, 40), 1)
        rows = []
        for step in range(20):
            instance.do_step(step)
            rows.append(instance.get_values(names))
    return rows


@needs_compiler
@pytest.mark.parametrize(
    ("definition", "use"),
    [
        ("double gamma = 42.0;", "gamma"),
        ("double y0 = 40.0, y1 = 2.0;", "y0 + y1"),
        ("int error(int a) { return a + 1; }", "error(41)"),
        ("int advance(int a) { return a + 1; }", "advance(41)"),
        ("int Py_GetVersion(int a) { return a + 1; }", "Py_GetVersion(41)"),
    ],
)
def test_an_fmu_uses_its_own_function_or_variable(
    definition: str, use: str, folder: Path, opened: Callable[..., FmuLibrary]
) -> None:
    library = opened(compiled(folder / "own.so", f"{definition} double fmi_used(void) {{ return {use}; }}"))

    library.fmi_used.restype = ctypes.c_double

    assert library.fmi_used() == 42.0


@needs_compiler
def test_without_deep_binding_those_of_the_process_come_first(folder: Path, opened: Callable[..., FmuLibrary]) -> None:
    code = "int Py_IsInitialized(void) { return 42; } int fmi_used(void) { return Py_IsInitialized(); }"
    path = compiled(folder / "other.so", code)

    library = opened(path, deep_binding=False)

    assert library.fmi_used() == 1


@needs_compiler
def test_an_fmu_that_needs_python_uses_that_of_the_process(folder: Path, opened: Callable[..., FmuLibrary]) -> None:
    compiled(folder / "libpython3.99.so", "int Py_IsInitialized(void) { return 42; }")
    code = "int Py_IsInitialized(void); int fmi_used(void) { return Py_IsInitialized(); }"

    library = opened(compiled(folder / "embedding.so", code, f"-L{folder}", "-lpython3.99"))

    assert library.fmi_used() == 1


@needs_compiler
def test_a_program_and_a_configuration_choose_the_binding(tmp_path: Path) -> None:
    with zipfile.ZipFile(FMUS / "Gain.fmu") as archive:
        (name,) = [one for one in archive.namelist() if one.startswith("binaries/")]
    library = compiled(tmp_path / "Gain.so", LEAST.format(y="Py_IsInitialized()")).read_bytes()
    fmu = repacked(tmp_path / "Gain.fmu", keep=lambda entry: entry != name, add={name: library})
    found = []

    for deep_binding in (True, False):
        with FMIAdapter(fmu, 0.1, deep_binding=deep_binding) as adapter:
            adapter.exit_initialization_mode(0.0)
            adapter.do_step()
            found.append(adapter.get_output_value("y"))
        mesh = fmu_mesh.Mesh("one", step_size=0.1, stop_time=1.0)
        mesh.add("gain", fmu=str(fmu), deep_binding=deep_binding)
        with mesh.open() as system:
            system.step()
            found.append(system.get("gain.y"))

    assert found == [42.0, 42.0, 1.0, 1.0]


@needs_compiler
@pytest.mark.parametrize("soname", [True, False])
@pytest.mark.parametrize("run_path", ["", "/folder/of/its/maker"])
def test_a_library_beside_is_found_without_a_run_path(
    soname: bool,  # noqa: FBT001 as named
    run_path: str,
    folder: Path,
    opened: Callable[..., FmuLibrary],
) -> None:
    known = "-Wl,-soname,{}" if soname else "-Wl,--build-id=none"
    linked = [f"-L{folder}", *([f"-Wl,-rpath,{run_path}"] if run_path else [])]
    compiled(folder / "libinner.so", "int inner(void) { return 40; }", known.format("libinner.so"))
    code = "int inner(void); int outer(void) { return inner() + 2; }"
    compiled(folder / "libouter.so", code, *linked, "-linner", known.format("libouter.so"))
    code = "int outer(void); int inner(void); int fmi_used(void) { return outer() + inner() - 40; }"
    path = compiled(folder / "model.so", code, *linked, "-louter", "-linner")

    library = opened(path)

    assert library.fmi_used() == 42


@needs_compiler
def test_a_closed_library_is_unloaded_with_those_beside_it(folder: Path) -> None:
    compiled(folder / "libhelper.so", "int helper(void) { return 42; }")
    path = compiled(
        folder / "model.so", "int helper(void); int fmi_used(void) { return helper(); }", f"-L{folder}", "-lhelper"
    )
    library = FmuLibrary(path, deep_binding=True)
    assert is_loaded(f"{folder}/libhelper.so")

    library.close()

    assert not is_loaded(str(folder))


@needs_compiler
def test_imports_are_those_of_all_libraries_of_the_fmu(folder: Path, opened: Callable[..., FmuLibrary]) -> None:
    compiled(folder / "libhelper.so", "int chdir(const char *); int helper(void) { return chdir(0); }")
    path = compiled(
        folder / "model.so", "int helper(void); int fmi_used(void) { return helper(); }", f"-L{folder}", "-lhelper"
    )

    imports = opened(path).imports

    assert {b"chdir", b"helper"} <= imports
    assert imports.isdisjoint({b"fmi_used", b"Py_GetVersion"})


@needs_compiler
def test_a_function_that_is_missing_is_told_when_it_is_called(folder: Path, opened: Callable[..., FmuLibrary]) -> None:
    library = opened(compiled(folder / "model.so", "int fmi2DoStep(void) { return 0; }"))

    assert (library.fmi2DoStep(), library.fmi2Reset()) == (0, MISSING)
    assert library.missing == {"fmi2Reset"}


@pytest.mark.parametrize(("version", "kind"), KINDS, ids=str)
def test_functions_that_a_run_does_not_need_may_be_missing(
    version: Version, kind: Kind, event_fmu: EventFmu, tmp_path: Path
) -> None:
    whole = event_fmu("Ball", version)
    part = without(whole, tmp_path / "part.fmu", *OPTIONAL)

    assert rows_of(part, kind, tmp_path / "part") == rows_of(whole, kind, tmp_path / "whole")


@pytest.mark.parametrize(("version", "kind"), KINDS, ids=str)
def test_a_function_that_every_run_needs_is_named_if_it_is_missing(
    version: Version, kind: Kind, event_fmu: EventFmu, tmp_path: Path
) -> None:
    needed = "DoStep" if kind == "co_simulation" else "SetTime"
    part = without(event_fmu("Stairs", version), tmp_path / "part.fmu", needed, "SetInteger", "SetInt32")
    prefix = f"fmi{version if version > 1 else ''}"
    names = sorted([prefix + needed, prefix + ("SetInt32" if version == 3 else "SetInteger")])

    with pytest.raises(LoadFailed, match=f"its library has no function {', '.join(names)}, which every run needs"):
        rows_of(part, kind, tmp_path / "part")


def test_a_state_that_cannot_be_kept_is_told_with_the_missing_function(event_fmu: EventFmu, tmp_path: Path) -> None:
    part = without(event_fmu("Stairs", 2), tmp_path / "part.fmu", "GetFMUstate")
    mesh = fmu_mesh.Mesh("one", step_size=0.1, stop_time=1.0)
    mesh.add("stairs", fmu=str(part))

    with (
        mesh.open() as system,
        pytest.raises(FmuError, match="fmi2GetFMUstate returned nothing: its library does not have"),
    ):
        system.save()
