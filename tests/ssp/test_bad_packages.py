"""Packages with a fault: each is refused with its file, its line and its element, and with a way out."""

from __future__ import annotations

from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh.errors import ConfigurationError, Finding
from tests.ssp.bad_packages import BAD_ARCHIVES, BAD_PACKAGES, GOOD, Edit, Fault, edited
from tests.ssp.packages import write_package


def findings_in(path: Path) -> tuple[Finding, ...]:
    """All that is wrong in a package; a finding that stands for the whole has no line."""
    with pytest.raises(ConfigurationError) as caught:
        fmu_mesh.load(path).check()
    error = caught.value
    return error.findings or (Finding(str(path), "", str(error), ""),)


def line_of(text: str, wanted: str) -> int:
    """The line of a text that stands once in another one: where its start tag ends."""
    assert text.count(wanted) == 1, wanted
    return text.count("\n", 0, text.index(wanted)) + 1


def test_the_good_package_has_no_finding_and_no_warning(tmp_path: Path) -> None:
    path = write_package(tmp_path / "good.ssp", GOOD)

    check = fmu_mesh.load(path).check()

    assert check.findings == ()
    assert check.warnings == ()


@pytest.mark.parametrize("fault", BAD_PACKAGES, ids=lambda fault: fault.name)
def test_a_fault_is_refused_with_its_file_line_and_element(fault: Fault, tmp_path: Path) -> None:
    files = edited(*fault.edits, without=fault.without)
    path = write_package(tmp_path / "bad.ssp", files)

    findings = findings_in(path)

    found = [one for one in findings if all(word in str(one) for word in fault.words)]
    everything = "\n".join(map(str, findings))
    assert len(found) == 1, everything
    assert len(findings) == fault.count, everything
    assert found[0].path.startswith(fault.element), everything
    if fault.at:
        text = files[fault.file]
        assert isinstance(text, str)
        assert found[0].file == str(path / fault.file)
        assert found[0].line == line_of(text, fault.at), everything
