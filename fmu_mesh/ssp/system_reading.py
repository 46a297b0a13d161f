"""From a package to the values of a configuration, as a YAML file gives them.

Owns which description of a package is read, what SSP cannot say and an option has to, and which part of the
configuration came from which line.
"""

from __future__ import annotations

import math
import posixpath
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final, Literal

from msgspec.structs import replace

from ..config.findings import Findings, ValueOrigin
from ..config.loading import PlainConfig
from ..config.mesh import LimitsConfig
from ..config.yaml_text import Plain
from ..errors import ConfigurationError, LoadFailed
from ..instances.fmi.archive.reading import read_description
from ..instances.fmi.step_options import Terms
from ..system.graph import feedback_edges, fewest_feedback_edges
from ..text import listed, meant, nearest
from ..variables.model_description import Kind, ModelDescription, Variable
from .flattening import FlatConnection, flatten
from .grammar import PATTERNS
from .naming import instance_name, mesh_name
from .own_annotation import ANNOTATION_TYPE, AnnotationRefused, chosen_names, merged
from .package import DEFAULT, RESULT_BESIDE_PACKAGE, Package
from .parameter_bindings import AppliedValue, ResolvedParameters, changed, resolve_parameters
from .problems import Problems
from .ssd_reading import annotations_of, read_structure, read_values
from .system_structure import (
    Annotation,
    FilePlace,
    Structure,
    StructureComponent,
    StructureSystem,
    components_of,
    elements_of,
)

__all__ = ["NEEDED", "chosen_description", "read_system"]

NEEDED: Final = {
    "simulation.step_size": "`step_size`, the communication step size in s",
    "simulation.stop_time": "`stop_time`, the end of the simulation in s",
    "simulation.algorithm": "`algorithm='jacobi'`, as OMSimulator and libcosim step, or `algorithm='gauss_seidel'`",
}
"""What a run needs and a package may not say, with the option that does."""

_KINDS: Final[Mapping[str, Kind]] = {
    "CoSimulation": "co_simulation",
    "ModelExchange": "model_exchange",
}
# SSP has no step size and no algorithm. OMSimulator and libcosim write their own, and both exchange values between
# steps of equal length: all components step with the values of the last communication point, which is `jacobi`.
_OPEN_MODELICA: Final = "org.openmodelica"
_OPEN_SIMULATION_PLATFORM: Final = "com.opensimulationplatform"
_STEP_SIZES: Final = {
    _OPEN_MODELICA: ("FixedStepMaster", "stepSize"),
    _OPEN_SIMULATION_PLATFORM: ("FixedStepAlgorithm", "baseStepSize"),
}
_HINTS: Final = {_OPEN_SIMULATION_PLATFORM: ("StepSizeHint", "value")}
_KNOWN: Final = {_OPEN_MODELICA, _OPEN_SIMULATION_PLATFORM, ANNOTATION_TYPE}


def read_system(
    path: Path, ssd: str | None = None, ssv: Sequence[str | Path] = (), *, annotated: bool = True
) -> PlainConfig:
    """Read a package as the values of a configuration.

    What the configuration means is checked with everything else before a run; so are the findings of the package. The
    arguments are those of `read_configuration`; each file with values is a last binding of the root system. If it is
    not ``annotated``, our annotation says the names of the instances only.

    Raises:
        ConfigurationError: there is no such package, description or file with values, or it has no system.
    """
    problems = Problems()
    with Package(path) as package:
        name = chosen_description(package, ssd)
        structure = read_structure(package, name, problems)
        if structure is None:
            Findings(package.shown(name), first=problems.findings).raise_any()
        assert structure is not None  # otherwise there is a finding
        chosen = [read_values(package, str(name), problems) for name in ssv]
        bindings = (*structure.system.bindings, *(binding for binding in chosen if binding is not None))
        structure = replace(structure, system=replace(structure.system, bindings=bindings))
        return _Configuration(package, name, structure, problems).plain(annotated=annotated)


def chosen_description(package: Package, ssd: str | None) -> str:
    """The file of the description that is asked for.

    Raises:
        ConfigurationError: there is none.
    """
    names = package.descriptions
    if ssd is None:
        if package.given:
            return package.given
        if DEFAULT in names:
            return DEFAULT
        inside = next((name for name in package.names() if name.endswith(f"/{DEFAULT}")), None)
        hint = f"It has '{inside}': zip what is inside that folder." if inside else "Is it a package of SSP?"
        if names:
            hint = f"It has {listed(names)}: choose one with `ssd=...`."
        raise ConfigurationError(f"'{package.root}' has no {DEFAULT} at its root", hint=hint)
    for wanted in (ssd, f"{ssd}.ssd"):
        if wanted in names:
            return wanted
    titles: dict[str, str] = {}
    for name in names:
        structure = read_structure(package, name, Problems())
        if structure is not None:
            titles.setdefault(structure.name, name)
    if ssd in titles:
        return titles[ssd]
    near = nearest(ssd, [*names, *(posixpath.splitext(name)[0] for name in names), *titles])
    raise ConfigurationError(
        f"'{package.root}' has no description '{ssd}'", hint=meant(near, f"It has {listed(names)}.")
    )


class _Configuration:
    """The values of a configuration, and where they come from."""

    def __init__(self, package: Package, name: str, structure: Structure, problems: Problems) -> None:
        self._package = package
        self._name = name
        self._structure = structure
        self._problems = problems
        self._components = dict(components_of(structure.system))
        self._descriptions: dict[tuple[str, str], ModelDescription | None] = {}
        self._file = Path(package.shown(name))
        self._lines: dict[str, int] = {}
        self._origins: dict[str, ValueOrigin] = {}
        self._explained: tuple[str, ...] = ()
        own = (one for one in structure.system.annotations if one.type == ANNOTATION_TYPE)
        self._annotation = next(own, None)
        self._names = self._chosen_names()

    def plain(self, *, annotated: bool) -> PlainConfig:
        """All of it, with what our annotation says."""
        system = self._structure.system
        parameters = resolve_parameters(system, self._describe, self._problems)
        units = {node: value.unit for node, value in parameters.of_systems.items() if value.unit is not None}
        connections, values = flatten(system, self._describe, self._problems, units)
        if self._annotation is None:
            connections = self._delayed_last(connections)
        self._settle(connections, values, parameters)
        known = all(not isinstance(one, StructureSystem) or one.is_known for _, one in elements_of(system))
        if not self._components and known:  # otherwise there is a finding
            found = "no component in it, nor in a system inside it: there is nothing to run"
            self._problems.add(system.place, found, "a Component with an FMU")
        if not self._components:
            self._explained += ("instances",)
        simulation = self._simulation()
        data: dict[str, Plain] = {
            "mesh": mesh_name(self._structure.name or self._package.root.stem),
            "simulation": simulation,
            "instances": self._instances(parameters.of_components, simulation),
            "connections": [self._connection(number, one) for number, one in enumerate(connections)],
        }
        if self._package.is_archive:
            data["record"] = {"file": RESULT_BESIDE_PACKAGE}
        if annotated and self._annotation is not None:
            data = self._with_annotation(data, self._annotation)
        times = data["simulation"]
        assert isinstance(times, dict)  # `merged` adds to a mapping
        self._place("", self._structure.place)
        self._note_annotations(system, simulation.get("step_size"))
        return PlainConfig(
            data,
            self._file,
            self._lines,
            tuple(self._problems.findings),
            origins=self._origins,
            warnings=tuple(self._problems.warnings),
            needed={key: option for key, option in NEEDED.items() if key.partition(".")[2] not in times},
            explained=self._explained,
            foreign="a package of SSP",
        )

    def _chosen_names(self) -> dict[str, str]:
        """The name of each instance, by the one that follows from its element."""
        defaults = [instance_name(path) for path in self._components]
        if self._annotation is not None:
            try:
                return chosen_names(defaults, self._annotation.text)
            except AnnotationRefused as refused:
                self._problems.add(self._annotation.place, refused.found, refused.expected)
                self._annotation = None
        return {name: name for name in defaults}

    def _with_annotation(self, data: dict[str, Plain], own: Annotation) -> dict[str, Plain]:
        """The values with what our annotation says."""
        folder = ".." if self._package.is_archive else ""
        try:
            result = merged(data, own.text, moved=lambda path: posixpath.join(folder, path))
        except AnnotationRefused as refused:
            self._problems.add(own.place, refused.found, refused.expected)
            return data
        record = result.data.get("record")
        if self._package.is_archive and isinstance(record, dict) and "file" not in record:
            result.data["record"] = {**record, "file": RESULT_BESIDE_PACKAGE}
        for path in result.paths:
            self._place(path, own.place)
        if "zenoh" in result.paths:
            found = f"the package says how the mesh connects: {str(result.data['zenoh'])[:200]}"
            self._problems.warn(own.place, found, "`connect=...` and `listen=...`, if you do not trust it")
        for gone in result.gone:
            self._problems.warn(own.place, f"{gone} is not there any more")
        return result.data

    def _describe(self, path: tuple[str, ...]) -> ModelDescription | None:
        """The model description of a component; None if it cannot be read: then the plan has a finding."""
        component = self._components[path]
        if not component.source:
            return None
        key = component.source, component.implementation
        if key not in self._descriptions:
            kind: Literal["auto"] | Kind = _KINDS.get(component.implementation, "auto")
            try:
                path_of_fmu = self._package.root / component.source
                found = read_description(path_of_fmu, Terms(LimitsConfig()), kind, to_run=False)
            except LoadFailed:
                found = None
            self._descriptions[key] = found
        return self._descriptions[key]

    def _settle(
        self, connections: Iterable[FlatConnection], values: Iterable[FlatConnection], parameters: ResolvedParameters
    ) -> None:
        """Give components the values of connectors of systems; a connected variable takes that of the connection."""
        of_components = parameters.of_components
        for value in values:
            path, variable = value.target
            if (applied := parameters.of_systems.get(value.source)) is not None:
                given = changed(applied, value.change, self._variable(value.target), path, self._problems)
                if given is not None:
                    of_components.setdefault(path, {})[variable] = given
        for connection in connections:
            path, variable = connection.target
            bound, target = of_components.get(path, {}).get(variable), self._variable(connection.target)
            if bound is None or (target is not None and target.causality == "input"):
                continue  # an input has it before the first value of the connection
            found = f"a value for '{'.'.join((*path, variable))}', which a connection gives its value"
            self._problems.warn(bound.origin, found)
            del of_components[path][variable]

    def _variable(self, end: tuple[tuple[str, ...], str]) -> Variable | None:
        """The variable of a component at an end of a connection; None if it is not known."""
        path, name = end
        description = self._describe(path)
        return description.variable_of(name) if description is not None else None

    # --- sections

    def _simulation(self) -> dict[str, Plain]:
        """What the package says about time."""
        structure, simulation = self._structure, dict[str, Plain]()
        if structure.start_time is not None:
            simulation["start_time"] = structure.start_time
        if structure.stop_time is not None:
            simulation["stop_time"] = structure.stop_time
        before = len(self._problems.findings)
        found = _base_step_size(annotations_of(structure), self._problems)
        if len(self._problems.findings) > before:
            self._explained += ("simulation.step_size", "simulation.algorithm")
        if found is not None:
            step_size, annotation = found
            simulation |= {"step_size": step_size, "algorithm": "jacobi"}
            for key in ("step_size", "algorithm"):
                self._place(f"simulation.{key}", annotation.place)
        self._place("simulation", structure.place)
        return simulation

    def _instances(
        self, values: Mapping[tuple[str, ...], Mapping[str, AppliedValue]], simulation: Mapping[str, Plain]
    ) -> dict[str, Plain]:
        instances: dict[str, Plain] = {}
        for path, component in self._components.items():
            name = self._names[instance_name(path)]
            section: dict[str, Plain] = {"fmu": component.source}
            place = f"instances.{name}"
            self._place(place, component.place)
            if component.implementation in _KINDS:
                section["kind"] = _KINDS[component.implementation]
            if (step_size := self._step_size(component, simulation)) is not None:
                section["step_size"] = step_size
            applied = values.get(path, {})
            if applied:
                section["start_values"] = {variable: one.value for variable, one in applied.items()}
                for variable, one in applied.items():
                    text = f"{one.origin.element}{f', {one.how}' if one.how else ''}"
                    origin = ValueOrigin(one.origin.file, one.origin.line, text)
                    self._origins[f"{place}.start_values.{variable}"] = origin
            instances[name] = section
        return instances

    def _step_size(self, component: StructureComponent, simulation: Mapping[str, Plain]) -> float | None:
        """The step size that libcosim takes for a component: a multiple of the base step size, in whole nanoseconds."""
        hint = _step_size(component.annotations, _HINTS, "{0} '{2}'", self._problems)
        base = simulation.get("step_size")
        if hint is None or not isinstance(base, float):
            return None
        points = max(1, _nanoseconds(hint[0]) // max(1, _nanoseconds(base)))
        if points * base != hint[0]:
            found = f"the step size {hint[0]:g} s, for which {points * base:.12g} s is taken"
            self._problems.warn(hint[1].place, found, f"a whole multiple of {base:g} s")
        return points * base if points > 1 else None

    def _delayed_last(self, connections: list[FlatConnection]) -> list[FlatConnection]:
        """With Gauss-Seidel the connections that are written last are delayed: let these be as few as possible.

        Nobody has chosen the order in a document. If no other order has fewer delays, it stays.
        """
        targets = [self._variable(one.target) for one in connections]
        pairs = zip(connections, targets, strict=True)
        stepped = [one for one, target in pairs if target is None or target.causality != "parameter"]
        edges = [(one.source[0], one.target[0], True) for one in stepped]
        paths = dict.fromkeys(path for source, target, _ in edges for path in (source, target))
        fewest = fewest_feedback_edges(paths, edges)
        if len(fewest) == len(feedback_edges(paths, edges)):
            return connections
        last = {stepped[index].target for index in fewest}
        return sorted(connections, key=lambda one: one.target in last)

    def _connection(self, number: int, connection: FlatConnection) -> dict[str, Plain]:
        """A connection as a configuration has it."""
        self._place(f"connections[{number}]", connection.place)
        both = connection.source, connection.target
        ends = [f"{self._names[instance_name(path)]}.{variable}" for path, variable in both]
        written: dict[str, Plain] = {"from": ends[0], "to": ends[1]}
        linear = connection.change.linear
        if linear.factor != 1.0:
            written["factor"] = linear.factor
        if not linear.identity and repr(linear.offset) != "0.0":  # -0.0 is another offset for a factor
            written["offset"] = linear.offset
        if connection.change.ignore_units:
            written["ignore_units"] = True
        if connection.change.mapping:
            target = self._variable(connection.target)
            entries = connection.change.mapping.items()
            written["map"] = {have: _map_value(want, target) for have, want in entries}
        if connection.change.place is not None:
            for key in ("factor", "offset", "map"):
                self._place(f"connections[{number}].{key}", connection.change.place)
        return written

    def _place(self, path: str, place: FilePlace) -> None:
        """Note where a part of the configuration is written; in another file than the description, with that file."""
        if place.file == str(self._file):
            self._lines[path] = place.line
        elif path:
            self._origins[path] = ValueOrigin(place.file, place.line, place.element)

    def _note_annotations(self, system: StructureSystem, step_size: Plain) -> None:
        """Note which annotations of a system, and of those in it, have no effect."""
        annotations = annotations_of(self._structure) if system is self._structure.system else system.annotations
        own = _base_step_size(system.annotations, Problems())
        if own is not None and own[0] != step_size:
            found = f"a step size of {own[0]:g} s for the system '{system.name}'"
            self._problems.warn(own[1].place, found, "that of the root system, which all its instances have")
        solvers = [(name, one) for one in annotations if one.type == _OPEN_MODELICA for name, _ in one.elements]
        for solver, annotation in (both for both in solvers if both[0] in {"VariableStepSolver", "FixedStepSolver"}):
            found = (
                f"the {solver} for the whole system '{system.name}' is not used: an FMU for co-simulation has its own "
                "solver, and one for model exchange gets one of its own, see `solver`"
            )
            self._problems.warn_once(("solver", solver), annotation.place, found, "system")
        for element in system.elements:
            annotations += element.annotations if isinstance(element, StructureComponent) else ()
            if isinstance(element, StructureSystem):
                self._note_annotations(element, step_size)
        for annotation in annotations:
            if annotation.type not in _KNOWN:
                found = "its type is not known: it has no effect"
                self._problems.warn_once(("annotation", annotation.type), annotation.place, found, "annotation")


def _nanoseconds(seconds: float) -> int:
    """A duration as libcosim has it, in 64 bits."""
    return round(min(seconds * 1e9, 2.0**62))


def _map_value(text: str, target: Variable | None) -> bool | int | str:
    """The value that a mapping gives to a variable: as a configuration has it, from the text of the mapping."""
    if target is not None and target.type == "Boolean":
        return text == "true"
    names = [item for item, _ in target.items] if target is not None else []
    return int(text) if text not in names and re.fullmatch(r"-?[0-9]+", text) else text


def _base_step_size(annotations: Iterable[Annotation], problems: Problems) -> tuple[float, Annotation] | None:
    """The step size of a whole system in s, and the annotation that says it; None if none does.

    The annotations are those of the root system, of its default experiment and of its description.
    """
    return _step_size(annotations, _STEP_SIZES, "{0} with {1} '{2}'", problems)


def _step_size(
    annotations: Iterable[Annotation], places: Mapping[str, tuple[str, str]], words: str, problems: Problems
) -> tuple[float, Annotation] | None:
    """The first step size at one of the places: element and attribute by type of annotation. Others are findings."""
    for annotation in annotations:
        wanted, attribute = places.get(annotation.type, ("", ""))
        for text in (attributes.get(attribute) for name, attributes in annotation.elements if name == wanted):
            number = (text or "").strip()
            value = float(number) if PATTERNS["number"].fullmatch(number) else math.nan
            if math.isfinite(value) and value > 0.0:
                return value, annotation
            problems.add(annotation.place, words.format(wanted, attribute, text), "a step size > 0 in s")
    return None
