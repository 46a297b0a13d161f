"""The state of an FMU instance, for going back to it or for going on in another process (FMI 2.0, 2.1.8; 3.0, 2.2.10).

A state is that of the FMU and our own `Bookkeeping`. FMI 1.0 has no states.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple, TypeVar

import msgspec
from fmpy.fmi1 import FMICallException

from ...errors import FmuError, StepFailed
from ...variables.model_description import ModelDescription
from ..instance_wrapper import of_kind, packed, unpacked
from .fmu_values import status_name

__all__ = ["Bookkeeping", "FmuState", "KeepsFmuState"]

T = TypeVar("T")


class Bookkeeping(msgspec.Struct, frozen=True):
    """What we know about an instance besides its FMU state.

    Attributes:
        step: own steps done; -1 in or before Initialization Mode.
        time: the time of the FMU in s, where it does not follow from the step.
        next_event: time of its next time event in s; None if there is none.
        row: its held inputs.
        ticks: the clocks; see `Clocks.place`.
        last_event: time of its last event mode in s, where the steps depend on it; None if there was none.
    """

    step: int
    time: float | None = None
    next_event: float | None = None
    row: tuple[bytes | list[Any], ...] = ()
    ticks: tuple[float | None, ...] = ()
    last_event: float | None = None


class FmuState(NamedTuple):
    """One state of one instance; it belongs to this instance until `KeepsFmuState.free_state`."""

    handle: Any
    kept: Bookkeeping


class KeepsFmuState:
    """The `KeepsState` Protocol for instances of FMUs."""

    name: str
    _fmu: Any

    @property
    @abstractmethod
    def description(self) -> ModelDescription:
        """The model description."""

    def get_state(self) -> FmuState:
        """See `KeepsState`."""
        self._check_state(self.description.can_get_and_set_state, "get and set its state")
        return FmuState(self._on_state(self._fmu.getFMUState), self._bookkeeping())

    def set_state(self, state: object) -> None:
        """See `KeepsState`."""
        own = of_kind(FmuState, state)
        self._on_state(lambda: self._fmu.setFMUState(own.handle))
        self._restore(own.kept)

    def free_state(self, state: object) -> None:
        """See `KeepsState`."""
        own = of_kind(FmuState, state)
        with suppress(StepFailed):  # it takes memory, and nothing else
            self._on_state(lambda: self._fmu.freeFMUState(own.handle))

    def serialize_state(self, state: object) -> bytes:
        """See `KeepsState`."""
        self._check_state(self.description.can_serialize_state, "serialize its state")
        own = of_kind(FmuState, state)
        return packed(own.kept, self._on_state(lambda: self._fmu.serializeFMUState(own.handle)))

    def deserialize_state(self, data: bytes) -> FmuState:
        """See `KeepsState`.

        Raises:
            FmuMeshError: ``data`` is no state of an instance.
        """
        self._check_state(self.description.can_serialize_state, "serialize its state")
        kept, rest = unpacked(data, Bookkeeping, self.name)
        return FmuState(self._on_state(lambda: self._fmu.deserializeFMUState(rest)), kept)

    @abstractmethod
    def _check_live(self) -> None:
        """Raise an error if no function of the FMU may be called any more."""

    @abstractmethod
    def _note(self, status: int) -> None:
        """Take note of a status above warning."""

    @abstractmethod
    def _bookkeeping(self) -> Bookkeeping:
        """Our own part of the state now."""

    @abstractmethod
    def _restore(self, kept: Bookkeeping) -> None:
        """Go back to this part after the FMU has gone back to its state."""

    def _check_state(self, can: bool, what: str) -> None:  # noqa: FBT001 a capability flag
        if not can:
            raise FmuError(f"the FMU cannot {what}, as its model description says", instance=self.name)

    def _on_state(self, call: Callable[[], T]) -> T:
        self._check_live()
        try:
            return call()
        except FMICallException as error:
            self._note(error.status)
            raise StepFailed(f"{error.function} returned {status_name(error.status)}", instance=self.name) from error
