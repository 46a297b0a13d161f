"""What the entries of `connections` with a Zenoh key mean: names, types, units and times are checked.

Owns which values of a key are for which input, and which values of an output go to which key. Payloads are
`fmu_mesh.node.key_payloads`; the layout of messages of ROS is `fmu_mesh.ros_wire.key_messages`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import UTC, datetime
from typing import Final, Literal

import msgspec

from ..config.findings import Findings
from ..config.key_sections import KEY, KeyInputConfig, KeyOutputConfig, KeyView
from ..simtime import steps_between
from ..text import listed, shown
from ..variables.model_description import Variable
from ..variables.units import BaseUnit, Linear
from ..variables.value_conversion import ValueRefused, to_value
from ..variables.value_types import PlainValue, element_name, is_float
from .connections import Variables, offered, resolve_variable
from .given_units import type_in_words, unit_change
from .start_values import why_not_settable

__all__ = [
    "KeyInput",
    "KeyOutput",
    "KeyPath",
    "KeyValue",
    "RecordedKeys",
    "field_parts",
    "key_views",
    "resolve_keys",
    "seconds_of",
]

KeyPath = tuple[str | int | tuple[str, str], ...]
"""A path into JSON: names, indexes, and (name, text) for the element whose field of this name has this text."""

KeyValue = tuple[str, int, float | None, PlainValue]
"""Instance and variable, the point at which the instance took it, the time in s from which on it holds, value."""

_PART: Final = re.compile(r"""(?:^|\.)([^.\[\]]+)|\[(\d{1,9})\]|\[(\w+)=(["']?)(.+?)\4\]""")
_CHUNK: Final = re.compile(r"(\*\*?|([^*$#?/]|\$\*)+)")
_STAMP: Final = "header.stamp"


class RecordedKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A file with values that have come by keys in an earlier run: `<result>.keys.jsonl`."""

    path: str
    sha256: str


class KeyInput(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The values of a key for one variable.

    Attributes:
        path: its place in the configuration file; so has an output.
        factor: the value is factor * number + offset, for a unit and the factor of the file together.
        map: what stands for a value, by the word for it.
        time: `arrival`, `timestamp`, or the path of a field.
        origin: the time of point 0 in s in the clock of ``time``; None: the first value takes effect when it arrives.
        simulated: whether a number in the field is simulation time.
    """

    variable: str
    key: str
    path: str = ""
    encoding: Literal["auto", "json", "text", "cdr", "float64"] = "auto"
    type: str | None = None
    field: str | None = None
    factor: float = 1.0
    offset: float = 0.0
    map: dict[str, PlainValue] = {}
    time: str = "arrival"
    origin: float | None = None
    simulated: bool = False
    linear: bool = False
    delay: float = 0.0
    wait: bool = False

    def __str__(self) -> str:
        when = "on arrival" if self.time == "arrival" else f"at its {self.time}"
        late = f", {self.delay:g} s later" if self.delay else ""
        words = [when + late, *(["linear"] if self.linear else ()), *(["the run waits for it"] if self.wait else ())]
        return ", ".join(words)


class KeyOutput(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The values of one variable, or of an element of it, for a key.

    Attributes:
        index: the element, counted from 0; empty for the whole variable.
        every: base points between two values; 1: each own point.
    """

    variable: str
    key: str
    path: str = ""
    index: tuple[int, ...] = ()
    on: Literal["point", "change"] = "point"
    every: int = 1
    encoding: Literal["json", "text", "cdr", "float64"] = "json"
    type: str | None = None
    field: str | None = None
    factor: float = 1.0
    offset: float = 0.0
    map: dict[str, PlainValue] = {}
    blocks: bool = False

    def __str__(self) -> str:
        rare = f"every {self.every} points" if self.every > 1 else "at each point"
        when = rare if self.on == "point" else "on change" + (f", at most {rare}" if self.every > 1 else "")
        return when + (", the run waits for who is slow" if self.blocks else "")


def key_views(instance: str, *keys: KeyInput | KeyOutput) -> tuple[KeyView, ...]:
    """What people see of keys of an instance."""
    views = []
    for own in keys:
        index = own.index if isinstance(own, KeyOutput) else ()
        name = element_name(own.variable, index) if index else own.variable
        payload = " ".join(filter(None, (own.type or own.encoding, own.field)))
        views.append(KeyView(instance, own.key, "in" if isinstance(own, KeyInput) else "out", name, payload, str(own)))
    return tuple(views)


def field_parts(path: str) -> KeyPath:
    """The parts of a path into JSON, such as `sensors[0].value` or `sensors[name=flow].value`.

    Raises:
        ValueError: it is no such path.
    """
    parts: list[str | int | tuple[str, str]] = []
    end = 0
    for found in _PART.finditer(path):
        if found.start() != end:
            break
        name, index, key, _, text = found.groups()
        parts.append(name if name is not None else int(index) if index is not None else (key, text))
        end = found.end()
    if end != len(path) or not parts:
        raise ValueError(path)
    return tuple(parts)


def seconds_of(time: object) -> float | None:
    """A time in s: a finite number, or text of ISO 8601 since 1970 (without a zone: UTC); None for anything else."""
    if isinstance(time, str):
        try:
            moment = datetime.fromisoformat(time)
        except ValueError:
            return None
        return (moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)).timestamp()
    if not isinstance(time, int | float) or isinstance(time, bool):
        return None
    return float(time) if abs(time) < 1e300 else None  # a larger integer is no float


def resolve_keys(  # noqa: PLR0913, PLR0917  a part of a configuration, and what is around it
    entries: Iterable[object],
    root: str,
    step_size: float,
    variables: Variables,
    connected: Mapping[str, str],
    unit_of: Callable[[str], BaseUnit | None],
    findings: Findings,
) -> tuple[dict[str, tuple[KeyInput, ...]], dict[str, tuple[KeyOutput, ...]]]:
    """What comes by keys and what goes to keys, by instance; what is wrong is a finding.

    Args:
        entries: the connections of the configuration; one may be a placeholder.
        root: what the keys of the mesh itself begin with.
        step_size: base step size in s.
        variables: all variables of all instances.
        connected: the source instance of each `instance.variable` with a connection.
        unit_of: the meaning of a unit by its usual name; None if it is not known.
        findings: where everything goes that is wrong.
    """
    resolving = _Resolving(root, step_size, variables, dict(connected), unit_of, findings, set())
    inputs: dict[str, list[KeyInput]] = {}
    outputs: dict[str, list[KeyOutput]] = {}
    for index, entry in enumerate(entries):
        path = f"connections[{index}]"
        if isinstance(entry, KeyInputConfig) and entry.target:
            for own in resolving.input(entry, path):
                inputs.setdefault(entry.target.partition(".")[0], []).append(own)
        elif isinstance(entry, KeyOutputConfig) and entry.source:
            for sent in resolving.output(entry, path):
                outputs.setdefault(entry.source.partition(".")[0], []).append(sent)
    return {name: tuple(own) for name, own in inputs.items()}, {name: tuple(own) for name, own in outputs.items()}


class _Resolving(msgspec.Struct):
    """See `resolve_keys`; ``published`` has the keys of the outputs so far."""

    root: str
    step_size: float
    variables: Variables
    connected: dict[str, str]
    unit_of: Callable[[str], BaseUnit | None]
    findings: Findings
    published: set[str]

    def input(self, entry: KeyInputConfig, path: str) -> Iterator[KeyInput]:
        """The meaning of one entry; nothing after a finding, or without a model description."""
        before = len(self.findings)
        variable = self._target(entry, path)
        wild = self._check_key(entry.key, path)
        if wild and entry.take != "newest":
            found = f"'{entry.key}', which can match several keys"
            self.findings.add(f"{path}.key", found, "one key, or `take: newest` as well")
        if wild and entry.wait:
            self.findings.add(f"{path}.wait", "true for a key with a wildcard", "false, or one key")
        origin = self._origin(entry, path)
        self._check_message(entry, path)
        linear = entry.interpolation == "linear"
        if variable is None:
            return
        if linear and not (is_float(variable.type) and variable.causality == "input"):
            found = f"linear for '{entry.target}', {type_in_words(variable)}"
            self.findings.add(f"{path}.interpolation", found, "hold; inputs of type Real may be linear")
        self._check_factors(entry, variable, path)
        change = unit_change(entry.unit, variable, path, self.variables, self.unit_of, self.findings)
        both = change.then(Linear(entry.factor, entry.offset)) if change is not None else Linear()
        mapped = self._map(entry, variable, path)
        if len(self.findings) == before:
            yield KeyInput(
                variable=variable.name,
                key=entry.key,
                path=path,
                encoding=entry.encoding,
                type=entry.type,
                field=entry.field,
                factor=both.factor,
                offset=both.offset,
                map=mapped,
                time=entry.time,
                origin=origin,
                simulated=entry.origin is None and entry.time not in ("timestamp", _STAMP),
                linear=linear,
                delay=entry.delay,
                wait=entry.wait,
            )

    def output(self, entry: KeyOutputConfig, path: str) -> Iterator[KeyOutput]:
        """As `input`, for a key that others read."""
        before, add = len(self.findings), self.findings.add
        if self._check_key(entry.key, path) or entry.key.startswith(self.root):
            add(f"{path}.key", f"'{entry.key}'", f"one key, without wildcards, and not below {self.root}")
        if entry.key in self.published:
            add(f"{path}.key", f"'{entry.key}' a second time", "a key of its own for each output")
        self.published.add(entry.key)
        self._check_message(entry, path)
        step = self.step_size
        every = steps_between(0.0, entry.every, step) if entry.every is not None and step > 0.0 else 1
        if not every:
            add(f"{path}.every", f"{entry.every:g} s", f"a multiple of the step size {step:.12g} s")
        found = resolve_variable(entry.source, f"{path}.from", self.variables, "output", self.findings)
        if found is None:
            return
        variable, index = found
        if variable.causality == "independent":
            add(f"{path}.from", f"'{entry.source}', the time", "another variable; each value has its time")
        self._check_factors(entry, variable, path)
        if entry.map and entry.encoding in ("cdr", "float64"):
            add(f"{path}.map", f"a map with `encoding: {entry.encoding}`", "json or text")
        units = self.variables, self.unit_of, self.findings
        change = unit_change(entry.unit, variable, path, *units, outwards=True) or Linear()
        both = change.then(Linear(entry.factor, entry.offset))
        if len(self.findings) == before:
            yield KeyOutput(
                variable=variable.name,
                key=entry.key,
                path=path,
                index=index,
                on=entry.on,
                every=every or 1,
                encoding=entry.encoding,
                type=entry.type,
                field=entry.field,
                factor=both.factor,
                offset=both.offset,
                map=dict(entry.map),
                blocks=entry.congestion == "block",
            )

    def _target(self, entry: KeyInputConfig, path: str) -> Variable | None:
        def may_be_set(instance: str, variable: Variable) -> bool:
            return why_not_settable(variable, self.connected.get(f"{instance}.{variable.name}")) is None

        found = resolve_variable(entry.target, f"{path}.to", self.variables, may_be_set, self.findings)
        if found is None:
            return None
        (variable, index), instance = found, entry.target.partition(".")[0]
        name = f"{instance}.{variable.name}"
        if index:
            self.findings.add(f"{path}.to", f"'{entry.target}', an element of an array", f"the whole array: {name}")
        elif (why := why_not_settable(variable, self.connected.get(name))) is not None:
            names = listed(offered(instance, self.variables, may_be_set))
            expected = f"an input that is not connected, or a tunable parameter of '{instance}': {names}"
            self.findings.add(f"{path}.to", f"'{name}', which {why.partition(';')[0]}", expected)
        self.connected.setdefault(name, f"{KEY}{entry.key}")
        return variable

    def _origin(self, entry: KeyInputConfig, path: str) -> float | None:
        """The time of point 0 in s, if the entry says it; checks all that belongs to times."""
        add, has_time = self.findings.add, entry.time != "arrival"
        keys = {"delay": entry.delay != 0.0, "origin": entry.origin is not None}
        keys["interpolation"] = entry.interpolation == "linear"
        for name in (name for name, given in keys.items() if given and not has_time):
            found = f"{getattr(entry, name)} for values that take effect on arrival"
            add(f"{path}.{name}", found, "`time: timestamp`, or a field with the time")
        if not 0.0 <= entry.delay < math.inf:
            add(f"{path}.delay", f"{entry.delay:g}", "a time >= 0 in s")
        fields = {"field": entry.field, "time": entry.time if has_time and entry.time != "timestamp" else None}
        for name, field in fields.items() if entry.encoding != "cdr" else ():
            if field is not None and entry.encoding == "float64":
                add(f"{path}.{name}", f"the field '{field}' of doubles, which have none", "`encoding: json`")
            try:
                field_parts(field if field is not None else "value")
            except ValueError:
                expected = "a path such as sensors[0].value or sensors[name=flow].value"
                add(f"{path}.{name}", f"'{field}'", expected)
        if entry.encoding == "cdr" and entry.time not in ("arrival", "timestamp", _STAMP):
            add(f"{path}.time", f"the field '{entry.time}' of a message", f"arrival, timestamp or {_STAMP}")
        origin = seconds_of(entry.origin)
        if origin is None and entry.origin not in (None, "first"):
            add(f"{path}.origin", shown(entry.origin), "first, seconds, or a time such as 2026-05-01T12:00:00Z")
        return origin

    def _check_key(self, key: str, path: str) -> bool:
        """Whether a key has wildcards; a finding if it is no key of Zenoh."""
        if key and not all(map(_CHUNK.fullmatch, key.split("/"))):
            self.findings.add(
                f"{path}.key", f"'{key}'", "a Zenoh key such as plant/pump/flow, without #, ? and empty parts"
            )
        return "*" in key

    def _check_message(self, entry: KeyInputConfig | KeyOutputConfig, path: str) -> None:
        if (entry.encoding == "cdr") != (entry.type is not None):
            missing = entry.type is None
            found = "`encoding: cdr` without a type" if missing else f"a type for `encoding: {entry.encoding}`"
            self.findings.add(f"{path}.type", found, "the type of a ROS message, and `encoding: cdr`")
        if isinstance(entry, KeyOutputConfig) and entry.field is not None and entry.encoding != "cdr":
            self.findings.add(f"{path}.field", f"a field for `encoding: {entry.encoding}`", "`encoding: cdr`")

    def _check_factors(self, entry: KeyInputConfig | KeyOutputConfig, variable: Variable, path: str) -> None:
        changes = (entry.factor, entry.offset) != (1.0, 0.0)
        if changes and not is_float(variable.type):
            found = (
                f"factor {entry.factor:g} and offset {entry.offset:g} for the {variable.type_name} '{variable.name}'"
            )
            self.findings.add(path, found, "factor and offset of Real only")
        if entry.encoding == "float64" and variable.type != "Float64":
            self.findings.add(
                f"{path}.encoding", f"float64 for the {variable.type_name} '{variable.name}'", "a Float64"
            )
        if changes and entry.map:
            self.findings.add(f"{path}.map", "a map, and factor and offset", "one of the two")

    def _map(self, entry: KeyInputConfig, variable: Variable, path: str) -> dict[str, PlainValue]:
        if entry.map and variable.shape:
            self.findings.add(f"{path}.map", f"a map for the array '{variable.name}'", "a map for a scalar")
            return {}
        for word, value in entry.map.items():
            try:
                to_value(value, variable)
            except ValueRefused as refused:
                found = f"{shown(value)} for the {variable.type_name} '{variable.name}'"
                self.findings.add(f"{path}.map.{word}", found, refused.expected, refused.suggestion)
        return dict(entry.map)
