"""Values that a program gives, as a configuration file has them or as one of some types."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from os import PathLike
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

__all__ = ["kinds_of", "plain", "taken"]


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


_CLASSES: Mapping[object, Any] = {
    float: int | float,
    Path: str | PathLike,
    Sequence: list | tuple,
    Literal: str,
    Iterable: (),
}
"""The classes of what is taken for some types; of any other type, the class itself."""


def taken(value: Any, kinds: Sequence[Any]) -> Any:  # noqa: ANN401  whatever a program gives
    """A value as the first of some types has it.

    Scalars and arrays of numpy, and what pandas has, are taken where numbers, lists and mappings are. A mapping may be
    a list of pairs, or of texts such as `a.b=1`, if one of the types is an `Iterable`. A truth value is no number.

    Example:
        >>> import numpy as np
        >>> taken(np.float32(0.5), (float, type(None)))
        0.5
        >>> taken([("a.b", np.array([1, 2])), "a.c=x"], (Mapping[str, Any], Iterable[Any]))
        {'a.b': [1, 2], 'a.c': 'x'}

    Raises:
        TypeError: it is of none of them. Or a ValueError, or a LookupError.
    """
    if object in kinds:  # whoever gets it looks into it
        return value
    if getattr(value, "ndim", None) == 0 and hasattr(value, "item"):  # a scalar of numpy, or an array without axes
        value = value.item()
    elif not isinstance(value, Mapping) and callable(getattr(value, "items", None)):  # a Series or a frame of pandas
        value = dict(value.items())
    elif hasattr(value, "tolist"):
        value = value.tolist()
    with_pairs = any(get_origin(kind) is Iterable for kind in kinds)
    if with_pairs and isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping):
        from .yaml_text import read_value  # noqa: PLC0415  slow to import, and only for texts

        value = dict(read_value(one) if isinstance(one, str) else (one[0], one[1]) for one in value)
    for kind in kinds:
        if kind is not str or Path not in kinds:
            with suppress(TypeError, ValueError, LookupError, OverflowError):
                return _of_kind(value, kind)
    raise TypeError


def _of_kind(value: Any, kind: Any) -> Any:  # noqa: ANN401  whatever a program gives
    origin, parts = get_origin(kind) or kind, get_args(kind)
    right = isinstance(value, _CLASSES.get(origin, origin)) and isinstance(value, bool) == (origin is bool)
    if not right or (origin is Literal and value not in parts) or (origin is Path and "\0" in str(value)):
        raise TypeError
    if origin is Mapping:
        if not all(isinstance(name, str) for name in value):
            raise TypeError
        return {name: plain(one) if parts[1] is Any else taken(one, parts[1:]) for name, one in value.items()}
    if origin is Sequence:
        return tuple(taken(one, kinds_of(parts[0])) for one in value)
    return origin(value) if origin in (float, Path) else value


def kinds_of(annotation: Any) -> tuple[Any, ...]:  # noqa: ANN401  a type, which has no common class
    """The types of a union, or the one type."""
    return get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
