"""ROS names of topics and parameters: how FMI variables are named, and which names ROS allows.

The rule is that of `fmi_adapter`: every character other than a letter, digit or underscore becomes an underscore, and
leading underscores are removed. A name that is unusable or not unique is reported; nothing is renamed silently.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

import msgspec

__all__ = [
    "NameProblem",
    "absolute",
    "collision",
    "dds_type",
    "name_problems",
    "ros_name",
    "service_name",
    "topic_problem",
]

_NO_NAME_CHARACTER = re.compile(r"[^A-Za-z0-9_]")
_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


class NameProblem(msgspec.Struct, frozen=True):
    """Variables that the rule gives no usable name, in the order of the model description; `str` says why."""

    variables: tuple[str, ...]
    text: str

    def __str__(self) -> str:
        return self.text


def collision(name: str, variables: Iterable[str]) -> NameProblem:
    """Several variables have this name."""
    several = tuple(variables)
    quoted = ", ".join(f"'{variable}'" for variable in several)
    return NameProblem(several, f"the variables {quoted} all become '{name}'")


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
        if not name or name[0].isdigit():
            for owner in owners:
                text = f"the variable '{owner}' becomes '{name}', which starts with a digit"
                nothing = f"nothing is left of the name of the variable '{owner}'"
                problems.append(NameProblem((owner,), text if name else nothing))
        if name and len(owners) > 1:
            problems.append(collision(name, owners))
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


def service_name(kind: str) -> str:
    """The usual name of a service of this type: `get_parameters` for GetParameters."""
    return re.sub(r"\B([A-Z])", r"_\1", kind).lower()
