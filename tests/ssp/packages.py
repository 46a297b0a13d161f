"""Writes packages of SSP: their XML by short functions, and the archive around it.

The FMUs are those of `fmus/`, or those that only tests use.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

from tests.fmus.helpers import FMUS

__all__ = [
    "NAMESPACES",
    "Files",
    "bound",
    "component",
    "connection",
    "connector",
    "description",
    "element",
    "fmus",
    "mapped",
    "mapping_file",
    "parameter",
    "parameter_file",
    "parameter_set",
    "system",
    "unit",
    "write_package",
]

Files = Mapping[str, str | bytes]
"""The files of a package by their names in it."""

_NAMES = {
    "ssd": "SystemStructureDescription",
    "ssc": "SystemStructureCommon",
    "ssv": "SystemStructureParameterValues",
    "ssm": "SystemStructureParameterMapping",
    "ssb": "SystemStructureSignalDictionary",
}
NAMESPACES = {f"xmlns:{prefix}": f"http://ssp-standard.org/SSP1/{name}" for prefix, name in _NAMES.items()}
"""The attributes of a root element that bind the usual prefixes."""


def element(tag: str, *children: str, **attributes: object) -> str:
    """An element with these attributes; `class_` is written `class`, and an attribute that is None is left out."""
    given = {name.rstrip("_"): value for name, value in attributes.items() if value is not None}
    opened = " ".join([tag, *(f"{name}={quoteattr(str(value))}" for name, value in given.items())])
    inside = "\n".join(filter(None, children))
    return f"<{opened}>\n{inside}\n</{tag}>" if inside else f"<{opened}/>"


def connector(name: str, kind: str, type_: str = "Real", *inside: str, **of_the_type: object) -> str:
    """A connector; an empty ``type_`` leaves the type out."""
    children = [element(f"ssc:{type_}", **of_the_type)] if type_ else []
    return element("ssd:Connector", *children, *inside, name=name, kind=kind)


def connection(start: str, end: str, *inside: str, **attributes: object) -> str:
    """A connection: `element.connector`, or `.connector` for one of the system itself."""
    ends: dict[str, object] = {}
    for side, text in (("start", start), ("end", end)):
        owner, _, name = text.partition(".")
        ends |= {f"{side}Element": owner or None, f"{side}Connector": name}
    return element("ssd:Connection", *inside, **ends, **attributes)


def component(
    name: str,
    source: str,
    *connectors: str,
    bindings: Iterable[str] = (),
    annotations: Iterable[str] = (),
    **attributes: object,
) -> str:
    """A component; ``source`` is the name of an FMU, or a URI."""
    uri = source if "/" in source or "#" in source or "." in source else f"resources/{source}.fmu"
    return element(
        "ssd:Component",
        _listed("ssd:Connectors", connectors),
        _listed("ssd:ParameterBindings", bindings),
        _listed("ssd:Annotations", annotations),
        name=name,
        source=uri,
        **attributes,
    )


def system(
    name: str,
    *elements: str,
    connectors: Iterable[str] = (),
    connections: Iterable[str] = (),
    bindings: Iterable[str] = (),
    annotations: Iterable[str] = (),
    **attributes: object,
) -> str:
    """A system with elements."""
    return element(
        "ssd:System",
        _listed("ssd:Connectors", connectors),
        _listed("ssd:ParameterBindings", bindings),
        _listed("ssd:Elements", elements),
        _listed("ssd:Connections", connections),
        _listed("ssd:Annotations", annotations),
        name=name,
        **attributes,
    )


def description(
    root: str,
    *,
    name: str = "own",
    version: str = "1.0",
    units: Iterable[str] = (),
    enumerations: Iterable[str] = (),
    stop_time: float | None = 1.0,
    start_time: float | None = None,
    annotations: Iterable[str] = (),
) -> str:
    """A system structure description with this root system."""
    times = {"startTime": start_time, "stopTime": stop_time}
    content = element(
        "ssd:SystemStructureDescription",
        root,
        _listed("ssd:Enumerations", enumerations),
        _listed("ssd:Units", units),
        element("ssd:DefaultExperiment", **times) if stop_time is not None else "",
        _listed("ssd:Annotations", annotations),
        **NAMESPACES,
        name=name,
        version=version,
    )
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{content}\n'


def unit(name: str, **base: object) -> str:
    """A unit by its exponents, factor and offset."""
    return element("ssc:Unit", element("ssc:BaseUnit", **base), name=name)


def bound(values: str, mapping: str | None = None, **attributes: object) -> str:
    """A parameter binding. Values and mapping are a URI, or the element itself."""
    inline = values.startswith("<")
    children = [element("ssd:ParameterValues", values)] if inline else []
    if mapping is not None and mapping.startswith("<"):
        children.append(element("ssd:ParameterMapping", mapping))
    elif mapping is not None:
        children.append(element("ssd:ParameterMapping", source=mapping))
    return element("ssd:ParameterBinding", *children, source=None if inline else values, **attributes)


def parameter(name: str, value: object, type_: str = "Real", *inside: str, **of_the_type: object) -> str:
    """One parameter; a ``value`` of None leaves the attribute out."""
    return element("ssv:Parameter", element(f"ssv:{type_}", value=value, **of_the_type), *inside, name=name)


def parameter_set(*parameters: str, units: Iterable[str] = (), version: str = "1.0", **attributes: object) -> str:
    """A parameter set, as it is in a binding."""
    return element(
        "ssv:ParameterSet",
        _listed("ssv:Parameters", parameters),
        _listed("ssv:Units", units),
        **{"version": version, "name": "values"} | attributes,
    )


def parameter_file(*parameters: str, units: Iterable[str] = (), version: str = "1.0") -> str:
    """An SSV file."""
    return parameter_set(*parameters, units=units, version=version, **NAMESPACES)


def mapped(source: str, target: str, *inside: str, **attributes: object) -> str:
    """An entry of a parameter mapping."""
    return element("ssm:MappingEntry", *inside, source=source, target=target, **attributes)


def mapping_file(*entries: str, version: str = "1.0") -> str:
    """An SSM file, or a mapping in a binding."""
    return element("ssm:ParameterMapping", *entries, **NAMESPACES, version=version)


def fmus(*names: str) -> dict[str, bytes]:
    """Kept FMUs as files of a package."""
    return {f"resources/{name}.fmu": (FMUS / f"{name}.fmu").read_bytes() for name in names}


def write_package(path: Path, files: Files) -> Path:
    """Write an archive, or a folder if ``path`` has no suffix; returns the path."""
    if not path.suffix:
        for name, content in files.items():
            file = path / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content.encode() if isinstance(content, str) else content)
        return path
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def _listed(tag: str, children: Iterable[str]) -> str:
    """A list of elements; nothing if it is empty."""
    written = [*children]
    return element(tag, *written) if written else ""
