"""YAML text to plain values with line numbers: mappings, lists, text, numbers, truth values, null.

Owns the YAML 1.2 core schema and the limits of a text (invariant 7 of the design): depth, size after aliases are
expanded, one document, no tags. ruamel.yaml only splits the text into events; it creates no objects. Its errors get
plain words for somebody who writes a configuration, and the line of their cause: the parser reports an open bracket or
quote many lines after it was opened. Knows nothing of what the values mean.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from io import StringIO
from typing import NoReturn

import msgspec
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, StringMark, YAMLError
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
from ruamel.yaml.reader import ReaderError
from ruamel.yaml.tokens import (
    FlowMappingEndToken,
    FlowMappingStartToken,
    FlowSequenceEndToken,
    FlowSequenceStartToken,
    ScalarToken,
    Token,
)

from fmu_mesh.config.findings import Findings
from fmu_mesh.text import shown

__all__ = ["MAXIMUM_DEPTH", "MAXIMUM_VALUES", "Plain", "read", "read_value", "written", "written_for_others"]

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

_INDENTED = "lines that belong together in one column, what belongs to them further to the right"
_KEY_VALUE = "`key: value`, with a blank after the colon"
_QUOTED = "quotes around text that begins with it"
_YAML = "YAML 1.2"

_CLOSING = {"{": "}", "[": "]"}
_IN_WORDS = {
    r"found '<block mapping start>'": ("a line that begins in another column than those above it", _INDENTED),
    r"found '-'": ("an item of a list ('- ...') among keys", f"`key: value` there, or {_INDENTED}"),
    r"found '}'": ("a '}' that closes nothing", "a '{' before it, or no '}'"),
    r"found '\]'": ("a ']' that closes nothing", "a '[' before it, or no ']'"),
    r"found ','": ("a ',' outside of { } and [ ]", "one value; quotes around text with a comma in it"),
    r"found '(?:[{\[]|<.*>)' while parsing a block mapping": (
        "text after a value",
        "one value; quotes around all of it",
    ),
    r"found '(\?|<scalar>|<block .*)' while parsing a block collection": (
        "a line without '- ' among the items of a list",
        f"'- ' before each item, and {_INDENTED}",
    ),
    r"'\\t' that cannot start": ("a tab", "blanks: YAML takes no tabs there"),
    r"character '(.)' that cannot start": (r"a value that begins with '\1'", _QUOTED),
    r"unknown escape character '(.)'": (r"'\\\1' between double quotes", r"single quotes, or '\\' for a backslash"),
    r"escape sequence": ("an escape sequence that is not complete", "as many digits as it takes, or single quotes"),
    r"while scanning an (?:alias|anchor)": ("a '*' or '&' without a name after it", _QUOTED),
    r"sequence entries are not allowed": (
        "a '- ' where no list can begin",
        "each item in a line of its own, below its key",
    ),
    r"mapping keys are not allowed": ("a '? ' where no key can be", _QUOTED),
    r"while (?:parsing|scanning) an? tag|tag handle": ("a value that begins with '!'", _QUOTED),
    r"while scanning a block scalar": ("text after '|' or '>'", f"the text in the lines below, or {_QUOTED}"),
    r"'<document start>'|directive": ("a line that begins with '%'", "none; quotes around a name that begins with it"),
    r"incompatible YAML": ("another version of YAML", _YAML),
    r"while scanning a quoted scalar": ("a line '---' or '...' between quotes", "the closing quote before it"),
}
"""By pattern of the parser's message: what was found, and what was expected."""


def read(text: str, findings: Findings, lines: dict[str, int]) -> Plain:
    """The value of a YAML text of one document; ``lines`` gets the line, from 1, of every path (`connections[2].to`).

    After a syntax error or a broken limit the value is None; after any other finding it has all valid parts.
    """
    try:
        return _Reader(text, findings, lines).document()
    except _Refused:
        return None
    except YAMLError as error:
        problem = _in_words(error, text)
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


def written_for_others(value: Plain) -> str:
    """A value as YAML text that any reader takes: also one of YAML 1.1, for which `no` and `1:30` are no texts."""
    text, yaml = StringIO(), YAML()
    yaml.version, yaml.width = (1, 1), 1 << 16
    yaml.default_flow_style = None
    yaml.representer.ignore_aliases = lambda _data: True
    yaml.dump(value, text)
    return text.getvalue().partition("---\n")[2]


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


class _SyntaxProblem(msgspec.Struct, frozen=True):
    """An error of syntax in plain words, with the line of its cause, counted from 1."""

    line: int
    found: str
    expected: str


def _in_words(error: YAMLError, text: str) -> _SyntaxProblem:
    """The cause of an ``error`` of the parser in ``text``, in plain words."""
    if isinstance(error, ReaderError):
        line = text.count("\n", 0, error.position) + 1
        return _SyntaxProblem(line, f"the character U+{error.character:04X}", "characters that can be printed")
    at = error.problem_mark or error.context_mark if isinstance(error, MarkedYAMLError) else None
    if not isinstance(error, MarkedYAMLError) or at is None:
        return _SyntaxProblem(1, " ".join(str(error).split()), _YAML)
    opened = error.context_mark.line + 1 if error.context_mark is not None else at.line + 1
    problem = " ".join(filter(None, (error.problem, error.context)))
    return _where_it_began(problem, opened, at, text) or _where_it_is(problem, at.line + 1, text)


def _where_it_began(problem: str, opened: int, at: StringMark, text: str) -> _SyntaxProblem | None:
    """A cause before the place where the parser stopped; ``opened`` is the line where the current part began."""
    line = at.line + 1
    if "unexpected end of stream while scanning a quoted" in problem:
        return _SyntaxProblem(opened, "a quote that is not closed", "the same quote at the end of the text")
    if (first := _quote_over_lines(text, line)) is not None:
        found = f"a quote that only another one in line {line} closes"
        return _SyntaxProblem(first, found, "the same quote at the end of the text, in the same line")
    if "while parsing a flow" in problem and (bracket := _innermost_bracket(text, at)) is not None:
        return _unclosed_bracket(*bracket, line, problem)
    if "mapping values are not allowed" in problem:
        return _unexpected_colon(text.splitlines(), at)
    if "could not find expected ':'" in problem:
        return _SyntaxProblem(opened, "a line without ': '", _KEY_VALUE)
    return None


def _where_it_is(problem: str, line: int, text: str) -> _SyntaxProblem:
    if "<document start>" in problem:  # reported for a later line
        line = next((number for number, one in enumerate(text.splitlines(), 1) if one.startswith("%")), line)
    for pattern, (found, expected) in _IN_WORDS.items():
        if match := re.search(pattern, problem):
            return _SyntaxProblem(line, match.expand(found), expected)
    return _SyntaxProblem(line, re.sub(r"[<>]", "", problem), _YAML)


def _innermost_bracket(text: str, at: StringMark) -> tuple[str, int] | None:
    """The innermost bracket that is open at a place, and its line."""
    opened: list[tuple[str, int]] = []
    for token in _tokens(text):
        if token.start_mark.index >= at.index:
            break
        if isinstance(token, FlowMappingStartToken | FlowSequenceStartToken):
            bracket = "{" if isinstance(token, FlowMappingStartToken) else "["
            opened.append((bracket, int(token.start_mark.line) + 1))
        elif isinstance(token, FlowMappingEndToken | FlowSequenceEndToken) and opened:
            opened.pop()
    return opened[-1] if opened else None


def _unclosed_bracket(bracket: str, opened: int, line: int, problem: str) -> _SyntaxProblem:
    """A bracket that is closed by the wrong one or not at all, or whose entries lack a comma."""
    closing = _CLOSING[bracket]
    if other := re.search(r"(?:got|found) '([}\])])'", problem):
        where = f" in line {line}" if line != opened else ""
        return _SyntaxProblem(opened, f"a '{bracket}' that '{other[1]}' closes{where}", f"'{closing}'")
    if "found ','" in problem:
        return _SyntaxProblem(line, "a ',' with nothing before it", "a value before each ','")
    if line != opened or "stream end" in problem:
        found = f"a '{bracket}' that is not closed before line {line}"
        return _SyntaxProblem(opened, found, f"'{closing}' at its end, and ',' between its entries")
    return _SyntaxProblem(
        line, f"no ',' between two entries of '{bracket} {closing}'", f"',', or '{closing}' at the end"
    )


def _quote_over_lines(text: str, line: int) -> int | None:
    """The first line of a quoted text that ends in ``line``, where the parser stopped, but began in an earlier one."""
    last: ScalarToken | None = None
    for token in _tokens(text):
        if isinstance(token, ScalarToken) and token.end_mark.line + 1 <= line:
            last = token if token.style in ("'", '"') else None
    if last is None or last.end_mark.line + 1 != line or last.start_mark.line == last.end_mark.line:
        return None
    return int(last.start_mark.line) + 1


def _tokens(text: str) -> Iterator[Token]:
    """The tokens of a text up to its first error."""
    with contextlib.suppress(YAMLError, ValueError, OverflowError):
        yield from YAML(typ="safe", pure=True).scan(text)


def _unexpected_colon(lines: list[str], at: StringMark) -> _SyntaxProblem:
    """An unexpected ': ': the second one in a line, in a line too far right, or after a line without one."""
    own, number = lines[at.line], at.line + 1
    if re.search(r":\s", own[: at.column]):
        return _SyntaxProblem(number, "a second ': ' in one line", "quotes around text with ': ' in it")
    above = next((index for index in range(at.line - 1, -1, -1) if lines[index].strip()), None)
    if above is not None and not re.search(r":(\s|$)", lines[above]):
        return _SyntaxProblem(above + 1, "a line without ': '", _KEY_VALUE)
    return _SyntaxProblem(number, "a line too far to the right", _INDENTED)
