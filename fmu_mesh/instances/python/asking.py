"""Describing a component in a child process: nothing that a user wrote is imported where a run is planned.

Owns the request and the answer, for both sides.
"""

from __future__ import annotations

import sys
from pathlib import Path
from shlex import quote
from typing import Any

import msgspec

from ... import __version__
from ...errors import FmuMeshError, LoadFailed
from ...installing import installed_from
from ...variables.model_description import ModelDescription
from ..child_question import ask_description_of, described, run_child
from .component_description import check_arguments
from .importing import ImportedComponent
from .python_section import PythonConfig, class_place_of

__all__ = ["answer_to", "ask_description"]


class _Request(msgspec.Struct, frozen=True):
    """A component to describe; see `PythonConfig`."""

    python: str
    path: str
    arguments: dict[str, Any]


def ask_description(path: Path, section: PythonConfig) -> ModelDescription:
    """The model description of a component, from a child process that imports it.

    Args:
        path: the absolute path of its file; `Path()` for a module.
        section: its section of the configuration.

    Raises:
        LoadFailed: it cannot be imported or described, or the interpreter cannot be used; says why.
    """
    target = class_place_of(section.python)
    if target.file and not path.is_file():
        raise LoadFailed("a folder" if path.is_dir() else "no such file")
    if section.interpreter is not None:
        _check_version(section.interpreter)
    request = _Request(section.python, str(path), section.arguments)
    return ask_description_of("its import", __name__, request, section.interpreter or sys.executable)


def answer_to(request: str) -> bytes:
    """In the child process: import what is asked for; returns the answer."""
    asked = msgspec.json.decode(request, type=_Request)
    component = ImportedComponent(Path(asked.path), class_place_of(asked.python))

    def describe() -> ModelDescription:
        try:
            description = component.load()
            check_arguments(component.cls, asked.arguments)
        except (Exception, SystemExit) as error:  # it is code of the user
            raise LoadFailed(component.told(error), hint=_hint(error)) from error
        return description

    return described(describe)


def _hint(error: BaseException) -> str | None:
    if isinstance(error, ModuleNotFoundError):
        return "Is it installed in the Python that runs the component?"
    return error.hint if isinstance(error, FmuMeshError) else None


def _check_version(python: str) -> None:
    """Check that a Python has our version.

    Raises:
        LoadFailed: it has another one, or none.
    """
    output, _ = run_child([python, "-Pc", "import fmu_mesh; print(fmu_mesh.__version__)"])
    version = output.decode(errors="replace").strip()
    if version != __version__:
        has = f"has fmu-mesh {version}" if version else "has no fmu-mesh"
        place = installed_from()
        how = f"{quote(python)} -m pip install {place}" if place else f"from a clone of version {__version__}"
        hint = f"Install fmu-mesh {__version__} there: {how}"
        raise LoadFailed(f"the Python '{python}' {has}", hint=hint)
