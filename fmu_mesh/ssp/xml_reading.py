"""From the bytes of one XML file to an element whose names, attributes and values are those of the standard.

Owns the safety of the parser, the namespaces, and the check against `grammar`. What the elements mean is
`ssd_reading` and `parameter_reading`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any, Final, NamedTuple
from xml.parsers import expat

from lxml import etree

from ..archives.safe_xml import safe_xml, syntax_error
from ..errors import LoadFailed
from ..text import listed, nearest, printable, shown
from .grammar import GRAMMAR, NAMESPACES, PATTERNS, Attribute, Rule
from .problems import Problems
from .system_structure import Annotation, FilePlace

__all__ = ["XmlElement", "read_xml"]

_SHOWN_ATTRIBUTES: Final = ("name", "source", "type")
_PREFIXES: Final = {namespace: prefix for prefix, namespace in NAMESPACES.items()}
_VERSIONS: Final = ("1.0", "2.0")
_INLINE: Final = ("ssv:ParameterSet", "ssm:ParameterMapping", "ssb:SignalDictionary")
_UNBOUND: Final = re.compile(r"Namespace prefix (\S+)(?: for \S+)? on (\S+) is not defined")
_DOCUMENT_TYPE: Final = re.compile(rb"<!DOCTYPE")
_KNOWN_LINES: Final = 65535
"""lxml knows the lines of elements up to this one, and later ones not exactly."""


class _Document(NamedTuple):
    """What all elements of a file have in common: its name in messages, and their lines where lxml may not know them.

    The ``lines`` also keep the elements, which are the keys.
    """

    file: str
    lines: Mapping[Any, int]


class XmlElement:
    """An element of a file that was checked; its attributes have valid values, or there is a finding about them.

    Attributes:
        tag: with the usual prefix, such as `ssd:System`; a foreign element has its namespace in braces.
        version: of the file, `1.0` or `2.0`.
    """

    def __init__(self, element: Any, document: _Document, version: str) -> None:  # noqa: ANN401  lxml ships no types
        self._element = element
        self._document = document
        self.tag = _with_prefix(element.tag)
        self.version = version

    @property
    def place(self) -> FilePlace:
        """Its file and line, and its name in words: `Connector 'u' of Component 'gain'`."""
        line = self._document.lines.get(self._element) or self._element.sourceline or 0
        return FilePlace(self._document.file, line, printable(_in_words(self._element)))

    def get(self, name: str) -> str | None:
        """An attribute as text; None if it is not given."""
        value: str | None = self._element.get(name)
        return value

    def text(self, name: str) -> str:
        """A required attribute; empty where it is missing, for which there is a finding."""
        return self.get(name) or ""

    def number(self, name: str, default: float) -> float:
        """A number; ``default`` where it is not given, or is no number."""
        found = self.optional_number(name)
        return default if found is None else found

    def optional_number(self, name: str) -> float | None:
        """A number; None where it is not given, or is no number."""
        text = (self.get(name) or "").strip()
        return float(text) if PATTERNS["number"].fullmatch(text) else None

    def integer(self, name: str, default: int = 0) -> int:
        """A whole number; ``default`` where it is not given, or is none."""
        text = (self.get(name) or "").strip()
        return int(text) if PATTERNS["integer"].fullmatch(text) else default

    def boolean(self, name: str) -> bool:
        """A truth value; false where it is not given."""
        return (self.get(name) or "").strip() in ("true", "1")

    def numbers(self, name: str) -> tuple[int, ...]:
        """A list of whole numbers, empty where it is not given."""
        return tuple(int(word) for word in (self.get(name) or "").split() if word.isdigit())

    def children(self, *tags: str) -> Iterator[XmlElement]:
        """The children with one of these tags, in their order; all of them if no tag is given."""
        for child in self._element:
            if isinstance(child.tag, str) and (not tags or _with_prefix(child.tag) in tags):
                # A parameter set or a mapping inside a description has a version of its own.
                own = child.get("version") if _with_prefix(child.tag) in _INLINE else None
                yield XmlElement(child, self._document, (own or self.version).strip())

    def child(self, *tags: str) -> XmlElement | None:
        """The first child with one of these tags; None if there is none."""
        return next(self.children(*tags), None)

    def inside(self, tag: str) -> Iterator[XmlElement]:
        """The children of the child with this tag."""
        child = self.child(tag)
        return child.children() if child is not None else iter(())

    def own_elements(self) -> Iterator[XmlElement]:
        """All elements of SSP inside this one, in their order; a set or a mapping inside a description has its own."""
        for child in self.children():
            rule = GRAMMAR.get(child.tag)
            if rule is not None and not rule.anything and child.tag not in _INLINE:
                yield child
                yield from child.own_elements()

    def annotations(self) -> tuple[Annotation, ...]:
        """The annotations of this element."""
        return tuple(one.as_annotation() for one in self.inside(f"{self.tag.partition(':')[0]}:Annotations"))

    def as_annotation(self) -> Annotation:
        """This element, an `ssc:Annotation`, as a value."""
        inside = [(etree.QName(one).localname, dict(one.attrib)) for one in self._element.iterdescendants("*")]
        text = next((child.text or "" for child in self._element if isinstance(child.tag, str)), "")
        return Annotation(self.text("type"), tuple(inside), self.place, text)

    def with_id(self, identifier: str) -> XmlElement | None:
        """The element of the whole file with this `id`; None if there is none."""
        found = self._element.xpath("//*[@id = $identifier]", identifier=identifier)
        return XmlElement(found[0], self._document, self.version) if found else None

    def is_inside(self, other: XmlElement) -> bool:
        """Whether this element is another one, or anywhere inside it."""
        return self._element is other._element or other._element in self._element.iterancestors()

    def check(self, problems: Problems) -> None:
        """Check this element and all that is inside it against the grammar."""
        rule = GRAMMAR.get(self.tag)
        if rule is None or rule.anything:
            return
        self._check_attributes(rule, problems)
        counts: dict[str, int] = {}
        for child in self.children():
            if child.tag not in rule.children:
                names = [name.partition(":")[2] for name in rule.children]
                own = _kind(child.tag)
                near = nearest(own, names)
                namespace = _wrong_namespace(child.tag, near, rule)
                expected = f"one of {listed(names)}" if names else "nothing inside it"
                problems.add(child.place, f"the element {namespace or own} in {_kind(self.tag)}", expected, near)
                continue
            counts[child.tag] = counts.get(child.tag, 0) + 1
            if counts[child.tag] > 1 and not rule.children[child.tag]:
                problems.add(child.place, f"a second {_kind(child.tag)} in {self.place.element}", "one at most")
            child.check(problems)
        if rule.choice and not any(tag in counts for tag in rule.choice):
            names = [tag.partition(":")[2] for tag in rule.choice]
            problems.add(self.place, "no type", f"one of {listed(names)}")
        for tag in rule.required:
            if tag not in counts:
                problems.add(self.place, f"no {_kind(tag)}", "one")

    def _check_attributes(self, rule: Rule, problems: Problems) -> None:
        attributes = {name: text for name, text in self._element.attrib.items() if not name.startswith("{")}
        missing = [name for name, one in rule.attributes.items() if one.required and name not in attributes]
        unknown = [name for name in attributes if name not in rule.attributes]
        meant = missing if len(missing) == len(unknown) == 1 else []  # most likely it has only a wrong name
        for name, text in attributes.items():
            attribute = rule.attributes.get(name)
            if attribute is None:
                names = [*rule.attributes]
                expected = f"one of {listed(names)}" if names else "no attributes"
                near = meant[0] if meant else nearest(name, names)
                problems.add(self.place, f"the attribute '{name}'", expected, near)
                continue
            _check_value(self, name, text, attribute, problems)
            if attribute.since == "2.0" and self.version == "1.0":
                problems.warn(self.place, f"the attribute '{name}' of SSP 2.0 in a file that says version 1.0")
        for name in missing:
            if name not in meant:
                problems.add(self.place, f"no attribute '{name}'", rule.attributes[name].expected)
        if rule.since == "2.0" and self.version == "1.0":
            problems.warn(self.place, f"{_kind(self.tag)} of SSP 2.0 in a file that says version 1.0")


def read_xml(data: bytes, file: str, tag: str, problems: Problems) -> XmlElement | None:
    """The root of one file, whose content was checked; None if it is no such file at all, for which there is a finding.

    The ``file`` is as messages name it; ``tag`` is what its root must be, such as `ssd:SystemStructureDescription`.
    """
    try:
        root = safe_xml(data, f"'{file}'")
    except LoadFailed as error:
        _add_syntax(data, file, error, problems)
        return None
    document = _Document(file, _far_lines(data, root))
    found = XmlElement(root, document, (root.get("version") or "").strip())
    if found.tag != tag:
        local = etree.QName(root).localname
        wanted = tag.partition(":")[2]
        if local == wanted:
            namespace = etree.QName(root).namespace
            text = f"the namespace '{namespace}'" if namespace else "no namespace"
            problems.add(found.place, f"{wanted} in {text}", f"'{NAMESPACES[tag.partition(':')[0]]}' (SSP 1.0 and 2.0)")
        else:
            problems.add(found.place, f"the root element {local}", wanted, wanted if local in _ROOTS else None)
        return None
    if found.version and found.version not in _VERSIONS:
        problems.add(found.place, f"the version {shown(found.version)}", "1.0 or 2.0")
        return None
    found.check(problems)
    return found


_ROOTS: Final = ("SystemStructureDescription", "ParameterSet", "ParameterMapping", "SignalDictionary")


def _far_lines(data: bytes, root: Any) -> Mapping[Any, int]:  # noqa: ANN401  lxml ships no types
    """The line of each element of a file with more lines than lxml knows; empty for other files.

    The file has no document type: `safe_xml` has parsed it.
    """
    if data.count(b"\n") < _KNOWN_LINES:
        return {}
    lines: list[int] = []
    parser = expat.ParserCreate()
    parser.StartElementHandler = lambda *_: lines.append(parser.CurrentLineNumber)
    try:
        parser.Parse(data, True)  # noqa: FBT003  its only form
    except expat.ExpatError:
        return {}  # an encoding that only lxml knows
    return dict(zip(root.iter("*"), lines, strict=False))


def _add_syntax(data: bytes, file: str, error: LoadFailed, problems: Problems) -> None:
    """Add a finding for XML that cannot be parsed, or must not be."""
    cause = error.__cause__
    if isinstance(cause, etree.XMLSyntaxError):
        line = cause.lineno or 1
        if (unbound := _UNBOUND.search(cause.msg or "")) is not None:
            found = f"the prefix '{unbound[1]}' of {unbound[1]}:{unbound[2]}, which is bound to no namespace"
            problems.add(FilePlace(file, line, ""), found, f'xmlns:{unbound[1]}="..." on it or on an element around it')
        else:
            problems.add(FilePlace(file, line, ""), f"no well-formed XML: {syntax_error(cause)}", "XML 1.0")
        return
    text = data.replace(b"\0", b"")  # in UTF-16 every second byte of it
    match = _DOCUMENT_TYPE.search(text)
    line = text.count(b"\n", 0, match.start()) + 1 if match is not None else 1
    found = "a document type, with which XML can expand without limit and read other files"
    problems.add(FilePlace(file, line, ""), found, "none: no file of SSP has one")


def _check_value(element: XmlElement, name: str, text: str, attribute: Attribute, problems: Problems) -> None:
    words = text.split() if attribute.is_list else [text if attribute.type in ("text", "name") else text.strip()]
    for word in words:
        if attribute.words:
            if word not in attribute.words:
                problems.add(element.place, f"{name} {shown(word)}", attribute.expected, nearest(word, attribute.words))
        elif not PATTERNS[attribute.type].fullmatch(word):
            problems.add(element.place, f"{name} {shown(word)}", attribute.expected)


def _wrong_namespace(tag: str, near: str | None, rule: Rule) -> str | None:
    """A name with its namespace, where the name without it would be right."""
    local = _kind(tag)
    if near != local or not any(own.partition(":")[2] == local for own in rule.children):
        return None
    if tag.startswith("{"):
        return f"{local} of the namespace '{tag[1:].partition('}')[0]}'"
    prefix = tag.partition(":")[0]
    return (
        f"{local} of the namespace '{NAMESPACES[prefix]}'" if prefix in NAMESPACES else f"{local} without a namespace"
    )


@lru_cache(maxsize=256)
def _with_prefix(tag: str) -> str:
    """A tag with the usual prefix in the place of its namespace."""
    name = etree.QName(tag)
    return f"{_PREFIXES[name.namespace]}:{name.localname}" if name.namespace in _PREFIXES else tag


def _kind(tag: str) -> str:
    """A tag without its namespace or prefix."""
    return tag.rpartition("}")[2].rpartition(":")[2]


def _in_words(element: Any) -> str:  # noqa: ANN401  lxml ships no types
    """An element and the named ones around it: `Connector 'u' of Component 'gain'`."""
    words: list[str] = []
    while element is not None and len(words) < 2:
        local = etree.QName(element).localname
        name = next((f"'{element.get(key)}'" for key in _SHOWN_ATTRIBUTES if element.get(key)), None)
        if local == "Connection":
            name = f"'{_end(element, 'start')} - {_end(element, 'end')}'"
        if local == "MappingEntry":
            name = _entry(element)
        if not words:
            words.append(local if name is None else f"{local} {name}")
        elif name is not None and local not in _ROOTS:
            words.append(f"{local} {name}")
        element = element.getparent()
    return " of ".join(words)


def _end(element: Any, side: str) -> str:  # noqa: ANN401  lxml ships no types
    """One end of a connection as its attributes have it."""
    owner, connector = element.get(f"{side}Element"), element.get(f"{side}Connector")
    return f"{owner}.{connector or '?'}" if owner else connector or "?"


def _entry(element: Any) -> str | None:  # noqa: ANN401  lxml ships no types
    """What an entry of a mapping maps: `'gain to motor.k'`, or the part that is given."""
    source, target = element.get("source"), element.get("target")
    if source and target:
        return f"'{source} to {target}'"
    return f"'{source}'" if source else f"to '{target}'" if target else None
