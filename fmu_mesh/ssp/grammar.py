"""The elements and attributes of SSP 1.0 and 2.0, as a table: what may stand where, and what its values are.

Geometry, meta data and annotations are not looked into: they do not change what a system computes.
"""

from __future__ import annotations

import re
from typing import Final, NamedTuple, get_args

import msgspec

from .system_structure import ConnectorKind

__all__ = ["GRAMMAR", "NAMESPACES", "PATTERNS", "TYPES", "Attribute", "Rule", "number_of"]

NAMESPACES: Final = {
    "ssd": "http://ssp-standard.org/SSP1/SystemStructureDescription",
    "ssc": "http://ssp-standard.org/SSP1/SystemStructureCommon",
    "ssv": "http://ssp-standard.org/SSP1/SystemStructureParameterValues",
    "ssm": "http://ssp-standard.org/SSP1/SystemStructureParameterMapping",
    "ssb": "http://ssp-standard.org/SSP1/SystemStructureSignalDictionary",
}
"""The namespaces by their usual prefixes; they are the same in both versions."""

_NUMBER: Final = r"[-+]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?|-?INF|NaN"
PATTERNS: Final = {
    "text": re.compile(r"(?s).*"),
    "name": re.compile(r"(?s).+"),
    "number": re.compile(_NUMBER),
    "integer": re.compile(r"[-+]?[0-9]{1,20}"),
    "size": re.compile(r"\+?[0-9]{1,20}"),
    "boolean": re.compile(r"true|false|0|1"),
}
"""The values of attributes by type, after XML Schema."""

_IN_WORDS: Final = {
    "text": "a text",
    "name": "a name that is not empty",
    "number": "a number",
    "integer": "a whole number",
    "size": "a whole number >= 0",
    "boolean": "true or false",
}

_TYPES_OF_1: Final = ("Real", "Integer", "Boolean", "String", "Enumeration", "Binary")
_TYPES_OF_2: Final = (
    "Float64",
    "Float32",
    "Int8",
    "UInt8",
    "Int16",
    "UInt16",
    "Int32",
    "UInt32",
    "Int64",
    "UInt64",
)
TYPES: Final = (*_TYPES_OF_1, *_TYPES_OF_2, "Clock")
"""The elements that say the type of a connector."""


class Attribute(NamedTuple):
    """One attribute.

    Attributes:
        type: a key of `PATTERNS`.
        words: the only values, if there are such.
        is_list: whether it has several values with blanks between them.
        since: the first version of SSP that has it.
    """

    type: str
    required: bool = False
    words: tuple[str, ...] = ()
    is_list: bool = False
    since: str = "1.0"

    @property
    def expected(self) -> str:
        """The values in words."""
        if self.words:
            return f"one of {', '.join(self.words)}" if len(self.words) > 1 else self.words[0]
        return f"a list of {_IN_WORDS[self.type].removeprefix('a ')}s" if self.is_list else _IN_WORDS[self.type]


class Rule(msgspec.Struct, frozen=True):
    """One element.

    Attributes:
        children: the elements inside it, and whether one may stand there several times.
        required: those of them that must be there.
        choice: those of which one must be there.
        anything: whether it is not looked into.
    """

    attributes: dict[str, Attribute] = {}
    children: dict[str, bool] = {}
    required: tuple[str, ...] = ()
    choice: tuple[str, ...] = ()
    anything: bool = False
    since: str = "1.0"


_KINDS = get_args(ConnectorKind)
_IMPLEMENTATIONS = ("any", "CoSimulation", "ModelExchange", "ScheduledExecution")
_BASES = ("SSD", "component")

_text, _name, _number, _integer = (
    Attribute("text"),
    Attribute("name", required=True),
    Attribute("number"),
    Attribute("integer"),
)
_boolean, _needed = Attribute("boolean"), Attribute("text", required=True)
_SELF = {"id": _text, "description": _text}
_TOP = {
    **_SELF,
    "version": _needed,
    "author": _text,
    "fileversion": _text,
    "copyright": _text,
    "license": _text,
    "generationTool": _text,
    "generationDateAndTime": _text,
}
_META = {"ssc:MetaData": True, "ssc:Signature": True}
_ANYTHING = Rule(anything=True)
_TRANSFORMATIONS = {
    "ssc:LinearTransformation": False,
    "ssc:BooleanMappingTransformation": False,
    "ssc:IntegerMappingTransformation": False,
    "ssc:EnumerationMappingTransformation": False,
}
_ELEMENT = {
    "ssd:Connectors": False,
    "ssd:ElementGeometry": False,
    "ssd:ParameterBindings": False,
    **_META,
    "ssd:Annotations": False,
}
_SOURCE = {
    **_SELF,
    "type": _text,
    "source": _text,
    "sourceBase": Attribute("text", words=_BASES),
}


def _since(name: str) -> str:
    return "1.0" if name in _TYPES_OF_1 else "2.0"


def _connector_types() -> dict[str, Rule]:
    """The type elements of connectors and of signals."""
    rules = {f"ssc:{name}": Rule(since=_since(name)) for name in TYPES}
    for name in ("Real", "Float64", "Float32"):
        rules[f"ssc:{name}"] = Rule({"unit": _text}, since=_since(name))
    rules["ssc:Enumeration"] = Rule({"name": _name, **_SELF}, {"ssc:Item": True, "ssc:Annotations": False})
    rules["ssc:Binary"] = Rule({"mime-type": _text})
    rules["ssc:Clock"] = Rule(anything=True, since="2.0")
    return rules


def _value_types() -> dict[str, Rule]:
    """The type elements of parameters."""
    rules = {}
    for name in (*_TYPES_OF_1, *_TYPES_OF_2):
        has_values = name in ("String", "Enumeration", "Binary")
        own = {"value": Attribute("text", required=not has_values)}
        if name in ("Real", "Float64", "Float32"):
            own["unit"] = _text
        if name == "Enumeration":
            own["name"] = _text
        if name == "Binary":
            own["mime-type"] = _text
        rules[f"ssv:{name}"] = Rule(own, {"ssv:Value": True} if has_values else {}, since=_since(name))
    return rules


_CONNECTOR_TYPES = {f"ssc:{name}": False for name in TYPES}
_VALUE_TYPES = {f"ssv:{name}": False for name in (*_TYPES_OF_1, *_TYPES_OF_2)}
_DIMENSIONS = {"ssc:Dimension": True}

GRAMMAR: Final[dict[str, Rule]] = {
    # --- system structure descriptions
    "ssd:SystemStructureDescription": Rule(
        {**_TOP, "name": _needed},
        {
            "ssd:System": False,
            "ssd:Enumerations": False,
            "ssd:Units": False,
            "ssd:DefaultExperiment": False,
            **_META,
            "ssd:Annotations": False,
        },
        ("ssd:System",),
    ),
    "ssd:System": Rule(
        {**_SELF, "name": _name},
        {
            **_ELEMENT,
            "ssd:Elements": False,
            "ssd:Connections": False,
            "ssd:SignalDictionaries": False,
            "ssd:SystemGeometry": False,
            "ssd:GraphicalElements": False,
        },
    ),
    "ssd:Component": Rule(
        {
            **_SELF,
            "name": _name,
            "type": _text,
            "source": _text,
            "implementation": Attribute("text", words=_IMPLEMENTATIONS),
        },
        _ELEMENT,
    ),
    "ssd:SignalDictionaryReference": Rule({**_SELF, "name": _name, "dictionary": _name}, _ELEMENT),
    "ssd:Elements": Rule({}, {"ssd:Component": True, "ssd:System": True, "ssd:SignalDictionaryReference": True}),
    "ssd:Connectors": Rule({}, {"ssd:Connector": True}),
    "ssd:Connector": Rule(
        {**_SELF, "name": _name, "kind": Attribute("text", required=True, words=_KINDS)},
        {
            **_CONNECTOR_TYPES,
            **_DIMENSIONS,
            "ssd:Clock": True,
            "ssd:ConnectorGeometry": False,
            **_META,
            "ssd:Annotations": False,
        },
    ),
    "ssd:Clock": Rule({"name": _name}, since="2.0"),
    "ssd:Connections": Rule({}, {"ssd:Connection": True}),
    "ssd:Connection": Rule(
        {
            **_SELF,
            "startElement": _text,
            "startConnector": _name,
            "endElement": _text,
            "endConnector": _name,
            "startIndices": Attribute("size", is_list=True, since="2.0"),
            "endIndices": Attribute("size", is_list=True, since="2.0"),
            "suppressUnitConversion": _boolean,
        },
        {**_TRANSFORMATIONS, "ssd:ConnectionGeometry": False, **_META, "ssd:Annotations": False},
    ),
    "ssd:ParameterBindings": Rule({}, {"ssd:ParameterBinding": True}),
    "ssd:ParameterBinding": Rule(
        {**_SOURCE, "prefix": _text},
        {"ssd:ParameterValues": False, "ssd:ParameterMapping": False, **_META, "ssd:Annotations": False},
    ),
    "ssd:ParameterValues": Rule({}, {"ssv:ParameterSet": False}),
    "ssd:ParameterMapping": Rule(_SOURCE, {"ssm:ParameterMapping": False, **_META, "ssd:Annotations": False}),
    "ssd:SignalDictionaries": Rule({}, {"ssd:SignalDictionary": True}),
    "ssd:SignalDictionary": Rule(
        {**_SELF, "name": _name, "type": _text, "source": _text},
        {"ssb:SignalDictionary": False, **_META, "ssd:Annotations": False},
    ),
    "ssd:DefaultExperiment": Rule(
        {**_SELF, "startTime": _number, "stopTime": _number}, {**_META, "ssd:Annotations": False}
    ),
    "ssd:Enumerations": Rule({}, {"ssc:Enumeration": True}),
    "ssd:Units": Rule({}, {"ssc:Unit": True}),
    "ssd:Annotations": Rule({}, {"ssc:Annotation": True}),
    **dict.fromkeys(
        (
            "ssd:ConnectorGeometry",
            "ssd:ElementGeometry",
            "ssd:ConnectionGeometry",
            "ssd:SystemGeometry",
            "ssd:GraphicalElements",
            "ssc:MetaData",
            "ssc:Signature",
            "ssc:Annotation",
        ),
        _ANYTHING,
    ),
    # --- common
    **_connector_types(),
    "ssc:Dimension": Rule({"size": Attribute("size"), "sizeConnector": _text}, since="2.0"),
    "ssc:Item": Rule({"name": _needed, "value": Attribute("integer", required=True)}),
    "ssc:Unit": Rule({**_SELF, "name": _needed}, {"ssc:BaseUnit": False, "ssc:Annotations": False}, ("ssc:BaseUnit",)),
    "ssc:BaseUnit": Rule(
        {
            **dict.fromkeys(("kg", "m", "s", "A", "K", "mol", "cd", "rad"), _integer),
            "factor": _number,
            "offset": _number,
        }
    ),
    "ssc:Annotations": Rule({}, {"ssc:Annotation": True}),
    "ssc:LinearTransformation": Rule({"factor": _number, "offset": _number}),
    **{
        f"ssc:{kind}MappingTransformation": Rule({}, {"ssc:MapEntry": True}, ("ssc:MapEntry",))
        for kind in ("Boolean", "Integer", "Enumeration")
    },
    "ssc:MapEntry": Rule({"source": _needed, "target": _needed}),
    # --- parameter values
    "ssv:ParameterSet": Rule(
        {**_TOP, "name": _needed},
        {"ssv:Parameters": False, "ssv:Enumerations": False, "ssv:Units": False, **_META, "ssv:Annotations": False},
        ("ssv:Parameters",),
    ),
    "ssv:Parameters": Rule({}, {"ssv:Parameter": True}),
    "ssv:Parameter": Rule(
        {**_SELF, "name": _name},
        {**_VALUE_TYPES, **_DIMENSIONS, **_META, "ssv:Annotations": False},
        choice=tuple(_VALUE_TYPES),
    ),
    **_value_types(),
    "ssv:Value": Rule({"value": _needed}, since="2.0"),
    "ssv:Enumerations": Rule({}, {"ssc:Enumeration": True}),
    "ssv:Units": Rule({}, {"ssc:Unit": True}),
    "ssv:Annotations": Rule({}, {"ssc:Annotation": True}),
    # --- parameter mappings
    "ssm:ParameterMapping": Rule(_TOP, {"ssm:MappingEntry": True, **_META, "ssm:Annotations": False}),
    "ssm:MappingEntry": Rule(
        # Tools write entries without a source for parameters that they do not map.
        {**_SELF, "source": _needed, "target": _name, "suppressUnitConversion": _boolean},
        {**_TRANSFORMATIONS, "ssm:Annotations": False},
    ),
    "ssm:Annotations": Rule({}, {"ssc:Annotation": True}),
    # --- signal dictionaries
    "ssb:SignalDictionary": Rule(
        _TOP,
        {"ssb:DictionaryEntry": True, "ssb:Enumerations": False, "ssb:Units": False, **_META, "ssb:Annotations": False},
    ),
    "ssb:DictionaryEntry": Rule(
        {**_SELF, "name": _name},
        {**_CONNECTOR_TYPES, **_DIMENSIONS, **_META, "ssb:Annotations": False},
        choice=tuple(_CONNECTOR_TYPES),
    ),
    "ssb:Enumerations": Rule({}, {"ssc:Enumeration": True}),
    "ssb:Units": Rule({}, {"ssc:Unit": True}),
    "ssb:Annotations": Rule({}, {"ssc:Annotation": True}),
}
"""By tag with the usual prefix."""


def number_of(text: str) -> float:
    """The value of a text that is an xs:double, exactly as Python reads the same digits.

    Example:
        >>> number_of("1e-3"), number_of("-INF")
        (0.001, -inf)
    """
    return float(text.replace("INF", "inf"))
