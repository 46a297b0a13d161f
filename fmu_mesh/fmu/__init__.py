"""FMUs: reading, extracting, loading and calling them. The only package that imports fmpy."""

from .archive import Terms, content_of, sha256_of
from .fmi1 import Fmi1Instance
from .fmi2 import Fmi2Instance
from .fmi3 import Fmi3Instance
from .instance import FmuInstance, LogMessage
from .opening import open_instance, stepped
from .reading import read_description
from .sources import compile_sources

__all__ = [
    "Fmi1Instance",
    "Fmi2Instance",
    "Fmi3Instance",
    "FmuInstance",
    "LogMessage",
    "Terms",
    "compile_sources",
    "content_of",
    "open_instance",
    "read_description",
    "sha256_of",
    "stepped",
]
