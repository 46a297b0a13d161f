"""The plan of a mesh as plain values: names and plain values, without what only nodes need."""

from __future__ import annotations

import msgspec

from ..config.key_sections import KeyView
from ..config.loading import LoadedConfig
from ..config.mesh import SimulationConfig
from ..config.ros_section import MeshTopic
from ..errors import Finding
from ..rings.library import why_no_library
from ..system.input_timeouts import InputTimeout
from ..system.placement import two_trips
from ..system.plan import Plan
from ..system.played_nodes import stateless
from ..system.value_map import map_words
from ..text import counted
from ..variables.value_conversion import to_plain
from ..variables.value_types import PlainValue
from .plan_page import scheduled, start_value_origin

__all__ = ["PlanView", "plan_view"]


class PlannedOrigin(msgspec.Struct, frozen=True):
    """Where a value was written: a line of a file, or an option; ``text`` has the option, or the element in words."""

    file: str | None
    line: int | None
    text: str


class PlannedInstance(msgspec.Struct, frozen=True):
    """One instance: its model, step size in s, node (process), start values with their origins, timeouts of inputs.

    Attributes:
        host: the host of `deploy.hosts` on which it runs; None: that of `launch`.
        stateless: why its state cannot be written to a file; None if it can.
    """

    name: str
    model: str
    step_size: float
    node: str
    start_values: dict[str, PlainValue]
    origins: dict[str, PlannedOrigin]
    timeouts: tuple[InputTimeout, ...] = ()
    host: str | None = None
    stateless: str | None = None


class PlannedConnection(msgspec.Struct, frozen=True):
    """One connection: the input is factor * output + offset, ``delay`` points later.

    Attributes:
        map: what the input gets instead of a value, items by their names; other values stay as they are.
        initial_only: whether it gives a parameter its value in the initialization, and has no part in the steps.
    """

    source: str = msgspec.field(name="from")
    target: str = msgspec.field(name="to")
    delay: int
    factor: float
    offset: float
    units: str
    closes_cycle: bool
    map: dict[str, str] = {}
    initial_only: bool = False


class PlannedRecord(msgspec.Struct, frozen=True):
    """One result file: its columns but the time, the point of its first row, and the points from row to row."""

    file: str
    variables: list[str]
    first: int
    every: int


class PlannedSchedule(msgspec.Struct, frozen=True):
    """What a scenario sets: number of values, and the times in s of the first and the last one."""

    variable: str
    values: int
    first: float
    last: float
    interpolation: str
    file: str | None


class PlanView(msgspec.Struct, frozen=True):
    """What would run.

    Attributes:
        simulation: the section of the configuration, options applied.
        last_point: number of the last point; None without a stop time.
        window: how many points a node may run ahead of the slowest.
        order: the instances in the order in which they step.
        cycles: the instances of each cycle.
        free_inputs: `instance.variable` of the inputs that are not connected.
        levels: level in the initialization of each connected output.
        recorded: `instance.variable` of the columns of the first result file.
        result_file: the first result file; None if nothing is recorded.
        records: all result files.
        scenario: what the scenario sets, by `instance.variable`.
        topics: those in ROS.
        keys: the Zenoh keys at ends of connections.
        warnings: findings that do not prevent a run.
        library: why the library of C is not used; None if it is.
        two_trips: connections between two hosts whose values go through a third one, that of `launch`, in words.
    """

    mesh: str
    simulation: SimulationConfig
    last_point: int | None
    window: int
    instances: list[PlannedInstance]
    connections: list[PlannedConnection]
    order: list[str]
    cycles: list[list[str]]
    free_inputs: list[str]
    levels: dict[str, int]
    recorded: list[str]
    result_file: str | None
    records: list[PlannedRecord]
    scenario: list[PlannedSchedule]
    warnings: tuple[Finding, ...]
    library: str | None
    topics: tuple[MeshTopic, ...] = ()
    keys: tuple[KeyView, ...] = ()
    two_trips: list[str] = []

    def __repr__(self) -> str:
        counts = f"{counted(len(self.instances), 'instance')}, {counted(len(self.connections), 'connection')}"
        return f"<PlanView of {self.mesh}: {counts}>"


def plan_view(plan: Plan, loaded: LoadedConfig) -> PlanView:
    """The plan as plain values; its configuration says where start values come from."""
    system, grid = plan.system, plan.grid
    closing = {str(connection) for connection in plan.closing}
    connected = {(c.target_instance, c.target.name) for c in plan.connections}
    connected |= {(own.instance, own.variable) for own in system.keys if own.direction == "in"}
    without = stateless(system)
    instances = [
        PlannedInstance(
            own.name,
            own.fmu,
            own.step_points * grid.step_size,
            own.node,
            {name: to_plain(value) for name, value in own.start_values.items()},
            {
                name: PlannedOrigin(origin.file or None, origin.line, origin.text)
                for name in own.start_values
                for origin in [start_value_origin(loaded, own, name)]
            },
            own.timeouts,
            plan.nodes[own.node].host,
            without.get(own.name),
        )
        for own in system.instances.values()
    ]
    connections = [
        PlannedConnection(
            f"{c.source_instance}.{c.source_name}",
            f"{c.target_instance}.{c.target_name}",
            c.delay or 0,
            c.factor,
            c.offset,
            c.units,
            str(c) in closing,
            map_words(c.map, c.source, c.target),
            c.initial_only,
        )
        for c in plan.connections
    ]
    free = (
        f"{name}.{variable.name}"
        for name, own in system.instances.items()
        for variable in own.description.variables
        if variable.causality == "input" and (name, variable.name) not in connected
    )
    records = [
        PlannedRecord(own.file, [f"{name}.{variable}" for name, variable in own.variables], own.first, own.every)
        for own in system.records
    ]
    return PlanView(
        mesh=system.config.mesh,
        simulation=system.config.simulation,
        last_point=grid.last_point if grid.stop_time is not None else None,
        window=plan.window,
        instances=instances,
        connections=connections,
        order=[*plan.order],
        cycles=[[*cycle] for cycle in plan.cycles],
        free_inputs=[*free],
        levels={f"{name}.{variable}": level for (name, variable), level in plan.initialization.levels.items()},
        recorded=records[0].variables if records else [],
        result_file=system.result_file,
        records=records,
        scenario=[
            PlannedSchedule(
                f"{name}.{own.variable}",
                course.changes,
                *times,
                "linear" if own.linear else "hold",
                own.file.path if own.file is not None else None,
            )
            for name, own, course, times in scheduled(plan)
        ],
        warnings=system.warnings,
        library=why_no_library(),
        topics=system.topics,
        keys=system.keys,
        two_trips=two_trips(plan),
    )
