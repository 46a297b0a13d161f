"""The mesh as ROS 2 sees it: the gateway, the ROS node, and bags.

This package meets the rest of the mesh on the wire only. Only `fmu_mesh.ros.node` needs an installed ROS.
"""

import warnings
from typing import Any


def moved(module: str, name: str) -> Any:  # noqa: ANN401 any name of the new module
    """A name of an old module, which `fmu_mesh.ros.node` has now, with a warning."""
    from . import node  # noqa: PLC0415 only who imports an old name needs it

    if name not in node.__all__:
        raise AttributeError(f"module '{module}' has no attribute '{name}'")
    text = f"{module} is deprecated: write `from fmu_mesh.ros.node import {name}`"
    warnings.warn(text, DeprecationWarning, stacklevel=2)
    return getattr(node, name)
