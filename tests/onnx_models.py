"""Writes small ONNX models for tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

__all__ = ["Nodes", "weights", "write_identity", "write_model", "write_network"]

Nodes = Sequence[tuple[str, Sequence[str], Sequence[str]] | tuple[str, Sequence[str], Sequence[str], Mapping[str, Any]]]
"""(operator, names of its inputs, names of its outputs), and its attributes."""

Tensors = Mapping[str, tuple[str, Sequence[int | str | None] | None]]
"""(type as in `TensorProto`, sizes) by name."""


def write_model(
    path: Path,
    nodes: Nodes,
    inputs: Tensors,
    outputs: Tensors,
    constants: Mapping[str, NDArray[Any]] | None = None,
) -> Path:
    """Write a model of these operators, and return its path."""
    graph = helper.make_graph(
        [helper.make_node(operator, taken, given, **(*rest, {})[0]) for operator, taken, given, *rest in nodes],
        "graph",
        [
            helper.make_tensor_value_info(name, getattr(TensorProto, kind), size)
            for name, (kind, size) in inputs.items()
        ],
        [
            helper.make_tensor_value_info(name, getattr(TensorProto, kind), size)
            for name, (kind, size) in outputs.items()
        ],
        [numpy_helper.from_array(array, name) for name, array in (constants or {}).items()],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
    return path


def write_identity(path: Path, kind: str = "FLOAT", sizes: Sequence[int | str | None] | None = (1,)) -> Path:
    """Write a model whose output `y` is its input `x`."""
    return write_model(path, [("Identity", ["x"], ["y"])], {"x": (kind, sizes)}, {"y": (kind, sizes)})


def weights(inputs: int, hidden: int = 32) -> dict[str, NDArray[np.float32]]:
    """The weights of a network with one output, whose values are far from being short decimal numbers."""
    random = np.random.default_rng(7)
    shapes = {"first": (inputs, hidden), "second": (hidden, 1)}
    return {name: np.asarray(random.standard_normal(shape) / 4, dtype=np.float32) for name, shape in shapes.items()}


def write_network(path: Path, inputs: int = 4) -> Path:
    """Write tanh(tanh(observation * first) * second), from `inputs` elements to the scalar `action`."""
    nodes: Nodes = [
        ("MatMul", ["observation", "first"], ["product"]),
        ("Tanh", ["product"], ["hidden"]),
        ("MatMul", ["hidden", "second"], ["answer"]),
        ("Tanh", ["answer"], ["action"]),
    ]
    sizes: Tensors = {"observation": ("FLOAT", ["batch", inputs])}
    return write_model(path, nodes, sizes, {"action": ("FLOAT", ["batch", 1])}, weights(inputs))
