"""From a system structure description to Structs, with the systems, parameter sets and mappings that it refers to.

A component that is a system itself (`application/x-ssp-definition`, `application/x-ssp-package`, `#id`) is read as the
system (SSP 2.0, 5.4). What connections and bindings mean is `flattening` and `parameter_bindings`.
"""

from __future__ import annotations

import posixpath
from collections.abc import Iterable
from pathlib import Path
from typing import Final, Literal, NamedTuple, TypeVar, cast, get_args

from msgspec.structs import replace

from ..errors import ConfigurationError
from ..text import shown
from .file_definitions import enumeration_named, enumerations_of, transformation_of, unit_named, units_of
from .grammar import TYPES
from .package import DEFAULT, Package
from .parameter_reading import parameter_mapping, parameter_set, refuse_ambiguous
from .problems import Problems
from .system_structure import (
    Annotation,
    Binding,
    Connector,
    ConnectorKind,
    Enumeration,
    FilePlace,
    ParameterMapping,
    Structure,
    StructureComponent,
    StructureConnection,
    StructureSystem,
    Unit,
)
from .xml_reading import XmlElement, read_xml

__all__ = ["read_structure"]

Named = TypeVar("Named", StructureComponent | StructureSystem, Connector)

_FMU: Final = "application/x-fmu-sharedlibrary"
_DEFINITION: Final = "application/x-ssp-definition"
_PACKAGE: Final = "application/x-ssp-package"
_SET: Final = "application/x-ssp-parameter-set"
_MAPPING: Final = "application/x-ssp-parameter-mapping"
_MODELICA: Final = "text/x-modelica"
_IMPLEMENTATIONS: Final[dict[str, Literal["any", "CoSimulation", "ModelExchange"]]] = {
    "CoSimulation": "CoSimulation",
    "ModelExchange": "ModelExchange",
}
_MAXIMUM_DEPTH: Final = 32
"""Most systems inside one another."""

_MAXIMUM_NESTED: Final = 1000
"""Most components that are systems: a few small files that refer to one another could have any number of them."""


def read_structure(package: Package, name: str, problems: Problems) -> Structure | None:
    """A system structure description of a package with everything in it that is right; None if there is nothing."""
    return _Reader(package, problems).structure(name, 0)


class _File(NamedTuple):
    """What elements of one file refer to; ``around`` are the files and systems that are read while this one is."""

    name: str
    units: dict[str, Unit]
    enumerations: dict[str, Enumeration]
    around: tuple[str, ...]

    @property
    def folder(self) -> str:
        """The folder that relative URIs in the file refer to."""
        return posixpath.dirname(self.name)


def read_values(package: Package, name: str, problems: Problems) -> Binding | None:
    """The values of an SSV file, in the package or else on the disk, as a binding without a mapping.

    None after a finding.

    Raises:
        ConfigurationError: there is no such file, or it cannot be read.
    """
    if package.exists(name):
        data, shown_name = package.read(name), package.shown(name)
    else:
        data, shown_name = package.read_beside(Path(name)), name
    root = read_xml(data, shown_name, "ssv:ParameterSet", problems)
    return Binding(parameter_set(root, problems)) if root is not None else None


class _Reader:
    def __init__(self, package: Package, problems: Problems) -> None:
        self._package = package
        self._problems = problems
        self._connections = 0
        self._nested_systems = 0

    def structure(self, name: str, depth: int, around: tuple[str, ...] = ()) -> Structure | None:
        root = self._root(name, "ssd:SystemStructureDescription")
        if root is None:
            return None
        file = _File(
            name,
            units_of(root, "ssd:Units", self._problems),
            enumerations_of(root, "ssd:Enumerations", self._problems),
            (*around, name),
        )
        self._not_verified(root)
        top = root.child("ssd:System")
        if top is None:
            return None
        system = self._system(top, file, depth)
        structure = Structure(root.text("name"), root.version, system, root.place, annotations=root.annotations())
        if (experiment := root.child("ssd:DefaultExperiment")) is None:
            return structure
        return replace(
            structure,
            start_time=experiment.optional_number("startTime"),
            stop_time=experiment.optional_number("stopTime"),
            annotations=(*structure.annotations, *experiment.annotations()),
        )

    def _root(self, name: str, tag: str) -> XmlElement | None:
        """The root element of a file; None after a finding."""
        try:
            data = self._package.read(name)
        except ConfigurationError as error:
            hint = f" {error.hint}" if error.hint else ""
            self._problems.add(FilePlace(self._package.shown(name), 0, ""), f"{error.message}{hint}", "")
            return None
        return read_xml(data, self._package.shown(name), tag, self._problems)

    def _system(self, element: XmlElement, file: _File, depth: int) -> StructureSystem:
        elements: list[StructureComponent | StructureSystem] = []
        for child in element.inside("ssd:Elements"):
            match child.tag:
                case "ssd:Component":
                    elements.append(self._component(child, file, depth))
                case "ssd:System" if depth < _MAXIMUM_DEPTH:
                    elements.append(self._system(child, file, depth + 1))
                case "ssd:System":
                    self._too_deep(child.place)
                case "ssd:SignalDictionaryReference":
                    expected = "connections between the connectors themselves: signal dictionaries are not supported"
                    self._problems.add(child.place, "a reference to a signal dictionary", expected)
        elements = self._unique(elements, "element")
        if (dictionaries := element.child("ssd:SignalDictionaries")) is not None and dictionaries.child() is not None:
            self._problems.warn(dictionaries.place, "signal dictionaries are not supported, and not read")
        self._not_verified(element)
        return StructureSystem(
            name=element.text("name"),
            place=element.place,
            connectors=self._connectors(element, file),
            elements=tuple(elements),
            connections=tuple(self._connection(one) for one in element.inside("ssd:Connections")),
            bindings=self._bindings(element, file, None),
            annotations=element.annotations(),
            description=element.get("description"),
        )

    # --- components

    def _component(self, element: XmlElement, file: _File, depth: int) -> StructureComponent | StructureSystem:
        """A component, or the system that it is; after a finding with its connectors only."""
        type_ = (element.get("type") or _FMU).strip()
        source = element.get("source")
        if source is None:
            self._problems.add(element.place, "no source: nothing computes it", "an FMU as its source")
            return self._unknown(element, file)
        if not element.get("name"):
            return self._unknown(element, file)  # there is a finding
        if type_ not in (_FMU, _DEFINITION, _PACKAGE):
            expected = f"{_FMU}, {_DEFINITION} or {_PACKAGE}"
            self._problems.add(element.place, f"the type '{type_}'", expected)
            return self._unknown(element, file)
        if type_ != _FMU:
            return self._nested(element, file, source, depth)
        name = self._package.named_by(source, file.folder, element.place, self._problems)
        if name is None:
            return self._unknown(element, file)
        implementation = element.get("implementation")
        if implementation == "ScheduledExecution":
            expected = "CoSimulation or ModelExchange"
            self._problems.add(element.place, f"the implementation '{implementation}'", expected)
        self._not_verified(element)
        return StructureComponent(
            name=element.text("name"),
            source=name,
            place=element.place,
            implementation=_IMPLEMENTATIONS.get(implementation or "", "any"),
            connectors=self._connectors(element, file),
            bindings=self._bindings(element, file, name),
            annotations=element.annotations(),
            description=element.get("description"),
        )

    def _nested(self, element: XmlElement, file: _File, source: str, depth: int) -> StructureSystem:
        """A component that is a system: that system under the name of the component, with its bindings last."""
        self._nested_systems += 1
        if self._nested_systems == _MAXIMUM_NESTED + 1:
            found = f"more than {_MAXIMUM_NESTED} components that are systems"
            self._problems.add(element.place, found, "fewer: do files refer to one another several times?")
        if self._nested_systems > _MAXIMUM_NESTED:
            return self._unknown(element, file)
        if depth >= _MAXIMUM_DEPTH:
            self._too_deep(element.place)
            return self._unknown(element, file)
        uri, _, fragment = source.partition("#")
        system: StructureSystem | None = None
        if not uri and fragment:
            system = self._defined(element, file, fragment, depth)
        else:
            name = self._package.named_by(uri, file.folder, element.place, self._problems)
            if name is not None and not name.lower().endswith(".ssd"):
                name = posixpath.join(name, fragment or DEFAULT)
            if name in file.around:
                self._problems.add(element.place, f"the system '{name}' inside itself", "another system")
            elif name is not None:
                structure = self.structure(name, depth + 1, file.around)
                system = structure.system if structure is not None else None
        if system is None:
            return self._unknown(element, file)
        own = self._bindings(element, file, None)
        return replace(system, name=element.text("name"), place=element.place, bindings=(*system.bindings, *own))

    def _defined(self, element: XmlElement, file: _File, identifier: str, depth: int) -> StructureSystem | None:
        """The system of the same file with this id; None after a finding."""
        definition = element.with_id(identifier)
        if definition is None or definition.tag != "ssd:System":
            self._problems.add(element.place, f"the source '#{identifier}'", f"the id of a System in {file.name}")
            return None
        own = f"{file.name}#{identifier}"
        if own in file.around or element.is_inside(definition):
            self._problems.add(element.place, f"the system '#{identifier}' inside itself", "another system")
            return None
        return self._system(definition, file._replace(around=(*file.around, own)), depth + 1)

    def _unknown(self, element: XmlElement, file: _File) -> StructureSystem:
        """What stands for a component that cannot be read, for which there is a finding."""
        return StructureSystem(
            element.text("name"), element.place, connectors=self._connectors(element, file), is_known=False
        )

    # --- connectors and connections

    def _connectors(self, element: XmlElement, file: _File) -> tuple[Connector, ...]:
        connectors = [self._connector(one, file) for one in element.inside("ssd:Connectors")]
        return tuple(self._unique(connectors, "connector"))

    def _connector(self, element: XmlElement, file: _File) -> Connector:
        type_ = element.child(*(f"ssc:{name}" for name in TYPES))
        place, unit, enumeration, name = element.place, None, None, None
        if type_ is not None:
            name = type_.tag.partition(":")[2]
            unit = unit_named(type_.get("unit"), file.units)
            if name == "Enumeration" and (wanted := type_.text("name")):
                enumeration = enumeration_named(wanted, file.enumerations, place, self._problems)
            if name == "Binary" and (type_.get("mime-type") or "").startswith(_MODELICA):
                name = None  # the FMU's variable says the type
        kind = element.get("kind")
        return Connector(
            name=element.text("name"),
            kind=cast("ConnectorKind", kind) if kind in get_args(ConnectorKind) else None,
            place=place,
            type=name,
            unit=unit,
            enumeration=enumeration,
            dimensions=tuple(
                one.integer("size") if one.get("size") is not None else one.get("sizeConnector")
                for one in element.children("ssc:Dimension")
            ),
        )

    def _connection(self, element: XmlElement) -> StructureConnection:
        self._connections += 1
        return StructureConnection(
            start_connector=element.text("startConnector"),
            end_connector=element.text("endConnector"),
            place=element.place,
            start_element=element.get("startElement") or None,  # OMSimulator writes an empty one
            end_element=element.get("endElement") or None,
            start_index=element.numbers("startIndices"),
            end_index=element.numbers("endIndices"),
            suppress_unit_conversion=element.boolean("suppressUnitConversion"),
            transformation=transformation_of(element, self._problems),
            number=self._connections,
        )

    # --- parameters

    def _bindings(self, element: XmlElement, file: _File, component: str | None) -> tuple[Binding, ...]:
        return tuple(
            binding
            for one in element.inside("ssd:ParameterBindings")
            if (binding := self._binding(one, file, component)) is not None
        )

    def _binding(self, element: XmlElement, file: _File, component: str | None) -> Binding | None:
        """A binding with the parameters and the mapping that it refers to; None after a finding."""
        inline = element.child("ssd:ParameterValues")
        values = self._referred(element, inline, "ssv:ParameterSet", _SET, file, component)
        if values is None:
            return None
        if element.get("source"):
            parameters = parameter_set(values, self._problems)
        else:  # a set inside this file
            parameters = parameter_set(values, self._problems, file.units, file.enumerations)
        mapping = element.child("ssd:ParameterMapping")
        entries: ParameterMapping | None = None
        if mapping is not None:
            found = self._referred(mapping, mapping, "ssm:ParameterMapping", _MAPPING, file, component)
            if found is None:  # nobody knows which of the parameters it applies
                refuse_ambiguous(parameters, parameters.ambiguous, self._problems)
                return None
            entries = parameter_mapping(found, self._problems)
        return Binding(parameters, element.get("prefix") or "", entries)

    def _referred(  # noqa: PLR0913, PLR0917  what a reference consists of
        self,
        element: XmlElement,
        inline: XmlElement | None,
        tag: str,
        type_: str,
        file: _File,
        component: str | None,
    ) -> XmlElement | None:
        """The root of the document that an element refers to or contains; None after a finding."""
        what = tag.partition(":")[2]
        given = (element.get("type") or type_).strip()
        if given != type_:
            self._problems.add(element.place, f"the type '{given}'", type_)
            return None
        source = element.get("source")
        content = inline.child(tag) if inline is not None else None
        if source and content is not None:
            self._problems.add(element.place, f"a source and a {what} inside it", "one of the two")
            return None
        if content is not None:
            return content
        if source is None:
            self._problems.add(element.place, f"neither a source nor a {what}", "one of the two")
            return None
        base = file.folder
        if element.get("sourceBase") == "component":
            if component is None:
                self._problems.add(element.place, "sourceBase 'component' outside of an FMU", "SSD")
                return None
            base = component
        name = self._package.named_by(source, base, element.place, self._problems)
        return self._root(name, tag) if name is not None else None

    # --- findings

    def _unique(self, named: Iterable[Named], what: str) -> list[Named]:
        """Those with a name that none before them has; the others are findings."""
        first: dict[str, Named] = {}
        for one in named:
            if one.name in first:
                found = f"a second {what} '{one.name}', first in line {first[one.name].place.line}"
                self._problems.add(one.place, found, "names of their own inside a system")
            first.setdefault(one.name, one)
        return list(first.values())

    def _too_deep(self, place: FilePlace) -> None:
        found = f"more than {_MAXIMUM_DEPTH} systems inside one another"
        self._problems.add(place, found, "fewer")

    def _not_verified(self, element: XmlElement) -> None:
        for signature in element.children("ssc:Signature"):
            self._problems.warn(signature.place, f"a signature of type {shown(signature.text('type'))} is not verified")


def annotations_of(structure: Structure) -> tuple[Annotation, ...]:
    """The annotations that may say how a whole system is simulated."""
    return (*structure.system.annotations, *structure.annotations)
