"""The FMUs of the job `windows`: the example FMUs with a library for 64-bit Windows only, which run under Wine."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from fmu_mesh.instances.fmi.wine import INSTALL_WINE, wine_program
from fmus.build import HERE, WINDOWS_FROM_LINUX, build

__all__ = ["why_no_windows", "windows_fmu"]

_BUILT = HERE.parent / "build" / "bench-programs" / "windows"


def why_no_windows() -> str | None:
    """Why FMUs for Windows cannot be built or run here; None if they can."""
    if wine_program() is None:
        return f"Wine is not installed: {INSTALL_WINE}"
    return None if find_spec("ziglang") is not None else "the compiler is missing: `make library` installs it"


def windows_fmu(name: str) -> Path:
    """An example FMU for Windows; it is built once and kept under `build/`."""
    built = _BUILT / f"{name}.fmu"
    return built if built.is_file() else build(HERE / "src" / name, _BUILT, WINDOWS_FROM_LINUX)
