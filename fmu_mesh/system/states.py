"""States of a system that outlive its process: what must agree where one is restored, and with which a run begins.

Owns no file and no state; those are `fmu_mesh.run.state_file` and the instances.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from types import MappingProxyType

import msgspec

from ..config.instance_sections import placed
from ..text import counted, shown
from ..variables.value_conversion import to_plain
from ..variables.value_types import PlainValue
from .plan import Plan
from .start_values import why_not_settable

__all__ = ["BeginsWith", "SavedInstance", "differences", "saved_instances"]

_DIGITS = 16
_OF_MODEL = ("kind", "model", "variables", "options")


class SavedInstance(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a state says about the instance that it is of.

    Attributes:
        agreed: what must be equal where it is restored, by its name: in words, or a hash.
        start_values: those that were given, by variable.
    """

    agreed: dict[str, str]
    start_values: dict[str, PlainValue]


class BeginsWith(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The states with which a run begins, at the first point of its grid.

    Attributes:
        states: that of each instance.
        set_again: the start values that are others now, by instance and variable.
        anew: of each instance of the mesh that begins anew there, what its scenario has set by then.
    """

    states: dict[str, bytes] = {}
    set_again: dict[str, dict[str, PlainValue]] = {}
    anew: dict[str, dict[str, PlainValue]] = {}

    def only(self, names: Iterable[str]) -> BeginsWith:
        """What these instances need."""
        known = {*names}
        return BeginsWith(
            {name: state for name, state in self.states.items() if name in known},
            {name: values for name, values in self.set_again.items() if name in known},
            self.anew,
        )


def saved_instances(
    plan: Plan, contents: Mapping[str, str], others: Mapping[str, Mapping[str, PlainValue]] = MappingProxyType({})
) -> dict[str, SavedInstance]:
    """What a state of this plan says, by instance.

    ``contents`` is the SHA-256 of each model, and ``others`` are the start values that are not as in the plan.
    """
    found = {}
    ends = [(c.source_instance, c.source.name) for c in plan.connections]
    ends += [(c.target_instance, c.target.name) for c in plan.connections]
    for name, own in plan.system.instances.items():
        described = own.description
        fed = [
            (c.source_instance, c.source_name, c.target_name, c.delay, c.factor, c.offset, repr(c.map), c.extrapolation)
            for c in plan.connections
            if c.target_instance == name
        ]
        used = {schedule.variable for schedule in own.scenario} | {variable for end, variable in ends if end == name}
        agreed = {
            "kind": f"{described.kind} {described.fmi_version}".strip(),
            "step": counted(own.step_points, "point") + (" ahead" if name in plan.ahead else ""),
            "model": _hash((contents.get(name, ""), described.guid)),
            "variables": _hash([(v.name, v.type, v.shape, v.causality, v.variability) for v in described.variables]),
            "options": _hash(placed(plan.system.config.instances[name]).agreed()),
            "connections": _hash(fed),
            "values over time": _hash([schedule.agreed() for schedule in own.scenario]),
            "timeouts": _hash(own.timeouts),
        }
        if groups := [group for group in plan.groups if name in group.members]:
            agreed["group"] = _hash(groups)
        if plan.consistent:
            feeds = plan.nodes[own.node].instance(name).step_feeds
            agreed["consistent outputs"] = _hash([(feed.source, feed.rule.delay, feed.columns) for feed in feeds])
        agreed |= {
            f"variable '{v.name}'": f"{v.type}{[*v.shape] if v.shape else ''} {v.causality}"
            for v in described.variables
            if v.name in used
        }
        given = {variable: to_plain(value) for variable, value in own.start_values.items()}
        found[name] = SavedInstance(agreed, given | dict(others.get(name, {})))
    return found


def differences(
    saved: Mapping[str, SavedInstance], plan: Plan, contents: Mapping[str, str]
) -> tuple[list[tuple[str, str]], dict[str, dict[str, PlainValue]]]:
    """What differs between the mesh of a state and that of a plan; of an instance that is replaced, its interface.

    Returns:
        Why the state cannot be restored: instances, and what differs, in words. And the start values that differ and
        can be set between two steps, by instance and variable: of tunable parameters, and of inputs that are free.
    """
    own, set_again = saved_instances(plan, contents), dict[str, dict[str, PlainValue]]()
    replaced = plan.system.replaced
    refused = [(name, "the mesh has no such instance") for name in saved if name not in own]
    for name, there in own.items():
        if name not in saved:
            refused.append((name, "the state has no such instance"))
            continue
        for what, now in there.agreed.items():
            if name in replaced and what in _OF_MODEL:
                continue
            if (was := saved[name].agreed.get(what, "not known")) != now:
                refused.append((name, f"{what}: {now} here, and {was} in the state"))
        before = there.start_values if name in replaced else saved[name].start_values
        for variable, value, why in _start_values(plan, name, before, there.start_values):
            if why:
                refused.append((name, why))
            else:
                set_again.setdefault(name, {})[variable] = value
    return refused, set_again


def _start_values(
    plan: Plan, name: str, saved: Mapping[str, PlainValue], own: Mapping[str, PlainValue]
) -> Iterator[tuple[str, PlainValue, str]]:
    """The variables with another start value: the new value, and why it cannot be set later, empty if it can."""
    instance, sources = plan.system.instances[name], plan.nodes[plan.node_of(name)].instance(name).sources
    prescribed = {schedule.variable for schedule in instance.scenario}
    for variable in instance.description.variables:
        if variable.name not in own and variable.name not in saved:
            continue
        default = to_plain(variable.start) if variable.start is not None else ""
        was, now = saved.get(variable.name, default), own.get(variable.name, default)
        if repr(was) == repr(now):
            continue
        why = why_not_settable(variable, sources.get(variable.name))
        why = "has values over time" if variable.name in prescribed else why
        yield variable.name, now, f"'{variable.name}' is {shown(now)}, was {shown(was)}, and {why}" if why else ""


def _hash(value: object) -> str:
    return hashlib.sha256(msgspec.json.encode(value, order="deterministic")).hexdigest()[:_DIGITS]
