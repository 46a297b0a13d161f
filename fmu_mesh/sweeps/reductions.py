"""Reductions: a recorded variable of one run as one value, such as `max(pendulum.a)`.

Owns how a reduction is written and what each of them means. Does not know where its value goes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..api.result import Result
from ..config.findings import Findings
from ..errors import CallRefused, ConfigurationError
from ..text import listed, meant, nearest
from ..variables.value_conversion import to_plain
from ..variables.value_types import PlainValue, VariableType, is_text

__all__ = ["FUNCTIONS", "Reduction", "check_reductions", "read_reduction", "reduced_value"]

_WRITTEN = re.compile(r"(?s)(\w+)\s*\((.*)\)")
_AT = re.compile(r"(?s)(.*),\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)")
_ULPS = 4
"""The time of a row is the start plus a product: it may be this many units in the last place above a decimal number."""


class Reduction(msgspec.Struct, frozen=True):
    """One value of one recorded variable."""

    text: str  # as it was written; also the name of the column
    function: str  # one of `FUNCTIONS`
    variable: str
    time: float | None = None  # the simulation time of `at` in s


def read_reduction(text: str) -> Reduction:
    """The reduction that a text means.

    `first`, `last`: the value of this row. `min`, `max`, `span`: the extreme values and their distance. `mean`, `std`,
    `rms`: mean, standard deviation (divided by the number of rows) and root mean square of the rows. `integral`: over
    time in s, by the trapezoidal rule. `time_of_min`, `time_of_max`: the time in s of the first extreme value. `at`:
    the value of the last row that is not after this time.

    Example:
        >>> read_reduction("max(pendulum.a)").function
        'max'
        >>> read_reduction("at(arm.der(q[1,2],2), 2.5)")
        Reduction(text='at(arm.der(q[1,2],2), 2.5)', function='at', variable='arm.der(q[1,2],2)', time=2.5)

    Args:
        text: `FUNCTION(INSTANCE.VARIABLE)`, or `at(INSTANCE.VARIABLE, TIME)`.

    Raises:
        ConfigurationError: it is no such text; names the nearest function.
    """
    text = text.strip()
    found = _WRITTEN.fullmatch(text)
    if found is None or found[1] not in FUNCTIONS:
        name = found[1] if found is not None else text.partition("(")[0].strip()
        near = nearest(name, FUNCTIONS) or ("last" if found is None else None)
        inner = found[2] if found is not None else text if "(" not in text else "pendulum.a"
        hint = meant(near and f"{near}({inner})", f"There are: {', '.join(FUNCTIONS)}.")
        raise ConfigurationError(f"'{text}' is no reduction.", hint=hint)
    function, variable, time = found[1], found[2].strip(), None
    if function == "at":
        parts = _AT.fullmatch(variable)
        if parts is None:
            raise ConfigurationError(f"'{text}' has no time.", hint=f"Give it one in s, as in at({variable}, 2.5).")
        variable, time = parts[1].strip(), float(parts[2])
    if not variable:
        raise ConfigurationError(f"'{text}' names no variable.", hint=f"Name one, as in {function}(pendulum.a).")
    return Reduction(text, function, variable, time)


def check_reductions(reductions: Sequence[Reduction], recorded: Mapping[str, VariableType]) -> None:
    """Check before the first run that all reductions have a recorded variable, and numbers where they need them.

    Example:
        >>> check_reductions([read_reduction("max(pendulum.a)")], {"pendulum.a": "Float64"})

    Raises:
        ConfigurationError: with all findings, and the nearest names.
    """
    findings = Findings("reductions")
    for number, reduction in enumerate(reductions):
        name = reduction.variable
        if name not in recorded:
            expected = f"one of {listed([*recorded])}"
            findings.add(reduction.text, f"'{name}', which is not recorded", expected, nearest(name, recorded))
        elif is_text(recorded[name]) and reduction.function not in _OF_TEXTS:
            findings.add(reduction.text, f"'{name}', which is a text", "first, last or at")
        if reduction.text in {earlier.text for earlier in reductions[:number]}:
            findings.add(reduction.text, "the same reduction a second time", "each once")
    findings.raise_any()


def reduced_value(reduction: Reduction, result: Result) -> PlainValue | None:
    """The value of a reduction for one run.

    Example:
        >>> import fmu_mesh
        >>> result = fmu_mesh.load("configs/pendulum_delay.yaml").run(stop_time=1.0, record="memory", processes=False)
        >>> reduced_value(read_reduction("first(pendulum.a)"), result)
        1.3

    Returns:
        A float, int, bool or str; base64 for bytes. NaN if the variable was NaN in a row that counts. None if there is
        no row, or none before the time of `at`.

    Raises:
        UnknownName: the variable was not recorded.
        CallRefused: the variable is a text, and the function needs numbers.
    """
    values, times = result[reduction.variable], result.times
    if values.dtype == object and reduction.function not in _OF_TEXTS:
        raise CallRefused(f"{reduction.text}: '{reduction.variable}' is a text.", hint="Texts have first, last and at.")
    if not len(values):
        return None
    if reduction.time is not None:
        slack = _ULPS * float(np.spacing(max(abs(reduction.time), abs(times[0]))))
        row = int(np.searchsorted(times, reduction.time + slack, side="right")) - 1
        return _plain(values[row]) if row >= 0 else None
    with np.errstate(all="ignore"):  # infinite values, and values whose square is too large, need no warning
        # One order of the summands, wherever the values lie.
        return _plain(_FUNCTIONS[reduction.function](np.ascontiguousarray(values), times))


def _plain(value: Any) -> PlainValue:  # noqa: ANN401  an element of any array
    value = value.item() if isinstance(value, np.generic) else value
    plain: PlainValue = to_plain(value) if isinstance(value, bytes) else value
    return plain


_Values = NDArray[Any]
_Times = NDArray[np.float64]


def _floats(values: _Values) -> NDArray[np.float64]:
    return values.astype(np.float64)


def _integral(values: _Values, times: _Times) -> float:
    numbers = _floats(values)
    return float(np.sum(np.diff(times) * (numbers[1:] + numbers[:-1]) / 2.0))


def _time_at(values: _Values, times: _Times, place: int) -> float:
    return math.nan if np.isnan(_floats(values)).any() else float(times[place])


_FUNCTIONS: Final[dict[str, Callable[[_Values, _Times], Any]]] = {
    "first": lambda values, _: values[0],
    "last": lambda values, _: values[-1],
    "min": lambda values, _: values.min(),
    "max": lambda values, _: values.max(),
    "mean": lambda values, _: np.mean(_floats(values)),
    "std": lambda values, _: np.std(_floats(values)),
    "rms": lambda values, _: math.sqrt(np.mean(np.square(_floats(values)))),
    "span": lambda values, _: values.max().item() - values.min().item(),  # of Python: whole numbers do not overflow
    "integral": _integral,
    "time_of_min": lambda values, times: _time_at(values, times, int(values.argmin())),
    "time_of_max": lambda values, times: _time_at(values, times, int(values.argmax())),
}
FUNCTIONS: Final = (*_FUNCTIONS, "at")
_OF_TEXTS: Final = ("first", "last", "at")
