"""fmu_mesh: a service mesh for co-simulation on Eclipse Zenoh."""

__version__ = "0.1.0"

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .adapter import FMIAdapter
    from .instances.python.component import Component, component
    from .instances.python.declarations import Input, Output, Parameter

__all__ = ["Component", "FMIAdapter", "Input", "Output", "Parameter", "__version__", "component"]


def __getattr__(name: str) -> object:
    """Import what is asked for only now, so that a node or a master does not pay for it."""
    if name == "FMIAdapter":
        from .adapter import FMIAdapter  # noqa: PLC0415 see above

        return FMIAdapter
    if name in {"Component", "component"}:
        from .instances.python import component as components  # noqa: PLC0415 see above

        return getattr(components, name)
    if name in {"Input", "Output", "Parameter"}:
        from .instances.python import declarations  # noqa: PLC0415 see above

        return getattr(declarations, name)
    msg = f"module '{__name__}' has no attribute '{name}'"
    raise AttributeError(msg)
