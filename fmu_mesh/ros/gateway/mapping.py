"""The `ros` section as a whole: checked, with its custom message types, and its topics resolved."""

from __future__ import annotations

import math

from ...config.findings import Findings
from ...config.loading import LoadedConfig
from ...config.mesh import Config, RosConfig
from ...errors import ConfigurationError
from ...system.start_values import sized
from ...text import nearest_file
from ..messages.definitions import MessageTypes, is_message_name
from ..messages.ros_names import topic_problem
from .resolver import Resolver
from .topics import Descriptions, RosPlan

__all__ = ["message_types", "resolve"]


def message_types(loaded: LoadedConfig, findings: Findings) -> MessageTypes | None:
    """The message types of the `ros` section, custom ones included; None after a finding."""
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
            custom[name] = place.read_text(encoding="utf-8")
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
    """Give the `ros` section its meaning.

    Args:
        loaded: the configuration and its places in the file.
        descriptions: the model descriptions by instance name; what needs one that is missing is not checked.
        findings: where all that is wrong goes.

    Returns:
        The plan; None where there is no section. With findings it is not complete.
    """
    section = loaded.config.ros
    if section is None:
        return None
    types = message_types(loaded, findings)
    _check_section(loaded.config, section, findings)
    if types is None:
        return None
    # Sizes that are too large are found with the start values that give them.
    instances, untold = loaded.config.instances, loaded.findings()
    full = {name: sized(name, own, instances[name], untold) for name, own in descriptions.items() if name in instances}
    return Resolver(loaded.config, section, full, types, findings).plan()


def _check_section(config: Config, section: RosConfig, findings: Findings) -> None:
    if section.node is not None and (problem := _token_problem(section.node)):
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


def _token_problem(name: str) -> str | None:
    return "a slash" if "/" in name else topic_problem(name)
