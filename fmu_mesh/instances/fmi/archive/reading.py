"""Reads the model description of an FMU into our own Structs, without unpacking or loading the FMU.

Decides which FMUs can run: those of FMI 1.0, 2.0 and 3.0 with a library or sources for this platform. Problems that a
strict validator finds do not keep an FMU from running; they are kept in `ModelDescription.problems`.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import Any, Final, Literal, cast
from zipfile import ZipFile, ZipInfo

import fmpy
from fmpy.model_description import ModelDescription as FmpyDescription
from fmpy.model_description import read_model_description
from fmpy.validation import validate_model_description
from msgspec.structs import replace

from ....errors import LoadFailed
from ....variables.model_description import Causality, Clock, DefaultExperiment, Kind, ModelDescription, runs_of
from ..step_options import Terms
from .archive import Contents, OpenFmu, opened
from .declared_variables import number, states_of, variables_of
from .examining import examine, find_library, library_name, names_here

__all__ = ["description_of", "parsed", "read_description"]

_WORDS: Final[dict[Kind, str]] = {"co_simulation": "co-simulation", "model_exchange": "model exchange"}


def read_description(
    path: Path,
    terms: Terms = Terms(),  # noqa: B008 a frozen Struct
    kind: Literal["auto"] | Kind = "auto",
    *,
    to_run: bool = True,
) -> ModelDescription:
    """Read the model description of the FMU at ``path``, a file or a folder; `LoadFailed` says why there is none.

    ``kind`` is the kind to use, for ``auto`` co-simulation if the FMU has both; with ``to_run`` it must be able to run
    on this platform.
    """
    with opened(path, terms) as fmu:
        return description_of(fmu, kind, to_run=to_run)


def description_of(
    fmu: OpenFmu, kind: Literal["auto"] | Kind = "auto", *, to_run: bool = True, in_sandbox: bool = False
) -> ModelDescription:
    """As `read_description`, for an FMU that is open; ``in_sandbox`` of WebAssembly, where no library of it runs."""
    path = fmu.path
    contents, root, problems = examine(fmu)
    source = parsed(path, contents)
    version = source.fmiVersion or ""
    kind = _kind(source, kind, path)
    if kind == "model_exchange" and version != "1.0" and root.find("ModelStructure") is None:
        raise LoadFailed(
            f"the modelDescription.xml of '{path}' has no ModelStructure, which has its continuous states."
        )
    platforms = tuple(fmpy.supported_platforms(_readable(contents)))
    for unknown in ("aarch64-linux", "wasm32-wasip2"):  # to FMPy
        if any(name.startswith(f"binaries/{unknown}") for name in contents.names):
            platforms += (unknown,)
    interfaces = [_interface(source, kind), *(_interface(source, other) for other in _WORDS if other != kind)]
    identifiers = [one.modelIdentifier or "" for one in interfaces if one is not None]
    names = names_here(fmu, contents.names, version) if to_run else frozenset()
    library = find_library(path, names, identifiers, version, in_sandbox=in_sandbox) if to_run else None
    runs = runs_of(library)
    if library is not None and library != (wanted := library_name(identifiers[0], version, names, runs)):
        what = (
            f"is not named as FMI demands, '{wanted}'" if identifiers[0] else "is all that tells the model identifier"
        )
        problems = (*problems, f"the library '{library}' {what}")
    for variable, element in zip(source.modelVariables, root.iterfind("ModelVariables/*"), strict=False):
        variable.sourceline = element.sourceline  # that of the file, which has other lines than the repaired text
    try:
        description = _convert(source, kind, root, platforms, (*problems, *validate_model_description(source)))
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise _unreadable(path) from error
    identifier = identifiers[0] or (PurePosixPath(library).stem if library is not None else "")
    return replace(description, model_identifier=identifier, library=library)


def _kind(source: FmpyDescription, wanted: str, path: Path) -> Kind:
    """The kind to use: the wanted one; for `auto` the first that the FMU has, co-simulation before model exchange."""
    there = [kind for kind in _WORDS if _interface(source, kind) is not None]
    for kind in there:
        if wanted in ("auto", kind):
            return kind
    has = _WORDS[there[0]] if there else "scheduled execution"
    missed = next((words for kind, words in _WORDS.items() if kind == wanted), "co-simulation or model exchange")
    if not there and source.scheduledExecution is None:
        raise LoadFailed(
            f"the modelDescription.xml of '{path}' declares no kind of FMU: it has neither a <CoSimulation> nor a "
            "<ModelExchange>.",
            hint="Export it again as an FMU for co-simulation.",
        )
    raise LoadFailed(
        f"'{path}' is for {has} only, not for {missed}.",
        hint="`kind: auto` uses the kind that the FMU has." if there else None,
    )


def _interface(source: FmpyDescription, kind: Kind) -> Any:  # noqa: ANN401 FMPy is untyped
    return source.coSimulation if kind == "co_simulation" else source.modelExchange


def _readable(contents: Contents) -> BytesIO:
    """What FMPy reads an FMU from: an archive with names and XML as it understands them."""
    archive = BytesIO()
    with ZipFile(archive, "w") as file:
        for name in contents.names:
            if name in contents.xml or name.startswith(("binaries/", "sources/")):
                file.writestr(ZipInfo(name), contents.xml.get(name, b""))
    return archive


def parsed(path: Path, contents: Contents) -> FmpyDescription:
    """FMPy's model description, from what `examine` has returned; `LoadFailed` if it breaks a rule beyond repair."""
    try:
        return read_model_description(_readable(contents), validate=False)
    except Exception as error:  # FMPy raises whatever the XML provokes in it
        raise _unreadable(path) from error


def _unreadable(path: Path) -> LoadFailed:
    return LoadFailed(
        f"the modelDescription.xml of '{path}' breaks a rule of FMI in a way that keeps it from being read.",
        hint="Report it to the maker of its tool; `--debug` shows where the reading ended.",
    )


def _convert(
    source: FmpyDescription, kind: Kind, root: ET.Element, platforms: tuple[str, ...], problems: tuple[str, ...]
) -> ModelDescription:
    interface = _interface(source, kind)
    experiment = source.defaultExperiment
    capabilities = root.find("Implementation/*/Capabilities")  # FMPy does not read those of FMI 1.0
    internal = root.find("CoSimulation[@fixedInternalStepSize]")  # nor this attribute of FMI 3.0

    def can(attribute: str) -> bool:
        if capabilities is not None:
            return capabilities.get(attribute) in ("true", "1")
        return bool(getattr(interface, attribute, False))

    return ModelDescription(
        model_name=source.modelName or "",
        model_identifier=interface.modelIdentifier or "",
        fmi_version=source.fmiVersion or "",
        kind=kind,
        guid=source.guid or "",
        variables=variables_of(source, root),
        description=source.description,
        generation_tool=source.generationTool,
        default_experiment=DefaultExperiment(
            start_time=number(getattr(experiment, "startTime", None)),
            stop_time=number(getattr(experiment, "stopTime", None)),
            step_size=number(getattr(experiment, "stepSize", None)),
            tolerance=number(getattr(experiment, "tolerance", None)),
        ),
        can_handle_variable_step_size=can("canHandleVariableCommunicationStepSize"),
        can_reject_steps=can("canRejectSteps"),
        can_interpolate_inputs=can("canInterpolateInputs"),
        has_event_mode=can("hasEventMode"),
        can_get_and_set_state=bool(interface.canGetAndSetFMUstate),
        can_serialize_state=bool(interface.canSerializeFMUstate),
        only_once_per_process=can("canBeInstantiatedOnlyOncePerProcess"),
        needs_execution_tool=bool(interface.needsExecutionTool)
        or root.find("Implementation/CoSimulation_Tool") is not None,
        # FMI 1.0 has no flag for this and always requires the call.
        tell_completed_steps=can("needsCompletedIntegratorStep") or (source.fmiVersion or "").startswith("1."),
        states=states_of(source),
        continuous_states=int(source.numberOfContinuousStates),
        event_indicators=int(source.numberOfEventIndicators),
        clocks=tuple(map(_clock, root.iterfind("ModelVariables/Clock"))),
        platforms=platforms,
        kinds=tuple(one for one in _WORDS if _interface(source, one) is not None),
        problems=problems,
        fixed_step_size=number(internal.get("fixedInternalStepSize")) if internal is not None else None,
    )


def _clock(element: ET.Element) -> Clock:
    """A clock; an interval given as a fraction is counted in units of its resolution (FMI 3.0, 2.2.8.4)."""
    interval, shift = number(element.get("intervalDecimal")), number(element.get("shiftDecimal"))
    counter, resolution = element.get("intervalCounter"), element.get("resolution")
    if counter is not None and resolution is not None and int(resolution):
        interval, shift = int(counter) / int(resolution), int(element.get("shiftCounter", 0)) / int(resolution)
    return Clock(
        name=element.attrib["name"],
        value_reference=int(element.attrib["valueReference"]),
        causality=cast("Causality", element.get("causality", "local")),
        interval_variability=element.get("intervalVariability", "triggered"),
        interval=interval,
        shift=shift or 0.0,
    )
