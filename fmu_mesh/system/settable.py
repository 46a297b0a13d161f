"""What may be set between two steps: unconnected inputs and tunable parameters; everything else with a reason.

Nobody else decides it: `VariableView.settable` tells tools of a running mesh.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..variables.model_description import Variable
from ..variables.value_conversion import ValueRefused

if TYPE_CHECKING:
    from .plan import InstancePlan

__all__ = ["check_settable", "sources_of", "why_not_settable"]


def sources_of(plan: InstancePlan) -> dict[str, str]:
    """The source instance of each input of an instance that is connected, or of which an element is."""
    return {plan.inputs.column(own.target).name: feed.source for feed in plan.feeds for own in feed.columns}


def check_settable(plan: InstancePlan, variable: Variable) -> None:
    """Check that a variable of an instance may be set between two steps.

    Raises:
        ValueRefused: it may not; the message is the predicate of a sentence whose subject is the variable.
    """
    why = why_not_settable(variable, sources_of(plan).get(variable.name))
    if why is not None:
        raise ValueRefused(why)


def why_not_settable(variable: Variable, source: str | None) -> str | None:
    """Why a variable may not be set between two steps; None if it may.

    Args:
        variable: the variable.
        source: the instance that it is connected to; None if it is not connected.

    Returns:
        The predicate of a sentence whose subject is the variable.
    """
    match variable.causality:
        case "input" if source is not None:
            return f"is connected to '{source}'; only unconnected inputs can be set"
        case "parameter" if source is not None:
            return f"gets its value from '{source}'; only parameters without a connection can be prescribed"
        case "parameter" | "calculatedParameter" if variable.variability != "tunable":
            return f"is a {variable.variability} parameter; only tunable ones can be set while it runs"
        case "input" | "parameter" | "calculatedParameter":
            return None
        case _:
            return "is no input and no parameter, so it cannot be set"
