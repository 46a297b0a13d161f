"""A package that a mesh comes from: whether the mesh is still what it says, its files for a copy, and what is lost.

A copy has all documents and files of the package; only our annotation in its description is another one. So geometry,
descriptions, annotations of other tools and everything else that we do not read survive.
"""

from __future__ import annotations

import posixpath
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import unquote

from lxml import etree

from ..archives.archive_entries import checked_archive, entry_name
from ..archives.safe_xml import safe_xml
from ..config.loading import PlainConfig
from ..config.mesh import LimitsConfig
from ..errors import ConfigurationError, Finding
from ..files import archive_on_the_way, is_file
from ..text import listed
from .grammar import NAMESPACES
from .own_annotation import ANNOTATION_TYPE
from .package import DEFAULT, Package
from .package_writing import ArchiveEntry, PackageEntry

__all__ = ["KeptPackage", "kept_package"]

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


class KeptPackage(NamedTuple):
    """A package on the disk.

    Attributes:
        root: the archive or the folder.
        name: the file of the description that was read.
        document: its bytes.
    """

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
    def copied(self, document: bytes) -> Iterator[list[PackageEntry]]:
        """The files of a copy of the package, with another content of the description.

        Raises:
            LoadFailed, OSError: the package cannot be read.
            ConfigurationError: a link, or a file that the description names, leads out of the folder.
        """
        if is_file(self.root):
            with self.root.open("rb") as file, checked_archive(self.root, file, LimitsConfig(), "package") as archive:
                entries = [entry for entry in archive.infolist() if not entry.is_dir()]
                yield [
                    PackageEntry(name, document if name == self.name else ArchiveEntry(archive, entry))
                    for entry in entries
                    for name in [entry_name(entry)]
                ]
            return
        if beside := sorted(source for source in _sources(self._tree()) if source.startswith("../")):
            text = f"'{self.shown}' names '{beside[0]}', which is not in the folder of the package"
            raise ConfigurationError(text, hint="Copy it into the folder, and name the copy.")
        names = self._names_in_folder()
        main = DEFAULT if DEFAULT not in names else self.name
        others = [PackageEntry(name, self._own_file(name)) for name in names if name != self.name]
        yield [PackageEntry(main, document), *others]

    def _own_file(self, name: str) -> Path:
        """The path of a file of a folder; what is copied is given to others, and so must not be somewhere else."""
        path = self.root / name
        if not path.resolve().is_relative_to(self.root.resolve()):
            text = f"'{path}' is a link out of the folder of the package"
            raise ConfigurationError(text, hint="Put the file itself in its place.")
        return path

    def lost(self, kept_units: set[str]) -> tuple[Finding, ...]:
        """What a new description does not have, each with its first line.

        Args:
            kept_units: the names of the units that the new one defines.
        """
        root = self._tree()
        found = [*_lost_elements(root, kept_units), *self._lost_files(root)]
        return tuple(Finding(self.shown, "", f"not in the new package: {text}", "", line=line) for line, text in found)

    def _tree(self) -> Any:  # noqa: ANN401  lxml ships no types
        return safe_xml(self.document, f"'{self.shown}'")

    def _lost_files(self, root: Any) -> Iterator[tuple[int | None, str]]:  # noqa: ANN401  lxml ships no types
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


def kept_package(plain: PlainConfig) -> KeptPackage | None:
    """The package that a configuration was read from; None if it was not.

    Raises:
        ConfigurationError: it cannot be read any more.
    """
    file = plain.file
    if file.suffix.lower() != ".ssd":
        return None
    root = archive_on_the_way(file) or file.parent
    name = file.relative_to(root).as_posix()
    if "/" in name:
        return None  # of a package inside another archive
    with Package(root) as package:
        return KeptPackage(root, name, package.read(name))


def _sources(root: Any) -> set[str]:  # noqa: ANN401  lxml ships no types
    """The files that a description at the root of a package refers to."""
    uris = (element.get("source") for element in root.iter() if isinstance(element.tag, str))
    return {posixpath.normpath(unquote(uri.partition("#")[0])) for uri in uris if uri}


def _lost_elements(root: Any, kept_units: set[str]) -> Iterator[tuple[int | None, str]]:  # noqa: ANN401  as above
    """What stands in a description and is not in a new one, with the line of the first one."""
    groups: dict[str, list[Any]] = {}
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


def _kind_of(element: Any, kept_units: set[str]) -> str | None:  # noqa: ANN401  as above
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
