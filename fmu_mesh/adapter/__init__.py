"""`FMIAdapter`: one FMU in a user's own program, with the concepts of the ROS package `fmi_adapter`."""

from .adapter import FMIAdapter
from .times import Nanoseconds

__all__ = ["FMIAdapter", "Nanoseconds"]
