"""The old module of what a user's own node needs, now in `fmu_mesh.ros.node`; removed after the next minor version."""

from __future__ import annotations

import warnings
from typing import Any

from . import node


def __getattr__(name: str) -> Any:  # noqa: ANN401 any name of the new module
    if name not in node.__all__:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    text = f"{__name__} is deprecated: write `from fmu_mesh.ros.node import {name}`"
    warnings.warn(text, DeprecationWarning, stacklevel=2)
    return getattr(node, name)
