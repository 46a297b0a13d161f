"""A mesh; the launch ends with it. Its section `ros` says what ROS sees.

ros2 launch fmu_mesh_ros mesh.launch.py config:=pendulum_ros.yaml
"""

from fmu_mesh_ros.actions import Mesh
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, RegisterEventHandler, Shutdown
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration


def generate_launch_description() -> LaunchDescription:
    """What `ros2 launch` runs."""
    mesh = Mesh(config=LaunchConfiguration("config"))
    ended = OnProcessExit(target_action=mesh, on_exit=[Shutdown(reason="the mesh has ended")])
    return LaunchDescription(
        [
            DeclareLaunchArgument("config", description="configuration file of the mesh"),
            RegisterEventHandler(ended),
            mesh,
        ]
    )
