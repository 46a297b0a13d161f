"""The variants of a sweep: the values that each run gets, from a grid, from a sampler, or as a program lists them.

Pure values. Knows neither models nor files: whether a name exists and a value fits is checked with the configuration.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import islice, product
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..config.findings import Findings
from ..config.plain_values import plain
from ..config.yaml_text import read
from ..errors import CallRefused, ConfigurationError
from ..installing import importing
from ..text import listed, meant, nearest, shown
from ..variables.value_types import PlainValue

__all__ = ["MAX_VARIANTS", "SAMPLERS", "Parameters", "Range", "Values", "grid", "read_values", "sampled", "variants_of"]

Parameters = dict[str, PlainValue]
"""One variant: its values by name, such as `pendulum.d` or `simulation.step_size`."""

MAX_VARIANTS = 1_000_000
"""Largest number of variants of one sweep: all of them are in memory."""

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_RANGE = re.compile(rf"\s*{_NUMBER}\s*:[^,\[\]{{}}\"'#]*")
_SAMPLER = re.compile(r"([^:]*):([1-9][0-9]{0,6})")
SAMPLERS = {"lhs": "LatinHypercube", "sobol": "Sobol", "halton": "Halton", "random": ""}
"""The samplers by name, each with its class in `scipy.stats.qmc`; independent numbers need none."""


class Range(msgspec.Struct, frozen=True):
    """An interval in which a parameter varies.

    Example:
        >>> import fmu_mesh
        >>> damping = fmu_mesh.Range(0.01, 1.0, 3, "log")
        >>> grid({"pendulum.d": damping})
        [{'pendulum.d': 0.01}, {'pendulum.d': 0.1}, {'pendulum.d': 1.0}]

    Attributes:
        low: its first value, in the unit of the parameter.
        high: its last value.
        count: number of values, both ends included; None leaves the choice to a sampler. Both ends may be of the type
            `int`: then the values are whole numbers, if all of them are whole.
        scale: `linear` for equal distances; `log` for equal ratios, for which both ends are above 0.
    """

    low: float
    high: float
    count: int | None = None
    scale: Literal["linear", "log"] = "linear"


Values = Range | Sequence[PlainValue]
"""What a parameter gets: values of a range, or those of a list."""


def read_values(text: str) -> tuple[str, Values]:
    """The name and the values of a text such as `--vary` takes.

    Example:
        >>> read_values("pendulum.d=0.05:0.8:16")
        ('pendulum.d', Range(low=0.05, high=0.8, count=16, scale='linear'))
        >>> read_values("a.b=0.01:10:5:log")[1], read_values("a.b=0.05:0.8")[1].count
        (Range(low=0.01, high=10, count=5, scale='log'), None)
        >>> read_values("a.b=0.1, 2, x"), read_values("a.b=[[1, 2], [3, 4]]")
        (('a.b', [0.1, 2, 'x']), ('a.b', [[1, 2], [3, 4]]))

    Args:
        text: `NAME=LOW:HIGH:COUNT`, also with `:log` at its end, or without the count for a sampler; or
            `NAME=VALUE,VALUE`, each in YAML; or `NAME=[VALUE,VALUE]`, where a value may itself be a list: an array.

    Raises:
        ConfigurationError: it is none of these.
    """
    name, equals, written = (part.strip() for part in text.partition("="))
    if not (name and equals and written):
        raise _refused(text, "no values of a parameter", "NAME=LOW:HIGH:COUNT or NAME=VALUE,VALUE")
    if _RANGE.fullmatch(written):
        return name, _read_range(text, written)
    values = read(written if written.startswith("[") else f"[{written}]", wrong := Findings("--vary"), {})
    if len(wrong) or not isinstance(values, list):
        found = next(iter(wrong)).found if len(wrong) else f"the value {shown(values)}"
        raise _refused(text, found, "values in YAML, separated by commas")
    kept: list[PlainValue] = []
    for value in values:
        if value is None or isinstance(value, dict):
            raise _refused(text, shown(value), "numbers, texts, true or false, or lists")
        kept.append(value)
    return name, kept


def grid(vary: Mapping[str, Values]) -> list[Parameters]:
    """All combinations of the values; the last name varies fastest. Equal combinations are there once.

    Example:
        >>> grid({"pendulum.d": Range(0.0, 1.0, 2), "pendulum.l": [1.0, 2.0]})[1:3]
        [{'pendulum.d': 0.0, 'pendulum.l': 2.0}, {'pendulum.d': 1.0, 'pendulum.l': 1.0}]

    Raises:
        ConfigurationError: there is no name, a list is empty, a range has no count, or there are too many combinations.
    """
    lists = {name: _listed_values(values) for name, values in _checked(vary).items()}
    for name, values in lists.items():
        if values is None:
            hint = f"Give it one, as in {name}=LOW:HIGH:16, or choose a sampler, such as lhs:64."
            raise ConfigurationError(f"the range of '{name}' has no count.", hint=hint)
    count = math.prod(len(values) for values in lists.values() if values is not None)
    if count > MAX_VARIANTS:
        hint = "Choose fewer values, or a sampler, such as lhs:1000."
        raise ConfigurationError(f"there are {count} combinations; {MAX_VARIANTS} are possible.", hint=hint)
    return _once(lists, product(*filter(None, lists.values())))


def sampled(vary: Mapping[str, Values], sampler: str, seed: int = 0) -> list[Parameters]:
    """Combinations that a sampler chooses. Equal combinations are there once.

    A range without a count can have any value in it. A list, and a range with a count, only has its own values.

    Example:
        >>> sampled({"pendulum.d": Range(0.0, 1.0), "pendulum.l": [1.0, 2.0]}, "random:2", seed=1)
        [{'pendulum.d': 0.5118216247002567, 'pendulum.l': 2.0}, {'pendulum.d': 0.14415961271963373, 'pendulum.l': 2.0}]

    Args:
        vary: what varies.
        sampler: `lhs:64` (Latin hypercube), `sobol:64` or `halton:64` (low discrepancy, scrambled), or `random:64`.
        seed: a whole number, at least 0. The same seed chooses the same values.

    Raises:
        ConfigurationError: there is no such sampler, it needs scipy, which is not installed, or a range is wrong.
    """
    lists = {name: _listed_values(values) for name, values in _checked(vary).items()}
    columns: list[list[PlainValue]] = []
    for (name, values), shares in zip(lists.items(), _shares(sampler, len(lists), seed).T, strict=True):
        if values is not None:
            columns.append([values[min(int(share * len(values)), len(values) - 1)] for share in shares])
        else:
            span = vary[name]
            assert isinstance(span, Range)
            columns.append(_scaled(span, shares).tolist())
    return _once(lists, zip(*columns, strict=True))


def variants_of(
    vary: Mapping[str, object] | Iterable[Mapping[str, object]], sampler: str | None = None, seed: int = 0
) -> list[Parameters]:
    """The variants of a sweep, as `fmu_mesh.sweep` takes them.

    Example:
        >>> import numpy as np
        >>> variants_of({"pendulum.d": np.array([0.1, 0.2])})
        [{'pendulum.d': 0.1}, {'pendulum.d': 0.2}]
        >>> variants_of([{"a.b": 1, "a.c": 2}, {"a.c": 4, "a.b": np.float64(3)}])
        [{'a.b': 1, 'a.c': 2}, {'a.b': 3.0, 'a.c': 4}]

    Args:
        vary: by name, a `Range` or the values; all combinations are variants. Or the variants themselves, all of which
            have the same names: what a sampler of your own makes.
        sampler: as in `sampled`; None for all combinations.
        seed: as in `sampled`.

    Raises:
        ConfigurationError: as `grid` and `sampled`.
        CallRefused: something is no value, or the listed variants have different names or are equal.
    """
    if isinstance(vary, Mapping):
        values = {name: _values_of(name, given) for name, given in vary.items()}
        return grid(values) if sampler is None else sampled(values, sampler, seed)
    if sampler is not None:
        raise CallRefused("a sampler cannot choose from a list of variants", hint="Give it the ranges, by name.")
    return _listed_variants(_elements("a sweep", vary, "a mapping of names to values, or a list of mappings"))


# --- ranges and lists


def _read_range(text: str, written: str) -> Range:
    low, *rest = (part.strip() for part in written.split(":"))
    expected = "NAME=LOW:HIGH:COUNT or NAME=LOW:HIGH:COUNT:log; no COUNT for a sampler"
    ends = [read(end, Findings("--vary"), {}) for end in (low, rest[0])]
    scale = rest.pop() if len(rest) > 1 and rest[-1] in ("linear", "log") else "linear"
    first, last = (end if isinstance(end, int | float) and not isinstance(end, bool) else None for end in ends)
    count = rest[1] if len(rest) == 2 else None
    if (
        first is None
        or last is None
        or len(rest) > 2
        or (count is not None and re.fullmatch("[0-9]{1,9}", count) is None)
    ):
        raise _refused(text, f"the range {shown(written)}", expected)
    made = Range(first, last, None if count is None else int(count), "log" if scale == "log" else "linear")
    if (problem := _problem(made)) is not None:
        raise _refused(text, *problem)
    return made


def _refused(text: str, found: str, expected: str) -> ConfigurationError:
    return ConfigurationError(f"--vary {text}: {found}; expected {expected}.")


def _problem(span: Range) -> tuple[str, str] | None:
    """What is wrong with a range, and what was expected; None if nothing is."""
    ends = f"{span.low} to {span.high}"
    if not math.isfinite(span.high - span.low):
        return f"a range from {ends}", "finite numbers"
    if span.low == span.high:
        return f"a range from {ends}", f"two ends; {span.low} alone is a list of one value"
    if span.scale == "log" and min(span.low, span.high) <= 0.0:
        return f"a logarithmic range from {ends}", "both ends above 0"
    if span.count is not None and not 2 <= span.count <= MAX_VARIANTS:
        return f"{span.count} values from {ends}", f"2 to {MAX_VARIANTS} values, with both ends"
    return None


def _checked(vary: Mapping[str, Values]) -> Mapping[str, Values]:
    if not vary:
        raise ConfigurationError("nothing varies.", hint="Name a parameter, as in --vary pendulum.d=0.05:0.8:16.")
    for name, values in vary.items():
        if isinstance(values, Range) and (problem := _problem(values)) is not None:
            raise ConfigurationError(f"'{name}' has {problem[0]}; expected {problem[1]}.")
        if not isinstance(values, Range) and not values:
            raise ConfigurationError(f"'{name}' has no values.", hint=f"Give it some, as in {name}=0.1,0.2.")
    return vary


def _listed_values(values: Values) -> Sequence[PlainValue] | None:
    """The values of a list, or of a range with a count; None for a range without one."""
    if not isinstance(values, Range):
        return values
    if values.count is None:
        return None
    spaced = np.geomspace if values.scale == "log" else np.linspace
    table = spaced(values.low, values.high, values.count)
    if isinstance(values.low, int) and isinstance(values.high, int) and (table == np.rint(table)).all():
        return [int(value) for value in table]
    return [float(value) for value in table]


# --- samplers


def _shares(sampler: str, dimensions: int, seed: object) -> NDArray[np.float64]:
    """Numbers from 0 to 1, shape `(count, dimensions)`."""
    found = _SAMPLER.fullmatch(sampler)
    name, count = (found[1], int(found[2])) if found is not None else (sampler.partition(":")[0], 0)
    if name not in SAMPLERS:
        near = nearest(name, SAMPLERS)
        hint = meant(near and f"{near}:{count or 64}", f"There are {listed([*SAMPLERS])}, as in lhs:64.")
        raise ConfigurationError(f"there is no sampler '{sampler}'.", hint=hint)
    if not 0 < count <= MAX_VARIANTS:
        raise ConfigurationError(f"the sampler '{sampler}' has no count from 1 to {MAX_VARIANTS}, as in {name}:64.")
    if name == "sobol" and count.bit_count() != 1:
        below = 1 << (count.bit_length() - 1)
        hint = f"Choose {below} or {2 * below}, or halton:{count}."
        raise ConfigurationError(f"'{sampler}': a Sobol sequence is balanced only for a power of 2.", hint=hint)
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ConfigurationError(f"the seed {shown(seed)} is no whole number of at least 0.")
    generator = np.random.default_rng(seed)
    if name == "random":
        return generator.random((count, dimensions))
    with importing("scipy", f"samplers other than random:{count}"):
        from scipy.stats import qmc  # noqa: PLC0415  an extra, and slow to import
    shares: NDArray[np.float64] = getattr(qmc, SAMPLERS[name])(dimensions, seed=generator).random(count)
    return shares


def _scaled(span: Range, shares: NDArray[np.float64]) -> NDArray[np.float64]:
    """The values of a range that have these shares of it below them."""
    low, high = span.low, span.high
    values = low * (high / low) ** shares if span.scale == "log" else low + shares * (high - low)
    return np.clip(values, min(low, high), max(low, high))  # rounding must not lead outside


# --- what a program gives


def _values_of(name: str, given: object) -> Values:
    """A `Range`, or the values of a list or an array as Python has them."""
    if isinstance(given, Range):
        fields = plain(msgspec.structs.asdict(given))
        try:
            msgspec.convert(fields, Range)
        except msgspec.ValidationError as error:
            raise CallRefused(f"the range of '{name}' is wrong: {error}") from error
        return Range(**fields)
    return [_value_of(name, value) for value in _elements(f"'{name}'", given, "a list of values, or a Range")]


def _elements(what: str, given: object, expected: str) -> list[Any]:
    """The elements of a list, an array or an iterator; one more than possible of an endless one."""
    scalar = isinstance(given, str | bytes | Mapping) or (isinstance(given, np.ndarray) and given.ndim == 0)
    if scalar or not isinstance(given, Iterable):
        raise _no_values(what, given, expected)
    return list(islice(given, MAX_VARIANTS + 1))


def _value_of(name: str, given: object) -> PlainValue:
    value = plain(given)
    if isinstance(value, bool | int | float | str | list):
        return value
    raise _no_values(f"'{name}'", value, "a number, a text, a bool, or a list of these")


def _no_values(what: str, given: object, expected: str) -> CallRefused:
    return CallRefused(f"{what} got {shown(given)} ({type(given).__name__}); expected {expected}")


def _listed_variants(given: Sequence[object]) -> list[Parameters]:
    variants: list[Parameters] = []
    places: dict[str, int] = {}
    names: list[str] = []
    for number, variant in enumerate(given):
        if not isinstance(variant, Mapping) or not variant:
            raise _no_values(f"variant {number}", variant, "a mapping of names to values")
        names = names or [str(name) for name in variant]
        if variant.keys() != set(names):
            different = sorted(set(names).symmetric_difference(variant.keys()))
            raise CallRefused(f"variant {number} and variant 0 have different names: {listed(different)}")
        variants.append({name: _value_of(name, variant[name]) for name in names})
        first = places.setdefault(repr([*variants[-1].values()]), number)
        if first != number:
            raise CallRefused(f"variants {first} and {number} are equal", hint="Give each variant once.")
    if not 0 < len(variants) <= MAX_VARIANTS:
        raise CallRefused(f"a sweep has 1 to {MAX_VARIANTS} variants")
    return variants


def _once(names: Iterable[str], rows: Iterable[Sequence[PlainValue]]) -> list[Parameters]:
    """The rows as variants, without those that came before. The types count: 1 and 1.0 are different values."""
    names, different = [*names], {repr(row): row for row in rows}
    return [dict(zip(names, row, strict=True)) for row in different.values()]
