"""The order in which connected outputs are computed in Initialization Mode, and which of them are iterated.

Each connected output has a level. It is 0 if the output depends on no connected input; otherwise it is one more than
the highest level of the outputs that these inputs are connected to (FMI 2.0, 2.2.8, InitialUnknowns). Outputs that
depend on each other form a loop (docs/adr/0013). A loop is torn at some of its connections, and its outputs get their
levels in the torn graph. These levels are repeated until the torn connections have the assumed values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import itemgetter

import msgspec

from ..config.findings import Findings
from ..variables.model_description import ModelDescription, Variable
from ..variables.value_conversion import to_plain
from ..variables.value_types import PlainValue, Value, VariableType, nested, zero
from .graph import reaches, strongly_connected
from .system import Connection, ResolvedSystem

__all__ = ["InitializationPlan", "Loop", "Tear", "check_loops", "needed_initially", "plan_initialization"]

Key = tuple[str, str]


class Tear(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A connection at which a loop is torn. Its input has an assumed value, which the iteration corrects.

    Attributes:
        output: as `y`, or an element of it as `y[2]`; ``input`` likewise.
        type: the type of the input, or of the element.
        shape: the sizes of its dimensions.
        start: the first assumed value: the start value of the input.
        map: see `Connection`; ``items`` likewise.
    """

    source: str
    output: str
    target: str
    input: str
    factor: float
    offset: float
    type: VariableType
    start: PlainValue
    shape: tuple[int, ...] = ()
    map: tuple[tuple[int, int], ...] = ()
    items: tuple[tuple[str, int], ...] = ()

    def __str__(self) -> str:
        return f"{self.source}.{self.output} -> {self.target}.{self.input}"


class Loop(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An algebraic loop in Initialization Mode.

    Attributes:
        first: its first level. Outputs outside of the loop have none of its levels.
        last: its last level.
        tears: the torn connections; without them there is no cycle.
        outputs: (instance, output) of all its outputs, in the order of their levels.
        nodes: the nodes with these outputs.
    """

    first: int
    last: int
    tears: tuple[Tear, ...]
    outputs: tuple[Key, ...]
    nodes: tuple[str, ...]


class InitializationPlan(msgspec.Struct, frozen=True):
    """Levels of connected outputs by (instance, output), and the loops among them in the order of their levels."""

    levels: dict[Key, int]
    loops: tuple[Loop, ...]


def plan_initialization(system: ResolvedSystem, connections: Sequence[Connection]) -> InitializationPlan:
    """Levels of all connected outputs, and the loops.

    In Initialization Mode a delay has no effect, but a connection with a delay is torn before one without: so the
    values flow in the order of the steps.
    """
    outputs = tuple(dict.fromkeys((c.source_instance, c.source.name) for c in connections))
    reached = _reached(system, connections)
    edges = [(_source(c), target) for c in connections for target in reached[id(c)]]
    on_themselves = {source for source, target in edges if source == target}
    place = {key: number for number, key in enumerate(outputs)}
    leaving: dict[Key, list[tuple[int, Connection]]] = {}
    for number, c in enumerate(connections):
        leaving.setdefault(_source(c), []).append((number, c))
    levels: dict[Key, int] = {}
    loops: list[Loop] = []
    level = 0
    for parts in _by_depth(outputs, edges):
        single = [part[0] for part in parts if len(part) == 1 and part[0] not in on_themselves]
        levels.update(dict.fromkeys(single, level))
        level += bool(single)
        for part in parts:
            if len(part) > 1 or part[0] in on_themselves:
                members = sorted(part, key=place.__getitem__)
                own = [c for _, c in sorted((pair for key in part for pair in leaving[key]), key=itemgetter(0))]
                torn, kept = _torn(members, own, reached)
                depths = {key: depth for depth, deep in enumerate(_by_depth(members, kept)) for (key,) in deep}
                levels.update({key: level + depth for key, depth in depths.items()})
                last = level + max(depths.values())
                ordered = tuple(sorted(members, key=depths.__getitem__))
                nodes = tuple(dict.fromkeys(system.instances[name].node for name, _ in members))
                loops.append(Loop(level, last, tuple(_tear(system, c) for c in torn), ordered, nodes))
                level = last + 1
    return InitializationPlan(levels=levels, loops=tuple(loops))


def check_loops(
    plan: InitializationPlan,
    connections: Sequence[Connection],
    descriptions: Mapping[str, ModelDescription],
    findings: Findings,
) -> None:
    """Refuse parameters of FMI 1.0 in a loop: they cannot be set again after the initialization.

    Raises:
        ConfigurationError: there is one; has all findings.
    """
    wrong = False
    for c in connections:
        target, source = c.target_instance, (c.source_instance, c.source.name)
        if not c.initial_only or not descriptions[target].fmi_version.startswith("1"):
            continue
        if any(source in loop.outputs and any(name == target for name, _ in loop.outputs) for loop in plan.loops):
            found = f"{c}, whose value depends on '{target}' itself in the initialization"
            findings.add(c.path, found, "no such dependency: FMI 1.0 cannot set a parameter again")
            wrong = True
    if wrong:
        findings.raise_any()


def _torn(
    members: Sequence[Key], connections: Sequence[Connection], reached: Mapping[int, Sequence[Key]]
) -> tuple[list[Connection], list[tuple[Key, Key]]]:
    """The connections of a loop at which it is torn, and the remaining edges.

    Like the delays of Gauss-Seidel, it is the connection written last that closes a cycle; of those to parameters, none
    if there is another one.
    """
    own = set(members)
    torn: set[int] = set()
    kept: list[tuple[Key, Key]] = []
    successors: dict[Key, list[Key]] = {key: [] for key in members}
    for connection in sorted(connections, key=lambda c: -1 if c.initial_only else c.delay or 0):
        source = _source(connection)
        targets = [key for key in reached[id(connection)] if key in own]
        if any(reaches(successors, target, source) for target in targets):
            torn.add(id(connection))
        else:
            kept += [(source, target) for target in targets]
            successors[source].extend(targets)
    return [c for c in connections if id(c) in torn], kept


def _tear(system: ResolvedSystem, connection: Connection) -> Tear:
    instance, variable = system.instances[connection.target_instance], connection.target
    start: Value | None = instance.start_values.get(variable.name, variable.start)
    if start is None:  # an input must have one (FMI 2.0, 2.2.7)
        start = nested([zero(variable.type)] * variable.size, variable.shape)
    for number in connection.target_index:
        assert isinstance(start, list)
        start = start[number]
    return Tear(
        source=connection.source_instance,
        output=connection.source_name,
        target=connection.target_instance,
        input=connection.target_name,
        factor=connection.factor,
        offset=connection.offset,
        type=variable.type,
        start=to_plain(start),
        shape=() if connection.target_index else variable.shape,
        map=connection.map,
        items=connection.items,
    )


def _reached(system: ResolvedSystem, connections: Sequence[Connection]) -> dict[int, list[Key]]:
    """The connected outputs that depend on the target of a connection, by the id of the connection."""
    outputs: dict[str, dict[str, Variable]] = {}
    parameters: dict[str, list[str]] = {}
    for c in connections:
        outputs.setdefault(c.source_instance, {})[c.source.name] = c.source
        if c.initial_only:
            parameters.setdefault(c.target_instance, []).append(c.target.name)
    # By instance and known: the outputs that depend on it, with their places; those that may depend on all by None.
    dependents: dict[tuple[str, str | None], list[tuple[int, str]]] = {}
    for instance, own in outputs.items():
        for number, output in enumerate(own.values()):
            description = system.instances[instance].description
            declared = _dependencies(output, parameters.get(instance, []), description)
            for known in dict.fromkeys(declared) if declared is not None else (None,):
                dependents.setdefault((instance, known), []).append((number, output.name))
    reached = {}
    for c in connections:
        target = c.target_instance
        both = dependents.get((target, None), []) + dependents.get((target, c.target.name), [])
        reached[id(c)] = [(target, name) for _, name in sorted(both)]
    return reached


def _dependencies(source: Variable, parameters: Sequence[str], description: ModelDescription) -> tuple[str, ...] | None:
    """The knowns that the source of a connection depends on, with those of its ``parameters`` that are connected.

    FMI 2.0 and 3.0 declare them for initial unknowns; a local variable that is none of them may depend on everything.
    All others declare dependencies on inputs only. FMI 1.0 has no Initialization Mode: whatever is read there is read
    after the parameters have been set.
    """
    version = description.fmi_version[:1]
    given = source.causality == "parameter" or source.variability == "constant" or source.initial == "exact"
    declared: tuple[str, ...] | None = () if given else source.dependencies
    if not given and source.causality != "output" and version and not declared:
        return None
    if declared is None or version in ("2", "3") or (given and version != "1"):
        return declared
    return (*declared, *parameters)


def _by_depth(vertices: Sequence[Key], edges: Sequence[tuple[Key, Key]]) -> list[list[list[Key]]]:
    """The strongly connected components by depth: the number of components on the longest path to them."""
    parts = strongly_connected(vertices, edges)
    part_of = {key: number for number, part in enumerate(parts) for key in part}
    before: list[set[int]] = [set() for _ in parts]
    for source, target in edges:
        if part_of[source] != part_of[target]:
            before[part_of[target]].add(part_of[source])
    depths: list[int] = []
    for others in before:  # sources come before their targets
        depths.append(1 + max((depths[other] for other in others), default=-1))
    by_depth: list[list[list[Key]]] = [[] for _ in range(max(depths, default=-1) + 1)]
    for part, depth in zip(parts, depths, strict=True):
        by_depth[depth].append(part)
    return by_depth


def _source(connection: Connection) -> Key:
    return connection.source_instance, connection.source.name


def needed_initially(
    system: ResolvedSystem,
    connections: Sequence[Connection],
    plan: InitializationPlan,
    needed: Mapping[tuple[str, str], set[str]],
) -> dict[tuple[str, str], set[str]]:
    """What a node needs for parameters or to iterate a loop and no other link has (``needed``), by (instance, node)."""
    initial, nodes = dict[tuple[str, str], set[str]](), {name: own.node for name, own in system.instances.items()}
    for c in connections:
        own = c.source_instance, nodes[c.target_instance]
        if c.initial_only and own[1] != nodes[c.source_instance] and c.source.name not in needed.get(own, ()):
            initial.setdefault(own, set()).add(c.source.name)
    for loop in plan.loops:
        for node in loop.nodes:
            for tear in loop.tears:
                output = system.base_of(tear.source, tear.output)
                if node != nodes[tear.source] and output not in needed.get((tear.source, node), ()):
                    initial.setdefault((tear.source, node), set()).add(output)
    return initial
