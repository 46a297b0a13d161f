"""From nested systems to connections between components.

Owns which end of a connection is its source, which follows from the owners and kinds of the two ends and never from the
words start and end (SSP 2.0, 5.3.2.1); and the way of a value through the connectors of systems with what happens to it
there: unit conversion first, then the transformation, at every connection.

A connection between components stands where the last of the connections that it consists of stands in the documents.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Final, Literal

import msgspec

from ..text import listed
from ..variables.model_description import ModelDescription, Variable
from ..variables.units import Linear, conversion
from ..variables.value_types import FMI2_TYPES, element_name
from .problems import Problems
from .system_structure import (
    FilePlace,
    Path,
    StructureComponent,
    StructureConnection,
    StructureSystem,
    Transformation,
    Unit,
)

__all__ = ["Describe", "FlatConnection", "PathChange", "flatten"]

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


class PathChange(msgspec.Struct, frozen=True):
    """What happens to a value on its way from one component to another.

    Attributes:
        linear: conversions and transformations together; what only the transformations do is ``own``.
        mapping: the values of the target by values of the source, as written; empty if there is no such mapping.
        ignore_units: whether the units of the two variables are not what counts, because ``linear`` has it all.
        place: of the last transformation; None if there is none.
    """

    linear: Linear = Linear()
    mapping: dict[str, str] = {}
    ignore_units: bool = False
    place: FilePlace | None = None


class FlatConnection(msgspec.Struct, frozen=True):
    """A connection to a variable of a component.

    Attributes:
        source: path of the component, and the variable or an element of it as `y[2]`; ``target`` likewise. Or path of a
            system, and a connector of it that nothing is connected to.
        place: of the connection that ends at the target.
    """

    source: tuple[Path, str]
    target: tuple[Path, str]
    change: PathChange
    place: FilePlace


def flatten(
    system: StructureSystem,
    describe: Describe,
    problems: Problems,
    units: Mapping[tuple[Path, str], Unit] = MappingProxyType({}),
) -> tuple[list[FlatConnection], list[FlatConnection]]:
    """The connections between all components of a system, and what unconnected connectors of systems lead to.

    Of what is wrong there is a finding, and the result has the rest. The ``units`` are those of values that parameter
    bindings give to connectors of systems without a unit of their own.
    """
    flattening = _Flattening(describe, problems, units)
    flattening.collect(system, ())
    return flattening.result()


class _Flattening:
    def __init__(self, describe: Describe, problems: Problems, units: Mapping[tuple[Path, str], Unit]) -> None:
        self._describe = describe
        self._problems = problems
        self._units = units
        self._inbound: dict[tuple[Path, str], _Segment] = {}

    def collect(self, system: StructureSystem, path: Path) -> None:
        """Give every connection of a system, and of those in it, its direction."""
        for element in system.elements:
            if isinstance(element, StructureSystem):
                self.collect(element, (*path, element.name))
            else:
                self._check(element, (*path, element.name))
        for connection in system.connections:
            segment = self._segment(system, path, connection)
            if segment is None:
                continue
            other = self._inbound.get(segment.target.node)
            if other is not None:
                place = other.connection.place
                found = f"a second source for '{segment.target}': '{segment.source}', after '{other.source}'"
                where = f"in line {place.line}" if place.file == connection.place.file else f"in {place.file}"
                self._problems.add(connection.place, f"{found} ({where})", "one source")
                continue
            self._inbound[segment.target.node] = segment

    def result(self) -> tuple[list[FlatConnection], list[FlatConnection]]:
        """All connections to components from components, and from systems, both in the order of the documents."""
        found: list[tuple[list[int], bool, FlatConnection]] = []
        for segment in self._inbound.values():
            segments = self._way_to(segment) if segment.target.is_component else None
            change = self._change(segments) if segments is not None else None
            if segments is None or change is None:
                continue
            order = sorted((one.connection.number for one in segments), reverse=True)
            source, target, place = segments[0].source, segment.target, segment.connection.place
            found.append((order, source.is_component, FlatConnection(source.node, target.node, change, place)))
        found.sort(key=lambda one: one[0])
        return [one for _, between, one in found if between], [one for _, between, one in found if not between]

    # --- ways

    def _way_to(self, last: _Segment) -> list[_Segment] | None:
        """The connections on the way to a component, the first one first; None if they form a circle."""
        way = [last]
        while not way[0].source.is_component and (before := self._inbound.get(way[0].source.node)) is not None:
            if before in way:
                first = min(way[: way.index(before) + 1], key=lambda one: one.connection.number)
                found = f"a circle of connectors of systems, through '{first.target}'"
                self._problems.add(first.connection.place, found, "a source that computes the value")
                return None
            way.insert(0, before)
        return way

    def _change(self, way: Sequence[_Segment]) -> PathChange | None:
        """What happens to a value on its way; None after a finding."""
        source, target = way[0].source, way[-1].target
        relative = any(one.variable is not None and one.variable.relative_quantity for one in (source, target))
        unit, total, own = source.unit, Linear(), Linear()
        mapping: Transformation | None = None
        place: FilePlace | None = None
        for segment in way:
            connection, next_unit = segment.connection, segment.target.unit
            if not connection.suppress_unit_conversion:
                change = self._converted(unit, next_unit, segment, relative=relative)
                if change is None:
                    return None
                total = total.then(change)
            unit = next_unit if next_unit is not None else unit
            transformation = connection.transformation
            if transformation is None:
                continue
            place = transformation.place
            if transformation.kind == "linear":
                linear = Linear(transformation.factor, transformation.offset)
                total, own = total.then(linear), own.then(linear)
            elif mapping is not None or not total.identity:
                found = f"a second transformation on the way from '{source}' to '{target}'"
                self._problems.add(transformation.place, found, "one, if one of them is a mapping")
                return None
            else:
                mapping = transformation
        if mapping is not None and not total.identity:
            found = f"a mapping and a factor or a unit conversion on the way from '{source}' to '{target}'"
            self._problems.add(mapping.place, found, "one of the two")
            return None
        entries = mapping.entries if mapping is not None else {}
        if mapping is None and _by_variables(source, target, own, relative=relative) == total:
            return PathChange(own, place=place)
        return PathChange(total, entries, ignore_units=mapping is None, place=place)

    def _converted(self, unit: Unit | None, target: Unit | None, segment: _Segment, *, relative: bool) -> Linear | None:
        """The conversion between two units; None after a finding."""
        if unit is None or target is None or not unit.name or not target.name or unit == target:
            return Linear()
        if unit.base is None or target.base is None:
            if unit.name != target.name:
                undefined = unit.name if unit.base is None else target.name
                found = (
                    f"'{segment.source}' in '{unit.name}' goes to '{segment.target}' in '{target.name}' unconverted, "
                    f"because the unit '{undefined}' is not defined"
                )
                like = "connection", unit.name, target.name
                self._problems.warn_once(like, segment.connection.place, found, "connection")
            return Linear()
        change = conversion(unit.base, target.base, relative=relative)
        if change is None:
            ends = f"'{segment.source}' in '{unit.name}' ({unit.base})", f"'{segment.target}' in '{target.name}'"
            found = f"{ends[0]} to {ends[1]} ({target.base})"
            expected = 'units of one dimension, or suppressUnitConversion="true"'
            self._problems.add(segment.connection.place, found, expected)
        return change

    # --- ends

    def _check(self, component: StructureComponent, path: Path) -> None:
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
            unit = connector.unit
            if unit is None or not unit.name or not variable.unit or unit.name == variable.unit:
                continue
            if unit.base is not None and variable.base_unit is not None and unit.base != variable.base_unit:
                found = f"the unit '{unit.name}', while the FMU has '{variable.unit}'; that of the connector counts"
                self._problems.warn(connector.place, found)

    def _segment(self, system: StructureSystem, path: Path, connection: StructureConnection) -> _Segment | None:
        """A connection of a system with its direction; None after a finding."""
        first = self._end(system, path, connection, "start")
        second = self._end(system, path, connection, "end")
        if first is None or second is None:
            return None
        forwards, backwards = _may_flow(first, second), _may_flow(second, first)
        if forwards and not backwards:
            return _Segment(first, second, connection)
        if backwards and not forwards:
            return _Segment(second, first, connection)
        ends = f"{_in_words(first)} and {_in_words(second)}"
        if forwards:
            expected = "a kind for one of the two connectors"
            self._problems.add(connection.place, f"no direction between {ends}", expected)
        else:
            self._problems.add(connection.place, f"a connection between {ends}", "a source and a destination")
        return None

    def _end(
        self, system: StructureSystem, path: Path, connection: StructureConnection, side: Literal["start", "end"]
    ) -> _ConnectionEnd | None:
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
    ) -> _ConnectionEnd | None:
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
        return _ConnectionEnd(path, name, owner, connector.kind or "unspecified", unit)

    def _of_component(
        self,
        component: StructureComponent,
        path: Path,
        name: str,
        index: tuple[int, ...],
        connection: StructureConnection,
    ) -> _ConnectionEnd | None:
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
        return _ConnectionEnd(path, name, "element", kind or "unspecified", unit, variable, index, is_component=True)


def _by_variables(source: _ConnectionEnd, target: _ConnectionEnd, own: Linear, *, relative: bool) -> Linear | None:
    """What a connection does by the units of the two variables alone; None if it would be refused."""
    have, want = source.variable, target.variable
    if have is None or want is None or have.base_unit is None or want.base_unit is None:
        return own
    change = conversion(have.base_unit, want.base_unit, relative=relative)
    return change.then(own) if change is not None else None


class _ConnectionEnd(msgspec.Struct, frozen=True):
    """One end of a connection; ``owner`` is whose connector it is, as seen from the system with the connection.

    The variable is that of an FMU; None for a connector of a system.
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


class _Segment(msgspec.Struct, frozen=True):
    """A connection with its direction."""

    source: _ConnectionEnd
    target: _ConnectionEnd
    connection: StructureConnection


def _may_flow(source: _ConnectionEnd, target: _ConnectionEnd) -> bool:
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


def _in_words(end: _ConnectionEnd) -> str:
    whose = "the system" if end.owner == "system" else "an element"
    return f"'{end}' ({end.kind} of {whose})"
