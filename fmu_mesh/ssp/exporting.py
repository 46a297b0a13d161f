"""From a mesh to a package of SSP, which `fmu-mesh launch` runs with the same result, and other tools can open.

Owns what goes into a package, and what cannot. A mesh that comes from a package and was not changed keeps the documents
and files of that package (`kept_package`); any other one gets a new description (`ssd_writing`).
"""

from __future__ import annotations

import posixpath
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec

from ..config.findings import Findings
from ..config.loading import PlainConfig, read_file
from ..errors import ConfigurationError, Finding
from ..files import exists, is_file
from ..instances.fmi.fmu_kind import FmuConfig
from ..system.system import ResolvedSystem
from .own_annotation import written
from .package_writing import PackageEntry, resource_names, write_package
from .ssd_writing import ElementNames, SspVersion, ssd_of

__all__ = ["MAIN_DOCUMENT", "export"]

MAIN_DOCUMENT = "SystemStructure.ssd"
"""The description that a package is read by, unless another one is chosen (SSP 2.0, 3.1)."""


def export(
    plain: PlainConfig, resolve: Callable[[], ResolvedSystem], path: Path, version: SspVersion | None = None
) -> tuple[Finding, ...]:
    """Write a mesh as a package of SSP.

    Args:
        plain: the configuration.
        resolve: gives its instances, connections and start values; called if a new description is written.
        path: the package, which ends in `.ssp`. An older one is replaced when the new one is complete.
        version: of SSP; None: that of the package that the mesh comes from, otherwise 1.0.

    Returns:
        What the package that the mesh comes from has, and the new one has not.

    Raises:
        ConfigurationError: SSP, or this version of it, cannot say something; or a file cannot be read or written.
            Nothing is left behind.
    """
    if path.suffix.lower() != ".ssp":
        raise ConfigurationError(f"'{path}' is no name of a package", hint="Let it end in '.ssp'.")
    _write_new(plain, resolve, path, version or "1.0")
    return ()


def _write_new(
    plain: PlainConfig, resolve: Callable[[], ResolvedSystem], path: Path, version: SspVersion
) -> None:
    findings = Findings(str(plain.file), plain.lines)
    data = _with_scenario(plain, findings)
    _check_kinds(data, findings)
    _check_files(data, findings)
    findings.raise_any()
    system = resolve()
    models = {name: Path(instance.fmu) for name, instance in system.instances.items()}
    try:
        resources = resource_names(models.values())
    except OSError as error:
        raise ConfigurationError(f"'{error.filename}' cannot be read: {error.strerror}") from error
    elements, changed = _element_names(list(models))
    names = ElementNames(elements, {name: resources[model] for name, model in models.items()})
    simulation = system.config.simulation
    described: dict[str, Any] = {
        "mesh": _default_name(system.config.mesh),
        "simulation": {"start_time": simulation.start_time},
    }
    if simulation.stop_time is not None:
        described["simulation"]["stop_time"] = simulation.stop_time
    annotation = written(data, described, names=changed, moved=_from_package(plain.file))
    document = ssd_of(system, names, version, annotation, findings)
    findings.raise_any()
    files = {resource: model for model, resource in reversed(resources.items())}
    entries = [PackageEntry(MAIN_DOCUMENT, document)]
    entries += [PackageEntry(resource, files[resource]) for resource in dict.fromkeys(resources.values())]
    write_package(path, entries)


def _check_kinds(data: Mapping[str, Any], findings: Findings) -> None:
    """Add a finding for every instance that is no FMU."""
    keys = {*msgspec.structs.fields(FmuConfig)}
    del keys
    for name, section in data["instances"].items():
        if isinstance(section, dict) and "fmu" not in section:
            kind = next(iter(section), "nothing")
            found = f"'{name}', which is no FMU but of the kind '{kind}'"
            findings.add(f"instances.{name}", found, "FMUs only: SSP has no components of other kinds")
