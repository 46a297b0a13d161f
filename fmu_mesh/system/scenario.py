"""What a scenario means: its names, types, units and times are checked, and each variable gets a `Schedule`.

Owns which values the steps of a run use, and which of them are start values. Reading bags is not its business: the
values in them are an argument, because only `fmu_mesh.ros` knows messages.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
from msgspec.structs import replace

from ..config.findings import Findings
from ..config.scenario_section import ScenarioSource, ScenarioValues
from ..errors import Finding
from ..simtime import TimeGrid
from ..text import listed, shown
from ..variables.model_description import Value, Variable
from ..variables.units import BaseUnit, Linear
from ..variables.value_conversion import FINITE, ValueRefused, to_plain, to_value
from ..variables.value_types import PlainValue, is_float
from .connections import Variables, offered, resolve_variable
from .given_units import changed, type_in_words, unit_change
from .schedule import Course, Schedule, SeriesFile
from .series_files import SeriesRefused, columns_of, content_of, course_of, read_series
from .start_values import why_not_settable

__all__ = [
    "BAG_STAMP_S",
    "BagValues",
    "ResolvedScenario",
    "Scenario",
    "ScenarioInput",
    "is_bag",
    "resolve_scenario",
]

BAG_STAMP_S = 1.5e-9
"""Stamps of messages are whole nanoseconds: the largest difference in s of two equal ones."""

_OF_TABLES = ("column", "time")
_OF_BAGS = ("topic", "start", "stamps")

_UNCHANGED = Linear()

PlainInput = Any  # a constant of a file; `to_value` says what may be one


class BagValues(NamedTuple):
    """What the messages of a bag say about one variable: times in s, in ascending order, and values."""

    times: tuple[float, ...]
    values: tuple[Value, ...]


class Scenario(NamedTuple):
    """A scenario with what is outside of its file.

    Attributes:
        source: what the file says.
        bags: the values that come from bags, by `instance.variable`. One may be missing because its bag could not be
            read; then there is a finding for it.
        unit_of: the meaning of a unit by its usual name; None if it is not known.
    """

    source: ScenarioSource
    bags: Mapping[str, BagValues] = {}
    unit_of: Callable[[str], BaseUnit | None] = lambda _name: None


class ScenarioInput(NamedTuple):
    """One instance, as far as a scenario needs it: its start values, its points per own step, and what NaN means."""

    start_values: Mapping[str, Value]
    step_points: int
    not_finite: Literal["stop", "record"] = "stop"


class ResolvedScenario(msgspec.Struct, frozen=True):
    """What a scenario sets.

    Attributes:
        schedules: by instance.
        start_values: by instance and variable: what it prescribes for the start.
        files: the SHA-256 of each file that it reads, by absolute path.
        warnings: what has no effect.
    """

    schedules: dict[str, tuple[Schedule, ...]] = {}
    start_values: dict[str, dict[str, Value]] = {}
    files: dict[str, str] = {}
    warnings: tuple[Finding, ...] = ()


class _Entry(NamedTuple):
    """One entry of `values`, or the values of one variable in all events."""

    instance: str
    variable: Variable
    path: str
    schedule: Schedule


def is_bag(values: ScenarioValues) -> bool:
    """Whether values come from a bag."""
    file = values.file or ""
    return values.topic is not None or file.endswith((".mcap", ".db3"))


def resolve_scenario(  # noqa: PLR0913, PLR0917  what a scenario refers to
    scenario: Scenario,
    variables: Variables,
    instances: Mapping[str, ScenarioInput],
    sources: Mapping[str, str],
    grid: TimeGrid,
    findings: Findings,
) -> ResolvedScenario:
    """Resolve a scenario.

    Args:
        scenario: the scenario.
        variables: all variables of all instances; None for an instance without a model description.
        instances: those with a model description.
        sources: the source instance of each `instance.variable` that is connected, and so cannot be set.
        grid: the communication points.
        findings: where everything goes that is wrong; its paths are those of the file of the scenario.
    """
    late = scenario.source.findings()
    return _Resolving(scenario, variables, instances, sources, grid, findings, late, {}).resolved()


class _Resolving(msgspec.Struct):
    """See `resolve_scenario`; ``late`` are warnings of times after the last step, ``files`` the hashes of all files."""

    scenario: Scenario
    variables: Variables
    instances: Mapping[str, ScenarioInput]
    sources: Mapping[str, str]
    grid: TimeGrid
    findings: Findings
    late: Findings
    files: dict[str, str]

    def resolved(self) -> ResolvedScenario:
        """All schedules without a finding."""
        entries = {(entry.instance, entry.variable.name): entry for entry in self._values()}
        for event in self._events():
            key = event.instance, event.variable.name
            first = entries.get(key)
            if first is not None and first.schedule.linear:
                found = f"an event for '{'.'.join(key)}', which changes linearly ({first.path})"
                self.findings.add(event.path, found, "one of the two")
            elif first is not None:  # at equal times an event counts: it comes behind
                both = first.schedule, event.schedule
                pairs = [pair for one in both for pair in zip(one.times, one.values, strict=True)]
                times, values = zip(*sorted(pairs, key=itemgetter(0)), strict=True)
                entries[key] = first._replace(schedule=replace(first.schedule, times=times, values=values))
            else:
                entries[key] = event
        schedules: dict[str, list[Schedule]] = {}
        start_values: dict[str, dict[str, Value]] = {}
        for entry in entries.values():
            if (course := self._course(entry)) is None:
                continue
            schedules.setdefault(entry.instance, []).append(entry.schedule)
            if entry.schedule.file or not entry.schedule.initial:
                begin = self.grid.time(course.first_step * self.instances[entry.instance].step_points)
                self._tell_late([(entry.path, begin)], entry.instance)
            start = course.value(0) if entry.schedule.initial else None
            if start is not None:
                start_values.setdefault(entry.instance, {})[entry.variable.name] = start
                self._check_start(entry)
        by_instance = {name: tuple(own) for name, own in schedules.items()}
        return ResolvedScenario(by_instance, start_values, self.files, tuple(self.late))

    # --- the parts of the file

    def _values(self) -> Iterator[_Entry]:
        for reference, given in self.scenario.source.config.values.items():
            path = f"{self.scenario.source.prefix}values.{reference}"
            end = self._settable(reference, path)
            if end is None:
                continue
            schedule: Schedule | None = None
            if isinstance(given, ScenarioValues):
                schedule = self._over_time(reference, given, end[1], path)
            elif (value := self._value(given, end[1], path)) is not None:  # a constant
                schedule = Schedule(end[1].name, (self.grid.start_time,), (value,))
            if schedule is not None:
                yield _Entry(*end, path, schedule)

    def _events(self) -> Iterator[_Entry]:
        """What all events set, by variable."""
        found: dict[tuple[str, str], list[tuple[float, PlainValue]]] = {}
        ends: dict[tuple[str, str], _Entry] = {}
        given: set[tuple[str, str, float]] = set()
        events = enumerate(self.scenario.source.config.events)
        for index, event in sorted(events, key=lambda item: item[1].at):
            for reference, plain in event.set.items():
                path = f"{self.scenario.source.prefix}events[{index}].set.{reference}"
                end = self._settable(reference, path)
                value = self._value(plain, end[1], path) if end is not None else None
                if end is None or value is None or event.at == math.inf:  # its time is wrong
                    continue
                key = end[0], end[1].name
                if (*key, event.at) in given:
                    text = f"'{reference}' at {event.at:g} s a second time"
                    self.findings.add(path, text, "one event for a variable at a time")
                given.add((*key, event.at))
                self._tell_late([(path, event.at)], end[0])
                found.setdefault(key, []).append((event.at, value))
                ends.setdefault(key, _Entry(*end, path, Schedule(end[1].name, (), ())))
        for key, pairs in found.items():
            times, values = zip(*pairs, strict=True)
            yield ends[key]._replace(schedule=Schedule(key[1], times, values))

    def _settable(self, reference: str, path: str) -> tuple[str, Variable] | None:
        """The instance and the variable of a reference that may be set; None after a finding, or without a model."""
        end = resolve_variable(reference, path, self.variables, self._is_settable, self.findings)
        if end is None:
            return None
        (variable, index), instance = end, reference.partition(".")[0]
        if index:
            found = f"'{reference}', an element of the array '{variable.name}'"
            self.findings.add(path, found, f"the whole array: {instance}.{variable.name}")
            return None
        if (why := self._why_not_settable(instance, variable)) is not None:
            names = offered(instance, self.variables, self._is_settable)
            expected = f"an input that is not connected, or a tunable parameter of '{instance}': {listed(names)}"
            self.findings.add(path, f"'{reference}', which {why.partition(';')[0]}", expected)
            return None
        return instance, variable

    def _why_not_settable(self, instance: str, variable: Variable) -> str | None:
        return why_not_settable(variable, self.sources.get(f"{instance}.{variable.name}"))

    def _is_settable(self, instance: str, variable: Variable) -> bool:
        return self._why_not_settable(instance, variable) is None

    # --- one variable

    def _over_time(self, reference: str, given: ScenarioValues, variable: Variable, path: str) -> Schedule | None:
        can_be_linear = is_float(variable.type) and variable.causality == "input"
        automatic = "linear" if can_be_linear and variable.variability == "continuous" else "hold"
        linear = (automatic if given.interpolation == "auto" else given.interpolation) == "linear"
        if linear and not can_be_linear:
            found = f"linear for '{reference}', {type_in_words(variable)}"
            self.findings.add(f"{path}.interpolation", found, "hold; inputs of type Real may be linear")
            return None
        change = unit_change(given.unit, variable, path, self.variables, self.scenario.unit_of, self.findings)
        if change is None or not self._keys_fit(given, path):
            return None
        if given.file is None:
            schedule = self._listed(given, variable, change, path)
            places = [(f"{path}.times[{at}]", time) for at, time in enumerate(schedule.times if schedule else ())]
            self._tell_late(places, reference.partition(".")[0], linear=linear)
        elif is_bag(given):
            schedule = self._bag(reference, given, variable, change, path)
        else:
            schedule = self._table(reference, given, variable, change, path)
        return replace(schedule, linear=linear) if schedule is not None else None

    def _keys_fit(self, given: ScenarioValues, path: str) -> bool:
        """Whether the keys go together: either a file, or times with values."""
        before = len(self.findings)
        if given.file is None:
            for key in (*_OF_TABLES, *_OF_BAGS):
                if getattr(given, key) is not None:
                    self.findings.add(f"{path}.{key}", f"'{key}' without a file", "file: with the values")
            if len(self.findings) == before and (given.times is None or given.values is None):
                missing = "times" if given.times is None else "values"
                self.findings.add(f"{path}.{missing}", "missing", "times: and values:, or file: with both")
        else:
            others = _OF_TABLES if is_bag(given) else _OF_BAGS
            for key in ("times", "values", *others):
                if getattr(given, key) is not None:
                    what = "a bag" if is_bag(given) else "a table"
                    self.findings.add(f"{path}.{key}", f"'{key}' for {what}, '{given.file}'", "no such key here")
            if is_bag(given) and given.topic is None:
                self.findings.add(f"{path}.topic", "missing", "the topic and field, such as /cmd:linear.x")
        return len(self.findings) == before

    def _listed(self, given: ScenarioValues, variable: Variable, change: Linear, path: str) -> Schedule | None:
        times, plain = given.times or [], given.values or []
        if len(times) != len(plain) or not times:
            found = f"{len(plain)} values for {len(times)} times"
            self.findings.add(f"{path}.values", found, "one value for each time, and at least one")
            return None
        for index in range(1, len(times)):
            if times[index] < times[index - 1]:
                found = f"{times[index]:g} s after {times[index - 1]:g} s"
                self.findings.add(f"{path}.times[{index}]", found, "times in ascending order")
                return None
        values = [self._value(one, variable, f"{path}.values[{i}]", change) for i, one in enumerate(plain)]
        if any(value is None for value in values) or any(map(math.isnan, times)):  # a time that is wrong
            return None
        return Schedule(variable.name, tuple(times), tuple(value for value in values if value is not None))

    def _bag(
        self, reference: str, given: ScenarioValues, variable: Variable, change: Linear, path: str
    ) -> Schedule | None:
        found = self.scenario.bags.get(reference)
        if found is None:
            return None
        values = []
        for time, one in zip(*found, strict=True):
            value = self._value(one, variable, f"{path}.topic", change, f" at {time:.9g} s")
            if value is None:
                return None
            values.append(value)
        self._hash(self.scenario.source.resolve(given.file or ""))
        return Schedule(variable.name, found.times, tuple(values), initial=False, tolerance=BAG_STAMP_S)

    def _table(
        self, reference: str, given: ScenarioValues, variable: Variable, change: Linear, path: str
    ) -> Schedule | None:
        file = self.scenario.source.resolve(given.file or "")
        try:
            digest = self._hash(file)
            column, time = given.column, given.time or "time"
            if column is None:
                names = columns_of(file)
                others = [name for name in names if name != time]
                near = [name for name in (reference, variable.name) if name in others]
                column = near[0] if near else others[0] if len(others) == 1 else reference
            series = SeriesFile(str(file), digest, time, column, change.factor, change.offset)
            read_series(series, variable)
        except SeriesRefused as refused:
            self.findings.add(f"{path}.{refused.key}", str(refused), refused.expected, refused.suggestion)
            return None
        return Schedule(variable.name, (), (), file=series)

    def _hash(self, file: Path) -> str:
        """The SHA-256 of a file; of a folder, that is not known."""
        if file.is_dir():
            return ""
        if str(file) not in self.files:
            self.files[str(file)] = content_of(file)
        return self.files[str(file)]

    def _value(
        self, plain: PlainInput, variable: Variable, path: str, change: Linear = _UNCHANGED, where: str = ""
    ) -> PlainValue | None:
        """A value in the unit of the variable; None after a finding."""
        try:
            return to_plain(to_value(changed(plain, change), variable))
        except ValueRefused as refused:
            found = f"{shown(plain)}{where} for the {variable.type_name} '{variable.name}'"
            if refused.out_of_range:
                found = f"{shown(plain)}{where} for '{variable.name}', which is out of its range"
            self.findings.add(path, found, refused.expected, refused.suggestion)
            return None

    # --- the run

    def _course(self, entry: _Entry) -> Course | None:
        own = self.instances[entry.instance]
        try:
            course = course_of(entry.schedule, entry.variable, self.grid, own.step_points)
        except SeriesRefused as refused:
            self.findings.add(f"{entry.path}.{refused.key}", str(refused), refused.expected)
            return None
        time = course.not_finite_at if own.not_finite == "stop" else None
        if time is not None:
            found = f"a value of '{entry.instance}.{entry.variable.name}' at {time:.9g} s that is not finite"
            self.findings.add(entry.path, found, FINITE)
            return None
        return course

    def _tell_late(self, places: Sequence[tuple[str, float]], instance: str, *, linear: bool = False) -> None:
        """Warn of the first time after the last step: it, the stop time, or the unit of a time may be wrong."""
        points, last, time_of = self.instances[instance].step_points, self.grid.last_point, self.grid.time
        late = [self.grid.step_at(time, points) * points >= last > 0 for _, time in places]
        for path, time in places[late.index(True) + linear :][:1] if any(late) else ():  # the first one may end a line
            found = f"never reached: at {time:.9g} s, stop time {time_of(last):.9g} s"
            self.late.add(path, found, f"a time up to {time_of((last - 1) // points * points):.9g} s: the last step")

    def _check_start(self, entry: _Entry) -> None:
        """A value for the start is a start value: there must be no other one, and it must be allowed."""
        name = f"{entry.instance}.{entry.variable.name}"
        other = self.instances[entry.instance].start_values.get(entry.variable.name)
        if other is not None:
            found = f"a value of '{name}' at the start, which has the start value {shown(other)}, too"
            self.findings.add(entry.path, found, "one of the two")
        elif not entry.variable.settable_before_start:
            found = f"a value of '{name}' at the start, {entry.variable.role} that cannot be set before the start"
            self.findings.add(entry.path, found, f"values after {self.grid.start_time:g} s")
