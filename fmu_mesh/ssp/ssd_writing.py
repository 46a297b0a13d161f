"""From a mesh to the XML of a system structure description, of SSP 1.0 or 2.0; our annotation in one of another tool.

Owns which elements and attributes stand for what, how values become text, and what a version cannot say. Which files go
into the package is `exporting`, and what no version can say is `own_annotation`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal

import msgspec
from lxml import etree

from ..archives.safe_xml import safe_xml
from ..config.findings import Findings
from ..config.mesh import ConnectionConfig
from ..system.system import Connection, ResolvedSystem
from ..system.value_map import map_words
from ..variables.model_description import Kind, ModelDescription, Value, Variable
from ..variables.units import BaseUnit
from ..variables.value_conversion import to_plain, to_value
from ..variables.value_types import FMI2_TYPES, flattened
from .grammar import NAMESPACES
from .own_annotation import ANNOTATION_ELEMENT, ANNOTATION_TYPE

__all__ = ["ElementNames", "SspVersion", "XmlNode", "is_xml_text", "own_annotation_in", "ssd_of", "with_own_annotation"]

SspVersion = Literal["1.0", "2.0"]

_KINDS_OF_1: Final = ("input", "output", "parameter", "calculatedParameter")
_KINDS: Final = (*_KINDS_OF_1, "structuralParameter")
"""The connectors that are written even if nothing uses them."""

_TYPES_OF_1: Final = {**{type_: name for name, type_ in FMI2_TYPES.items()}, "Binary": "Binary"}
"""The names in SSP 1.0 of the types that it has."""

_IMPLEMENTATIONS: Final[dict[Kind, str]] = {"co_simulation": "CoSimulation", "model_exchange": "ModelExchange"}
_INT_32: Final = range(-(2**31), 2**31)
_SOURCES_OF_PARAMETERS: Final = ("constant", "calculatedParameter")

XmlNode = Any
"""An element of lxml, which ships no types."""

_OWN: Final = f"ssd:System/ssd:Annotations/ssc:Annotation[@type='{ANNOTATION_TYPE}']"
"""The path of our annotation in a description."""


class ElementNames(msgspec.Struct, frozen=True):
    """The names of the elements, and what they are made from.

    Attributes:
        elements: the name of the component, by instance.
        sources: the path of the FMU in the package, by instance.
        kinds: co_simulation or model_exchange, by instance; one that the configuration leaves open has none.
    """

    elements: Mapping[str, str]
    sources: Mapping[str, str]
    kinds: Mapping[str, Kind]


def ssd_of(
    system: ResolvedSystem, names: ElementNames, version: SspVersion, annotation: str | None, findings: Findings
) -> tuple[bytes, set[str]]:
    """A system structure description of a mesh whose instances are FMUs, and the names of the units that it defines.

    What this version of SSP, or no version, can say is a finding. Then the document is useless.
    """
    writer = _Writer(system, names, version, findings)
    return writer.document(annotation), {*writer.units}


class _Writer:
    """Writes one document; ``units`` by name and enumerations are collected on the way."""

    def __init__(self, system: ResolvedSystem, names: ElementNames, version: SspVersion, findings: Findings) -> None:
        self._system = system
        self._names = names
        self._version: SspVersion = version
        self._findings = findings
        self.units: dict[str, BaseUnit] = {}
        self._enumerations: dict[tuple[tuple[str, int], ...], str] = {}

    def document(self, annotation: str | None) -> bytes:
        config = self._system.config
        root = etree.Element(
            _tag_of("ssd:SystemStructureDescription"),
            {"version": self._version, "name": config.mesh, "generationTool": "fmu_mesh"},
            nsmap={prefix: NAMESPACES[prefix] for prefix in ("ssd", "ssc", "ssv")},
        )
        own = _child(root, "ssd:System", name=config.mesh)
        elements = _child(own, "ssd:Elements")
        for name in self._system.instances:
            self._component(elements, name)
        if self._system.connections:
            connections = _child(own, "ssd:Connections")
            for connection in self._system.connections:
                self._connection(connections, connection)
        if annotation is not None:
            own.append(_annotations_element(annotation))
        self._definitions(root)
        experiment = {"startTime": _number_text(config.simulation.start_time)}
        if config.simulation.stop_time is not None:
            experiment["stopTime"] = _number_text(config.simulation.stop_time)
        _child(root, "ssd:DefaultExperiment", **experiment)
        etree.indent(root)
        return bytes(etree.tostring(root, encoding="UTF-8", xml_declaration=True)) + b"\n"

    # --- components

    def _component(self, parent: XmlNode, name: str) -> None:
        description = self._system.instances[name].description
        named = [description.variable_of(key) for key in self._system.config.instances[name].start_values]
        resolved = self._system.instances[name].start_values  # where elements are written, the whole array
        start_values = {variable.name: resolved[variable.name] for variable in named if variable is not None}
        # The type is the default of the standard, but OMSimulator leaves out components of SSP 2.0 without one.
        source, type_ = self._names.sources[name], "application/x-fmu-sharedlibrary"
        component = _child(parent, "ssd:Component", name=self._names.elements[name], type=type_, source=source)
        if name in self._names.kinds:
            component.set("implementation", _IMPLEMENTATIONS[self._names.kinds[name]])
        connected = {one.source.name for one in self._system.connections if one.source_instance == name}
        connected |= {one.target.name for one in self._system.connections if one.target_instance == name}
        # One that is not connected is shown to other tools if they can connect or set it, and it has a type.
        connectors = [
            variable
            for variable in description.variables
            if variable.name in connected
            or ((variable.causality in _KINDS or variable.name in start_values) and self._is_known(variable))
        ]
        if connectors:
            parent = _child(component, "ssd:Connectors")
            for variable in connectors:
                self._connector(parent, variable, description)
        variables = {variable.name: variable for variable in description.variables}
        if start_values:
            self._binding(component, name, [(variables[key], value) for key, value in start_values.items()])

    def _is_known(self, variable: Variable) -> bool:
        """Whether this version of SSP has the kind and the type of a variable."""
        if self._version == "2.0":
            return True
        return variable.causality in _KINDS_OF_1 and not variable.shape and variable.type in _TYPES_OF_1

    def _type(self, variable: Variable) -> str:
        """The name of a type: of the FMU's own version, where this version of SSP has it."""
        if self._version == "1.0":
            return _TYPES_OF_1.get(variable.type, variable.type)
        return variable.declared_type or variable.type

    def _connector(self, parent: XmlNode, variable: Variable, description: ModelDescription) -> None:
        connector = _child(parent, "ssd:Connector", name=variable.name, kind=variable.causality)
        attributes: dict[str, str] = {}
        if variable.type in ("Float64", "Float32") and (unit := self._unit(variable)) is not None:
            attributes["unit"] = unit
        if variable.type == "Enumeration":
            enumeration = self._enumeration(variable, description)
            if enumeration is None:
                return  # the type of the FMU's variable counts
            attributes["name"] = enumeration
        _child(connector, f"ssc:{self._type(variable)}", **attributes)
        self._dimensions(connector, variable)

    def _dimensions(self, parent: XmlNode, variable: Variable) -> None:
        for dimension, size in zip(variable.dimensions, variable.shape, strict=True):
            if isinstance(dimension, str) and parent.tag == _tag_of("ssd:Connector"):
                _child(parent, "ssc:Dimension", sizeConnector=dimension)
            else:
                _child(parent, "ssc:Dimension", size=str(size))

    # --- start values

    def _binding(self, component: XmlNode, name: str, written: Sequence[tuple[Variable, Any]]) -> None:
        binding = _child(_child(component, "ssd:ParameterBindings"), "ssd:ParameterBinding")
        values = _child(binding, "ssd:ParameterValues")
        own = _child(values, "ssv:ParameterSet", version=self._version, name=self._names.elements[name])
        parameters = _child(own, "ssv:Parameters")
        units: dict[str, BaseUnit] = {}
        for variable, plain in written:
            place = f"instances.{name}.start_values.{variable.name}"
            if self._version == "1.0" and (variable.shape or variable.type not in _TYPES_OF_1):
                self._needs_2(place, f"a start value of type {variable.type_name} for '{variable.name}'")
                continue
            value = to_value(plain, variable)
            texts = [_text_of(element, variable) for element in flattened(value, len(variable.shape))]
            if not all(is_xml_text(text) for text in texts):
                found = f"a control character in the start value of '{variable.name}'"
                self._findings.add(place, found, "text without control characters: XML has no place for them")
                continue
            parameter = _child(parameters, "ssv:Parameter", name=variable.name)
            self._value(parameter, variable, texts)
            if variable.type in ("Float64", "Float32") and (unit := self._unit(variable)) is not None:
                parameter[0].set("unit", unit)
                units[unit] = self.units[unit]
            self._dimensions(parameter, variable)
        if units:
            _write_units(_child(own, "ssv:Units"), units)

    def _value(self, parameter: XmlNode, variable: Variable, texts: Sequence[str]) -> None:
        type_ = self._type(variable)
        if variable.type == "Enumeration" and not variable.items:
            type_ = "Integer"  # there are no names of items
        node = _child(parameter, f"ssv:{type_}")
        if not variable.shape:
            node.set("value", texts[0])
        elif type_ in ("String", "Enumeration", "Binary"):
            for text in texts:
                _child(node, "ssv:Value", value=text)
        else:
            node.set("value", " ".join(texts))

    # --- connections

    def _connection(self, parent: XmlNode, connection: Connection) -> None:
        index = int(connection.path.removeprefix("connections[").rstrip("]"))
        config = self._system.config.connections[index]
        assert isinstance(config, ConnectionConfig)
        self._check_ends(connection)
        attributes = {
            "startElement": self._names.elements[connection.source_instance],
            "startConnector": connection.source.name,
            "startIndices": " ".join(str(number + 1) for number in connection.source_index),
            "endElement": self._names.elements[connection.target_instance],
            "endConnector": connection.target.name,
            "endIndices": " ".join(str(number + 1) for number in connection.target_index),
            "suppressUnitConversion": "true" if config.ignore_units else "",
        }
        node = _child(parent, "ssd:Connection", **{name: text for name, text in attributes.items() if text})
        self._transformation(node, connection, config)

    def _transformation(self, node: XmlNode, connection: Connection, config: ConnectionConfig) -> None:
        if (config.factor, config.offset) != (1.0, 0.0):
            _child(
                node, "ssc:LinearTransformation", factor=_number_text(config.factor), offset=_number_text(config.offset)
            )
        if not connection.map:
            return
        source, target = connection.source, connection.target
        kind = _map_kind(source, target)
        place = f"{connection.path}.map"
        if kind is None:
            expected = "two ends of type Boolean, or none: SSP has no other maps of Boolean"
            self._findings.add(place, f"a map from {source.type_name} to {target.type_name}", expected)
            return
        pairs = {str(have): str(want) for have, want in connection.map}
        if kind != "Integer":
            pairs = map_words(connection.map, source, target)
        elif self._version == "1.0" and not all(number in _INT_32 for pair in connection.map for number in pair):
            self._needs_2(place, "a number of more than 32 bits")
        parent = _child(node, f"ssc:{kind}MappingTransformation")
        for have, want in pairs.items():
            _child(parent, "ssc:MapEntry", source=have, target=want)

    def _check_ends(self, connection: Connection) -> None:
        source, target = connection.source, connection.target
        if target.causality != "input" and source.causality not in _SOURCES_OF_PARAMETERS:
            found = f"{connection}, from {source.role} to {target.role}"
            expected = "a start value for it: SSP has such connections from calculated parameters only"
            self._findings.add(connection.path, found, expected)
        if self._version == "2.0":
            return
        for variable, index in ((source, connection.source_index), (target, connection.target_index)):
            if index:
                self._needs_2(connection.path, f"{connection}, which connects an element of an array")
            elif not self._is_known(variable):
                what = variable.causality if variable.causality not in _KINDS_OF_1 else f"type {variable.type_name}"
                self._needs_2(connection.path, f"{connection}, where '{variable.name}' is of {what}")

    def _needs_2(self, path: str, found: str) -> None:
        self._findings.add(path, found, 'SSP 2.0, as with `version="2.0"`')

    # --- definitions

    def _unit(self, variable: Variable) -> str | None:
        """The name of a variable's unit in the document; None if the FMU's counts.

        That is where the FMU does not define it, or where another FMU has another definition of this name.
        """
        name, base = variable.unit, variable.base_unit
        if name is None or base is None or not base.usable:
            return None
        return name if self.units.setdefault(name, base) == base else None

    def _enumeration(self, variable: Variable, description: ModelDescription) -> str | None:
        """The name of an enumeration in the document; None if it cannot be defined there."""
        if not variable.items or not all(number in _INT_32 for _, number in variable.items):
            return None
        if variable.items not in self._enumerations:
            wanted, names = f"{description.model_name}.{variable.name}", {*self._enumerations.values()}
            name, number = wanted, 1
            while name in names:
                number += 1
                name = f"{wanted} {number}"
            self._enumerations[variable.items] = name
        return self._enumerations[variable.items]

    def _definitions(self, root: XmlNode) -> None:
        if self._enumerations:
            parent = _child(root, "ssd:Enumerations")
            for items, name in self._enumerations.items():
                enumeration = _child(parent, "ssc:Enumeration", name=name)
                for item, number in items:
                    _child(enumeration, "ssc:Item", name=item, value=str(number))
        if self.units:
            _write_units(_child(root, "ssd:Units"), self.units)


def _map_kind(source: Variable, target: Variable) -> str | None:
    """Which of the mappings of SSP a map is; None if it is none of them."""
    types = {source.type, target.type}
    if types == {"Boolean"}:
        return "Boolean"
    if types == {"Enumeration"} and source.items and target.items:
        return "Enumeration"
    return "Integer" if "Boolean" not in types else None


def _text_of(value: Value, variable: Variable) -> str:
    """A scalar value as an attribute of a parameter set has it."""
    match value:
        case bool():
            return "true" if value else "false"
        case float():
            return _number_text(value)
        case bytes():
            return value.hex().upper()
        case int() if variable.type == "Enumeration":
            return next((item for item, number in variable.items if number == value), str(value))
    return str(value)


def _number_text(value: float) -> str:
    """A number as xs:double, which gives back the same one: its words for NaN and infinity are those of FMI."""
    return str(to_plain(float(value)))


def _tag_of(name: str) -> str:
    """The name of an element with its namespace, from a name with the usual prefix: `ssd:System`."""
    prefix, _, local = name.partition(":")
    return f"{{{NAMESPACES[prefix]}}}{local}"


def _child(parent: XmlNode, name: str, /, **attributes: str) -> XmlNode:
    """Add an element to another one; ``name`` has the usual prefix."""
    return etree.SubElement(parent, _tag_of(name), attributes)


def _write_units(parent: XmlNode, units: Mapping[str, BaseUnit]) -> None:
    """Add the definitions of units to the element `Units` of a document."""
    for name, base in sorted(units.items()):
        fields = {
            key: value for key, value in msgspec.structs.asdict(base).items() if value != getattr(BaseUnit(), key)
        }
        texts = {key: str(value) if isinstance(value, int) else _number_text(value) for key, value in fields.items()}
        _child(_child(parent, "ssc:Unit", name=name), "ssc:BaseUnit", **texts)


def _annotations_element(text: str) -> XmlNode:
    """The element `ssd:Annotations` of a root system, with our annotation and no other."""
    parent = etree.Element(_tag_of("ssd:Annotations"), nsmap={prefix: NAMESPACES[prefix] for prefix in ("ssd", "ssc")})
    entry = _child(parent, "ssc:Annotation", type=ANNOTATION_TYPE)
    namespace = etree.QName(ANNOTATION_ELEMENT).namespace
    etree.SubElement(entry, ANNOTATION_ELEMENT, nsmap={None: namespace}).text = text
    return parent


def own_annotation_in(document: bytes) -> str | None:
    """The text of our annotation in a system structure description; None if the root system has none."""
    element = safe_xml(document, "the description").find(f"{_OWN}/*", NAMESPACES)
    return None if element is None else element.text or ""


def with_own_annotation(document: bytes, text: str | None) -> bytes:
    """A system structure description with another text of our annotation; None: without an annotation of ours.

    The document is written again, and says the same as before: elements, attributes, comments and the blanks between
    them stay, also those of other tools. Quotes, character references and blanks inside of tags may change.
    """
    root = safe_xml(document, "the description")
    for old in root.findall(_OWN, NAMESPACES):
        old.getparent().remove(old)
    if text is not None:
        made, system = _annotations_element(text), root.find("ssd:System", NAMESPACES)
        there = system.find("ssd:Annotations", NAMESPACES)
        if there is None:
            system.append(made)
        else:
            there.append(made[0])
    tree = root.getroottree()
    return bytes(etree.tostring(tree, encoding=tree.docinfo.encoding or "UTF-8", xml_declaration=True))


def is_xml_text(text: str) -> bool:
    """Whether XML can hold a text: it has no place for most control characters (XML 1.0, 2.2)."""
    return all(
        character in "\t\n\r" or " " <= character < "\ud800" or "\ue000" <= character < "\ufffe" or character > "\uffff"
        for character in text
    )
