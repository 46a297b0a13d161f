"""From a mesh to a package of SSP, which `fmu-mesh launch` runs with the same result, and other tools can open.

Owns what goes into a package, and what cannot. A mesh that comes from a package and was not changed keeps the documents
and files of that package; only our annotation in its description is another one. So geometry, descriptions, annotations
of other tools and everything else that we do not read survive. Any other mesh gets a new description (`ssd_writing`).
"""

from __future__ import annotations

import json
import posixpath
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import unquote

from lxml import etree

from ..archives.archive_entries import checked_archive, entry_name
from ..archives.safe_xml import safe_xml
from ..config.findings import Findings
from ..config.loading import PlainConfig, read_file
from ..config.mesh import LimitsConfig
from ..errors import ConfigurationError, Finding, LoadFailed
from ..files import archive_on_the_way, beside, is_file, is_folder
from ..system.system import ResolvedSystem
from ..text import listed, nearest_file
from .grammar import NAMESPACES
from .naming import element_path, instance_name, mesh_name
from .own_annotation import ANNOTATION_TYPE, has_key, names_in, written
from .package import DEFAULT, Package
from .package_writing import ArchiveEntry, Content, resource_names, write_package
from .ssd_writing import (
    ElementNames,
    SspVersion,
    XmlNode,
    is_xml_text,
    own_annotation_in,
    ssd_of,
    with_own_annotation,
)
from .system_reading import read_system

__all__ = ["export"]

_OF_CONNECTIONS: Final = ("from", "to", "factor", "offset", "ignore_units", "map")
"""The keys of a connection that SSP can say."""

_FOLDERS: Final = ("resources/", "documentation/", "extra/")
"""The folders of a package that has been unpacked (SSP 2.0, 3); others may have nothing to do with it."""

_DOCUMENTS: Final = (".ssd", ".ssv", ".ssm")
_NAMESPACES: Final = frozenset(NAMESPACES.values())
_LOST: Final = {
    "SignalDictionary": "signal dictionaries",
    "SignalDictionaryReference": "references to signal dictionaries",
    "MetaData": "elements with meta data",
    "Signature": "signatures",
}
_HEAD: Final = ("author", "fileversion", "copyright", "license", "generationDateAndTime")


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
    kept = _kept_package(plain)
    try:
        if kept is not None and (version is None or kept.is_of(version)):
            place = (kept.root / kept.name,) if is_folder(kept.root) else (kept.root, kept.name)
            original = read_system(*place, annotated=False)
            Findings(kept.shown, first=original.findings).raise_any()  # the package may have changed since it was read
            if json.dumps(_content(plain.data)) == json.dumps(_content(original.data)):
                return _write_copy(plain, original, kept, path)
        units = _write_new(plain, resolve, path, version or "1.0")
        return kept.lost(units) if kept is not None else ()
    except LoadFailed as error:  # of the package, or of an FMU
        raise ConfigurationError(error.message, hint=error.hint) from error


def _content(data: Any) -> list[Any]:  # noqa: ANN401  values of a file
    """What a configuration says that SSP can say, in its order."""
    instances = [
        (name, section.get("fmu"), section.get("kind", "auto"), section.get("start_values") or {})
        for name, section in data.get("instances", {}).items()
    ]
    connections = [
        {key: value for key, value in one.items() if key in _OF_CONNECTIONS} if isinstance(one, dict) else one
        for one in data.get("connections", ())
        if not has_key(one)
    ]
    return [instances, connections]


def _write_copy(plain: PlainConfig, original: PlainConfig, kept: _KeptPackage, path: Path) -> tuple[Finding, ...]:
    """Write a copy of the package with an annotation of ours that says the rest."""
    data = _packable(plain)
    described: Mapping[str, Any] = original.data if isinstance(original.data, dict) else {}
    before = own_annotation_in(kept.document)
    names = names_in(before) if before is not None else {}
    annotation = written(data, described, names=names, moved=_to_package(plain.file))
    document = kept.document if annotation == before else with_own_annotation(kept.document, annotation)
    with kept.copied(document) as entries:
        write_package(path, entries)
    if kept.name in entries and kept.name != DEFAULT:
        found = f"'{kept.name}' is not the default description of the package"
        return (Finding(str(path), "", found, f"`ssd={kept.name!r}` to run it"),)
    return ()


def _write_new(plain: PlainConfig, resolve: Callable[[], ResolvedSystem], path: Path, version: SspVersion) -> set[str]:
    """Write a package with a new description; returns the names of its units."""
    data = _packable(plain, fmus_only=True)
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
    # What a new description says in its own words about what the annotation could also say.
    times = {key: getattr(system.config.simulation, key) for key in ("start_time", "stop_time")}
    given = {key: value for key, value in times.items() if value is not None}
    described = {"mesh": mesh_name(system.config.mesh), "simulation": given}
    annotation = written(data, described, names=changed, moved=_to_package(plain.file))
    findings = Findings(str(plain.file), plain.lines, plain.overrides)
    document, units = ssd_of(system, names, version, annotation, findings)
    findings.raise_any()
    models_of = {resource: model for model, resource in reversed(resources.items())}
    write_package(path, {DEFAULT: document, **{name: models_of[name] for name in resources.values()}})
    return units


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


def _packable(plain: PlainConfig, *, fmus_only: bool = False) -> dict[str, Any]:
    """The values of the configuration with the scenario that it may name a file of; all that cannot go is an error."""
    findings = Findings(str(plain.file), plain.lines, plain.overrides)
    data = plain.data
    instances = data.get("instances") if isinstance(data, dict) else None
    if not isinstance(data, dict) or not isinstance(instances, dict):
        findings.add("", "no mapping with instances", "a configuration")
        findings.raise_any()
    assert isinstance(data, dict)  # see above
    assert isinstance(instances, dict)
    if isinstance(named := data.get("scenario"), str):
        file = beside(plain.file, named)
        if is_file(file):
            data = {**data, "scenario": read_file(file).data}
        else:
            findings.add("scenario", f"no such file '{named}'", "a file with values and events", nearest_file(file))
    for name, section in instances.items() if fmus_only else ():
        if isinstance(section, dict) and section and "fmu" not in section:
            found = f"'{name}', which is no FMU but has the key '{next(iter(section))}'"
            expected = "only FMUs: SSP has no components of other kinds. Export the mesh without it"
            findings.add(f"instances.{name}", found, expected)
    scenario, zenoh = data.get("scenario"), data.get("zenoh")
    values = scenario.get("values") if isinstance(scenario, dict) else None
    for name, entry in values.items() if isinstance(values, dict) else ():
        if isinstance(entry, dict) and entry.get("file") is not None:
            found = f"values from the file '{entry['file']}', which has no place in a package"
            findings.add(f"scenario.values.{name}", found, "`times` and `values`, or no entry for this variable")
    if isinstance(zenoh, dict) and zenoh.get("config") is not None:
        found = f"the file '{zenoh['config']}', which has no place in a package"
        findings.add("zenoh.config", found, "the keys of the section `zenoh`, such as `connect`")
    findings.raise_any()
    return data


def _to_package(file: Path) -> Callable[[str], str]:
    """From the path of a result file for the folder of ``file`` to one for the folder of the package around it."""
    package = archive_on_the_way(file)
    if package is None:
        return lambda path: path
    folder = file.parent.relative_to(package.parent).as_posix()
    return lambda path: posixpath.normpath(posixpath.join(folder, path))


class _KeptPackage(NamedTuple):
    """A package on the disk, an archive or a folder, with the name and the bytes of the description that was read."""

    root: Path
    name: str
    document: bytes

    @property
    def shown(self) -> str:
        """The description as messages name it."""
        return str(self.root / self.name)

    def is_of(self, version: str) -> bool:
        """Whether the description, and all sets and mappings that it has or refers to, are of a version of SSP."""
        own = self._tree()
        with Package(self.root) as package:
            names = [name for name in _sources(own) if name.lower().endswith(_DOCUMENTS) and package.exists(name)]
            others = [safe_xml(package.read(name), f"'{package.shown(name)}'") for name in names]
        elements = (one for root in (own, *others) for one in root.iter() if isinstance(one.tag, str))
        said = {one.get("version") for one in elements if etree.QName(one).namespace in _NAMESPACES}
        return said <= {version, None}

    @contextmanager
    def copied(self, document: bytes) -> Iterator[dict[str, Content]]:
        """The files of a copy of the package, with another content of the description."""
        if is_file(self.root):
            with self.root.open("rb") as file, checked_archive(self.root, file, LimitsConfig(), "package") as archive:
                there = [entry for entry in archive.infolist() if not entry.is_dir()]
                entries = {entry_name(entry): ArchiveEntry(archive, entry) for entry in there}
                yield {**entries, self.name: document}
            return
        if beside := sorted(source for source in _sources(self._tree()) if source.startswith("../")):
            text = f"'{self.shown}' names '{beside[0]}', which is not in the folder of the package"
            raise ConfigurationError(text, hint="Copy it into the folder, and name the copy.")
        names = self._names_in_folder()
        main = DEFAULT if DEFAULT not in names else self.name
        yield {main: document, **{name: self._own_file(name) for name in names if name != self.name}}

    def _own_file(self, name: str) -> Path:
        """The path of a file of a folder; what is copied is given to others, and so must not be somewhere else."""
        path = self.root / name
        if not path.resolve().is_relative_to(self.root.resolve()):
            text = f"'{path}' is a link out of the folder of the package"
            raise ConfigurationError(text, hint="Put the file itself in its place.")
        return path

    def lost(self, kept_units: set[str]) -> tuple[Finding, ...]:
        """What a new description, which defines the units ``kept_units``, does not have; each with its first line."""
        root = self._tree()
        found = [*_lost_elements(root, kept_units), *self._lost_files(root)]
        return tuple(Finding(self.shown, "", f"not in the new package: {text}", "", line=line) for line, text in found)

    def _tree(self) -> XmlNode:
        return safe_xml(self.document, f"'{self.shown}'")

    def _lost_files(self, root: XmlNode) -> Iterator[tuple[int | None, str]]:
        """The files that a new package does not have: all but the FMUs."""
        sources = _sources(root)
        with Package(self.root) as package:
            names = package.names() if package.is_archive else self._names_in_folder()
        fmus = {name for name in names if name in sources and name.lower().endswith(".fmu")}
        others = [name for name in names if name not in fmus and name != self.name]
        if others:
            yield None, f"files ({len(others)}): {listed(others)}"

    def _names_in_folder(self) -> list[str]:
        """The files in a folder that belong to the package."""
        with Package(self.root) as package:
            names, documents = package.names(), package.descriptions
            sources = {source for name in documents for source in _sources(safe_xml(package.read(name), f"'{name}'"))}
        return [name for name in names if name in documents or name.startswith(_FOLDERS) or name in sources]


def _kept_package(plain: PlainConfig) -> _KeptPackage | None:
    """The package that a configuration was read from; None if it was not."""
    file = plain.file
    if file.suffix.lower() != ".ssd":
        return None
    root = archive_on_the_way(file) or file.parent
    name = file.relative_to(root).as_posix()
    if "/" in name:
        return None  # of a package inside another archive
    with Package(root) as package:
        return _KeptPackage(root, name, package.read(name))


def _sources(root: XmlNode) -> set[str]:
    """The files that a description at the root of a package refers to."""
    uris = (element.get("source") for element in root.iter() if isinstance(element.tag, str))
    return {posixpath.normpath(unquote(uri.partition("#")[0])) for uri in uris if uri}


def _lost_elements(root: XmlNode, kept_units: set[str]) -> Iterator[tuple[int | None, str]]:
    """What stands in a description and is not in a new one, with the line of the first one."""
    groups: dict[str, list[XmlNode]] = {}
    for element in root.iter():
        if not isinstance(element.tag, str) or etree.QName(element).namespace not in _NAMESPACES:
            continue
        for what in (_kind_of(element, kept_units), "descriptions" if element.get("description") else None):
            if what is not None:
                groups.setdefault(what, []).append(element)
    for what, elements in groups.items():
        yield elements[0].sourceline, f"{what} ({len(elements)})"
    head = [f"{key} '{root.get(key)}'" for key in _HEAD if root.get(key)]
    if head:
        yield root.sourceline, listed(head)


def _kind_of(element: XmlNode, kept_units: set[str]) -> str | None:
    """What is lost with an element, in words; None if it has a place in a new description."""
    name, own = etree.QName(element).localname, element.get("name")
    around = element.getparent()
    parent = etree.QName(around).localname if around is not None else None
    special = {
        "nested systems": (name == "System" and parent != "SystemStructureDescription")
        or (name == "Component" and "x-ssp" in (element.get("type") or "")),
        "lists of connectors of systems": name == "Connectors" and parent == "System",
        f"annotations '{element.get('type')}'": name == "Annotation" and element.get("type") != ANNOTATION_TYPE,
        f"the unit '{own}', which no FMU defines": name == "Unit" and own not in kept_units,
        "elements with geometry": name == "GraphicalElements" or name.endswith("Geometry"),
    }
    return next((what for what, applies in special.items() if applies), _LOST.get(name))
