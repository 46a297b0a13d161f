"""`SystemState` and `BatchState`: where a `System` or a `Batch` can go back to.

Owns when a state is closed. What it holds, its system knows, which frees it on its own thread.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Self

import numpy as np
from numpy.typing import NDArray

__all__ = ["BatchState", "SystemState"]


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
        return f"<{type(self).__name__}: point {self.point}{', closed' if self.closed else ''}>"

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return not self._release.alive

    def close(self) -> None:
        """Give the memory of the state back; the FMUs free it at the next `save`, `restore` or `System.close`."""
        self._release()


class BatchState(SystemState):
    """The state of all copies of a `Batch`, for `Batch.restore`; it belongs to this batch.

    Example:
        >>> with fmu_mesh.load("configs/pendulum_delay.yaml").batch(2) as batch:
        ...     batch.step(10)
        ...     with batch.save() as state:
        ...         batch.step(10)
        ...         batch.restore(state)
        ...         batch.point.tolist(), state.point.tolist()
        ([10, 10], [10, 10])

    Attributes:
        point: the communication point of each copy, shape (copies,).
    """

    point: NDArray[np.int64]  # type: ignore[assignment]  # one for each copy

    def __init__(self, point: NDArray[np.int64], release: Callable[[], None]) -> None:
        super().__init__(0, release)
        self.point = point
