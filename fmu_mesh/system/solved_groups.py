"""Groups that are solved (`group: {name: g, solve: newton}`): what their members exchange, and what they have to be.

How they are solved is `fmu_mesh.instances.tight_group`. A solved group is one unit of a node: all its members step at
once. So it is one vertex where the order of instances and the delays are chosen (`Blocks`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import msgspec

from ..config.findings import Findings
from ..config.group_section import GroupConfig, GroupedInstance, Members, group_name, solved_groups_of
from ..text import listed
from ..variables.model_description import ModelDescription
from .connections import Connection
from .consistent_outputs import Feedthrough, element_pairs

__all__ = [
    "Blocks",
    "SolvedGroup",
    "Unknown",
    "blocks_of",
    "check_solved_groups",
    "is_solved",
    "solved_groups",
    "within_block",
]

Blocks = Mapping[str, str]
"""By the name of a member of a solved group: the first member of the group, in the order of the file."""


class Unknown(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A Float64 input that a member gets from a member: its value at the end of a step is solved.

    Attributes:
        target: the instance that has the ``input``, which may be an element of an array; ``source`` and ``output``
            likewise.
    """

    target: str
    input: str
    source: str
    output: str
    factor: float
    offset: float

    def __str__(self) -> str:
        return f"{self.target}.{self.input}"


class SolvedGroup(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A group that is solved.

    Attributes:
        members: the instances in the order of the plan; the step of the first one is that of all.
        tolerance: how far an unknown may be from what its output gives, relative to the larger of 1 and its size.
        step_tolerance: how far a line may be from its course within a step, relative likewise; None: no step control.
        feedthrough: by member, output and input: how the output changes with an input that is constant over a step.
    """

    name: str
    members: tuple[str, ...]
    unknowns: tuple[Unknown, ...]
    tolerance: float
    step_tolerance: float | None
    feedthrough: dict[str, dict[str, dict[str, float]]]


def blocks_of(members: Members) -> Blocks:
    """The solved groups of a configuration."""
    solved, first, found = solved_groups_of(members), dict[str, str](), dict[str, str]()
    for name, member in members.items():
        if (group := group_name(member.group)) in solved:
            found[name] = first.setdefault(str(group), name)
    return found


def is_solved(connection: Connection, blocks: Blocks) -> bool:
    """Whether the values of a connection are unknowns of a solved group."""
    c = connection
    floats = c.source.type == c.target.type == "Float64" and c.target.variability == "continuous"
    return floats and within_block(c, blocks) and not c.map


def within_block(connection: Connection, blocks: Blocks) -> bool:
    """Whether both ends of a connection are members of one solved group."""
    block = blocks.get(connection.source_instance)
    return block is not None and block == blocks.get(connection.target_instance) and not connection.initial_only


def solved_groups(
    configured: Members,
    connections: Sequence[Connection],
    order: Sequence[str],
    feedthrough: Feedthrough,
) -> tuple[SolvedGroup, ...]:
    """The solved groups of a plan with these connections and this order of instances."""
    blocks, found = blocks_of(configured), list[SolvedGroup]()
    for group, own in solved_groups_of(configured).items():
        members = tuple(name for name in order if group_name(configured[name].group) == group)
        inner = [c for c in connections if c.target_instance in members and is_solved(c, blocks)]
        unknowns = tuple(
            Unknown(c.target_instance, target, c.source_instance, source, c.factor, c.offset)
            for c in inner
            for source, target in element_pairs(c)
        )
        held = {
            (c.target_instance, target) for c in inner if c.extrapolation != "linear" for _, target in element_pairs(c)
        }
        direct = {
            name: {
                output: {one: value for one, value in inputs.items() if (name, one) in held and value}
                for output, inputs in feedthrough.get(name, {}).items()
            }
            for name in members
        }
        control = own.step_control.tolerance if own.step_control is not None else None
        found.append(SolvedGroup(group, members, unknowns, own.tolerance, control, direct))
    return tuple(found)


def check_solved_groups(
    configured: Members,
    descriptions: Mapping[str, ModelDescription],
    connections: Sequence[Connection],
    findings: Findings,
) -> None:
    """Add a finding for each member that cannot be in a group that is solved, and for each group without unknowns."""
    groups, blocks = solved_groups_of(configured, findings), blocks_of(configured)
    for group, own in groups.items():
        members = [name for name in descriptions if group_name(configured[name].group) == group]
        sizes = {name: configured[name].step_size for name in members}
        if len({*sizes.values()}) > 1:
            shown = listed([f"{size:g} s of '{name}'" for name, size in sizes.items()])
            findings.add(
                f"instances.{members[0]}.group",
                f"'{group}' is solved, and has the step sizes {shown}",
                "one for all members",
            )
        for name in members:
            for key, found, expected in _why_not(name, configured[name], descriptions[name], own):
                findings.add(f"instances.{name}.{key}", f"{found}, in the group '{group}', which is solved", expected)
        inner = [c for c in connections if within_block(c, blocks) and c.target_instance in members]
        for c in inner:
            if c.delay == 0:
                findings.add(f"{c.path}.delay", f"0 for {c}, within the group '{group}', which is solved", "no `delay`")
        if members and not any(is_solved(c, blocks) for c in inner):
            found = f"nothing to solve in '{group}': no continuous Float64 input of a member comes from a member"
            findings.add(f"instances.{members[0]}.group", found, "such connections, or no `solve`")


def _why_not(
    name: str, member: GroupedInstance, description: ModelDescription, own: GroupConfig
) -> Iterator[tuple[str, str, str]]:
    """What prevents that an instance is a member: the key, what was found, and what is expected."""
    version = description.fmi_version
    if not description.can_get_and_set_state:
        flag = f"canGetAndSetFMU{'s' if version[:1] == '2' else 'S'}tate"
        why = "FMI 1.0 has no states" if version[:1] == "1" else f"its model description does not have {flag}"
        yield "group", f"'{name}' has no state to go back to ({why})", "another group, or one without `solve`"
    if member.holds:
        yield "on_failure", "an instance whose outputs are held after a failure", "stop"
    fixed = version and description.kind == "co_simulation" and not description.can_handle_variable_step_size
    if own.step_control is not None and (fixed or (not version and description.fixed_step_size is not None)):
        flag = " (canHandleVariableCommunicationStepSize)" if version else ""
        yield "group", f"step control, while '{name}' cannot vary its step size{flag}", "no `step_control`"
