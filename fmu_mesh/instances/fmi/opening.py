"""From a model description to the instance that calls that version and kind of FMI."""

from __future__ import annotations

from pathlib import Path
from typing import Final, cast

from ...variables.model_description import Kind, ModelDescription
from ..contract import Instance
from ..kept_models import KeptModels
from .co_simulation.extrapolation import LinearInputs
from .co_simulation.fmi1 import Fmi1Instance
from .co_simulation.fmi2 import Fmi2Instance
from .co_simulation.fmi3 import Fmi3Instance
from .fmu_instance import FmuInstance, LogSink
from .model_exchange.continuous import Fmi1ModelInstance, Fmi2ModelInstance, Fmi3ModelInstance
from .step_options import StepOptions, Terms

__all__ = ["open_instance", "stepped"]

_CLASSES: Final[dict[tuple[str, Kind], type[FmuInstance]]] = {
    ("1", "co_simulation"): Fmi1Instance,
    ("1", "model_exchange"): Fmi1ModelInstance,
    ("2", "co_simulation"): Fmi2Instance,
    ("2", "model_exchange"): Fmi2ModelInstance,
    ("3", "co_simulation"): Fmi3Instance,
    ("3", "model_exchange"): Fmi3ModelInstance,
}


def open_instance(  # noqa: PLR0913, PLR0917 the parameters of `FmuInstance`
    path: Path,
    name: str,
    description: ModelDescription,
    folder: Path,
    log: LogSink = lambda _message: None,
    terms: Terms = Terms(),  # noqa: B008 a frozen Struct
    options: StepOptions = StepOptions(),  # noqa: B008 a frozen Struct
    kept: KeptModels | None = None,
) -> FmuInstance:
    """Extract the FMU at ``path`` below ``folder``, load it, and make the instance called ``name``.

    It has to keep to ``terms``. What an earlier instance of this name has ``kept`` is used again.
    """
    kind = cast("Kind", description.kind)
    return _CLASSES[description.fmi_version[0], kind](path, name, description, folder, log, terms, options, kept)


def stepped(instance: FmuInstance, options: StepOptions) -> Instance:
    """The instance with linear inputs if it has some; ``instance`` stays the one to close."""
    if not options.linear_inputs:
        return instance
    return LinearInputs(instance, options.linear_inputs)
