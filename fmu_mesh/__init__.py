"""fmu_mesh: a service mesh for co-simulation on Eclipse Zenoh.

>>> import fmu_mesh
>>> result = fmu_mesh.load("configs/pendulum_delay.yaml").run(stop_time=1.0, record="memory")
>>> result["delay.y"].shape
(501,)
"""

__version__ = "0.3.0"

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .adapter import FMIAdapter
    from .api.attaching import attach, meshes
    from .api.batch import Batch
    from .api.comparison import Comparison
    from .api.inspection import Inspection, inspect
    from .api.mesh_builder import Mesh, load
    from .api.mesh_check import Check
    from .api.open_system import System
    from .api.package_inspection import PackageInspection, inspect_package
    from .api.rerunning import rerun
    from .api.result import Result
    from .api.run_handle import Run
    from .api.samples import Sample
    from .api.simulating import simulate
    from .api.system_state import BatchState, SystemState
    from .errors import (
        CallRefused,
        ConfigurationError,
        DeadlineExceeded,
        Finding,
        FmuError,
        FmuMeshError,
        FrameGap,
        InitializationFailed,
        Interrupted,
        KeyboardInterrupted,
        LibraryMissing,
        LoadFailed,
        LoopNotConverged,
        MeshLost,
        NotFinite,
        ProtocolBroken,
        StepFailed,
        UnknownName,
    )
    from .instances.outside.program import Importer, attach_as
    from .instances.python.component import Component, component
    from .instances.python.declarations import Input, Output, Parameter
    from .pictures.system_graph import SystemGraph
    from .results.formats import recover
    from .sweeps.convergence import Convergence
    from .sweeps.sweep_result import SweepResult
    from .sweeps.sweeping import Sweep, sweep
    from .sweeps.variants import Range

__all__ = [
    "Batch",
    "BatchState",
    "CallRefused",
    "Check",
    "Comparison",
    "Component",
    "ConfigurationError",
    "Convergence",
    "DeadlineExceeded",
    "FMIAdapter",
    "Finding",
    "FmuError",
    "FmuMeshError",
    "FrameGap",
    "Importer",
    "InitializationFailed",
    "Input",
    "Inspection",
    "Interrupted",
    "KeyboardInterrupted",
    "LibraryMissing",
    "LoadFailed",
    "LoopNotConverged",
    "Mesh",
    "MeshLost",
    "NotFinite",
    "Output",
    "PackageInspection",
    "Parameter",
    "ProtocolBroken",
    "Range",
    "Result",
    "Run",
    "Sample",
    "StepFailed",
    "Sweep",
    "SweepResult",
    "System",
    "SystemGraph",
    "SystemState",
    "UnknownName",
    "__version__",
    "attach",
    "attach_as",
    "component",
    "inspect",
    "inspect_package",
    "load",
    "meshes",
    "recover",
    "rerun",
    "simulate",
    "sweep",
]

_NAMES = {
    "adapter": ("FMIAdapter",),
    "api.attaching": ("attach", "meshes"),
    "api.batch": ("Batch",),
    "api.comparison": ("Comparison",),
    "api.inspection": ("Inspection", "inspect"),
    "api.mesh_builder": ("Mesh", "load"),
    "api.mesh_check": ("Check",),
    "api.open_system": ("System",),
    "api.package_inspection": ("PackageInspection", "inspect_package"),
    "results.formats": ("recover",),
    "api.rerunning": ("rerun",),
    "api.result": ("Result",),
    "api.run_handle": ("Run",),
    "api.samples": ("Sample",),
    "api.simulating": ("simulate",),
    "api.system_state": ("BatchState", "SystemState"),
    "instances.outside.program": ("Importer", "attach_as"),
    "instances.python.component": ("Component", "component"),
    "instances.python.declarations": ("Input", "Output", "Parameter"),
    "pictures.system_graph": ("SystemGraph",),
    "sweeps.convergence": ("Convergence",),
    "sweeps.sweep_result": ("SweepResult",),
    "sweeps.sweeping": ("Sweep", "sweep"),
    "sweeps.variants": ("Range",),
}
"""The public names by their modules; all others are exceptions."""

_OF_POSIX = ("fcntl", "resource", "pwd", "termios")


def __getattr__(name: str) -> object:
    """Import a public name when it is first used, so that a node or a master does not pay for it."""
    if name not in __all__:
        msg = f"module '{__name__}' has no attribute '{name}'"
        raise AttributeError(msg)
    from importlib import import_module  # noqa: PLC0415 see above

    module = next((module for module, names in _NAMES.items() if name in names), "errors")
    try:
        value = getattr(import_module(f"{__name__}.{module}"), name)
    except ModuleNotFoundError as error:
        if error.name not in _OF_POSIX:
            raise
        from .errors import ConfigurationError  # noqa: PLC0415 as above

        raise ConfigurationError(
            f"fmu_mesh.{name} needs Linux: this system has no module `{error.name}`",
            hint="On Windows, the Windows Subsystem for Linux (WSL 2) runs it.",
        ) from error
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
