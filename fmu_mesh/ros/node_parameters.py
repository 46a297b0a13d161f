"""The old module of what a user's own node needs, now in `fmu_mesh.ros.node`; removed after the next minor version."""

from __future__ import annotations

from functools import partial

from .names import moved

__getattr__ = partial(moved, __name__)
