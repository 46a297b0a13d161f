"""The table in docs/ssp.md: each row names a system or a fault that is tested, and each system has a row."""

from __future__ import annotations

from pathlib import Path

from tests.ssp.bad_packages import BAD_ARCHIVES, BAD_PACKAGES
from tests.ssp.own_systems import SYSTEMS
from tests.ssp.supported_systems import SUPPORTED

PAGE = Path(__file__).parents[2] / "docs" / "ssp.md"
FAULTS = {*BAD_ARCHIVES, *(fault.name for fault in BAD_PACKAGES), "a connection of a clock"}


def rows() -> list[list[str]]:
    """The rows of the table without those that are headings: feature, clause, what happens here, tests."""
    lines = PAGE.read_text(encoding="utf-8").partition("| feature | clause | here | test |\n")[2].splitlines()[1:]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    return [row for row in cells if not row[0].startswith("**")]


def named() -> dict[str, list[str]]:
    """The names in the last column, by feature."""
    return {feature: tests.split("; ") for feature, _, _, tests in rows()}


def test_each_row_names_systems_and_faults_that_are_tested() -> None:
    known = {*FAULTS, *SYSTEMS, *(own.name for own in SUPPORTED)}

    unknown = {feature: sorted({*names} - known) for feature, names in named().items() if {*names} - known}

    assert len(named()) > 40
    assert unknown == {}


def test_each_row_that_refuses_something_names_a_fault() -> None:
    refusing = {row[0] for row in rows() if "refused" in row[2] or "ends the run" in row[2]}

    without = {feature for feature in refusing if not FAULTS & {*named()[feature]}}

    assert without == {"Integer to Enumeration and other types"}  # tests/equivalence/test_maps.py ends such runs


def test_each_system_has_a_row() -> None:
    shown = {name for names in named().values() for name in names}

    assert {own.name for own in SUPPORTED} - shown == set()
