"""What a system structure means, read in the plainest way: one flat list of FMUs, start values and connections.

It is written from the standard (SSP 2.0) and imports nothing of the package, so that both can be compared. It takes for
granted that a package is right: what is wrong in a package is not its business, and mostly ends it with a KeyError.

    system = read_system(Path("system.ssp"), folder)
    columns, rows = run_system(system, step_size=0.01, stop_time=1.0)            # tests.ssp.reference_run
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import fmpy

__all__ = ["FlatSystem", "Flow", "Fmu", "name_of", "read_system", "solver_of"]

SSD = "{http://ssp-standard.org/SSP1/SystemStructureDescription}"
SSC = "{http://ssp-standard.org/SSP1/SystemStructureCommon}"
SSV = "{http://ssp-standard.org/SSP1/SystemStructureParameterValues}"
SSM = "{http://ssp-standard.org/SSP1/SystemStructureParameterMapping}"

EXPONENTS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
SOURCES_INSIDE = ("input", "parameter", "structuralParameter")
"""The kinds of a system's own connectors that are sources within it; those of an element are targets (5.3.2.1)."""
KINDS = {"CoSimulation": "co_simulation", "ModelExchange": "model_exchange"}

Path_ = tuple[str, ...]
End = tuple[Path_, str]
"""A connector or a variable: the names of the elements down to its owner, without that of the root; its own name."""
Value = float | int | bool | str
Table = Mapping[Value, Value]


class Unit(NamedTuple):
    """A unit of a file: `in base units = factor * value + offset`; ``dimension`` is None if the file defines none."""

    name: str
    dimension: tuple[int, ...] | None = None
    factor: float = 1.0
    offset: float = 0.0


class Change(NamedTuple):
    """What happens to a value on its way: first the factor and the offset, then the tables."""

    factor: float = 1.0
    offset: float = 0.0
    tables: tuple[Table, ...] = ()

    def of(self, value: Value) -> Value:
        """The changed value."""
        if (self.factor, self.offset) != (1.0, 0.0):
            value = float(value) * self.factor + self.offset
        for table in self.tables:
            value = table.get(value, value)
        return value

    def linear(self, factor: float, offset: float) -> Change:
        """This, and then another linear change; one of them may do nothing at all."""
        if (factor, offset) == (1.0, 0.0):
            return self
        if (self.factor, self.offset) == (1.0, 0.0):
            return Change(factor, offset, self.tables)
        return Change(factor * self.factor, factor * self.offset + offset, self.tables)


@dataclass
class Fmu:
    """One component.

    Attributes:
        file: the FMU.
        kind: co_simulation or model_exchange.
        start_values: what the bindings give its variables.
        step_size: of its own, in s, if an annotation asks for one.
    """

    path: Path_
    file: Path
    kind: str
    start_values: dict[str, Value] = field(default_factory=dict)
    step_size: float | None = None

    @cached_property
    def description(self) -> Any:  # noqa: ANN401  FMPy is untyped
        """The model description as FMPy reads it."""
        return fmpy.read_model_description(str(self.file), validate=False)

    @cached_property
    def variables(self) -> dict[str, Any]:
        """The variables by name."""
        return {variable.name: variable for variable in self.description.modelVariables}

    @cached_property
    def units(self) -> dict[str, Unit]:
        """The units that the FMU defines, by name."""
        return {unit.name: _fmu_unit(unit) for unit in self.description.unitDefinitions}

    @cached_property
    def negated(self) -> set[str]:
        """The variables of FMI 1.0 whose value is that of another one with the other sign."""
        return {v.attrib["name"] for v in self._written() if v.get("alias") == "negatedAlias"}

    @cached_property
    def direct_dependencies(self) -> dict[str, list[str]]:
        """What the outputs of an FMU of FMI 1.0 depend on, where it says so."""
        return {
            variable.attrib["name"]: [name.text or "" for name in direct.iterfind("Name")]
            for variable in self._written()
            if (direct := variable.find("DirectDependency")) is not None
        }

    def _written(self) -> list[ET.Element]:
        """The variables of FMI 1.0 with what FMPy does not read."""
        with zipfile.ZipFile(self.file) as archive:
            root = ET.fromstring(archive.read("modelDescription.xml"))  # noqa: S314  as `_Reader`
        return root.findall("ModelVariables/ScalarVariable")

    def unit_of(self, name: str) -> Unit | None:
        """The unit of a variable; None if it has none."""
        variable = self.variables[name]
        unit = variable.unit or (variable.declaredType.unit if variable.declaredType is not None else None)
        return None if unit is None else self.units.get(unit, Unit(unit))

    def items_of(self, name: str) -> dict[str, int]:
        """The values of the items of an Enumeration."""
        declared = self.variables[name].declaredType
        return (
            {item.name: int(item.value) for item in declared.items} if declared is not None and declared.items else {}
        )


class Flow(NamedTuple):
    """A connection between two FMUs.

    Attributes:
        numbers: the places of its parts among all connections of the document, the last one first.
    """

    source: End
    target: End
    change: Change
    numbers: tuple[int, ...]


@dataclass
class FlatSystem:
    """A system without levels.

    Attributes:
        name: of the system.
        fmus: in the order of the document.
        flows: in the order of the document: a chain of connections is where its last part is.
        step_size: of the annotation of the system in s, if there is one; the times of the experiment likewise.
        warnings: what was left out.
    """

    name: str
    fmus: dict[Path_, Fmu]
    flows: list[Flow]
    start_time: float
    stop_time: float | None
    step_size: float | None
    warnings: list[str]


def name_of(path: Path_) -> str:
    """The name of an instance (docs/ssp.md): what an instance cannot be called is written as `-<code point>-`."""

    def escaped(element: str) -> str:
        text = re.sub(r"[^A-Za-z0-9_]", lambda found: f"-{ord(found[0])}-", element)
        return f"-{ord(text[0])}-{text[1:]}" if text[0].isdigit() else text

    joined = "-".join(map(escaped, path))
    return f"_{joined}" if joined.startswith("-") else joined


def solver_of(system: FlatSystem) -> dict[str, str]:
    """The values of a configuration that name the solver of the reference, which is CVode, for model exchange."""
    exchanging = [path for path, fmu in system.fmus.items() if fmu.kind == "model_exchange"]
    return {f"instances.{name_of(path)}.solver.name": "cvode" for path in exchanging}


def read_system(package: Path, folder: Path, ssd: str = "SystemStructure.ssd") -> FlatSystem:
    """Read a package.

    Args:
        package: an .ssp, an unpacked folder or an .ssd.
        folder: an empty folder; an .ssp is unpacked there.
        ssd: the name of the system structure.
    """
    if package.suffix == ".ssd":
        return _Reader(package).read()
    if package.is_dir():
        return _Reader(package / ssd).read()
    with zipfile.ZipFile(package) as archive:
        archive.extractall(folder)
    return _Reader(folder / ssd).read()


class Segment(NamedTuple):
    """One connection as it is written, in the direction of its values."""

    source: End
    suppressed: bool
    transformation: ET.Element | None
    number: int


class Given(NamedTuple):
    """A value that a binding gives to a connector or variable, and its unit."""

    value: Value
    unit: Unit | None


class _Reader:
    def __init__(self, file: Path) -> None:
        self.file = file
        self.root = ET.parse(file).getroot()  # noqa: S314  our own systems, and those that a person fetched
        self.units = _units(self.root, SSD)
        self.numbers = {id(element): number for number, element in enumerate(self.root.iter(f"{SSD}Connection"))}
        self.fmus: dict[Path_, Fmu] = {}
        self.connectors: dict[End, ET.Element] = {}
        self.feeds: dict[End, Segment] = {}
        self.given: dict[End, Given] = {}
        self.warnings: list[str] = []

    def read(self) -> FlatSystem:
        system = self.root.find(f"{SSD}System")
        assert system is not None
        self._elements(system, ())
        self._connections(system, ())
        self._bindings(system, ())
        flows = []
        for path, fmu in self.fmus.items():
            for name in fmu.variables:
                if (given := self.given.get((path, name))) is not None:
                    fmu.start_values[name] = self._typed(fmu, name, given.value)
                flow = self._arriving((path, name))
                if isinstance(flow, Flow):
                    flows.append(flow)
                elif flow is not None:
                    fmu.start_values[name] = self._typed(fmu, name, flow.value)
        experiment = self.root.find(f"{SSD}DefaultExperiment")
        times = {} if experiment is None else experiment.attrib
        places = [place for place in (system, experiment) if place is not None]
        return FlatSystem(
            name=system.get("name") or self.root.get("name") or "",
            fmus=self.fmus,
            flows=sorted(flows, key=lambda flow: flow.numbers),
            start_time=float(times.get("startTime", 0.0)),
            stop_time=float(times["stopTime"]) if "stopTime" in times else None,
            step_size=next((size for place in places if (size := _step_size(place)) is not None), None),
            warnings=self.warnings,
        )

    # --- the elements

    def _elements(self, system: ET.Element, path: Path_) -> None:
        for connector in system.iterfind(f"{SSD}Connectors/{SSD}Connector"):
            self.connectors[path, connector.attrib["name"]] = connector
        for element in system.iterfind(f"{SSD}Elements/*"):
            own = (*path, element.attrib["name"])
            if element.tag == f"{SSD}System":
                self._elements(element, own)
                continue
            for connector in element.iterfind(f"{SSD}Connectors/{SSD}Connector"):
                self.connectors[own, connector.attrib["name"]] = connector
            file = self.file.parent / unquote(element.attrib["source"])
            self.fmus[own] = fmu = Fmu(own, file, "")
            fmu.kind = KINDS.get(element.get("implementation", "any"), "")
            if not fmu.kind:
                fmu.kind = "co_simulation" if fmu.description.coSimulation is not None else "model_exchange"
            fmu.step_size = _hint(element)

    def _owner_is_fmu(self, end: End) -> bool:
        return end[0] in self.fmus

    def _kind(self, end: End) -> str:
        connector = self.connectors.get(end)
        return "unspecified" if connector is None else connector.get("kind", "unspecified")

    def _unit(self, end: End) -> Unit | None:
        """The unit of a connector or variable; None: it takes that of the value."""
        connector = self.connectors.get(end)
        for type_ in connector if connector is not None else ():
            if (unit := type_.get("unit")) is not None:
                return self.units.get(unit, Unit(unit)) if unit else Unit("")
        return self.fmus[end[0]].unit_of(end[1]) if self._owner_is_fmu(end) else None

    # --- the connections

    def _connections(self, system: ET.Element, path: Path_) -> None:
        for element in system.iterfind(f"{SSD}Elements/{SSD}System"):
            self._connections(element, (*path, element.attrib["name"]))
        for connection in system.iterfind(f"{SSD}Connections/{SSD}Connection"):
            ends = []
            for side in ("start", "end"):
                owner = connection.get(f"{side}Element")
                ends.append(((*path, owner) if owner else path, connection.attrib[f"{side}Connector"]))
            source, target = (
                ends if self._is_source(ends[0], path) or not self._is_source(ends[1], path) else ends[::-1]
            )
            if target in self.feeds:
                raise ValueError(f"{target} has two sources")
            change = next((child for child in connection if child.tag.startswith(SSC)), None)
            suppressed = connection.get("suppressUnitConversion") in ("true", "1")
            self.feeds[target] = Segment(source, suppressed, change, self.numbers[id(connection)])

    def _is_source(self, end: End, inside: Path_) -> bool:
        kind = self._kind(end)
        if kind == "unspecified" and self._owner_is_fmu(end):
            kind = self.fmus[end[0]].variables[end[1]].causality or "local"
        if kind == "unspecified":
            return False
        return (kind in SOURCES_INSIDE) == (end[0] == inside)

    def _arriving(self, end: End) -> Flow | Given | None:
        """What comes to a variable of an FMU: the output of another one, or the value of a connector of a system."""
        chain: list[tuple[End, Segment]] = []
        at = end
        while at in self.feeds:
            segment = self.feeds[at]
            chain.insert(0, (at, segment))
            at = segment.source
            if self._owner_is_fmu(at):
                change = self._along(chain, self._unit(at))
                return Flow(at, end, change, tuple(sorted((part.number for _, part in chain), reverse=True)))
        for begin, (_, segment) in enumerate(chain):  # the outermost connector with a value
            if (given := self.given.get(segment.source)) is not None:
                return Given(self._along(chain[begin:], given.unit).of(given.value), None)
        return None

    def _along(self, chain: Sequence[tuple[End, Segment]], unit: Unit | None) -> Change:
        """What a chain of connections does to a value in ``unit``."""
        change = Change()
        for target, segment in chain:
            own = self._unit(target)
            if not segment.suppressed:
                change = self._converted(change, unit, own, str(target))
            unit = own or unit
            change = _transformed(change, segment.transformation, self._items(segment.source), self._items(target))
        return change

    def _converted(self, change: Change, unit: Unit | None, own: Unit | None, what: str) -> Change:
        if unit is None or own is None or not unit.name or not own.name:
            return change
        if unit.dimension is None or own.dimension is None:
            if unit.name != own.name:
                self.warnings.append(f"{what}: {unit.name} to {own.name} is not defined")
            return change
        if unit.dimension != own.dimension:
            raise ValueError(f"{what}: {unit} to {own}")
        return change.linear(unit.factor / own.factor, (unit.offset - own.offset) / own.factor)

    def _items(self, end: End) -> dict[str, int]:
        if self._owner_is_fmu(end):
            return self.fmus[end[0]].items_of(end[1])
        connector = self.connectors.get(end)
        name = next((type_.get("name") for type_ in connector or () if type_.tag == f"{SSC}Enumeration"), None)
        return {
            item.attrib["name"]: int(item.attrib["value"])
            for enumeration in self.root.iterfind(f"{SSD}Enumerations/{SSC}Enumeration")
            if enumeration.get("name") == name
            for item in enumeration
        }

    # --- the parameters

    def _bindings(self, element: ET.Element, path: Path_) -> None:
        """Those of the lower levels first: a later value replaces an earlier one."""
        for child in element.iterfind(f"{SSD}Elements/*"):
            self._bindings(child, (*path, child.attrib["name"]))
        for binding in element.iterfind(f"{SSD}ParameterBindings/{SSD}ParameterBinding"):
            base = self.file
            if binding.get("sourceBase") == "component":
                base = self.fmus[path].file
            values = self._document(binding, base, binding.find(f"{SSD}ParameterValues/{SSV}ParameterSet"))
            written = binding.find(f"{SSD}ParameterMapping")
            mapping = None
            if written is not None:
                mapping = self._document(written, base, written.find(f"{SSM}ParameterMapping"))
            self._apply(values, mapping, binding.get("prefix", ""), path)

    def _document(self, owner: ET.Element, base: Path, inline: ET.Element | None) -> ET.Element:
        if not owner.get("source"):
            assert inline is not None
            return inline
        return ET.parse(base.parent / unquote(owner.attrib["source"])).getroot()  # noqa: S314  as above

    def _apply(self, values: ET.Element, mapping: ET.Element | None, prefix: str, path: Path_) -> None:
        units = _units(values, SSV)
        for parameter in values.iterfind(f"{SSV}Parameters/{SSV}Parameter"):
            name = prefix + parameter.attrib["name"]
            element = parameter[0]
            unit = element.get("unit")
            given = Given(_value(element), units.get(unit, Unit(unit)) if unit else None)
            if mapping is None:
                self._give(path, name, given, None)
            for entry in mapping if mapping is not None else ():
                if entry.tag == f"{SSM}MappingEntry" and entry.attrib["source"] == name:
                    self._give(path, entry.attrib["target"], given, entry)

    def _give(self, path: Path_, name: str, given: Given, entry: ET.Element | None) -> None:
        """Give a value to everything of this name at or below ``path``; with nothing of this name it is ignored."""
        ends = [end for end in self._ends() if end[0][: len(path)] == path]
        for end in ends:
            if ".".join((*end[0][len(path) :], end[1])) != name:
                continue
            own, change = self._unit(end), Change()
            if entry is None or entry.get("suppressUnitConversion") not in ("true", "1"):
                change = self._converted(change, given.unit, own, f"{end} <- {name}")
            if entry is not None:
                transformation = next((child for child in entry if child.tag.startswith(SSC)), None)
                change = _transformed(change, transformation, {}, {})
            self.given[end] = Given(change.of(given.value), own or given.unit)

    def _ends(self) -> Iterator[End]:
        yield from ((path, name) for path, fmu in self.fmus.items() for name in fmu.variables)
        yield from (end for end in self.connectors if not self._owner_is_fmu(end))

    @staticmethod
    def _typed(fmu: Fmu, name: str, value: Value) -> Value:
        """A value as the type of an FMU's variable."""
        match fmu.variables[name].type:
            case "Real" | "Float64" | "Float32":
                return float(value)
            case "Boolean":
                return value in ("true", "1") if isinstance(value, str) else bool(value)
            case "String" | "Binary":
                return str(value)
            case "Enumeration" if isinstance(value, str):
                items = fmu.items_of(name)
                return items[value] if value in items else int(value)
            case _:
                return int(value)


def _value(element: ET.Element) -> Value:
    """A value as it is written, a number as a number."""
    type_ = element.tag.removeprefix(SSV)
    text = element.get("value", "")
    readers: dict[str, Callable[[str], Value]] = {"String": str, "Enumeration": str, "Binary": str, "Boolean": _boolean}
    return readers.get(type_, float if type_ in ("Real", "Float64", "Float32") else int)(text)


def _boolean(text: str) -> bool:
    return {"true": True, "1": True, "false": False, "0": False}[text]


def _transformed(
    change: Change, transformation: ET.Element | None, sources: Mapping[str, int], targets: Mapping[str, int]
) -> Change:
    if transformation is None:
        return change
    if transformation.tag == f"{SSC}LinearTransformation":
        return change.linear(float(transformation.get("factor", 1.0)), float(transformation.get("offset", 0.0)))
    read: Callable[[str], Value]
    match transformation.tag.removeprefix(SSC):
        case "BooleanMappingTransformation":
            return change._replace(tables=(*change.tables, _table(transformation, _boolean, _boolean)))
        case "IntegerMappingTransformation":
            return change._replace(tables=(*change.tables, _table(transformation, int, int)))
        case _:
            read = (lambda text: sources.get(text, text)) if sources else str
            write: Callable[[str], Value] = (lambda text: targets.get(text, text)) if targets else str
            return change._replace(tables=(*change.tables, _table(transformation, read, write)))


def _table(transformation: ET.Element, read: Callable[[str], Value], write: Callable[[str], Value]) -> Table:
    return {read(entry.attrib["source"]): write(entry.attrib["target"]) for entry in transformation}


def _units(root: ET.Element, namespace: str) -> dict[str, Unit]:
    units = {}
    for unit in root.iterfind(f"{namespace}Units/{SSC}Unit"):
        base = unit.find(f"{SSC}BaseUnit")
        if base is not None:
            exponents = tuple(int(base.get(name, "0")) for name in EXPONENTS)
            numbers = float(base.get("factor", "1")), float(base.get("offset", "0"))
            units[unit.attrib["name"]] = Unit(unit.attrib["name"], exponents, *numbers)
    return units


def _fmu_unit(unit: Any) -> Unit:  # noqa: ANN401  FMPy is untyped
    base = unit.baseUnit
    if base is None:
        return Unit(unit.name)
    exponents = tuple(int(getattr(base, name)) for name in EXPONENTS)
    return Unit(unit.name, exponents, float(base.factor), float(base.offset))


def _step_size(place: ET.Element) -> float | None:
    """The step size that an annotation of the system, or of the experiment, gives in s."""
    for annotation in place.iterfind(f"{SSD}Annotations/{SSC}Annotation"):
        for element in annotation.iter():
            name = element.tag.rpartition("}")[2]
            if annotation.get("type") == "org.openmodelica" and name == "FixedStepMaster":
                return float(element.attrib["stepSize"])
            if annotation.get("type") == "com.opensimulationplatform" and name == "FixedStepAlgorithm":
                return float(element.attrib["baseStepSize"])
    return None


def _hint(component: ET.Element) -> float | None:
    for annotation in component.iterfind(f"{SSD}Annotations/{SSC}Annotation"):
        for element in annotation.iter():
            if element.tag.rpartition("}")[2] == "StepSizeHint":
                return float(element.attrib["value"])
    return None
