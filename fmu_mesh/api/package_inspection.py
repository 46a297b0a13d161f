"""What a package of SSP says: its systems, FMUs, connectors, parameters and annotations. Nothing of it is executed."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Literal

import msgspec

from .. import files
from ..config.call_options import checked
from ..errors import ConfigurationError
from ..pictures.tables import pairs, table, titled
from ..printing import page
from ..ssp.configuration_files import named_package
from ..ssp.own_annotation import has_key
from ..ssp.package import Package
from ..ssp.problems import Problems
from ..ssp.ssd_reading import annotations_of, read_structure
from ..ssp.system_reading import read_system
from ..ssp.system_structure import (
    Binding,
    Element,
    StructureComponent,
    components_of,
    elements_of,
)
from ..text import counted, printable, short_number

__all__ = ["PackageInspection", "inspect_package"]


class PackageVariant(msgspec.Struct, frozen=True):
    """One description of a package: its file, the name that it has, and the version of SSP."""

    file: str
    name: str
    version: str


class PackageElement(msgspec.Struct, frozen=True):
    """A system, or a component with its FMU.

    Attributes:
        path: the names of the elements from the root system on; empty for the root system.
        source: the FMU, relative to the package; None for a system.
        instance: the name of the instance that it becomes; None for a system.
        implementation: how the FMU is to be used; None for a system.
        connectors: how many there are of each kind.
        connections: how many are inside a system.
    """

    path: tuple[str, ...]
    kind: Literal["system", "component"]
    source: str | None
    instance: str | None
    implementation: str | None
    connectors: dict[str, int]
    connections: int
    description: str | None


class PackageConnector(msgspec.Struct, frozen=True):
    """A connector of the root system."""

    name: str
    kind: str | None
    type: str | None
    unit: str | None


class PackageParameters(msgspec.Struct, frozen=True):
    """A source of parameter values.

    Attributes:
        element: path of the element that has the binding.
        file: where the values are; a description if they are inside of it.
        line: the line of the parameter set.
        parameters: how many values it has.
        prefix: in front of their names.
        mapping: the file with the mapping; None if all names count as they are.
    """

    element: tuple[str, ...]
    file: str
    line: int
    parameters: int
    prefix: str
    mapping: str | None


class PackageInspection(msgspec.Struct, frozen=True, omit_defaults=False):
    """What `inspect_package` found. As text, it is the page that `fmu-mesh inspect` prints.

    Example:
        >>> import fmu_mesh
        >>> _ = fmu_mesh.load("configs/pendulum_delay.yaml").to_ssp("pair.ssp")
        >>> package = fmu_mesh.inspect_package("pair.ssp")
        >>> [element.source for element in package.elements if element.kind == "component"]
        ['resources/DampedPendulum.fmu', 'resources/TransportDelay.fmu']
        >>> package.problems
        ()

    Attributes:
        file: the path as it was given.
        bytes: size of the package; None for a folder.
        description: the file of the description that is shown.
        name: the name of the description.
        version: the version of SSP.
        variants: all descriptions of the package; others are chosen by file or name.
        start_time: of the default experiment in s; None if it has none. ``stop_time`` likewise.
        step_size: in s, from an annotation; None if no annotation says it.
        algorithm: from an annotation; None if no annotation says it.
        needed: what options of a run have to give.
        elements: in the order of the documents.
        connectors: those of the root system.
        connections: how many connections there are between components.
        parameters: the sources of values.
        annotations: how many there are of each type.
        problems: what keeps the package from running, in words with file and line.
        warnings: what is not supported and has no effect.
    """

    file: str
    bytes: int | None
    description: str
    name: str
    version: str
    variants: tuple[PackageVariant, ...]
    start_time: float | None
    stop_time: float | None
    step_size: float | None
    algorithm: str | None
    needed: tuple[str, ...]
    elements: tuple[PackageElement, ...]
    connectors: tuple[PackageConnector, ...]
    connections: int
    parameters: tuple[PackageParameters, ...]
    annotations: dict[str, int]
    problems: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def page(self) -> str:
        """The page in lines."""
        return page(_page(self))

    def __str__(self) -> str:
        return self.page

    def __repr__(self) -> str:
        return f"<PackageInspection of {self.file}: SSP {self.version}, {_counts(self)}>"


@checked
def inspect_package(path: str | Path, *, ssd: str | None = None) -> PackageInspection:
    """Read what a package of SSP says. Nothing of it is run.

    Example:
        >>> import fmu_mesh
        >>> _ = fmu_mesh.load("configs/pendulum_delay.yaml").to_ssp("pair.ssp")
        >>> print(fmu_mesh.inspect_package("pair.ssp"))
        File         pair.ssp (... bytes)
        Description  SystemStructure.ssd
        Name         pendulum_delay
        ...

    Args:
        path: an .ssp file, the folder of an unpacked one, or an .ssd file.
        ssd: which description of the package: the name of its file, or the name that it has; None: the default one.

    Raises:
        ConfigurationError: there is no such package or description, or it has no system; has all findings.
    """
    package_path, chosen = named_package(Path(path), ssd) or (Path(path), ssd)
    plain = read_system(package_path, chosen)
    with Package(package_path) as package:
        name = plain.file.name
        structure = read_structure(package, name, Problems())
        if structure is None:
            raise ConfigurationError(f"'{path}' was changed while it was read", hint="Try again.")
        variants = [
            PackageVariant(other, found.name, found.version)
            for other in package.descriptions
            if (found := structure if other == name else read_structure(package, other, Problems())) is not None
        ]
        data = plain.data if isinstance(plain.data, dict) else {}  # of a wrong package there may be any part
        instances, simulation, connections = (data.get(key) for key in ("instances", "simulation", "connections"))
        times = simulation if isinstance(simulation, dict) else {}
        step_size, algorithm = times.get("step_size"), times.get("algorithm")
        components = [place for place, _ in components_of(structure.system)]
        names = dict(zip(components, instances if isinstance(instances, dict) else (), strict=False))
        elements = list(elements_of(structure.system))
        annotations = [*annotations_of(structure), *(own for _, one in elements[1:] for own in one.annotations)]
        return PackageInspection(
            file=str(path),
            bytes=None if files.is_folder(package.root) else package.root.stat().st_size,
            description=name,
            name=structure.name,
            version=structure.version,
            variants=tuple(variants),
            start_time=structure.start_time,
            stop_time=structure.stop_time,
            step_size=step_size if isinstance(step_size, float) else None,
            algorithm=algorithm if isinstance(algorithm, str) else None,
            needed=tuple(plain.needed.values()),
            elements=tuple(_element(place, one, names.get(place)) for place, one in elements),
            connectors=tuple(
                PackageConnector(one.name, one.kind, one.type, one.unit.name if one.unit is not None else None)
                for one in structure.system.connectors
            ),
            connections=sum(not has_key(one) for one in connections) if isinstance(connections, list) else 0,
            parameters=tuple(_source(package, place, own) for place, one in elements for own in one.bindings),
            annotations=dict(Counter(one.type for one in annotations)),
            problems=tuple(map(str, plain.findings)),
            warnings=tuple(map(str, plain.warnings)),
        )


def _element(path: tuple[str, ...], element: Element, instance: str | None) -> PackageElement:
    connectors: dict[str, int] = dict(Counter(one.kind or "unspecified" for one in element.connectors))
    if isinstance(element, StructureComponent):
        source, how = element.source, element.implementation
        return PackageElement(path, "component", source, instance, how, connectors, 0, element.description)
    inside = len(element.connections)
    return PackageElement(path, "system", None, instance, None, connectors, inside, element.description)


def _source(package: Package, path: tuple[str, ...], binding: Binding) -> PackageParameters:
    def inside(file: str) -> str:
        return file.removeprefix(package.shown("")).lstrip("/")

    values, mapping = binding.values, binding.mapping
    mapped_by = inside(mapping.place.file) if mapping is not None else None
    file, line = inside(values.place.file), values.place.line
    return PackageParameters(path, file, line, len(values.parameters), binding.prefix, mapped_by)


# --- the page


def _page(found: PackageInspection) -> list[str]:
    experiment = (("start", found.start_time), ("stop", found.stop_time), ("step", found.step_size))
    times = [f"{what} {short_number(value)} s" for what, value in experiment if value is not None]
    annotations = (_line(own) + (f" ({n})" if n > 1 else "") for own, n in found.annotations.items())
    variants = ", ".join(f"{one.file} ({_line(one.name)})" for one in found.variants)
    lines = pairs(
        [
            ("File", f"{found.file} ({found.bytes} bytes)" if found.bytes is not None else f"{found.file} (a folder)"),
            ("Description", found.description),
            ("Name", _line(found.name)),
            ("Version", f"SSP {found.version}"),
            ("Variants", f"{variants}: `ssd=...` chooses one" if len(found.variants) > 1 else ""),
            ("Experiment", ", ".join([*times, *([found.algorithm] if found.algorithm is not None else [])])),
            ("Needs", "; ".join(found.needed)),
            ("System", _counts(found)),
            ("Annotations", ", ".join(annotations)),
        ]
    )
    sections = [
        ("Elements", table([_row(element) for element in found.elements], indent=2)),
        (
            f"Connectors of the system ({len(found.connectors)})",
            table([[_line(c.name), c.kind or "", c.type or "", c.unit or ""] for c in found.connectors], indent=2),
        ),
        (f"Parameters ({len(found.parameters)})", table([_values(one) for one in found.parameters], indent=2)),
        (f"Problems ({len(found.problems)})", [f"  {_line(one)}" for one in found.problems]),
        (f"Warnings ({len(found.warnings)})", [f"  {_line(one)}" for one in found.warnings]),
    ]
    return titled([("", lines), *sections])


def _counts(found: PackageInspection) -> str:
    kinds = Counter(element.kind for element in found.elements)
    systems = f" in {kinds['system']} systems" if kinds["system"] > 1 else ""
    return (
        f"{counted(kinds['component'], 'component')}{systems}, {counted(found.connections, 'connection')} between them"
    )


def _row(element: PackageElement) -> list[str]:
    """An element of the tree, indented below the system that it is in."""
    name = "  " * len(element.path) + (_line(element.path[-1]) if element.path else "the system")
    connectors = ", ".join(counted(count, kind) for kind, count in element.connectors.items())
    if element.kind == "system":
        return [name, "", counted(element.connections, "connection"), "", connectors]
    differs = element.instance is not None and element.path != (element.instance,)
    instance = f"instance {element.instance}" if differs else ""
    implementation = "" if element.implementation == "any" else str(element.implementation)
    return [name, element.source or "no FMU", implementation, instance, connectors]


def _values(source: PackageParameters) -> list[str]:
    element = " / ".join(map(_line, source.element)) or "the system"
    mapping = f"mapped by {source.mapping}" if source.mapping is not None else ""
    prefix = f"prefix '{_line(source.prefix)}'" if source.prefix else ""
    return [f"{source.file}:{source.line}", counted(source.parameters, "parameter"), f"of {element}", prefix, mapping]


def _line(text: str) -> str:
    return printable(" ".join(text.split()))
