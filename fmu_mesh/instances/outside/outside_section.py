"""The section of a program outside in a configuration."""

from __future__ import annotations

from typing import Annotated, Literal

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
from ...variables.model_description import ModelDescription
from ...variables.value_types import PlainValue

__all__ = ["OutsideConfig", "OutsideVariableConfig", "OutsideVariablesConfig"]

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
