"""The old module of what a user's own node needs, now in `fmu_mesh.ros.node`; removed after the next minor version."""

from functools import partial

from . import moved

__getattr__ = partial(moved, __name__)
