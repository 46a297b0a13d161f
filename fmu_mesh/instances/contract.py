"""The Protocol that a local FMU, a physics engine and a test double implement, and how such an instance is stepped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from ..rings.ring import Ring
from ..simtime import TimeGrid
from ..variables.model_description import ModelDescription, Value

__all__ = ["Instance", "KeepsState"]


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
        """Set the inputs of row ``step``, advance to own step ``step + 1``, write the outputs to row ``step + 1``.

        Raises:
            TerminationRequested: the FMU asks to end the simulation; the step is not taken, and no other may be.
        """
        ...

    def close(self) -> None:
        """Terminate if allowed, free the instance and remove its files. Never raises; may be called twice."""
        ...


class KeepsState(Protocol):
    """An instance that can go back to where it was, also in another process (FMI 2.0, 2.1.8; FMI 3.0, 2.2.10).

    Only where the model description says so: `can_get_and_set_state`, and `can_serialize_state` for the last two.
    To be called between two calls of `do_step`.

    Raises:
        FmuError: the FMU cannot, or failed to.
    """

    def get_state(self) -> object:
        """Everything that the instance is now; `free_state` it some time."""
        ...

    def set_state(self, state: object) -> None:
        """Be again what ``state`` was; the next `do_step` is the one that would have been the next then."""
        ...

    def free_state(self, state: object) -> None:
        """Give the memory of a state back to the FMU."""
        ...

    def serialize_state(self, state: object) -> bytes:
        """The state in a form that outlives the process."""
        ...

    def deserialize_state(self, data: bytes) -> object:
        """The state that an instance of the same FMU has serialized."""
        ...
