"""The state of an instance, to go back to it or to go on from it in another process (FMI 2.0, 2.1.8; FMI 3.0, 2.2.10).

Owns what belongs to a state besides that of the FMU: where the instance stands. FMI 1.0 has none of this.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, TypeVar

import msgspec
from fmpy.fmi1 import FMICallException

from ...errors import FmuError, FmuMeshError, StepFailed
from ...variables.model_description import ModelDescription

__all__ = ["FmuState", "KeepsFmuState", "Standing"]

T = TypeVar("T")


class Standing(msgspec.Struct, frozen=True):
    """Where an instance stands.

    Attributes:
        step: own steps done; -1 in or before Initialization Mode.
        time: the time of the FMU in s, where it is not that of the step.
        next_event: that of its next time event; None if there is none.
        row: the inputs that it was given in its last event mode.
        ticks: where its clocks are; see `Clocks.place`.
        last_event: the time of its last event mode in s, where the steps go by it; None if there was none.
    """

    step: int
    time: float | None = None
    next_event: float | None = None
    row: tuple[bytes | list[str], ...] = ()
    ticks: tuple[float | None, ...] = ()
    last_event: float | None = None


class FmuState:
    """One state of one instance; belongs to it until `KeepsFmuState.free_state`."""

    def __init__(self, handle: Any, standing: Standing) -> None:  # noqa: ANN401 a pointer of ctypes
        self.handle = handle
        self.standing = standing


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
        return FmuState(self._on_state(self._fmu.getFMUState), self._standing())

    def set_state(self, state: object) -> None:
        """See `KeepsState`."""
        own = _own(state)
        self._on_state(lambda: self._fmu.setFMUState(own.handle))
        self._stand(own.standing)

    def free_state(self, state: object) -> None:
        """See `KeepsState`."""
        own = _own(state)
        self._on_state(lambda: self._fmu.freeFMUState(own.handle))

    def serialize_state(self, state: object) -> bytes:
        """See `KeepsState`: where the instance stands as JSON, a zero, and what the FMU gives."""
        self._check_state(self.description.can_serialize_state, "serialize its state")
        own = _own(state)
        data: bytes = self._on_state(lambda: self._fmu.serializeFMUState(own.handle))
        return msgspec.json.encode(own.standing) + b"\0" + data

    def deserialize_state(self, data: bytes) -> FmuState:
        """See `KeepsState`.

        Raises:
            FmuMeshError: ``data`` is no state of an instance.
        """
        self._check_state(self.description.can_serialize_state, "serialize its state")
        head, _, rest = data.partition(b"\0")
        try:
            standing = msgspec.json.decode(head, type=Standing)
        except msgspec.DecodeError as error:
            raise FmuMeshError(f"this is no state of an instance: {error}", instance=self.name) from error
        return FmuState(self._on_state(lambda: self._fmu.deserializeFMUState(rest)), standing)

    @abstractmethod
    def _standing(self) -> Standing:
        """Where the instance stands now."""

    @abstractmethod
    def _stand(self, standing: Standing) -> None:
        """Stand there, now that the FMU does."""

    def _check_state(self, can: bool, what: str) -> None:  # noqa: FBT001 a capability flag
        if not can:
            raise FmuError(f"the FMU cannot {what}, as its model description says", instance=self.name)

    def _on_state(self, call: Callable[[], T]) -> T:
        try:
            return call()
        except FMICallException as error:
            raise StepFailed(f"{error.function} failed with status {error.status}", instance=self.name) from error


def _own(state: object) -> FmuState:
    if not isinstance(state, FmuState):
        msg = f"{type(state).__name__} is no state of an FMU"
        raise TypeError(msg)
    return state
