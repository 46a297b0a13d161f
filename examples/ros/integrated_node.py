"""Two FMUs in one ROS node: a damped pendulum, and a delay that repeats its angle 5.5 s later.

The library example of the book chapter on `fmi_adapter`, with `fmu_mesh.FMIAdapter` and rclpy. It publishes `angle` and
`delayed_angle` every 20 ms of ROS time. Values of the FMUs are parameters of the node:

    python examples/ros/integrated_node.py --ros-args -p pendulum.l:=1.0 -p use_sim_time:=true

Every step is that of `configs/chapter_library_example.yaml`, so the floats are the same.
"""

from __future__ import annotations

from pathlib import Path

import rclpy
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import Float64

from fmu_mesh import FMIAdapter
from fmu_mesh.adapter import Nanoseconds
from fmu_mesh.ros.node import initialize_from_parameters

FMUS = Path(__file__).resolve().parents[2] / "fmus"
STEP = Duration(nanoseconds=20_000_000)
VALUES = {"pendulum": {"d": 0.001, "l": 2.0, "a": 1.3}, "delay": {"d": 5.5}}


class IntegratedNode(Node):
    """The node; all of its callbacks, and so all calls of the FMUs, are on the thread that spins it."""

    def __init__(self) -> None:
        super().__init__("fmi_adapter_examples_integrated_node")
        self.pendulum = FMIAdapter(FMUS / "DampedPendulum.fmu", STEP)
        self.delay = FMIAdapter(FMUS / "TransportDelay.fmu", STEP)
        for part, adapter in (("pendulum", self.pendulum), ("delay", self.delay)):
            for name, value in VALUES[part].items():
                adapter.set_initial_value(name, value)
            # `pendulum.d` and not `d`, because both FMUs have one.
            initialize_from_parameters(self, adapter, prefix=f"{part}.")
        self.delay.set_initial_value("x", self.pendulum.get_output_value("a"))
        self.angle = self.create_publisher(Float64, "angle", 1000)
        self.delayed_angle = self.create_publisher(Float64, "delayed_angle", 1000)
        self.timer = self.create_timer(STEP.nanoseconds / 1e9, self.step)

    def step(self) -> None:
        """Bring both FMUs to the present, step by step, and publish every one."""
        now = self.get_clock().now()
        if self.pendulum.is_in_initialization_mode:
            self.pendulum.exit_initialization_mode(now)
            self.delay.exit_initialization_mode(now)
        while now.nanoseconds - self.pendulum.simulation_time_ns >= STEP.nanoseconds:
            self.pendulum.do_step()
            angle = self.pendulum.get_output_value("a")
            # Inputs are read where a step starts: stamped with its end, the angle would reach the delay one step late.
            self.delay.set_input_value("x", Nanoseconds(self.delay.simulation_time_ns), angle)
            self.delay.do_step()
            self.angle.publish(Float64(data=angle))
            self.delayed_angle.publish(Float64(data=self.delay.get_output_value("y")))

    def close(self) -> None:
        """Free the FMUs."""
        self.pendulum.close()
        self.delay.close()


def main() -> None:
    """Run the node until ROS is shut down."""
    rclpy.init()
    node = IntegratedNode()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception:
        if rclpy.ok():  # else ROS was shut down in the middle of a step
            raise
    finally:
        node.close()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
