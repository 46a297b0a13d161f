"""Any change of the XML of a package gives findings, each with its file and line, or a mesh that is exported alike."""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st
from lxml import etree

import fmu_mesh
from fmu_mesh.api.converting import convert
from fmu_mesh.api.mesh_check import Check
from tests.helpers import examples
from tests.ssp.bad_packages import GOOD
from tests.ssp.packages import Files, write_package
from tests.ssp.ship import SHIP

PACKAGES: Final[dict[str, Files]] = {"good": GOOD, "ship": SHIP}
TIMES: Final[dict[str, Any]] = {"step_size": 0.125, "stop_time": 1.0, "algorithm": "gauss_seidel"}
VALUES: Final = [
    *("", " ", "0", "-1", "2.5", "1e400", "NaN", "INF", "99999999999999999999", "\u0663", "1_0", "1 2", "true", "2.0"),
    *("x", "u", "y", "k", "a.b", "\u00e4\u2028", "input", "output", "parameter", "Real", "ScheduledExecution"),
    *("..", "../x", "/", "#", "#x", "%2e%2e/x", "%00", "%zz", "a\\b", "http://x/y", "file:///etc/hostname"),
    *("resources/Gain.fmu", "SystemStructure.ssd", "resources/values.ssv", "component"),
    *("application/x-ssp-definition", "application/x-ssp-package"),
]
BYTES: Final = [
    b"<",
    b">",
    b"&",
    b'"',
    b"<!--",
    b"]]>",
    b"&#0;",
    b"\0",
    b"<?xml?>",
    b"<!DOCTYPE x>",
    b"\xff",
    b"\xc3\xa9",
]

Choose = Callable[[int], int]
"""An index below a number."""


def remove(elements: list[Any], choose: Choose) -> None:
    one = elements[choose(len(elements))]
    if one.getparent() is not None:
        one.getparent().remove(one)


def duplicate(elements: list[Any], choose: Choose) -> None:
    one = elements[choose(len(elements))]
    if one.getparent() is not None:
        one.addnext(copy.deepcopy(one))


def rename(elements: list[Any], choose: Choose) -> None:
    elements[choose(len(elements))].tag = elements[choose(len(elements))].tag


def move(elements: list[Any], choose: Choose) -> None:
    one, other = (elements[choose(len(elements))] for _ in range(2))
    if one.getparent() is not None and one not in [other, *other.iterancestors()]:
        other.insert(choose(len(other) + 1), one)


def remove_attribute(elements: list[Any], choose: Choose) -> None:
    attributes = elements[choose(len(elements))].attrib
    if attributes:
        del attributes[[*attributes][choose(len(attributes))]]


def change_attribute(elements: list[Any], choose: Choose) -> None:
    attributes = elements[choose(len(elements))].attrib
    if attributes:
        attributes[[*attributes][choose(len(attributes))]] = VALUES[choose(len(VALUES))]


def copy_attribute(elements: list[Any], choose: Choose) -> None:
    """Give one attribute the value of another one, or another element the same attribute."""
    one, other = (elements[choose(len(elements))] for _ in range(2))
    if one.attrib and other.attrib:
        name, own = ([*element.attrib][choose(len(element.attrib))] for element in (one, other))
        other.attrib[[own, name][choose(2)]] = one.attrib[name]


def insert(elements: list[Any], choose: Choose) -> None:
    new = [etree.Comment("x"), etree.ProcessingInstruction("p", "x"), etree.Element("{urn:x}b"), etree.Element("b")]
    elements[choose(len(elements))].insert(0, new[choose(len(new))])


def write_text(elements: list[Any], choose: Choose) -> None:
    elements[choose(len(elements))].text = ["text", " ", "<"][choose(3)]


CHANGES: Final = [
    *(remove, duplicate, rename, move, remove_attribute, change_attribute, change_attribute, copy_attribute),
    *(insert, write_text),
]


@st.composite
def changed_files(draw: st.DrawFn) -> Files:
    """A package with one document that is not what it was."""
    files = PACKAGES[draw(st.sampled_from([*PACKAGES]))]
    name = draw(st.sampled_from([name for name in files if not name.endswith(".fmu")]))
    content = files[name]
    assert isinstance(content, str)

    def choose(count: int) -> int:
        return draw(st.integers(0, count - 1))

    if draw(st.integers(0, 4)) == 0:
        data = content.encode()
        start = choose(len(data))
        length = draw(st.sampled_from([0, 1, 20, len(data)]))
        return {**files, name: data[:start] + draw(st.sampled_from([b"", *BYTES])) + data[start + length :]}
    root = etree.fromstring(content.encode())
    for _ in range(draw(st.sampled_from([1, 1, 1, 2, 3]))):
        draw(st.sampled_from(CHANGES))([one for one in root.iter() if isinstance(one.tag, str)], choose)
    return {**files, name: etree.tostring(root)}


def summary(check: Check) -> tuple[Any, ...]:
    """What would run, without the files that it comes from."""
    plan = check.plan
    assert plan is not None
    instances = [(one.name, one.step_size, sorted(map(repr, one.start_values.items()))) for one in plan.instances]
    return instances, [str(one) for one in plan.connections], plan.order, plan.levels, plan.recorded


def checked(path: Path) -> Check | fmu_mesh.ConfigurationError:
    """The check of a package, or the error where nothing of it can be read."""
    try:
        return fmu_mesh.load(path).check(**TIMES)
    except fmu_mesh.ConfigurationError as error:
        return error


@pytest.mark.parametrize("name", PACKAGES)
def test_the_packages_run_as_they_are(name: str, tmp_path: Path) -> None:
    assert fmu_mesh.load(write_package(tmp_path / "good.ssp", PACKAGES[name])).check()


@settings(max_examples=examples(50), suppress_health_check=[HealthCheck.too_slow])
@given(changed_files())
def test_changed_package_has_findings_with_file_and_line_or_is_exported_alike(files: Files) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = write_package(Path(folder, "changed.ssp"), files)
        check = checked(path)
        event("refused" if check.findings else "right")
        findings = check.findings

        assert findings or isinstance(check, Check)
        for finding in findings:
            assert finding.file.startswith(str(path)), finding
            assert finding.line is not None or finding.path.startswith("simulation."), finding  # an option's value
            assert "\n" not in str(finding)
        if isinstance(check, Check) and check:
            assert not fmu_mesh.inspect_package(path).problems
            for target in (Path(folder, "made.yaml"), Path(folder, "made.ssp")):
                convert(path, target, simulation=TIMES)
                assert summary(fmu_mesh.load(target).check(**TIMES)) == summary(check)
