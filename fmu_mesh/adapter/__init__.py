"""`FMIAdapter`: one FMU for a program that steps it by itself, with the concepts of the ROS package `fmi_adapter`."""

from .adapter import FMIAdapter
from .times import Nanoseconds

__all__ = ["FMIAdapter", "Nanoseconds"]
