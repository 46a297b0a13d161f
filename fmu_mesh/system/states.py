"""States of a system that outlive its process: which instances have one, and what must agree where one is restored.

Owns no file and no state; those are `fmu_mesh.run.state_file` and the instances.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import msgspec

from ..config.instance_sections import placed
from ..text import counted, listed, shown
from ..variables.value_conversion import to_plain
from ..variables.value_types import PlainValue
from .plan import Plan
from .start_values import why_not_settable
from .system import ResolvedSystem

__all__ = ["AgreedInstance", "BeginsWith", "Differences", "agreed_of", "differences", "stateless"]

_HASHES = {
    "variables": "variables",
    "options": "options",
    "connections": "connections",
    "scenario": "values over time",
    "timeouts": "timeouts",
}


class AgreedInstance(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a state says about the instance that it is of.

    Attributes:
        model: a hash of the SHA-256 of its files, and of its GUID.
        kind: such as `co_simulation 2.0`.
        step: its own step in base points.
        variables, options, connections, scenario, timeouts: a hash of each.
        start_values: those that were given, by variable.
    """

    model: str
    kind: str
    step: int
    variables: str
    options: str
    connections: str
    scenario: str
    timeouts: str
    start_values: dict[str, PlainValue]


class BeginsWith(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The states with which a run begins, at the first point of its grid.

    Attributes:
        states: that of each instance.
        set_again: the start values that are others now, by instance and variable.
    """

    states: dict[str, bytes] = {}
    set_again: dict[str, dict[str, PlainValue]] = {}

    def only(self, names: Iterable[str]) -> BeginsWith:
        """What these instances need."""
        known = {*names}
        return BeginsWith(
            {name: state for name, state in self.states.items() if name in known},
            {name: values for name, values in self.set_again.items() if name in known},
        )


class Differences(NamedTuple):
    """What differs between a state and a mesh: why it cannot be restored, in words, and values that can be set."""

    refused: list[tuple[str, str]]  # the instance, and a sentence about it without its name
    set_again: dict[str, dict[str, PlainValue]]  # by instance and variable


def stateless(system: ResolvedSystem, *, keys: bool = True) -> dict[str, str]:
    """The instances whose state cannot outlive their process, and why, as the end of a sentence.

    With ``keys``, inputs get the values of their Zenoh keys, as in processes.
    """
    found = {}
    for name, own in system.instances.items():
        why = system.config.instances[name].stateless(own.description)
        if why is None and keys and own.keys_in:
            why = (
                f"keys of Zenoh give values to {listed([key.variable for key in own.keys_in])}, and these have no past"
            )
        if why is not None:
            found[name] = why
    return found


def agreed_of(plan: Plan, contents: Mapping[str, str]) -> dict[str, AgreedInstance]:
    """What a state of this plan says, by instance; ``contents`` is the SHA-256 of each model."""
    found = {}
    for name, own in plan.system.instances.items():
        described = own.description
        fed = [
            (c.source_instance, c.source_name, c.target_name, c.delay, c.factor, c.offset, repr(c.map), c.extrapolation)
            for c in plan.connections
            if c.target_instance == name
        ]
        found[name] = AgreedInstance(
            model=_hash((contents.get(name, ""), described.guid)),
            kind=f"{described.kind} {described.fmi_version}".strip(),
            step=own.step_points,
            variables=_hash([(v.name, v.type, v.shape, v.causality, v.variability) for v in described.variables]),
            options=_hash(placed(plan.system.config.instances[name]).agreed()),
            connections=_hash(fed),
            scenario=_hash([schedule.agreed() for schedule in own.scenario]),
            timeouts=_hash(own.timeouts),
            start_values={variable: to_plain(value) for variable, value in own.start_values.items()},
        )
    return found


def differences(saved: Mapping[str, AgreedInstance], plan: Plan, contents: Mapping[str, str]) -> Differences:
    """What differs between the mesh of a state and that of a plan.

    Start values may differ where they can be set between two steps: tunable parameters, and inputs that are free.
    """
    found, own = Differences([], {}), agreed_of(plan, contents)
    found.refused.extend((name, "the mesh has no such instance") for name in saved if name not in own)
    for name, there in own.items():
        if (before := saved.get(name)) is None:
            found.refused.append((name, "the state has no such instance"))
            continue
        told = [
            ("kind", before.kind, there.kind),
            ("step", counted(before.step, "point"), counted(there.step, "point")),
        ]
        wrong = [f"its {what} was {was} and is {now}" for what, was, now in told if was != now]
        if before.model != there.model:
            wrong.append("its model is another one: the SHA-256 of its files, or its GUID, differs")
        else:
            wrong += [
                f"its {said} differ" for what, said in _HASHES.items() if getattr(before, what) != getattr(there, what)
            ]
            wrong += _start_values(plan, name, before, found.set_again)
        found.refused.extend((name, why) for why in wrong)
    return found


def _start_values(
    plan: Plan, name: str, saved: AgreedInstance, set_again: dict[str, dict[str, PlainValue]]
) -> list[str]:
    """Note the start values that differ and can be set; the others, in words."""
    own, item, wrong = plan.system.instances[name], plan.nodes[plan.node_of(name)].instance(name), []
    prescribed = {schedule.variable for schedule in own.scenario}
    for variable_name in dict.fromkeys([*saved.start_values, *own.start_values]):
        variable = own.description.variable(variable_name)
        default = to_plain(variable.start) if variable is not None and variable.start is not None else None
        given = own.start_values.get(variable_name)
        was, now = saved.start_values.get(variable_name, default), default if given is None else to_plain(given)
        if variable is None or repr(was) == repr(now):
            continue
        refusal = why_not_settable(variable, item.sources.get(variable_name))
        why = "it has values over time" if variable_name in prescribed else refusal and f"it {refusal}"
        if why is None and now is not None:
            set_again.setdefault(name, {})[variable_name] = now
        else:
            wrong.append(f"its start value of '{variable_name}' was {shown(was)} and is {shown(now)}, and {why}")
    return wrong


def _hash(value: object) -> str:
    return hashlib.sha256(msgspec.json.encode(value, order="deterministic")).hexdigest()
