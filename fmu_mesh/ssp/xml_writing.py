"""XML of SSP as it is written: elements, numbers, units and our annotation, also in a document of another tool.

Owns how values become text. Which elements stand for what is `ssd_writing`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import msgspec
from lxml import etree

from ..archives.safe_xml import safe_xml
from ..variables.units import BaseUnit
from .grammar import NAMESPACES
from .own_annotation import ANNOTATION_ELEMENT, ANNOTATION_TYPE

__all__ = [
    "XmlNode",
    "annotations_element",
    "child",
    "is_xml_text",
    "number_text",
    "own_annotation_in",
    "tag_of",
    "with_own_annotation",
    "write_units",
]

XmlNode = Any
"""An element of lxml, which ships no types."""

_OWN: Final = f"ssd:System/ssd:Annotations/ssc:Annotation[@type='{ANNOTATION_TYPE}']"
"""The path of our annotation in a description."""


def number_text(value: float) -> str:
    """A number as xs:double, which gives back the same one."""
    if math.isfinite(value):
        return repr(float(value))
    return "NaN" if math.isnan(value) else "INF" if value > 0.0 else "-INF"


def tag_of(name: str) -> str:
    """The name of an element with its namespace, from a name with the usual prefix: `ssd:System`."""
    prefix, _, local = name.partition(":")
    return f"{{{NAMESPACES[prefix]}}}{local}"


def child(parent: XmlNode, name: str, /, **attributes: str) -> XmlNode:
    """Add an element to another one; ``name`` has the usual prefix."""
    return etree.SubElement(parent, tag_of(name), attributes)


def write_units(parent: XmlNode, units: Mapping[str, BaseUnit]) -> None:
    """Add the definitions of units to the element `Units` of a document."""
    for name, base in sorted(units.items()):
        fields = {
            key: value for key, value in msgspec.structs.asdict(base).items() if value != getattr(BaseUnit(), key)
        }
        texts = {key: str(value) if isinstance(value, int) else number_text(value) for key, value in fields.items()}
        child(child(parent, "ssc:Unit", name=name), "ssc:BaseUnit", **texts)


def annotations_element(text: str) -> XmlNode:
    """The element `ssd:Annotations` of a root system, with our annotation and no other."""
    parent = etree.Element(tag_of("ssd:Annotations"), nsmap={prefix: NAMESPACES[prefix] for prefix in ("ssd", "ssc")})
    entry = child(parent, "ssc:Annotation", type=ANNOTATION_TYPE)
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
        made, system = annotations_element(text), root.find("ssd:System", NAMESPACES)
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
