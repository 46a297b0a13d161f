"""The answer of `…/<instance>/info`."""

from __future__ import annotations

import os
import socket

from ..system.plan import NodePlan
from ..variables.value_conversion import to_plain
from ..wire.keys import escape
from ..wire.views import ConnectionView, InstanceInfo, VariableView
from .stepping import Runner
from .streams import kind_of

__all__ = ["instance_info"]


def instance_info(plan: NodePlan, runner: Runner) -> InstanceInfo:
    """What `info` answers for an instance of this process."""
    description, start_values = runner.instance.description, runner.plan.start_values
    return InstanceInfo(
        instance=runner.name,
        model_name=description.model_name,
        description=description.description,
        fmi_version=description.fmi_version,
        kind=description.kind,
        fmu=runner.plan.fmu,
        generation_tool=description.generation_tool,
        capabilities={
            "can_handle_variable_step_size": description.can_handle_variable_step_size,
            "can_get_and_set_state": description.can_get_and_set_state,
            "can_serialize_state": description.can_serialize_state,
            "can_interpolate_inputs": description.can_interpolate_inputs,
            "has_event_mode": description.has_event_mode,
            "needs_execution_tool": description.needs_execution_tool,
            "only_once_per_process": description.only_once_per_process,
        },
        default_experiment=description.default_experiment,
        step_size=plan.grid.step_size * runner.plan.step_points,
        variables=tuple(
            VariableView(
                v.name,
                f"{kind}/{escape(v.name)}",
                v.declared_type or v.type,
                v.causality,
                v.variability,
                v.unit,
                start_values.get(v.name, to_plain(v.start) if v.start is not None else None),
                v.description,
                v.shape,
            )
            for v in description.variables
            if (kind := kind_of(v)) is not None
        ),
        connections=tuple(
            ConnectionView(f"{feed.source}.{source}", f"{runner.name}.{target}", feed.delay, factor, offset)
            for feed in runner.plan.feeds
            for source, target, factor, offset in feed.columns
        ),
        node=plan.node,
        pid=os.getpid(),
        host=socket.gethostname(),
        problems=description.problems,
        clocks=description.clocks,
    )
