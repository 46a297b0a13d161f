"""The Protocol that a local FMU, a physics engine and a test double implement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from ..simtime import TimeGrid
from .description import ModelDescription, Value
from .ring import Ring

__all__ = ["Instance"]


class Instance(Protocol):
    """One instance, called from one thread only.

    Call sequence: `enter_initialization`, then `set_values` and `get_values` as often as needed, then
    `exit_initialization`; then `bind`, and `do_step` at consecutive points of its own, with `set_values` and
    `get_values` between steps; at the end, and after any exception, `close`.

    Raises:
        FmuError: by every method but `close`; after it only `close` is allowed.
    """

    @property
    def description(self) -> ModelDescription:
        """The model description."""
        ...

    def enter_initialization(
        self, start_time: float, stop_time: float | None, start_values: Mapping[str, Value]
    ) -> None:
        """Set ``start_values`` and enter Initialization Mode (times in s, None: open end; FMI 2.0, 4.2.1)."""
        ...

    def exit_initialization(self) -> None:
        """Leave Initialization Mode; outputs are valid from now on."""
        ...

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set variables by name, between two calls of `do_step` or in Initialization Mode."""
        ...

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """Current values of variables by name, between two calls of `do_step` or in Initialization Mode."""
        ...

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Let `do_step` read inputs from and write outputs to these rings; write the current outputs as row ``step``.

        An own step takes ``points`` points of ``grid``; own step ``n`` starts at the time of point ``n * points``. All
        output rings have the same number of rows. May be called again between steps, with other rings.
        """
        ...

    def do_step(self, step: int) -> None:
        """Set the inputs of row ``step``, advance to own step ``step + 1``, write the outputs to row ``step + 1``."""
        ...

    def close(self) -> None:
        """Terminate if allowed, free the instance and remove its files. Never raises; may be called twice."""
        ...
