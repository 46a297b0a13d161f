"""A collection of findings and warnings about the files of a package, each with its file, line and element."""

from __future__ import annotations

from collections.abc import Hashable, Iterable

from msgspec.structs import replace

from ..errors import Finding
from ..text import listed, nearest, printable
from .system_structure import FilePlace

__all__ = ["Problems"]


class Problems:
    """What is wrong in the files of a package, and what is only noted.

    Attributes:
        findings: what prevents a run.
        warnings: what does not.
    """

    def __init__(self) -> None:
        self.findings: list[Finding] = []
        self.warnings: list[Finding] = []
        self._alike: dict[Hashable, tuple[int, list[Finding]]] = {}  # by kind: where the first one is, and all

    def add(self, place: FilePlace, found: str, expected: str, suggestion: str | None = None) -> None:
        """Add a finding: there is ``found`` instead of ``expected``."""
        self._add(self.findings, _finding(place, found, expected, suggestion))

    def unknown(self, place: FilePlace, found: str, name: str, names: Iterable[str]) -> None:
        """Add a finding about a ``name`` that is none of ``names``; suggests the nearest one."""
        known = [*names]
        self.add(place, found, f"one of {listed(known)}", nearest(name, known))

    def warn(self, place: FilePlace, found: str, expected: str = "") -> None:
        """Add a warning."""
        self._add(self.warnings, _finding(place, found, expected))

    def warn_once(self, like: Hashable, place: FilePlace, found: str, what: str) -> None:
        """Add a warning, or let the first one of its kind say how many others there are.

        The warnings of one kind have equal values of ``like``, and are about ``what``, such as `value`.
        """
        finding = _finding(place, found)
        index, alike = self._alike.setdefault(like, (len(self.warnings), []))
        if finding in alike:
            return  # an element may be read more than once
        alike.append(finding)
        if len(alike) == 1:
            self.warnings.append(finding)
        else:
            more = f"one more {what}" if len(alike) == 2 else f"{len(alike) - 1} more {what}s"
            self.warnings[index] = replace(alike[0], found=f"{alike[0].found}; {more} likewise")

    @staticmethod
    def _add(found_so_far: list[Finding], finding: Finding) -> None:
        if finding not in found_so_far:  # an element may be read more than once
            found_so_far.append(finding)


def _finding(place: FilePlace, found: str, expected: str = "", suggestion: str | None = None) -> Finding:
    """A finding whose texts, which may have names of the package in them, are one line each."""
    near = printable(suggestion) if suggestion is not None else None
    return Finding(place.file, place.element, printable(found), printable(expected), near, place.line or None)
