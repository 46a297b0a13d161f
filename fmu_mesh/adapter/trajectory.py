"""What an input is when: the caller's clock against the FMU's, on which its `Trajectory` is."""

from __future__ import annotations

import math

from ..model.trajectory import Trajectory

__all__ = ["Clock", "Trajectory"]


class Clock:
    """The caller's clock against the FMU's, which starts at 0.0.

    The only place that knows how the caller tells the time. A clock of integer nanoseconds has the same three methods.

    Args:
        start: the caller's time of the FMU's 0.0, in s.
    """

    def __init__(self, start: float) -> None:
        self._start = start

    def to_fmu(self, time: float) -> float:
        """A time of the caller on the FMU's clock, in s: one subtraction, exact while ``time`` is near the start."""
        return time - self._start

    def from_fmu(self, time: float) -> float:
        """A time of the FMU on the caller's clock, in s: one addition."""
        return self._start + time

    def resolution(self, time: float) -> float:
        """How far apart two of the caller's times near the FMU's ``time`` can be (s) and still mean the same.

        A float of today's Unix time is good to 0.24 us, and `start + 3 * 0.1` is not `start + 0.3`: a few units in the
        last place are left to the rounding of one multiplication and one addition, as in `simtime.steps_between`.
        """
        return 8 * math.ulp(max(abs(self._start), abs(self._start + time)))
