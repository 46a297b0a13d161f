"""ROS simulators that are stepped through `simulation_interfaces`."""
