"""Programs that take part in a mesh as instances: the section of a configuration, and the kind.

In a configuration: `importer: {outside: {inputs: {...}, outputs: {...}}}`. `docs/outside.md` says what a program does.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from ...config.base import Base
from ...config.findings import Findings
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
    StartValues,
    StepSize,
)
from ...config.mesh import LimitsConfig
from ...errors import LoadFailed
from ...variables.model_description import ModelDescription, Variable
from ...variables.value_conversion import ValueRefused, to_value
from ...variables.value_types import PlainValue, is_float, nested, zero
from ..contract import Instance, Kind, Opening

__all__ = ["KIND_OF_OUTSIDE_PROGRAMS", "OutsideConfig", "OutsideVariableConfig", "OutsideVariablesConfig"]

_NAME_BYTES = 255

OutsideType = Literal[
    "Float64",
    "Float32",
    "Int8",
    "UInt8",
    "Int16",
    "UInt16",
    "Int32",
    "UInt32",
    "Int64",
    "UInt64",
    "Boolean",
    "String",
]


class OutsideVariableConfig(Base, frozen=True, kw_only=True):
    """A variable of the program."""

    type: Annotated[OutsideType, Meta(description="Its type, in the words of FMI 3.0.")] = "Float64"
    shape: Annotated[list[Annotated[int, Meta(ge=1)]], Meta(description="Sizes of an array; empty: a scalar.")] = []
    unit: Annotated[str | None, Meta(description="Its unit, as in a model description.")] = None
    description: Annotated[str | None, Meta(description="What it is.")] = None
    start: Annotated[
        PlainValue | None,
        Meta(description="Its value until somebody sets another one; null: 0, false or an empty text."),
    ] = None


class OutsideVariablesConfig(Base, frozen=True, kw_only=True):
    """The variables of a program that takes part in the mesh."""

    inputs: Annotated[dict[str, OutsideVariableConfig], Meta(description="What it reads from the mesh, by name.")] = {}
    outputs: Annotated[dict[str, OutsideVariableConfig], Meta(description="What it sets in the mesh, by name.")] = {}

    def __str__(self) -> str:
        return "a program that attaches"


class OutsideConfig(Base, InstanceSection, frozen=True, kw_only=True, tag_field=KIND, tag="outside"):
    """A program that we do not start: it attaches, sets the outputs and takes the steps."""

    outside: Annotated[OutsideVariablesConfig, Meta(description="Its variables.")]
    start_values: StartValues = {}
    inputs: Inputs = {}
    step_size: StepSize = None
    group: Group = None
    host: Host = None
    not_finite: NotFinitePolicy = None
    on_failure: OnFailure = "stop"
    extrapolation: ExtrapolationOfInputs = None
    feedthrough: Feedthrough = None

    waits_for_program = True

    @property
    def path(self) -> str:
        """Empty: there is no file."""
        return ""

    def check(self, place: str, description: ModelDescription, findings: Findings) -> None:
        """Add a finding for a host: program and node share memory."""
        if self.host is not None:
            findings.add(f"{place}.host", f"'{self.host}'", "no host: the program attaches on the host of `launch`")


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
