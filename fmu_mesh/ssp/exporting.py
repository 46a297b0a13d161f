"""From a mesh to a package of SSP, which `fmu-mesh launch` runs with the same result, and other tools can open.

Owns what goes into a package, and what cannot. A mesh that comes from a package and was not changed keeps the documents
and files of that package (`kept_package`); any other one gets a new description (`ssd_writing`).
"""

from __future__ import annotations

import json
import posixpath
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from ..config.findings import Findings
from ..config.loading import PlainConfig, read_file
from ..config.mesh import Config
from ..errors import ConfigurationError, Finding, LoadFailed
from ..files import archive_on_the_way, beside, is_file, is_folder
from ..system.system import ResolvedSystem
from ..text import nearest_file
from .document_changes import own_annotation_in, with_own_annotation
from .kept_package import KeptPackage, kept_package
from .naming import element_path, instance_name, mesh_name
from .own_annotation import names_in, without, written
from .package import DEFAULT
from .package_writing import PackageEntry, resource_names, write_package
from .ssd_writing import ElementNames, SspVersion, ssd_of
from .system_reading import read_system
from .xml_writing import is_xml_text

__all__ = ["export"]

_OF_CONNECTIONS: Final = ("from", "to", "factor", "offset", "ignore_units", "map")
"""The keys of a connection that SSP can say."""


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
    kept = kept_package(plain)
    if kept is not None and (version is None or kept.is_of(version)):
        original = _read_again(kept)
        if _is_unchanged(plain, original):
            return _write_copy(plain, original, kept, path)
    units = _write_new(plain, resolve, path, version or "1.0")
    return kept.lost(units) if kept is not None else ()


def _read_again(kept: KeptPackage) -> PlainConfig:
    """The configuration of a package as it is on the disk.

    Raises:
        ConfigurationError: it is wrong; has all findings.
    """
    original = read_system(kept.root / kept.name) if is_folder(kept.root) else read_system(kept.root, kept.name)
    Findings(kept.shown, first=original.findings).raise_any()
    return original


def _is_unchanged(plain: PlainConfig, original: PlainConfig) -> bool:
    """Whether a configuration has the instances, start values and connections of a package, in their order."""
    return json.dumps(_content(plain.data)) == json.dumps(_content(original.data))


def _content(data: Any) -> list[Any]:  # noqa: ANN401  values of a file
    """What a configuration says that SSP can say."""
    instances = [
        (name, section.get("fmu"), section.get("kind", "auto"), section.get("start_values") or {})
        for name, section in data.get("instances", {}).items()
    ]
    connections = [
        {key: value for key, value in one.items() if key in _OF_CONNECTIONS} if isinstance(one, dict) else one
        for one in data.get("connections", ())
    ]
    return [instances, connections]


def _write_copy(plain: PlainConfig, original: PlainConfig, kept: KeptPackage, path: Path) -> tuple[Finding, ...]:
    """Write a copy of the package with an annotation of ours that says the rest."""
    findings = Findings(str(plain.file), plain.lines, plain.overrides)
    data = _with_scenario(plain, findings)
    _check_files(data, findings)
    findings.raise_any()
    described: Mapping[str, Any] = original.data if isinstance(original.data, dict) else {}
    names: dict[str, str] = {}
    before = own_annotation_in(kept.document)
    if before is not None:
        described, names = without(described, before), names_in(before)
    annotation = written(data, described, names=names, moved=_to_package(plain.file))
    document = kept.document if annotation == before else with_own_annotation(kept.document, annotation)
    try:
        with kept.copied(document) as entries:
            write_package(path, entries)
            names_of_files = [entry.name for entry in entries]
    except LoadFailed as error:
        raise ConfigurationError(error.message, hint=error.hint) from error
    if kept.name in names_of_files and kept.name != DEFAULT:
        found = f"'{kept.name}' is not the default description of the package"
        return (Finding(str(path), "", found, f"`ssd={kept.name!r}` to run it"),)
    return ()


def _write_new(plain: PlainConfig, resolve: Callable[[], ResolvedSystem], path: Path, version: SspVersion) -> set[str]:
    """Write a package with a new description; returns the names of its units."""
    findings = Findings(str(plain.file), plain.lines, plain.overrides)
    data = _with_scenario(plain, findings)
    _check_kinds(data, findings)
    _check_files(data, findings)
    findings.raise_any()
    system = resolve()
    models = {name: Path(instance.fmu) for name, instance in system.instances.items()}
    resources = resource_names(models.values())
    elements, changed = _element_names([*models])
    sections = data["instances"]
    names = ElementNames(
        elements,
        {name: resources[model] for name, model in models.items()},
        {name: sections[name]["kind"] for name in models if sections[name].get("kind", "auto") != "auto"},
    )
    data = {**data, "simulation": {"algorithm": system.config.simulation.algorithm, **data["simulation"]}}
    annotation = written(data, _described(system.config), names=changed, moved=_to_package(plain.file))
    document = ssd_of(system, names, version, annotation, findings)
    findings.raise_any()
    models_of = {resource: model for model, resource in reversed(resources.items())}
    entries = [PackageEntry(resource, models_of[resource]) for resource in dict.fromkeys(resources.values())]
    write_package(path, [PackageEntry(DEFAULT, document.xml), *entries])
    return document.units


def _described(config: Config) -> dict[str, Any]:
    """What a new description says in its own words about what the annotation could also say."""
    simulation = config.simulation
    times = {"start_time": simulation.start_time, "stop_time": simulation.stop_time}
    given = {key: value for key, value in times.items() if value is not None}
    return {"mesh": mesh_name(config.mesh), "simulation": given}


def _element_names(instances: Sequence[str]) -> tuple[dict[str, str], dict[str, str]]:
    """The name of each element, and the instances whose names do not follow from that, by the name that would.

    An instance that was read from a package gets the name of its element again, such as `DP Controller`. One whose name
    stands for systems around an element, such as `left-motor`, keeps it as the name of its element.
    """
    elements: dict[str, str] = {}
    for name in instances:
        try:
            path = element_path(name)
        except (ValueError, OverflowError):
            continue  # a number in it is no code point
        if len(path) == 1 and path[0] and is_xml_text(path[0]) and instance_name(path) == name:
            elements[name] = path[0]
    taken = {*elements.values()}
    for name in instances:
        if name not in elements:
            elements[name] = name
            while elements[name] in taken:
                elements[name] += "_"
            taken.add(elements[name])
    defaults = {name: instance_name((elements[name],)) for name in instances}
    return elements, {default: name for name, default in defaults.items() if default != name}


def _with_scenario(plain: PlainConfig, findings: Findings) -> dict[str, Any]:
    """The values of the configuration with the scenario that it may name a file of."""
    data = plain.data
    if not isinstance(data, dict) or not isinstance(data.get("instances"), dict):
        findings.add("", "no mapping with instances", "a configuration")
        findings.raise_any()
    assert isinstance(data, dict)  # see above
    scenario = data.get("scenario")
    if not isinstance(scenario, str):
        return data
    file = beside(plain.file, scenario)
    if not is_file(file):
        findings.add("scenario", f"no such file '{scenario}'", "a file with values and events", nearest_file(file))
        return data
    return {**data, "scenario": read_file(file).data}


def _check_kinds(data: Mapping[str, Any], findings: Findings) -> None:
    """Add a finding for every instance that is no FMU."""
    for name, section in data["instances"].items():
        if isinstance(section, dict) and section and "fmu" not in section:
            found = f"'{name}', which is no FMU but has the key '{next(iter(section))}'"
            expected = "only FMUs: SSP has no components of other kinds. Export the mesh without it"
            findings.add(f"instances.{name}", found, expected)


def _check_files(data: Mapping[str, Any], findings: Findings) -> None:
    """Add a finding for every file that cannot go into a package."""
    scenario = data.get("scenario")
    values = scenario.get("values") if isinstance(scenario, dict) else None
    for name, entry in (values or {}).items():
        if isinstance(entry, dict) and entry.get("file") is not None:
            found = f"values from the file '{entry['file']}', which has no place in a package"
            findings.add(f"scenario.values.{name}", found, "`times` and `values`, or no entry for this variable")
    zenoh = data.get("zenoh")
    if isinstance(zenoh, dict) and zenoh.get("config") is not None:
        found = f"the file '{zenoh['config']}', which has no place in a package"
        findings.add("zenoh.config", found, "the keys of the section `zenoh`, such as `connect`")


def _to_package(file: Path) -> Callable[[str], str]:
    """From the path of a result file for the folder of ``file`` to one for the folder of the package around it."""
    package = archive_on_the_way(file)
    if package is None:
        return lambda path: path
    folder = file.parent.relative_to(package.parent).as_posix()
    return lambda path: posixpath.normpath(posixpath.join(folder, path))
