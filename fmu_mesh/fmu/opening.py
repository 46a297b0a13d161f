"""From a model description to the instance that calls that version of FMI."""

from __future__ import annotations

from pathlib import Path

from ..model.description import ModelDescription
from .archive import Terms
from .fmi1 import Fmi1Instance
from .fmi2 import Fmi2Instance
from .fmi3 import Fmi3Instance
from .instance import FmuInstance, LogSink

__all__ = ["open_instance"]

_BY_VERSION: dict[str, type[FmuInstance]] = {"1": Fmi1Instance, "2": Fmi2Instance, "3": Fmi3Instance}


def open_instance(  # noqa: PLR0913, PLR0917  what an FMU is opened with
    path: Path,
    name: str,
    description: ModelDescription,
    folder: Path,
    log: LogSink = lambda _message: None,
    terms: Terms = Terms(),  # noqa: B008 a frozen Struct
) -> FmuInstance:
    """Extract the FMU at ``path`` below ``folder``, load it, and make the instance called ``name``.

    It has to keep to ``terms``.

    Raises:
        LoadFailed: the FMU cannot be extracted, loaded or instantiated.
    """
    return _BY_VERSION[description.fmi_version[0]](path, name, description, folder, log, terms)
