"""Errors of YAML syntax in plain words, for somebody who writes a configuration.

Owns the words for the errors of the parser, and the line of their cause: the parser reports an open bracket or quote
many lines after it was opened. Knows nothing of what the values mean.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator

import msgspec
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, StringMark, YAMLError
from ruamel.yaml.reader import ReaderError
from ruamel.yaml.tokens import (
    FlowMappingEndToken,
    FlowMappingStartToken,
    FlowSequenceEndToken,
    FlowSequenceStartToken,
    ScalarToken,
    Token,
)

__all__ = ["SyntaxProblem", "in_words"]

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


class SyntaxProblem(msgspec.Struct, frozen=True):
    """An error of syntax in plain words.

    Attributes:
        line: the line of the cause, counted from 1.
        found: what the text has there.
        expected: what would be valid.
    """

    line: int
    found: str
    expected: str


def in_words(error: YAMLError, text: str) -> SyntaxProblem:
    """The cause of an ``error`` of the parser in ``text``, in plain words."""
    if isinstance(error, ReaderError):
        line = text.count("\n", 0, error.position) + 1
        return SyntaxProblem(line, f"the character U+{error.character:04X}", "characters that can be printed")
    at = error.problem_mark or error.context_mark if isinstance(error, MarkedYAMLError) else None
    if not isinstance(error, MarkedYAMLError) or at is None:
        return SyntaxProblem(1, " ".join(str(error).split()), _YAML)
    opened = error.context_mark.line + 1 if error.context_mark is not None else at.line + 1
    problem = " ".join(filter(None, (error.problem, error.context)))
    return _where_it_began(problem, opened, at, text) or _where_it_is(problem, at.line + 1, text)


def _where_it_began(problem: str, opened: int, at: StringMark, text: str) -> SyntaxProblem | None:
    """A cause before the place where the parser stopped; ``opened`` is the line where the current part began."""
    line = at.line + 1
    if "unexpected end of stream while scanning a quoted" in problem:
        return SyntaxProblem(opened, "a quote that is not closed", "the same quote at the end of the text")
    if (first := _quote_over_lines(text, line)) is not None:
        found = f"a quote that only another one in line {line} closes"
        return SyntaxProblem(first, found, "the same quote at the end of the text, in the same line")
    if "while parsing a flow" in problem and (bracket := _innermost_bracket(text, at)) is not None:
        return _unclosed_bracket(*bracket, line, problem)
    if "mapping values are not allowed" in problem:
        return _unexpected_colon(text.splitlines(), at)
    if "could not find expected ':'" in problem:
        return SyntaxProblem(opened, "a line without ': '", _KEY_VALUE)
    return None


def _where_it_is(problem: str, line: int, text: str) -> SyntaxProblem:
    if "<document start>" in problem:  # reported for a later line
        line = next((number for number, one in enumerate(text.splitlines(), 1) if one.startswith("%")), line)
    for pattern, (found, expected) in _IN_WORDS.items():
        if match := re.search(pattern, problem):
            return SyntaxProblem(line, match.expand(found), expected)
    return SyntaxProblem(line, re.sub(r"[<>]", "", problem), _YAML)


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


def _unclosed_bracket(bracket: str, opened: int, line: int, problem: str) -> SyntaxProblem:
    """A bracket that is closed by the wrong one or not at all, or whose entries lack a comma."""
    closing = _CLOSING[bracket]
    if other := re.search(r"(?:got|found) '([}\])])'", problem):
        where = f" in line {line}" if line != opened else ""
        return SyntaxProblem(opened, f"a '{bracket}' that '{other[1]}' closes{where}", f"'{closing}'")
    if "found ','" in problem:
        return SyntaxProblem(line, "a ',' with nothing before it", "a value before each ','")
    if line != opened or "stream end" in problem:
        found = f"a '{bracket}' that is not closed before line {line}"
        return SyntaxProblem(opened, found, f"'{closing}' at its end, and ',' between its entries")
    return SyntaxProblem(
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


def _unexpected_colon(lines: list[str], at: StringMark) -> SyntaxProblem:
    """An unexpected ': ': the second one in a line, in a line too far right, or after a line without one."""
    own, number = lines[at.line], at.line + 1
    if re.search(r":\s", own[: at.column]):
        return SyntaxProblem(number, "a second ': ' in one line", "quotes around text with ': ' in it")
    above = next((index for index in range(at.line - 1, -1, -1) if lines[index].strip()), None)
    if above is not None and not re.search(r":(\s|$)", lines[above]):
        return SyntaxProblem(above + 1, "a line without ': '", _KEY_VALUE)
    return SyntaxProblem(number, "a line too far to the right", _INDENTED)
