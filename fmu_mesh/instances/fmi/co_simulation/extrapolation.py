"""Inputs that change linearly within a communication step (`extrapolation: linear` of a connection).

Owns the derivative of an input from two neighbouring rows, the same in every process because it depends on nothing but
the rows. A connection with delay 1 gives the value at the start of a step, which is extrapolated with the derivative
of the step before; one with delay 0 gives the value at its end, so the input is interpolated. How an FMU takes a
derivative is its own matter (`TakesDerivatives`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import msgspec
import numpy as np

from ....errors import FmuMeshError
from ....rings.ring import Ring
from ....simtime import TimeGrid
from ....system.layout import Layout
from ....system.linear_inputs import LinearInput
from ...contract import Instance, KeepsState
from ...instance_wrapper import AroundInstance

__all__ = ["LinearInputs", "TakesDerivatives"]


class TakesDerivatives(Instance, KeepsState, Protocol):
    """An instance of an FMU whose Real inputs may change linearly within a step."""

    def set_input_derivatives(self, derivatives: Mapping[str, float]) -> None:
        """Time derivatives (1/s) of inputs for the next step; see FMI 2.0, 4.2.1, fmi2SetRealInputDerivatives."""
        ...

    def remove_files(self) -> None:
        """See `KeepsFiles`."""
        ...


class LinearInputs(AroundInstance[TakesDerivatives]):
    """An instance of whose inputs some change linearly; for the rest it is the instance itself.

    Args:
        instance: it; is closed with this.
        inputs: the linear inputs.
    """

    def __init__(self, instance: TakesDerivatives, inputs: Sequence[LinearInput]) -> None:
        super().__init__(instance)
        self._names = [item.name for item in inputs]
        self._at_end = np.array([item.delay == 0 for item in inputs])
        self._previous: np.ndarray[Any, np.dtype[np.float64]] = np.zeros(0)
        self._stepped = False
        self._outer = Ring(Layout(), 1)
        self._inner = self._outer
        self._columns = np.zeros(0, dtype=np.intp)
        self._step_size = 0.0

    def remove_files(self) -> None:
        """See `KeepsFiles`."""
        self._instance.remove_files()

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """See `Instance`."""
        if not self._previous.size:
            # Before the first step, the inputs are what Initialization Mode has left in the FMU.
            self._previous = np.array(self._instance.get_values(self._names), dtype=np.float64)
        self._outer = inputs
        self._inner = Ring(inputs.layout, 1)
        self._columns = np.array([inputs.layout.place(name).first for name in self._names])
        self._step_size = points * grid.step_size
        self._instance.bind(self._inner, outputs, grid, points, step)

    def do_step(self, step: int) -> None:
        """See `Instance`."""
        slot = step & self._outer.mask
        for own, part in zip(self._inner.parts, self._outer.parts, strict=True):
            own[0] = part[slot]
        reals = self._inner.part("Float64")
        given, previous = reals[0, self._columns], self._previous
        slopes = (given - previous) / self._step_size
        if not self._stepped:
            slopes[~self._at_end] = 0.0  # there is no step before, whose derivative could be gone on with
            self._stepped = True
        reals[0, self._columns] = np.where(self._at_end, previous, given)
        self._previous = given
        self._instance.set_input_derivatives(dict(zip(self._names, slopes.tolist(), strict=True)))
        self._instance.do_step(step)

    def get_state(self) -> object:
        """See `KeepsState`."""
        return _State(self._instance.get_state(), _Slopes(self._previous.tolist(), self._stepped))

    def set_state(self, state: object) -> None:
        """See `KeepsState`."""
        own = _own(state)
        self._instance.set_state(own.inner)
        self._previous = np.array(own.slopes.previous, dtype=np.float64)
        self._stepped = own.slopes.stepped

    def free_state(self, state: object) -> None:
        """See `KeepsState`."""
        self._instance.free_state(_own(state).inner)

    def serialize_state(self, state: object) -> bytes:
        """See `KeepsState`: the values of the linear inputs as JSON, a zero, and what the instance gives."""
        own = _own(state)
        return msgspec.json.encode(own.slopes) + b"\0" + self._instance.serialize_state(own.inner)

    def deserialize_state(self, data: bytes) -> object:
        """See `KeepsState`.

        Raises:
            FmuMeshError: ``data`` is no state of an instance with linear inputs.
        """
        head, _, rest = data.partition(b"\0")
        try:
            slopes = msgspec.json.decode(head, type=_Slopes)
        except msgspec.DecodeError as error:
            raise FmuMeshError(f"this is no state of an instance with linear inputs: {error}") from error
        return _State(self._instance.deserialize_state(rest), slopes)


class _Slopes(msgspec.Struct, frozen=True):
    """What the slopes of the next step follow from: the last values, and whether there was a step."""

    previous: list[float]
    stepped: bool


class _State:
    """A state of the instance, and the slopes."""

    def __init__(self, inner: object, slopes: _Slopes) -> None:
        self.inner = inner
        self.slopes = slopes


def _own(state: object) -> _State:
    if not isinstance(state, _State):
        msg = f"{type(state).__name__} is no state of an instance with linear inputs"
        raise TypeError(msg)
    return state
