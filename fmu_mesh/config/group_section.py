"""The key `group` of an instance: which instances share a process, and how those of a group are solved together."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Annotated, Literal, NamedTuple

from msgspec import Meta

from fmu_mesh.config.base import POSITIVE, Base, Name
from fmu_mesh.config.findings import Findings

__all__ = [
    "Group",
    "GroupConfig",
    "GroupedInstance",
    "Members",
    "StepControlConfig",
    "group_name",
    "solved_groups_of",
]


class StepControlConfig(Base, frozen=True, kw_only=True):
    """Smaller steps between two points, where the values that the members exchange bend."""

    tolerance: Annotated[
        float,
        Meta(
            description="How far the line of an exchanged value may be from its course within a step, relative to the "
            "larger of 1 and its size.",
            extra_json_schema=POSITIVE,
        ),
    ] = 1e-4


class GroupConfig(Base, frozen=True, kw_only=True):
    """A group and how its members are solved. One member has it, and the others have the name."""

    name: Annotated[Name, Meta(description="The name of the group.")]
    solve: Annotated[
        Literal["newton"] | None,
        Meta(
            description="newton: the values that the members exchange are solved at every point, by steps that are "
            "taken again from saved states; null: they are exchanged as between other instances."
        ),
    ] = None
    tolerance: Annotated[
        float,
        Meta(
            description="How far these values may be from each other, relative to the larger of 1 and their size.",
            extra_json_schema=POSITIVE,
        ),
    ] = 1e-8
    step_control: Annotated[
        StepControlConfig | None,
        Meta(description="Smaller steps between two points where they are needed; null: one step for each point."),
    ] = None


Group = Annotated[
    Name | GroupConfig | None,
    Meta(description="Instances of one group share one node (one process); or its name and how it is solved."),
]


class GroupedInstance(NamedTuple):
    """What of an instance matters to its group: the key, its step size in s, and whether a failure does not end it."""

    group: str | GroupConfig | None
    step_size: float
    holds: bool


Members = Mapping[str, GroupedInstance]
"""All instances by name, whatever their groups."""


def group_name(group: str | GroupConfig | None) -> str | None:
    """The name of the group that an instance has."""
    return group.name if isinstance(group, GroupConfig) else group


def solved_groups_of(
    members: Mapping[str, GroupedInstance], findings: Findings | None = None
) -> dict[str, GroupConfig]:
    """The groups that are solved, by name; a finding for each member that says something else than one before it."""
    found: dict[str, tuple[str, GroupConfig]] = {}
    for name, member in members.items():
        own, place = member.group, f"instances.{name}.group"
        if not isinstance(own, GroupConfig):
            continue
        first, known = found.setdefault(own.name, (place, own))
        if findings is None:
            continue
        if known != own:
            what = f"other settings for the group '{own.name}' than `{first}` has"
            findings.add(place, what, f"`group: {own.name}`, or the settings at one member only")
        tolerances = {"tolerance": own.tolerance}
        tolerances |= {"step_control.tolerance": own.step_control.tolerance} if own.step_control is not None else {}
        for key, value in tolerances.items():
            if not (isfinite(value) and value > 0.0):
                findings.add(f"{place}.{key}", f"{value:g}", "a number > 0")
        if own.step_control is not None and own.solve is None:
            findings.add(f"{place}.step_control", "step control in a group that is not solved", "`solve: newton`")
    return {name: own for name, (_, own) in found.items() if own.solve is not None}
