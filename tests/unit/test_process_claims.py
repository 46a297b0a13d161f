"""What an FMU claims of its process, read from its libraries, and how its copies get names of their own."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import pytest

from fmu_mesh.instances.fmi.archive.archive import opened
from fmu_mesh.instances.fmi.archive.library_names import claims_of, rename_libraries
from fmu_mesh.instances.fmi.archive.shared_library import read_shared_library
from fmu_mesh.system.process_sharing import BOTH_USE_PYTHON, Claims, SharedProcess
from tests.fmus.helpers import NO_COMPILER
from tests.fmus.packing import Entry, repacked, unpacked

pytestmark = pytest.mark.skipif(NO_COMPILER is not None, reason=NO_COMPILER or "")

OWN = "binaries/linux64/Gain.so"
HELPER = "double gain(void) { return 2.0; }"
ASKING = "double gain(void); double value(void) { return gain(); }"


def library(folder: Path, name: str, code: str, *flags: str | Path, plus: bool = False) -> Path:
    source = folder / f"{name}.{'cpp' if plus else 'c'}"
    source.write_text(code)
    command = ["c++" if plus else "cc", "-shared", "-fPIC", "-o", folder / name, source, *flags]
    subprocess.run(command, check=True, timeout=60)
    return folder / name


def claimed(target: Path, libraries: Mapping[str, Path], *, folder: bool = False) -> Claims:
    """The claims of an FMU with these libraries, by their names in it."""
    target.mkdir()
    add: dict[Entry, bytes] = {name: path.read_bytes() for name, path in libraries.items()}
    fmu = repacked(target / "model.fmu", keep=lambda name: not name.startswith("binaries/"), add=add)
    with opened(unpacked(target / "model", source=fmu) if folder else fmu) as one:
        return claims_of(one, OWN)


def share(claims: Sequence[Claims]) -> bool:
    process = SharedProcess()
    return all(process.refusal(str(number), partial(dict, own)) is None for number, own in enumerate(claims))


def why(name: str) -> str:
    return f"both load a library '{name}', of which a process has one"


def test_a_library_that_each_instance_copies_shares_with_no_other_one(tmp_path: Path) -> None:
    helper = library(tmp_path, "libgain.so", HELPER, "-Wl,-soname,libgain.so")
    own = library(tmp_path, "Gain.so", ASKING, helper)

    brought = claimed(tmp_path / "one", {OWN: own, "binaries/linux64/libgain.so": helper})
    of_the_system = claimed(tmp_path / "two", {OWN: own})

    assert share([brought, brought])
    assert share([of_the_system, of_the_system])
    assert not share([brought, of_the_system])


@pytest.mark.parametrize("folder", [False, True])
def test_a_library_in_the_folder_of_a_user_is_no_copy(tmp_path: Path, *, folder: bool) -> None:
    helper = library(tmp_path, "libgain.so", HELPER, "-Wl,-soname,libgain.so")
    own = library(tmp_path, "Gain.so", ASKING, helper, "-Wl,-rpath,$ORIGIN/../../resources")

    claims = claimed(tmp_path / "one", {OWN: own, "resources/libgain.so": helper}, folder=folder)

    assert claims[why("libgain.so")] == ("" if folder else "a copy of its own")


def test_a_library_that_is_opened_by_its_name_is_found(tmp_path: Path) -> None:
    helper = library(tmp_path, "libgain.so", HELPER, "-Wl,-soname,libgain.so")
    own = library(tmp_path, "Gain.so", 'const char *name(void) { return "libgain.so"; }')

    claims = claimed(tmp_path / "one", {OWN: own, "binaries/linux64/libgain.so": helper})

    assert why("libgain.so") in claims


def test_an_fmu_that_embeds_python_claims_the_interpreter(tmp_path: Path) -> None:
    own = library(tmp_path, "Gain.so", "void Py_Initialize(void); void value(void) { Py_Initialize(); }")
    claims = claimed(tmp_path / "one", {OWN: own})

    assert claims == {BOTH_USE_PYTHON: ""}
    assert not share([claims, {BOTH_USE_PYTHON: "components"}])


@pytest.mark.skipif(shutil.which("c++") is None, reason="there is no C++ compiler")
def test_unique_symbols_of_the_user_count_and_those_of_cpp_do_not(tmp_path: Path) -> None:
    code = "#include <map>\n#include <memory>\n#include <regex>\n#include <string>\n"
    code += (
        "inline int counter = 3; inline const double limit = 2.5; inline int& once() { static int n = 1; return n; }\n"
    )
    code += 'extern "C" double value() { std::map<std::string, std::shared_ptr<int>> all; std::regex one("a+");\n'
    code += (
        'all["a"] = std::make_shared<int>(1); const volatile double* at = &limit; return counter++ + once()++ + *at; }'
    )
    path = library(tmp_path, "Gain.so", code, "-std=c++17", "-O0", plus=True)

    facts = read_shared_library(path.read_bytes())
    claims = claimed(tmp_path / "one", {OWN: path})

    assert facts is not None
    assert any(name.startswith("_ZZNKSt") for name in facts.unique)
    names = {reason.split("'")[1]: bool(content) for reason, content in claims.items() if "C++ variable" in reason}
    assert names["counter"] is False
    assert names["_ZZ4oncevE1n"] is False
    assert {name for name in names if "St" in name} == set()


def test_a_name_that_is_taken_is_replaced_in_all_files(tmp_path: Path) -> None:
    for number in (1, 2):
        (tmp_path / str(number)).mkdir()
        code = f"static double n = {number}; double gain(void) {{ return n += {number}; }}"
        helper = library(tmp_path / str(number), "libtaken.so", code, "-Wl,-soname,libtaken.so")
        library(tmp_path / str(number), "Gain.so", ASKING, helper, "-Wl,-rpath,$ORIGIN")
    values = []

    for number in (1, 2):
        rename_libraries(tmp_path / str(number))
        value = ctypes.CDLL(str(tmp_path / str(number) / "Gain.so")).value
        values.append(ctypes.CFUNCTYPE(ctypes.c_double)(ctypes.cast(value, ctypes.c_void_p).value or 0)())

    assert values == [2.0, 4.0]
    assert sorted(path.name for path in (tmp_path / "1").glob("*.so")) == ["Gain.so", "libtaken.so"]
