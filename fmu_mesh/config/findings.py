"""A collection of findings about one configuration file.

Owns how a path in the file (`connections[2].to`) becomes a line number. Does not know what is checked.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

from fmu_mesh.errors import ConfigurationError, Finding

__all__ = ["Findings", "locate"]


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
    """

    def __init__(
        self,
        file: str,
        lines: Mapping[str, int] | None = None,
        replaced: Mapping[str, str] | None = None,
        first: Sequence[Finding] = (),
    ) -> None:
        self._file = file
        self._lines = lines if lines is not None else {}
        self._replaced = replaced if replaced is not None else {}
        self._items: list[Finding] = [*first]
        self._places: set[str] = {finding.path for finding in first}
        self._settled: frozenset[str] = frozenset()

    def add(self, path: str, found: str, expected: str, suggestion: str | None = None) -> None:
        """Add a finding: the file, or an option, has ``found`` at ``path`` instead of ``expected``."""
        if any(_same_place(path, settled) for settled in self._settled):
            return
        self._places.add(path)
        option = self._option(path)
        line = None if option is not None or path.startswith("--") else locate(self._lines, path)
        self._items.append(Finding(self._file, option or path, found, expected, suggestion, line))

    def merge(self, findings: Iterable[Finding]) -> None:
        """Add earlier findings. Later ones at, inside or around their places are ignored as consequences."""
        for finding in findings:
            self._items.append(finding)
            self._places.add(finding.path)
        if isinstance(findings, Findings):
            self._places |= findings.places
        self._settled = frozenset(self._places - {""})

    @property
    def places(self) -> frozenset[str]:
        """The paths of all findings, also of those about options."""
        return frozenset(self._places)

    def line(self, path: str) -> int | None:
        """The line of ``path``, or of the innermost part of the file around it that has one."""
        return locate(self._lines, path)

    def _option(self, path: str) -> str | None:
        """The option that replaced the value at ``path``, or a part of the file around it, such as a whole section."""
        return self._replaced.get(max((own for own in self._replaced if _is_inside(path, own)), key=len, default=""))

    def __len__(self) -> int:
        return len(self._items)

    def __iter__(self) -> Iterator[Finding]:
        return iter(self._items)

    def raise_any(self) -> None:
        """Raise one error with all findings in the order of their lines; do nothing if there are none.

        Raises:
            ConfigurationError: there is at least one finding.
        """
        if self._items:
            by_line = sorted(self._items, key=lambda finding: (finding.line is None, finding.line or 0))
            text = f"{self._file}: {len(by_line)} problems" if len(by_line) > 1 else str(by_line[0])
            raise ConfigurationError(text, findings=tuple(by_line))


def locate(lines: Mapping[str, int], path: str) -> int | None:
    """The line of ``path``, or of the innermost part around it that has one; None if there is none."""
    while path:
        if path in lines:
            return lines[path]
        path = path[: max(path.rfind("."), path.rfind("["), 0)]
    return lines.get("")


def _same_place(path: str, other: str) -> bool:
    """Whether one of two paths is equal to the other one or inside it."""
    return _is_inside(path, other) or _is_inside(other, path)


def _is_inside(path: str, outer: str) -> bool:
    """Whether a path is equal to another one, or inside it."""
    return path.startswith(outer) and path[len(outer) : len(outer) + 1] in ("", ".", "[")
