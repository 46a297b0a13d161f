"""How an algebraic loop was solved at the start, for `info` and the metadata of results."""

from __future__ import annotations

import msgspec

from ..text import counted, walk

__all__ = ["SolvedLoop"]


class SolvedLoop(msgspec.Struct, frozen=True):
    """How an algebraic loop was solved at the start.

    Attributes:
        outputs: its outputs, as `instance.output`, in the order in which they are computed.
        residual: the largest difference that is left between a floating-point value and its source, as a fraction of
            the value if that is above 1.
    """

    outputs: tuple[str, ...]
    iterations: int
    residual: float

    def __str__(self) -> str:
        after = counted(self.iterations, "iteration")
        return f"{walk(self.outputs)} solved after {after}, residual {self.residual:.2g}"
