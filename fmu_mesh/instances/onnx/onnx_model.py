"""An ONNX model as a function of arrays, and as a model description.

Owns the file, the session of onnxruntime, and which tensor is which variable. When the function is computed is
`fmu_mesh.instances.onnx.onnx_instance`.

A dynamic first dimension is the batch: its size is 1. Leading dimensions of size 1 are left out. So `float[N,4]` and
`float[1,4]` are arrays of 4 elements, and `float[N,1]`, `float[1]` and `float` are scalars.
"""

from __future__ import annotations

import hashlib
import itertools
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ...config.mesh import LimitsConfig
from ...errors import LoadFailed
from ...files import opened
from ...installing import importing
from ...text import listed
from ...variables.model_description import ModelDescription, Variable
from ...variables.value_types import MAX_ELEMENTS, VariableType, is_float, nested, zero

__all__ = ["Array", "OnnxModel", "Tensor", "reason_of"]

Array = NDArray[Any]
Sizes = tuple[int, ...]

_TYPES: dict[str, tuple[Any, VariableType]] = {
    "tensor(float16)": (np.float16, "Float32"),
    "tensor(float)": (np.float32, "Float32"),
    "tensor(double)": (np.float64, "Float64"),
    "tensor(int8)": (np.int8, "Int8"),
    "tensor(uint8)": (np.uint8, "UInt8"),
    "tensor(int16)": (np.int16, "Int16"),
    "tensor(uint16)": (np.uint16, "UInt16"),
    "tensor(int32)": (np.int32, "Int32"),
    "tensor(uint32)": (np.uint32, "UInt32"),
    "tensor(int64)": (np.int64, "Int64"),
    "tensor(uint64)": (np.uint64, "UInt64"),
    "tensor(bool)": (np.bool_, "Boolean"),
    "tensor(string)": (np.object_, "String"),
}
"""By the type of a tensor, the type of its elements, and the type of an output that holds all their values."""

_NO_FOLDER = "/dev/null"
"""Where onnxruntime looks for weights that are not in the file; its message names it."""


class Tensor(msgspec.Struct, frozen=True):
    """One input or output of a model."""

    # what the mesh sees of it. An input of any floating-point type is a Float64, so that every floating-point output
    # can be connected to it; its value is rounded when the model is computed.
    variable: Variable
    dtype: Any  # the type of the elements of the tensor
    sizes: Sizes  # the sizes of all its dimensions


class OnnxModel:
    """A model that onnxruntime computes on one thread; `LoadFailed` if that cannot, or no instance can be made of it.

    ``content`` is the SHA-256 that the file has to have, None if it is not known; ``limits.unpacked_bytes`` its largest
    size.
    """

    def __init__(
        self,
        path: Path,
        limits: LimitsConfig = LimitsConfig(),  # noqa: B008  a frozen Struct
        content: str | None = None,
    ) -> None:
        data = _read(path, limits)
        sha256 = hashlib.sha256(data).hexdigest()
        if content not in {None, sha256}:
            raise LoadFailed(f"'{path}' was changed after the run was planned", hint="Start the run again.")
        engine = _engine()
        self._session = _load(engine, data, path)
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if problems := [*_problems(inputs, outputs)]:
            raise LoadFailed(f"'{path}' cannot be an instance: {'; '.join(problems)}")
        self._names = [node.name for node in outputs]
        self.inputs = tuple(_tensor(number, node, _sizes(node)) for number, node in enumerate(inputs))
        self.outputs = tuple(
            _tensor(number, node, sizes, self.inputs)
            for number, (node, sizes) in enumerate(zip(outputs, self._sizes_of_outputs(path), strict=True), len(inputs))
        )
        said = self._session.get_modelmeta()
        self.description = ModelDescription(
            model_name=said.graph_name or "onnx",
            model_identifier="onnx",
            fmi_version="",
            kind="onnx_model",
            guid=sha256[:32],
            variables=tuple(tensor.variable for tensor in (*self.inputs, *self.outputs)),
            description=said.description or said.graph_description or None,
            generation_tool=f"onnxruntime {engine.__version__}",
            can_handle_variable_step_size=True,
            can_get_and_set_state=True,
            can_serialize_state=True,
        )

    def compute(self, inputs: Mapping[str, Array]) -> list[Array]:
        """The outputs for inputs of the right types and sizes; the errors of onnxruntime have no class in common."""
        outputs: list[Array] = self._session.run(self._names, inputs)
        return outputs

    def _sizes_of_outputs(self, path: Path) -> list[Sizes]:
        """What the sizes are when the model is computed; the file does not always say it."""
        zeros = {
            tensor.variable.name: np.full(tensor.sizes, zero(tensor.variable.type), tensor.dtype)
            for tensor in self.inputs
        }
        try:
            outputs, again = self.compute(zeros), self.compute(zeros)
        except Exception as error:
            raise LoadFailed(f"onnxruntime cannot compute '{path}' for inputs of 0: {reason_of(error)}") from error
        for name, first, second in zip(self._names, outputs, again, strict=True):
            if not np.array_equal(first, second, equal_nan=first.dtype.kind == "f"):
                text = f"the output '{name}' of '{path}' has different values for the same inputs"
                hint = "Export the model without random numbers: the most likely action, and no dropout."
                raise LoadFailed(text, hint=hint)
            if not 0 < first.size <= MAX_ELEMENTS:
                text = f"the output '{name}' of '{path}' has {first.size} elements for inputs of 0"
                raise LoadFailed(text, hint=f"An output has from 1 to {MAX_ELEMENTS} elements, always as many.")
        return [output.shape for output in outputs]


def reason_of(error: Exception) -> str:
    """What onnxruntime says of an error, in one line and without its codes."""
    text = " ".join(str(error).split())
    return text.rpartition("[ONNXRuntimeError] : ")[2].split(" : ", 2)[-1].rstrip(".")


def _read(path: Path, limits: LimitsConfig) -> bytes:
    try:
        size = path.stat().st_size
        if size > limits.unpacked_bytes:
            text = f"'{path}' has {size} bytes; the limit is {limits.unpacked_bytes}"
            raise LoadFailed(text, hint="Raise `limits.unpacked_bytes` if that is right.")
        with opened(path) as file:
            return file.read()
    except OSError as error:
        raise LoadFailed(f"'{path}' cannot be read: {error.strerror or error}") from error


def _engine() -> ModuleType:
    # Some releases send usage data to their vendor, with threads and files of their own. Who wants that says so.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    with importing("onnxruntime"):
        import onnxruntime  # noqa: PLC0415  an extra, and slow to import
    module: ModuleType = onnxruntime
    return module


def _load(engine: ModuleType, data: bytes, path: Path) -> Any:  # noqa: ANN401  onnxruntime has no types
    options = engine.SessionOptions()
    # Several threads add numbers in another order, and take processors away from other instances.
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 4  # nothing on stderr: what is wrong is in the exception
    # Weights in other files would be no part of the SHA-256 that all hosts agree on.
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", _NO_FOLDER)
    try:
        return engine.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        if _NO_FOLDER in str(error):
            hint = f"Write one file: `onnx.save(onnx.load('{path.name}'), '{path.name}')`."
            raise LoadFailed(f"'{path}' has its weights in another file", hint=hint) from error
        raise LoadFailed(f"onnxruntime cannot load '{path}': {reason_of(error)}") from error


def _problems(inputs: list[Any], outputs: list[Any]) -> Iterator[str]:
    """Why no instance can be made of a model with these inputs and outputs of onnxruntime."""
    for causality, nodes in (("input", inputs), ("output", outputs)):
        for node in nodes:
            if node.type not in _TYPES:
                hint = ": export it with `options={'zipmap': False}`" if "map(" in node.type else ""
                yield f"the {causality} '{node.name}' is a {node.type}{hint}"
    for node in inputs:
        sizes = _sizes(node)
        dynamic = [f"'{size or place}'" for place, size in enumerate(sizes, 1) if not isinstance(size, int)]
        if dynamic:
            yield f"the input '{node.name}' has dynamic dimensions besides the first, the batch: {listed(dynamic)}"
        elif not 0 < math.prod(sizes) <= MAX_ELEMENTS:
            yield f"the input '{node.name}' has {math.prod(sizes)} elements, not from 1 to {MAX_ELEMENTS}"
    for name in sorted({node.name for node in inputs} & {node.name for node in outputs}):
        yield f"'{name}' is the name of an input and of an output"


def _sizes(node: Any) -> tuple[Any, ...]:  # noqa: ANN401  onnxruntime has no types
    """The sizes of an input; a dynamic one is its name or None, but for the first, the batch, which is 1."""
    return tuple(1 if place == 0 and not isinstance(size, int) else size for place, size in enumerate(node.shape))


def _tensor(number: int, node: Any, sizes: Sizes, inputs: Sequence[Tensor] | None = None) -> Tensor:  # noqa: ANN401  as above
    """An output that depends on all ``inputs``, or an input if there are none."""
    dtype, type_ = _TYPES[node.type]
    if inputs is None and is_float(type_):
        type_ = "Float64"
    shape = tuple(itertools.dropwhile(lambda size: size == 1, sizes))
    depends_on = None if inputs is None else tuple(tensor.variable.name for tensor in inputs)
    variable = Variable(
        name=node.name,
        value_reference=number,
        type=type_,
        causality="input" if inputs is None else "output",
        variability="continuous" if is_float(type_) else "discrete",
        initial=None if inputs is None else "calculated",
        start=nested([zero(type_)] * math.prod(shape), shape) if inputs is None else None,
        dimensions=shape,
        shape=shape,
        dependencies=depends_on,
        feedthrough=depends_on,
    )
    return Tensor(variable, dtype, sizes)
