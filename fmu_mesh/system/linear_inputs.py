"""Inputs that change linearly within a step (`extrapolation: linear`): which there are, which kinds support them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import msgspec

from ..config.findings import Findings
from ..variables.model_description import ModelDescription
from .connections import Connection

__all__ = ["LinearInput", "check_extrapolation"]


class LinearInput(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An input that changes linearly within a step.

    Attributes:
        delay: that of its connection: 0 or 1.
        source_points: base points per step of its source.
    """

    name: str
    delay: int
    source_points: int = 1


def check_extrapolation(
    connections: Sequence[Connection],
    retrying: Collection[str],
    descriptions: Mapping[str, ModelDescription],
    findings: Findings,
) -> None:
    """Add a finding for every `extrapolation: linear` whose target cannot take the derivative of an input.

    Discarded steps of the ``retrying`` instances are retried.
    """
    for connection in connections:
        if connection.extrapolation == "linear":
            target = connection.target_instance
            reason = _cannot_extrapolate(connection, descriptions[target], retries=target in retrying)
            if reason is not None:
                found = f"linear for {connection}, but {reason}"
                findings.add(f"{connection.path}.extrapolation", found, "hold")


def _cannot_extrapolate(connection: Connection, description: ModelDescription, *, retries: bool) -> str | None:
    target = connection.target
    if target.type != "Float64" or target.shape or connection.target_index:
        return f"'{target.name}' is no scalar Real input"
    if connection.initial_only:
        return f"'{target.name}' is a parameter"
    if target.variability != "continuous":
        return f"'{target.name}' is a {target.variability} input"
    if description.kind == "model_exchange":
        return None
    if description.fmi_version.startswith("3."):
        reason = "co-simulation in FMI 3.0 takes no input derivatives (it would run as model exchange)"
    elif not description.can_interpolate_inputs:
        reason = f"the FMU of '{connection.target_instance}' does not interpolate inputs (canInterpolateInputs)"
    elif retries:
        reason = "discarded steps of its target are retried, and a part of a step has no input derivatives of its own"
    else:
        return None
    return reason
