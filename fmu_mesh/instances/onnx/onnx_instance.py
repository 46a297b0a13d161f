"""An ONNX model behind the `Instance` Protocol.

One own step from n to n + 1, in pseudocode::

    inputs of row n, rounded to the types of the tensors
    compute the model
    outputs into row n + 1

In Initialization Mode the outputs follow the inputs at any time; afterwards they change in a step only. A model has no
memory, so the values of its inputs and outputs are the whole state.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import msgspec
import numpy as np

from ...errors import FmuError, InitializationFailed, StepFailed
from ...rings.ring import Ring
from ...simtime import TimeGrid
from ...system.layout import Layout
from ...variables.model_description import Value
from ...variables.value_conversion import to_value
from ...variables.value_types import is_float
from ..contract import KeepsStateAsBytes
from .onnx_model import Array, OnnxModel, reason_of

__all__ = ["OnnxInstance"]


class OnnxInstance(KeepsStateAsBytes):
    """One model; see `fmu_mesh.instances.contract.Instance` for the call sequence.

    With ``not_finite`` as `record`, NaN is no error.
    """

    def __init__(self, name: str, model: OnnxModel, not_finite: Literal["stop", "record"] | None = None) -> None:
        self.name = name
        self._takes_nan = not_finite == "record"
        self._model = model
        self.description = model.description
        self._variables = {variable.name: variable for variable in model.description.variables}
        self._values = Ring(Layout.of(model.description.variables), 1)
        self._tensors: dict[str, Array] = {t.variable.name: np.empty(t.sizes, t.dtype) for t in model.inputs}
        # Views of the same memory: the values of an input and its tensor, of an output, and of all of one type.
        self._loads = [(self._own(name), tensor.reshape(-1)) for name, tensor in self._tensors.items()]
        self._stores = [(tensor.variable, self._own(tensor.variable.name)) for tensor in model.outputs]
        parts = zip(self._values.layout.parts, self._values.parts, strict=True)
        self._numbers = [rows[0] for part, rows in parts if is_float(part.type)]
        self._is_initialized = False
        self._is_computed = False

    def end_run(self) -> bool:
        """See `BeginsAgain`."""
        return True

    def begin_again(self) -> None:
        """See `BeginsAgain`."""
        self._values.clear()
        self._is_initialized = self._is_computed = False

    def enter_initialization(
        self, start_time: float, stop_time: float | None, start_values: Mapping[str, Value]
    ) -> None:
        """Set ``start_values``."""
        self.set_values({name: to_value(value, self._variables[name]) for name, value in start_values.items()})

    def exit_initialization(self) -> None:
        """Compute the outputs of the first point."""
        self._follow()
        self._is_initialized = True

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set inputs by name."""
        for name, value in values.items():
            self._values.put(0, name, value)
        self._is_computed = False

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """Current values by name; those of outputs may have to be computed."""
        if any(self._variables[name].causality == "output" for name in names):
            self._follow()
        return [self._values.value(0, name) for name in names]

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Choose the rings of `do_step`, and write the current outputs to row ``step``."""
        self._takes = [(self._own(name), *_columns(inputs, name), inputs.mask) for name in inputs.layout.names]
        self._gives = [
            (self._own(name), *_columns(ring, name), ring.mask) for ring in outputs for name in ring.layout.names
        ]
        self._write(step)

    def do_step(self, step: int) -> None:
        """Take the inputs of row ``step``, compute the model, write the outputs to row ``step + 1``."""
        for own, rows, columns, mask in self._takes:
            own[:] = rows[step & mask, columns]
        self._compute()
        self._write(step + 1)

    def get_state(self) -> bytes:
        """See `KeepsState`: the values of all inputs and outputs."""
        return msgspec.msgpack.encode([part.tolist() for part in self._values.parts])

    def set_state(self, state: object) -> None:
        """See `KeepsState`; also for a state of an equal instance."""
        assert isinstance(state, bytes)
        own = self._values.parts
        try:
            parts = [np.array(part) for part in msgspec.msgpack.decode(state, type=list[list[list[Any]]])]
        except msgspec.DecodeError:
            parts = []
        if [part.shape for part in parts] != [part.shape for part in own]:
            raise StepFailed(f"{len(state)} bytes are no state of this model", instance=self.name)
        for part, values in zip(own, parts, strict=True):
            part[...] = values

    def close(self) -> None:
        """Nothing to do: the session of onnxruntime has neither files nor threads, and is freed with this object."""

    def _own(self, name: str) -> Array:
        """The elements of a variable, as a view of their memory."""
        rows, columns = _columns(self._values, name)
        return rows[0, columns]

    def _follow(self) -> None:
        """Compute the outputs if the inputs were changed in Initialization Mode."""
        if not (self._is_initialized or self._is_computed):
            self._compute()
            self._is_computed = True

    def _compute(self) -> None:
        """Compute the outputs from the inputs.

        NaN is an error: most functions of a network hide it, so a policy would go on with a number that means nothing.
        """
        with np.errstate(over="ignore"):  # what is beyond the range of a Float32 becomes infinite, as in C
            for values, tensor in self._loads:
                tensor[:] = values
            try:
                outputs = self._model.compute(self._tensors)
            except Exception as error:
                raise self._failed(f"onnxruntime cannot compute it: {reason_of(error)}") from error
            for (variable, values), output in zip(self._stores, outputs, strict=True):
                if output.size != values.size:
                    text = f"the output has {output.size} elements now and had {values.size} for inputs of 0"
                    raise self._failed(text, variable.name)
                values[:] = output.ravel()
            if not self._takes_nan and any(
                math.isnan(numbers.dot(numbers)) for numbers in self._numbers
            ):  # only NaN makes a sum of squares NaN
                raise self._not_a_number()

    def _not_a_number(self) -> FmuError:
        """The error that names the first element that is NaN; inputs come before outputs."""
        elements = (
            (variable, name)
            for variable in self._variables.values()
            if is_float(variable.type)
            for name, value in zip(variable.elements, self._own(variable.name), strict=True)
            if np.isnan(value)
        )
        variable, name = next(elements)
        return self._failed(f"the {variable.causality} is not a number (NaN)", name)

    def _failed(self, text: str, variable: str | None = None) -> FmuError:
        failure = StepFailed if self._is_initialized else InitializationFailed
        return failure(text, instance=self.name, variable=variable)

    def _write(self, step: int) -> None:
        for own, rows, columns, mask in self._gives:
            rows[step & mask, columns] = own


def _columns(ring: Ring, name: str) -> tuple[Array, slice]:
    """Where the elements of a variable are: the array of their type, and the columns of it."""
    place = ring.layout.place(name)
    return ring.parts[place.part], slice(place.first, place.first + place.size)
