"""The validated system: every name of the configuration resolved against the model descriptions.

Owns the meaning of a configuration (names, causality, types, step sizes). What follows from the graph
(delays, order, cycles) is `fmu_mesh.system.plan`. Descriptions are handed in: it knows neither FMPy nor Zenoh.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import msgspec
from msgspec.structs import replace

from fmu_mesh import files
from fmu_mesh.config.findings import Findings
from fmu_mesh.config.loading import LoadedConfig
from fmu_mesh.config.mesh import AnyInstanceConfig, Config, HostConfig, InstanceConfig
from fmu_mesh.errors import Finding
from fmu_mesh.simtime import ENDLESS, TimeGrid, steps_between
from fmu_mesh.system.connections import (
    Connection,
    Variables,
    resolve_connections,
    resolve_variable,
    unit_warnings,
)
from fmu_mesh.system.couplings import coupled_connections
from fmu_mesh.system.grouping import automatic_nodes
from fmu_mesh.system.recording import result_endings, result_format
from fmu_mesh.system.start_values import forbidden_start_values, resolve_start_values, sized
from fmu_mesh.system.step_options import StepOptions, capability_warnings, check_extrapolation, resolve_step_options
from fmu_mesh.text import nearest_file, shown
from fmu_mesh.variables.model_description import ModelDescription, Value
from fmu_mesh.variables.value_types import element_name, is_text

__all__ = ["Connection", "System", "SystemInstance", "build"]

_RESERVED_NAME = "mesh"


class SystemInstance(msgspec.Struct, frozen=True):
    """One instance of the system.

    Attributes:
        name: instance name.
        fmu: absolute path of the FMU, or of the model of a physics engine; empty where there is no file.
        description: its model description.
        start_values: start values by variable name, converted to the variable's type.
        step_points: its step size as a multiple of the base step size; 1 or more.
        node: name of the node (process) it runs in: its group, that of its cycle (`group: auto`), or its own name.
        options: how it is stepped; its linear inputs are not known before the delays.
        hosted: its section of the configuration if it is no FMU.
    """

    name: str
    fmu: str
    description: ModelDescription
    start_values: dict[str, Value]
    step_points: int
    node: str
    options: StepOptions = StepOptions()
    hosted: HostConfig | None = None


class System(msgspec.Struct, frozen=True):
    """A configuration whose every name has a meaning.

    Attributes:
        instances: in the order of the file.
        recorded: the recorded outputs as (instance, variable), in the order of the result columns; of an array every
            element is a column of its own, as `y[1,2]`.
        result_file: absolute path of the result file, or None if nothing is recorded.
        warnings: what is odd but can run, such as connections between different units.
    """

    config: Config
    grid: TimeGrid
    instances: dict[str, SystemInstance]
    connections: tuple[Connection, ...]
    recorded: tuple[tuple[str, str], ...]
    result_file: str | None
    warnings: tuple[Finding, ...] = ()


def build(
    loaded: LoadedConfig, descriptions: Mapping[str, ModelDescription], findings: Iterable[Finding] = ()
) -> System:
    """Give every name of a configuration its meaning.

    Args:
        loaded: the configuration and its places in the file.
        descriptions: the model descriptions by instance name. Where one is missing, because its FMU could not
            be read, what needs it is not checked; then ``findings`` has to say why it is missing.
        findings: earlier findings, which one error shows together with those of this function.

    Raises:
        ConfigurationError: something is wrong; carries all findings.
    """
    config = loaded.config
    collected = loaded.findings()
    collected.merge(findings)
    descriptions = {
        name: sized(name, description, config.instances[name], collected)
        for name, description in descriptions.items()
        if name in config.instances
    }
    variables: Variables = {
        name: {variable.name: variable for variable in descriptions[name].variables} if name in descriptions else None
        for name in config.instances
    }
    grid = _grid(config, collected)
    instances = _instances(loaded, descriptions, variables, collected)
    forbidden_start_values(config, descriptions, collected, strict=True)
    _check_nodes(config, descriptions, collected)
    connections = resolve_connections(config.connections, variables, collected)
    check_extrapolation(connections, config.instances, descriptions, collected)
    connections += coupled_connections(config, variables, connections, collected)
    recorded, result_file = _recorded(config, variables, collected), _result_file(loaded, collected)
    if not recorded or result_file is None:  # one without the other records nothing
        recorded, result_file = (), None
    _check_zenoh(loaded, collected)
    if grid is None or len(instances) < len(config.instances):
        collected.raise_any()
        missing = [name for name in config.instances if name not in descriptions]
        raise ValueError(f"no model description and no finding for {missing}")
    collected.raise_any()
    if config.group == "auto":
        edges = [(c.source_instance, c.target_instance) for c in connections]
        nodes = automatic_nodes(config, edges, descriptions)
        instances = {name: replace(own, node=nodes.get(name, own.node)) for name, own in instances.items()}
    warnings = loaded.findings()
    forbidden_start_values(config, descriptions, warnings, strict=False)
    unit_warnings(connections, descriptions, warnings)
    capability_warnings(config.instances, descriptions, warnings)
    return System(config, grid, instances, connections, recorded, result_file, tuple(warnings))


def _grid(config: Config, findings: Findings) -> TimeGrid | None:
    simulation = config.simulation
    start, stop, step = simulation.start_time, simulation.stop_time, simulation.step_size
    if simulation.real_time_factor < 0.0:
        found = f"{simulation.real_time_factor:g}"
        findings.add("simulation.real_time_factor", found, "0 (as fast as possible) or a positive factor")
    if any(time is not None and math.isnan(time) for time in (start, stop, step)):
        return None  # no time of a file is NaN: the structure is wrong there, which is found already
    if not (math.isfinite(step) and step > 0.0):
        findings.add("simulation.step_size", f"{step:g}", "a step size > 0 in s")
        return None
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
    loaded: LoadedConfig,
    descriptions: Mapping[str, ModelDescription],
    variables: Variables,
    findings: Findings,
) -> dict[str, SystemInstance]:
    """The instances whose model description is there."""
    base = loaded.config.simulation.step_size
    instances: dict[str, SystemInstance] = {}
    for name, config in loaded.config.instances.items():
        if name == _RESERVED_NAME:
            findings.add(f"instances.{name}", f"the name '{name}'", "another name: it is reserved for the mesh itself")
        step_points = _step_points(name, config, base, findings)
        own = variables[name]
        if own is None:
            continue
        instances[name] = SystemInstance(
            name=name,
            fmu=str(loaded.resolve(config.path)) if config.path else "",
            description=descriptions[name],
            start_values=resolve_start_values(name, config, own, findings),
            step_points=step_points,
            node=config.group or name,
            options=resolve_step_options(name, config, descriptions[name], findings),
            hosted=None if isinstance(config, InstanceConfig) else config,
        )
    return instances


def _step_points(name: str, config: AnyInstanceConfig, base: float, findings: Findings) -> int:
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


def _check_nodes(config: Config, descriptions: Mapping[str, ModelDescription], findings: Findings) -> None:
    """Whether the instances of every group can share one node."""
    first_of: dict[str, str] = {}
    only_once: dict[tuple[str, str], str] = {}
    for name, instance in config.instances.items():
        group = instance.group
        if group is None:
            continue
        path = f"instances.{name}.group"
        first = first_of.setdefault(group, name)
        if group == _RESERVED_NAME:
            findings.add(path, f"the group '{group}'", "another name: it is reserved for the mesh itself")
        elif group in config.instances and config.instances[group].group != group:
            found = f"the group '{group}', which is the name of an instance outside the group"
            findings.add(path, found, "a name of its own")
        if config.instances[first].host != instance.host:
            found = f"{shown(instance.host)}, while '{first}' has {shown(config.instances[first].host)}"
            expected = f"one host for all instances of the group '{group}'"
            findings.add(f"instances.{name}.host", found, expected)
        description = descriptions.get(name)
        if description is not None and description.only_once_per_process:
            other = only_once.setdefault((group, description.guid), name)
            if other != name:
                found = f"'{name}' in one process with '{other}'"
                findings.add(path, found, "different groups: this FMU allows one instance per process")


def _recorded(config: Config, variables: Variables, findings: Findings) -> tuple[tuple[str, str], ...]:
    """The recorded outputs; by default all that are no String and no Binary."""
    if config.record.variables is None:
        return tuple(
            (name, element)
            for name, own in variables.items()
            for variable in (own or {}).values()
            if variable.causality == "output" and not is_text(variable.type)
            for element in variable.elements
        )
    recorded: dict[tuple[str, str], str] = {}
    for index, reference in enumerate(config.record.variables):
        path = f"record.variables[{index}]"
        instance, _, name = reference.partition(".")
        first = recorded.get((instance, name))
        end = None if first else resolve_variable(reference, path, variables, "output", findings)
        names: tuple[str, ...] = (name,)
        if end is not None:
            variable, element = end
            names = (element_name(variable.name, element),) if element else variable.elements
            first = next((recorded[instance, one] for one in names if (instance, one) in recorded), None)
            if variable.causality != "output":
                findings.add(path, f"'{reference}', whose causality is {variable.causality}", "an output")
        if first:
            findings.add(path, f"'{reference}' a second time (first: {first})", "every variable at most once")
        recorded.update(dict.fromkeys([(instance, one) for one in names], first or path))
    return tuple(recorded)


def _result_file(loaded: LoadedConfig, findings: Findings) -> str | None:
    text = loaded.config.record.file
    if text is None:
        return None
    path = loaded.resolve(text.replace("{mesh}", loaded.config.mesh))
    try:
        is_folder = path.is_dir()
    except OSError as error:  # its name is too long, or it is in a folder of somebody else
        findings.add("record.file", f"{shown(text)} ({error.strerror})", "a file that can be written")
        return None
    if is_folder:
        findings.add("record.file", f"the folder '{text}'", "a file, or null to record nothing")
    elif result_format(path) is None:
        endings = " or ".join(result_endings())
        findings.add("record.file", f"'{text}', a format that is not written", f"a name ending in {endings}")
    return str(path)


def _check_zenoh(loaded: LoadedConfig, findings: Findings) -> None:
    zenoh = loaded.config.zenoh
    if zenoh.mode == "client" and not zenoh.connect and zenoh.config is None:
        findings.add("zenoh.mode", "client without a router", "an endpoint in zenoh.connect")
    if zenoh.config is not None and not files.is_file(path := loaded.resolve(zenoh.config)):
        found = f"no such file '{zenoh.config}'"
        findings.add("zenoh.config", found, "an existing Zenoh configuration", nearest_file(path))
