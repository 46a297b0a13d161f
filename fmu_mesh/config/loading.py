"""Reading a configuration file: the result is a valid structure, or an error with all findings.

Owns the short form of connections and the start values that options give. Of a file whose structure is wrong, there is
a partial configuration: its valid parts, with placeholders for the others. With them the meaning of the valid parts can
be checked, and one error shows all findings; it is never run. What the names in the file mean is
`fmu_mesh.system.system`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
from msgspec import inspect, structs

from fmu_mesh.config.findings import CONTAINERS, Findings, ValueOrigin, Written, located
from fmu_mesh.config.instance_sections import KIND, InstanceSection, Kinds, keys_of
from fmu_mesh.config.mesh import Config, config_type
from fmu_mesh.config.scenario_section import ScenarioConfig, ScenarioSource
from fmu_mesh.config.structure import check
from fmu_mesh.config.yaml_text import Plain, read
from fmu_mesh.errors import Finding
from fmu_mesh.files import archive_on_the_way, opened
from fmu_mesh.text import listed, nearest, nearest_file, option_text, shown

__all__ = [
    "MAXIMUM_BYTES",
    "LoadedConfig",
    "PlainConfig",
    "ValueOrigin",
    "examine_data",
    "read_file",
    "read_scenario",
    "read_text",
]

MAXIMUM_BYTES = 4 * 1024 * 1024
_ARCHIVE = b"PK\x03\x04"

_ARROW = "->"
_OTHER_ARROW = re.compile(r"\s*(?:-+>|=+>|→|⟶|~>|>)\s*")
_SHORT_FORM = "'instance.output -> instance.input', or {from: instance.output, to: instance.input}"

_SHARED: Final = ("inputs", "step_size", "group", "host", "not_finite", "on_failure")
"""The keys of an instance that are checked although its kind is not known."""

_NO_CONNECTION: Final[dict[str, Plain]] = {KIND: "connection", "from": "", "to": ""}
_FILLING: Final[dict[Plain, dict[str, Plain]]] = {
    "connection": _NO_CONNECTION,
    "key_input": {"key": "", "to": ""},
    "key_output": {"key": "", "from": ""},
}
"""By the kind of a connection, the keys that it needs."""

_PLACEHOLDERS: Final[dict[str, Plain]] = {
    "connections": _NO_CONNECTION,
    "record": {"file": None},
    r"record(\[\d+\])?\.variables": "",
    r"scenario\.events": {"at": math.inf, "set": {}},
    r"scenario\.values\..+\.times": math.nan,
    r"scenario\.values\..+\.values": 0,
    r"ros\.topics": "",
}
"""By the path of a list, what stands for a wrong item, so that others keep their index, and for keys that miss."""

_TIMES = ("start_time", "stop_time", "step_size")


class PlainConfig(NamedTuple):
    """The values of a configuration, not yet checked.

    Attributes:
        data: mappings, lists, texts and numbers, as in the file.
        file: relative paths and findings refer to it; a configuration that a program has made has no such file.
        lines: line numbers, counted from 1, by path in the file; empty without a file.
        findings: what is wrong with the text, such as a key that stands there twice.
        overrides: the option that replaced a value, by path in the file.
        origins: where a value was written, by path in the file, if that is another file.
        warnings: findings that do not prevent a run.
        needed: what an option has to give because the file cannot say it: the option, by path in the file.
        explained: paths about which the findings say already, in the words of the file, what is wrong.
        foreign: what it comes from, in words, if that must not name code, such as `a package of SSP`.
    """

    data: Plain
    file: Path
    lines: dict[str, int] = {}
    findings: tuple[Finding, ...] = ()
    overrides: dict[str, str] = {}
    origins: dict[str, ValueOrigin] = {}
    warnings: tuple[Finding, ...] = ()
    needed: dict[str, str] = {}
    explained: tuple[str, ...] = ()
    foreign: str = ""


class LoadedConfig(Written[Config], frozen=True):
    """A configuration with a valid structure, and the line of each of its parts.

    Attributes:
        warnings: findings of the file that do not prevent a run.
        foreign: as in `PlainConfig`.
    """

    warnings: tuple[Finding, ...] = ()
    foreign: str = ""

    def origin(self, path: str) -> ValueOrigin:
        """Where the value at ``path`` comes from: a file and a line of it, or an option."""
        return located(path, str(self.file), self.lines, self.overrides, self.origins)

    @property
    def scenario_origin(self) -> ValueOrigin:
        """Where the scenario was written."""
        scenario = self.config.scenario
        return ValueOrigin(scenario, None, "scenario") if isinstance(scenario, str) else self.origin("scenario")

    def finding(self, path: str, found: str, expected: str, suggestion: str | None = None) -> Finding:
        """A finding with the file and the line of ``path``."""
        origin = self.origin(path)
        return Finding(origin.file or str(self.file), path, found, expected, suggestion, origin.line)


def read_file(path: Path) -> PlainConfig:
    """Read the values of a configuration file; what they mean is not checked yet.

    Raises:
        ConfigurationError: the file cannot be read, or is no YAML.
    """
    findings = Findings(str(path))
    text = _text(path, findings)
    findings.raise_any()
    return read_text(text, path)


def read_text(text: str, path: Path) -> PlainConfig:
    """As `read_file`, with the text of the file as an argument.

    Raises:
        ConfigurationError: it is no YAML; the findings refer to ``path``.
    """
    lines: dict[str, int] = {}
    findings = Findings(str(path), lines)
    data = read(text, findings, lines)
    if data is None and not len(findings):
        findings.add("", "nothing (null)", "a mapping with mesh, simulation and instances")
    if data is None:
        findings.raise_any()
    return PlainConfig(data, path, lines, tuple(findings))


def read_scenario(loaded: LoadedConfig, findings: Findings) -> ScenarioSource | None:
    """The scenario of a configuration: its section, or the file that the section names; None if there is none.

    If something is wrong with the file, which are findings, the result has only its valid parts.

    Raises:
        ConfigurationError: the file cannot be read, or is no YAML.
    """
    section = loaded.config.scenario
    if section is None:
        return None
    if isinstance(section, ScenarioConfig):
        return ScenarioSource(section, loaded.file, loaded.lines, loaded.overrides, prefix="scenario.")
    path = loaded.resolve(section)
    if not section or not path.is_file():
        found, expected = f"no such file '{section}'", "a file with values and events"
        if (archive := archive_on_the_way(path)) is not None:
            found, expected = f"'{section}' inside '{archive.name}'", f"{expected}; `../NAME` is beside that archive"
        findings.add("scenario", found, expected, nearest_file(path))
        return None
    shown_path = loaded.file.parent / section  # from inside an archive, only the resolved path can be opened
    plain = read_file(shown_path if shown_path.is_file() else path)
    own = Findings(str(plain.file), plain.lines, None, plain.findings)
    check(plain.data, _type_info(ScenarioConfig), "", own)
    config = _partial_scenario(plain.data, own.places)
    findings.merge(own)
    wrong = frozenset(place for place in own.places if not CONTAINERS.fullmatch(place))
    return ScenarioSource(config, plain.file, plain.lines, wrong=wrong) if config is not None else None


def examine_data(plain: PlainConfig, overrides: Mapping[str, Plain], kinds: Kinds) -> tuple[LoadedConfig, Findings]:
    """Check values that were read from a file, or that a program has made.

    Returns:
        The configuration and the findings. Pass both to `system.build`, which checks the meaning of the rest and raises
        one error with all findings. With a finding, a configuration may be partial: it has placeholders (an empty
        `fmu`, a step size of NaN) and must not be run.

    Raises:
        ConfigurationError: too little of it is valid.
    """
    data, path, lines = plain.data, plain.file, plain.lines
    replaced = dict(plain.overrides)
    findings = Findings(str(path), lines, replaced, plain.findings, plain.origins)
    findings.explain(plain.explained)
    sections = kinds.own()
    if isinstance(data, dict):
        data = _with_long_connections(data, findings)
        data = _with_kinds(_with_overrides(data, overrides, replaced, findings), sections, kinds, findings)
    type_ = config_type(tuple(sections.values()))
    check(data, _type_info(type_), "", findings)
    config = _partial_configuration(data, findings.places, sections) if len(findings) else msgspec.convert(data, type_)
    if config is None:
        findings.raise_any()
    assert config is not None  # without a finding there is a configuration
    # The kinds have done their part: from here on, a configuration is a plain `Config`, in every process.
    own, origins, warnings = Config(**structs.asdict(config)), plain.origins, plain.warnings
    return LoadedConfig(own, path, lines, replaced, origins, warnings, plain.foreign), findings


@lru_cache(maxsize=8)
def _type_info(type_: type[msgspec.Struct]) -> inspect.Type:
    """The fields of a type as msgspec sees them; to find them takes longer than to check a configuration."""
    return inspect.type_info(type_)


def _text(path: Path, findings: Findings) -> str:
    """The text of the file; empty if there is a finding."""
    try:
        with opened(path) as file:
            data = file.read(MAXIMUM_BYTES + 1)
    except FileNotFoundError:
        findings.add("", "no such file", "", nearest_file(path))
        return ""
    except IsADirectoryError:
        findings.add("", "a folder", "a configuration file")
        return ""
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        findings.add("", f"it cannot be read ({reason})", "a readable file")
        return ""
    if len(data) > MAXIMUM_BYTES:
        findings.add("", f"more than {MAXIMUM_BYTES} bytes", "a smaller file")
        return ""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        found = f"the byte 0x{data[error.start]:02x} in line {line}", "text in UTF-8"
        if data.startswith(_ARCHIVE):
            found = (
                "an archive, as FMUs are",
                f"a configuration file; `fmu-mesh simulate {path}` (`fmu_mesh.simulate`) simulates one FMU",
            )
        findings.add("", *found)
        return ""


def _with_long_connections(data: dict[str, Plain], findings: Findings) -> dict[str, Plain]:
    """``data`` with every connection in the long form, and its kind. A wrong one is a finding and gets empty ends."""
    connections = data.get("connections")
    if not isinstance(connections, list):
        return data
    written: list[Plain] = []
    for index, connection in enumerate(connections):
        if isinstance(connection, dict):
            if connection.get("key") == "":  # which is also the place of a wrong one
                findings.add(f"connections[{index}].key", "''", "a Zenoh key such as plant/pump/flow")
            with_key = "key_output" if "from" in connection else "key_input"
            written.append({**connection, KIND: with_key if "key" in connection else "connection"})
            continue
        ends = [end.strip() for end in connection.split(_ARROW)] if isinstance(connection, str) else []
        if len(ends) == 2 and all(ends):
            written.append({KIND: "connection", "from": ends[0], "to": ends[1]})
        else:
            findings.add(f"connections[{index}]", shown(connection), _SHORT_FORM, _arrow_meant(connection))
            written.append(_NO_CONNECTION)
    return {**data, "connections": written}


def _with_kinds(
    data: dict[str, Plain], sections: dict[str, type[InstanceSection]], kinds: Kinds, findings: Findings
) -> dict[str, Plain]:
    """``data`` with the kind of every instance, as its keys say it: the usual kind where they do not.

    Kinds of other packages are looked for only where an instance has no key of ours; those that are found are added to
    ``sections``.
    """
    instances = data.get("instances")
    if not isinstance(instances, dict):
        return data
    usual = next(iter(sections))
    written: dict[str, Plain] = {}
    for name, instance in instances.items():
        if not isinstance(instance, dict):
            written[name] = instance
            continue
        key = next((key for key in sections if key in instance), None)
        if key is None and (others := instance.keys() - set(keys_of(sections[usual]))):
            key = _kind_meant(others, kinds)
            if key is None:
                expected = f"one of the keys {listed(kinds.names())}"
                findings.add(f"instances.{name}", "no key of an installed kind of instance", expected)
            else:
                sections.setdefault(key, kinds.section(key))
        written[name] = {**instance, KIND: key or usual}
    return {**data, "instances": written}


def _kind_meant(keys: AbstractSet[str], kinds: Kinds) -> str | None:
    """The kind that one of the keys names, or else the nearest one."""
    names = kinds.names()
    exact = [name for name in names if name in keys]
    near = [name for key in sorted(keys) if (name := nearest(key, names)) is not None]
    return next(iter([*exact, *near]), None)


def _arrow_meant(connection: Plain) -> str | None:
    """The short form with the right arrow, for a text with another one."""
    if not isinstance(connection, str):
        return None
    forwards = [end.strip() for end in _OTHER_ARROW.split(connection)]
    backwards = [end.strip() for end in reversed(re.split(r"<[-=]+|←", connection))]
    for ends in (backwards, forwards):
        if len(ends) == 2 and all(ends):
            return f"{ends[0]} {_ARROW} {ends[1]}"
    return None


def _with_overrides(
    data: dict[str, Plain], overrides: Mapping[str, Plain], replaced: dict[str, str], findings: Findings
) -> dict[str, Plain]:
    """``data`` with the start values that options give; adds each option to ``replaced``."""
    instances = data.get("instances")
    if not isinstance(instances, dict):
        return data
    instances = dict(instances)
    for path, value in overrides.items():
        option = option_text("start_values", {path: value})
        name, _, variable = path.partition(".")
        if not (name and variable):
            findings.add(option, f"the name '{path}'", "instance.variable")
        elif name not in instances:
            expected = f"one of {listed(list(instances))}"
            findings.add(option, f"the unknown instance '{name}'", expected, nearest(name, instances))
        elif not isinstance(value, bool | int | float | str | list):
            findings.add(option, f"the value {shown(value)}", "a number, text, true or false, or a list")
        else:
            _set_start_value(instances, name, variable, value)
            replaced[f"instances.{name}.start_values.{variable}"] = option
    return {**data, "instances": instances}


def _set_start_value(instances: dict[str, Plain], name: str, variable: str, value: Plain) -> None:
    instance = instances[name]
    if isinstance(instance, dict):
        values = instance.get("start_values", {})
        if isinstance(values, dict):
            instances[name] = {**instance, "start_values": {**values, variable: value}}


def _partial_configuration(
    data: Plain, wrong: AbstractSet[str], sections: Mapping[str, type[InstanceSection]]
) -> Config | None:
    """The configuration without the values at the paths ``wrong``; None if too little is valid.

    A missing or wrong time is NaN, a missing model an empty path, a missing end of a connection an empty name, and an
    event without a time never happens. The sections are those of the kinds of instances by key, the usual kind first.
    """
    rest = _without(data, wrong, "")
    instances = data.get("instances") if isinstance(data, dict) else None
    if not isinstance(rest, dict) or not isinstance(instances, dict):
        return None
    models = [_with_model(own, sections) for own in ({**instances, **_mapping(rest.get("instances"))}).values()]
    try:
        config = msgspec.convert(
            {
                **rest,
                "mesh": rest.get("mesh", "mesh"),
                "simulation": _simulation(rest.get("simulation"), wrong),
                "instances": {f"i{number}": model for number, model in enumerate(models)},
            },
            config_type(tuple(sections.values())),
        )
    except msgspec.ValidationError:
        return None
    # A name that is not allowed, for which there is a finding, is still that of an instance.
    return msgspec.structs.replace(config, instances=dict(zip(instances, config.instances.values(), strict=True)))


def _partial_scenario(data: Plain, wrong: AbstractSet[str]) -> ScenarioConfig | None:
    """As `partial_configuration`, for a scenario in a file of its own."""
    rest = _without(data, {f"scenario.{place}" for place in wrong}, "scenario")
    try:
        return msgspec.convert(rest, ScenarioConfig)
    except msgspec.ValidationError:
        return None


def _without(value: Plain, wrong: AbstractSet[str], path: str) -> Plain:
    """``value`` without its wrong entries; placeholders are in their place where they are in a list."""
    if isinstance(value, dict):
        places = {key: f"{path}.{key}" if path else key for key in value}
        return {
            key: _without(item, wrong, places[key])
            for key, item in value.items()
            if places[key] not in wrong or (isinstance(item, dict | list) and CONTAINERS.fullmatch(places[key]))
        }
    if isinstance(value, list):
        places_of_items = [f"{path}[{index}]" for index in range(len(value))]
        placeholder = next((own for lists, own in _PLACEHOLDERS.items() if re.fullmatch(lists, path)), None)
        inside = (place for place in places_of_items for one in wrong if one == place or one.startswith(f"{place}."))
        if placeholder is None and any(inside):
            return []
        pairs = zip(value, places_of_items, strict=True)
        kept = [placeholder if place in wrong else _without(item, wrong, place) for item, place in pairs]
        return [
            {**_FILLING.get(item.get(KIND), _mapping(placeholder)), **item} if isinstance(item, dict) else item
            for item in kept
        ]
    return value


def _mapping(value: Plain) -> dict[str, Plain]:
    return value if isinstance(value, dict) else {}


def _simulation(section: Plain, wrong: AbstractSet[str]) -> dict[str, Plain]:
    times: dict[str, Plain] = {"stop_time": math.nan, "step_size": math.nan}
    unknown: dict[str, Plain] = {name: math.nan for name in _TIMES if f"simulation.{name}" in wrong}
    return {**times, **_mapping(section), **unknown}


def _with_model(instance: Plain, sections: Mapping[str, type[InstanceSection]]) -> dict[str, Plain]:
    usual = next(iter(sections))
    given = instance if isinstance(instance, dict) else {KIND: usual}
    key = str(given[KIND])
    with_path: dict[str, Plain] = {key: "", **given}
    try:
        msgspec.convert(with_path, sections[key])
    except msgspec.ValidationError:  # a kind without a file, or one that misses something else
        shared = {key: given[key] for key in _SHARED if key in given}
        return {KIND: usual, usual: "", **shared}
    return with_path
