"""fmu_mesh: a service mesh for co-simulation on Eclipse Zenoh."""

__version__ = "0.1.0"

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .adapter import FMIAdapter

__all__ = ["FMIAdapter", "__version__"]


def __getattr__(name: str) -> object:
    """Import `FMIAdapter` when it is asked for, so that a node or a master does not pay for it."""
    if name == "FMIAdapter":
        from .adapter import FMIAdapter  # noqa: PLC0415 see above

        return FMIAdapter
    msg = f"module '{__name__}' has no attribute '{name}'"
    raise AttributeError(msg)
