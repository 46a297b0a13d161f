"""`SystemState`: where a `System` can go back to.

Owns when a state is closed. What it holds, its system knows, which frees it on its own thread.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Self

__all__ = ["SystemState"]


class SystemState:
    """The state of a `System` at a point, for `System.restore`; it belongs to this system.

    Example:
        >>> with fmu_mesh.load("configs/pendulum_delay.yaml").open() as system:
        ...     system.step(10)
        ...     with system.save() as state:
        ...         system.step(10)
        ...         system.restore(state)
        ...     system.point, state.point, state.closed
        (10, 10, True)

    Attributes:
        point: the communication point.
    """

    def __init__(self, point: int, release: Callable[[], None]) -> None:
        self.point = point
        self._release = weakref.finalize(self, release)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<SystemState: point {self.point}{', closed' if self.closed else ''}>"

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return not self._release.alive

    def close(self) -> None:
        """Give the memory of the state back; the FMUs free it at the next `save`, `restore` or `System.close`."""
        self._release()
