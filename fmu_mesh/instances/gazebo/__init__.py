"""Worlds of the simulator Gazebo classic 11 as instances: joints and links are variables. Gazebo is a process."""
