"""Which inputs something in the mesh drives, so that nobody else can set them.

Knows the configuration and the model descriptions. What is wrong with either is told by `fmu_mesh.system.system`.
"""

from __future__ import annotations

from collections.abc import Mapping

from ..config.findings import Findings
from ..config.instance_sections import ActuatorConfig, PhysicsSection
from ..config.mesh import Config
from ..variables.model_description import ModelDescription
from .connections import Variables, resolve_connections
from .couplings import coupled_connections

__all__ = ["driven_inputs"]

_FREE = "an input without a connection"


def driven_inputs(config: Config, descriptions: Mapping[str, ModelDescription]) -> dict[str, str]:
    """By `instance.variable` of every input that is not free, what could be set instead.

    An array of which one element is connected is not free, and neither is the effort command of a joint that has an
    actuator: the engine does not use it then.

    Args:
        config: the configuration.
        descriptions: the model descriptions by instance name, arrays in their sizes; some may be missing.
    """
    untold = Findings("")
    variables: Variables = {
        name: {variable.name: variable for variable in descriptions[name].variables} if name in descriptions else None
        for name in config.instances
    }
    explicit = resolve_connections(config.connections, variables, untold)
    connections = (*explicit, *coupled_connections(config, variables, explicit, untold))
    driven = {f"{c.target_instance}.{c.target.name}": _FREE for c in connections}
    # A connection whose source is not known, which is found elsewhere, still says what its target is for.
    driven |= {connection.target: _FREE for connection in config.connections}
    for name, engine in config.instances.items():
        for actuator in engine.actuators if isinstance(engine, PhysicsSection) else ():
            if actuator.enabled:
                driven.setdefault(f"{name}.{actuator.joint}.effort_command", _instead(actuator))
    return driven


def _instead(actuator: ActuatorConfig) -> str:
    own = actuator.variable_names.get("actuatorInput", "actuatorInput")
    return f"'{actuator.instance}.{own}': the joint '{actuator.joint}' has the actuator '{actuator.name}'"
