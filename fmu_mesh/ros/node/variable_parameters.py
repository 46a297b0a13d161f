"""The variables of an FMU as parameters of a ROS node.

`declare_parameters` and `initialize_from_parameters` are for a user's own node, as `declareROSParameters` and
`initializeFromROSParameters` of `fmi_adapter` are. A node is any object with the methods of `rclpy.node.Node`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ...adapter import FMIAdapter
from ...errors import CallRefused, ConfigurationError
from ...ros_wire.rclpy_profile import RosNode, ros_module
from ...ros_wire.ros_names import collision, name_problems, ros_name
from ...text import nearest
from ...variables.model_description import ModelDescription, Value, Variable
from ...variables.value_types import nested

__all__ = [
    "declare_parameters",
    "initialize_from_parameters",
    "names_of",
    "parameter_values",
    "undeclared",
    "value_of",
]


def names_of(variables: Sequence[Variable], names: Mapping[str, str] | None = None) -> dict[str, str]:
    """The ROS name of every variable: the one in ``names``, or the one that `fmi_adapter` makes.

    Raises:
        ConfigurationError: two names are the same, or one is not allowed in ROS; says how to choose others.
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
            problems.append(str(collision(chosen, sharing)))
    if problems:
        raise ConfigurationError(
            f"the FMU's variables cannot be named in ROS: {'; '.join(problems)}.",
            hint="Give other names, each as 'VARIABLE: NAME', in the parameter 'names'.",
        )
    return result


def declare_parameters(
    node: RosNode, description: ModelDescription, names: Mapping[str, str] | None = None, prefix: str = ""
) -> dict[str, Variable]:
    """Declare a parameter without a value for every variable; a parameter that the node has already is kept.

    A parameter accepts every type, because a file that says `l: 2` means the Real 2.0. A value is checked against the
    variable when it is used.

    Args:
        node: the node.
        description: the model description, such as `adapter.description`.
        names: ROS names by variable, for variables whose usual name cannot be used.
        prefix: put before each name, such as `pendulum.` if a node has several FMUs.

    Returns:
        The variables by the names of their parameters.

    Raises:
        ConfigurationError: two variables have the same name, or a variable has no name in ROS.

    Example:
        >>> variables = declare_parameters(node, adapter.description)  # doctest: +SKIP
        >>> variables["l"].unit  # doctest: +SKIP
        'm'
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
    """Parameters that the user has set but the node does not have, each with the most similar name that it has."""
    # rclpy ignores a value for an undeclared parameter silently, and shows it nowhere else.
    there = node.list_parameters([], 0).names
    overrides = node._parameter_overrides  # noqa: SLF001 rclpy has no public way to read them
    names = [name for name in overrides if not node.has_parameter(name)]
    return {name: nearest(name, there) for name in names if not name.startswith("qos_overrides.")}


def parameter_values(node: RosNode, variables: Mapping[str, Variable]) -> dict[str, Value]:
    """The values of the parameters that are set, by variable; ``variables`` are by parameter name."""
    values = [(variable, node.get_parameter(name).value) for name, variable in variables.items()]
    return {variable.name: value_of(variable, value) for variable, value in values if value is not None}


def value_of(variable: Variable, parameter: Any) -> Value:  # noqa: ANN401 any type that a parameter can have
    """The value of a parameter in the shape of its variable; an array in ROS has one dimension."""
    value: Value = parameter
    if variable.shape and not isinstance(parameter, str) and hasattr(parameter, "__len__"):
        elements = list(parameter)
        value = nested(elements, variable.shape) if len(elements) == variable.size else elements
    return value


def initialize_from_parameters(
    node: RosNode, adapter: FMIAdapter, names: Mapping[str, str] | None = None, prefix: str = ""
) -> list[str]:
    """Declare a parameter for every variable of an FMU, and set the variables whose parameters have values.

    Args:
        node: the node.
        adapter: the FMU, in Initialization Mode.
        names: ROS names by variable, for variables whose usual name cannot be used.
        prefix: put before each name, such as `pendulum.` if a node has several FMUs.

    Returns:
        The names of the variables that were set.

    Raises:
        ConfigurationError: two variables have the same name, or a variable has no name in ROS.
        CallRefused: a value has the wrong type or range, or cannot be set; names every such value.

    Example:
        >>> adapter = FMIAdapter("fmus/DampedPendulum.fmu")  # doctest: +SKIP
        >>> initialize_from_parameters(node, adapter)  # started with `-p l:=1.0`  # doctest: +SKIP
        ['l']
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
