"""From the `ros` section of a configuration to a plan: the section is checked and its topics are resolved."""

from __future__ import annotations

import math
from collections.abc import Mapping

import msgspec

from ...config.findings import Findings
from ...config.loading import LoadedConfig
from ...config.mesh import Config, RosConfig
from ...errors import ConfigurationError
from ...files import opened
from ...system.start_values import sized
from ...text import nearest_file
from ...variables.model_description import Causality, ModelDescription, Variability, Variable
from ...variables.value_types import FMI2_TYPES, VariableType
from ...wire.views import InstanceInfo, VariableView
from ..messages.definitions import MessageTypes, is_message_name
from ..messages.ros_names import topic_problem
from ..messages.topics import Descriptions, RosPlan
from .resolver import Resolver

__all__ = ["descriptions_of", "message_types", "resolve"]


def message_types(loaded: LoadedConfig, findings: Findings) -> MessageTypes | None:
    """The message types of the `ros` section with its custom ones; None after a finding."""
    section = loaded.config.ros
    assert section is not None
    custom = {}
    for name, file in section.messages.items():
        path = f"ros.messages.{name}"
        if not is_message_name(name):
            findings.add(path, f"'{name}'", "the full name of a message type, such as lab_msgs/msg/Wheel")
            continue
        place = loaded.resolve(file)
        try:
            with opened(place) as source:
                custom[name] = source.read().decode()
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else str(error)
            findings.add(path, f"'{file}', which cannot be read ({reason})", "a .msg file", nearest_file(place))
    try:
        return MessageTypes(section.distribution, custom)
    except ConfigurationError as error:
        expected = f"a Python that has it. {error.hint}" if error.hint else "definitions that are complete"
        findings.add("ros.messages" if custom else "ros", error.message, expected)
        return None


def resolve(loaded: LoadedConfig, descriptions: Descriptions, findings: Findings) -> RosPlan | None:
    """Make the plan of the `ros` section.

    Args:
        loaded: the configuration.
        descriptions: the model descriptions by instance name; a topic whose description is missing is not checked.
        findings: where the findings go.

    Returns:
        The plan; None without a section or without message types. After findings it is incomplete.
    """
    section = loaded.config.ros
    if section is None:
        return None
    types = message_types(loaded, findings)
    _check_section(loaded.config, section, findings)
    # Array sizes that are too large are reported with the start values that set them, so not here.
    instances, ignored = loaded.config.instances, loaded.findings()
    full = {name: sized(name, own, instances[name], ignored) for name, own in descriptions.items() if name in instances}
    resolver = Resolver(loaded.config, section, full, types, findings)
    if types is None:  # the names can be checked
        resolver.topics()
        return None
    return resolver.plan()


def descriptions_of(infos: Mapping[str, InstanceInfo]) -> dict[str, ModelDescription]:
    """The model descriptions of running instances, from their answers, with only what topics need.

    The instances may run on another host, so their FMUs cannot be read here.
    """
    return {
        name: ModelDescription(
            model_name=info.model_name,
            model_identifier=info.model_name,
            fmi_version=info.fmi_version,
            kind="co_simulation",
            guid="",
            variables=tuple(_variable(view) for view in info.variables),
        )
        for name, info in infos.items()
    }


def _variable(view: VariableView) -> Variable:
    return Variable(
        name=view.name,
        value_reference=0,
        type=msgspec.convert(FMI2_TYPES.get(view.type, view.type), VariableType),
        causality=msgspec.convert(view.causality, Causality),
        variability=msgspec.convert(view.variability, Variability),
        unit=view.unit,
        description=view.description,
        declared_type=view.type,
        shape=view.shape,
    )


def _check_section(config: Config, section: RosConfig, findings: Findings) -> None:
    if section.node is not None:
        problem = "a slash" if "/" in section.node else topic_problem(section.node)
        if problem is not None:
            findings.add("ros.node", f"'{section.node}': {problem}", "letters, digits and underscores, no digit first")
    if section.namespace != "/" and (problem := topic_problem(section.namespace)):
        findings.add("ros.namespace", f"'{section.namespace}': {problem}", "a name such as /robot")
    elif not section.namespace.startswith("/"):
        findings.add("ros.namespace", f"'{section.namespace}'", "a name that starts with a slash")
    if section.clock_rate is not None and not (math.isfinite(section.clock_rate) and section.clock_rate > 0):
        findings.add("ros.clock_rate", f"{section.clock_rate:g}", "a rate > 0 in Hz, or null for no /clock")
    if not section.connect and not section.listen:
        findings.add("ros.connect", "no endpoint", "where the bridge or the router is, or an endpoint in ros.listen")
    if config.simulation.start_time < 0:
        found = f"{config.simulation.start_time:g}, while `ros` is there"
        findings.add("simulation.start_time", found, "a time >= 0: a ROS clock has no negative times")
