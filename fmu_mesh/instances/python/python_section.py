"""The section of a component in Python in a configuration."""

from __future__ import annotations

from contextvars import ContextVar
from typing import Annotated, Literal, NamedTuple, Self

from msgspec import Meta
from msgspec.structs import replace

from ...config.base import Base
from ...config.instance_sections import (
    KIND,
    ExtrapolationOfInputs,
    Feedthrough,
    Group,
    Host,
    Inputs,
    InstanceSection,
    NotFinitePolicy,
    OnFailure,
    Process,
    StartValues,
    StepSize,
)
from ...variables.model_description import ModelDescription
from ...variables.value_types import PlainValue

__all__ = ["ClassPlace", "PythonConfig", "class_place_of", "importing"]

importing: ContextVar[str | None] = ContextVar("importing", default=None)
"""The file or module that this thread imports as a component just now. Whoever starts a run looks here first.

A program that starts a run at its top, without `if __name__ == "__main__":`, would otherwise start it again in each
process that imports a component of that program.
"""


class ClassPlace(NamedTuple):
    """Where a component class is."""

    file: str  # the file, as it is written; empty if a module is named
    module: str  # the name of an installed module; empty if a file is named
    name: str  # the class; empty if none is named


def class_place_of(text: str) -> ClassPlace:
    """What `controller.py:Controller` or `package.module:Controller` names.

    Example:
        >>> class_place_of("controller.py:Controller").file, class_place_of("package.module:Controller").module
        ('controller.py', 'package.module')
    """
    place, _, name = text.rpartition(":")
    if not place:
        place, name = text, ""
    is_file = place.endswith(".py") or "/" in place
    return ClassPlace(place if is_file else "", "" if is_file else place, name)


class PythonConfig(Base, InstanceSection, frozen=True, kw_only=True, tag_field=KIND, tag="python"):
    """A component in Python: a class that derives from `fmu_mesh.Component`."""

    python: Annotated[
        str,
        Meta(
            description="The class: `controller.py:Controller`, relative to this file, or `package.module:Controller`."
        ),
    ]
    interpreter: Annotated[
        str | None,
        Meta(description="The Python that runs it, with fmu-mesh installed; default: the one that runs fmu-mesh."),
    ] = None
    arguments: Annotated[
        dict[str, PlainValue | None], Meta(description="The arguments that the class is called with, by name.")
    ] = {}
    start_values: StartValues = {}
    inputs: Inputs = {}
    interpolation: Annotated[
        Literal["hold", "linear"] | None,
        Meta(description="How a value with a time is used for an unconnected input; default: from the next step."),
    ] = None
    step_size: StepSize = None
    group: Group = None
    host: Host = None
    not_finite: NotFinitePolicy = None
    on_failure: OnFailure = "stop"
    process: Process = None
    extrapolation: ExtrapolationOfInputs = None
    feedthrough: Feedthrough = None

    names_code = True

    @property
    def path(self) -> str:
        """The file of the class; empty for a module."""
        return class_place_of(self.python).file

    def agreed(self) -> Self:
        """The section without the file and the interpreter, which may be elsewhere on each host."""
        target = class_place_of(self.python)
        return replace(self, python=f"{target.module}:{target.name}", interpreter=None)

    def summary(self, description: ModelDescription) -> str:
        """The class, and where it runs."""
        own = f", {self.interpreter}" if self.interpreter is not None else ""
        return f"class {description.model_name}{own}"
