"""What may be set between two steps: unconnected inputs and tunable parameters; everything else with a reason."""

from __future__ import annotations

from ..variables.model_description import Variable
from ..variables.value_conversion import ValueRefused
from .plan import InstancePlan

__all__ = ["check_settable"]


def check_settable(plan: InstancePlan, variable: Variable) -> None:
    """Check that a variable of an instance may be set between two steps.

    Raises:
        ValueRefused: it may not; the message is the predicate of a sentence whose subject is the variable.
    """
    match variable.causality:
        case "input" if variable.name in plan.inputs.names:
            layout = plan.inputs
            feed = next(
                feed
                for feed in plan.feeds
                if variable.name in {layout.column(target).name for _, target, _, _ in feed.columns}
            )
            raise ValueRefused(f"is connected to '{feed.source}'; only unconnected inputs can be set")
        case "parameter" | "calculatedParameter" if variable.variability != "tunable":
            text = f"is a {variable.variability} parameter; only tunable ones can be set while it runs"
            raise ValueRefused(text)
        case "input" | "parameter" | "calculatedParameter":
            return
        case _:
            raise ValueRefused("is no input and no parameter, so it cannot be set")
