"""The plans of a system that a program resets: each with the start values of one reset.

Owns what a reset may change: values, and nothing else. A reset takes less time than a plan, so a plan is made once for
the names of the start values that are given; other values for these names are checked here, by the same rules.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from msgspec.structs import replace

from ..system.plan import InstancePlan, Plan
from ..variables.model_description import ModelDescription, Value
from ..variables.value_conversion import ValueRefused, to_plain, to_value
from ..variables.value_types import PlainValue
from .preparing import KnownModels, check_reset, planned_reset
from .run_plan import RunPlan

__all__ = ["ResetPlans"]


class ResetPlans:
    """Plans of one run.

    Args:
        run: the run as it was opened.
        plan: plans it again, with these start values besides; None: from the configuration of the run.

    Attributes:
        first: its plan.
    """

    def __init__(self, run: RunPlan, plan: Callable[[Mapping[str, Any]], RunPlan] | None) -> None:
        self._run = run
        self._plan_again = plan or self._planned
        self._plans: dict[frozenset[str], Plan] = {}
        self.first = run.plan

    def plan(self, start_values: Mapping[str, Any]) -> Plan:
        """The plan with the start values of the run and these, by `instance.variable`.

        Raises:
            ConfigurationError: a start value is wrong, or changes the size of an array; carries all findings.
        """
        if not start_values:
            return self.first
        names = frozenset(start_values)
        if (before := self._plans.get(names)) is not None and (plan := _with_values(before, start_values)) is not None:
            return plan
        again = self._plan_again(start_values)
        check_reset(self._run, again)
        self._plans[names] = plan = again.plan
        return plan

    def _planned(self, start_values: Mapping[str, Any]) -> RunPlan:
        return planned_reset(self._run, start_values, 0, KnownModels.of(self._run))


def _with_values(plan: Plan, start_values: Mapping[str, Any]) -> Plan | None:
    """The plan with other values for these names; None where more follows from them, or one is wrong."""
    system = plan.system
    if plan.initialization.loops or system.config.scenario is not None:
        return None
    changed: dict[str, dict[str, PlainValue]] = {}
    for full, plain in start_values.items():
        name, _, variable = full.partition(".")
        node = plan.nodes[plan.node_of(name)]
        value = _value(plain, variable, node.instance(name), system.instances[name].description)
        if value is None:
            return None
        changed.setdefault(name, {})[variable] = to_plain(value)
    nodes = dict(plan.nodes)
    for name, values in changed.items():
        node = nodes[plan.node_of(name)]
        instances = tuple(
            replace(own, start_values=own.start_values | values) if own.name == name else own for own in node.instances
        )
        nodes[node.node] = replace(node, instances=instances)
    return replace(plan, nodes=nodes)


def _value(plain: object, name: str, own: InstancePlan, description: ModelDescription) -> Value | None:
    """The start value of a variable; None if it is wrong, and for elements, sizes and what inputs fall back to."""
    variable = description.variable(name)
    if variable is None or variable.causality == "structuralParameter" or own.timeouts:
        return None
    try:
        return to_value(plain, variable, finite=own.not_finite == "stop")
    except ValueRefused:
        return None
