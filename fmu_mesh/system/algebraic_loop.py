"""The iteration of an algebraic loop at the start: its arithmetic and its criterion for convergence.

Every process that takes part in a loop gets the same values and runs the same iteration. So all of them, and a run in
one process, end after the same sweep without a message about it. The arithmetic must give the same floats on each host:
there is no BLAS here, and every sum is one of `math.fsum` (ADR 95).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import chain, islice, pairwise
from operator import mul, sub
from typing import Final, TypeGuard

from ..config.mesh import InitializationConfig
from ..errors import LoopNotConverged
from ..text import walk
from ..variables.model_description import Value, Variable
from ..variables.value_conversion import to_value
from ..variables.value_types import flattened, nested
from .initialization_plan import Loop, Tear

__all__ = ["FixedPoint", "accelerated"]

_SHOWN = 8
_FAST: Final = 0.1  # while each sweep leaves at most this part of the residual, acceleration would spare few sweeps
_MOST_SWEEPS: Final = 30  # more of them would take long to combine, and hardly lead nearer
_PATIENCE: Final = 20  # so many accelerated sweeps, and one for each value, may leave the residual as large as it was
_LEAST_CHANGE: Final = 1e-8  # residuals that change less than this, in relation to the values, change by rounding
_LARGEST: Final = 1e100  # the squares of larger values could be infinite

Floats = list[float]


def accelerated(sweeps: Sequence[tuple[Floats, Floats]]) -> Floats:
    """The next assumed values of a loop, by the method of Anderson; for one value, it is the secant method.

    From one sweep to the next, the residuals (new - assumed) and the new values have changed. The multiples of these
    changes are searched that, taken from the last sweep, leave the smallest residual: least squares, by Gram-Schmidt,
    beginning with the newest change. If n residuals depend linearly on n values, n independent changes leave nothing.

    Args:
        sweeps: the assumed and the new values of the last sweeps, the newest at the end.

    Example:
        >>> accelerated([([0.0], [4.0]), ([4.0], [-8.0])])  # u = 4 - 3 u
        [1.0]
    """
    assumed, following = sweeps[-1]
    weights = [1.0 / max(1.0, abs(value)) for value in following]  # as in the criterion
    residual = list(map(mul, weights, map(sub, following, assumed)))
    basis: list[tuple[Floats, Floats]] = []
    for (assumed, new), (older_assumed, older_new) in pairwise(reversed(sweeps)):
        change = list(map(sub, new, older_new))
        turn = list(map(mul, weights, map(sub, change, map(sub, assumed, older_assumed))))
        whole = _norm(turn)
        for unit, own in basis:
            part = math.fsum(map(mul, unit, turn))
            turn, change = _less(turn, part, unit), _less(change, part, own)
        size = _norm(turn)
        if size > _LEAST_CHANGE * max(whole, _norm(map(mul, weights, change))):
            unit, own = [value / size for value in turn], [value / size for value in change]
            basis.append((unit, own))
            part = math.fsum(map(mul, unit, residual))
            residual, following = _less(residual, part, unit), _less(following, part, own)
    return following


class FixedPoint:
    """The assumed values of the torn inputs of one loop.

    One sweep of the caller: set the torn inputs to `assumed`, get all outputs of the loop level by level, and call
    `update` with the new values of the torn connections. For each of these values ``new``::

        residual = |new - assumed|, which must be at most tolerance * max(1, |new|)

    For an array, this holds for each element. Values of types other than Float64 and Float32 must be equal; the new
    ones follow on them, and what `_Search` finds on floats. After convergence the torn inputs keep the assumed values:
    then all other connections are exact, and the torn ones are off by their residual.

    Args:
        loop: the loop.
        settings: tolerance, relaxation and the maximum number of iterations.

    Attributes:
        assumed: by (instance, input).
        sweeps: how many there were.
        residual: the largest one of the last sweep over max(1, |new|), among floats.
    """

    def __init__(self, loop: Loop, settings: InitializationConfig) -> None:
        self.assumed: dict[tuple[str, str], Value] = {(tear.target, tear.input): _start(tear) for tear in loop.tears}
        self.sweeps = 0
        self.residual = math.inf
        self._loop = loop
        self._settings = settings
        self._search = _Search(settings.relaxation, len(loop.tears))

    def update(self, brought: Sequence[Value]) -> bool:
        """Finish one sweep.

        Args:
            brought: the new values of the torn connections, in the order of the tears.

        Returns:
            Whether the loop has converged.

        Raises:
            LoopNotConverged: the limit is reached, or a value is not finite and nothing leads back.
        """
        self.sweeps += 1
        pairs = [*chain.from_iterable(map(_elements, self._loop.tears, self.assumed.values(), brought))]
        floats = [pair for pair in pairs if _are_floats(pair)]
        self.residual = max((abs(new - old) / max(1.0, abs(new)) for old, new in floats), default=0.0)
        if all(self._agree(*pair) for pair in pairs):
            return True
        if any(old != new for old, new in pairs if not _are_floats((old, new))):
            self._search = _Search(self._settings.relaxation)  # the equations of the floats are others now
        following = self._search.following([old for old, _ in floats], [new for _, new in floats], self.residual)
        if following is None:
            raise self._not_converged("a value is not finite any more", brought)
        if self.sweeps >= self._settings.iterations:
            raise self._not_converged(f"not within a tolerance of {self._settings.tolerance:g}", brought)
        values = iter(following)
        elements = iter([next(values) if _are_floats(pair) else pair[1] for pair in pairs])
        for key, tear in zip(self.assumed, self._loop.tears, strict=True):
            self.assumed[key] = nested([*islice(elements, math.prod(tear.shape))], tear.shape)
        return False

    def _agree(self, old: Value, new: Value) -> bool:
        if isinstance(old, float) and isinstance(new, float):
            return math.isfinite(new) and abs(new - old) <= self._settings.tolerance * max(1.0, abs(new))
        return old == new

    def _not_converged(self, why: str, brought: Sequence[Value]) -> LoopNotConverged:
        names = walk([*map(".".join, self._loop.outputs)])
        apart = [
            f"{tear} {_apart(old, new)}"
            for tear, old, new in zip(self._loop.tears, self.assumed.values(), brought, strict=True)
            if not all(self._agree(*pair) for pair in _elements(tear, old, new))
        ]
        more = f" and {len(apart) - _SHOWN} more" if len(apart) > _SHOWN else ""
        least = f"; as the tolerance counts them, {self._search.least:.2g} at best" if self._search.least < 1.0 else ""
        return LoopNotConverged(
            f"the algebraic loop {names} did not converge at the start: after {self.sweeps} iterations {why}; "
            f"residuals: {', '.join(apart[:_SHOWN])}{more}{least}",
            hint="It may have no solution. Else give its inputs better start values (`fmu-mesh check` names them), or "
            "raise `initialization.tolerance` or `initialization.iterations`, or lower `initialization.relaxation` "
            f"(now {self._settings.relaxation:g}).",
        )


class _Search:
    """Finds the assumed values of a loop as long as its equations stay the same.

    Outputs that are no loop, because their models only do not say so, settle by substitution (assumed = new) to the
    last bit: after one sweep for each torn input, and one more. From then on, where a sweep takes away less than nine
    tenths of the residual, the next values are those of `accelerated`. If they do not help for long, substitution goes
    on where it was: Float32 values, whose small differences say nothing, may still settle by it. After values that lead
    to NaN or infinity, the next ones are half way back. All of this only if the relaxation is 1.
    """

    def __init__(self, relaxation: float, tears: int = 0) -> None:
        self._relaxation, self._tears, self._count = relaxation, tears, 0
        self._sweeps: list[tuple[Floats, Floats]] = []
        self._accelerates: bool | None = False  # None: not any more
        self._residual, self.least, self._least_at = math.inf, math.inf, 0
        self._substituted: Floats = []

    def following(self, assumed: Floats, new: Floats, residual: float) -> Floats | None:
        """The next assumed values, after a sweep with this largest residual; None: there are none to go back to."""
        self._count += 1
        if not all(map(math.isfinite, new)):
            back = self._sweeps[-1][0] if self._sweeps and self._accelerates is not None else None
            return back and [old / 2.0 + before / 2.0 for old, before in zip(assumed, back, strict=True)]
        if self._relaxation != 1.0:
            return _less(assumed, -self._relaxation, list(map(sub, new, assumed)))
        most = min(len(new), _MOST_SWEEPS)
        if max(map(abs, (*assumed, *new)), default=0.0) < _LARGEST:
            self._sweeps = [*self._sweeps[-most:], (assumed, new)]
        if residual < self.least:
            self.least, self._least_at = residual, self._count
        is_slow, self._residual = residual > _FAST * self._residual, residual
        if self._accelerates is False and is_slow and len(self._sweeps) > 1:
            self._accelerates, self._substituted = self._count > max(self._tears, most), new
        if self._accelerates and self._count > self._least_at + _PATIENCE + most:
            self._accelerates = None
            return self._substituted
        chosen = accelerated(self._sweeps) if self._accelerates else new
        return chosen if all(map(math.isfinite, chosen)) else new


def _start(tear: Tear) -> Value:
    return to_value(tear.start, Variable(tear.input, 0, tear.type, "input", "discrete", shape=tear.shape))


def _apart(old: Value, new: Value) -> str:
    if isinstance(old, float) and isinstance(new, float):
        return f"{abs(new - old):.6g} (from {old:.12g} to {new:.12g})"
    if isinstance(old, list) and isinstance(new, list) and all(isinstance(one, float) for one in [*old, *new]):
        return f"{max(abs(two - one) for one, two in zip(old, new, strict=True)):.6g} (the largest of its elements)"
    return f"(from {old!r} to {new!r})"


def _are_floats(pair: tuple[Value, Value]) -> TypeGuard[tuple[float, float]]:
    return isinstance(pair[0], float) and isinstance(pair[1], float)


def _elements(tear: Tear, old: Value, new: Value) -> Iterable[tuple[Value, Value]]:
    rank = len(tear.shape)
    return zip(flattened(old, rank), flattened(new, rank), strict=True)


def _less(values: Floats, part: float, other: Floats) -> Floats:
    return [value - part * own for value, own in zip(values, other, strict=True)]


def _norm(values: Iterable[float]) -> float:
    return math.sqrt(math.fsum(value * value for value in values))
