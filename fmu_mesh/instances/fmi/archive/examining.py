"""What can be said of an FMU before FMPy reads it: whether its XML is safe and legal, and whether it can run here.

Everything that cannot run is refused here, with a sentence that says why; what is only odd is left to the reader, which
keeps it as a problem of the description. FMPy is only handed XML that has passed `safe_xml`: it resolves entities.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final

import fmpy
from lxml import etree

from ....errors import LoadFailed
from .archive import Contents, Terms, look_into

__all__ = ["examine", "find_library", "library_name", "safe_xml", "source_names"]

_SHOWN: Final = 3
_SUFFIX: Final = str(fmpy.sharedLibraryExtension)
_SCHEMA_FILES: Final = {
    "1": "fmi1/fmiModelDescription.xsd",
    "2": "fmi2/fmi2ModelDescription.xsd",
    "3": "fmi3/fmi3ModelDescription.xsd",
}
_ILLEGAL: Final = frozenset({"SCHEMAV_CVC_DATATYPE_VALID_1_2_1", "SCHEMAV_CVC_ENUMERATION_VALID"})
_DECIDING: Final = re.compile(
    r"valueReference|causality|variability|initial|index|dependencies|dependenciesKind|derivative|previous|reinit"
    r"|can[A-Z]\w*|needs[A-Z]\w*|has[A-Z]\w*|numberOf\w+|intervalVariability|clocks"
)
"""Attributes that decide how an FMU is called; an illegal date or unit is only odd."""

_ATTRIBUTE = re.compile(r"attribute '([^']+)': (?:\[[^]]*\] )?(.*)")


def examine(path: Path, terms: Terms) -> Contents:
    """Look into the FMU at ``path`` and refuse what must not be read, or cannot run anywhere.

    Raises:
        LoadFailed: it is no FMU, breaks the terms, or its XML is unsafe or illegal.
    """
    contents = look_into(path, terms)
    if "modelDescription.xml" not in contents.names:
        kind = "a folder" if path.is_dir() else "a ZIP archive"
        raise LoadFailed(
            f"'{path}' is {kind}, but has no modelDescription.xml at its root, so it is no FMU.",
            hint="An FMU that was zipped inside a folder of its own must be zipped again without that folder.",
        )
    roots = {name: safe_xml(data, f"the {name} of '{path}'") for name, data in contents.xml.items()}
    root = roots["modelDescription.xml"]
    version = root.get("fmiVersion") or ""
    if re.match(r"3\.\d+(\.\d+)?-", version):
        raise LoadFailed(
            f"'{path}' is for FMI {version}, a version before the standard was finished, which nothing can rely on.",
            hint="Export it for FMI 3.0.",
        )
    if root.tag != "fmiModelDescription" or version[:1] not in _SCHEMA_FILES:
        shown = f"FMI '{version}'" if root.tag == "fmiModelDescription" else f"a <{root.tag}>"
        raise LoadFailed(f"the modelDescription.xml of '{path}' is for {shown}; there are FMI 1.0, 2.0 and 3.0.")
    if illegal := list(_illegal_values(root, version[0])):
        rest = f", and {len(illegal) - _SHOWN} more" if len(illegal) > _SHOWN else ""
        text = f"the modelDescription.xml of '{path}' has illegal values: {'; '.join(illegal[:_SHOWN])}{rest}."
        raise LoadFailed(text, hint="Its tool has to be told, or the file corrected.")
    return contents


def safe_xml(data: bytes, what: str) -> Any:  # noqa: ANN401 lxml ships no types
    """The root element of ``data``, which is named ``what`` in errors.

    A document type is refused before it is read: that is where entities are declared that expand without end or reach
    for other files, and no FMI document has one.

    Raises:
        LoadFailed: there is a document type, or it is not well-formed XML.
    """
    try:
        # Two readers: a target sees the document type before lxml does anything with it, but builds no tree.
        etree.fromstring(data, _parser(target=_NoDocumentType()))
        return etree.fromstring(data, _parser())
    except _DocumentTypeError as error:
        raise LoadFailed(
            f"{what} declares a document type, through which XML can expand without end and reach for other files.",
            hint="No FMI document has one: remove its <!DOCTYPE>.",
        ) from error
    except etree.XMLSyntaxError as error:
        raise LoadFailed(f"{what} cannot be read: {error.msg}") from error


def library_name(identifier: str, fmi_version: str) -> str:
    """Where an FMU has its library for this platform (FMI 1.0, 2.3; 2.0, 2.3; 3.0, 2.5.1)."""
    platform = fmpy.platform_tuple if fmi_version.startswith("3") else fmpy.platform
    return f"binaries/{platform}/{identifier}{_SUFFIX}"


def source_names(names: Iterable[str]) -> list[str]:
    """The C and C++ sources among the files of an FMU."""
    return sorted(name for name in names if re.fullmatch(r"sources/.*\.(c|cc|cpp|cxx)", name))


def find_library(path: Path, names: Collection[str], identifiers: Sequence[str], fmi_version: str) -> str | None:
    """The library of an FMU for this platform: that of its name, or else the only one that there is.

    Args:
        path: the FMU.
        names: of its files.
        identifiers: the model identifier of the kind to use, then that of the other kind if there is one.
        fmi_version: of it.

    Returns:
        The name of its file; None if there are sources to make it from.

    Raises:
        LoadFailed: it can run elsewhere only, or which library it is cannot be told; the message says what it has.
    """
    identifier, *others_of_it = identifiers
    if "/" in identifier or "\\" in identifier or identifier.startswith("."):
        raise LoadFailed(f"'{path}' has the model identifier '{identifier}', which cannot be the name of a library.")
    wanted = library_name(identifier, fmi_version)
    if identifier and wanted in names:
        return wanted
    folder = wanted.rpartition("/")[0]
    there = sorted(name for name in names if name.rpartition("/")[0] == folder and name.endswith(_SUFFIX))
    known = [name for one in others_of_it if (name := library_name(one, fmi_version)) in there]
    others = [name for name in there if name not in known]
    if len(others) == 1:
        return others[0]
    what = f"'{path}' has no '{wanted}'" if identifier else f"'{path}' has no model identifier to find its library by"
    if others:
        raise LoadFailed(
            f"{what}; it has {' and '.join(map(repr, others))}, and which of them to load cannot be told.",
            hint="The library must have the name of the model identifier (FMI 2.0, 2.3).",
        )
    if identifier and source_names(names):
        return None
    if known:
        raise LoadFailed(
            f"{what}; it has only '{known[0]}', the library of its other kind.",
            hint="Leave `kind` to the other one, or export it with both libraries.",
        )
    if not identifier:
        raise LoadFailed(f"{what}, nor a library for this platform.", hint="Its tool has to be told.")
    platforms = sorted({name.split("/")[1] for name in names if re.fullmatch(r"binaries/[^/]+/.+", name)})
    raise LoadFailed(
        f"'{path}' has no binary for this platform ({folder.rpartition('/')[2]}); it has: "
        f"{', '.join(platforms) or 'no platform at all'}.",
        hint="Export it for this platform, or with its sources.",
    )


class _DocumentTypeError(Exception):
    """A document type was found."""


class _NoDocumentType:
    """Reads a document for its document type only."""

    def doctype(self, *_declared: str | None) -> None:
        raise _DocumentTypeError

    def close(self) -> None:
        """The document has none."""


def _parser(**options: object) -> Any:  # noqa: ANN401 lxml ships no types
    return etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, dtd_validation=False, huge_tree=False, **options
    )


@cache
def _schema(generation: str) -> Any:  # noqa: ANN401 lxml ships no types
    return etree.XMLSchema(file=str(Path(fmpy.__file__).parent / "schema" / _SCHEMA_FILES[generation]))


def _illegal_values(root: Any, generation: str) -> Iterable[str]:  # noqa: ANN401 lxml ships no types
    """In words, the attributes that decide how the FMU is called and have a value that the schema does not know."""
    schema = _schema(generation)
    schema.validate(root)
    for error in schema.error_log:
        match = _ATTRIBUTE.search(error.message)
        if error.type_name in _ILLEGAL and match is not None and _DECIDING.fullmatch(match[1]):
            found = root.getroottree().xpath(error.path)
            element = next(
                (one for node in found[:1] for one in (node, *node.iterancestors()) if one.get("name")), None
            )
            owner = f"variable '{element.get('name')}'" if element is not None else error.path.rpartition("/")[2]
            yield f"{owner} (line {error.line}): {match[1]}: {match[2].rstrip('.')}"
