"""How outputs of a model depend on its inputs at the same point, measured in Initialization Mode in a child process.

Owns what is set and read for that. A derivative counts if it is the same over two steps of the input and with other
values of the other inputs: whoever uses it takes it for a constant (`fmu_mesh.system.coupling_rule`).
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..config.instance_sections import InstanceSection
from ..config.mesh import LimitsConfig
from ..errors import FmuMeshError, LoadFailed
from ..variables.model_description import ModelDescription
from ..variables.value_conversion import to_value
from ..variables.value_types import PlainValue, Value, split_element
from .child_question import run_child
from .contract import Instance, Opening
from .registry import decode_section, open_instance

__all__ = ["Measured", "answer_to", "measured"]

_AGREE = 1e-6
"""Two measured derivatives are the same if they differ by less than this part of the larger one."""


class Measured(msgspec.Struct, frozen=True):
    """The derivatives by output and input; and in words, which are none: those that are no constants."""

    derivatives: dict[str, dict[str, float]] = {}
    changing: tuple[str, ...] = ()
    failure: str = ""


class _Request(msgspec.Struct, frozen=True):
    path: str
    section: InstanceSection
    description: ModelDescription
    limits: LimitsConfig
    start_time: float
    start_values: dict[str, PlainValue]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


def measured(  # noqa: PLR0913, PLR0917  a model, and what is asked of it
    path: Path,
    section: InstanceSection,
    description: ModelDescription,
    limits: LimitsConfig,
    start_time: float,
    start_values: Mapping[str, PlainValue],
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> Measured:
    """Measure how each of the outputs depends on each of the inputs; both may be elements of arrays, as `y[2]`.

    The child process has the deadline of `child_question`. Where it fails, `Measured.failure` says why.
    """
    request = _Request(
        str(path), section, description, limits, start_time, dict(start_values), tuple(inputs), tuple(outputs)
    )
    python = section.interpreter or sys.executable
    with tempfile.TemporaryDirectory(prefix="fmu_mesh-") as folder:
        file = Path(folder) / "request"
        file.write_bytes(msgspec.msgpack.encode(request, enc_hook=str))
        answer, ending = b"", ""
        try:
            answer, ending = run_child([python, "-Pm", __package__, __name__, str(file)])
        except LoadFailed as error:
            return Measured(failure=error.message)
    try:
        return msgspec.msgpack.decode(answer, type=Measured)
    except msgspec.DecodeError:
        return Measured(failure=f"the process that measures it {ending}")


def answer_to(request: str) -> bytes:
    """In the child process: measure what is asked for; returns the answer."""
    file = Path(request)
    own = msgspec.msgpack.decode(file.read_bytes(), type=_Request, dec_hook=decode_section)
    opening = Opening[Any](
        name="measured",
        path=Path(own.path),
        section=own.section,
        description=own.description,
        folder=file.parent,
        limits=own.limits,
    )
    variables = {variable.name: variable for variable in own.description.variables}
    try:
        instance = open_instance(opening)
        values = {name: to_value(value, variables[name]) for name, value in own.start_values.items()}
        instance.enter_initialization(own.start_time, None, values)
        answer = _Measurement(instance, own.inputs, own.outputs).result()
    except FmuMeshError as error:
        answer = Measured(failure=error.message)
    return msgspec.msgpack.encode(answer)


class _Measurement:
    """Sets inputs of an instance in Initialization Mode, and reads what its outputs are then."""

    def __init__(self, instance: Instance, inputs: Sequence[str], outputs: Sequence[str]) -> None:
        self._instance, self._inputs, self._outputs = instance, inputs, outputs
        known = {variable.name for variable in instance.description.variables}
        self._ends = {
            name: (name, ()) if name in known else split_element(name) or (name, ()) for name in (*inputs, *outputs)
        }

    def result(self) -> Measured:
        """Each derivative, as an average over two steps of its input."""
        base = self._read(self._inputs)
        steps = np.array([2.0 ** math.floor(math.log2(max(abs(value), 1.0))) / 8.0 for value in base])
        derivatives: dict[str, dict[str, float]] = {}
        changing = []
        for number, name in enumerate(self._inputs):
            only = np.zeros(len(base))
            only[number] = steps[number]
            others = base + steps - only
            at = [self._at(base + times * only) for times in (0, 1, 2)]
            elsewhere = [self._at(others + times * only) for times in (0, 1)]
            slopes = [at[1] - at[0], at[2] - at[1], elsewhere[1] - elsewhere[0]]
            for output, *rest in zip(self._outputs, np.abs(at).max(axis=0), *slopes, strict=True):
                size, *changes = (float(value) for value in rest)
                allowed = max(_AGREE * max(map(abs, changes)), 64 * np.finfo(float).eps * size)
                if not max(changes) - min(changes) <= allowed:
                    changing.append(f"'{output}' by '{name}'")
                elif max(map(abs, changes)) > 64 * np.finfo(float).eps * size:
                    derivatives.setdefault(output, {})[name] = (changes[0] + changes[1]) / (2 * float(steps[number]))
        self._set(base)
        return Measured(derivatives, tuple(changing))

    def _at(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        self._set(values)
        return self._read(self._outputs)

    def _set(self, values: NDArray[np.float64]) -> None:
        given: dict[str, Any] = {}
        for name, value in zip(self._inputs, values.tolist(), strict=True):
            variable, index = self._ends[name]
            if not index:
                given[variable] = value
                continue
            if variable not in given:
                given[variable] = self._instance.get_values([variable])[0]
            row = given[variable]
            for place in index[:-1]:
                row = row[place]
            row[index[-1]] = value
        self._instance.set_values(given)

    def _read(self, names: Sequence[str]) -> NDArray[np.float64]:
        ends = [self._ends[name] for name in names]
        values: list[Value] = self._instance.get_values([variable for variable, _ in ends])
        return np.array([np.asarray(value, float)[index] for value, (_, index) in zip(values, ends, strict=True)])
