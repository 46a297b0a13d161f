"""The old module of `ros_name`, which is in `fmu_mesh.ros.node` now; removed after the next minor version."""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any

from . import node


def moved(module: str, name: str) -> Any:  # noqa: ANN401 any name of the new module
    """A name of an old module, with a warning."""
    if name not in node.__all__:
        raise AttributeError(f"module '{module}' has no attribute '{name}'")
    text = f"{module} is deprecated: write `from fmu_mesh.ros.node import {name}`"
    warnings.warn(text, DeprecationWarning, stacklevel=2)
    return getattr(node, name)


__getattr__ = partial(moved, __name__)
