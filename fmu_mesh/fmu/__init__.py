"""FMUs: reading, extracting, loading and calling them. The only package that imports fmpy."""

from .fmi1 import Fmi1Instance
from .fmi2 import Fmi2Instance
from .fmi3 import Fmi3Instance
from .instance import FmuInstance, LogMessage
from .opening import open_instance
from .reading import read_description

__all__ = [
    "Fmi1Instance",
    "Fmi2Instance",
    "Fmi3Instance",
    "FmuInstance",
    "LogMessage",
    "open_instance",
    "read_description",
]
