"""The old name of what `fmu_mesh.ros.node` offers now; it goes with the next minor version but one."""

import warnings

from .messages.ros_names import *  # noqa: F403 all names that were here

warnings.warn(
    "fmu_mesh.ros.names is deprecated: write `from fmu_mesh.ros.node import ros_name`",
    DeprecationWarning,
    stacklevel=2,
)
