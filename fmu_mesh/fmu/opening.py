"""From a model description to the instance that calls that version of FMI."""

from __future__ import annotations

from pathlib import Path

from ..model.description import ModelDescription
from .fmi1 import Fmi1Instance
from .fmi2 import Fmi2Instance
from .fmi3 import Fmi3Instance
from .instance import FmuInstance, LogSink

__all__ = ["open_instance"]

_BY_VERSION: dict[str, type[FmuInstance]] = {"1": Fmi1Instance, "2": Fmi2Instance, "3": Fmi3Instance}


def open_instance(
    path: Path,
    name: str,
    description: ModelDescription,
    folder: Path,
    log: LogSink = lambda _message: None,
) -> FmuInstance:
    """Extract the FMU at ``path`` below ``folder``, load it, and make the instance called ``name``.

    Raises:
        LoadFailed: the FMU cannot be extracted, loaded or instantiated.
    """
    return _BY_VERSION[description.fmi_version[0]](path, name, description, folder, log)
