"""The elements and attributes of SSP 1.0 and 2.0, as a table: what may stand where, and what its values are.

Geometry, meta data and annotations are not looked into: they do not change what a system computes.
"""

from __future__ import annotations

import re
from typing import Final, NamedTuple, get_args

import msgspec

from .system_structure import ConnectorKind

__all__ = ["GRAMMAR", "NAMESPACES", "PATTERNS", "TYPES", "Attribute", "Rule"]

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
"""The values of attributes by type, after XML Schema; `float` reads a number, `INF` and `NaN` included."""

_IN_WORDS: Final = {
    "text": "a text",
    "name": "a name that is not empty",
    "number": "a number",
    "integer": "a whole number",
    "size": "a whole number >= 0",
    "boolean": "true or false",
}

_TYPES_OF_1: Final = ("Real", "Integer", "Boolean", "String", "Enumeration", "Binary")
_INTEGERS_OF_2: Final = tuple(f"{sign}{bits}" for bits in (8, 16, 32, 64) for sign in ("Int", "UInt"))
TYPES: Final = (*_TYPES_OF_1, "Float64", "Float32", *_INTEGERS_OF_2, "Clock")
"""The elements that say the type of a connector."""


class Attribute(NamedTuple):
    """One attribute, with its first version of SSP.

    The type is a key of `PATTERNS`. The ``words`` are the only values, if there are such; a list has several values.
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


_WORDS: Final[dict[str, tuple[str, ...]]] = {
    "kind": get_args(ConnectorKind),
    "implementation": ("any", "CoSimulation", "ModelExchange", "ScheduledExecution"),
    "base": ("SSD", "component"),
}
"""The types of attributes that have only some values."""

_ATTRIBUTE: Final = re.compile(r"([\w-]+)(?::(\w+))?([!*2]*)")
_CHILD: Final = re.compile(r"(\w+:\w+)([!*|]*)")


def _rule(attributes: str = "", children: str = "", since: str = "1.0") -> Rule:
    """A rule in short.

    An attribute is `name:type`, or the name alone for a text; then `!` if it is required, `*` for a list, `2` if it is
    one of SSP 2.0. A child is its tag; then `*` if there may be several, `!` if it is required, `|` if one of these is.
    """
    own: dict[str, Attribute] = {}
    for name, type_, marks in _ATTRIBUTE.findall(attributes):
        words, since_own = _WORDS.get(type_, ()), "2.0" if "2" in marks else "1.0"
        own[name] = Attribute("text" if words else type_ or "text", "!" in marks, words, "*" in marks, since_own)
    found = _CHILD.findall(children)
    required, choice = (tuple(tag for tag, marks in found if sign in marks) for sign in "!|")
    return Rule(own, {tag: "*" in marks for tag, marks in found}, required, choice, since=since)


_SINCE: Final = {**dict.fromkeys(_TYPES_OF_1, "1.0"), **dict.fromkeys(TYPES[len(_TYPES_OF_1) :], "2.0")}
_FLOATS: Final = ("Real", "Float64", "Float32")
_MAPPED: Final = ("Boolean", "Integer", "Enumeration")
_SELF = "id description"
_NAMED = f"{_SELF} name:name!"
_TOP = f"{_SELF} version! author fileversion copyright license generationTool generationDateAndTime"
_META = "ssc:MetaData* ssc:Signature*"
_SOURCE = f"{_SELF} type source sourceBase:base"
_ELEMENT = f"ssd:Connectors ssd:ElementGeometry ssd:ParameterBindings {_META} ssd:Annotations"
_CONNECTOR_TYPES = " ".join(f"ssc:{name}" for name in TYPES)
_ONE_OF_THE_TYPES = " ".join(f"ssc:{name}|" for name in TYPES)
_VALUE_TYPES = " ".join(f"ssv:{name}|" for name in TYPES if name != "Clock")
_TRANSFORMATIONS = " ".join(f"ssc:{kind}Transformation" for kind in ("Linear", *(f"{one}Mapping" for one in _MAPPED)))

GRAMMAR: Final[dict[str, Rule]] = {
    # --- system structure descriptions
    "ssd:SystemStructureDescription": _rule(
        f"{_TOP} name!",
        f"ssd:System! ssd:Enumerations ssd:Units ssd:DefaultExperiment {_META} ssd:Annotations",
    ),
    "ssd:System": _rule(
        _NAMED,
        f"{_ELEMENT} ssd:Elements ssd:Connections ssd:SignalDictionaries ssd:SystemGeometry ssd:GraphicalElements",
    ),
    "ssd:Component": _rule(f"{_NAMED} type source implementation:implementation", _ELEMENT),
    "ssd:SignalDictionaryReference": _rule(f"{_NAMED} dictionary:name!", _ELEMENT),
    "ssd:Elements": _rule("", "ssd:Component* ssd:System* ssd:SignalDictionaryReference*"),
    "ssd:Connectors": _rule("", "ssd:Connector*"),
    "ssd:Connector": _rule(
        f"{_NAMED} kind:kind!",
        f"{_CONNECTOR_TYPES} ssc:Dimension* ssd:Clock* ssd:ConnectorGeometry {_META} ssd:Annotations",
    ),
    "ssd:Clock": _rule("name:name!", since="2.0"),
    "ssd:Connections": _rule("", "ssd:Connection*"),
    "ssd:Connection": _rule(
        f"{_SELF} startElement startConnector:name! endElement endConnector:name! startIndices:size*2 "
        "endIndices:size*2 suppressUnitConversion:boolean",
        f"{_TRANSFORMATIONS} ssd:ConnectionGeometry {_META} ssd:Annotations",
    ),
    "ssd:ParameterBindings": _rule("", "ssd:ParameterBinding*"),
    "ssd:ParameterBinding": _rule(
        f"{_SOURCE} prefix", f"ssd:ParameterValues ssd:ParameterMapping {_META} ssd:Annotations"
    ),
    "ssd:ParameterValues": _rule("", "ssv:ParameterSet"),
    "ssd:ParameterMapping": _rule(_SOURCE, f"ssm:ParameterMapping {_META} ssd:Annotations"),
    "ssd:SignalDictionaries": _rule("", "ssd:SignalDictionary*"),
    "ssd:SignalDictionary": _rule(f"{_NAMED} type source", f"ssb:SignalDictionary {_META} ssd:Annotations"),
    "ssd:DefaultExperiment": _rule(f"{_SELF} startTime:number stopTime:number", f"{_META} ssd:Annotations"),
    **{f"ssd:{name}Geometry": Rule(anything=True) for name in ("Connector", "Element", "Connection", "System")},
    "ssd:GraphicalElements": Rule(anything=True),
    # --- common
    **{f"ssc:{name}": Rule(anything=True) for name in ("MetaData", "Signature", "Annotation")},
    **{
        f"{prefix}:{name}s": _rule("", f"ssc:{name}*")
        for prefix, names in (
            ("ssd", ("Enumeration", "Unit", "Annotation")),
            ("ssv", ("Enumeration", "Unit", "Annotation")),
            ("ssb", ("Enumeration", "Unit", "Annotation")),
            ("ssm", ("Annotation",)),
            ("ssc", ("Annotation",)),
        )
        for name in names
    },
    **{f"ssc:{name}": _rule("unit" if name in _FLOATS else "", since=_SINCE[name]) for name in TYPES},
    "ssc:Enumeration": _rule(f"name:name! {_SELF}", "ssc:Item* ssc:Annotations"),
    "ssc:Binary": _rule("mime-type"),
    "ssc:Clock": Rule(anything=True, since="2.0"),
    "ssc:Dimension": _rule("size:size sizeConnector", since="2.0"),
    "ssc:Item": _rule("name! value:integer!"),
    "ssc:Unit": _rule(f"{_SELF} name!", "ssc:BaseUnit! ssc:Annotations"),
    "ssc:BaseUnit": _rule(
        "kg:integer m:integer s:integer A:integer K:integer mol:integer cd:integer rad:integer "
        "factor:number offset:number"
    ),
    "ssc:LinearTransformation": _rule("factor:number offset:number"),
    **{f"ssc:{kind}MappingTransformation": _rule("", "ssc:MapEntry*!") for kind in _MAPPED},
    "ssc:MapEntry": _rule("source! target!"),
    # --- parameter values
    "ssv:ParameterSet": _rule(f"{_TOP} name!", f"ssv:Parameters! ssv:Enumerations ssv:Units {_META} ssv:Annotations"),
    "ssv:Parameters": _rule("", "ssv:Parameter*"),
    "ssv:Parameter": _rule(_NAMED, f"{_VALUE_TYPES} ssc:Dimension* {_META} ssv:Annotations"),
    **{
        f"ssv:{name}": _rule("value! unit" if name in _FLOATS else "value!", since=_SINCE[name])
        for name in TYPES
        if name != "Clock"
    },
    "ssv:String": _rule("value", "ssv:Value*"),
    "ssv:Enumeration": _rule("value name", "ssv:Value*"),
    "ssv:Binary": _rule("value mime-type", "ssv:Value*"),
    "ssv:Value": _rule("value!", since="2.0"),
    # --- parameter mappings
    "ssm:ParameterMapping": _rule(_TOP, f"ssm:MappingEntry* {_META} ssm:Annotations"),
    # Tools write entries without a source for parameters that they do not map: it may be an empty text.
    "ssm:MappingEntry": _rule(
        f"{_SELF} source! target:name! suppressUnitConversion:boolean", f"{_TRANSFORMATIONS} ssm:Annotations"
    ),
    # --- signal dictionaries
    "ssb:SignalDictionary": _rule(_TOP, f"ssb:DictionaryEntry* ssb:Enumerations ssb:Units {_META} ssb:Annotations"),
    "ssb:DictionaryEntry": _rule(_NAMED, f"{_ONE_OF_THE_TYPES} ssc:Dimension* {_META} ssb:Annotations"),
}
"""By tag with the usual prefix."""
