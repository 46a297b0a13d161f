"""A system structure description of another tool with our annotation: every other byte of it stays as it is.

Owns where the annotation stands in the text of a document. A parser tells only the places; the text itself is never
written anew, so prefixes, comments and blanks of the tool are kept. It is for documents that `ssd_reading` has
accepted.
"""

from __future__ import annotations

from typing import Final, NamedTuple
from xml.parsers import expat  # finds places only, in documents that were parsed safely before

from lxml import etree

from .grammar import NAMESPACES
from .own_annotation import ANNOTATION_TYPE
from .xml_writing import annotations_element

__all__ = ["own_annotation_in", "with_own_annotation"]

_SYSTEM: Final = f"{NAMESPACES['ssd']} System"
_ANNOTATIONS: Final = f"{NAMESPACES['ssd']} Annotations"
_ANNOTATION: Final = f"{NAMESPACES['ssc']} Annotation"


class _Span(NamedTuple):
    """The bytes of an element.

    Attributes:
        inner_end: where its end tag begins; equal to ``end`` for an element without one.
    """

    start: int
    inner_end: int
    end: int


def own_annotation_in(document: bytes) -> str | None:
    """The text of our annotation; None if the root system has none."""
    spans = _Places(document).own
    if not spans:
        return None
    root = etree.fromstring(document)  # it was parsed safely before
    path = f"ssd:System/ssd:Annotations/ssc:Annotation[@type='{ANNOTATION_TYPE}']/*"
    element = next(iter(root.xpath(path, namespaces=NAMESPACES)), None)
    return None if element is None else element.text or ""


def with_own_annotation(document: bytes, text: str | None) -> bytes:
    """The document with another text of our annotation; None: without an annotation of ours.

    Raises:
        ValueError: the document has no place for one: it is not in an encoding that contains ASCII, or has no system.
    """
    places = _Places(document)
    element = annotations_element(text) if text is not None else None
    changed = document
    if element is None:
        for span in reversed(places.own):
            changed = _without(changed, span)
        return changed
    entry: bytes = etree.tostring(element[0], encoding="ASCII", xml_declaration=False)
    if places.own:
        for span in reversed(places.own[1:]):
            changed = _without(changed, span)
        first = places.own[0]
        return changed[: first.start] + entry + changed[first.end :]
    if places.annotations is not None and places.annotations.inner_end != places.annotations.end:
        at = places.annotations.inner_end
        return document[:at] + entry + document[at:]
    whole: bytes = etree.tostring(element, encoding="ASCII", xml_declaration=False)
    if places.annotations is not None:
        return document[: places.annotations.start] + whole + document[places.annotations.end :]
    if places.system is None or places.system.inner_end == places.system.end:
        raise ValueError("there is no system with elements")
    at = places.system.inner_end
    return document[:at] + whole + document[at:]


def _without(document: bytes, span: _Span) -> bytes:
    return document[: span.start] + document[span.end :]


class _Places:
    """Where the root system, its annotations and ours among them are.

    Raises:
        ValueError: bytes and characters of the document do not correspond.
    """

    def __init__(self, document: bytes) -> None:
        if b"\0" in document:
            raise ValueError("the encoding of the document does not contain ASCII")
        self.system: _Span | None = None
        self.annotations: _Span | None = None
        self.own: list[_Span] = []
        self._document = document
        self._open: list[tuple[str, int, bool]] = []
        self._is_empty = False
        self._parser = expat.ParserCreate(namespace_separator=" ")
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.DefaultHandler = self._content
        self._parser.Parse(document, True)  # noqa: FBT003  its last argument has no name

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self._is_empty = True
        is_own = attributes.get("type") == ANNOTATION_TYPE
        self._open.append((name, self._parser.CurrentByteIndex, is_own))

    def _content(self, _text: str) -> None:
        """Text, a comment or anything else that is no element."""
        self._is_empty = False

    def _end(self, _name: str) -> None:
        at = self._parser.CurrentByteIndex
        # At the end of an element without an end tag, the parser is behind it already.
        has_no_tag = self._is_empty and self._document.endswith(b"/>", self._open[-1][1], at)
        end = at if has_no_tag else self._document.index(b">", at) + 1
        self._is_empty = False
        names = [name for name, _, _ in self._open]
        _, start, is_own = self._open.pop()
        span = _Span(start, at, end)
        if names[1:] == [_SYSTEM]:
            self.system = span
        elif names[1:] == [_SYSTEM, _ANNOTATIONS]:
            self.annotations = span
        elif names[1:] == [_SYSTEM, _ANNOTATIONS, _ANNOTATION] and is_own:
            self.own.append(span)
