"""One FMU as a ROS node: configured and activated as soon as it is there, as in `fmi_adapter`.

ros2 launch examples/ros/fmi_adapter_node.launch.py fmu_path:=fmus/DampedPendulum.fmu
"""

from __future__ import annotations

import sys

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.events import matches_action
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from lifecycle_msgs.msg import Transition


def change(node: LifecycleNode, transition: int) -> EmitEvent:
    """Ask a node for a transition of its lifecycle."""
    return EmitEvent(event=ChangeState(lifecycle_node_matcher=matches_action(node), transition_id=transition))


def generate_launch_description() -> LaunchDescription:
    """What `ros2 launch` runs."""
    node = LifecycleNode(
        executable=sys.executable,  # the Python that has fmu_mesh
        arguments=["-Pm", "fmu_mesh.ros.node"],
        name="fmi_adapter_node",
        namespace="",
        parameters=[{"fmu_path": LaunchConfiguration("fmu_path")}],
        output="screen",
    )
    # Only after it was configured: a node that deactivates itself at its stop time stays inactive.
    configured = OnStateTransition(
        target_lifecycle_node=node,
        start_state="configuring",
        goal_state="inactive",
        entities=[change(node, Transition.TRANSITION_ACTIVATE)],
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("fmu_path", description="path of the FMU"),
            RegisterEventHandler(configured),
            node,
            change(node, Transition.TRANSITION_CONFIGURE),
        ]
    )
