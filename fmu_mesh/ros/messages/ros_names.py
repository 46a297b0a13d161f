"""ROS names of topics and parameters: how FMI variables are named, and which names ROS allows.

The rule is that of `fmi_adapter`: every character other than a letter, digit or underscore becomes an underscore, and
leading underscores are removed. A name that is unusable or not unique is reported; nothing is renamed silently.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Literal

import msgspec

__all__ = ["NameProblem", "absolute", "dds_type", "name_problems", "ros_name", "topic_problem"]

_NO_NAME_CHARACTER = re.compile(r"[^A-Za-z0-9_]")
_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


class NameProblem(msgspec.Struct, frozen=True):
    """Variables that the rule gives no usable name.

    Attributes:
        name: the name that the rule gives them.
        variables: the variables with this name, in the order of the model description.
        kind: several variables have the same name, the name starts with a digit, or the name is empty.
    """

    name: str
    variables: tuple[str, ...]
    kind: Literal["collision", "digit", "empty"]

    def __str__(self) -> str:
        quoted = ", ".join(f"'{variable}'" for variable in self.variables)
        match self.kind:
            case "collision":
                return f"the variables {quoted} all become '{self.name}'"
            case "digit":
                return f"the variable {quoted} becomes '{self.name}', which starts with a digit"
            case "empty":
                return f"nothing is left of the name of the variable {quoted}"


def ros_name(variable: str) -> str:
    """The ROS name of an FMI variable, as in `fmi_adapter`.

    Example:
        >>> ros_name("der(a,2)")
        'der_a_2_'
    """
    return _NO_NAME_CHARACTER.sub("_", variable).lstrip("_")


def name_problems(variables: Iterable[str]) -> list[NameProblem]:
    """The problems with the ROS names of ``variables`` if all of them are used together."""
    by_name: dict[str, list[str]] = {}
    for variable in variables:
        by_name.setdefault(ros_name(variable), []).append(variable)
    problems = []
    for name, owners in by_name.items():
        if not name:
            problems += [NameProblem(name, (owner,), "empty") for owner in owners]
            continue
        if name[0].isdigit():
            problems += [NameProblem(name, (owner,), "digit") for owner in owners]
        if len(owners) > 1:
            problems.append(NameProblem(name, tuple(owners), "collision"))
    return problems


def absolute(topic: str, namespace: str = "/") -> str:
    """The absolute name of ``topic``; a relative name is in ``namespace``."""
    return topic if topic.startswith("/") else f"{namespace.rstrip('/')}/{topic}"


def topic_problem(topic: str) -> str | None:
    """Why ``topic`` is not allowed as a name (ROS 2 design, "Topic and Service name mapping to DDS"); None if it is."""
    tokens = topic.removeprefix("/").split("/")
    for token in tokens:
        if not token:
            return "an empty part between two slashes" if len(tokens) > 1 else "nothing"
        if token[0].isdigit():
            return f"the part '{token}' starts with a digit"
        if _TOKEN.fullmatch(token) is None:
            return f"the part '{token}' has characters other than letters, digits and underscores"
    return None


def dds_type(message: str) -> str:
    """The name of a ROS type in DDS: `std_msgs/msg/Float64` is `std_msgs::msg::dds_::Float64_`."""
    package, kind, name = message.split("/")
    return f"{package}::{kind}::dds_::{name}_"
