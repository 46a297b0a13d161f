"""Worlds of the physics engine MuJoCo as instances: joints and bodies are variables.

MuJoCo is an extra and is imported when a world is opened. No other package imports it.
"""

from .mujoco_files import world_content
from .mujoco_instance import MujocoInstance
from .mujoco_world import describe_world
from .rendering import Film, Picture, Window, check_film, check_window

__all__ = [
    "Film",
    "MujocoInstance",
    "Picture",
    "Window",
    "check_film",
    "check_window",
    "describe_world",
    "world_content",
]
