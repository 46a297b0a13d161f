"""From the parameter bindings of all systems and components to start values (SSP 2.0, 5.2.3).

Owns which name means which variable, and which of several values counts: a binding of a higher level beats one of a
lower level, and at one level the later one. What a value becomes is `parameter_values`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from typing import Final

import msgspec

from ..text import listed, nearest, shown
from ..variables.model_description import ModelDescription, Value, Variable
from ..variables.value_conversion import ValueRefused, to_value
from .flattening import Describe
from .parameter_reading import refuse_ambiguous
from .parameter_values import AppliedValue, changed, converted, target_of_connector, target_of_variable
from .problems import Problems
from .system_structure import (
    Binding,
    FilePlace,
    MappingEntry,
    ParameterValue,
    Path,
    StructureComponent,
    StructureSystem,
    components_of,
    elements_of,
)

__all__ = ["AppliedValue", "ResolvedParameters", "changed", "resolve_parameters"]

_SHOWN_NAMES: Final = 8
"""Most names of one binding with a warning of their own, if they match nothing."""

_COMPARED_NAMES: Final = 5000
"""Most names of variables in which the nearest one is looked for."""


class ResolvedParameters(msgspec.Struct, frozen=True):
    """The values that the bindings of a system give.

    Attributes:
        of_components: by path of the component and name of the variable.
        of_systems: by path of the system and name of its connector.
    """

    of_components: dict[Path, dict[str, AppliedValue]] = {}
    of_systems: dict[tuple[Path, str], AppliedValue] = {}


def resolve_parameters(system: StructureSystem, describe: Describe, problems: Problems) -> ResolvedParameters:
    """The value of every variable and of every connector of a system that bindings give one.

    Names that match nothing have no effect and are warnings. Only the value that counts is converted. ``describe``
    gives the model description of the component at a path; None if it cannot be read.
    """
    resolution = _Resolution(describe, problems)
    resolution.collect(system, ())
    return resolution.result(system)


class _Candidate(msgspec.Struct, frozen=True):
    """A value that a name leads to."""

    parameter: ParameterValue
    entry: MappingEntry | None


class _Resolution:
    def __init__(self, describe: Describe, problems: Problems) -> None:
        self._describe = describe
        self._problems = problems
        self._of_components: dict[Path, dict[str, _Candidate]] = {}
        self._of_systems: dict[tuple[Path, str], _Candidate] = {}
        self._originals: dict[Path, dict[str, str]] = {}
        self._inside: dict[Path, tuple[set[str], dict[str, StructureComponent | StructureSystem]]] = {}

    def collect(self, system: StructureSystem, path: Path) -> None:
        """Note the values of all bindings, those of the highest level last, so that they replace the others."""
        for element in system.elements:
            if isinstance(element, StructureSystem):
                self.collect(element, (*path, element.name))
            else:
                self._apply_all(element, (*path, element.name))
        self._apply_all(system, path)

    def result(self, system: StructureSystem) -> ResolvedParameters:
        """The values that count, as their variables and connectors take them."""
        resolved = ResolvedParameters({}, {})
        for path, component in components_of(system):
            description = self._describe(path)
            candidates = self._of_components.get(path)
            if candidates and description is not None:
                resolved.of_components[path] = self._of_component(component, path, description, candidates)
        for path, owner in elements_of(system):
            for connector in owner.connectors if isinstance(owner, StructureSystem) else ():
                candidate = self._of_systems.get((path, connector.name))
                if candidate is None or not candidate.parameter.values:
                    continue  # without values, there is a finding
                target = target_of_connector(connector, path)
                value = converted(candidate.parameter, candidate.entry, target, self._problems)
                if value is not None:
                    resolved.of_systems[path, connector.name] = value
        return resolved

    # --- names

    def _apply_all(self, owner: StructureComponent | StructureSystem, path: Path) -> None:
        for binding in owner.bindings:
            self._apply(binding, owner, path)

    def _apply(self, binding: Binding, owner: StructureComponent | StructureSystem, path: Path) -> None:
        """Note the values of one binding at all variables and connectors that their names mean."""
        unmatched: list[tuple[str, FilePlace]] = []
        for name, candidate in self._named(binding):
            if not self._note(owner, path, name, candidate):
                place = candidate.entry.place if candidate.entry is not None else candidate.parameter.place
                unmatched.append((name, place))
            else:
                refuse_ambiguous(binding.values, [candidate.parameter.name], self._problems)
        if not unmatched:
            return
        names = list(islice(self._names(owner, path), _COMPARED_NAMES))
        whose = owner.place.element or f"'{owner.name}'"
        for name, place in unmatched[:_SHOWN_NAMES]:
            near = nearest(name, names)
            found = f"a value for {shown(name)}, which {whose} does not have: it has no effect"
            self._problems.warn(place, found, f"a name such as '{near}'" if near is not None else "")
        if rest := unmatched[_SHOWN_NAMES:]:
            found = f"{len(rest)} more values for names that {whose} does not have: they have no effect"
            self._problems.warn(rest[0][1], f"{found} ({listed([name for name, _ in rest])})")

    def _named(self, binding: Binding) -> Iterator[tuple[str, _Candidate]]:
        """The values of a binding by the names that they are applied to: the prefix comes first, then the mapping."""
        parameters = {f"{binding.prefix}{one.name}": one for one in binding.values.parameters}
        if binding.mapping is None:
            for name, parameter in parameters.items():
                yield name, _Candidate(parameter, None)
            return
        for entry in binding.mapping.entries:
            if entry.source in parameters:
                yield entry.target, _Candidate(parameters[entry.source], entry)
                continue
            near = nearest(entry.source, parameters)
            found = f"the source {shown(entry.source)}, which the parameter set '{binding.values.name}' does not have"
            self._problems.warn(entry.place, found, f"a name such as '{near}'" if near is not None else "")

    def _note(self, owner: StructureComponent | StructureSystem, path: Path, name: str, candidate: _Candidate) -> bool:
        """Give a value to everything that has a name inside an element; return whether there is such a thing."""
        if isinstance(owner, StructureComponent):
            return self._note_variable(path, name, candidate)
        if not owner.is_known:
            return True  # for which there is a finding
        if path not in self._inside:
            connectors = {connector.name for connector in owner.connectors}
            self._inside[path] = connectors, {element.name: element for element in owner.elements}
        connectors, elements = self._inside[path]
        found = name in connectors
        if found:
            self._of_systems[path, name] = candidate
        dot = name.find(".")
        while dot >= 0:  # names of elements may have dots, so several elements may begin one name
            element = elements.get(name[:dot])
            if element is not None:
                found = self._note(element, (*path, element.name), name[dot + 1 :], candidate) or found
            dot = name.find(".", dot + 1)
        return found

    def _note_variable(self, path: Path, name: str, candidate: _Candidate) -> bool:
        description = self._describe(path)
        if description is None:
            return True  # nobody knows; that it cannot be read is a finding of the plan
        variable = description.variable(name)
        if variable is None:
            return False
        if not variable.may_take_start_value:
            found = f"a value for '{name}' of '{'.'.join(path)}', which cannot be set: it has no effect"
            self._problems.warn(candidate.parameter.place, found)
            return True
        self._of_components.setdefault(path, {})[self._original(path, description, variable)] = candidate
        return True

    def _original(self, path: Path, description: ModelDescription, variable: Variable) -> str:
        """The name of the variable itself, if this is an alias of FMI 3.0: of two names for one value, one counts."""
        if not description.fmi_version.startswith("3"):
            return variable.name
        if path not in self._originals:
            first: dict[int, str] = {}
            names = {one.name: first.setdefault(one.value_reference, one.name) for one in description.variables}
            self._originals[path] = names
        return self._originals[path][variable.name]

    def _names(self, owner: StructureComponent | StructureSystem, path: Path) -> Iterator[str]:
        """The names of what can have a value inside an element."""
        if isinstance(owner, StructureComponent):
            description = self._describe(path)
            for variable in description.variables if description is not None else ():
                if variable.settable_before_start:
                    yield variable.name
            return
        yield from (connector.name for connector in owner.connectors)
        for element in owner.elements:
            yield from (f"{element.name}.{name}" for name in self._names(element, (*path, element.name)))

    # --- values

    def _of_component(
        self,
        component: StructureComponent,
        path: Path,
        description: ModelDescription,
        candidates: dict[str, _Candidate],
    ) -> dict[str, AppliedValue]:
        """The values of one component: scalars first, because they may be the sizes of its arrays."""
        values: dict[str, AppliedValue] = {}
        sizes: dict[str, Value] = {}
        for arrays in (False, True):
            for name, candidate in candidates.items():
                variable = description.variable(name)
                if variable is None or bool(variable.dimensions) is not arrays or not candidate.parameter.values:
                    continue
                connector = next((one for one in component.connectors if one.name == name), None)
                target = target_of_variable(variable, path, connector)
                value = converted(candidate.parameter, candidate.entry, target, self._problems)
                if value is None:
                    continue
                values[name] = value
                if variable.causality == "structuralParameter":
                    with suppress(ValueRefused):  # out of its range: the plan has a finding for it
                        sizes[name] = to_value(value.value, variable)
            description = description.sized(sizes)
        return {name: values[name] for name in candidates if name in values}
