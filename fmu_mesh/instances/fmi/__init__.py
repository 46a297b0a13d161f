"""FMUs: reading, extracting, loading and calling them. The only package that imports fmpy."""

from .archive.archive import Terms, content_of, sha256_of
from .archive.reading import read_description
from .archive.sources import describe
from .co_simulation.fmi1 import Fmi1Instance
from .co_simulation.fmi2 import Fmi2Instance
from .co_simulation.fmi3 import Fmi3Instance
from .fmu_instance import FmuInstance, LogMessage
from .opening import open_instance, stepped

__all__ = [
    "Fmi1Instance",
    "Fmi2Instance",
    "Fmi3Instance",
    "FmuInstance",
    "LogMessage",
    "Terms",
    "content_of",
    "describe",
    "open_instance",
    "read_description",
    "sha256_of",
    "stepped",
]
