"""The `map` of a connection: from the words of a configuration to numbers, and which results its input can be.

Owns what an entry means (SSP 2.0, 4.5.2.2 to 4.5.2.4). What becomes of a value in a run is
`fmu_mesh.rings.value_change`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

from msgspec.structs import replace

from fmu_mesh.config.findings import Findings
from fmu_mesh.text import listed, nearest, shown, with_article
from fmu_mesh.variables.model_description import Variable
from fmu_mesh.variables.value_conversion import ValueRefused, to_value
from fmu_mesh.variables.value_types import INTEGERS

__all__ = ["checked_items", "map_text", "map_words", "resolve_map"]

_WHOLE: Final = re.compile(r"[+-]?\d+")
_TRUTH: Final = {"false": 0, "true": 1}

Pairs = tuple[tuple[int, int], ...]


def resolve_map(
    entries: Mapping[str, bool | int | str], source: Variable, target: Variable, path: str, findings: Findings
) -> Pairs:
    """The entries of a `map` as numbers, in ascending order; false is 0 and true is 1.

    An entry says what the input gets, by the value of the output: `true`, a whole number, or an item. One for a number
    that the output cannot be has no effect, and is left out.
    """
    if not all(variable.type in INTEGERS or variable.type == "Boolean" for variable in (source, target)):
        found = f"a map from {with_article(_type_of(source))} to {with_article(_type_of(target))}"
        findings.add(path, found, "a map between Boolean, integer types and Enumeration only")
        return ()
    pairs: dict[int, int] = {}
    words: dict[int, str] = {}
    for word, value in entries.items():
        place = f"{path}.{word}"
        number = _source_number(word, source, place, findings)
        if number is not None and number in words:
            found = f"a second entry for the value {number} of the {source.type_name} '{source.name}'"
            findings.add(place, f"{found}, after '{words[number]}'", "one entry for a value")
            number = None
        try:
            # The limits of the input are not those of its type: the FMU sees to them.
            scalar = replace(target, shape=(), dimensions=(), minimum=None, maximum=None)
            result = to_value(value, scalar)
        except ValueRefused as refused:
            found = f"{shown(value)} for the {_type_of(target)} '{target.name}'"
            findings.add(place, found, refused.expected, refused.suggestion)
            continue
        assert isinstance(result, int)
        if number is not None:
            words[number] = word
            if _can_be(source, number):
                pairs[number] = int(result)
    return tuple(sorted(pairs.items()))


def checked_items(source: Variable, target: Variable, pairs: Pairs) -> tuple[tuple[str, int], ...]:
    """The items of an Enumeration if a number or a map may give it none of them; empty if there is nothing to check.

    What one Enumeration gives another one without a map is up to the two FMUs.
    """
    if target.type != "Enumeration" or not target.items or (source.type == "Enumeration" and not pairs):
        return ()
    if source.type == "Enumeration" and source.items:
        changed, known = dict(pairs), {number for _, number in target.items}
        if all(changed.get(number, number) in known for _, number in source.items):
            return ()
    return target.items


def map_words(pairs: Pairs, source: Variable, target: Variable) -> dict[str, str]:
    """The entries in words, such as `{"off": "idle"}`: items by their names."""
    return {_word(have, source): _word(want, target) for have, want in pairs}


def map_text(pairs: Pairs, source: Variable, target: Variable) -> str:
    """The entries for a person, of many only the first ones: `off -> idle, 5 -> running`."""
    return listed([f"{have} -> {want}" for have, want in map_words(pairs, source, target).items()], nothing="")


def _source_number(word: str, source: Variable, place: str, findings: Findings) -> int | None:
    """The number of the output that an entry is for; None after a finding."""
    items = dict(source.items) if source.type == "Enumeration" else {}
    if word in items:
        return items[word]
    if source.type == "Boolean":
        number, expected = _TRUTH.get(word), "true or false"
    else:
        number = int(word) if _WHOLE.fullmatch(word) else None
        expected = "a whole number"
        if items:
            expected = f"one of {listed([f'{name} ({item})' for name, item in items.items()])}"
    if number is None:
        found = f"an entry for '{word}' of the {_type_of(source)} '{source.name}'"
        findings.add(place, found, expected, nearest(word, items))
    return number


def _can_be(source: Variable, number: int) -> bool:
    """Whether an output can have a value."""
    if source.type == "Boolean":
        return True
    if source.type == "Enumeration" and source.items:
        return number in (item for _, item in source.items)
    return number in INTEGERS[source.type]


def _word(number: int, variable: Variable) -> str:
    if variable.type == "Boolean":
        return "true" if number else "false"
    names = {item: name for name, item in variable.items} if variable.type == "Enumeration" else {}
    return names.get(number, str(number))


def _type_of(variable: Variable) -> str:
    """The type of a variable, or of the elements of an array."""
    return variable.type_name.partition("[")[0]
