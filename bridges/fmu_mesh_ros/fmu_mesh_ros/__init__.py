"""fmu_mesh for those who start things with `ros2 run` and `ros2 launch`."""
