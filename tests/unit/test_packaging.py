"""What is built and released: the version and its changelog, the files of the wheel, the extras and their sizes.

`test_house.py` looks at which folders are in the distributions; `.ci/run` installs them, and tries them.
"""

from __future__ import annotations

import re
import tomllib
import zipfile
from pathlib import Path

import pytest
from hatchling.builders.wheel import WheelBuilder

import fmu_mesh

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
FOR_DEVELOPERS = {"check", "dev", "docs", "library", "package", "test", "test-ros"}


def text(path: str) -> str:
    return (ROOT / path).read_text(encoding="utf-8")


def test_the_newest_version_of_the_changelog_is_that_of_the_package() -> None:
    sections = re.findall(r"^## \[(.+?)\]", text("CHANGELOG.md"), re.MULTILINE)
    versions = [tuple(map(int, section.split("."))) for section in sections[1:]]

    assert sections[:2] == ["Unreleased", fmu_mesh.__version__]
    assert versions == sorted(versions, reverse=True)


def test_the_wheel_has_the_header_files_that_source_fmus_are_compiled_with(tmp_path: Path) -> None:
    wheel = next(WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"]))
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    package = ROOT / "fmu_mesh"

    ours = {path for path in package.rglob("*") if path.is_file() and path.suffix not in {".pyc", ".so"}}
    assert {path.suffix for path in ours} >= {".h", ".py", ".typed"}
    assert {path.relative_to(ROOT).as_posix() for path in ours} == {
        name for name in names if name.startswith("fmu_mesh/") and not name.endswith(".so")
    }


def test_the_page_on_installation_has_every_optional_feature() -> None:
    rows = re.findall(r"^\| `([\w-]+)` \|.*\| (\d+) MB more \|$", text("docs/installation.md"), re.MULTILINE)

    assert {name for name, _ in rows} == EXTRAS.keys() - FOR_DEVELOPERS


def test_nobody_is_told_to_install_what_is_on_no_index() -> None:
    """Whoever takes our name on an index would run code at those who follow the advice."""
    files = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
    files += [file for folder in ("docs", "examples", "configs") for file in (ROOT / folder).rglob("*.*")]
    files += (ROOT / "fmu_mesh").rglob("*.py")
    advice = re.compile(r"install [^`\n]*['\" ]fmu[-_]mesh\b(?!/)|fmu[-_]mesh\[[a-z]|fmu[-_]mesh==")

    advised = [
        f"{file.relative_to(ROOT)}: {line}"
        for file in files
        if file.suffix in {".md", ".py", ".yaml"}
        for line in file.read_text(encoding="utf-8").splitlines()
        if advice.search(line) and "uninstall" not in line
    ]

    assert advised == []


@pytest.mark.parametrize("folder", ["docs", "examples"])
def test_every_extra_that_a_page_names_exists(folder: str) -> None:
    files = [*(ROOT / folder).rglob("*.md"), *(ROOT / folder).rglob("*.py"), *ROOT.glob("*.md")]
    named = {
        extra
        for file in files
        for group in re.findall(r"(?:fmu-mesh|'\.)\[([a-z,-]+)\]", file.read_text(encoding="utf-8"))
        for extra in group.split(",")
    }

    assert named
    assert named <= EXTRAS.keys()


def test_the_versions_of_python_that_are_promised_begin_with_the_oldest_one() -> None:
    promised = [c.rpartition(" ")[2] for c in PROJECT["classifiers"] if re.search(r"Python :: 3\.\d+$", c)]

    assert PROJECT["requires-python"] == f">={promised[0]}"
    assert f"for version in {' '.join(promised[1:])} " in text(".ci/run")
