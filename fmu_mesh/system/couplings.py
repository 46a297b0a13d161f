"""Connections for the `controllers`, `actuators` and `fluid_dynamics` of a physics engine.

Owns the variable names of the two `gazebo-fmi` plugins and of controllers. Their order is that of `gazebo-fmi`: values
from the engine have a delay of one point. So in each step the controller comes first, then the actuator, then the
engine with the new effort.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

import msgspec
from msgspec.structs import replace

from ..config.findings import Findings
from ..config.instance_sections import ActuatorConfig, ControllerConfig, FluidDynamicsConfig, PhysicsSection
from ..config.mesh import Config, sources_of
from ..text import listed, nearest
from ..variables.model_description import ModelDescription, Variable
from .connections import Connection, Variables, resolve_connections

__all__ = ["coupled_connections", "driven_inputs"]

AnyCoupling = ControllerConfig | ActuatorConfig | FluidDynamicsConfig

_AXES = ("x", "y", "z")
_FREE = "an input without a connection"


class _Coupling(msgspec.Struct, frozen=True):
    """One entry of a section, and the variables of the engine that it is connected to.

    Attributes:
        part: the joint or body.
        reads: the engine's outputs by default name of the instance's input.
        drives: the engine's inputs by default name of the instance's output.
    """

    engine: str
    path: str
    config: AnyCoupling
    what: Literal["joint", "body"]
    part: str
    reads: dict[str, str]
    drives: dict[str, str]


def coupled_connections(
    engines: Mapping[str, PhysicsSection], variables: Variables, explicit: Sequence[Connection], findings: Findings
) -> tuple[Connection, ...]:
    """The connections that follow from the sections of all physics engines, beside the ``explicit`` ones of the file.

    An instance without a model description gets none.
    """
    found: list[Connection] = []
    # Controllers first: actuators take their efforts.
    for coupling in sorted(_couplings(engines), key=lambda coupling: isinstance(coupling.config, ActuatorConfig)):
        found += _connect(coupling, variables, [*explicit, *found], findings)
        if isinstance(coupling.config, ActuatorConfig):
            _check_command(engines[coupling.engine], coupling, findings)
    return tuple(found)


def driven_inputs(config: Config, descriptions: Mapping[str, ModelDescription]) -> dict[str, str]:
    """The inputs that have a source in the mesh, as `instance.variable`, and for each what can be set instead.

    An array has a source if one of its elements has. The effort command of a joint with an actuator counts, too,
    because the engine does not use it. Some of the descriptions, with arrays in their sizes, may be missing.
    """
    ignored = Findings("")  # `fmu_mesh.system.system` reports them
    engines, variables = config.engines, Variables(descriptions, [*config.instances])
    explicit = resolve_connections(config.connections, variables, ignored)
    connections = (*explicit, *coupled_connections(engines, variables, explicit, ignored))
    driven = {f"{c.target_instance}.{c.target.name}": _FREE for c in connections}
    # Also the target of a connection whose source does not exist.
    driven |= dict.fromkeys(sources_of(config.connections), _FREE)
    for name, engine in engines.items():
        for actuator in engine.actuators:
            if actuator.enabled:
                own = actuator.variable_names.get("actuatorInput", "actuatorInput")
                instead = (
                    f"'{actuator.instance}.{own}': the joint '{actuator.joint}' has the actuator '{actuator.name}'"
                )
                driven.setdefault(f"{name}.{actuator.joint}.effort_command", instead)
    return driven


def _check_command(engine: PhysicsSection, coupling: _Coupling, findings: Findings) -> None:
    """Refuse a start value of an effort command that the engine does not use because there is an actuator."""
    command = coupling.reads["actuatorInput"]
    if command in engine.start_values:
        own = coupling.config.variable_names.get("actuatorInput", "actuatorInput")
        found = f"a start value for '{command}', although the joint has the actuator '{coupling.config.name}'"
        path = f"instances.{coupling.engine}.start_values.{command}"
        findings.add(path, found, f"a start value of '{coupling.config.instance}.{own}'")


def _couplings(engines: Mapping[str, PhysicsSection]) -> Iterator[_Coupling]:
    for name, engine in engines.items():
        sections: tuple[tuple[str, Sequence[AnyCoupling]], ...] = (
            ("controllers", engine.controllers),
            ("actuators", engine.actuators),
            ("fluid_dynamics", engine.fluid_dynamics),
        )
        for section, entries in sections:
            for number, entry in enumerate(entries):
                if entry.enabled:
                    yield _coupling(name, f"instances.{name}.{section}[{number}]", entry)


def _coupling(engine: str, path: str, config: AnyCoupling) -> _Coupling:
    match config:
        case ActuatorConfig(joint=joint):
            reads = {
                "actuatorInput": f"{joint}.effort_command",
                "jointPosition": f"{joint}.position",
                "jointVelocity": f"{joint}.velocity",
                "jointAcceleration": f"{joint}.acceleration",
            }
            return _Coupling(engine, path, config, "joint", joint, reads, {"jointTorque": f"{joint}.effort"})
        case ControllerConfig(joint=joint):
            reads = {"position": f"{joint}.position", "velocity": f"{joint}.velocity"}
            return _Coupling(engine, path, config, "joint", joint, reads, {"effort": f"{joint}.effort_command"})
        case FluidDynamicsConfig(link=link):
            reads = {f"relativeVelocity_{axis}": f"{link}.relative_velocity_{axis}" for axis in _AXES}
            drives = {f"fluidDynamicForce_{axis}": f"{link}.force_{axis}" for axis in _AXES}
            drives |= {f"fluidDynamicMoment_{axis}": f"{link}.moment_{axis}" for axis in _AXES}
            return _Coupling(engine, path, config, "body", link, reads, drives)


def _connect(
    coupling: _Coupling, variables: Variables, others: Sequence[Connection], findings: Findings
) -> list[Connection]:
    """The connections of one coupling; none after a finding."""
    own = _own_variables(coupling, variables, findings)
    engine = variables[coupling.engine]
    if engine is None or not _part_exists(coupling, engine, findings) or own is None:
        return []
    connections: list[Connection] = []
    for default, variable in own.items():
        if default == "actuatorInput":
            connections += _command(coupling, coupling.reads[default], variable, others)
        elif default in coupling.reads:
            source = engine[coupling.reads[default]]
            ends = (coupling.engine, source, coupling.config.instance, variable)
            connections.append(Connection(*ends, factor=1.0, offset=0.0, delay=1, path=coupling.path))
        else:
            driven = engine[coupling.drives[default]]
            ends = (coupling.config.instance, variable, coupling.engine, driven)
            connections.append(Connection(*ends, factor=1.0, offset=0.0, delay=None, path=coupling.path))
    taken = {(other.target_instance, other.target.name): other for other in others}
    for connection in connections:
        other = taken.get((connection.target_instance, connection.target.name))
        if other is not None:
            target = f"{connection.target_instance}.{connection.target.name}"
            found = f"a second source for the input '{target}': {connection}, after {other} ({other.path})"
            findings.add(coupling.path, found, "one source for an input")
    return connections


def _command(
    coupling: _Coupling, command: str, variable: Variable, others: Sequence[Connection]
) -> Iterator[Connection]:
    """A connection from the controller of the joint to the actuator; none without a controller."""
    for other in others:
        if (other.target_instance, other.target.name) == (coupling.engine, command):
            yield replace(other, target_instance=coupling.config.instance, target=variable, path=coupling.path)


def _part_exists(coupling: _Coupling, engine: Mapping[str, Variable], findings: Findings) -> bool:
    """Whether the engine has the joint or body."""
    config, last = coupling.config, ".effort" if coupling.what == "joint" else ".force_x"
    if f"{coupling.part}{last}" in engine:
        return True
    names = [name.removesuffix(last) for name in engine if name.endswith(last)]
    key = "link" if isinstance(config, FluidDynamicsConfig) else "joint"
    kind = "bodies" if key == "link" else "revolute and prismatic joints"
    found = f"the unknown {coupling.what} '{coupling.part}' of '{coupling.engine}'"
    expected = f"one of its {kind}: {listed(names)}"
    findings.add(f"{coupling.path}.{key}", found, expected, nearest(coupling.part, names))
    return False


def _own_variables(coupling: _Coupling, variables: Variables, findings: Findings) -> dict[str, Variable] | None:
    """The variables of the instance by default name; None after a finding, or without a description."""
    config, path = coupling.config, coupling.path
    defaults = [*coupling.reads, *coupling.drives]
    before = len(findings)
    for name in config.variable_names:
        if name not in defaults:
            place = f"{path}.variable_names.{name}"
            findings.add(place, f"the unknown name '{name}'", f"one of {listed(defaults)}", nearest(name, defaults))
    if config.instance not in variables:
        expected = f"one of the instances {listed(list(variables))}"
        found = f"the unknown instance '{config.instance}'"
        findings.add(f"{path}.instance", found, expected, nearest(config.instance, variables))
        return None
    known = variables[config.instance]
    if known is None:
        return None
    own = {}
    for default in defaults:
        name = config.variable_names.get(default, default)
        causality = "input" if default in coupling.reads else "output"
        variable = known.get(name)
        if variable is not None and variable.causality == causality and variable.type == "Float64":
            own[default] = variable
            continue
        place = f"{path}.variable_names.{default}" if default in config.variable_names else path
        candidates = [v.name for v in known.values() if v.causality == causality and v.type == "Float64"]
        missing = "no variable" if variable is None else f"no Real {causality}"
        found = f"'{config.instance}', which has {missing} '{name}'"
        expected = f"a Real {causality} for '{default}' ({config.name!r}); it may have another name in `variable_names`"
        findings.add(place, found, expected, nearest(name, candidates))
    return own if len(findings) == before else None
