"""YAML text to plain values with line numbers: mappings, lists, text, numbers, truth values, null.

Owns the YAML 1.2 core schema and the limits of a text (invariant 7 of the design): depth, size after aliases are
expanded, one document, no tags. ruamel.yaml only splits the text into events; it creates no objects. Knows nothing of
what the values mean.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from io import StringIO
from typing import NoReturn

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import (
    AliasEvent,
    DocumentStartEvent,
    Event,
    MappingEndEvent,
    MappingStartEvent,
    ScalarEvent,
    SequenceEndEvent,
    SequenceStartEvent,
    StreamEndEvent,
)

from fmu_mesh.config.findings import Findings
from fmu_mesh.config.yaml_errors import in_words
from fmu_mesh.text import shown

__all__ = ["MAXIMUM_DEPTH", "MAXIMUM_VALUES", "Plain", "read", "read_value", "written"]

Plain = None | bool | int | float | str | list["Plain"] | dict[str, "Plain"]

MAXIMUM_DEPTH = 16
"""Largest depth of nested mappings and lists; the configuration needs five levels."""
MAXIMUM_VALUES = 200_000
"""Largest number of values after aliases are expanded."""

_INTEGER = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_WORDS: dict[str, bool | None] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL"), None),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}
_NO_BLANK = re.compile(r"[^:]+:[^:]+")
_CORE_TAGS = "tag:yaml.org,2002:"
"""The parser replaces `!!` by this."""
_LONGEST_INTEGER = 40  # characters: a longer text takes long to convert and is a float anyway
_INTEGERS = range(-(2**63), 2**64)  # 64 bits; a decimal number beyond is a float, one in another base text


def read(text: str, findings: Findings, lines: dict[str, int]) -> Plain:
    """The value of a YAML text.

    Args:
        text: the text; one document.
        findings: collects everything that is wrong with it. After a syntax error or a broken limit the value is None;
            after any other finding it has all valid parts.
        lines: gets the line, counted from 1, of every path (`connections[2].to`).
    """
    try:
        return _Reader(text, findings, lines).document()
    except _Refused:
        return None
    except YAMLError as error:
        problem = in_words(error, text)
        lines[""] = problem.line
        findings.add("", problem.found, problem.expected)
    except (ValueError, OverflowError):  # ruamel.yaml does not catch the errors of `chr`
        findings.add("", "an escape sequence that is no character", "YAML 1.2")
    return None


def written(value: Plain) -> str:
    """A value as YAML text that `read` reads back as the same value; short mappings and lists in one line."""
    text, yaml = StringIO(), YAML()
    yaml.default_flow_style = None
    yaml.dump(value, text)
    return text.getvalue()


def read_value(text: str) -> tuple[str, Plain]:
    """A name and a value from a text such as the command line takes: `NAME=VALUE`, the value in YAML.

    Raises:
        ValueError: it is none; says why.
    """
    name, equals, written = text.partition("=")
    if not (name and equals and written):
        msg = f"'{text}' is no value of a name"
        raise ValueError(msg)
    value = read(written, wrong := Findings(text), {})
    if len(wrong):
        raise ValueError(f"'{text}': {next(iter(wrong)).found}; expected a value in YAML")
    return name, value


def resolve(text: str) -> Plain:
    """The value of a plain (unquoted) scalar by the core schema (YAML 1.2, 10.3.2)."""
    if text in _WORDS:
        return _WORDS[text]
    if _INTEGER.fullmatch(text):
        if len(text) <= _LONGEST_INTEGER:
            number = int(text, 0) if text[:2] in ("0x", "0o") else int(text)
            if number in _INTEGERS:
                return number
        return text if text[:2] in ("0x", "0o") else float(text)
    if _FLOAT.fullmatch(text):
        return float(text.replace(".inf", "inf").replace(".nan", "nan")) if text[-1].isalpha() else float(text)
    return text


class _Refused(Exception):
    """The text breaks a limit; the finding was added."""


class _Reader:
    """Builds the value of one document from the events of ruamel.yaml."""

    def __init__(self, text: str, findings: Findings, lines: dict[str, int]) -> None:
        self._events: Iterator[Event] = YAML(typ="safe", pure=True).parse(text)
        self._findings = findings
        self._lines = lines
        self._anchors: dict[str, tuple[Plain, int]] = {}
        self._count = 0

    def document(self) -> Plain:
        next(self._events)  # the start of the stream
        if isinstance(next(self._events), StreamEndEvent):
            self._lines[""] = 1
            self._refuse("", "an empty file", "a configuration")
        value = self._value(next(self._events), "", 1)
        for event in self._events:
            if isinstance(event, DocumentStartEvent):
                self._lines[""] = event.start_mark.line + 1
                self._refuse("", "a second document", "one document in the file")
        return value

    def _value(self, event: Event, path: str, depth: int) -> Plain:
        self._lines.setdefault(path, event.start_mark.line + 1)
        if isinstance(event, AliasEvent):
            return self._alias(event, path)
        assert isinstance(event, ScalarEvent | SequenceStartEvent | MappingStartEvent)
        before = self._count
        self._grow(1, path)
        if event.tag is not None:
            tag = str(event.tag).replace(_CORE_TAGS, "!!")
            self._findings.add(path, f"the tag {shown(tag)}", "a value without a tag")
        if depth > MAXIMUM_DEPTH:
            self._refuse(path, f"more than {MAXIMUM_DEPTH} nested levels", "a flatter structure")
        value: Plain
        match event:
            case ScalarEvent(style=style):
                text = self._text(event, path)
                value = text if style else resolve(text)
            case SequenceStartEvent():
                value = self._sequence(path, depth)
            case _:
                value = self._mapping(path, depth)
        if event.anchor is not None:
            self._anchors[event.anchor] = (value, self._count - before)
        return value

    def _sequence(self, path: str, depth: int) -> list[Plain]:
        values: list[Plain] = []
        while not isinstance(event := next(self._events), SequenceEndEvent):
            values.append(self._value(event, f"{path}[{len(values)}]", depth + 1))
        return values

    def _mapping(self, path: str, depth: int) -> dict[str, Plain]:
        values: dict[str, Plain] = {}
        while not isinstance(event := next(self._events), MappingEndEvent):
            key = self._key(event, path, depth)
            if key is None:  # a finding; its value gets no more of them
                self._value(next(self._events), path, depth + 1)
                continue
            place = f"{path}.{key}" if path else key
            line = event.start_mark.line + 1
            if key in values:
                first = self._lines.get(place)
                self._lines[place] = line
                self._findings.add(place, f"duplicate key (first in line {first})", "")
            self._lines[place] = line
            value = self._value(next(self._events), place, depth + 1)
            if value is None and _NO_BLANK.fullmatch(key):
                self._findings.add(place, f"'{key}' without a value", "a blank after the colon")
                continue
            values[key] = value
        return values

    def _key(self, event: Event, path: str, depth: int) -> str | None:
        if isinstance(event, ScalarEvent):
            return self._text(event, path)
        place = f"{path}.?" if path else "?"
        self._value(event, place, depth + 1)
        self._findings.add(place, "a key that is no text", "a name as the key")
        return None

    def _text(self, event: ScalarEvent, path: str) -> str:
        text = str(event.value)
        with contextlib.suppress(UnicodeDecodeError):
            # JSON escapes a character as two surrogates; a single one is no character.
            whole = text.encode("utf-16-le", "surrogatepass").decode("utf-16-le")
            if "\0" not in whole:
                return whole
        self._findings.add(path, f"{shown(text)}, which no file and no model can hold", "other characters")
        return "?"

    def _alias(self, event: AliasEvent, path: str) -> Plain:
        if event.anchor not in self._anchors:
            self._refuse(path, f"the alias *{event.anchor}", f"the anchor &{event.anchor} before it, complete")
        value, count = self._anchors[event.anchor]
        self._grow(count, path)
        return value

    def _grow(self, count: int, path: str) -> None:
        self._count += count
        if self._count > MAXIMUM_VALUES:
            self._refuse(path, f"more than {MAXIMUM_VALUES} values", "a smaller file")

    def _refuse(self, path: str, found: str, expected: str) -> NoReturn:
        self._findings.add(path, found, expected)
        raise _Refused
