"""Which variables each result file has, and at which points: names and patterns of the section `record`.

Owns `RecordPlan` and the meaning of patterns. Knows no format: what a file can hold is checked by a function that the
caller gives (`fmu_mesh.results.formats.check_record`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import msgspec
from msgspec.structs import replace

from ..config.findings import Findings
from ..config.loading import LoadedConfig
from ..config.mesh import RecordConfig
from ..files import archive_on_the_way
from ..simtime import TimeGrid, steps_between
from ..text import EXPRESSION, is_pattern, listed, matched, nearest, short_number, shown
from ..variables.model_description import Causality, ModelDescription, Variable
from ..variables.value_types import element_name, is_text, split_element
from .connections import Variables, resolve_variable
from .coupling_rule import Consistent
from .feeds import Compared

__all__ = [
    "IN_MEMORY",
    "CheckRecord",
    "RecordPlan",
    "record_paths",
    "record_warnings",
    "resolve_records",
    "union_of",
]

IN_MEMORY = ".arrays"
"""The ending of what the library keeps in memory; no file that anybody names."""

_PREFIXES: dict[str, tuple[Causality, ...]] = {
    "out": ("output",),
    "in": ("input",),
    "local": ("local",),
    "param": ("parameter", "calculatedParameter", "structuralParameter"),
}
"""What a pattern with one of these words and a colon before it matches."""

_WORDS = {"out": "output", "in": "input", "local": "local variable", "param": "parameter"}

_MOST_LOCALS = 100
"""Locals of an instance without outputs and states that are recorded where nothing is chosen."""

_DEFAULT_FILE = f"{RecordConfig().file}"
"""How the name of a file ends that nobody has chosen."""


class RecordPlan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One result file: its columns and its rows.

    The file has a row for the points ``first``, ``first + every``, ``first + 2 * every``, ...

    Example:
        >>> plan = RecordPlan("/tmp/slow.csv", (("pendulum", "a"),), first=10, every=5)
        >>> plan.rows_before(21), plan.point_of(2)
        (3, 20)

    Attributes:
        file: absolute path of the file.
        variables: (instance, variable) of every column, in order; of an array every element is a column of its own,
            as `y[1,2]`.
        first: point of the first row.
        every: number of points from row to row.
        consistent: how columns are calculated that are consistent outputs, by `instance.variable`.
    """

    file: str
    variables: tuple[tuple[str, str], ...]
    first: int = 0
    every: int = 1
    consistent: dict[str, Consistent] = {}

    def point_of(self, row: int) -> int:
        """The point of a row; rows are counted from 0."""
        return self.first + row * self.every

    def rows_before(self, point: int) -> int:
        """Number of rows of the points before ``point``."""
        return max(0, -((self.first - point) // self.every))

    def with_consistent(self, consistent: Mapping[tuple[str, str], Consistent]) -> RecordPlan:
        """The file, with these outputs made consistent."""
        own = {".".join(key): consistent[key] for key in self.variables if key in consistent}
        return replace(self, consistent=own)

    @property
    def read(self) -> tuple[tuple[str, str], ...]:
        """(instance, variable) of what the columns are, or are calculated from."""
        terms = (term[:2] for own in self.consistent.values() for term in own.terms)
        return (*self.variables, *terms) if self.consistent else self.variables

    def rows_within(self, first: int, end: int) -> slice:
        """Which ones of the points first to end - 1 have a row, as a slice of arrays with a value for each of them."""
        return slice(self.point_of(self.rows_before(first)) - first, end - first, self.every)


def union_of(records: Sequence[RecordPlan], compared: Sequence[Compared] = ()) -> tuple[tuple[str, str], ...]:
    """(instance, variable) of what all files need, and what is compared, each once, in the order of the files."""
    if len(records) == 1 and not records[0].consistent and not compared:
        return records[0].variables
    columns = [column for record in records for column in record.read]
    return tuple(dict.fromkeys([*columns, *(term[:2] for one in compared for term in one.value.terms)]))


CheckRecord = Callable[[RecordPlan, str, Mapping[str, ModelDescription], Findings], None]
"""Adds a finding for everything that the format of a file cannot hold, given the place of its section."""


def resolve_records(  # noqa: PLR0913, PLR0917  sections, what they may refer to, and where findings go
    loaded: LoadedConfig,
    variables: Variables,
    grid: TimeGrid | None,
    findings: Findings,
    obstacles: Findings,
    check: CheckRecord,
) -> tuple[RecordPlan, ...]:
    """The result files of a configuration; one without a path or without columns is left out.

    Args:
        loaded: the configuration.
        variables: all variables of all instances; None in place of those that are not known.
        grid: the communication points; None after a finding about them.
        findings: where findings go.
        obstacles: where those about the files themselves go, such as a missing package.
        check: what the formats say about their files.
    """
    records: list[RecordPlan] = []
    first_of: dict[str, str] = {}
    for place, section in loaded.config.records.items():
        chosen = _chosen(section, f"{place}.variables", variables, findings)
        file = _file(loaded, place, section, obstacles)
        first = _first_point(section, f"{place}.from", grid, findings)
        if file is None:
            continue
        known = tuple((i, v) for i, v in chosen if (own := variables.descriptions.get(i)) and own.variable_of(v))
        check(RecordPlan(file, known, first, section.every), place, variables.descriptions, obstacles)
        other = first_of.setdefault(file, place)
        if other != place:
            findings.add(f"{place}.file", f"'{section.file}', which is also the file of {other}", "a file of its own")
        if not chosen and _is_named(loaded, place, section) and None not in variables.values():
            found = f"'{section.file}', into which nothing is recorded"
            findings.add(f"{place}.file", found, f"variables in `{place}.variables`, or null to record nothing")
        if chosen:
            records.append(RecordPlan(file, chosen, first, section.every))
    if loaded.config.simulation.defects and not records and not len(findings):
        found = "true, but defects are calculated where rows are written, and nothing is recorded"
        findings.add("simulation.defects", found, "a file in `record`, or false")
    return tuple(records)


def record_warnings(
    loaded: LoadedConfig, variables: Variables, records: Sequence[RecordPlan], warnings: Findings
) -> None:
    """Warn of files without the outputs of an instance."""
    files = {record.file for record in records}
    for place, section in loaded.config.records.items():
        file = _path(loaded, section)
        if file is not None and section.variables is None:
            instead = [(name, words) for name, own in variables.descriptions.items() if (words := _by_default(own)[1])]
            if instead:
                others = listed([f"of {name} {words}" for name, words in instead])
                found = f"no outputs with numbers, so others are recorded: {others}"
                every = f"local:{instead[0][0]}.*" if len(instead) == 1 else "local:*"
                warnings.add(f"{place}.variables", found, f"`{every}` in this list for all locals")
            elif str(file) not in files:
                warnings.add(place, "nothing is recorded: there are no outputs, states or locals with numbers", "")


def record_paths(loaded: LoadedConfig) -> dict[str, Path]:
    """The absolute paths of the result files, by the places of their sections in the configuration."""
    sections = loaded.config.records.items()
    return {place: path for place, section in sections if (path := _path(loaded, section)) is not None}


def _is_named(loaded: LoadedConfig, place: str, section: RecordConfig) -> bool:
    """Whether somebody named the file and expects results in it: with `variables: []`, only an option names it."""
    if section.file is None or Path(section.file).suffix.lower() == IN_MEMORY:
        return False
    in_file = f"{place}.file" in loaded.lines or not section.file.endswith(_DEFAULT_FILE)
    return f"{place}.file" in loaded.overrides or (in_file and section.variables is None)


def _path(loaded: LoadedConfig, section: RecordConfig) -> Path | None:
    return loaded.resolve(section.file.replace("{mesh}", loaded.config.mesh)) if section.file is not None else None


def _file(loaded: LoadedConfig, place: str, section: RecordConfig, findings: Findings) -> str | None:
    text, path, place = section.file, _path(loaded, section), f"{place}.file"
    if path is None:
        return None
    try:
        is_folder = path.is_dir()
    except OSError as error:  # the name is too long, or the folder belongs to another user
        findings.add(place, f"{shown(text)} ({error.strerror})", "a file that can be written")
        return None
    if is_folder:
        findings.add(place, f"the folder '{text}'", "a file, or null to record nothing")
    elif (file := archive_on_the_way(path)) is not None:
        findings.add(place, f"'{text}' in the file '{file}'", "a file in a folder; choose one with `output=...`")
    return str(path)


def _first_point(section: RecordConfig, place: str, grid: TimeGrid | None, findings: Findings) -> int:
    """The first point that is not before the time `from`."""
    start = section.start
    if start is None or grid is None or start <= grid.start_time:
        return 0
    points = steps_between(grid.start_time, start, grid.step_size)
    if points is None:
        points = math.ceil((start - grid.start_time) / grid.step_size)
    if points > grid.last_point:
        end = grid.time(grid.last_point)
        found = f"{short_number(start)} s, after the last communication point"
        findings.add(place, found, f"a time up to {short_number(end)}")
        return 0
    return points


def _chosen(section: RecordConfig, place: str, variables: Variables, findings: Findings) -> tuple[tuple[str, str], ...]:
    """The columns of a file."""
    if section.variables is None:
        return tuple(
            (instance, element)
            for instance, description in variables.descriptions.items()
            for variable in _by_default(description)[0]
            for element in variable.elements
        )
    choice = _Choice(variables, findings)
    for index, reference in enumerate(section.variables):
        choice.add(reference, f"{place}[{index}]")
    return tuple(choice.columns)


def _by_default(description: ModelDescription) -> tuple[Sequence[Variable], str]:
    """What is recorded of an instance where nothing is chosen, and in words what it is if that is not its outputs."""
    numbers = [variable for variable in description.variables if not is_text(variable.type)]
    if outputs := [variable for variable in numbers if variable.causality == "output"]:
        return outputs, ""
    of_states = {*description.states}
    if states := [variable for variable in numbers if variable.name in of_states]:
        return states, f"its continuous states ({len(states)})"
    changing = [variable for variable in numbers if variable.causality == "local" and variable.changes]
    first = f"the first {_MOST_LOCALS} of " if len(changing) > _MOST_LOCALS else ""
    return changing[:_MOST_LOCALS], f"{first}its locals that change ({len(changing)})" if changing else ""


class _Choice:
    """The columns that names and patterns stand for.

    Attributes:
        columns: (instance, variable), and the place where it is named; None: only patterns match it.
    """

    def __init__(self, variables: Variables, findings: Findings) -> None:
        self.columns: dict[tuple[str, str], str | None] = {}
        self._variables = variables
        self._findings = findings

    def add(self, reference: str, place: str) -> None:
        """Add what a name or a pattern stands for; names come first, as those of variables may have any characters."""
        instance, _, name = reference.partition(".")
        word, colon, text = reference.partition(":")
        has_word = bool(colon) and word in _PREFIXES
        if name in (self._variables.get(instance) or ()) or not (has_word or is_pattern(reference)):
            self._add_named(reference, place)
        else:
            self._add_matched(reference, place, *((word, text) if has_word else ("out", reference)))

    def _add_matched(self, reference: str, place: str, word: str, text: str) -> None:
        variables = self._variables
        try:
            names = matched(text, [f"{instance}.{name}" for instance, own in variables.items() for name in own or {}])
        except ValueError as error:
            expected = f"a regular expression of Python after `{EXPRESSION}`"
            self._findings.add(place, f"{shown(reference)} ({error})", expected)
            return
        found = self._matched(names, word)
        for instance, variable in found:
            for element in variable.elements:
                self.columns.setdefault((instance, element), None)
        instance, dot, _ = text.partition(".")
        possible = variables if is_pattern(instance) or not dot else {instance} & variables.keys()
        if not found and all(variables[name] is not None for name in possible):
            self._nothing_matches(f"{shown(reference)}, which matches no {_WORDS[word]}", place, word, text, names)

    def _matched(self, names: set[str], word: str) -> list[tuple[str, Variable]]:
        """The variables with these names that a word stands for, in the order of the file and the descriptions."""
        return [
            (instance, variable)
            for instance, own in self._variables.items()
            for variable in (own or {}).values()
            if variable.causality in _PREFIXES[word]
            and not is_text(variable.type)
            and f"{instance}.{variable.name}" in names
        ]

    def _nothing_matches(self, found: str, place: str, word: str, text: str, names: set[str]) -> None:
        """Say what a pattern may have been meant to be; ``names`` are those that it matches without its word."""
        every = {f"{i}.{v.name}": v for i, own in self._variables.items() for v in (own or {}).values()}
        possible = {name: v for name, v in every.items() if v.causality in _PREFIXES[word]}
        numbers = [name for name, v in possible.items() if not is_text(v.type)]
        texts = [name for name in possible if name in names and name not in numbers]
        others = [other for other in _PREFIXES if self._matched(names, other)]
        if texts:
            expected, near = "each String and Binary by its whole name", texts[0]
        elif not numbers:
            expected, near = f"another pattern: this mesh has no {_WORDS[word]}s with numbers", None
        elif others:
            expected, near = f"a pattern for {_WORDS[others[0]]}s, as it matches some", f"{others[0]}:{text}"
        else:
            expected = f"a pattern for one of {listed(numbers)}"
            near = nearest(re.sub(r"[*?]", "", text.removeprefix(EXPRESSION)), numbers)
        self._findings.add(place, found, expected, near)

    def _add_named(self, reference: str, place: str) -> None:
        """Add a variable, or an element of an array; of a name that is not known the column, for later findings."""
        instance, _, name = reference.partition(".")
        first = self.columns.get((instance, name))
        end = None if first else self._resolved(reference, place)
        names: tuple[str, ...] = (name,)
        if end is not None:
            variable, element = end
            names = (element_name(variable.name, element),) if element else variable.elements
            first = next((where for one in names if (where := self.columns.get((instance, one)))), None)
            if variable.causality == "independent":
                found = f"'{reference}', the independent variable"
                self._findings.add(place, found, "another variable: its values are in the column time")
        if first:
            self._findings.add(place, f"'{reference}' a second time (first: {first})", "every variable at most once")
        for one in names:
            self.columns[instance, one] = first or place

    def _resolved(self, reference: str, place: str) -> tuple[Variable, tuple[int, ...]] | None:
        """As `resolve_variable`; the nearest name is that of any variable where no output is near."""
        instance, _, name = reference.partition(".")
        own = self._variables.get(instance)
        is_clock = own is not None and self._variables.descriptions[instance].clock(name) is not None
        if own and name and name not in own and split_element(name) is None and not is_clock:
            outputs = [variable.name for variable in own.values() if variable.causality == "output"]
            near = nearest(name, own) if nearest(name, outputs) is None else None
            if near is not None:
                found = f"the unknown variable '{name}' of instance '{instance}'"
                self._findings.add(place, found, f"one of the {len(own)} variables of '{instance}'", near)
                return None
        return resolve_variable(reference, place, self._variables, "output", self._findings)
