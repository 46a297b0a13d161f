"""Which columns of a result somebody means: by a name, that of an array, or a pattern."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from ..errors import ConfigurationError
from ..text import listed, matching, nearest

__all__ = ["chosen_names", "of_one_instance"]


def chosen_names(path: Path | str, names: Sequence[str], wanted: Sequence[str]) -> Sequence[str]:
    """The wanted variables of a result; all of them if none is named.

    A name may be that of an array, which means all of its elements, or a pattern: `*` stands for any characters, `?`
    for one, and `re:` begins a regular expression. In a result of one instance, it may lack the name of the instance.

    Example:
        >>> chosen_names("demo.csv", ["arm.a", "arm.v", "motor.i[1]", "motor.i[2]"], ["motor.i", "arm.?"])
        ['motor.i[1]', 'motor.i[2]', 'arm.a', 'arm.v']

    Raises:
        ConfigurationError: one is not there; with the nearest name. Or a regular expression is none.
    """
    found: dict[str, None] = {}
    unknown = []
    for text in wanted:
        own = matching(text, names) or _elements(text, names)
        if not own and (instance := of_one_instance(names)):
            own = matching(f"{instance}.{text}", names) or _elements(f"{instance}.{text}", names)
        found.update(dict.fromkeys(own))
        unknown += [text] if not own else []
    if unknown:
        meant = [name for text in unknown for name in _meant(text, names)]
        hint = f"Did you mean {_either(meant)}?" if meant else f"There are: {listed(names)}."
        raise ConfigurationError(f"'{path}' has no variable {_either(unknown)}.", hint=hint)
    return [*found] or names


def of_one_instance(names: Iterable[str]) -> str | None:
    """The instance that all columns are of; None if there are several."""
    instances = {name.partition(".")[0] for name in names}
    return min(instances) if len(instances) == 1 else None


def _elements(array: str, names: Sequence[str]) -> list[str]:
    """The columns of the elements of an array."""
    matches = re.compile(re.escape(array) + r"\[[0-9]+(,[0-9]+)*\]").fullmatch
    return [name for name in names if matches(name)]


def _meant(text: str, names: Sequence[str]) -> list[str]:
    """The columns that somebody may have meant: those of variables with this name, or else the nearest name."""
    alike = [name for name in names if name.partition(".")[2] == text]
    near = nearest(text, names) or nearest(text, {name.partition(".")[2]: name for name in names})
    if alike or near is None:
        return alike
    return [near] if near in names else [name for name in names if name.partition(".")[2] == near]


def _either(names: Sequence[str]) -> str:
    return " or ".join(filter(None, [listed([repr(name) for name in names[:-1]], nothing=""), repr(names[-1])]))
