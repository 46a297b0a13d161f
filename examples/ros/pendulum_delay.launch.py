"""A damped pendulum and a delay of its angle, each as a ROS node, with both lifecycles switched together.

    ros2 launch examples/ros/pendulum_delay.launch.py

Both are configured before one of them is activated, and the delay is active before the pendulum, so it misses nothing:

    delay configured -> pendulum configured -> delay activated -> pendulum activated

The angle is on `/example/a`, and 2.33 s later on `/example/y`. Two nodes that are coupled by topics without stamps, as
here and in `fmi_adapter`, run asynchronously: what a step is given depends on when a message came. For exact results
run both FMUs as a mesh (`configs/pendulum_delay.yaml`) and let a node be its gateway.
"""

from __future__ import annotations

import sys
from pathlib import Path

from launch import LaunchDescription
from launch.actions import EmitEvent, RegisterEventHandler
from launch.events import matches_action
from launch_ros.actions import LifecycleNode
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from lifecycle_msgs.msg import Transition

FMUS = Path(__file__).resolve().parents[2] / "fmus"


def fmu_node(name: str, fmu: str, values: dict[str, float], remappings: list[tuple[str, str]]) -> LifecycleNode:
    """A node that runs an FMU."""
    return LifecycleNode(
        executable=sys.executable,  # the Python that has fmu_mesh
        arguments=["-Pm", "fmu_mesh.ros.node"],
        name=name,
        namespace="example",
        parameters=[{"fmu_path": str(FMUS / fmu), **values}],
        remappings=remappings,
        output="screen",
    )


def change(node: LifecycleNode, transition: int) -> EmitEvent:
    """Ask a node for a transition of its lifecycle."""
    return EmitEvent(event=ChangeState(lifecycle_node_matcher=matches_action(node), transition_id=transition))


def after(node: LifecycleNode, state: str, then: EmitEvent, start: str = "configuring") -> RegisterEventHandler:
    """Do something when a node comes to a state."""
    handler = OnStateTransition(target_lifecycle_node=node, start_state=start, goal_state=state, entities=[then])
    return RegisterEventHandler(handler)


def generate_launch_description() -> LaunchDescription:
    """What `ros2 launch` runs."""
    # The input of the delay is the output of the pendulum.
    delay = fmu_node("transport_delay", "TransportDelay.fmu", {"d": 2.33}, [("x", "a")])
    pendulum = fmu_node("damped_pendulum", "DampedPendulum.fmu", {"l": 25.0, "d": 0.01}, [])
    return LaunchDescription(
        [
            after(delay, "inactive", change(pendulum, Transition.TRANSITION_CONFIGURE)),
            after(pendulum, "inactive", change(delay, Transition.TRANSITION_ACTIVATE)),
            after(delay, "active", change(pendulum, Transition.TRANSITION_ACTIVATE), start="activating"),
            delay,
            pendulum,
            change(delay, Transition.TRANSITION_CONFIGURE),
        ]
    )
