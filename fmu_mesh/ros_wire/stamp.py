"""Simulation time as ROS writes it: whole seconds and nanoseconds (`builtin_interfaces/msg/Time`)."""

from __future__ import annotations

import math

__all__ = ["in_nanoseconds", "nanoseconds", "to_stamp"]

_PER_SECOND = 1_000_000_000


def nanoseconds(time: float) -> int:
    """``time`` s in ns, rounded to the nearest; the fraction is scaled on its own to keep its last digits."""
    whole = math.floor(time)
    return whole * _PER_SECOND + round((time - whole) * _PER_SECOND)


def to_stamp(time: float) -> dict[str, int]:
    """``time`` s as a `builtin_interfaces/msg/Time`."""
    sec, nanosec = divmod(nanoseconds(time), _PER_SECOND)
    return {"sec": sec, "nanosec": nanosec}


def in_nanoseconds(sec: int, nanosec: int) -> int:
    """The time in ns of a `builtin_interfaces/msg/Time`."""
    return int(sec) * _PER_SECOND + int(nanosec)
