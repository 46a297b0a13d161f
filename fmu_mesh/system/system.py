"""The validated system: every name of the configuration is resolved with the model descriptions.

Owns the meaning of names, causality, types and step sizes. Delays, order and cycles are `fmu_mesh.system.plan`. The
model descriptions are arguments: this module knows neither FMPy nor Zenoh.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from functools import partial
from typing import Literal

import msgspec
from msgspec.structs import replace

from fmu_mesh import files
from fmu_mesh.config.access_sections import check_access
from fmu_mesh.config.deploy_section import check_deploy
from fmu_mesh.config.findings import Findings
from fmu_mesh.config.group_section import group_name
from fmu_mesh.config.instance_sections import InstanceSection, key_of
from fmu_mesh.config.key_sections import KEY, KeyView
from fmu_mesh.config.loading import LoadedConfig
from fmu_mesh.config.mesh import Config, sources_of
from fmu_mesh.config.ros_section import MeshTopic
from fmu_mesh.errors import Finding
from fmu_mesh.simtime import ENDLESS, TimeGrid, steps_between
from fmu_mesh.system.connections import Connection, Variables, resolve_connections, unit_warnings
from fmu_mesh.system.couplings import coupled_connections
from fmu_mesh.system.execution_order import execution_order
from fmu_mesh.system.feeds import Compared
from fmu_mesh.system.input_timeouts import InputTimeout
from fmu_mesh.system.layout import Layout
from fmu_mesh.system.linear_inputs import with_extrapolation
from fmu_mesh.system.live_keys import KeyInput, KeyOutput, RecordedKeys, key_views, resolve_keys
from fmu_mesh.system.process_sharing import ClaimsOf, SharedProcess, automatic_nodes
from fmu_mesh.system.records import CheckRecord, RecordPlan, record_warnings, resolve_records, union_of
from fmu_mesh.system.scenario import ResolvedScenario, Scenario, ScenarioInput, resolve_scenario
from fmu_mesh.system.schedule import Schedule
from fmu_mesh.system.solved_groups import blocks_of, check_solved_groups
from fmu_mesh.system.start_values import check_substitutes, forbidden_start_values, resolve_start_values, sized
from fmu_mesh.text import listed, nearest, nearest_file, shown
from fmu_mesh.variables.model_description import ModelDescription, Value
from fmu_mesh.variables.units import BaseUnit
from fmu_mesh.variables.value_conversion import ValueRefused, to_plain, to_value

__all__ = ["Connection", "ResolvedSystem", "SystemInstance", "build"]

_RESERVED_NAME = "mesh"


class SystemInstance(msgspec.Struct, frozen=True):
    """One instance of the system.

    Attributes:
        fmu: absolute path of the model; empty for a kind without files.
        start_values: start values by variable name, converted to the variable's type; with those of the scenario.
        step_points: its step size as a multiple of the base step size; 1 or more.
        node: name of its node (process): its group, that of its cycle (`group: auto`), or its own name.
        not_finite: what an output that is NaN or infinite means.
        timeouts: what its inputs do without a value.
        keys_in: the variables that get the values of keys; ``keys_out``: those whose values go to keys.
    """

    name: str
    fmu: str
    description: ModelDescription
    start_values: dict[str, Value]
    step_points: int
    node: str
    scenario: tuple[Schedule, ...] = ()
    not_finite: Literal["stop", "record"] = "stop"
    timeouts: tuple[InputTimeout, ...] = ()
    keys_in: tuple[KeyInput, ...] = ()
    keys_out: tuple[KeyOutput, ...] = ()


class ResolvedSystem(msgspec.Struct, frozen=True):
    """A configuration whose names are all resolved.

    Attributes:
        instances: in the order of the file.
        records: the result files; empty if nothing is recorded.
        warnings: findings that do not prevent a run, such as connections between different units.
        scenario_files: the SHA-256 of each file with values of the scenario, by absolute path.
        topics: those in ROS.
        recorded_keys: an earlier run, whose values of keys this run gets instead of those of the keys.
        begins_with: the state file with which it begins, absolute, or nothing; the ``replaced`` begin anew there.
        feedthrough: the derivatives of outputs by inputs at the same point, if outputs are made consistent.
        compared: what targets assume over their steps, if that is compared with what comes.
    """

    config: Config
    grid: TimeGrid
    instances: dict[str, SystemInstance]
    connections: tuple[Connection, ...]
    records: tuple[RecordPlan, ...] = ()
    warnings: tuple[Finding, ...] = ()
    scenario_files: dict[str, str] = {}
    topics: tuple[MeshTopic, ...] = ()
    recorded_keys: RecordedKeys | None = None
    begins_with: str = ""
    feedthrough: dict[str, dict[str, dict[str, float]]] = {}
    replaced: tuple[str, ...] = ()
    compared: tuple[Compared, ...] = ()

    @property
    def keys(self) -> tuple[KeyView, ...]:
        """The Zenoh keys at ends of connections."""
        own = self.instances.items()
        return tuple(key for name, one in own for key in key_views(name, *one.keys_in, *one.keys_out))

    @property
    def recorded(self) -> tuple[tuple[str, str], ...]:
        """(instance, variable) of what is read where rows are written, each once; an element is `y[1,2]`."""
        return union_of(self.records, self.compared)

    def base_of(self, instance: str, name: str) -> str:
        """The variable of a column or of an end of a connection, which may be an element of an array, as `y[1,2]`."""
        variable = self.instances[instance].description.variable_of(name)
        return variable.name if variable is not None else name

    def output_layouts(self, reads: Iterable[tuple[str, str]]) -> dict[str, Layout]:
        """What is read of each instance after a step: what ``reads`` names, what is recorded, and what goes to keys.

        In the order of its model description.
        """
        wanted = {name: {sent.variable for sent in own.keys_out} for name, own in self.instances.items()}
        for instance, variable in (*reads, *self.recorded):
            wanted[instance].add(self.base_of(instance, variable))
        return {
            name: Layout.of(variable for variable in own.description.variables if variable.name in wanted[name])
            for name, own in self.instances.items()
        }

    @property
    def result_file(self) -> str | None:
        """Absolute path of the first result file, or None if nothing is recorded."""
        return self.records[0].file if self.records else None


def build(  # noqa: PLR0913, PLR0917  a configuration, and what was found about it before
    loaded: LoadedConfig,
    descriptions: Mapping[str, ModelDescription],
    findings: Iterable[Finding] = (),
    scenario: Scenario | None = None,
    claims: ClaimsOf = lambda _name: {},
    obstacles: Findings | None = None,
    check_record: CheckRecord = lambda *_: None,
    unit_of: Callable[[str], BaseUnit | None] = lambda _name: None,
) -> ResolvedSystem:
    """Resolve every name of a configuration.

    Args:
        loaded: the configuration and its places in the file.
        descriptions: the model descriptions by instance name. One may be missing because its model could not be read;
            then ``findings`` must say why, and checks that need it are left out.
        findings: earlier findings; the error has them, too.
        scenario: the scenario, if there is one.
        claims: what an instance claims of its process.
        obstacles: where findings go that prevent a run on this host, and not its plan, such as a missing package; None:
            to the others. An error has them, too.
        check_record: what the format of each result file says about it; its findings are obstacles.
        unit_of: the meaning of a unit by its usual name; None if it is not known.

    Raises:
        ConfigurationError: there are findings; it has all of them.
    """
    config, collected = loaded.config, loaded.findings()
    collected.merge(findings)
    descriptions = {
        name: sized(name, description, config.instances[name], collected)
        for name, description in descriptions.items()
        if name in config.instances
    }
    variables = Variables(descriptions, [*config.instances])
    grid = _grid(config, collected)
    instances = _instances(loaded, descriptions, collected)
    forbidden_start_values(config, descriptions, collected, strict=True)
    _check_nodes(config, descriptions, claims, collected)
    connections = resolve_connections(config.connections, variables, collected)
    connections += coupled_connections(config.engines, variables, connections, collected)
    connections = with_extrapolation(config, connections, descriptions, collected)
    check_solved_groups(config.members, descriptions, connections, collected)
    if obstacles is not None:
        obstacles.explain(collected.places)
    of_files = collected if obstacles is None else obstacles
    records = resolve_records(loaded, variables, grid, collected, of_files, check_record)
    connected = {f"{c.target_instance}.{c.target.name}": c.source_instance for c in connections}
    root, step_size = f"{config.zenoh.key_prefix}/{config.mesh}/", config.simulation.step_size
    keys_in, keys_out = resolve_keys(config.connections, root, step_size, variables, connected, unit_of, collected)
    sources = sources_of(config.connections) | connected  # also those of wrong connections
    fed = {name for name, source in sources.items() if not source.startswith(KEY)}
    timeouts = {
        name: tuple(_timeouts(own, config, fed, grid.step_size if grid else 1.0, collected))
        for name, own in instances.items()
        if config.instances[name].inputs
    }
    timed = {(name, timeout.variable) for name, own in timeouts.items() for timeout in own}
    prescribed = _prescribed(scenario, variables, instances, sources, grid, collected)
    doors = _check_zenoh(loaded, collected)
    if len(collected):
        collected.merge(obstacles or ())
        how, blocks = config.simulation.algorithm, blocks_of(config.members)
        execution_order([*instances], connections, how, collected, blocks)  # for its findings
    if grid is None or len(instances) < len(config.instances):
        collected.raise_any()
        missing = [name for name in config.instances if name not in descriptions]
        raise ValueError(f"no model description and no finding for {missing}")
    collected.raise_any()
    if config.group == "auto":
        edges = [(c.source_instance, c.target_instance) for c in connections if not c.initial_only]
        nodes = automatic_nodes(config, edges, claims)
        instances = {name: replace(own, node=nodes.get(name, own.node)) for name, own in instances.items()}
    instances = {
        name: replace(
            own,
            start_values=own.start_values | prescribed.start_values.get(name, {}),
            scenario=tuple(
                replace(one, every=(name, one.variable) in timed) for one in prescribed.schedules.get(name, ())
            ),
            timeouts=timeouts.get(name, ()),
            keys_in=keys_in.get(name, ()),
            keys_out=keys_out.get(name, ()),
        )
        for name, own in instances.items()
    }
    warnings = loaded.findings()
    forbidden_start_values(config, descriptions, warnings, strict=False)
    unit_warnings(connections, descriptions, warnings)
    warnings.merge(prescribed.warnings)
    _doubts(config, descriptions, warnings)
    record_warnings(loaded, variables, records, warnings)
    all_warnings = (*doors, *loaded.warnings, *warnings)
    return ResolvedSystem(config, grid, instances, connections, records, all_warnings, prescribed.files)


def _prescribed(  # noqa: PLR0913, PLR0917  what a scenario refers to
    scenario: Scenario | None,
    variables: Variables,
    instances: Mapping[str, SystemInstance],
    sources: Mapping[str, str],
    grid: TimeGrid | None,
    findings: Findings,
) -> ResolvedScenario:
    """What the scenario prescribes. Without a time grid, for which there is a finding, it is checked all the same."""
    if scenario is None:
        return ResolvedScenario()
    grid = grid or TimeGrid(start_time=0.0, step_size=1.0, last_point=ENDLESS)
    inputs = {name: ScenarioInput(own.start_values, own.step_points, own.not_finite) for name, own in instances.items()}
    own = findings if scenario.source.prefix else scenario.source.findings()  # a file of its own has its own
    prescribed = resolve_scenario(scenario, variables, inputs, sources, grid, own)
    if own is not findings:
        findings.merge(own)
    return prescribed


def _grid(config: Config, findings: Findings) -> TimeGrid | None:
    simulation = config.simulation
    start, stop, step = simulation.start_time, simulation.stop_time, simulation.step_size
    if simulation.real_time_factor < 0.0:
        found = f"{simulation.real_time_factor:g}"
        findings.add("simulation.real_time_factor", found, "0 (as fast as possible) or a positive factor")
    if step <= 0.0 or math.isinf(step):
        findings.add("simulation.step_size", f"{step:g}", "a step size > 0 in s")
        return None
    if any(time is not None and math.isnan(time) for time in (start, stop, step)):
        return None  # a placeholder, for which there is a finding already
    last_point = _last_point(start, stop, step, findings) if stop is not None else ENDLESS
    return TimeGrid(start_time=start, step_size=step, last_point=last_point) if last_point is not None else None


def _last_point(start: float, stop: float, step: float, findings: Findings) -> int | None:
    if stop < start:
        findings.add("simulation.stop_time", f"{stop:g}, before start_time {start:g}", f"a time >= {start:g}")
        return None
    if not (stop - start) / step < ENDLESS:
        found = f"more than {ENDLESS} points from {start:g} s to {stop:g} s in steps of {step:g} s"
        findings.add("simulation.step_size", found, "a larger step size or an earlier stop time")
        return None
    last_point = steps_between(start, stop, step)
    if last_point is None:
        below = math.floor((stop - start) / step)
        expected = f"a whole multiple of it, as with stop_time {start + below * step:.12g}"
        duration = f"{stop - start:.12g} s between start_time and stop_time"
        found = f"{duration}, no whole multiple of step_size {step:.12g} s"
        findings.add("simulation.stop_time", found, f"{expected} or {start + (below + 1) * step:.12g}")
    return last_point


def _instances(
    loaded: LoadedConfig, descriptions: Mapping[str, ModelDescription], findings: Findings
) -> dict[str, SystemInstance]:
    """All instances with a model description."""
    base = loaded.config.simulation.step_size
    instances: dict[str, SystemInstance] = {}
    for name, config in loaded.config.instances.items():
        if name == _RESERVED_NAME:
            findings.add(f"instances.{name}", f"the name '{name}'", "another name: it is reserved for the mesh itself")
        step_points = _step_points(name, config, base, findings)
        if name not in descriptions:
            continue
        not_finite, described = loaded.config.not_finite(config), descriptions[name]
        start_values = resolve_start_values(name, config, described, findings, finite=not_finite == "stop")
        check_substitutes(name, config, described, findings, finite=not_finite == "stop")
        config.check(f"instances.{name}", descriptions[name], findings)
        fixed, own = None if described.fmi_version else described.fixed_step_size, step_points * base
        if fixed is not None and 0.0 < own < math.inf and not steps_between(0.0, own, fixed):
            found = f"{own:.12g} s, no whole multiple of the {fixed:.12g} s that one step in '{name}' takes"
            findings.add(f"instances.{name}.step_size", found, "a multiple of it")
        instances[name] = SystemInstance(
            name=name,
            fmu=str(loaded.resolve(config.path)) if config.path else "",
            description=descriptions[name],
            start_values=start_values,
            step_points=step_points,
            node=group_name(config.group) or name,
            not_finite=not_finite,
        )
    return instances


def _timeouts(
    instance: SystemInstance, config: Config, sources: AbstractSet[str], base: float, findings: Findings
) -> Iterator[InputTimeout]:
    """What the inputs of an instance do without a value; ``sources`` has those that are connected."""
    inputs = {v.name: v for v in instance.description.with_causality("input")}
    free = [name for name in inputs if f"{instance.name}.{name}" not in sources]
    for name, given in config.instances[instance.name].inputs.items():
        path, variable, own = f"instances.{instance.name}.inputs.{name}", inputs.get(name), given.timeout
        if variable is None or name not in free:
            what = f"the unknown input '{name}'" if variable is None else f"'{name}', which is connected"
            expected = f"an input of '{instance.name}' that is not connected: {listed(free)}"
            findings.add(path, what, expected, nearest(name, free))
        elif own is not None and not (math.isfinite(own.after) and own.after > 0.0):
            findings.add(f"{path}.timeout.after", f"{own.after:g}", "a time > 0 in s")
        elif own is not None:
            value: Value | None = instance.start_values.get(name, variable.start) if own.then == "start" else None
            try:
                if own.then not in ("hold", "start", "stop"):
                    value = to_value(own.then, variable, finite=True)
            except ValueRefused as refused:
                found = f"{shown(own.then)} for the {variable.type_name} '{name}'"
                expected = f"hold, start, stop, or {refused.expected}"
                findings.add(f"{path}.timeout.then", found, expected, refused.suggestion)
                continue
            if own.then == "start" and value is None:
                findings.add(f"{path}.timeout.then", f"start for '{name}', which has no start value", "one, or a value")
                continue
            # From 0 on: the time between two values has the rounding of that time, and not of a large start time.
            steps = TimeGrid(0.0, base, ENDLESS).step_at(own.after, instance.step_points)
            plain, stops = to_plain(value) if value is not None else None, own.then == "stop"
            yield InputTimeout(instance.name, name, own.after, steps, instance.step_points, plain, stops)


def _step_points(name: str, config: InstanceSection, base: float, findings: Findings) -> int:
    """The step size of an instance in points; 1 after a finding."""
    path, step = f"instances.{name}.step_size", config.step_size
    if step is None:
        return 1
    if not (math.isfinite(step) and step > 0.0):
        findings.add(path, f"{step:g}", "a step size > 0 in s")
        return 1
    if not (math.isfinite(base) and base > 0.0) or step / base > ENDLESS:
        return 1
    points = steps_between(0.0, step, base)
    if not points:
        below = math.floor(step / base)
        near = [f"{multiple * base:.12g}" for multiple in (below, below + 1) if multiple > 0]
        expected = f"a whole multiple of the base step size {base:.12g} s, such as {' or '.join(near)}"
        findings.add(path, f"{step:.12g} s", expected)
        return 1
    return points


def _check_nodes(
    config: Config, descriptions: Mapping[str, ModelDescription], claims: ClaimsOf, findings: Findings
) -> None:
    """Check that the instances of each group can share one node."""
    first_of: dict[str, str] = {}
    first_with_code: dict[str, str] = {}
    processes: dict[str, SharedProcess] = {}
    for name, instance in config.instances.items():
        group = group_name(instance.group)
        if group is None:
            continue
        path = f"instances.{name}.group"
        first = first_of.setdefault(group, name)
        if group == _RESERVED_NAME:
            findings.add(path, f"the group '{group}'", "another name: it is reserved for the mesh itself")
        elif group in config.instances and group_name(config.instances[group].group) != group:
            found = f"the group '{group}', which is the name of an instance outside the group"
            findings.add(path, found, "a name of its own")
        with_code = first_with_code.setdefault(group, name) if instance.names_code else name
        own, theirs = (config.process_of(one).of_node for one in (instance, config.instances[first]))
        for what, other, mine, others in (
            ("host", first, instance.host, config.instances[first].host),
            ("process", first, msgspec.to_builtins(own), msgspec.to_builtins(theirs)),
            ("interpreter", with_code, instance.interpreter, config.instances[with_code].interpreter),
        ):
            if mine != others:
                found = f"{shown(mine)}, while '{other}' has {shown(others)}"
                members = "components" if what == "interpreter" else "instances"
                expected = f"one {what} for all {members} of the group '{group}'"
                findings.add(f"instances.{name}.{what}", found, expected)
        if name in descriptions:
            process = processes.setdefault(group, SharedProcess())
            if (why := process.refusal(name, partial(claims, name))) is not None:
                findings.add(path, why, "different groups")


def _doubts(config: Config, descriptions: Mapping[str, ModelDescription], findings: Findings) -> None:
    """Note what models need, or need otherwise, than they get here."""
    for name, section in config.instances.items():
        description, place = descriptions[name], f"instances.{name}.{key_of(section)}"
        if description.needs_execution_tool:
            tool = description.generation_tool
            found = f"the FMU of '{name}' needs an execution tool ({tool or 'it does not say which'})"
            findings.add(place, found, f"{tool or 'that tool'} on the host that runs it")
        step = section.step_size or config.simulation.step_size
        if (doubt := description.doubt_about_step(step)) is not None:
            expected = f"`step_size: {description.step_size or step:.12g}`, in `simulation` or for '{name}' alone"
            findings.add(f"instances.{name}.step_size", f"{doubt}; '{name}' may compute wrong values", expected)
        if description.not_repeatable is not None:
            findings.add(place, description.not_repeatable, "")
        silent = [clock.name for clock in description.clocks if clock.never_ticks]
        if silent:
            found = f"triggered input clocks of '{name}' never tick, because clocks cannot be connected yet"
            findings.add(place, f"{found}: {listed(silent)}", "")


def _check_zenoh(loaded: LoadedConfig, findings: Findings) -> Findings:
    """Check where the mesh can be reached, and where it runs; returns the warnings."""
    config, zenoh, warnings = loaded.config, loaded.config.zenoh, loaded.findings()
    if zenoh.mode == "client" and not zenoh.connect and zenoh.config is None:
        findings.add("zenoh.mode", "client without a router", "an endpoint in zenoh.connect")
    if zenoh.config is not None and not files.is_file(path := loaded.resolve(zenoh.config)):
        found = f"no such file '{zenoh.config}'"
        findings.add("zenoh.config", found, "an existing Zenoh configuration", nearest_file(path))
    ros = {f"ros.{name}": getattr(config.ros, name) for name in ("listen", "connect") if config.ros is not None}
    check_access(zenoh, config.security, ros, findings, warnings)
    check_deploy(config.deploy, zenoh, {n: own.host for n, own in config.instances.items()}, findings, warnings)
    return warnings
