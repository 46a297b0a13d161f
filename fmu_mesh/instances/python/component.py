"""What a component in Python derives from: the class `Component`, and the decorator `component` for functions.

This is all that a component needs of fmu_mesh, and it knows no mesh: any program, such as a test of the component, can
make a component, set its inputs, call `step` and read its outputs.
"""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable
from typing import Any, ClassVar, Self, cast

from ...errors import CallRefused
from ...text import listed
from .declarations import Declared, Input, Output, Parameter

__all__ = ["Component", "component", "declared_variables"]


class Component:
    """Base of components in Python. A component is an instance of a mesh, as an FMU is.

    A subclass declares its variables with `Input`, `Output` and `Parameter`, and has a method `step`. The calls come in
    this order, all on one thread:

    1. the class is called with the `arguments` of the configuration; inputs and parameters have their start values;
    2. parameters and start values of the configuration are set;
    3. `initialize`, each time when an output is read after an input has changed. If it is called again, all attributes
       are first set back to what they were before its first call;
    4. `step` for each step of the instance, with all inputs set before;
    5. `close`.

    Any exception ends the run. The error shows the line of the component.

    Attributes:
        start_time: start time of the simulation in s; valid in `initialize`.

    Example:
        >>> import fmu_mesh
        >>> class Counter(fmu_mesh.Component):
        ...     '''Counts its steps.'''
        ...
        ...     by = fmu_mesh.Parameter(1, tunable=True)
        ...     count = fmu_mesh.Output(type="Int64")
        ...
        ...     def step(self, time, step_size):
        ...         self.count += self.by
        >>> counter = Counter()
        >>> counter.step(0.0, 0.1)
        >>> counter.count
        1
    """

    start_time: float = 0.0

    def __new__(cls, *_arguments: object, **_named: object) -> Self:
        """Give the inputs and parameters their start values, before `__init__` of a subclass, which need not care."""
        self = super().__new__(cls)
        for name, declared in declared_variables(cls).items():
            if declared.has_start or declared.causality != "output":
                vars(self)[name] = declared.start
        return self

    def initialize(self) -> None:
        """Compute the initial outputs and the initial state from parameters and inputs (FMI 2.0, 4.2.1).

        By default the outputs have their start values.
        """

    def step(self, time: float, step_size: float) -> None:
        """Compute the outputs at ``time + step_size``.

        The inputs are those that the delays of their connections prescribe, as for `fmi2DoStep` (FMI 2.0, 4.2.1).

        Args:
            time: the communication point at which the step starts, in s.
            step_size: in s.
        """
        raise NotImplementedError(f"{type(self).__name__} has no method `step(self, time, step_size)`")

    def get_state(self) -> object:
        """The complete state, which later changes of this component must not change. Default: a copy of all attributes.

        The values of the declared variables are kept in any case.
        """
        return copy.deepcopy(vars(self))

    def set_state(self, state: object) -> None:
        """Restore a state of `get_state`; the same state may be restored again later."""
        attributes = copy.deepcopy(cast("dict[str, object]", state))
        vars(self).clear()
        vars(self).update(attributes)

    def close(self) -> None:
        """Free what the component holds; called once at the end, also after an error."""


class _FunctionComponent(Component):
    """A component that a function computes; `component` makes the subclasses."""

    _function: ClassVar[Callable[..., object]]
    _arguments: ClassVar[tuple[str, ...]]
    _outputs: ClassVar[tuple[str, ...]]

    def initialize(self) -> None:
        """Call the function with the start time and a step size of 0."""
        self.step(self.start_time, 0.0)

    def step(self, time: float, step_size: float) -> None:
        """Call the function, and assign what it returns to the outputs."""
        values = vars(self)
        given = {"time": time, "step_size": step_size}
        result = self._function(**{name: given[name] if name in given else values[name] for name in self._arguments})
        if len(self._outputs) == 1:
            values[self._outputs[0]] = result
            return
        if not isinstance(result, tuple) or len(result) != len(self._outputs):
            found = (
                f"{len(result)} values" if isinstance(result, tuple) else f"a value of the type {type(result).__name__}"
            )
            expected = f"one for each of the outputs {', '.join(self._outputs)}"
            raise ValueError(f"the function returned {found}, expected a tuple of {len(self._outputs)}: {expected}")
        values.update(zip(self._outputs, result, strict=True))


def component(**declarations: Declared[Any]) -> Callable[[Callable[..., object]], type[Component]]:
    """Make a component of a function without a state.

    An argument without a default is an input, one with a default is a parameter. `time` and `step_size` are what
    `Component.step` gets. The function returns the value of the output; with several outputs a tuple, in the order of
    their declarations. Initial outputs are those of the start time, with a step size of 0.

    Args:
        declarations: each output, and each input or parameter that needs more than a name.

    Returns:
        A decorator, which returns a class that derives from `Component`.

    Raises:
        CallRefused: a declaration does not fit the function, or there is no output.

    Example:
        >>> import fmu_mesh
        >>> @fmu_mesh.component(u=fmu_mesh.Input(unit="V"), y=fmu_mesh.Output(unit="V"))
        ... def amplifier(time, u, k=2.0):
        ...     return k * u
        >>> stage = amplifier()
        >>> stage.u = 1.5
        >>> stage.step(0.0, 0.1)
        >>> stage.y
        3.0
    """

    def decorate(function: Callable[..., object]) -> type[Component]:
        variables: dict[str, Declared[Any]] = {}
        arguments = inspect.signature(function).parameters
        for name, argument in arguments.items():
            if argument.kind not in (argument.POSITIONAL_OR_KEYWORD, argument.KEYWORD_ONLY):
                raise CallRefused(
                    f"the argument '{argument}' of '{function.__name__}' has no name that can be connected"
                )
            if name not in ("time", "step_size"):
                variables[name] = declarations.get(name) or (
                    Input() if argument.default is argument.empty else Parameter(argument.default)
                )
        outputs = {name: declared for name, declared in declarations.items() if isinstance(declared, Output)}
        wrong = [name for name in declarations if (name in outputs) == (name in arguments)]
        if wrong or not outputs:
            problem = f"'{wrong[0]}' does not fit the function" if wrong else "there is no output"
            hint = f"Declare an `Output`, and `Input` or `Parameter` for its arguments {listed([*variables])}."
            raise CallRefused(f"the declarations of '{function.__name__}' are wrong: {problem}", hint=hint)
        members: dict[str, Any] = {
            **variables,
            **outputs,
            "_function": staticmethod(function),
            "_arguments": tuple(arguments),
            "_outputs": tuple(outputs),
            "__doc__": function.__doc__,
            "__module__": function.__module__,
            "__qualname__": function.__qualname__,
        }
        return type(function.__name__, (_FunctionComponent,), members)

    return decorate


def declared_variables(cls: type[Component]) -> dict[str, Declared[Any]]:
    """The variables of a component class by name, those of its bases first."""
    found: dict[str, Declared[Any]] = {}
    for base in reversed(cls.__mro__):
        for name, value in vars(base).items():
            if isinstance(value, Declared):
                found[name] = value
            else:
                found.pop(name, None)
    return found
