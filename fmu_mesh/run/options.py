"""What the command line changes of a configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import msgspec

from ..instances.registry import Showing

__all__ = ["Options"]


class Options(msgspec.Struct, frozen=True):
    """What the command line changes of a configuration.

    Attributes:
        start_values: `instance.variable=value` each.
        window: in points, or `auto`, instead of the configured one.
        real_time_factor: simulated over wall-clock time instead of the configured one; 0 for as fast as possible.
        output: the result file instead of the configured one.
        connect: Zenoh endpoints instead of the configured ones.
        listen: likewise, where the master can be reached besides its socket.
        profile: whether the nodes measure where their time goes.
        showing: whether and how a physics engine shows its world.
        paused: whether the run starts at rest at its first point.
    """

    start_values: tuple[str, ...] = ()
    window: int | Literal["auto"] | None = None
    real_time_factor: float | None = None
    output: Path | None = None
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    profile: bool = False
    showing: Showing = Showing()
    paused: bool = False
