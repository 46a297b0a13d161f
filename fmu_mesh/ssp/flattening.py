"""From nested systems to connections between components.

Owns the way of a value through the connectors of systems, and what happens to it on that way: unit conversion first,
then the transformation, at every connection.

A connection between components stands where the last of the connections that it consists of stands in the documents.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import msgspec

from ..variables.units import Linear, conversion
from .connection_ends import ConnectionEnd, ConnectionEnds, Describe, Segment
from .problems import Problems
from .system_structure import FilePlace, StructureSystem, Transformation, Unit

__all__ = ["FlatConnection", "PathChange", "flatten"]

Path = tuple[str, ...]


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
        self._problems = problems
        self._ends = ConnectionEnds(describe, problems, units)
        self._inbound: dict[tuple[Path, str], Segment] = {}

    def collect(self, system: StructureSystem, path: Path) -> None:
        """Give every connection of a system, and of those in it, its direction."""
        for element in system.elements:
            if isinstance(element, StructureSystem):
                self.collect(element, (*path, element.name))
            else:
                self._ends.check(element, (*path, element.name))
        for connection in system.connections:
            segment = self._ends.segment(system, path, connection)
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

    def _way_to(self, last: Segment) -> list[Segment] | None:
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

    def _change(self, way: Sequence[Segment]) -> PathChange | None:
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
        entries = {one.source: one.target for one in mapping.entries} if mapping is not None else {}
        if mapping is None and _by_variables(source, target, own, relative=relative) == total:
            return PathChange(own, place=place)
        return PathChange(total, entries, ignore_units=mapping is None, place=place)

    def _converted(self, unit: Unit | None, target: Unit | None, segment: Segment, *, relative: bool) -> Linear | None:
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


def _by_variables(source: ConnectionEnd, target: ConnectionEnd, own: Linear, *, relative: bool) -> Linear | None:
    """What a connection does by the units of the two variables alone; None if it would be refused."""
    have, want = source.variable, target.variable
    if have is None or want is None or have.base_unit is None or want.base_unit is None:
        return own
    change = conversion(have.base_unit, want.base_unit, relative=relative)
    return change.then(own) if change is not None else None
