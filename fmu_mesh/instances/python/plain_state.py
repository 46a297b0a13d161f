"""The state of a component as bytes: plain values, arrays and generators of random numbers, and nothing else.

Nothing is pickled, so reading such bytes runs no code. What comes back has the same types, the same order and the same
bits; two attributes that are one list are one list again.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from itertools import combinations
from typing import Any, Final

import msgspec
import numpy as np

__all__ = ["NotPlain", "check_memory", "encoded", "plain"]

_AS_THEY_ARE: Final = (type(None), bool, float, str, bytes)
_GENERATORS: Final = ("MT19937", "PCG64", "PCG64DXSM", "Philox", "SFC64")
_EXPECTED: Final = (
    "None, bool, int, float, str, bytes, list, tuple, dict, an array or a number of numpy, or a generator of random "
    "numbers (random.Random, numpy.random.Generator)"
)


class NotPlain(Exception):
    """A value cannot be written; the text is the predicate of a sentence whose subject is the component."""


def encoded(value: object) -> bytes:  # noqa: C901  one case for each type
    """A value as bytes; each part that may change has a number, by which it is meant where it is met again.

    Raises:
        NotPlain: it has something that is no plain value; names where that is.
    """
    numbers: dict[int, int] = {}
    alive: list[object] = []  # what has a number: else another object could get its address

    def tree(own: Any, place: str) -> Any:  # noqa: ANN401, C901, PLR0911  a value of any type, each in its form
        kind = type(own)
        if kind in _AS_THEY_ARE:
            return own
        if kind is int:
            return own if -(2**63) <= own < 2**63 else ["i", str(own)]
        if kind is tuple:
            return ["t", [tree(one, f"{place}[{n}]") for n, one in enumerate(own)]]
        if isinstance(own, np.generic) and _is_plain(own.dtype):
            return ["n", own.dtype.str, own.tobytes()]
        if id(own) in numbers:
            return ["=", numbers[id(own)]]
        numbers[id(own)] = len(numbers)
        alive.append(own)
        if kind is list:
            return ["l", [tree(one, f"{place}[{n}]") for n, one in enumerate(own)]]
        if kind is dict:
            values = ((k, v, f"{place}[{k!r}]" if place else f"attribute {k!r}") for k, v in own.items())
            return ["d", [[tree(k, f"a key of {place}"), tree(v, inside)] for k, v, inside in values]]
        if kind is np.ndarray and _is_plain(own.dtype):
            # As it lies in memory: the order of a sum, and so its last digits, may depend on it.
            axes = sorted(range(own.ndim), key=lambda axis: -abs(own.strides[axis]))
            return ["a", own.dtype.str, own.shape, axes, own.transpose(axes).tobytes()]
        if kind is random.Random:
            return ["r", tree(own.getstate(), place)]
        if kind is np.random.Generator and type(source := own.bit_generator).__name__ in _GENERATORS:
            seed = getattr(source.seed_seq, "state", None)  # `spawn` goes on from it
            return ["g", type(source).__name__, tree(seed, place), tree(source.state, place)]
        type_ = kind.__qualname__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__qualname__}"
        of = f" of {own.dtype}" if isinstance(own, np.ndarray) else ""
        raise NotPlain(f"has a {type_}{of} in {place or 'the place of all attributes'}; expected {_EXPECTED}")

    try:
        return msgspec.msgpack.encode(tree(value, ""))
    except (RecursionError, UnicodeEncodeError) as error:
        raise NotPlain(f"has a value that cannot be written: {error}") from error
    finally:
        alive.clear()  # a function that calls itself is in a circle of objects, and would keep them


def plain(data: bytes) -> Any:  # noqa: ANN401, C901  what was encoded
    """The value whose bytes these are.

    Raises:
        ValueError: they are no such bytes.
    """
    known: list[object] = []

    def put(own: object) -> Any:  # noqa: ANN401  as it is
        known.append(own)
        return own

    def value(form: Any) -> Any:  # noqa: ANN401, C901, PLR0911  as for `tree`
        match form:
            case None | bool() | int() | float() | str() | bytes():
                return form
            case ["i", digits]:
                return int(digits)
            case ["t", items]:
                return tuple(value(one) for one in items)
            case ["n", dtype, content]:
                return np.frombuffer(content, _dtype(dtype), 1)[0]
            case ["=", number]:
                return known[number]
            case ["l", items]:
                made = put([])
                made.extend(value(one) for one in items)
                return made
            case ["d", items]:
                made = put({})
                made.update((value(k), value(v)) for k, v in items)
                return made
            case ["a", dtype, shape, axes, content]:
                lying = np.frombuffer(bytearray(content), _dtype(dtype)).reshape([shape[axis] for axis in axes])
                return put(lying.transpose(np.argsort(axes)) if axes else lying)
            case ["r", state]:
                made = put(random.Random())  # noqa: S311  it is a model's
                made.setstate(value(state))
                return made
            case ["g", name, seed, state] if name in _GENERATORS:
                place = len(known)
                known.append(None)
                source = getattr(np.random, name)(np.random.SeedSequence(**value(seed)))
                source.state = value(state)
                known[place] = np.random.Generator(source)
                return known[place]
        raise ValueError(f"unknown form {str(form)[:40]}")

    try:
        return value(msgspec.msgpack.decode(data))
    except (msgspec.MsgspecError, TypeError, LookupError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(str(error)) from error
    finally:
        known.clear()  # as above


def check_memory(attributes: Mapping[str, object]) -> None:
    """Refuse arrays that are parts of one: each of them would come back with memory of its own.

    Raises:
        NotPlain: two of these attributes have memory in common, and are not one array.
    """
    arrays = [(name, own) for name, own in attributes.items() if isinstance(own, np.ndarray)]
    for (name, own), (other, array) in combinations(arrays, 2):
        if own is not array and np.may_share_memory(own, array):
            raise NotPlain(f"has arrays in '{name}' and '{other}' that share memory")


def _is_plain(dtype: np.dtype[Any]) -> bool:
    return dtype.kind in "biufcSUmM" and not dtype.hasobject


def _dtype(text: object) -> np.dtype[Any]:
    dtype = np.dtype(str(text))
    if not _is_plain(dtype):
        raise ValueError(f"arrays of the type {dtype}")
    return dtype
