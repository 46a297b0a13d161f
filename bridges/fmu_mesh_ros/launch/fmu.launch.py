"""One FMU as a ROS node that configures and activates itself.

ros2 launch fmu_mesh_ros fmu.launch.py fmu_path:=DampedPendulum.fmu
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """What `ros2 launch` runs."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("fmu_path", description="path of the FMU"),
            DeclareLaunchArgument("name", default_value="fmi_adapter_node", description="name of the node"),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of the node"),
            Node(
                package="fmu_mesh_ros",
                executable="node",
                name=LaunchConfiguration("name"),
                namespace=LaunchConfiguration("namespace"),
                parameters=[{"fmu_path": LaunchConfiguration("fmu_path"), "autostart": True}],
                output="screen",
            ),
        ]
    )
