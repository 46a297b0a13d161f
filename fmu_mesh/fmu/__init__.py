"""FMUs: reading, extracting, loading and calling them. The only package that imports fmpy."""

from .fmi2 import Fmi2Instance, LogMessage
from .reading import read_description

__all__ = ["Fmi2Instance", "LogMessage", "read_description"]
