"""Components in Python as a kind of instances. What users write is imported in processes of its own, and to run it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

from ...config.mesh import LimitsConfig
from ...files import sha256_of
from ...system.process_sharing import BOTH_USE_PYTHON, Claims
from ...variables.model_description import ModelDescription
from ..contract import Instance, Kind, Opening
from .python_section import PythonConfig

__all__ = ["KIND_OF_COMPONENTS"]


class PythonKind(Kind[PythonConfig]):
    """Classes that derive from `fmu_mesh.Component`."""

    section = PythonConfig
    expected = "a component in Python, such as `controller.py:Controller` or `package.module:Controller`"

    def describe(
        self,
        path: Path,
        section: PythonConfig,
        limits: LimitsConfig,  # noqa: ARG002  for FMUs
        tell: Callable[[str], None],  # noqa: ARG002  takes less than a second, as a rule
    ) -> ModelDescription:
        """Import the class in a child process, which sends back its description."""
        from .asking import ask_description  # noqa: PLC0415  only where there is a component

        return ask_description(path, section)

    def content(self, path: Path) -> str:
        """A SHA-256 of the file; empty for a module, whose content is in the description."""
        return hashlib.sha256(path.read_bytes()).hexdigest() if path != Path() else ""

    def claims(
        self,
        path: Path,
        section: PythonConfig,  # noqa: ARG002  the file says everything
        description: ModelDescription,  # noqa: ARG002  as above
        limits: LimitsConfig,  # noqa: ARG002  for FMUs
    ) -> Claims:
        """The interpreter, and the modules of its folder that cannot be imported for one instance alone."""
        claims: dict[str, str] = {BOTH_USE_PYTHON: "components"}
        for file in path.parent.iterdir() if path != Path() else ():
            if file.name.endswith((*EXTENSION_SUFFIXES, ".pyc")):
                name = file.name.partition(".")[0]
                claims[f"both may import a module '{name}', of which a process has one"] = sha256_of(file)
        return claims

    def open(self, opening: Opening[PythonConfig]) -> Instance:
        """Import the class in this process, and make a component."""
        from .python_instance import PythonInstance  # noqa: PLC0415  as above

        return PythonInstance(opening)


KIND_OF_COMPONENTS = PythonKind()
"""What the entry point `python` names."""
