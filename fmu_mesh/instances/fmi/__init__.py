"""FMUs: reading, extracting, loading and calling them. The only package that imports fmpy.

The names of this package are imported when they are used: FMPy is slow to import, and a configuration can be read
without it.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..contract import LogMessage
    from .archive.archive import Terms, content_of, sha256_of, size_of
    from .archive.reading import read_description
    from .archive.sources import describe
    from .archive.system_libraries import missing_libraries
    from .co_simulation.fmi1 import Fmi1Instance
    from .co_simulation.fmi2 import Fmi2Instance
    from .co_simulation.fmi3 import Fmi3Instance
    from .fmu_instance import FmuInstance
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
    "missing_libraries",
    "open_instance",
    "read_description",
    "sha256_of",
    "size_of",
    "stepped",
]

_MODULES = {
    "Fmi1Instance": ".co_simulation.fmi1",
    "Fmi2Instance": ".co_simulation.fmi2",
    "Fmi3Instance": ".co_simulation.fmi3",
    "FmuInstance": ".fmu_instance",
    "LogMessage": "..contract",
    "Terms": ".archive.archive",
    "content_of": ".archive.archive",
    "describe": ".archive.sources",
    "missing_libraries": ".archive.system_libraries",
    "open_instance": ".opening",
    "read_description": ".archive.reading",
    "sha256_of": ".archive.archive",
    "size_of": ".archive.archive",
    "stepped": ".opening",
}


def __getattr__(name: str) -> object:
    """Import a name of this package."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name], __name__), name)
