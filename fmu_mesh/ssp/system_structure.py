"""What the XML files of a package say, as frozen Structs: names and values as they are written, each with its place.

Owns the words of the standard: elements, connectors, connections, bindings, parameter sets and mappings. Names of units
are resolved, because each file has its own (SSP 2.0, 4.4.2); everything else is resolved by `flattening` and
`parameter_bindings`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import msgspec

from ..variables.units import BaseUnit

__all__ = [
    "Annotation",
    "Binding",
    "Connector",
    "ConnectorKind",
    "Element",
    "Enumeration",
    "FilePlace",
    "MappingEntry",
    "ParameterMapping",
    "ParameterSet",
    "ParameterValue",
    "Path",
    "Structure",
    "StructureComponent",
    "StructureConnection",
    "StructureSystem",
    "Transformation",
    "Unit",
    "components_of",
    "elements_of",
]

ConnectorKind = Literal[
    "input",
    "output",
    "inout",
    "parameter",
    "calculatedParameter",
    "structuralParameter",
    "constant",
    "local",
    "unspecified",
]


Path = tuple[str, ...]
"""The names of the elements on the way from the root system to one; empty for the root system."""

Enumeration = dict[str, int]
"""An enumeration that a file defines (SSP 2.0, 4.4.1): the values by the names of the items."""


class FilePlace(msgspec.Struct, frozen=True):
    """Where something is written.

    Attributes:
        file: the file as messages name it, such as `system.ssp/SystemStructure.ssd`.
        line: counted from 1.
        element: the element in words, such as `Connector 'u' of Component 'gain'`.
    """

    file: str
    line: int
    element: str


class Unit(msgspec.Struct, frozen=True):
    """A unit that a file refers to.

    Attributes:
        name: as written; empty: explicitly no unit.
        base: in SI base units; None if the file does not define it.
    """

    name: str
    base: BaseUnit | None = None


class Connector(msgspec.Struct, frozen=True):
    """A connector of an element (SSP 2.0, 5.2.1).

    Attributes:
        kind: None if it is not given, which counts as unspecified.
        type: the name of the type's element, such as Real or Float64; None if it has none. Binary with a media type of
            Modelica is None, too: it stands for the type of the FMU's variable.
        unit: None if it is not given; then the unit of the FMU's variable counts.
        dimensions: the fixed sizes, or the names of connectors; None where neither is given.
    """

    name: str
    kind: ConnectorKind | None
    place: FilePlace
    type: str | None = None
    unit: Unit | None = None
    enumeration: Enumeration | None = None
    dimensions: tuple[int | str | None, ...] = ()


class Transformation(msgspec.Struct, frozen=True):
    """A transformation of a connection or of a mapped parameter (SSP 2.0, 4.5.2).

    Attributes:
        kind: linear: factor and offset; otherwise ``entries``.
        entries: targets by sources: both are `true` or `false`, a whole number as `3`, or the name of an item.
    """

    kind: Literal["linear", "boolean", "integer", "enumeration"]
    place: FilePlace
    factor: float = 1.0
    offset: float = 0.0
    entries: dict[str, str] = {}


class StructureConnection(msgspec.Struct, frozen=True):
    """A connection inside a system. Its start is not always its source (SSP 2.0, 5.3.2).

    Attributes:
        start_element: the name of an element of the system; None: ``start_connector`` is one of the system itself.
        start_index: the element of an array, counted from 1; empty: all of it. ``end_index`` likewise.
        number: its position among all connections, in the order of the documents.
    """

    start_connector: str
    end_connector: str
    place: FilePlace
    start_element: str | None = None
    end_element: str | None = None
    start_index: tuple[int, ...] = ()
    end_index: tuple[int, ...] = ()
    suppress_unit_conversion: bool = False
    transformation: Transformation | None = None
    number: int = 0


class ParameterValue(msgspec.Struct, frozen=True):
    """One parameter of a parameter set (SSP 2.0, 6.2).

    Attributes:
        type: the name of the type's element, such as Real or Int32.
        values: as written: one for a scalar; for an array all elements, row by row. Empty: there is a finding.
        unit: None if it is not given: no conversion takes place.
        dimensions: the sizes of an array; empty for a scalar, or if the file does not say.
    """

    name: str
    type: str
    values: tuple[str, ...]
    place: FilePlace
    unit: Unit | None = None
    enumeration: Enumeration | None = None
    dimensions: tuple[int, ...] = ()


class ParameterSet(msgspec.Struct, frozen=True):
    """The parameters of an SSV file, or of an inline one (SSP 2.0, 6.1), in their order.

    Attributes:
        parameters: the first one of each name.
        ambiguous: where a second one of a name has another value; that name must not be applied.
    """

    name: str
    parameters: tuple[ParameterValue, ...]
    place: FilePlace
    ambiguous: dict[str, FilePlace] = {}


class MappingEntry(msgspec.Struct, frozen=True):
    """One entry of a parameter mapping (SSP 2.0, 7.1.1)."""

    source: str
    target: str
    place: FilePlace
    suppress_unit_conversion: bool = False
    transformation: Transformation | None = None


class ParameterMapping(msgspec.Struct, frozen=True):
    """The entries of an SSM file, or of an inline one (SSP 2.0, 7.1)."""

    entries: tuple[MappingEntry, ...]
    place: FilePlace


class Binding(msgspec.Struct, frozen=True):
    """A parameter binding whose sources were read (SSP 2.0, 5.2.3).

    Attributes:
        prefix: put in front of every name of ``values`` before the mapping and the lookup.
        mapping: only the parameters that it names are applied; None: all of them, by their own names.
    """

    values: ParameterSet
    prefix: str = ""
    mapping: ParameterMapping | None = None


class Annotation(msgspec.Struct, frozen=True):
    """One annotation (SSP 2.0, 4.2).

    Attributes:
        type: its namespace, such as `org.openmodelica`.
        elements: all elements inside it, with their names without the namespace, and their attributes.
        text: the text of the first element inside it, without those in that element; empty if there is none.
    """

    type: str
    elements: tuple[tuple[str, dict[str, str]], ...]
    place: FilePlace
    text: str = ""


class StructureComponent(msgspec.Struct, frozen=True):
    """An FMU of a system (SSP 2.0, 5.4). Components that are systems themselves are read as systems.

    Attributes:
        source: path of the FMU, relative to the file that a plan of this package refers to.
        description: for a person.
    """

    name: str
    source: str
    place: FilePlace
    implementation: Literal["any", "CoSimulation", "ModelExchange"] = "any"
    connectors: tuple[Connector, ...] = ()
    bindings: tuple[Binding, ...] = ()
    annotations: tuple[Annotation, ...] = ()
    description: str | None = None


class StructureSystem(msgspec.Struct, frozen=True):
    """A system: elements and the connections between them (SSP 2.0, 5.3).

    Attributes:
        is_known: false: it stands for a component that cannot be read, for which there is a finding.
    """

    name: str
    place: FilePlace
    connectors: tuple[Connector, ...] = ()
    elements: tuple[StructureComponent | StructureSystem, ...] = ()
    connections: tuple[StructureConnection, ...] = ()
    bindings: tuple[Binding, ...] = ()
    annotations: tuple[Annotation, ...] = ()
    description: str | None = None
    is_known: bool = True


Element = StructureComponent | StructureSystem


class Structure(msgspec.Struct, frozen=True):
    """A system structure description (SSP 2.0, 5.1).

    Attributes:
        start_time: of its default experiment, in s; None if it has none. ``stop_time`` likewise.
        annotations: those of the description and of its default experiment; the root system has its own.
    """

    name: str
    version: str
    system: StructureSystem
    place: FilePlace
    start_time: float | None = None
    stop_time: float | None = None
    annotations: tuple[Annotation, ...] = ()


def elements_of(system: StructureSystem, path: Path = ()) -> Iterator[tuple[Path, Element]]:
    """A system and all elements inside it with their paths, in the order of the documents."""
    yield path, system
    for element in system.elements:
        own = (*path, element.name)
        if isinstance(element, StructureSystem):
            yield from elements_of(element, own)
        else:
            yield own, element


def components_of(system: StructureSystem) -> Iterator[tuple[Path, StructureComponent]]:
    """All components of a system and of those in it, with their paths."""
    return ((path, element) for path, element in elements_of(system) if isinstance(element, StructureComponent))
