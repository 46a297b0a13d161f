"""An FMU, or the gateway of a mesh, as a ROS 2 lifecycle node; and what a user's own node needs for an FMU.

`python -m fmu_mesh.ros.node` runs the node. rclpy comes from the user's own ROS; importing this package does not need
it.
"""

from ...ros_wire.ros_names import ros_name
from .entry import create_node, main
from .variable_parameters import declare_parameters, initialize_from_parameters

__all__ = ["create_node", "declare_parameters", "initialize_from_parameters", "main", "ros_name"]
