"""Worlds of the simulator Gazebo classic 11 as instances: joints and links are variables. Gazebo is a process."""

from .gazebo_classic import GazeboClassicInstance, check_gazebo_classic
from .gazebo_world import describe_gazebo_world

__all__ = ["GazeboClassicInstance", "check_gazebo_classic", "describe_gazebo_world"]
