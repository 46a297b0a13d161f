"""FMUs: reading, extracting, loading and calling them. The only package that imports fmpy."""

from .fmi2 import Fmi2Instance
from .instance import FmuInstance, LogMessage
from .opening import open_fmu, stepped
from .reading import read_description

__all__ = ["Fmi2Instance", "FmuInstance", "LogMessage", "open_fmu", "read_description", "stepped"]
