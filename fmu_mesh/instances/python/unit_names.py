"""Units by their usual names, as the variables of a component have them: `rad`, `N.m`, `m/s2`, `kg/(m.s2)`.

The notation is that of Modelica and of most FMUs: `.` multiplies, `/` divides, an exponent follows its unit. Owns which
names are known. Values are converted by `fmu_mesh.variables.units`.
"""

from __future__ import annotations

import math
import re
from functools import cache, partial, reduce
from typing import Final

from ...variables.units import BASE_UNITS, BaseUnit

__all__ = ["base_unit_of"]

_KNOWN: Final[dict[str, BaseUnit]] = {
    "1": BaseUnit(),
    **{name: BaseUnit(**{name: 1}) for name in BASE_UNITS},
    "g": BaseUnit(kg=1, factor=1e-3),
    "t": BaseUnit(kg=1, factor=1e3),
    "min": BaseUnit(s=1, factor=60.0),
    "h": BaseUnit(s=1, factor=3600.0),
    "d": BaseUnit(s=1, factor=86400.0),
    "deg": BaseUnit(rad=1, factor=math.pi / 180.0),
    "rev": BaseUnit(rad=1, factor=2.0 * math.pi),
    "rpm": BaseUnit(rad=1, s=-1, factor=math.pi / 30.0),
    "degC": BaseUnit(K=1, offset=273.15),
    "degF": BaseUnit(K=1, factor=5.0 / 9.0, offset=459.67 * 5.0 / 9.0),
    "Hz": BaseUnit(s=-1),
    "N": BaseUnit(kg=1, m=1, s=-2),
    "Pa": BaseUnit(kg=1, m=-1, s=-2),
    "bar": BaseUnit(kg=1, m=-1, s=-2, factor=1e5),
    "J": BaseUnit(kg=1, m=2, s=-2),
    "W": BaseUnit(kg=1, m=2, s=-3),
    "C": BaseUnit(A=1, s=1),
    "V": BaseUnit(kg=1, m=2, s=-3, A=-1),
    "Ohm": BaseUnit(kg=1, m=2, s=-3, A=-2),
    "S": BaseUnit(kg=-1, m=-2, s=3, A=2),
    "F": BaseUnit(kg=-1, m=-2, s=4, A=2),
    "H": BaseUnit(kg=1, m=2, s=-2, A=-2),
    "Wb": BaseUnit(kg=1, m=2, s=-2, A=-1),
    "T": BaseUnit(kg=1, s=-2, A=-1),
    "l": BaseUnit(m=3, factor=1e-3),
    "%": BaseUnit(factor=1e-2),
}
_WITH_PREFIX: Final = _KNOWN.keys() - {"1", "kg", "min", "h", "d", "deg", "rev", "rpm", "degC", "degF", "%"}
_PREFIXES: Final = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "d": 1e-1, "h": 1e2, "k": 1e3, "M": 1e6, "G": 1e9}
_POWER: Final = re.compile(r"([A-Za-z%]+|1)\^?([+-]?[0-9]+)?")


@cache
def base_unit_of(name: str) -> BaseUnit | None:
    """The unit with this name in SI base units; None if it is not known.

    A unit that is not known can be connected to one of the same name only.

    Example:
        >>> base_unit_of("mm/s").factor, str(base_unit_of("N.m"))
        (0.001, 'kg.m2.s-2')
    """
    over, _, under = name.replace(" ", "").partition("/")
    if under.startswith("(") and under.endswith(")"):
        under = under[1:-1]
    try:
        return _times(_product(over), _product(under), -1) if under else _product(over)
    except LookupError:
        return None


def _product(text: str) -> BaseUnit:
    return reduce(partial(_times, power=1), map(_factor, re.split(r"[.*]", text)))


def _factor(text: str) -> BaseUnit:
    """One unit with its exponent."""
    match = _POWER.fullmatch(text)
    if match is None:
        raise LookupError(text)
    name, exponent = match.groups()
    if name in _KNOWN:
        unit = _KNOWN[name]
    elif name[1:] in _WITH_PREFIX:
        unit = _times(BaseUnit(factor=_PREFIXES[name[0]]), _KNOWN[name[1:]], 1)
    else:
        raise LookupError(name)
    return unit if exponent is None else _times(BaseUnit(), unit, int(exponent))


def _times(left: BaseUnit, right: BaseUnit, power: int) -> BaseUnit:
    """``left * right ** power``; units with an offset cannot be multiplied."""
    if left.offset or right.offset:
        raise LookupError("degC or degF in a product")
    exponents = {field: getattr(left, field) + power * getattr(right, field) for field in BASE_UNITS}
    return BaseUnit(**exponents, factor=left.factor * right.factor**power)
