"""Programs that take part in a mesh as instances, as a kind of instances.

In a configuration: `importer: {outside: {inputs: {...}, outputs: {...}}}`. `docs/outside.md` says what a program does.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import msgspec

from ...config.mesh import LimitsConfig
from ...errors import LoadFailed
from ...variables.model_description import ModelDescription, Variable
from ...variables.value_conversion import ValueRefused, to_value
from ...variables.value_types import is_float, nested, zero
from ..contract import Instance, Kind, Opening
from .outside_section import OutsideConfig, OutsideVariableConfig

__all__ = ["KIND_OF_OUTSIDE_PROGRAMS"]

_NAME_BYTES = 255


class OutsideKind(Kind[OutsideConfig]):
    """Programs that attach to a running mesh."""

    section = OutsideConfig
    expected = "the variables of a program"

    def describe(
        self, path: Path, section: OutsideConfig, limits: LimitsConfig, tell: Callable[[str], None]
    ) -> ModelDescription:
        """The variables are those that the section names."""
        own = section.outside
        if twice := own.inputs.keys() & own.outputs.keys():
            raise LoadFailed(f"'{min(twice)}' is an input and an output", hint="Give each variable a name of its own.")
        named = [*own.inputs.items(), *own.outputs.items()]
        variables = tuple(_variable(n, *item, is_output=n >= len(own.inputs)) for n, item in enumerate(named))
        return ModelDescription(
            model_name="outside",
            model_identifier="outside",
            fmi_version="",
            kind="program",
            guid=hashlib.sha256(msgspec.json.encode(own)).hexdigest(),
            variables=variables,
            not_repeatable="a program outside of the mesh takes part",
        )

    def content(self, path: Path) -> str:
        """Empty: there is no file."""
        return ""

    def open(self, opening: Opening[OutsideConfig]) -> Instance:
        """Make the socket and the memory; the program attaches later."""
        from .outside_instance import OutsideInstance  # noqa: PLC0415  only where there is such an instance

        return OutsideInstance(opening)


def _variable(reference: int, name: str, own: OutsideVariableConfig, *, is_output: bool) -> Variable:
    if not name or len(name.encode()) > _NAME_BYTES:
        raise LoadFailed(f"the name of a variable has 1 to {_NAME_BYTES} bytes, and '{name[:40]}' has not")
    if own.type == "String" and own.shape:
        raise LoadFailed(f"'{name}' is an array of String", hint="Use several variables.")
    shape = tuple(own.shape)
    variable = Variable(
        name=name,
        value_reference=reference,
        type=own.type,
        causality="output" if is_output else "input",
        variability="continuous" if is_float(own.type) else "discrete",
        initial="exact" if is_output else None,
        unit=own.unit,
        description=own.description,
        dependencies=() if is_output else None,
        feedthrough=() if is_output else None,
        dimensions=shape,
        shape=shape,
    )
    if own.start is None:
        elements = [zero(own.type)] * variable.size
        return msgspec.structs.replace(variable, start=nested(elements, shape) if shape else elements[0])
    try:
        return msgspec.structs.replace(variable, start=to_value(own.start, variable))
    except ValueRefused as refused:
        raise LoadFailed(f"the start value of '{name}': {refused}") from refused


KIND_OF_OUTSIDE_PROGRAMS = OutsideKind()  # what the entry point `outside` names
