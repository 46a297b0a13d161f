"""The path filter between /velDes and /velDesFil as a ROS node, configured and activated as soon as it is there.

ros2 launch examples/ros/path_filter/path_filter.launch.py
"""

from __future__ import annotations

import sys
from pathlib import Path

from launch import LaunchDescription
from launch_ros.actions import LifecycleNode

_TWIST = (
    "{{type: geometry_msgs/msg/TwistStamped, frame_id: base_link, "
    "fields: {{twist.linear.x: {linear}, twist.angular.z: {angular}}}}}"
)


def generate_launch_description() -> LaunchDescription:
    """What `ros2 launch` runs."""
    velocities = _TWIST.format(linear="linearVelocity", angular="angularVelocity")
    filtered = _TWIST.format(linear="filteredLinearVelocity", angular="filteredAngularVelocity")
    node = LifecycleNode(
        executable=sys.executable,  # the Python that has fmu_mesh
        arguments=["-Pm", "fmu_mesh.ros.node"],
        name="path_filter",
        namespace="",
        parameters=[
            {
                "fmu_path": str(Path(__file__).resolve().parents[3] / "fmus" / "PathFilter.fmu"),
                "slopeSpeed": 4.0,
                "autostart": True,
                "messages": [f"/velDes: {velocities}", f"/velDesFil: {filtered}"],
            }
        ],
        output="screen",
    )
    return LaunchDescription([node])
