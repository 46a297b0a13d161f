"""The mesh as ROS 2 sees it: messages, the gateway, the ROS node, and bags.

This package meets the rest of the mesh on the wire only. Only `fmu_mesh.ros.node` needs an installed ROS.
"""
