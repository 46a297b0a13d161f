"""A mesh and a ROS node that is its gateway, on any middleware of ROS; the launch ends with the mesh.

    ros2 launch fmu_mesh_ros mesh_and_gateway.launch.py config:=pendulum_delay.yaml real_time_factor:=1

A section `ros` in the configuration needs `profile: rclpy`, or the mesh starts a gateway of its own beside this node.
"""

from fmu_mesh_ros.actions import Mesh
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, RegisterEventHandler, Shutdown
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """What `ros2 launch` runs."""
    config = LaunchConfiguration("config")
    mesh = Mesh(config=config, arguments=["--real-time-factor", LaunchConfiguration("real_time_factor")])
    gateway = Node(
        package="fmu_mesh_ros",
        executable="node",
        name="fmu_mesh_gateway",
        parameters=[{"config": config, "autostart": True}],  # it waits for the mesh itself
        output="screen",
    )
    ended = OnProcessExit(target_action=mesh, on_exit=[Shutdown(reason="the mesh has ended")])
    return LaunchDescription(
        [
            DeclareLaunchArgument("config", description="configuration file of the mesh"),
            DeclareLaunchArgument("real_time_factor", default_value="1", description="0: as fast as possible"),
            RegisterEventHandler(ended),
            gateway,
            mesh,
        ]
    )
