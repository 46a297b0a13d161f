"""Which inputs follow the line of their source within a step (`extrapolation`), and which kinds support that.

What they get is `fmu_mesh.system.coupling_rule`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
from msgspec.structs import replace

from ..config.findings import Findings
from ..config.instance_sections import Extrapolation, InstanceSection
from ..config.mesh import Config
from ..text import counted
from ..variables.model_description import ModelDescription
from .connections import Connection
from .coupling_rule import CouplingRule
from .solved_groups import blocks_of, is_solved

__all__ = ["LinearInput", "counted_ways", "with_extrapolation"]


class LinearInput(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An input that follows the line of its source within a step: as a line, or with the value in its middle.

    Attributes:
        rule: that of its connection.
        ends: whether the row of outputs has the input, and gets its value at the end of the step.
    """

    name: str
    rule: CouplingRule
    ends: bool = False

    def latest(self, step: int) -> int:
        """The point of the row of the source that own step ``step`` gets."""
        return self.rule.row_for(step) * self.rule.source_points


def with_extrapolation(
    config: Config,
    connections: Sequence[Connection],
    descriptions: Mapping[str, ModelDescription],
    findings: Findings,
) -> tuple[Connection, ...]:
    """The connections with their ways of extrapolation; a finding for every way that a target does not support.

    What is said for an instance or for all holds for the inputs that can change within a step. Within a solved group,
    it is `linear` where the target takes that: its line ends at the value that is solved.
    """
    found, blocks = [], blocks_of(config.members)
    for c in connections:
        own, target = c.extrapolation, config.instances[c.target_instance]
        general, place = target.extrapolation, f"instances.{c.target_instance}.extrapolation"
        if general is None:
            general, place = config.simulation.extrapolation, "simulation.extrapolation"
        solved = is_solved(c, blocks)
        if solved and own is not None:
            findings.add(f"{c.path}.extrapolation", f"{own} for {c}, within a group that is solved", "none")
        wanted: Extrapolation = "auto" if solved else own or general
        description = descriptions[c.target_instance]
        why_held, why_not_linear = _why_held(c), _why_not_linear(c, description, retries=target.retries_steps)
        way: Extrapolation = wanted
        if wanted == "auto":
            way = _auto(why_held, why_not_linear)
        elif wanted != "hold" and why_held is not None and own is None:
            way = "hold"
        elif (why := why_held or (why_not_linear if wanted == "linear" else None)) is not None and wanted != "hold":
            expected = "hold" if why_held else "hold, midpoint or auto"
            findings.add(f"{c.path}.extrapolation" if own else place, f"{wanted} for {c}, but {why}", expected)
        found.append(replace(c, extrapolation=way))
    return tuple(found)


def counted_ways(
    connections: Sequence[Connection],
    descriptions: Mapping[str, ModelDescription],
    sections: Mapping[str, InstanceSection],
) -> str:
    """In words what `auto` would be for the inputs that are held now; empty, if it would hold them, too."""
    found: dict[Extrapolation, int] = {"linear": 0, "midpoint": 0}
    for c in connections:
        retries = sections[c.target_instance].retries_steps
        way = _auto(_why_held(c), _why_not_linear(c, descriptions[c.target_instance], retries=retries))
        if c.extrapolation == "hold" and way in found:
            found[way] += 1
    return ", ".join(f"{way} for {counted(number, 'input')}" for way, number in found.items() if number)


def _auto(why_held: str | None, why_not_linear: str | None) -> Extrapolation:
    if why_held is not None:
        return "hold"
    return "linear" if why_not_linear is None else "midpoint"


def _why_held(connection: Connection) -> str | None:
    """Why an input cannot change within a step; None if it can."""
    target = connection.target
    if target.type != "Float64" or target.shape or connection.target_index:
        return f"'{target.name}' is no scalar Real input"
    if connection.initial_only:
        return f"'{target.name}' is a parameter"
    if target.variability != "continuous":
        return f"'{target.name}' is a {target.variability} input"
    return None


def _why_not_linear(connection: Connection, description: ModelDescription, *, retries: bool) -> str | None:
    """Why an instance cannot take the derivative of an input; None if it can."""
    if description.kind == "model_exchange":
        return None
    if not description.fmi_version:
        reason = f"'{connection.target_instance}' takes no input derivatives"
    elif description.fmi_version.startswith("3."):
        reason = "co-simulation in FMI 3.0 takes no input derivatives (it would run as model exchange)"
    elif not description.can_interpolate_inputs:
        reason = f"the FMU of '{connection.target_instance}' does not interpolate inputs (canInterpolateInputs)"
    elif retries:
        reason = "discarded steps of its target are retried, and a part of a step has no input derivatives of its own"
    else:
        return None
    return reason
