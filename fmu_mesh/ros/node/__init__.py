"""An FMU, or the gateway of a mesh, as a ROS 2 lifecycle node; `python -m fmu_mesh.ros.node` runs it.

rclpy comes from the user's own ROS; importing this package does not need it.
"""

from .entry import create_node, main

__all__ = ["create_node", "main"]
