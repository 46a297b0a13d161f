"""The plan of a mesh as text: what `str(mesh.check())` and `fmu-mesh check` show."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from ..config.findings import ValueOrigin
from ..config.group_section import group_name
from ..config.loading import LoadedConfig
from ..rings.library import library_missed, why_no_library
from ..run.one_process import apart, claims_in
from ..run.run_plan import why_no_checkpoints
from ..system.linear_inputs import counted_ways
from ..system.placement import two_trips
from ..system.plan import RECORDER, Plan
from ..system.played_nodes import keeps_states, played_nodes, stateless
from ..system.process_sharing import automatic_nodes
from ..system.records import RecordPlan
from ..system.schedule import Course, Schedule
from ..system.series_files import course_of
from ..system.system import Connection, SystemInstance
from ..system.value_map import map_text
from ..text import listed, short_number, short_path, shown
from ..variables.model_description import Variable
from ..variables.value_conversion import to_plain
from .tables import pairs, table, titled

__all__ = ["plan_page", "scheduled", "slower_than_it_could_be", "start_value_origin"]

_PROBLEM_CHARACTERS = 200


def plan_page(plan: Plan, loaded: LoadedConfig | None = None) -> list[str]:
    """The plan as lines of text, the same everywhere; ``loaded`` says where start values come from."""
    sections = [
        ("", _head(plan)),
        ("Instances", _instances(plan)),
        ("Hosts", _hosts(plan)),
        ("Start values", _start_values(plan, loaded)),
        ("Connections", _connections(plan)),
        ("Coupling", _coupling(plan)),
        ("Zenoh keys", _keys(plan)),
        ("Execution order within one point", _order(plan)),
        ("Groups", _groups(plan)),
        ("Scenario", _scenario(plan)),
        ("Inputs that are not connected", _free_inputs(plan)),
        ("Timeouts", _timeouts(plan)),
        ("Initialization", _initialization(plan)),
        ("States", _states(plan)),
        ("Recorded", _recorded(plan)),
        ("Topics in ROS", table([own.cells for own in plan.system.topics], indent=2)),
        ("Warnings", _warnings(plan)),
    ]
    return titled(sections)


def slower_than_it_could_be() -> str | None:
    """A warning where the library of C is missing and could be used."""
    return f"the library of C is {why_no_library()}" if library_missed() else None


def _head(plan: Plan) -> list[str]:
    simulation, grid = plan.system.config.simulation, plan.grid
    factor = simulation.real_time_factor
    window = f"{plan.window} points" if plan.window > 1 else "1 point: lockstep"
    end = f"{short_number(grid.stop_time)} s in {grid.last_point}" if grid.stop_time is not None else "an open end in"
    times = f"{short_number(grid.start_time)} s to {end} steps of"
    return pairs(
        [
            ("Mesh", plan.system.config.mesh),
            ("Simulation", f"{times} {short_number(grid.step_size)} s"),
            ("Algorithm", simulation.algorithm),
            ("Window", window),
            ("Speed", f"{factor:g} times real time" if factor else "as fast as possible"),
            ("Library", why_no_library() or ""),
        ]
    )


def _instances(plan: Plan) -> list[str]:
    rows, notes = [], []
    for name, own in plan.system.instances.items():
        section = plan.system.config.instances[name]
        summary, other = section.summary(own.description), section.other_kind(own.description)
        notes += [f"  {name} {other}"] if other is not None else []
        model = f"{Path(own.fmu).name or own.description.model_name} ({summary})"
        step = f"step {short_number(own.step_points * plan.grid.step_size)} s"
        rows.append([name, model, step, "a process of its own" if own.node == name else f"group {own.node}"])
    return [*table(rows, indent=2), *notes]


def _hosts(plan: Plan) -> list[str]:
    """What runs where, and which values make two trips; nothing if everything runs on the host of `launch`."""
    if not (hosts := plan.hosts):
        return []
    nodes: dict[str | None, list[str]] = {}
    for name, node in plan.nodes.items():
        nodes.setdefault(node.host, []).append("recorder" if name == RECORDER else name)
    clock = ", whose clock paces all" if plan.system.config.simulation.real_time_factor else ""
    rows = [["where `launch` runs", ", ".join([f"master{clock}", *nodes.get(None, [])]), ""]]
    for name, host in hosts.items():
        rows.append([name, ", ".join(nodes[name]), f"ssh {host.ssh}" if host.ssh is not None else "started by hand"])
    return [*table(rows, indent=2), *(f"  {sentence}" for sentence in two_trips(plan))]


def _start_values(plan: Plan, loaded: LoadedConfig | None) -> list[str]:
    rows = [
        [
            f"{instance.name}.{name}",
            f"= {shown(value)}{_unit(instance.description.variable(name))}",
            str(start_value_origin(loaded, instance, name)) if loaded is not None else "",
        ]
        for instance in plan.system.instances.values()
        for name, value in instance.start_values.items()
    ]
    return table(rows, indent=2)


def start_value_origin(loaded: LoadedConfig, instance: SystemInstance, variable: str) -> ValueOrigin:
    """Where a start value comes from: a line of a file, as short as a person would write its path, or an option."""
    own = loaded.config.instances[instance.name].start_values  # the scenario has none of these
    written = variable if variable in own else next((name for name in own if name.startswith(f"{variable}[")), None)
    path = f"instances.{instance.name}.start_values.{written}"
    origin = loaded.origin(path) if written is not None else loaded.scenario_origin
    return origin._replace(file=short_path(origin.file)) if origin.file else origin


def _connections(plan: Plan) -> list[str]:
    closing_ones = {str(c) for c in plan.closing}
    rows = []
    for c in plan.connections:
        if c.initial_only:
            rows.append([str(c), "", "value in the initialization", _arithmetic(c), "", c.units])
            continue
        what = "value at the start of the step" if c.delay else "value at the end of the step"
        closing = "closes a cycle" if str(c) in closing_ones else ""
        if c.extrapolation == "linear":
            what = "goes on linearly in the step" if c.delay else "changes linearly in the step"
        elif c.extrapolation == "midpoint":
            what = "the middle of its line in the step"
        rows.append([str(c), f"delay {c.delay}", what, _arithmetic(c), closing, c.units])
    return table(rows, indent=2)


def _coupling(plan: Plan) -> list[str]:
    """Of which order the coupling is, what would be better, and which outputs are made consistent."""
    stepped = [c for c in plan.connections if not c.initial_only]
    instances, sections = plan.system.instances, plan.system.config.instances
    ways = [(c, c.extrapolation) for c in stepped if c.extrapolation != "hold"]
    lines = []
    if better := counted_ways(stepped, {name: own.description for name, own in instances.items()}, sections):
        lines.append(f"  order 1, because inputs are held; `extrapolation: auto` has order 2: {better}")
    direct = [c for c in stepped if c.source.feedthrough and (c.source_instance, c.source_name) not in plan.consistent]
    if ways and direct:
        names = listed([f"{c.source_instance}.{c.source_name}" for c in direct])
        lines.append(f"  order 1 behind {names}, which depend directly on inputs, without `loops: solved`")
    rules = [(c, plan.rule_of(c)) for c, _ in ways]
    if late := [str(c) for c, own in rules if own.source_points > own.target_points and not (own.delay or own.ahead)]:
        lines.append(f"  extrapolated, because the slower source waits for inputs with delay 0: {listed(late)}")
    if plan.consistent:
        lines.append(f"  consistent at each point: {listed(['.'.join(own) for own in plan.consistent])}")
    return lines


def _keys(plan: Plan) -> list[str]:
    recorded = plan.system.recorded_keys
    lines = table([own.cells for own in plan.system.keys], indent=2)
    return [*lines, f"  their values come from {short_path(recorded.path)}"] if recorded is not None else lines


def _free_inputs(plan: Plan) -> list[str]:
    """Inputs that keep their start values unless they are set: a forgotten connection is visible here."""
    connected = {(c.target_instance, c.target.name) for c in plan.connections}
    connected |= {(name, own.variable) for name, item in plan.system.instances.items() for own in item.scenario}
    connected |= {(own.instance, own.variable) for own in plan.system.keys if own.direction == "in"}
    lines = []
    for name, instance in plan.system.instances.items():
        free = [v for v in instance.description.variables if v.causality == "input" and (name, v.name) not in connected]
        starts = [(v, instance.start_values.get(v.name, v.start)) for v in free]
        shown_ = [f"{v.name}{f' = {shown(start)}' if start is not None else ''}{_unit(v)}" for v, start in starts]
        if shown_:
            lines.append([name, listed(shown_)])
    return table(lines, indent=2)


def _timeouts(plan: Plan) -> list[str]:
    instances = plan.system.instances.items()
    return table([[f"{name}.{own.variable}", str(own)] for name, item in instances for own in item.timeouts], indent=2)


def _scenario(plan: Plan) -> list[str]:
    rows = []
    for name, own, course, (first, last) in scheduled(plan):
        if course.changes == 1:
            since = "" if own.initial and not course.first_step else f" from {short_number(first)} s on"
            unit = _unit(plan.system.instances[name].description.variable(own.variable))
            what, shape = f"= {shown(to_plain(course.end))}{unit}{since}", ""
        else:
            what = f"{course.changes} values from {short_number(first)} s to {short_number(last)} s"
            shape = "linear" if own.linear else "hold"
        source = f"column '{own.file.column}' of {short_path(own.file.path)}" if own.file is not None else ""
        rows.append([f"{name}.{own.variable}", what, shape, source])
    return table(rows, indent=2)


def scheduled(plan: Plan) -> Iterator[tuple[str, Schedule, Course, tuple[float, float]]]:
    """What the scenario sets: the instance, how, and the times in s of the first and the last value."""
    for name, instance in plan.system.instances.items():
        for own in instance.scenario:
            variable = instance.description.variable(own.variable)
            assert variable is not None  # the plan is valid
            course = course_of(own, variable, plan.grid, instance.step_points)
            first, last = (plan.grid.time(n * instance.step_points) for n in (course.first_step, course.last_step))
            yield name, own, course, (first, last)


def _arithmetic(c: Connection) -> str:
    """The formula of a connection, or its map; empty if it copies the value."""
    if c.map:
        return f"map {map_text(c.map, c.source, c.target)}"
    if (c.factor, c.offset) == (1.0, 0.0):
        return ""
    product = f"{short_number(c.factor)} * {c.source_name}" if c.factor != 1.0 else c.source_name
    sign = "-" if c.offset < 0.0 else "+"
    sum_ = f"{product} {sign} {short_number(abs(c.offset))}" if c.offset else product
    return f"{c.target_name} = {sum_}"


def _order(plan: Plan) -> list[str]:
    is_chain = any(c.delay == 0 for c in plan.connections)
    together = "  (at the same time)" if len(plan.order) > 1 and not is_chain else ""
    lines = [f"  {(' -> ' if is_chain else ', ').join(plan.order)}{together}"]
    lines += [f"  cycle: {', '.join(cycle)}" for cycle in plan.cycles]
    return lines


def _groups(plan: Plan) -> list[str]:
    """For each cycle, what `group: auto` does or would do, and why; and what cannot share a process."""
    config, instances = plan.system.config, plan.system.instances
    edges = [(c.source_instance, c.target_instance) for c in plan.connections if not c.initial_only]
    automatic = automatic_nodes(config, edges, claims_in(plan))
    lines = [
        f"  '{own.name}' is solved at each point: {listed([str(unknown) for unknown in own.unknowns])}"
        for own in plan.groups
    ]
    for cycle in plan.cycles:
        names = ", ".join(sorted(cycle, key=[*instances].index))
        now = {plan.node_of(name) for name in cycle}
        would = {automatic.get(name, group_name(config.instances[name].group) or name) for name in cycle}
        if len(now) > 1:
            cost = f"{names} form a cycle over {len(now)} nodes: each point costs a round trip"
            lines.append(f"  {cost}; {_remedy(len(now), len(would))}")
        elif config.group == "auto" and any(name in automatic for name in cycle):
            lines.append(f"  {names} form a cycle: together in '{now.pop()}', each point costs no round trip")
    return [*lines, *(f"  {why}" for why in apart(plan))]


def _remedy(nodes: int, automatic: int) -> str:
    if automatic == 1:
        return "`group: auto` would put them into one"
    apart = "groups, hosts, or what cannot share a process keep them apart"
    return apart if automatic >= nodes else f"`group: auto` would put them into {automatic}, since {apart}"


def _initialization(plan: Plan) -> list[str]:
    """The levels in which outputs are computed, and which ones are iterated together."""
    loops = {loop.first: loop for loop in plan.initialization.loops}
    levels: dict[int, list[str]] = {}
    by_order = sorted(plan.initialization.levels.items(), key=lambda item: plan.order.index(item[0][0]))
    for (name, variable), level in by_order:
        levels.setdefault(level, []).append(f"{name}.{variable}")
    lines = []
    for level, names in sorted(levels.items()):
        lines.append(f"  level {level}: {', '.join(names)}")
        if level in loops:
            last = loops[level].last
            until = f"levels {level} to {last} are" if last > level else f"level {level} is"
            assumed = (
                f"{t.target}.{t.input} = {shown(t.start)}"
                f"{_unit(plan.system.instances[t.target].description.variable_of(t.input))}"
                for t in loops[level].tears
            )
            lines[-1:-1] = [f"  {until} iterated, beginning with {', '.join(assumed)}"]
    return lines


def _states(plan: Plan) -> list[str]:
    """Which instances have a state that outlives their process, and why others have none; nothing if all have one.

    And with which point a restart begins, if it does not begin with a checkpoint, or not for all.
    """
    without = stateless(plan.system)
    able = [name for name in plan.system.instances if name not in without]
    lines = [f"  {', '.join(able)}: can be written"] if able and without else []
    lines += (f"  {name}: cannot be written: {why}" for name, why in without.items())
    if not keeps_states(plan.system.config.recovery):
        return lines
    if why := why_no_checkpoints(plan):
        return [*lines, f"  after a loss, all is calculated again from the first point: {why}"]
    played = played_nodes(plan.system, plan.outputs)
    if played.names:
        going = ", ".join(name for name in plan.system.instances if name not in played.again)
        lines.append(
            f"  after a loss, these go on from a checkpoint: {going}; {played.point_bytes:g} bytes a point are kept"
        )
    again = (f"  after a loss, all steps of {name} are taken again: {why}" for name, why in played.again.items())
    return [*lines, *again]


def _recorded(plan: Plan) -> list[str]:
    """The columns of each result file, and its points if it does not have all of them."""
    instances, lines = plan.system.instances, []
    for record in plan.system.records:
        rows = []
        for name, variable in record.variables:
            described = instances[name].description.variable_of(variable)
            type_ = described.type_name.partition("[")[0] if described is not None else ""
            rows.append([f"{name}.{variable}", type_, _unit(described).strip()])
        lines += [*table(rows, indent=2), f"  into {short_path(record.file)}{_points_of(record, plan)}"]
    return lines or ["  nothing"]


def _points_of(record: RecordPlan, plan: Plan) -> str:
    """Which points a result file has, as the end of a line; empty for all of them."""
    step, parts = plan.grid.step_size, []
    if record.every > 1:
        parts.append(f"every {record.every} points ({short_number(record.every * step)} s)")
    if record.first:
        parts.append(f"from point {record.first} ({short_number(plan.grid.time(record.first))} s)")
    return f", {' '.join(parts)}" if parts else ""


def _warnings(plan: Plan) -> list[str]:
    lines = [f"  {warning}" for warning in plan.system.warnings]
    for instance in plan.system.instances.values():
        for problem in instance.description.problems:
            text = " ".join(problem.split())
            short = text if len(text) <= _PROBLEM_CHARACTERS else text[: _PROBLEM_CHARACTERS - 3] + "..."
            lines.append(f"  {instance.name}: {Path(instance.fmu).name}: {short}")
    return lines


def _unit(variable: Variable | None) -> str:
    return f" {variable.unit}" if variable is not None and variable.unit else ""
