"""Reading the model description of an FMU into the mesh's own Structs, without extracting or loading it.

Owns the judgement what can run (FMI 2.0 co-simulation with a binary for this platform) and what is only odd: problems
that a strict validator finds are kept in `ModelDescription.problems`, and the FMU runs.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Literal

import fmpy
from fmpy.model_description import ModelDescription as FmpyDescription
from fmpy.model_description import ModelVariable, read_model_description
from fmpy.model_description import ValidationError as FmpyValidationError
from msgspec.structs import replace

from ..errors import LoadFailed
from ..model.description import DefaultExperiment, Kind, ModelDescription, Value, Variable, VariableType
from .reading_clocks import read_clocks

__all__ = ["read_description"]

_MAX_DESCRIPTION_SIZE = 64 * 2**20
_TYPES: dict[str, VariableType] = {
    "Real": "Float64",
    "Integer": "Int32",
    "Boolean": "Boolean",
    "String": "String",
    "Enumeration": "Enumeration",
    "Float64": "Float64",
    "Int32": "Int32",
}


def read_description(path: Path, kind: Literal["auto"] | Kind = "auto") -> ModelDescription:
    """Read the model description of the FMU at ``path``.

    Args:
        path: the .fmu file.
        kind: which kind of it is wanted; ``auto``: co-simulation if it has both.

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
    if source.fmiVersion is None or not source.fmiVersion.startswith(("1.", "2.", "3.")):
        raise LoadFailed(f"'{path}' is an FMI {source.fmiVersion} FMU; FMI 2.0 co-simulation is what can run today.")
    kind = _kind(source, kind, path)
    interface = source.coSimulation if kind == "co_simulation" else source.modelExchange
    platforms = tuple(fmpy.supported_platforms(str(path)))
    if fmpy.platform not in platforms and "x86_64-linux" not in platforms:
        there = ", ".join(platforms) or "no platform at all"
        raise LoadFailed(
            f"'{path}' has no binary for this platform ({fmpy.platform}); it has: {there}.",
            hint="Export it for this platform, or compile its sources into it if it has some.",
        )
    folder = fmpy.platform if not source.fmiVersion.startswith("3.") else "x86_64-linux"
    library = f"binaries/{folder}/{interface.modelIdentifier}{fmpy.sharedLibraryExtension}"
    if library not in names:
        raise LoadFailed(
            f"'{path}' has no '{library}', although its model identifier is "
            f"'{interface.modelIdentifier}' (FMI 2.0, 2.3: the library must have that name)."
        )
    description = _convert(source, kind, platforms, problems)
    if any(variable.type == "Clock" for variable in source.modelVariables):
        return replace(description, clocks=read_clocks(path))
    return description


def _kind(source: FmpyDescription, wanted: str, path: Path) -> Kind:
    """The kind to use: the wanted one, or the one that there is; co-simulation comes first."""
    there: dict[Kind, bool] = {
        "co_simulation": source.coSimulation is not None,
        "model_exchange": source.modelExchange is not None,
    }
    for kind, is_there in there.items():
        if is_there and wanted in ("auto", kind):
            return kind
    has = " and ".join(kind for kind, is_there in there.items() if is_there).replace("_", " ")
    raise LoadFailed(
        f"'{path}' is for {has or 'scheduled execution'} only, not for {wanted.replace('_', ' ')}.",
        hint="`kind: auto` takes what there is." if has else None,
    )


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


def _convert(
    source: FmpyDescription, kind: Kind, platforms: tuple[str, ...], problems: tuple[str, ...]
) -> ModelDescription:
    interface = source.coSimulation if kind == "co_simulation" else source.modelExchange
    experiment = source.defaultExperiment
    dependencies = {
        unknown.variable.name: None
        if unknown.dependencies is None
        else tuple(variable.name for variable in unknown.dependencies)
        for unknown in source.initialUnknowns
        if unknown.variable is not None
    }
    return ModelDescription(
        model_name=source.modelName or "",
        model_identifier=interface.modelIdentifier,
        fmi_version=source.fmiVersion or "",
        kind=kind,
        guid=source.guid or "",
        variables=tuple(
            _variable(variable, dependencies, one=(source.fmiVersion or "").startswith("1."))
            for variable in source.modelVariables
            if variable.type in _TYPES
        ),
        description=source.description,
        generation_tool=source.generationTool,
        default_experiment=DefaultExperiment(
            start_time=_number(getattr(experiment, "startTime", None)),
            stop_time=_number(getattr(experiment, "stopTime", None)),
            step_size=_number(getattr(experiment, "stepSize", None)),
            tolerance=_number(getattr(experiment, "tolerance", None)),
        ),
        can_handle_variable_step_size=bool(getattr(interface, "canHandleVariableCommunicationStepSize", True)),
        can_get_and_set_state=bool(interface.canGetAndSetFMUstate),
        can_serialize_state=bool(interface.canSerializeFMUstate),
        only_once_per_process=bool(interface.canBeInstantiatedOnlyOncePerProcess),
        needs_execution_tool=bool(interface.needsExecutionTool),
        can_interpolate_inputs=bool(getattr(interface, "canInterpolateInputs", False)),
        has_event_mode=bool(getattr(interface, "hasEventMode", False)),
        # FMI 1.0 has no flag for it, and wants to be told.
        tell_completed_steps=bool(getattr(interface, "needsCompletedIntegratorStep", False))
        or (source.fmiVersion or "").startswith("1."),
        continuous_states=int(source.numberOfContinuousStates),
        event_indicators=int(source.numberOfEventIndicators),
        platforms=platforms,
        problems=problems,
    )


def _variable(source: ModelVariable, dependencies: dict[str, tuple[str, ...] | None], *, one: bool) -> Variable:
    """A variable; ``one``: of FMI 1.0."""
    type_ = _TYPES[source.type]
    declared = source.declaredType
    items = tuple((item.name, int(item.value)) for item in declared.items) if declared and declared.items else ()
    return Variable(
        name=source.name,
        value_reference=int(source.valueReference),
        type=type_,
        declared_type=source.type,
        causality=source.causality or "local",
        variability=source.variability or ("continuous" if type_ == "Float64" else "discrete"),
        # FMI 1.0 has no `initial`: what has a start value may be given another one.
        initial=source.initial or ("exact" if one and source.start is not None else None),
        start=_start(type_, source.start),
        unit=source.unit or (declared.unit if declared is not None else None),
        description=source.description,
        minimum=_number(source.min),
        maximum=_number(source.max),
        dependencies=dependencies.get(source.name, ()),
        items=items,
    )


def _number(text: str | float | None) -> float | None:
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        pass
    return None


def _start(type_: VariableType, text: str | None) -> Value | None:
    """The start value as a Python value, or None if there is none or it is not of the type."""
    if text is None:
        return None
    try:
        match type_:
            case "Float64":
                return float(text)
            case "Int32" | "Enumeration":
                return int(text)
            case "Boolean":
                return text in ("true", "1")
            case "String":
                return text
    except ValueError:
        pass
    return None
