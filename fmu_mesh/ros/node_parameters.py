"""The old name of what `fmu_mesh.ros.node` offers now; it goes with the next minor version but one."""

import warnings

from .node.variable_parameters import *  # noqa: F403 all names that were here

warnings.warn(
    "fmu_mesh.ros.node_parameters is deprecated: write `from fmu_mesh.ros.node import initialize_from_parameters`",
    DeprecationWarning,
    stacklevel=2,
)
