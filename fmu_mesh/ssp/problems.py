"""A collection of findings and warnings about the files of a package, each with its file, line and element."""

from __future__ import annotations

from ..errors import ConfigurationError, Finding
from ..text import printable
from .structure import Place

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

    def add(self, place: Place, found: str, expected: str, suggestion: str | None = None) -> None:
        """Add a finding: there is ``found`` instead of ``expected``."""
        self._add(self.findings, place, found, expected, suggestion)

    def warn(self, place: Place, found: str, expected: str = "") -> None:
        """Add a warning."""
        self._add(self.warnings, place, found, expected, None)

    def raise_any(self, file: str) -> None:
        """Raise one error with all findings in the order of their files and lines; do nothing if there are none.

        Raises:
            ConfigurationError: there is at least one finding.
        """
        if self.findings:
            files = {finding.file: number for number, finding in reversed(list(enumerate(self.findings)))}
            ordered = sorted(self.findings, key=lambda finding: (files[finding.file], finding.line or 0))
            text = f"{file}: {len(ordered)} problems" if len(ordered) > 1 else str(ordered[0])
            raise ConfigurationError(text, findings=tuple(ordered))

    @staticmethod
    def _add(found_so_far: list[Finding], place: Place, found: str, expected: str, suggestion: str | None) -> None:
        near = printable(suggestion) if suggestion is not None else None
        finding = Finding(place.file, place.element, printable(found), printable(expected), near, place.line or None)
        if finding not in found_so_far:  # an element may be read more than once
            found_so_far.append(finding)
