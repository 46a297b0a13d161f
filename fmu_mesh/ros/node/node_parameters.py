"""The variables of an FMU as parameters of a ROS node: declaring them, and initializing an FMU from those that are set.

For a node of your own, as `declareROSParameters` and `initializeFromROSParameters` of `fmi_adapter`. A node is anything
with the methods of `rclpy.node.Node`; rclpy itself comes from the user's ROS.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ...adapter import FMIAdapter
from ...errors import CallRefused, ConfigurationError
from ...text import nearest
from ...variables.model_description import ModelDescription, Value, Variable
from ...variables.value_types import nested
from ..messages.ros_names import NameProblem, name_problems, ros_name
from .rclpy_modules import ros_module

__all__ = [
    "declare_parameters",
    "initialize_from_parameters",
    "names_of",
    "parameter_values",
    "undeclare_parameters",
    "undeclared",
    "value_of",
]

RosNode = Any
"""`rclpy.node.Node`, which has no types where ROS is not installed."""


def names_of(variables: Sequence[Variable], names: Mapping[str, str] | None = None) -> dict[str, str]:
    """The ROS name of every variable: as `fmi_adapter` makes it, or as ``names`` has it by variable.

    Raises:
        ConfigurationError: two names are the same, or one is none in ROS; says how to give others.
    """
    own = dict(names or {})
    known = [variable.name for variable in variables]
    problems = [f"there is no variable '{name}'" for name in own if name not in known]
    problems += map(str, name_problems(name for name in known if name not in own))
    result = {name: own.get(name, ros_name(name)) for name in known}
    for name, chosen in own.items():
        if ros_name(chosen) != chosen or chosen[:1].isdigit() or not chosen:
            problems.append(f"'{chosen}', the name given to '{name}', is no ROS name")
        sharing = [other for other, taken in result.items() if taken == chosen]
        if len(sharing) > 1 and sharing[0] == name:
            problems.append(str(NameProblem(chosen, tuple(sharing), "collision")))
    if problems:
        raise ConfigurationError(
            f"the FMU's variables cannot be named in ROS: {'; '.join(problems)}.",
            hint="Give other names, each as 'VARIABLE: NAME', in the parameter 'names'.",
        )
    return result


def declare_parameters(
    node: RosNode, description: ModelDescription, names: Mapping[str, str] | None = None, prefix: str = ""
) -> dict[str, Variable]:
    """Declare a parameter, not set, for every variable; one that the node has already stays as it is.

    Every type is accepted at first, because a file that says `l: 2` means the Real 2.0; what is set is checked against
    the variable when it is used.

    Args:
        node: the node.
        description: of the FMU.
        names: ROS names by variable, where the usual ones do not do.
        prefix: what comes before each name, such as `pendulum.` where a node has several FMUs.

    Returns:
        The variables by the names of their parameters.

    Raises:
        ConfigurationError: two variables have one name, or one has none in ROS.
    """
    settable = {}
    names_by_variable = names_of(description.variables, names)
    descriptor = ros_module("rcl_interfaces.msg").ParameterDescriptor
    for variable in description.variables:
        name = prefix + names_by_variable[variable.name]
        if not node.has_parameter(name):
            text = variable.description or f"{variable.causality} of the FMU"
            unit = f" in {variable.unit}" if variable.unit else ""
            about = f"{variable.name}: {text} ({variable.type}{unit})"
            node.declare_parameter(name, None, descriptor(description=about, dynamic_typing=True))
        settable[name] = variable
    return settable


def undeclared(node: RosNode) -> dict[str, str | None]:
    """Parameters that somebody has set and that the node does not have, each with the nearest one that it has."""
    # rclpy takes what is set for a parameter that nobody declares without a word, and shows it nowhere else.
    there = node.list_parameters([], 0).names
    set_ = node._parameter_overrides  # noqa: SLF001 nothing public tells them
    names = [name for name in set_ if not node.has_parameter(name)]
    return {name: nearest(name, there) for name in names if not name.startswith("qos_overrides.")}


def undeclare_parameters(node: RosNode, names: Sequence[str]) -> None:
    """Take parameters back, so that another FMU can declare its own."""
    for name in names:
        node.undeclare_parameter(name)


def parameter_values(node: RosNode, variables: Mapping[str, Variable]) -> dict[str, Value]:
    """The values of the parameters that are set, by variable; ``variables`` are by parameter."""
    values = [(variable, node.get_parameter(name).value) for name, variable in variables.items()]
    return {variable.name: value_of(variable, value) for variable, value in values if value is not None}


def value_of(variable: Variable, parameter: Any) -> Value:  # noqa: ANN401 any type that a parameter can have
    """The value of a parameter as that of a variable: an array of ROS has one dimension, that of FMI has its own."""
    value: Value = parameter
    if variable.shape and not isinstance(parameter, str) and hasattr(parameter, "__len__"):
        elements = list(parameter)
        value = nested(elements, variable.shape) if len(elements) == variable.size else elements
    return value


def initialize_from_parameters(
    node: RosNode, adapter: FMIAdapter, names: Mapping[str, str] | None = None, prefix: str = ""
) -> list[str]:
    """Declare a parameter for every variable of an FMU, and give the FMU the values of those that are set.

    Args:
        node: the node.
        adapter: in initialization mode.
        names: ROS names by variable, where the usual ones do not do.
        prefix: what comes before each name, such as `pendulum.` where a node has several FMUs.

    Returns:
        The variables that were given a value.

    Raises:
        ConfigurationError: two variables have one name, or one has none in ROS.
        CallRefused: a value has the wrong type or range, or cannot be set; all of them are named.
    """
    values = parameter_values(node, declare_parameters(node, adapter.description, names, prefix))
    refused = []
    for name, value in values.items():
        try:
            adapter.set_initial_value(name, value)
        except CallRefused as error:
            refused.append(str(error))
    if refused:
        raise CallRefused(" ".join(refused))
    return list(values)
