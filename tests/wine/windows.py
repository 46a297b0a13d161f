"""FMUs for Windows, and what a C loop over their DLLs computes under the same Wine, without anything of the mesh."""

from __future__ import annotations

import os
import struct
import subprocess
import zipfile
from collections.abc import Sequence
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

import pytest

from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.instances.fmi.wine import windows_path, wine_environment, wine_program
from fmus.build import WINDOWS_FROM_LINUX, build
from tests.equivalence.reference import Reference, Table
from tests.fmus.event_fmus import Version, build_event_fmu
from tests.fmus.helpers import FMUS, SOURCES, session_folder

__all__ = ["NEEDS_WINE", "run_dlls", "windows_event_fmu", "windows_fmu", "windows_program"]

_MISSING = [
    *(["`apt install wine`"] if wine_program() is None else []),
    *(["`make library` for its compiler"] if find_spec("ziglang") is None else []),
]
NEEDS_WINE = pytest.mark.skipif(bool(_MISSING), reason=f"needs {' and '.join(_MISSING)}")

_DEADLINE_S = 120.0


def windows_fmu(name: str) -> Path:
    """An example FMU or one of the tests, with a library for 64-bit Windows only; this test session shares it."""
    built = session_folder() / "windows" / f"{name}.fmu"
    folder = FMUS / "src" if (FMUS / "src" / name).is_dir() else SOURCES
    return built if built.is_file() else build(folder / name, built.parent, WINDOWS_FROM_LINUX)


def windows_event_fmu(name: str, version: Version, **changes: str) -> Path:
    """As `build_event_fmu`, with a library for 64-bit Windows only."""
    return build_event_fmu(name, version, session_folder() / "windows", runs="windows", **changes)


def windows_program(source: Path, *options: str) -> Path:
    """A program or a library of C for 64-bit Windows; this test session shares it."""
    suffix = ".dll" if "-shared" in options else ".exe"
    built = session_folder() / "windows" / f"{source.stem}{suffix}"
    if not built.is_file():
        built.parent.mkdir(exist_ok=True)
        draft = built.with_name(f"{source.stem}.{os.getpid()}{suffix}")
        headers = f"-I{files('fmpy') / 'c-code'}"
        flags = ["-O2", "-std=c11", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-s", headers, *options]
        subprocess.run([*WINDOWS_FROM_LINUX.compiler, *flags, "-o", draft, source], check=True, timeout=600.0)
        draft.replace(built)
    return built


def run_dlls(reference: Reference, folder: Path) -> Table:
    """The rows of the result, as `run_fmpy` has them; the DLLs are extracted into ``folder``."""
    program = windows_program(Path(__file__).with_name("dll_loop.c"))
    done = subprocess.run(
        [str(wine_program()), str(program)],
        input="".join(f"{line}\n" for line in _plan(reference, folder)).encode(),
        capture_output=True,
        check=False,
        timeout=_DEADLINE_S,
        env=wine_environment(),
    )
    assert done.returncode == 0, done.stderr.decode(errors="replace")
    return [tuple(map(_number, line.split())) for line in done.stdout.decode().splitlines()]


def _plan(reference: Reference, folder: Path) -> Sequence[str]:
    names = [unit.name for unit in reference.units]
    descriptions = [read_description(Path(unit.fmu)) for unit in reference.units]
    lines = [f"grid {_digits(reference.start_time)} {_digits(reference.step_size)} {reference.last_point}"]

    def end(name: str, variable: str) -> str:
        place = names.index(name)
        found = descriptions[place].variable(variable)
        assert found is not None
        return f"{place} {found.value_reference}"

    for unit, description in zip(reference.units, descriptions, strict=True):
        assert description.library is not None
        with zipfile.ZipFile(unit.fmu) as archive:
            library = Path(archive.extract(description.library, folder / unit.name))
        lines.append(f"unit {windows_path(library)} {description.guid} {unit.points}")
        lines += [f"value {end(unit.name, key)} {_digits(value)}" for key, value in unit.start_values.items()]
    for pipe in reference.pipes:
        assert (pipe.factor, pipe.offset) == (1.0, 0.0)
        lines.append(f"pipe {end(pipe.source, pipe.output)} {end(pipe.target, pipe.input)} {pipe.delay}")
    return [*lines, *(f"record {end(*column)}" for column in reference.recorded)]


def _digits(value: float) -> str:
    return struct.pack(">d", value).hex()


def _number(digits: str) -> float:
    (value,) = struct.unpack(">d", bytes.fromhex(digits))
    return float(value)
