"""A communication step in smaller ones, after an FMU has discarded it.

Owns the choice of the smaller steps; how a step is taken, and how an FMU gets back to where a discarded one began, is
the business of its version of FMI.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from ....simtime import step_within

__all__ = ["DISCARD", "SMALLEST", "take_sub_steps"]

DISCARD: Final = 2
SMALLEST: Final = 1024
"""The smallest sub-step is this part of the communication step: beyond, an FMU is taken not to make it."""


def take_sub_steps(attempt: Callable[[float, float], int], time: float, step_size: float) -> int:
    """Take a step in halves, quarters and so on, as small as they have to be.

    Args:
        attempt: takes a step from a time of some size, and returns its status. After `DISCARD`, the FMU is where it was
            before.
        time: where the step begins, in s.
        step_size: its size in s.

    Returns:
        `DISCARD` if even the smallest sub-step was discarded; the status that ended it; or that of the last sub-step.
    """
    done, size, status = 0, SMALLEST // 2, DISCARD
    while done < SMALLEST:
        # Binary fractions of the step, whose sums are exact; the time is rounded, but not past the end of the step.
        start = time + step_size * (done / SMALLEST)
        status = attempt(start, step_within(start, step_size * (size / SMALLEST), time + step_size))
        if status == DISCARD and size > 1:
            size //= 2
        elif status >= DISCARD:
            return status
        else:
            done += size
    return status
