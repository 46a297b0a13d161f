"""The plan of a mesh: delays, order, cycles, initialization levels, and the tasks of every node.

Owns the synchronization model (docs/architecture.md) as data. The plan is a pure function of a
`ResolvedSystem`. Every process of a mesh computes or receives the same plan; they compare its digest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import msgspec
from msgspec.structs import replace

from ..config.deploy_section import HostConfig
from ..config.findings import Findings
from ..config.instance_sections import Extrapolation, InstanceSection, ProcessConfig, placed
from ..config.key_sections import KEY
from ..config.mesh import InitializationConfig, LimitsConfig, TimeoutsConfig
from ..simtime import TimeGrid
from ..variables.model_description import Variable
from ..variables.value_conversion import ValueRefused, to_plain
from ..variables.value_types import PlainValue, is_float
from .attempt import Attempt
from .consistent_outputs import consistent_outputs
from .coupling_rule import Consistent, CouplingRule
from .digest import digest_of
from .execution_order import execution_order, steps_ahead
from .feeds import Feed, compared_of, feeds_of, reads_of, step_feeds_of
from .initialization_plan import InitializationPlan, Loop, check_loops, plan_initialization
from .input_timeouts import InputTimeout
from .layout import Layout, row_bytes
from .linear_inputs import LinearInput
from .live_keys import KeyInput, KeyOutput, RecordedKeys
from .memory_map import MASTER, RECORDER, MemoryMap, RingPlace, map_memory
from .node_links import Link, links_of
from .played_nodes import keeps_states, played_nodes
from .records import RecordPlan
from .schedule import Schedule, row_of
from .solved_groups import SolvedGroup, blocks_of, solved_groups
from .start_values import why_not_settable
from .system import Connection, ResolvedSystem, SystemInstance
from .window import recorder_window, rows_of_ring, window_of

__all__ = ["MASTER", "RECORDER", "Feed", "InstancePlan", "Link", "NodePlan", "Plan", "make_plan"]


class InstancePlan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The part of one instance in the plan of a node.

    Attributes:
        step_points: base points per own step.
        outputs: the columns read after every step: connected outputs, and recorded variables of any causality.
        inputs: the connected inputs, set before every step.
        initialization: the levels of its connected outputs in Initialization Mode, by name.
        section: its section of the configuration, without the common keys: their meaning is in the other fields. It is
            decoded with the hook `fmu_mesh.instances.registry.decode_section`, because only that knows the kinds.
        step_feeds: what its steps read: the connections, with what makes outputs consistent.
        ahead: whether it takes its steps ahead of those that read it; see `steps_ahead`.
        linear_inputs: the inputs that change linearly within a step; ``midpoint_inputs``: those that get the middle.
        row: the inputs that are set in every step: ``inputs``, and the Float64 inputs of the scenario and of keys.
        parameters: the connections to parameters, whose values are transferred in Initialization Mode only.
        initial_inputs: what is set in Initialization Mode: ``inputs``, and the connected parameters.
        initial_outputs: what is read in Initialization Mode only.
        finite: those of ``outputs`` that end the run where they are not finite; ``not_finite``: what that means.
        timeouts: what its inputs do without a value.
        keys_in: the variables that get the values of keys; ``keys_out``: those whose values go to keys.
        recorded_keys: where the values of keys come from instead.
    """

    name: str
    fmu: str
    start_values: dict[str, PlainValue]
    step_points: int
    outputs: Layout
    inputs: Layout
    feeds: tuple[Feed, ...]
    step_feeds: tuple[Feed, ...]
    initialization: dict[str, int]
    section: InstanceSection
    ahead: bool = False
    linear_inputs: tuple[LinearInput, ...] = ()
    midpoint_inputs: tuple[LinearInput, ...] = ()
    scenario: tuple[Schedule, ...] = ()
    row: Layout | None = None
    parameters: tuple[Feed, ...] = ()
    initial_inputs: Layout = Layout()
    initial_outputs: Layout = Layout()
    finite: tuple[str, ...] = ()
    not_finite: Literal["stop", "record"] = "stop"
    timeouts: tuple[InputTimeout, ...] = ()
    keys_in: tuple[KeyInput, ...] = ()
    keys_out: tuple[KeyOutput, ...] = ()
    recorded_keys: RecordedKeys | None = None

    @property
    def input_row(self) -> Layout:
        """The inputs that are set in every step."""
        return self.row if self.row is not None else self.inputs

    @property
    def wait_points(self) -> int:
        """Where all step point by point: the points from the first one of its step to that after which it is taken."""
        return 0 if self.ahead else self.step_points - 1

    @property
    def sources(self) -> dict[str, str]:
        """What feeds each input that is connected, or of which an element is: an instance, or a key in words."""
        fed = {self.inputs.column(own.target).name: feed.source for feed in self.feeds for own in feed.columns}
        return fed | {own.variable: f"{KEY}{own.key}" for own in self.keys_in}

    def check_settable(self, variable: Variable) -> None:
        """Check that a variable may be set between two steps.

        Raises:
            ValueRefused: it may not; the message is the predicate of a sentence whose subject is the variable.
        """
        if (why := why_not_settable(variable, self.sources.get(variable.name))) is not None:
            raise ValueRefused(why)


class NodePlan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The plan of one node.

    Attributes:
        units: the instances in execution order. Those of one inner tuple form a cycle within the node and step point by
            point; the others run ahead as far as their inputs and the grant allow.
        window: number of points that this node may be behind the grant.
        progress_stride: points between two progress messages to the master: a quarter of the window, or a longer step.
        windows: number of points that each node, and last the recorder, may be behind the others, by name.
        batch: number of points that it may sleep for at once; 1 if others may wait for its own next row.
        memory: where everything lies in the memory that processes of one host share.
        rings: the output rings of its instances, and of all instances that it has values from.
        groups: the solved groups of its instances: each is one unit.
        loops: the algebraic loops at the start with instances of this node; ``initialization``: how they are iterated.
        shared_memory: whether processes of one host exchange messages through shared memory.
        row_streams: whether processes that share no memory exchange rows through sockets of their own.
        records: the result files, if it is the recorder; ``secured``: whether those who set values have names.
        process: what its process may take; ``host``: the host that it runs on; None: that of `launch`.
        saves: whether the states of its instances belong to a checkpoint for a restart.
    """

    mesh: str
    node: str
    digest: str
    key_prefix: str
    grid: TimeGrid
    window: int
    progress_stride: int
    windows: tuple[tuple[str, int], ...]
    batch: int
    memory: MemoryMap
    rings: tuple[RingPlace, ...]
    timeouts: TimeoutsConfig
    instances: tuple[InstancePlan, ...]
    units: tuple[tuple[str, ...], ...]
    links_in: tuple[Link, ...]
    links_out: tuple[Link, ...]
    groups: tuple[SolvedGroup, ...] = ()
    loops: tuple[Loop, ...] = ()
    initialization: InitializationConfig = InitializationConfig()
    records: tuple[RecordPlan, ...] = ()
    limits: LimitsConfig = LimitsConfig()
    shared_memory: bool = True
    row_streams: bool = True
    attempt: Attempt = Attempt()
    secured: bool = False
    process: ProcessConfig = ProcessConfig()
    host: str | None = None
    saves: bool = True

    def instance(self, name: str) -> InstancePlan:
        """The plan of one of its instances."""
        return next(instance for instance in self.instances if instance.name == name)

    @property
    def interpreter(self) -> str | None:
        """The Python that has to run this node; None: the one that runs fmu-mesh."""
        return next((own for item in self.instances if (own := item.section.interpreter) is not None), None)

    def peers(self) -> set[str]:
        """Names of the nodes that exchange frames with this one, without the recorder, which is part of the master."""
        nodes = {link.source_node for link in self.links_in} | {link.target_node for link in self.links_out}
        return nodes - {RECORDER}

    @property
    def step_sources(self) -> set[str]:
        """Names of the nodes whose rows it needs in its steps."""
        return {link.source_node for link in self.links_in if not link.initial_only}

    @property
    def step_targets(self) -> set[str]:
        """Names of the nodes that need its rows in their steps, with the recorder."""
        return {link.target_node for link in self.links_out if not link.initial_only}


class Plan(msgspec.Struct, frozen=True):
    """The plan of the whole mesh.

    Attributes:
        connections: the connections of the system, each with its delay.
        order: instance names in execution order within one point.
        cycles: instance names of every cycle.
        closing: the connections that have a delay of 1 because they close a cycle.
        ahead: the instances that take their steps ahead of those that read them.
        consistent: the formula of each output that is made consistent, by instance and name of the output or element.
        groups: the groups that are solved.
        nodes: by node name, with the recorder if there is one.
        played: the nodes whose rows are kept for a restart, because others have no state.
    """

    system: ResolvedSystem
    connections: tuple[Connection, ...]
    order: tuple[str, ...]
    cycles: tuple[tuple[str, ...], ...]
    closing: tuple[Connection, ...]
    ahead: tuple[str, ...]
    consistent: dict[tuple[str, str], Consistent]
    groups: tuple[SolvedGroup, ...]
    initialization: InitializationPlan
    window: int
    digest: str
    nodes: dict[str, NodePlan]
    played: tuple[str, ...] = ()

    @property
    def grid(self) -> TimeGrid:
        """The communication points of the run."""
        return self.system.grid

    @property
    def hosts(self) -> dict[str, HostConfig]:
        """The hosts that nodes run on, besides the one of `launch`, by name."""
        named = {node.host for node in self.nodes.values()}
        return {name: host for name, host in self.system.config.deploy.hosts.items() if name in named}

    @property
    def outputs(self) -> dict[str, Layout]:
        """The columns of the rows of each instance."""
        return {item.name: item.outputs for node in self.nodes.values() for item in node.instances}

    def rule_of(self, connection: Connection) -> CouplingRule:
        """Which row of its source a step of its target gets."""
        c, instances = connection, self.system.instances
        source, target = (instances[name].step_points for name in (c.source_instance, c.target_instance))
        return CouplingRule(c.delay or 0, source, target, c.ahead, self.grid.last_point // source)

    def node_of(self, instance: str) -> str:
        """The name of the node of an instance."""
        return self.system.instances[instance].node


def make_plan(
    system: ResolvedSystem,
    *,
    window: int | None = None,
    findings: Findings | None = None,
    contents: Mapping[str, str] = {},
) -> Plan:
    """Plan a validated system; a ``window`` in points overrides that of the configuration.

    An error has the ``findings`` about this host, too. The contents are the SHA-256 of each model, by instance name.

    Raises:
        ConfigurationError: a cycle has no delay; names the cycle.
    """
    findings = Findings(system.config.mesh) if findings is None else findings
    names, how = [*system.instances], system.config.simulation.algorithm
    points = {name: own.step_points for name, own in system.instances.items()}
    blocks = blocks_of(system.config.members)  # their outputs are consistent as they are
    direct = {name: own for name, own in system.feedthrough.items() if name not in blocks}
    consistent = consistent_outputs(system.connections, direct, points, findings)
    solved = consistent if system.config.simulation.loops == "solved" else None
    made = execution_order(names, system.connections, how, findings, blocks, solved)
    _, closing, order, cycles = made
    connections, ahead = steps_ahead(made, points, blocks, consistent)
    groups = solved_groups(system.config.members, connections, order, system.feedthrough)
    compares = system.config.simulation.defects and system.records  # it is done where rows are written
    system = replace(
        system,
        records=tuple(record.with_consistent(consistent) for record in system.records),
        compared=tuple(compared_of(connections, consistent, points)) if compares else (),
    )
    initialization = plan_initialization(system, connections)
    check_loops(initialization, connections, {n: own.description for n, own in system.instances.items()}, findings)
    reads = reads_of(connections, consistent)
    outputs = system.output_layouts(read[:2] for read in reads)
    window = window_of(system.config.simulation.window if window is None else window, outputs.values())
    played = played_nodes(system, outputs).names if keeps_states(system.config.recovery) else ()
    plan = Plan(
        system, connections, order, cycles, closing, ahead, consistent, groups, initialization, window, "", {}, played
    )
    kept = {name: own.names for name, own in outputs.items() if system.instances[name].node in played}
    nodes = _nodes(plan, outputs, links_of(system, reads, initialization, kept))
    digest = _digest(system, nodes, contents)
    return replace(plan, digest=digest, nodes={name: replace(node, digest=digest) for name, node in nodes.items()})


def _digest(system: ResolvedSystem, nodes: dict[str, NodePlan], contents: Mapping[str, str]) -> str:
    """The digest that all processes must have: it covers the content of files, but not where they are on each host."""
    agreed = [
        replace(
            node,
            limits=LimitsConfig(),
            process=ProcessConfig(),
            host=None,  # no number depends on it
            records=tuple(replace(record, file="") for record in node.records),
            instances=tuple(
                replace(
                    instance,
                    fmu="",
                    section=instance.section.agreed(),
                    scenario=tuple(schedule.agreed() for schedule in instance.scenario),
                    recorded_keys=None,
                )
                for instance in node.instances
            ),
        )
        for node in nodes.values()
    ]
    return digest_of(agreed, system, contents)


def _nodes(plan: Plan, outputs: Mapping[str, Layout], links: Sequence[Link]) -> dict[str, NodePlan]:
    system, config = plan.system, plan.system.config
    recorded = {link.source for link in links if link.target_node == RECORDER}
    windows = dict.fromkeys((instance.node for instance in system.instances.values()), plan.window)
    if recorded:
        windows[RECORDER] = recorder_window(plan.window, [row_bytes(outputs[name]) for name in recorded])
    longest_step = max(instance.step_points for instance in system.instances.values())
    rings = {}
    for name, own in system.instances.items():
        # A source may be two own steps beyond the grant (the step it takes, and the step for which it holds its value).
        # A target may be one own step behind the progress it has told.
        behind = (windows[RECORDER] if name in recorded else plan.window) + 3 * longest_step
        count = rows_of_ring(outputs[name], -(-behind // own.step_points), max(windows.values()))
        rings[name] = own.node, own.step_points, outputs[name], count
    memory, places = map_memory([*windows], rings)
    nodes = {}
    for node in windows:
        members = [name for name in plan.order if plan.node_of(name) == node]
        within = _units(plan, node, members)
        # A cycle over several nodes, or another program, waits for each row.
        waits = any(own.wait for name in members for own in system.instances[name].keys_in)
        shared = any(name in cycle and len(within[name]) < len(cycle) for name in members for cycle in plan.cycles)
        links_in = tuple(link for link in links if link.target_node == node)
        nodes[node] = NodePlan(
            mesh=config.mesh,
            node=node,
            digest="",
            key_prefix=config.zenoh.key_prefix,
            grid=plan.grid,
            window=windows[node],
            progress_stride=windows[node] // 4 if windows[node] >= 4 * longest_step else 1,
            windows=tuple(windows.items()),
            batch=1 if shared or waits else max(1, plan.window // 16),
            memory=memory,
            rings=tuple(
                places[name]
                for name in dict.fromkeys([*members, *(link.source for link in links_in if not link.initial_only)])
            ),
            timeouts=config.timeouts,
            instances=tuple(_instance_plan(plan, system.instances[name], outputs[name]) for name in members),
            units=tuple(dict.fromkeys(within[name] for name in members)),
            links_in=links_in,
            links_out=tuple(link for link in links if link.source_node == node),
            groups=tuple(group for group in plan.groups if group.members[0] in members),
            loops=tuple(loop for loop in plan.initialization.loops if node in loop.nodes),
            initialization=config.initialization,
            records=system.records if node == RECORDER else (),
            limits=config.limits,
            shared_memory=config.zenoh.shared_memory,
            row_streams=config.row_streams,
            secured=config.security is not None,
            process=config.process_of(config.instances[members[0]]).of_node if members else ProcessConfig(),
            host=config.deploy.known(config.instances[members[0]].host) if members else None,
            saves=not plan.played or node in plan.played,
        )
    return nodes


def _units(plan: Plan, node: str, members: list[str]) -> dict[str, tuple[str, ...]]:
    """The unit of each member of a node: its cycle if all of it is in this node, its solved group, or itself alone.

    A cycle over several nodes is stepped member by member, because a member may wait for another node that waits for a
    member of this node.
    """
    units: dict[str, tuple[str, ...]] = {name: (name,) for name in members}
    units |= {name: group.members for group in plan.groups for name in group.members if name in units}
    for cycle in plan.cycles:
        if all(plan.node_of(name) == node for name in cycle):
            unit = tuple(name for name in plan.order if name in cycle)
            units.update(dict.fromkeys(unit, unit))
    return units


def _instance_plan(plan: Plan, instance: SystemInstance, outputs: Layout) -> InstancePlan:
    stepped = [c for c in plan.connections if c.target_instance == instance.name and not c.initial_only]
    initial = [c for c in plan.connections if c.target_instance == instance.name and c.initial_only]
    connected = {c.target.name for c in stepped}
    initialized = connected | {c.target.name for c in initial}
    read = {c.source.name for c in plan.connections if c.source_instance == instance.name} - {*outputs.names}
    given = {variable.name for variable in instance.description.with_causality("output")}
    driven = {own.variable for own in instance.scenario} | {own.variable for own in instance.keys_in}
    checked = tuple(c.name for c in outputs.columns if is_float(c.type) and c.name in given)
    return InstancePlan(
        name=instance.name,
        fmu=instance.fmu,
        start_values={variable: to_plain(value) for variable, value in instance.start_values.items()},
        step_points=instance.step_points,
        outputs=outputs,
        inputs=Layout.of(v for v in instance.description.variables if v.name in connected),
        feeds=feeds_of(stepped, plan.rule_of),
        step_feeds=step_feeds_of(stepped, plan.consistent, plan.rule_of),
        initialization={v: level for (own, v), level in plan.initialization.levels.items() if own == instance.name},
        section=placed(plan.system.config.instances[instance.name], instance.not_finite),
        ahead=instance.name in plan.ahead,
        linear_inputs=_following(plan, stepped, "linear"),
        midpoint_inputs=_following(plan, stepped, "midpoint"),
        scenario=instance.scenario,
        row=row_of(instance.description, driven, connected),
        parameters=feeds_of(initial, plan.rule_of),
        initial_inputs=Layout.of(v for v in instance.description.variables if v.name in initialized),
        initial_outputs=Layout.of(v for v in instance.description.variables if v.name in read),
        finite=checked if instance.not_finite == "stop" else (),
        not_finite=instance.not_finite,
        timeouts=instance.timeouts,
        keys_in=instance.keys_in,
        keys_out=instance.keys_out,
        recorded_keys=plan.system.recorded_keys if instance.keys_in else None,
    )


def _following(plan: Plan, connections: Sequence[Connection], way: Extrapolation) -> tuple[LinearInput, ...]:
    """The inputs of these connections that follow the line of their source in one way."""
    ends = bool(plan.consistent)
    return tuple(LinearInput(c.target.name, plan.rule_of(c), ends) for c in connections if c.extrapolation == way)
