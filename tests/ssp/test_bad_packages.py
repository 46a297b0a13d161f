"""Packages with a fault: each is refused with its file, its line and its element, and with a way out."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh.errors import Finding
from tests.fmus.helpers import find_fmu
from tests.fmus.packing import repacked
from tests.ssp.bad_packages import BAD_ARCHIVES, BAD_PACKAGES, GOOD, Fault, edited
from tests.ssp.packages import Files, component, connection, connector, description, system, write_package

TOGETHER = (
    "a connector that the system does not have",
    "a kind that is not the causality of the FMU",
    "an implementation that does not exist",
    "a factor that is no number",
    "an SSV with a parameter without a type",
    "an SSM of another version",
    "two units of one name",
    "an inline value of another type",
    "a step size that is none",
)
"""Faults in different places of the files."""


def findings_in(path: Path) -> tuple[Finding, ...]:
    """All that is wrong in a package; where nothing of it can be read, `load` says so."""
    try:
        return fmu_mesh.load(path).check().findings
    except fmu_mesh.ConfigurationError as error:
        return error.findings


def line_of(text: str, wanted: str) -> int:
    """The line of a text that stands once in another one."""
    assert text.count(wanted) == 1, wanted
    return text.count("\n", 0, text.index(wanted)) + 1


def is_meant(finding: Finding, fault: Fault, root: Path) -> bool:
    """Whether a finding says what must be said about a fault."""
    text = edited(*fault.edits)[fault.file]
    assert isinstance(text, str)
    return (
        all(word in str(finding) for word in fault.words)
        and finding.path.startswith(fault.element)
        and (not fault.at or (finding.file, finding.line) == (str(root / fault.file), line_of(text, fault.at)))
    )


def test_the_good_package_has_no_finding_and_no_warning(tmp_path: Path) -> None:
    check = fmu_mesh.load(write_package(tmp_path / "good.ssp", GOOD)).check()

    assert check.findings == ()
    assert check.warnings == ()


@pytest.mark.parametrize("fault", BAD_PACKAGES, ids=lambda fault: fault.name)
def test_a_fault_is_found_with_its_file_line_and_element(fault: Fault, tmp_path: Path) -> None:
    path = write_package(tmp_path / "bad.ssp", edited(*fault.edits))

    findings = findings_in(path)

    everything = "\n".join(map(str, findings))
    assert sum(is_meant(one, fault, path) for one in findings) == 1, everything
    assert len(findings) == fault.count, everything


@pytest.mark.parametrize("name", ["bad", "bad.ssd"])
def test_a_folder_and_a_description_have_the_findings_of_the_package(name: str, tmp_path: Path) -> None:
    fault = next(fault for fault in BAD_PACKAGES if fault.name == "an SSV with a parameter without a type")
    folder = write_package(tmp_path / "bad", edited(*fault.edits))
    path = folder if name == "bad" else folder / "SystemStructure.ssd"

    findings = findings_in(path)

    assert [is_meant(one, fault, folder) for one in findings] == [True]


def test_all_faults_of_a_package_are_reported_at_once(tmp_path: Path) -> None:
    faults = [fault for fault in BAD_PACKAGES if fault.name in TOGETHER]
    path = write_package(tmp_path / "bad.ssp", edited(*itertools.chain(*(fault.edits for fault in faults))))

    findings = findings_in(path)

    assert len(faults) == len(TOGETHER)
    for fault in faults:
        found = [one for one in findings if all(word in str(one) for word in fault.words)]
        assert len(found) == 1, fault.name
    places = [(one.file, one.line) for one in findings]
    assert len({file for file, _ in places}) == 3
    assert places == sorted(places, key=lambda place: ([one[0] for one in places].index(place[0]), place[1] or 0))


@pytest.mark.parametrize("name", BAD_ARCHIVES)
def test_an_archive_with_a_fault_is_refused(name: str, tmp_path: Path) -> None:
    write, words = BAD_ARCHIVES[name]
    path = tmp_path / "bad.ssp"
    write(path)

    with pytest.raises(fmu_mesh.ConfigurationError) as caught:
        fmu_mesh.load(path).check().require()

    text = "\n".join(map(str, [caught.value, *caught.value.findings]))
    assert all(word in text for word in words), text
    assert [file.name for file in tmp_path.iterdir()] == ["bad.ssp"]


def test_a_connection_of_a_clock_is_refused(tmp_path: Path) -> None:
    def with_clock(text: str) -> str:
        clock = '<Clock name="tick" valueReference="900" causality="input" intervalVariability="constant" '
        return text.replace("</ModelVariables>", f'{clock}intervalDecimal="0.5"/></ModelVariables>')

    fmu = repacked(tmp_path / "Ticking.fmu", source=find_fmu("AllTypes3", tmp_path), description=with_clock)
    ticking = [component(name, "Ticking", connector("tick", "input", "Clock")) for name in ("one", "two")]
    root = system("root", *ticking, connections=[connection("one.tick", "two.tick")])
    files: Files = {"SystemStructure.ssd": description(root, version="2.0"), "resources/Ticking.fmu": fmu.read_bytes()}
    mesh = fmu_mesh.load(write_package(tmp_path / "bad.ssp", files))

    check = mesh.check(step_size=0.5, algorithm="jacobi")

    assert [finding.found for finding in check.findings] == ["the clock 'tick' of 'one'", "the clock 'tick' of 'two'"]
    assert {finding.expected for finding in check.findings} == {"no connection: a clock of an FMU ticks by itself"}
    assert not [warning for warning in check.warnings if "tick" in str(warning)]


def test_few_files_that_refer_to_one_another_do_not_become_many_systems(tmp_path: Path) -> None:
    system = "application/x-ssp-definition"
    files = {
        f"{number}.ssd": str(GOOD["SystemStructure.ssd"]).replace(
            "</ssd:Component>\n    </ssd:Elements>",
            f"""</ssd:Component>
                <ssd:Component name="one" type="{system}" source="{number + 1}.ssd"/>
                <ssd:Component name="two" type="{system}" source="{number + 1}.ssd"/>
                </ssd:Elements>""",
        )
        for number in range(30)
    }
    path = write_package(
        tmp_path / "bad.ssp", {**GOOD, **files, "SystemStructure.ssd": files["0.ssd"], "30.ssd": files["29.ssd"]}
    )

    findings = findings_in(path)

    assert any("more than 1000 components that are systems" in str(finding) for finding in findings)
