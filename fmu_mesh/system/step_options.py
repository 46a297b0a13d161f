"""How instances are to be stepped: `kind`, `solver`, `tolerance`, `retry_discarded_steps` and `extrapolation`.

Owns which of these wishes an FMU can fulfil, by its capability flags; what it cannot is a finding with the reason.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal

import msgspec

from ..config.findings import Findings
from ..config.mesh import AnyInstanceConfig, InstanceConfig
from ..variables.model_description import ModelDescription
from .connections import Connection

__all__ = [
    "LinearInput",
    "SolverSettings",
    "StepOptions",
    "capability_warnings",
    "check_extrapolation",
    "linear_inputs",
    "resolve_step_options",
]

_DEFAULT_TOLERANCE = 1e-6


class SolverSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the continuous states of a model-exchange FMU are solved.

    Attributes:
        relative_tolerance: of the local error; the absolute ones are this times the nominal values of the states.
        maximum_step_size: in s; None: at most the communication step.
    """

    name: Literal["cvode", "euler"] = "cvode"
    relative_tolerance: float = 1e-6
    maximum_step_size: float | None = None


class LinearInput(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An input that changes linearly within a step, and the delay of its connection (0 or 1)."""

    name: str
    delay: int


class StepOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How one instance is stepped; what its FMU cannot do has been refused before.

    Attributes:
        solver: of a model-exchange FMU.
        tolerance: relative tolerance that a co-simulation FMU is told; None: that of its default experiment.
        retry_discarded_steps: whether a step that the FMU discards is tried again in smaller ones.
        linear_inputs: the inputs whose connections are extrapolated.
    """

    solver: SolverSettings = SolverSettings()
    tolerance: float | None = None
    retry_discarded_steps: bool = False
    linear_inputs: tuple[LinearInput, ...] = ()


def resolve_step_options(
    name: str, config: AnyInstanceConfig, description: ModelDescription, findings: Findings
) -> StepOptions:
    """What the section of an instance says about its stepping; the linear inputs are not known before the delays."""
    if not isinstance(config, InstanceConfig):
        return StepOptions()
    solver = config.solver
    settings = {
        "tolerance": config.tolerance,
        "solver.relative_tolerance": solver.relative_tolerance,
        "solver.maximum_step_size": solver.maximum_step_size,
    }
    for key, value in settings.items():
        if value is not None and not (math.isfinite(value) and value > 0.0):
            findings.add(f"instances.{name}.{key}", f"{value:g}", "a number > 0")
    if description.kind == "co_simulation" and solver != InstanceConfig(fmu="").solver:
        found = f"a solver for '{name}', which runs as co-simulation and has a solver of its own"
        findings.add(f"instances.{name}.solver", found, "`kind: model_exchange`, or no solver")
    if config.tolerance is not None and (refusal := _takes_no_tolerance(description)) is not None:
        why, expected = refusal
        findings.add(f"instances.{name}.tolerance", f"{config.tolerance:g}, but {why}", expected)
    if config.retry_discarded_steps and (reason := _cannot_retry(description)) is not None:
        findings.add(f"instances.{name}.retry_discarded_steps", f"true, but {reason}", "false")
    tolerance = solver.relative_tolerance or description.default_experiment.tolerance or _DEFAULT_TOLERANCE
    return StepOptions(
        solver=SolverSettings(solver.name, tolerance, solver.maximum_step_size),
        tolerance=config.tolerance,
        retry_discarded_steps=config.retry_discarded_steps,
    )


def check_extrapolation(
    connections: Sequence[Connection],
    configs: Mapping[str, AnyInstanceConfig],
    descriptions: Mapping[str, ModelDescription],
    findings: Findings,
) -> None:
    """Refuse `extrapolation: linear` where the target cannot take the derivative of an input."""
    for connection in connections:
        if connection.extrapolation == "linear":
            target = connection.target_instance
            section = configs[target]
            retries = isinstance(section, InstanceConfig) and section.retry_discarded_steps
            reason = _cannot_extrapolate(connection, descriptions[target], retries=retries)
            if reason is not None:
                found = f"linear for {connection}, but {reason}"
                findings.add(f"{connection.path}.extrapolation", found, "hold")


def linear_inputs(connections: Sequence[Connection], name: str) -> tuple[LinearInput, ...]:
    """The inputs of an instance that change linearly; the delays of all connections are known."""
    return tuple(
        LinearInput(connection.target.name, connection.delay or 0)
        for connection in connections
        if connection.target_instance == name and connection.extrapolation == "linear"
    )


def capability_warnings(
    config: Mapping[str, AnyInstanceConfig], descriptions: Mapping[str, ModelDescription], findings: Findings
) -> None:
    """Note what an FMU needs that this program does not give it."""
    for name in config:
        description = descriptions[name]
        if description.needs_execution_tool:
            tool = description.generation_tool
            found = f"the FMU of '{name}' needs an execution tool ({tool or 'it does not say which'})"
            findings.add(f"instances.{name}.fmu", found, f"{tool or 'that tool'} on the host that runs it")


def _takes_no_tolerance(description: ModelDescription) -> tuple[str, str] | None:
    """Why an FMU cannot be told a tolerance, and what to write instead; None if it can."""
    if description.kind == "model_exchange":
        return "the FMU runs as model exchange, with a solver of ours", "`solver: {relative_tolerance: ...}`"
    if description.fmi_version.startswith("1."):
        return "co-simulation in FMI 1.0 cannot be told one (fmiInitializeSlave)", "no tolerance"
    return None


def _cannot_retry(description: ModelDescription) -> str | None:
    if description.kind == "model_exchange":
        return "a model-exchange FMU has no steps of its own to discard"
    if not description.can_handle_variable_step_size:
        return "the FMU does not handle a variable communication step size"
    if description.fmi_version.startswith("1.") and not description.can_reject_steps:
        return "the FMU cannot repeat a step (canRejectSteps)"
    if description.fmi_version.startswith("2.") and not description.can_get_and_set_state:
        return "the FMU cannot get and set its state, so it cannot go back to where the step began"
    return None


def _cannot_extrapolate(connection: Connection, description: ModelDescription, *, retries: bool) -> str | None:
    target = connection.target
    if target.type != "Float64" or target.shape or connection.target_index:
        return f"'{target.name}' is no scalar Real input"
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
