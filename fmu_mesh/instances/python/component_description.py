"""From the class of a component to its model description."""

from __future__ import annotations

from collections.abc import Mapping
from inspect import signature
from typing import Any

from msgspec.structs import replace

from ...errors import CallRefused
from ...text import did_you_mean, listed
from ...variables.model_description import ModelDescription, Variable
from .component import Component, declared_variables

__all__ = ["check_arguments", "description_of"]


def description_of(cls: type[Component], content: str) -> ModelDescription:
    """The model description of a component class; `CallRefused` says why it cannot be one.

    ``content`` is the SHA-256 of the file that defines it; processes that disagree about it refuse one another.
    """
    declared = declared_variables(cls)
    if cls.step is Component.step:
        raise CallRefused(f"'{cls.__name__}' has no method `step(self, time, step_size)`")
    hidden = [name for name in declared if hasattr(Component, name)]
    if hidden:
        text = f"the variable '{hidden[0]}' of '{cls.__name__}' has the name of something that every component has"
        raise CallRefused(text, hint="Give it another name.")
    variables = tuple(own.variable(reference) for reference, own in enumerate(declared.values()))
    inputs = [variable.name for variable in variables if variable.causality == "input"]
    initializes = cls.initialize is not Component.initialize
    return ModelDescription(
        model_name=cls.__name__,
        model_identifier=cls.__name__,
        fmi_version="",
        kind="component",
        guid=f"{{{content}:{cls.__name__}}}",
        variables=tuple(_with_dependencies(variable, inputs, initializes=initializes) for variable in variables),
        description=(cls.__doc__ or "").strip().partition("\n")[0] or None,
        generation_tool="Python",
        can_handle_variable_step_size=True,
        can_get_and_set_state=True,
    )


def check_arguments(cls: type[Component], arguments: Mapping[str, Any]) -> None:
    """Check that a component class can be called with these arguments; `CallRefused` says which is wrong."""
    own = cls.__init__ is not object.__init__  # otherwise Python ignores all arguments
    if not own and arguments:
        text = f"'{cls.__name__}' has no `__init__`, which could take the argument '{next(iter(arguments))}'"
        raise CallRefused(text, hint="The values of parameters are `start_values`.")
    if own:
        try:
            signature(cls.__init__).bind(None, **arguments)
        except TypeError as error:
            raise CallRefused(f"`arguments` do not fit `{cls.__name__}.__init__`: {error}") from error


def _with_dependencies(variable: Variable, inputs: list[str], *, initializes: bool) -> Variable:
    """An output with the inputs that its initial value depends on: all, if it is computed and nothing else is said."""
    if variable.causality != "output":
        return replace(variable, dependencies=())
    if variable.dependencies is None:
        return replace(variable, dependencies=tuple(inputs) if initializes else ())
    unknown = next((name for name in variable.dependencies if name not in inputs), None)
    if unknown is not None:
        hint = did_you_mean(unknown, inputs, f"The inputs are {listed(inputs)}.")
        raise CallRefused(f"'{variable.name}' depends on '{unknown}', which is no input", hint=hint)
    return variable
