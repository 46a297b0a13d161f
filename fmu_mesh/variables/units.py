"""Conversion of values between units (FMI 2.0, 2.2.2; FMI 3.0, 2.4.3).

Owns the arithmetic between units and the order in which a connection applies it. Which ends have which units is
`fmu_mesh.system.connections`.
"""

from __future__ import annotations

import math

import msgspec

__all__ = ["BASE_UNITS", "BaseUnit", "Linear", "conversion"]

BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


class BaseUnit(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A unit in terms of SI base units: `value in base units = factor * value + offset`; the rest are exponents."""

    kg: int = 0
    m: int = 0
    s: int = 0
    A: int = 0
    K: int = 0
    mol: int = 0
    cd: int = 0
    rad: int = 0
    factor: float = 1.0
    offset: float = 0.0

    @property
    def dimension(self) -> tuple[int, ...]:
        """The exponents of the base units; equal for units that can be converted into each other."""
        return (self.kg, self.m, self.s, self.A, self.K, self.mol, self.cd, self.rad)

    @property
    def usable(self) -> bool:
        """Whether values can be converted with it."""
        return math.isfinite(self.factor) and self.factor != 0.0 and math.isfinite(self.offset)

    def __str__(self) -> str:
        """The dimension, such as `kg.m2.s-2`; `1` for none."""
        powers = zip(BASE_UNITS, self.dimension, strict=True)
        return ".".join(f"{unit}{power if power != 1 else ''}" for unit, power in powers if power) or "1"


class Linear(msgspec.Struct, frozen=True):
    """`factor * value + offset`: one multiplication and one addition, or no operation for the identity."""

    factor: float = 1.0
    offset: float = 0.0

    @property
    def identity(self) -> bool:
        """Whether it leaves values unchanged, bit for bit."""
        return (self.factor, self.offset) == (1.0, 0.0)

    def then(self, other: Linear) -> Linear:
        """This conversion followed by ``other``, as one: coefficients are rounded once here, not for every value.

        An identity leaves the other one exactly as it is.
        """
        if self.identity:
            return other
        if other.identity:
            return self
        return Linear(other.factor * self.factor, other.factor * self.offset + other.offset)


def conversion(source: BaseUnit, target: BaseUnit, *, relative: bool = False) -> Linear | None:
    """The conversion of values from ``source`` to ``target``; None if the dimensions differ.

    With ``relative``, the value is a difference, so that 10 degC are 10 K (FMI 3.0, 2.4.4, relativeQuantity).
    """
    if source.dimension != target.dimension:
        return None
    shift = 0.0 if relative else (source.offset - target.offset) / target.factor
    return Linear(source.factor / target.factor, shift)
