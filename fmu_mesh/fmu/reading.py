"""Reading the model description of an FMU into the mesh's own Structs, without extracting or loading it.

Owns the judgement what can run (co-simulation of FMI 1.0, 2.0 and 3.0 with a binary for this platform) and what is only
odd: problems that a strict validator finds are kept in `ModelDescription.problems`, and the FMU runs.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

import fmpy
from fmpy.model_description import ModelDescription as FmpyDescription
from fmpy.model_description import ValidationError as FmpyValidationError
from fmpy.model_description import read_model_description

from ..errors import LoadFailed
from ..model.description import DefaultExperiment, ModelDescription
from .variables import variables_of

__all__ = ["read_description"]

_MAX_DESCRIPTION_SIZE = 64 * 2**20
_VERSIONS = ("1.0", "2.0", "3.0")


def read_description(path: Path) -> ModelDescription:
    """Read the model description of the FMU at ``path``.

    Raises:
        LoadFailed: it is no FMU, or one that cannot run here; the message says which and what would help.
    """
    names = _archive_names(path)
    if "modelDescription.xml" not in names:
        raise LoadFailed(
            f"'{path}' is a ZIP archive, but has no modelDescription.xml at its root, so it is no FMU.",
            hint="An FMU that was zipped inside a folder of its own must be zipped again without that folder.",
        )
    source, problems = _parse(path)
    version = source.fmiVersion or ""
    if not version.startswith(_VERSIONS) or "-" in version:  # 3.0-beta.1 is another interface than 3.0
        raise LoadFailed(f"'{path}' is an FMI {version} FMU; co-simulation of FMI 1.0, 2.0 and 3.0 is what can run.")
    if source.coSimulation is None:
        raise LoadFailed(f"'{path}' is for model exchange only; export it for co-simulation.")
    platforms = tuple(fmpy.supported_platforms(str(path)))
    if fmpy.platform not in platforms:
        there = ", ".join(platforms) or "no platform at all"
        raise LoadFailed(
            f"'{path}' has no binary for this platform ({fmpy.platform}); it has: {there}.",
            hint="Export it for this platform, or compile its sources into it if it has some.",
        )
    identifier = source.coSimulation.modelIdentifier
    folder = fmpy.platform_tuple if version.startswith("3.") else fmpy.platform
    library = f"binaries/{folder}/{identifier}{fmpy.sharedLibraryExtension}"
    if library not in names:
        raise LoadFailed(
            f"'{path}' has no '{library}', although its model identifier is "
            f"'{identifier}' (FMI 2.0, 2.3: the library must have that name)."
        )
    try:
        return _convert(source, _root(path), platforms, problems)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise LoadFailed(f"the modelDescription.xml of '{path}' has a value that cannot be: {error}") from error


def _archive_names(path: Path) -> frozenset[str]:
    """Names of all files in the archive."""
    try:
        with zipfile.ZipFile(path) as archive:
            for entry in archive.infolist():
                if entry.filename == "modelDescription.xml" and entry.file_size > _MAX_DESCRIPTION_SIZE:
                    raise LoadFailed(
                        f"the modelDescription.xml of '{path}' has {entry.file_size} bytes; "
                        f"the limit is {_MAX_DESCRIPTION_SIZE}."
                    )
            return frozenset(archive.namelist())
    except FileNotFoundError as error:
        raise LoadFailed(f"'{path}' does not exist.") from error
    except zipfile.BadZipFile as error:
        raise LoadFailed(f"'{path}' is no ZIP archive, so it is no FMU.") from error
    except OSError as error:
        raise LoadFailed(f"'{path}' cannot be read: {error.strerror}.") from error


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


def _root(path: Path) -> ET.Element:
    """The XML itself, for what FMPy leaves out; it was parsed before."""
    with zipfile.ZipFile(path) as archive:
        text = archive.read("modelDescription.xml")
    return ET.fromstring(text)  # noqa: S314  expat limits how far entities expand, and nothing external is resolved


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
