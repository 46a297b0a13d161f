"""Names: from FMI variables to ROS topics and parameters, and what a ROS name may be.

The rule is that of `fmi_adapter`: every character that is no letter, digit or underscore becomes an underscore, and
leading underscores go. Where that gives no usable name, or one name twice, it is told; nothing is renamed in silence.
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
    """Variables whose names cannot be used in ROS as they are.

    Attributes:
        name: what the rule makes of them.
        variables: the variables with this name, in the order of the model description.
        kind: several variables get one name, the name starts with a digit, or nothing is left of it.
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
    """The ROS name of an FMI variable, as `fmi_adapter` makes it: `der(a,2)` becomes `der_a_2_`."""
    return _NO_NAME_CHARACTER.sub("_", variable).lstrip("_")


def name_problems(variables: Iterable[str]) -> list[NameProblem]:
    """What is wrong with the ROS names of ``variables`` if all of them are used side by side."""
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
    """The absolute name of ``topic``; a relative one is in ``namespace``."""
    return topic if topic.startswith("/") else f"{namespace.rstrip('/')}/{topic}"


def topic_problem(topic: str) -> str | None:
    """Why ``topic`` is no ROS name (ROS 2 design, "Topic and Service name mapping to DDS"); None if it is one."""
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
    """The name that a ROS type has in DDS: `std_msgs/msg/Float64` is `std_msgs::msg::dds_::Float64_`."""
    package, kind, name = message.split("/")
    return f"{package}::{kind}::dds_::{name}_"
