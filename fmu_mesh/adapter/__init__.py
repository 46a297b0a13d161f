"""`FMIAdapter`: one FMU for a program that steps it by itself, with the concepts of the ROS package `fmi_adapter`."""

from .adapter import FMIAdapter

__all__ = ["FMIAdapter"]
