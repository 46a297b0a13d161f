"""Finds and builds the FMUs that tests use.

The sources of the FMUs that only tests use are in ``tests/fmus/src``; a built file of theirs is never kept in
the repository. Without a C compiler, a test that needs one of them is skipped with that reason.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path

import fmpy
import pytest

from fmus.build import BuildError, build, find_compiler

__all__ = [
    "FMUS",
    "KEPT_FMUS",
    "NO_COMPILER",
    "TEST_FMUS",
    "build_test_fmu",
    "built_once",
    "extracted_fmu",
    "find_fmu",
    "session_folder",
]

FMUS = Path(__file__).resolve().parents[2] / "fmus"
SOURCES = Path(__file__).resolve().parent / "src"

_SESSION = "FMU_MESH_TEST_SESSION"

KEPT_FMUS = tuple(sorted(path.stem for path in FMUS.glob("*.fmu")))
TEST_FMUS = tuple(
    sorted(path.parent.name for path in SOURCES.glob("*/modelDescription.xml") if "skeleton.c" in path.read_text())
)
"""The test-only FMUs made of the skeleton, which is of FMI 2.0."""


def built_once(model: Path) -> Path:
    """The FMU of the model in this folder, which all workers of a test session share: it must not be changed.

    Raises:
        BuildError: there is no C compiler, or the sources do not compile.
    """
    built = session_folder() / f"{model.name}.fmu"
    return built if built.is_file() else build(model, built.parent)


def build_test_fmu(name: str, folder: Path) -> Path:
    """Put a test-only FMU into ``folder`` and return its path; a file that is already there is used again.

    Args:
        name: a folder of ``tests/fmus/src``.
        folder: a folder of this test session, made if missing.

    Raises:
        BuildError: there is no C compiler, or the sources do not compile.
    """
    own = folder / f"{name}.fmu"
    if not own.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(built_once(SOURCES / name), own)
    return own


def session_folder() -> Path:
    """A folder that all workers of this test session share; who asks first makes it, and removes it at its end."""
    if _SESSION not in os.environ:
        os.environ[_SESSION] = folder = tempfile.mkdtemp(prefix="fmu_mesh_tests-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(os.environ[_SESSION])


def find_fmu(name: str, folder: Path) -> Path:
    """Return the kept FMU, or the test-only FMU built into ``folder``."""
    if name in KEPT_FMUS:
        return FMUS / f"{name}.fmu"
    if NO_COMPILER is not None:
        pytest.skip(NO_COMPILER)
    return build_test_fmu(name, folder)


def extracted_fmu(name: str, folder: Path) -> Path:
    """Return the folder of an extracted FMU below ``folder``; it is extracted once."""
    target = folder / f"{name}_extracted"
    if not target.is_dir():
        fmpy.extract(str(find_fmu(name, folder)), unzipdir=str(target))
    return target


def _why_no_compiler() -> str | None:
    try:
        find_compiler()
    except BuildError as error:
        return str(error)
    return None


NO_COMPILER = _why_no_compiler()
"""Why nothing can be built here, or None."""
