"""Inputs that change linearly within a communication step (`extrapolation: linear` of a connection).

Owns the derivative of an input. It follows from two neighbouring rows only, so it is the same in every process. A
connection with delay 1 gives the value at the start of a step: the input is extrapolated with the derivative of the
step before. A connection with delay 0 gives the value at the end: the input is interpolated. `TakesDerivatives` says
how an FMU gets a derivative.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import msgspec
import numpy as np

from ....rings.ring import Ring
from ....simtime import TimeGrid
from ....system.layout import Layout
from ....system.linear_inputs import LinearInput
from ...contract import Instance, KeepsState
from ...instance_wrapper import AroundInstance, of_kind, packed, unpacked

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
    """An instance with inputs that change linearly within a step.

    Args:
        instance: the inner instance; `close` closes it.
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
            # Before the first step, the FMU has the inputs of Initialization Mode.
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
            slopes[~self._at_end] = 0.0  # there is no step before that has a derivative
            self._stepped = True
        reals[0, self._columns] = np.where(self._at_end, previous, given)
        self._previous = given
        self._instance.set_input_derivatives(dict(zip(self._names, slopes.tolist(), strict=True)))
        self._instance.do_step(step)

    def get_state(self) -> object:
        """See `KeepsState`."""
        return _LinearState(super().get_state(), _Slopes(self._previous.tolist(), self._stepped))

    def set_state(self, state: object) -> None:
        """See `KeepsState`."""
        own = of_kind(_LinearState, state)
        super().set_state(own.inner)
        self._previous = np.array(own.slopes.previous, dtype=np.float64)
        self._stepped = own.slopes.stepped

    def free_state(self, state: object) -> None:
        """See `KeepsState`."""
        super().free_state(of_kind(_LinearState, state).inner)

    def serialize_state(self, state: object) -> bytes:
        """See `KeepsState`."""
        own = of_kind(_LinearState, state)
        return packed(own.slopes, super().serialize_state(own.inner))

    def deserialize_state(self, data: bytes) -> object:
        """See `KeepsState`.

        Raises:
            FmuMeshError: ``data`` is no state of an instance with linear inputs.
        """
        slopes, rest = unpacked(data, _Slopes, None)
        return _LinearState(super().deserialize_state(rest), slopes)


class _Slopes(msgspec.Struct, frozen=True):
    """The slopes of the next step follow from this: the last values, and whether there was a step."""

    previous: list[float]
    stepped: bool


class _LinearState(NamedTuple):
    """A state of the inner instance, and the slopes."""

    inner: object
    slopes: _Slopes
