"""The old module of `ros_name`, which is in `fmu_mesh.ros.node` now; removed after the next minor version."""

from functools import partial

from . import moved

__getattr__ = partial(moved, __name__)
