"""ROS messages under keys of a configuration: which field of a message a variable has.

What else is under keys is `fmu_mesh.node.key_payloads`. The definitions of the types are those of ROS 2 Jazzy.
"""

from __future__ import annotations

from msgspec.structs import replace

from ..config.findings import Findings
from ..config.mesh import RosTopicConfig
from ..errors import ConfigurationError
from ..system.live_keys import KeyInput, KeyOutput
from ..system.system import ResolvedSystem
from ..variables.model_description import Variable
from .assembling import Assembler, Disassembler
from .definitions import MessageTypes
from .fitting import TopicEntry, check_topic
from .topics import Direction, Port, Topic

__all__ = ["check_messages", "message_reader", "message_writer"]


def check_messages(system: ResolvedSystem, findings: Findings) -> None:
    """Add a finding for each message under a key that cannot carry its variable."""
    for name, own in system.instances.items():
        entries: tuple[KeyInput | KeyOutput, ...] = (*own.keys_in, *own.keys_out)
        for entry in entries:
            variable = own.description.variable(entry.variable)
            if entry.encoding != "cdr" or variable is None:
                continue
            path, topic = entry.path, _topic(entry, variable, name)
            written = RosTopicConfig(topic=entry.key, type=topic.message, fields={topic.ports[0].path: name})
            try:
                check_topic(TopicEntry(written, path, path, f"{path}.field"), topic, MessageTypes(), findings, [])
            except ConfigurationError as error:
                findings.add(f"{path}.encoding", error.message, error.hint or "")


def message_reader(own: KeyInput, variable: Variable) -> Disassembler:
    """What reads the value of a variable from messages of ROS."""
    return Disassembler(_topic(own, variable), MessageTypes())


def message_writer(own: KeyOutput, variable: Variable) -> Assembler:
    """What makes messages of ROS from the value of a variable."""
    return Assembler(_topic(own, variable), MessageTypes())


def _topic(own: KeyInput | KeyOutput, variable: Variable, instance: str = "") -> Topic:
    direction: Direction = "in" if isinstance(own, KeyInput) else "out"
    if isinstance(own, KeyOutput) and own.index:
        variable = replace(variable, shape=(), dimensions=())  # one element of it
    port = Port(own.field or "data", instance, variable, direction)
    return Topic(own.key, own.type or "", direction, (port,))
