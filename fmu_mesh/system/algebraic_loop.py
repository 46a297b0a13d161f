"""The fixed-point iteration of an algebraic loop at the start: its arithmetic and its criterion for convergence.

Every process that takes part in a loop gets the same values and runs the same iteration. So all of them, and a run in
one process, end after the same sweep without a message about it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from ..config.mesh import InitializationConfig
from ..errors import LoopNotConverged
from ..variables.model_description import Value, Variable
from ..variables.value_conversion import is_finite, to_value
from .initialization_plan import Loop, Tear

__all__ = ["FixedPoint"]

_SHOWN = 8


class FixedPoint:
    """The assumed values of the torn inputs of one loop.

    One sweep of the caller: set the torn inputs to `assumed`, get all outputs of the loop level by level, and call
    `update` with the new values of the torn connections. For each of these values ``new``::

        residual = |new - assumed|, which must be at most tolerance * max(1, |new|)
        assumed  = assumed + relaxation * (new - assumed)          (new itself where the relaxation is 1)

    For an array, this holds for each element. Values of types other than Float64 and Float32 must be equal, and are
    replaced without relaxation. After convergence the torn inputs keep the assumed values: then all other connections
    are exact, and the torn ones are off by their residual.

    Args:
        loop: the loop.
        settings: tolerance, relaxation and the maximum number of iterations.

    Attributes:
        assumed: by (instance, input).
    """

    def __init__(self, loop: Loop, settings: InitializationConfig) -> None:
        self.assumed: dict[tuple[str, str], Value] = {(tear.target, tear.input): _start(tear) for tear in loop.tears}
        self.sweeps = 0
        self._loop = loop
        self._settings = settings

    def update(self, brought: Sequence[Value]) -> bool:
        """Finish one sweep.

        Args:
            brought: the new values of the torn connections, in the order of the tears.

        Returns:
            Whether the loop has converged.

        Raises:
            LoopNotConverged: the limit is reached, or a value is not finite.
        """
        self.sweeps += 1
        pairs = list(zip(self.assumed.values(), brought, strict=True))
        if not all(map(is_finite, brought)):
            raise self._not_converged("a value is not finite any more", pairs)
        if all(self._agree(old, new) for old, new in pairs):
            return True
        if self.sweeps >= self._settings.iterations:
            raise self._not_converged(f"not within a tolerance of {self._settings.tolerance:g}", pairs)
        for key, (old, new) in zip(self.assumed, pairs, strict=True):
            self.assumed[key] = self._relaxed(old, new)
        return False

    def _agree(self, old: Value, new: Value) -> bool:
        if isinstance(old, list) and isinstance(new, list):
            return all(self._agree(one, other) for one, other in zip(old, new, strict=True))
        if isinstance(old, float) and isinstance(new, float):
            return math.isfinite(new) and abs(new - old) <= self._settings.tolerance * max(1.0, abs(new))
        return old == new

    def _relaxed(self, old: Value, new: Value) -> Value:
        if isinstance(old, list) and isinstance(new, list):
            return [self._relaxed(one, other) for one, other in zip(old, new, strict=True)]
        relaxation = self._settings.relaxation
        if relaxation != 1.0 and isinstance(old, float) and isinstance(new, float):
            return old + relaxation * (new - old)
        return new

    def _not_converged(self, why: str, pairs: Sequence[tuple[Value, Value]]) -> LoopNotConverged:
        names = " -> ".join(f"{instance}.{output}" for instance, output in self._loop.outputs[:_SHOWN])
        rest = len(self._loop.outputs) - _SHOWN
        apart = [
            f"{tear} {_residual(old, new)}"
            for tear, (old, new) in zip(self._loop.tears, pairs, strict=True)
            if not self._agree(old, new)
        ]
        more = f" and {len(apart) - _SHOWN} more" if len(apart) > _SHOWN else ""
        return LoopNotConverged(
            f"the algebraic loop {names}{f' and {rest} more' if rest > 0 else ''} did not converge at the start: after "
            f"{self.sweeps} iterations {why}; residuals: {', '.join(apart[:_SHOWN])}{more}",
            hint="Lower `initialization.relaxation` "
            f"(now {self._settings.relaxation:g}), raise `initialization.iterations`, or give its inputs better start "
            "values; `fmu-mesh check` shows the loop.",
        )


def _start(tear: Tear) -> Value:
    return to_value(tear.start, Variable(tear.input, 0, tear.type, "input", "discrete", shape=tear.shape))


def _residual(old: Value, new: Value) -> str:
    if isinstance(old, float) and isinstance(new, float):
        return f"{abs(new - old):.6g} (from {old:.12g} to {new:.12g})"
    if isinstance(old, list) and isinstance(new, list) and all(isinstance(one, float) for one in [*old, *new]):
        return f"{max(abs(two - one) for one, two in zip(old, new, strict=True)):.6g} (the largest of its elements)"
    return f"(from {old!r} to {new!r})"
