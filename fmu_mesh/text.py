"""Text for people: the nearest name, a list of names, a value, a number, a path, and what a pattern matches."""

from __future__ import annotations

import difflib
import json
import re
import subprocess
import sys
from collections.abc import Collection, Iterable, Sequence
from difflib import SequenceMatcher
from pathlib import Path

from .errors import ConfigurationError
from .printing import printable

__all__ = [
    "EXPRESSION",
    "WILDCARDS",
    "counted",
    "did_you_mean",
    "is_pattern",
    "listed",
    "matched",
    "matching",
    "meant",
    "nearest",
    "nearest_file",
    "option_text",
    "printable",
    "short_number",
    "short_path",
    "shown",
    "walk",
    "with_article",
]

_LISTED_NAMES = 8
_SHOWN_CHARACTERS = 60
_WEIGHT_OF_ENDING, _LIKE = 0.3, 0.85
"""What the ending of a file counts beside the rest of its name, and how like two names are, of 1.3."""

_REPETITION = re.compile(r"[*+?{]")
_MATCHING = """
import json, re, sys
expression, names = json.load(sys.stdin)
matches = re.compile(expression, re.DOTALL).fullmatch
json.dump([name for name in names if matches(name)], sys.stdout)
"""
_MATCHING_S = 10.0
"""How long all names may take."""

EXPRESSION = "re:"
"""Begins a pattern of names that is a regular expression."""

WILDCARDS = "*?"
"""The signs of other patterns."""


def nearest(name: str, names: Iterable[str]) -> str | None:
    """The one of ``names`` that is most similar to ``name``, or None if none is similar."""
    folded: dict[str, str] = {}
    for candidate in names:
        folded.setdefault(candidate.casefold(), candidate)
    wanted = name.casefold()
    close = difflib.get_close_matches(wanted, folded, n=1)
    if not close and len(wanted) > 1:  # the beginning of exactly one name
        longer = [candidate for candidate in folded if candidate.startswith(wanted)]
        close = longer if len(longer) == 1 else []
    return folded[close[0]] if close else None


def did_you_mean(name: str, names: Iterable[str], otherwise: str | None = None) -> str | None:
    """The hint for a name that is not there: the most similar one, or something else if none is similar."""
    return meant(nearest(name, names), otherwise)


def nearest_file(path: Path) -> str | None:
    """The existing file in the folder of ``path`` that has the nearest name, or None. Endings decide among equals."""
    try:
        names = sorted(entry.name for entry in path.parent.iterdir() if entry.is_file())
    except OSError:
        return None
    wanted = Path(path.name.casefold())

    def likeness(name: str) -> float:
        own = Path(name.casefold())
        stem, ending = SequenceMatcher(None, wanted.stem, own.stem), SequenceMatcher(None, wanted.suffix, own.suffix)
        return stem.ratio() + _WEIGHT_OF_ENDING * ending.ratio()

    name = max(names, key=likeness, default=None)
    if name is None or likeness(name) < _LIKE:
        name = nearest(path.name, names)
    return str(path.with_name(name)) if name is not None else None


def meant(near: str | None, otherwise: str | None = None) -> str | None:
    """The question whether a name was meant, as a hint; ``otherwise`` if no name is near."""
    return f"Did you mean '{near}'?" if near is not None else otherwise


def listed(names: Sequence[str], *, nothing: str = "none") -> str:
    """The names, separated by commas; of more than 8 the first ones and how many more there are."""
    if not names:
        return nothing
    rest = len(names) - _LISTED_NAMES
    return ", ".join(names[:_LISTED_NAMES]) + (f" and {rest} more" if rest > 0 else "")


def walk(names: Sequence[str], most: int = _LISTED_NAMES) -> str:
    """Names in the order in which one leads to the next, such as `a.y -> b.y and 3 more`."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return " -> ".join(names[:most]) + more


def counted(number: int, what: str) -> str:
    """`1 row`, `2 rows`, `0 processes`."""
    return f"{number} {what}{'' if number == 1 else 'es' if what.endswith('s') else 's'}"


def with_article(word: str) -> str:
    """`an input`, `a Real`."""
    return f"an {word}" if word[0] in "aeiouAEIOU" else f"a {word}"


def shown(value: object) -> str:
    """A value as a message shows it: at most 60 characters, a mapping and a list only by their kind."""
    match value:
        case None:
            return "nothing (null)"
        case bool():
            return "true" if value else "false"
        case str():
            text = repr(value)
        case dict():
            return "a mapping"
        case list():
            return "a list"
        case _:
            text = str(value)
    return text if len(text) <= _SHOWN_CHARACTERS else f"{text[: _SHOWN_CHARACTERS - 3]}..."


def option_text(name: str, value: object) -> str:
    """An option and its value as a program gives them, for messages; the command line shows them as a flag.

    Example:
        >>> option_text("start_values", {"pendulum.l": 2}), option_text("output", Path("a.csv"))
        ("`start_values={'pendulum.l': 2}`", "`output='a.csv'`")
    """
    text = repr(str(value) if isinstance(value, Path) else list(value) if isinstance(value, tuple) else value)
    return f"`{name}={text if len(text) <= _SHOWN_CHARACTERS else f'{text[: _SHOWN_CHARACTERS - 3]}...'}`"


def short_number(value: float) -> str:
    """A number with up to 12 significant digits: what rounding adds to a decimal number is not shown."""
    return f"{value:.12g}"


def short_path(path: str | Path) -> str:
    """A path relative to the current folder if it is in there."""
    try:
        return str(Path(path).relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def is_pattern(text: str) -> bool:
    """Whether a text has a sign of a pattern of names; the name of a variable may have one too."""
    return text.startswith(EXPRESSION) or any(sign in text for sign in WILDCARDS)


def matching(text: str, names: Collection[str]) -> list[str]:
    """The names that a text means: the one that it is, or else all that it matches as a pattern.

    Raises:
        ConfigurationError: it is no regular expression.
    """
    if text in names:
        return [text]
    if not is_pattern(text):
        return []
    try:
        found = matched(text, names)
    except ValueError as error:
        raise ConfigurationError(f"'{text}' is no regular expression: {error}.") from error
    return [name for name in names if name in found]


def matched(pattern: str, names: Collection[str]) -> set[str]:
    """The names that a pattern matches as a whole: `*` any characters, `?` one; after `re:` it is a regular expression.

    Brackets belong to the names of variables, so these are not the patterns of `fnmatch`.

    Raises:
        ValueError: it is no regular expression, or one that is too large or takes too long.
    """
    if pattern.startswith(EXPRESSION):
        try:
            expression = re.compile(pattern.removeprefix(EXPRESSION), re.DOTALL)
        except (re.error, OverflowError, RecursionError) as error:
            raise ValueError(str(error)) from error
        if len(_REPETITION.findall(expression.pattern)) > 1:
            return _matched_in_time(expression.pattern, names)
    else:
        # The shortest text in front of each part is as good as any other, so no other has to be tried (`?>`).
        first, *rest = ("".join("." if c == "?" else re.escape(c) for c in part) for part in pattern.split("*"))
        tried = [f"(?>.*?{part})" for part in rest[:-1]] + [f".*{part}" for part in rest[-1:]]
        expression = re.compile("".join((first, *tried)), re.DOTALL)
    return {name for name in names if expression.fullmatch(name)}


def _matched_in_time(expression: str, names: Collection[str]) -> set[str]:
    """The names that an expression matches, found in a process of its own: some, as `(a*)*b`, take for ever."""
    command, request = [sys.executable, "-ISc", _MATCHING], json.dumps([expression, [*names]])
    try:
        done = subprocess.run(command, input=request, capture_output=True, text=True, timeout=_MATCHING_S, check=True)
    except (subprocess.SubprocessError, OSError) as error:
        reason = f"it takes more than {_MATCHING_S:g} s" if isinstance(error, subprocess.TimeoutExpired) else str(error)
        raise ValueError(reason) from error
    return {*json.loads(done.stdout)}
