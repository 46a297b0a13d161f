"""From the connections of a configuration to connections between variables.

Owns the names of the ends (the first dot ends the instance name), causality, types and units. Delays and cycles are
`fmu_mesh.system.plan`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import msgspec
from msgspec.structs import replace

from fmu_mesh.config.findings import Findings
from fmu_mesh.config.instance_sections import Extrapolation
from fmu_mesh.config.key_sections import KeyInputConfig, KeyOutputConfig
from fmu_mesh.config.mesh import ConnectionConfig
from fmu_mesh.system.value_map import checked_items, resolve_map
from fmu_mesh.text import listed, nearest, with_article
from fmu_mesh.variables.model_description import ModelDescription, Variable
from fmu_mesh.variables.units import Linear, conversion
from fmu_mesh.variables.value_types import (
    FMI2_TYPES,
    INTEGERS,
    TYPES,
    VariableType,
    element_name,
    is_float,
    split_element,
    takes,
)

__all__ = [
    "Connection",
    "Variables",
    "element_of",
    "offered",
    "resolve_connections",
    "resolve_variable",
    "unit_warnings",
]

Offer = Callable[[str, Variable], bool]


class Variables(dict[str, Mapping[str, Variable] | None]):
    """The variables of every instance by name, in the order of the file; None without a model description.

    The descriptions are those of the instances by name, with arrays in their sizes.
    """

    def __init__(self, descriptions: Mapping[str, ModelDescription], names: Iterable[str]) -> None:
        super().__init__(dict.fromkeys(names))
        self.descriptions = {name: descriptions[name] for name in self if name in descriptions}
        self.update({name: {v.name: v for v in own.variables} for name, own in self.descriptions.items()})


class Connection(msgspec.Struct, frozen=True):
    """One connection: `target = factor * source + offset`.

    Attributes:
        factor: of the unit conversion and the file together; ``offset`` likewise.
        source_index: the element of the source array that is connected, counted from 0; empty for all of it.
        target_index: as ``source_index``, for the target.
        map: what the target gets instead of a value of the source, as numbers; other values stay as they are.
        items: the items of the target, if a value may be none of them.
        delay: 0, 1, or None where the algorithm decides; always None for a parameter.
        path: its place in the configuration file, such as `connections[2]`.
        units: the unit conversion in words; empty if there is none.
        extrapolation: how the target's input changes within a step; None: as the target or the simulation says.
        ahead: see `CouplingRule`.
    """

    source_instance: str
    source: Variable
    target_instance: str
    target: Variable
    factor: float
    offset: float
    delay: int | None
    path: str
    extrapolation: Extrapolation | None = None
    source_index: tuple[int, ...] = ()
    target_index: tuple[int, ...] = ()
    units: str = ""
    map: tuple[tuple[int, int], ...] = ()
    items: tuple[tuple[str, int], ...] = ()
    ahead: bool = False

    @property
    def initial_only(self) -> bool:
        """Whether its value is transferred in Initialization Mode only: its target is a parameter."""
        return self.target.causality == "parameter"

    @property
    def source_name(self) -> str:
        """The name of the source, as `y` or `y[2]`."""
        return element_name(self.source.name, self.source_index) if self.source_index else self.source.name

    @property
    def target_name(self) -> str:
        """The name of the target, as `u` or `u[1,3]`."""
        return element_name(self.target.name, self.target_index) if self.target_index else self.target.name

    def __str__(self) -> str:
        return f"{self.source_instance}.{self.source_name} -> {self.target_instance}.{self.target_name}"


def resolve_connections(
    configs: Sequence[ConnectionConfig | KeyInputConfig | KeyOutputConfig], variables: Variables, findings: Findings
) -> tuple[Connection, ...]:
    """All connections whose ends exist and fit; the others are findings."""
    connections: list[Connection] = []
    sources: dict[str, tuple[str, ConnectionConfig]] = {}
    for index, config in enumerate(configs):
        path = f"connections[{index}]"
        if not isinstance(config, ConnectionConfig):
            continue  # a key at one end: `live_keys`
        if not config.source and not config.target:
            findings.add(path, "no ends", "instance.output -> instance.input")
            continue
        source = resolve_variable(config.source, f"{path}.from", variables, "output", findings)
        target = resolve_variable(config.target, f"{path}.to", variables, "input", findings)
        _check_single_source(config, path, _taken(config.target, target), sources, findings)
        if source is None or target is None:
            continue
        connection = Connection(
            source_instance=config.source.partition(".")[0],
            source=source[0],
            target_instance=config.target.partition(".")[0],
            target=target[0],
            factor=config.factor,
            offset=config.offset,
            delay=config.delay,
            path=path,
            extrapolation=config.extrapolation,
            source_index=source[1],
            target_index=target[1],
        )
        if _causality_is_right(connection, variables, findings):
            _check_types(connection, findings)
            _check_delay(connection, findings)
            if connection.initial_only:
                connection = replace(connection, delay=None)
            connection = _with_units(connection, config, findings)
            connections.append(_with_map(connection, config, findings))
    return tuple(connections)


def offered(instance: str, variables: Variables, offer: str | Offer) -> list[str]:
    """The variables of an instance with a causality, or of which ``offer`` is true."""
    own = (variables.get(instance) or {}).values()
    return [v.name for v in own if (v.causality == offer if isinstance(offer, str) else offer(instance, v))]


def resolve_variable(
    reference: str, path: str, variables: Variables, offer: str | Offer, findings: Findings
) -> tuple[Variable, tuple[int, ...]] | None:
    """The variable that `instance.variable` names; None after a finding, or without a model description.

    `instance.array[1,2]` names an element of an array, counted from 1, unless a variable has that very name. With the
    variable comes the index of the element, counted from 0; empty for the variable as a whole. What is suggested
    instead of an unknown name has the causality ``offer``, or ``offer`` says of a variable that it can be set.
    """
    instance, dot, name = reference.partition(".")
    if not instance or not dot or not name:
        names = offered(instance, variables, offer)
        findings.add(path, f"'{reference}'", f"{instance}.{names[0]}" if len(names) == 1 else "instance.variable")
        return None
    if instance not in variables:
        expected = f"one of the instances {listed(list(variables))}"
        findings.add(path, f"the unknown instance '{instance}'", expected, nearest(instance, variables))
        return None
    own = variables[instance]
    if own is None:
        return None
    if name in own:
        return own[name], ()
    if (parts := split_element(name)) is not None and parts[0] in own:
        return element_of(own[parts[0]], parts[1], path, reference, findings)
    if (clock := variables.descriptions[instance].clock(name)) is not None:
        findings.add(path, clock, "")
    else:
        names = offered(instance, variables, offer)
        near = nearest(name, names)
        what = f"{offer}s of '{instance}'" if isinstance(offer, str) else f"variables of '{instance}' that can be set"
        expected = f"one of the {what}: {listed(sorted(names, key=lambda one: one != near))}"
        findings.add(path, f"the unknown variable '{name}' of instance '{instance}'", expected, near)
    return None


def unit_warnings(
    connections: Sequence[Connection], descriptions: Mapping[str, ModelDescription], findings: Findings
) -> None:
    """Add a warning for each connection between different units of which one has no definition.

    Such units are compared by their names. This is a warning only, because a unit may have several names. FMI 1.0
    defines no units: it has display units only, and no value is in a display unit (FMI 1.0, 3.3).
    """
    for connection in connections:
        source, target = connection.source.unit, connection.target.unit
        undefined = [(owner, end) for owner, end in _ends(connection) if end.base_unit is None]
        if source and target and source != target and undefined and not connection.units and _is_identity(connection):
            owner, end = undefined[0]
            old = descriptions[owner].fmi_version.startswith("1.")
            reason = "FMI 1.0 gives units a name only" if old else f"its model does not define '{end.unit}'"
            found = (
                f"{connection} connects the unit '{source}' to the unit '{target}' and converts nothing, because there "
                f"are no base units of {owner}.{end.name}: {reason}"
            )
            expected = "the same unit, a factor that converts it, or `ignore_units: true` if both are the same"
            findings.add(connection.path, found, expected)


def _with_units(connection: Connection, config: ConnectionConfig, findings: Findings) -> Connection:
    """The connection with the conversion between the units of its ends.

    The conversion is applied before the factor and the offset of the file. These are in the unit of the target
    (SSP 1.0, LinearTransformation of a connection; `ignore_units` is suppressUnitConversion).
    """
    source, target = connection.source, connection.target
    if config.ignore_units:
        return replace(connection, units="units ignored")
    if source.base_unit is None or target.base_unit is None:
        without = [f"{owner}.{end.name}" for owner, end in _ends(connection) if end.unit is None]
        return (
            replace(connection, units=f"not converted: {without[0]} has no unit") if len(without) == 1 else connection
        )
    relative = source.relative_quantity or target.relative_quantity
    change = conversion(source.base_unit, target.base_unit, relative=relative)
    if change is None:
        found = (
            f"{connection} connects the unit '{source.unit}' ({source.base_unit}) "
            f"to the unit '{target.unit}' ({target.base_unit})"
        )
        findings.add(connection.path, found, "units of one dimension, or `ignore_units: true` on the connection")
        return connection
    if change.identity:
        return connection
    own = Linear(connection.factor, connection.offset)
    both = change.then(own)
    after = "" if own.identity else f", then factor {own.factor:.12g} and offset {own.offset:.12g}"
    units = f"{source.unit} to {target.unit}{after}"
    return replace(connection, factor=both.factor, offset=both.offset, units=units)


def _with_map(connection: Connection, config: ConnectionConfig, findings: Findings) -> Connection:
    """The connection with the entries of its `map`, and with the items that its values must be."""
    source, target, path = connection.source, connection.target, f"{connection.path}.map"
    pairs = resolve_map(config.map, source, target, path, findings) if config.map else ()
    if config.map and (config.factor, config.offset) != (1.0, 0.0):
        found = f"a map and factor {config.factor:g} and offset {config.offset:g} on {connection}"
        findings.add(path, found, "a map, or factor and offset")
    return replace(connection, map=pairs, items=checked_items(source, target, pairs))


def _ends(connection: Connection) -> tuple[tuple[str, Variable], tuple[str, Variable]]:
    return (connection.source_instance, connection.source), (connection.target_instance, connection.target)


def _taken(reference: str, target: tuple[Variable, tuple[int, ...]] | None) -> tuple[str, str]:
    """The names of the target and of its variable, both with the instance; as written if there is no such variable."""
    if target is None:
        return reference, reference
    variable, index = target
    whole = f"{reference.partition('.')[0]}.{variable.name}"
    return element_name(whole, index) if index else whole, whole


def _check_single_source(
    config: ConnectionConfig,
    path: str,
    taken: tuple[str, str],
    sources: dict[str, tuple[str, ConnectionConfig]],
    findings: Findings,
) -> None:
    """Check that an input, and each element of an array, has one source.

    ``sources`` has the first source of each target. The key `array*` has the first source of any of its elements.
    """
    name, whole = taken
    first_source = sources.get(name) or sources.get(whole if name != whole else f"{whole}*")
    if first_source is None:
        sources[name] = path, config
        if name != whole:
            sources.setdefault(f"{whole}*", (path, config))
        return
    first_path, first = first_source
    line = findings.line(first_path)
    place = f"{first_path} in line {line}" if line is not None else first_path
    if first.source == config.source:
        found = f"{config.source} -> {config.target} a second time (first: {place})"
    else:
        found = (
            f"a second source for the input '{name}': {config.source} -> {config.target}, "
            f"after {first.source} -> {first.target} ({place})"
        )
    findings.add(path, found, "one source for an input")


def _causality_is_right(connection: Connection, variables: Variables, findings: Findings) -> bool:
    source, target = connection.source, connection.target
    source_name = f"{connection.source_instance}.{source.name}"
    target_name = f"{connection.target_instance}.{target.name}"
    if source.causality == "input" and target.causality == "output":
        found = f"the wrong way round: '{source_name}' is an input and '{target_name}' an output"
        findings.add(connection.path, found, "output -> input", f"{target_name} -> {source_name}")
        return False
    # The value of a source can be read at every point (SSP 2.0, 5.3.2.1).
    is_source = source.causality in ("output", "local", "calculatedParameter") or (
        source.causality == "parameter" and (source.variability == "constant" or target.causality == "parameter")
    )
    if not is_source:
        outputs = _names_of(connection.source_instance, "output", variables)
        findings.add(
            f"{connection.path}.from", f"'{source_name}' is {with_article(source.causality)}", f"an output{outputs}"
        )
    # A parameter gets its value in Initialization Mode (FMI 2.0, 2.2.7 and 4.2.4; FMI 3.0, 2.3.3).
    is_open_parameter = target.causality == "parameter" and target.settable_before_start and not source.changes
    is_target = target.causality == "input" or is_open_parameter
    if not is_target:
        inputs = _names_of(connection.target_instance, "input", variables)
        expected = f"an input{inputs}"
        if target.causality == "structuralParameter":
            expected = "an input or a parameter; its value is needed before the initialization, so use `start_values`"
        elif target.causality == "parameter" and source.changes:
            expected += f"; a parameter gets its value once, and '{source_name}' changes"
        findings.add(f"{connection.path}.to", f"'{target_name}' is {with_article(target.causality)}", expected)
    return is_source and is_target


def _names_of(instance: str, causality: str, variables: Variables) -> str:
    """The variables of an instance with a causality, as the end of the sentence `an output ...`."""
    return f" of '{instance}': {listed(offered(instance, variables, causality))}"


def _check_types(connection: Connection, findings: Findings) -> None:
    source, target = connection.source, connection.target
    items = tuple(number for _, number in source.items)
    have, want = _end(source, connection.source_index), _end(target, connection.target_index)
    if not _fits(target.type, source.type, items):
        known = TYPES if source.declared_type is None else FMI2_TYPES.values()  # in the FMI version of the source
        others = (type_ for type_ in known if type_ != target.type and _fits(target.type, type_))
        accepted = [_name_of(type_, target) for type_ in (target.type, *others)]
        found = f"{connection} connects {with_article(have)} to {with_article(want)}"
        findings.add(connection.path, found, f"a source of type {' or '.join(dict.fromkeys(accepted))}")
    elif (source.shape if not connection.source_index else ()) != (target.shape if not connection.target_index else ()):
        found = f"{connection} connects {with_article(have)} to {with_article(want)}"
        expected = "ends of the same shape: two arrays of the same dimensions, or one element as in y[1]"
        findings.add(connection.path, found, expected)
    elif not is_float(target.type) and not _is_identity(connection):
        conversion = f"factor {connection.factor:g} and offset {connection.offset:g}"
        name = f"the {target.type_name} '{connection.target_name}'"
        findings.add(connection.path, f"{conversion} for {name}", "factor and offset on Real inputs only")


def _fits(target: VariableType, source: VariableType, items: tuple[int, ...] = ()) -> bool:
    """Whether a connection is allowed: an integer for an Enumeration is checked in the run, value by value."""
    return takes(target, source, items) or (target == "Enumeration" and source in INTEGERS)


def _name_of(type_: VariableType, like: Variable) -> str:
    """The name of a type in the FMI version of a variable."""
    if like.declared_type is None:
        return type_
    return next((name for name, own in FMI2_TYPES.items() if own == type_), type_)


def _end(variable: Variable, index: tuple[int, ...]) -> str:
    """The type of one end: of the variable, or of one of its elements."""
    return variable.type_name.partition("[")[0] if index else variable.type_name


def element_of(
    variable: Variable, index: tuple[int, ...], path: str, reference: str, findings: Findings
) -> tuple[Variable, tuple[int, ...]] | None:
    """An element of an array; None after a finding, if it has no such index."""
    if len(index) == len(variable.shape) and all(0 <= i < size for i, size in zip(index, variable.shape, strict=True)):
        return variable, index
    if not variable.shape:
        expected = "an element of an array only: this variable is a scalar"
    else:
        last = ",".join(map(str, variable.shape))
        first = ",".join("1" for _ in variable.shape)
        expected = f"an index from [{first}] to [{last}]"
    findings.add(path, f"'{reference}' of the {variable.type_name} '{variable.name}'", expected)
    return None


def _check_delay(connection: Connection, findings: Findings) -> None:
    if connection.source_instance == connection.target_instance and connection.delay == 0:
        found = f"delay 0 on {connection}, from an instance to itself"
        findings.add(f"{connection.path}.delay", found, "delay 1")
    if connection.initial_only and connection.delay is not None:
        found = f"delay {connection.delay} on {connection}, from which a parameter gets its value before the first step"
        findings.add(f"{connection.path}.delay", found, "no delay")


def _is_identity(connection: Connection) -> bool:
    return connection.factor == 1.0 and connection.offset == 0.0
