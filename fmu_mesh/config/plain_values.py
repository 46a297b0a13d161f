"""Values that a program gives, as a configuration file has them or as one of some types."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

__all__ = ["NOTHING", "in_words", "kinds_of", "plain", "taken"]


def plain(value: Any) -> Any:  # noqa: ANN401  whatever a program gives
    """A value as a file has it: paths are text, arrays are nested lists, bytes are base64.

    Example:
        >>> import numpy as np
        >>> plain({"d": np.float64(0.5), "x": np.array([[1, 2]]), 3: (float("nan"),)})
        {'d': 0.5, 'x': [[1, 2]], '3': ['NaN']}
    """
    if hasattr(value, "to_numpy"):  # a Series or a frame of pandas
        value = value.to_numpy()
    if hasattr(value, "tolist"):  # an array or a scalar of numpy
        value = value.tolist()
    match value:
        case PathLike():
            return str(value)
        case float() if not math.isfinite(value):
            return "NaN" if math.isnan(value) else "INF" if value > 0 else "-INF"
        case bytes():
            return base64.b64encode(value).decode()
        case Mapping():
            return {_key(key): plain(inner) for key, inner in value.items()}
        case list() | tuple():
            return [plain(inner) for inner in value]
        case _:
            return value


def _key(key: Any) -> Any:  # noqa: ANN401  whatever a program gives
    """A key as a file has it: text. Those of a `map` are numbers in a program."""
    key = key.item() if hasattr(key, "item") else key
    return str(key).lower() if isinstance(key, bool) else str(key) if isinstance(key, int) else key


NOTHING = object()
"""Stands for no value of the types."""

_CLASSES: Mapping[object, tuple[tuple[type, ...], str]] = {
    NoneType: ((NoneType,), "None"),
    bool: ((bool,), "True or False"),
    int: ((int,), "a whole number"),
    float: ((int, float), "a number"),
    str: ((str,), "a text"),
    Path: ((str, PathLike), "a path"),
}
"""The types without parts: the classes of their values, and how a message calls them."""


def taken(value: Any, kinds: Sequence[Any]) -> Any:  # noqa: ANN401  whatever a program gives
    """A value as the first of some types has it; `NOTHING` if it is of none.

    Scalars and arrays of numpy, and what pandas has, are taken where numbers, lists and mappings are. A mapping may be
    a list of pairs, or of texts such as `a.b=1`, if one of the types is an `Iterable`. A truth value is no number.

    Example:
        >>> import numpy as np
        >>> taken(np.float32(0.5), (float, NoneType)), taken(True, (float,)) is NOTHING
        (0.5, True)
        >>> taken([("a.b", np.array([1, 2])), "a.c=x"], (Mapping[str, Any], Iterable[Any]))
        {'a.b': [1, 2], 'a.c': 'x'}
    """
    if getattr(value, "ndim", None) == 0 and hasattr(value, "item"):  # a scalar of numpy, or an array without axes
        value = value.item()
    with_pairs = any(get_origin(kind) is Iterable for kind in kinds)
    of_kinds = (_of_kind(value, kind, with_pairs) for kind in kinds if kind is not str or Path not in kinds)
    return next((own for own in of_kinds if own is not NOTHING), NOTHING)


def _of_kind(value: Any, kind: Any, with_pairs: bool) -> Any:  # noqa: ANN401,FBT001  whatever a program gives
    made, origin = NOTHING, get_origin(kind) or kind
    if origin in _CLASSES:
        if isinstance(value, _CLASSES[origin][0]) and isinstance(value, bool) == (origin is bool):
            made = _made(origin, value)
    elif origin is Mapping:
        made = _mapping(value, get_args(kind)[1], with_pairs)
    elif origin is Sequence:
        made = _sequence(value, get_args(kind)[0])
    elif origin is Literal:
        made = value if isinstance(value, str) and value in get_args(kind) else NOTHING
    elif origin is Callable:
        made = value if callable(value) else NOTHING
    elif origin is not Iterable:
        made = value if isinstance(value, origin) else NOTHING
    return made


def _made(kind: Any, value: Any) -> Any:  # noqa: ANN401  one of `_CLASSES`
    if isinstance(value, str | PathLike) and "\0" in str(value):
        return NOTHING
    try:
        return kind(value) if kind in (float, Path) else value
    except OverflowError:
        return NOTHING


def _mapping(value: Any, of: Any, with_pairs: bool) -> Any:  # noqa: ANN401,FBT001  whatever a program gives
    """A mapping, also a Series or a frame of pandas; or a list of pairs or of texts such as `a.b=1`."""
    if callable(getattr(value, "items", None)):
        pairs = [*value.items()]
    elif with_pairs and isinstance(value, list | tuple):
        from .yaml_text import read_value  # noqa: PLC0415  slow to import, and only for texts

        try:
            pairs = [read_value(one) if isinstance(one, str) else (one[0], one[1]) for one in value]
        except (ValueError, TypeError, LookupError):
            return NOTHING
    else:
        return NOTHING
    made = {name: plain(inner) if of is Any else taken(inner, (of,)) for name, inner in pairs}
    right = all(isinstance(name, str) and inner is not NOTHING for name, inner in made.items())
    return made if right else NOTHING


def _sequence(value: Any, of: Any) -> Any:  # noqa: ANN401  whatever a program gives
    given = value.tolist() if hasattr(value, "tolist") else value
    if not isinstance(given, list | tuple):
        return NOTHING
    made = tuple(taken(one, kinds_of(of)) for one in given)
    return made if NOTHING not in made else NOTHING


_WORDS = {Mapping: "a mapping", Iterable: "a list of pairs", Callable: "a function"}


def in_words(kind: Any) -> str:  # noqa: ANN401  a type, which has no common class
    """What a value of a type is, for a message."""
    origin = get_origin(kind) or kind
    if origin is Literal:
        return " or ".join(map(repr, get_args(kind)))
    if origin is Sequence:
        return f"a list, each item {in_words(get_args(kind)[0])}"
    if origin in _CLASSES:
        return _CLASSES[origin][1]
    return _WORDS.get(origin) or " or ".join(map(in_words, get_args(kind))) or f"a {kind.__name__}"


def kinds_of(annotation: Any) -> tuple[Any, ...]:  # noqa: ANN401  a type, which has no common class
    """The types of a union, or the one type."""
    return get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
