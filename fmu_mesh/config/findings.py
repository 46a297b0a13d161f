"""A collection of findings about one configuration.

Owns how a path in the configuration (`connections[2].to`) becomes a file and a line number, or the option that has
replaced the value. Does not know what is checked.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Generic, NamedTuple, TypeVar

import msgspec

from fmu_mesh.errors import ConfigurationError, Finding
from fmu_mesh.files import beside

__all__ = ["CONTAINERS", "Findings", "ValueOrigin", "Written", "located"]

C = TypeVar("C")

CONTAINERS = re.compile(
    r"|simulation|connections|initialization|record|zenoh|security|runtime|timeouts|recovery|limits|(scenario\.)?(values|events)|scenario"
    r"|ros(\.topics)?|instances(\.[^.]+(\.start_values)?)?"
)
"""The paths of mappings and lists whose parts are checked even if something is wrong with the whole, as its key."""


class ValueOrigin(NamedTuple):
    """Where a value was written.

    Example:
        >>> print(ValueOrigin("start.ssv", 12, "Parameter 'k'"))
        Parameter 'k' (start.ssv:12)

    Attributes:
        file: the file as messages name it; empty for an option.
        line: counted from 1; None if it is not known.
        text: the element in words, such as `Parameter 'k'`, or the option; empty if the line says it.
    """

    file: str
    line: int | None
    text: str = ""

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line is not None else self.file
        return f"{self.text} ({place})" if self.text and place else self.text or place


class Findings:
    """All findings about one file.

    Example:
        >>> findings = Findings("mesh.yaml", {"mesh": 1})
        >>> findings.add("mesh", "7", "a name")
        >>> print(*findings)
        mesh.yaml:1: mesh: 7; expected a name

    Args:
        file: the file as the user named it.
        lines: line numbers, counted from 1, by path in the file.
        replaced: the options that replace a value of the file, by path in the file.
        first: findings that there are already.
        origins: where parts of the configuration were written that other files give, by path.
    """

    def __init__(
        self,
        file: str,
        lines: Mapping[str, int] | None = None,
        replaced: Mapping[str, str] | None = None,
        first: Sequence[Finding] = (),
        origins: Mapping[str, ValueOrigin] = MappingProxyType({}),
    ) -> None:
        self._file = file
        self._lines = lines if lines is not None else {}
        self._replaced = replaced if replaced is not None else {}
        self._origins = origins
        self._items: list[Finding] = [*first]
        self._places: set[str] = {finding.path for finding in first}
        self._settled: frozenset[str] = frozenset()

    def add(self, path: str, found: str, expected: str, suggestion: str | None = None) -> None:
        """Add a finding: the file, or an option, has ``found`` at ``path`` instead of ``expected``."""
        if any(_is_inside(path, settled) or _is_inside(settled, path) for settled in self._settled):
            return
        self._places.add(path)
        if path.startswith("`"):
            origin = ValueOrigin("", None, path)
        else:
            origin = located(path, self._file, self._lines, self._replaced, self._origins)
        place, file = (path, origin.file) if origin.file else (origin.text, self._file)
        self._items.append(Finding(file, place, found, expected, suggestion, origin.line))

    def explain(self, paths: Iterable[str]) -> None:
        """Take findings at, inside or around these paths as consequences of the ones that there are already."""
        self._places |= {*paths}
        self._settled |= {*paths}

    def merge(self, findings: Iterable[Finding]) -> None:
        """Add earlier findings. Later ones at, inside or around their places are ignored as consequences."""
        for finding in findings:
            self._items.append(finding)
            self._places.add(finding.path)
        if isinstance(findings, Findings):
            self._places |= findings.places
        self._settled |= frozenset(place for place in self._places if not CONTAINERS.fullmatch(place))

    @property
    def places(self) -> frozenset[str]:
        """The paths of all findings, also of those about options."""
        return frozenset(self._places)

    def line(self, path: str) -> int | None:
        """The line of ``path``, or of the innermost part of the file around it that has one."""
        return located(path, self._file, self._lines, {}, self._origins).line

    def __len__(self) -> int:
        return len(self._items)

    def __iter__(self) -> Iterator[Finding]:
        return iter(self._items)

    def raise_any(self, plan: object = None) -> None:
        """Raise one error with all findings in the order of files and lines, and the plan; nothing if there are none.

        Raises:
            ConfigurationError: there is at least one finding.
        """
        if self._items:
            files = list(dict.fromkeys([self._file, *(finding.file for finding in self._items)]))
            by_line = sorted(self._items, key=lambda one: (files.index(one.file), one.line is None, one.line or 0))
            text = f"{self._file}: {len(by_line)} problems" if len(by_line) > 1 else str(by_line[0])
            raise ConfigurationError(text, findings=tuple(by_line), plan=plan)


class Written(msgspec.Struct, Generic[C], frozen=True):
    """What a file says, and where each part of it stands.

    Attributes:
        config: what it says, overrides included.
        file: the file as the user named it; relative paths in it refer to its folder.
        lines: line numbers, counted from 1, by path in the file.
        overrides: the option (`start_values={'pendulum.l': 2}`) that replaced a value, by path in the file.
        origins: where a value was written, by path in the file, if that is another file.
    """

    config: C
    file: Path
    lines: dict[str, int] = {}
    overrides: dict[str, str] = {}
    origins: dict[str, ValueOrigin] = {}

    def findings(self) -> Findings:
        """An empty collection of findings about this file."""
        return Findings(str(self.file), self.lines, self.overrides, origins=self.origins)

    def resolve(self, relative: str) -> Path:
        """The absolute path for a path in the file, which is relative to the folder of the file."""
        return beside(self.file, relative)


def located(
    path: str,
    file: str,
    lines: Mapping[str, int],
    replaced: Mapping[str, str],
    origins: Mapping[str, ValueOrigin],
) -> ValueOrigin:
    """Where the value at ``path`` of a configuration was written, or the innermost part around it that is known.

    Example:
        >>> lines, options = {"": 1, "instances": 3}, {"instances.gain.start_values.k": "`start_values=...`"}
        >>> print(located("instances.gain.fmu", "mesh.yaml", lines, options, {}))
        mesh.yaml:3
        >>> print(located("instances.gain.start_values.k", "mesh.yaml", lines, options, {}))
        `start_values=...`

    The arguments are those of `Findings`; an option that has replaced a value is its origin, whatever a file says.
    """
    option = replaced.get(max((own for own in replaced if _is_inside(path, own)), key=len, default=""))
    if option is not None:
        return ValueOrigin("", None, option)
    while True:
        if path in origins:
            return origins[path]
        if path in lines or not path:
            return ValueOrigin(file, lines.get(path))
        path = path[: max(path.rfind("."), path.rfind("["), 0)]


def _is_inside(path: str, outer: str) -> bool:
    """Whether a path is equal to another one, or inside it."""
    return path.startswith(outer) and path[len(outer) : len(outer) + 1] in ("", ".", "[")
