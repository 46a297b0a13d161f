"""Reading the model description of an FMU into the mesh's own Structs, without extracting or loading it.

Owns the judgement what can run (co-simulation of FMI 1.0, 2.0 and 3.0 with a binary for this platform) and what is only
odd: problems that a strict validator finds are kept in `ModelDescription.problems`, and the FMU runs.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import fmpy
from fmpy.model_description import ModelDescription as FmpyDescription
from fmpy.model_description import ValidationError as FmpyValidationError
from fmpy.model_description import read_model_description

from ..errors import LoadFailed
from ..model.description import DefaultExperiment, ModelDescription
from .archive import Terms
from .examining import examine, require_library
from .variables import variables_of

__all__ = ["read_description"]

_VERSIONS = ("1.0", "2.0", "3.0")


def read_description(
    path: Path,
    terms: Terms = Terms(),  # noqa: B008 a frozen Struct
    *,
    to_run: bool = True,
) -> ModelDescription:
    """Read the model description of the FMU at ``path``.

    Args:
        path: the .fmu file, or the folder of an unpacked one.
        terms: what it has to keep to.
        to_run: whether it must be able to run on this platform.

    Raises:
        LoadFailed: it is no FMU, or one that cannot run here; the message says which and what would help.
    """
    contents = examine(path, terms)
    source, problems = _parse(path)
    version = source.fmiVersion or ""
    if not version.startswith(_VERSIONS) or "-" in version:  # 3.0-beta.1 is another interface than 3.0
        raise LoadFailed(f"'{path}' is an FMI {version} FMU; co-simulation of FMI 1.0, 2.0 and 3.0 is what can run.")
    if source.coSimulation is None:
        raise LoadFailed(f"'{path}' is for model exchange only; export it for co-simulation.")
    platforms = tuple(fmpy.supported_platforms(str(path)))
    if to_run:
        require_library(path, contents.names, source.coSimulation.modelIdentifier or "", version)
    root = ET.fromstring(contents.xml["modelDescription.xml"])  # noqa: S314 - `examine` has found it safe
    try:
        return _convert(source, root, platforms, problems)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise LoadFailed(f"the modelDescription.xml of '{path}' has a value that cannot be: {error}") from error


def _parse(path: Path) -> tuple[FmpyDescription, tuple[str, ...]]:
    """FMPy's model description, and what a strict validation of it finds."""
    try:
        return read_model_description(str(path), validate=True), ()
    except FmpyValidationError as error:
        problems = tuple(str(problem) for problem in error.problems)
    except Exception as error:  # noqa: BLE001 FMPy and lxml raise whatever the XML provokes in them
        problems = (str(error),)
    try:
        return read_model_description(str(path), validate=False), problems
    except Exception as error:
        raise LoadFailed(f"the modelDescription.xml of '{path}' cannot be read: {error}") from error


def _convert(
    source: FmpyDescription, root: ET.Element, platforms: tuple[str, ...], problems: tuple[str, ...]
) -> ModelDescription:
    co_simulation = source.coSimulation
    experiment = source.defaultExperiment
    capabilities = root.find("Implementation/*/Capabilities")  # of FMI 1.0, which FMPy does not read

    def can(attribute: str) -> bool:
        if capabilities is not None:
            return capabilities.get(attribute) in ("true", "1")
        return bool(getattr(co_simulation, attribute))

    return ModelDescription(
        model_name=source.modelName or "",
        model_identifier=co_simulation.modelIdentifier,
        fmi_version=source.fmiVersion or "",
        kind="co_simulation",
        guid=source.guid or "",
        variables=variables_of(source, root),
        description=source.description,
        generation_tool=source.generationTool,
        default_experiment=DefaultExperiment(
            start_time=_number(getattr(experiment, "startTime", None)),
            stop_time=_number(getattr(experiment, "stopTime", None)),
            step_size=_number(getattr(experiment, "stepSize", None)),
            tolerance=_number(getattr(experiment, "tolerance", None)),
        ),
        can_handle_variable_step_size=can("canHandleVariableCommunicationStepSize"),
        has_event_mode=bool(co_simulation.hasEventMode),
        can_get_and_set_state=bool(co_simulation.canGetAndSetFMUstate),
        can_serialize_state=bool(co_simulation.canSerializeFMUstate),
        only_once_per_process=can("canBeInstantiatedOnlyOncePerProcess"),
        needs_execution_tool=bool(co_simulation.needsExecutionTool)
        or root.find("Implementation/CoSimulation_Tool") is not None,
        platforms=platforms,
        problems=problems,
    )


def _number(text: str | float | None) -> float | None:
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        return None
