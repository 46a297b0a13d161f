"""Components in Python as a kind of instances. What users write is imported in processes of its own, and to run it."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Sequence
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any

import msgspec

from ...config.mesh import LimitsConfig
from ...errors import FmuMeshError, LoadFailed
from ...files import below, sha256_of
from ...system.process_sharing import BOTH_USE_PYTHON, Claims
from ...variables.model_description import ModelDescription
from ..child_question import ask_description_of, check_version, described
from ..contract import Instance, Kind, Opening
from .python_section import PythonConfig, class_place_of

__all__ = ["KIND_OF_COMPONENTS"]


class PythonKind(Kind[PythonConfig]):
    """Classes that derive from `fmu_mesh.Component`."""

    section = PythonConfig
    expected = "a component in Python, such as `controller.py:Controller` or `package.module:Controller`"

    def describe(
        self, path: Path, section: PythonConfig, limits: LimitsConfig, tell: Callable[[str], None]
    ) -> ModelDescription:
        """Import the class in a child process, which sends back its description."""
        target = class_place_of(section.python)
        if target.file and not path.is_file():
            raise LoadFailed("a folder" if path.is_dir() else "no such file")
        if section.interpreter is not None:
            check_version(section.interpreter)
        request = section.python, str(path), section.arguments
        return ask_description_of("its import", __name__, request, section.interpreter or sys.executable)

    def content(self, path: Path) -> str:
        """A SHA-256 of the file; empty for a module, whose content is in the description."""
        return hashlib.sha256(path.read_bytes()).hexdigest() if path != Path() else ""

    def files(self, path: Path) -> Sequence[Path]:
        """All files of the folder of a component: it may import some, and read others."""
        return below(path.parent)

    def claims(self, path: Path, section: PythonConfig, description: ModelDescription, limits: LimitsConfig) -> Claims:
        """The interpreter, and the modules of its folder that cannot be imported for one instance alone."""
        claims: dict[str, str] = {BOTH_USE_PYTHON: "components"}
        for file in path.parent.iterdir() if path != Path() else ():
            if file.name.endswith((*EXTENSION_SUFFIXES, ".pyc")):
                name = file.name.partition(".")[0]
                claims[f"both may import a module '{name}', of which a process has one"] = sha256_of(file)
        return claims

    def open(self, opening: Opening[PythonConfig]) -> Instance:
        """Import the class in this process, and make a component."""
        from .python_instance import PythonInstance  # noqa: PLC0415  only where there is a component

        return PythonInstance(opening)


def answer_to(request: str) -> bytes:
    """In the child process: import what is asked for; returns the answer."""
    from .importing import ImportedComponent, check_arguments  # noqa: PLC0415  as above

    python, path, arguments = msgspec.json.decode(request, type=tuple[str, str, dict[str, Any]])
    component = ImportedComponent(Path(path), class_place_of(python))

    def describe() -> ModelDescription:
        try:
            description = component.load()
            check_arguments(component.cls, arguments)
        except (Exception, SystemExit) as error:  # it is code of the user
            hint = error.hint if isinstance(error, FmuMeshError) else None
            if isinstance(error, ModuleNotFoundError):
                hint = "Is it installed in the Python that runs the component?"
            raise LoadFailed(component.told(error), hint=hint) from error
        return description

    return described(describe)


KIND_OF_COMPONENTS = PythonKind()  # what the entry point `python` names
