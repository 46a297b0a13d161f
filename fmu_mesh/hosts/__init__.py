"""What acts as an instance without being an FMU: a physics engine, and the controller of a joint.

Each is an `Instance` with a model description of its own, so that checks, plans, nodes and tools treat it as an FMU.
MuJoCo is an extra and is imported when a world is opened; nothing else of the package imports it. Gazebo is a process.
"""

from .gazebo_classic import GazeboClassicInstance, check_gazebo_classic
from .gazebo_world import describe_gazebo_world
from .mujoco import MujocoInstance
from .mujoco_files import world_content
from .mujoco_model import describe_world
from .pid import PidInstance, describe_pid
from .rendering import Film, Picture, Window, check_film, check_window

__all__ = [
    "Film",
    "GazeboClassicInstance",
    "MujocoInstance",
    "Picture",
    "PidInstance",
    "Window",
    "check_film",
    "check_gazebo_classic",
    "check_window",
    "describe_gazebo_world",
    "describe_pid",
    "describe_world",
    "world_content",
]
