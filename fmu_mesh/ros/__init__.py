"""The mesh as ROS 2 sees it: names, message types and CDR, the gateway, and what a ROS node needs.

Meets the rest of the mesh on the wire only. Nothing here needs an installed ROS but `fmu_mesh.ros.node`.
"""
