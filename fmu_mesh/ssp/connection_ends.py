"""The ends of a connection: the connectors that its words mean, what their FMUs say about them, and its direction.

Owns which end is the source. It follows from the owners and kinds of the two ends, never from the words start and end
(SSP 2.0, 5.3.2.1). What happens to a value between the ends is `flattening`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final, Literal

import msgspec

from ..text import listed
from ..variables.model_description import ModelDescription, Variable
from ..variables.value_types import FMI2_TYPES, element_name
from .problems import Problems
from .system_structure import Connector, StructureComponent, StructureConnection, StructureSystem, Unit

__all__ = ["ConnectionEnd", "ConnectionEnds", "Describe", "Segment"]

Path = tuple[str, ...]
Describe = Callable[[Path], ModelDescription | None]
"""The model description of the component at a path; None if it cannot be read."""

_Owner = Literal["system", "element"]

_INTO_AN_ELEMENT: Final[dict[tuple[_Owner, str], tuple[str, ...]]] = {
    ("system", "structuralParameter"): ("structuralParameter", "parameter", "input", "inout"),
    ("system", "parameter"): ("parameter", "input", "inout"),
    ("system", "input"): ("input", "inout"),
    ("element", "constant"): ("structuralParameter", "parameter", "input", "inout"),
    ("element", "calculatedParameter"): ("parameter", "input", "inout"),
    ("element", "output"): ("input", "inout"),
    ("element", "local"): ("input", "inout"),
    ("element", "inout"): ("input",),
}
_OUT_OF_THE_SYSTEM: Final[dict[tuple[_Owner, str], tuple[str, ...]]] = {
    ("system", "structuralParameter"): ("calculatedParameter", "output", "local"),
    ("system", "parameter"): ("calculatedParameter", "output", "local"),
    ("system", "input"): ("output", "local"),
    ("element", "constant"): ("constant", "calculatedParameter", "output", "local"),
    ("element", "calculatedParameter"): ("calculatedParameter", "output", "local"),
    ("element", "output"): ("output", "local"),
    ("element", "local"): ("output", "local"),
    ("element", "inout"): ("output", "local"),
}
"""By owner and kind of the source: the kinds that a destination may have (SSP 2.0, 5.3.2.1)."""


class ConnectionEnd(msgspec.Struct, frozen=True):
    """One end of a connection.

    Attributes:
        owner: whose connector it is, as seen from the system with the connection.
        variable: that of an FMU; None for a connector of a system.
    """

    path: Path
    name: str
    owner: _Owner
    kind: str
    unit: Unit | None
    variable: Variable | None = None
    index: tuple[int, ...] = ()
    is_component: bool = False

    @property
    def node(self) -> tuple[Path, str]:
        """What it is connected by: the variable, or an element of it."""
        return self.path, element_name(self.name, tuple(one - 1 for one in self.index)) if self.index else self.name

    def __str__(self) -> str:
        return ".".join((*self.path, self.node[1]))


class Segment(msgspec.Struct, frozen=True):
    """A connection with its direction."""

    source: ConnectionEnd
    target: ConnectionEnd
    connection: StructureConnection


class ConnectionEnds:
    """Finds the two ends of connections; ``units`` are those of connectors of systems that have none of their own."""

    def __init__(self, describe: Describe, problems: Problems, units: Mapping[tuple[Path, str], Unit]) -> None:
        self._describe = describe
        self._problems = problems
        self._units = units

    def segment(self, system: StructureSystem, path: Path, connection: StructureConnection) -> Segment | None:
        """A connection of a system with its direction; None after a finding."""
        first = self._end(system, path, connection, "start")
        second = self._end(system, path, connection, "end")
        return self._directed(first, second, connection) if first is not None and second is not None else None

    def check(self, component: StructureComponent, path: Path) -> None:
        """Check that the connectors of a component are what its FMU has."""
        description = self._describe(path)
        if description is None:
            return
        clocks = {clock.name for clock in description.clocks}
        names = [one.name for one in component.connectors if one.name not in clocks]
        missing = [name for name in names if description.variable_of(name) is None]
        if missing:  # one that is connected is a finding
            found = f"connectors for variables that {component.source} does not have: {listed(missing)}"
            self._problems.warn_once((component.source, *missing), component.place, found, "component")
        for connector in component.connectors:
            variable = description.variable_of(connector.name)
            if variable is None:
                continue
            has = _kind_of(variable)
            old = description.fmi_version.startswith("1.") and connector.kind not in ("input", "output")
            if connector.kind not in (has, variable.causality, "unspecified", None) and not old:
                found = f"the kind '{connector.kind}', while the variable of the FMU is of causality '{has}'"
                self._problems.add(connector.place, found, f"the kind '{has}'")
            type_ = FMI2_TYPES.get(connector.type or "", connector.type)
            if type_ not in (None, variable.type):
                found = f"the type {connector.type}, while the FMU has {variable.type_name}, which counts"
                self._problems.warn(connector.place, found)
            self._check_unit(connector, variable)

    def _check_unit(self, connector: Connector, variable: Variable) -> None:
        """Warn where a connector and its variable have units that are not the same."""
        unit = connector.unit
        if unit is None or not unit.name or not variable.unit or unit.name == variable.unit:
            return
        if unit.base is None or variable.base_unit is None or unit.base == variable.base_unit:
            return
        found = f"the unit '{unit.name}', while the FMU has '{variable.unit}'; that of the connector counts"
        self._problems.warn(connector.place, found)

    def _directed(self, first: ConnectionEnd, second: ConnectionEnd, connection: StructureConnection) -> Segment | None:
        """A connection with its direction; None after a finding."""
        forwards, backwards = _may_flow(first, second), _may_flow(second, first)
        if forwards and not backwards:
            return Segment(first, second, connection)
        if backwards and not forwards:
            return Segment(second, first, connection)
        ends = f"{_in_words(first)} and {_in_words(second)}"
        if forwards:
            expected = "a kind for one of the two connectors"
            self._problems.add(connection.place, f"no direction between {ends}", expected)
        else:
            self._problems.add(connection.place, f"a connection between {ends}", "a source and a destination")
        return None

    def _end(
        self, system: StructureSystem, path: Path, connection: StructureConnection, side: Literal["start", "end"]
    ) -> ConnectionEnd | None:
        """One end of a connection; None after a finding."""
        element_named = connection.start_element if side == "start" else connection.end_element
        name = connection.start_connector if side == "start" else connection.end_connector
        index = connection.start_index if side == "start" else connection.end_index
        if element_named is None:
            return self._of_system(system, path, name, index, connection, "system")
        element = next((one for one in system.elements if one.name == element_named), None)
        if element is None:
            found = f"the unknown element '{element_named}' of the system '{system.name}'"
            self._problems.unknown(connection.place, found, element_named, [one.name for one in system.elements])
            return None
        own = (*path, element.name)
        if not name or (isinstance(element, StructureSystem) and not element.is_known):
            return None  # there is a finding
        if isinstance(element, StructureSystem):
            return self._of_system(element, own, name, index, connection, "element")
        return self._of_component(element, own, name, index, connection)

    def _of_system(  # noqa: PLR0913, PLR0917  what an end is
        self,
        system: StructureSystem,
        path: Path,
        name: str,
        index: tuple[int, ...],
        connection: StructureConnection,
        owner: _Owner,
    ) -> ConnectionEnd | None:
        connector = next((one for one in system.connectors if one.name == name), None)
        if not name:
            return None  # there is a finding
        if connector is None:
            found = f"the unknown connector '{name}' of the system '{system.name}'"
            self._problems.unknown(connection.place, found, name, [one.name for one in system.connectors])
            return None
        if index:
            expected = "the whole array, or elements of the arrays of components only"
            self._problems.add(connection.place, f"an element of the connector '{name}' of a system", expected)
            return None
        unit = connector.unit or self._units.get((path, name))
        return ConnectionEnd(path, name, owner, connector.kind or "unspecified", unit)

    def _of_component(
        self,
        component: StructureComponent,
        path: Path,
        name: str,
        index: tuple[int, ...],
        connection: StructureConnection,
    ) -> ConnectionEnd | None:
        connector = next((one for one in component.connectors if one.name == name), None)
        description = self._describe(path)
        variable = description.variable_of(name) if description is not None else None
        if connector is None and variable is None:
            found = f"the unknown connector '{name}' of '{component.name}'"
            if description is None:
                found = f"'{component.name}' has no connector '{name}'"
            self._problems.unknown(connection.place, found, name, [one.name for one in component.connectors])
            return None
        if connector is None:
            found = f"'{component.name}' has no connector '{name}'; the variable of its FMU is taken"
            self._problems.warn(connection.place, found)
        elif description is not None and variable is None:
            if name in (clock.name for clock in description.clocks):
                expected = "no connection: a clock of an FMU ticks by itself"
                self._problems.add(connection.place, f"the clock '{name}' of '{component.name}'", expected)
            else:
                found = f"the variable '{name}', which the FMU of '{component.name}' does not have"
                self._problems.unknown(connection.place, found, name, [one.name for one in description.variables])
            return None
        kind: str | None = connector.kind if connector is not None else None
        if kind in (None, "unspecified") and variable is not None:
            kind = _kind_of(variable)
        unit = connector.unit if connector is not None else None
        if unit is None and variable is not None and variable.unit:
            unit = Unit(variable.unit, variable.base_unit)
        return ConnectionEnd(path, name, "element", kind or "unspecified", unit, variable, index, is_component=True)


def _may_flow(source: ConnectionEnd, target: ConnectionEnd) -> bool:
    """Whether values may go from one end to the other."""
    table = _OUT_OF_THE_SYSTEM if target.owner == "system" else _INTO_AN_ELEMENT
    kinds = [kind for owner, kind in table if owner == source.owner] if source.kind == "unspecified" else [source.kind]
    for kind in kinds:
        targets = table.get((source.owner, kind), ())
        if target.kind in targets or (targets and target.kind == "unspecified"):
            return True
    return False


def _kind_of(variable: Variable) -> str:
    """The kind of a connector for a variable."""
    return "constant" if variable.variability == "constant" else variable.causality


def _in_words(end: ConnectionEnd) -> str:
    whose = "the system" if end.owner == "system" else "an element"
    return f"'{end}' ({end.kind} of {whose})"
