"""FMUs: reading, extracting, loading and calling them. The only package that imports fmpy."""

from .archive import Terms, sha256_of
from .examining import PLATFORM
from .fmi2 import Fmi2Instance, LogMessage
from .reading import read_description
from .sources import compile_sources

__all__ = [
    "PLATFORM",
    "Fmi2Instance",
    "LogMessage",
    "Terms",
    "compile_sources",
    "read_description",
    "sha256_of",
]
