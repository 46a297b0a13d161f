"""The generated pages of the reference: as committed, complete, and with examples that are right."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

from fmu_mesh.cli.main import COMMANDS
from fmu_mesh.config.call_options import CallOptions, option_fields
from fmu_mesh.config.findings import Findings
from fmu_mesh.config.structure import check
from fmu_mesh.run.options import ConvergenceOptions, RunOptions, SimulateOptions
from fmu_mesh.sweeps.planned_sweep import SweepOptions

ROOT = Path(__file__).resolve().parents[2]
SHORT_FORMS = {"connections"}
"""Keys whose example is a short form, which is expanded before the types are checked."""


@pytest.fixture(scope="module")
def pages() -> ModuleType:
    specification = importlib.util.spec_from_file_location("reference_pages", ROOT / "docs" / "reference_pages.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[specification.name] = module
    specification.loader.exec_module(module)
    return module


def test_the_kept_pages_are_what_the_code_makes(pages: ModuleType) -> None:
    for name, text in pages.reference_pages().items():
        assert (pages.REFERENCE / name).read_text(encoding="utf-8") == text, "run `python docs/reference_pages.py`"


def test_every_key_says_since_when_it_is_there(pages: ModuleType) -> None:
    versions = {*re.findall(r"^## \[(\d+\.\d+)\.\d+\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE), "next"}

    keys = [(section.title, key) for section in pages.sections() for key in section.keys]

    assert len(keys) > 100
    assert [f"{title}: {key.name}" for title, key in keys if key.since not in versions] == [], "see keys.yaml"


def test_every_key_has_a_description_and_a_right_example(pages: ModuleType) -> None:
    findings = Findings("keys.yaml")

    for section in pages.sections():
        for key in section.keys:
            assert key.text, f"{section.title}: {key.name}"
            if key.example is not None and key.name not in SHORT_FORMS:
                check(key.example, key.type, f"{section.title}.{key.name}", findings)

    assert [*map(str, findings)] == []


def test_every_key_without_an_example_is_a_section(pages: ModuleType) -> None:
    without = {key.name for section in pages.sections() for key in section.keys if key.example is None}

    assert without == {
        *(
            "simulation",
            "instances",
            "initialization",
            "record",
            "zenoh",
            "timeouts",
            "limits",
            "process",
            "ros",
            "solver",
            "security",
            "recovery",
            "runtime",
            "deploy",
        )
    }


def test_nothing_is_said_of_keys_that_are_gone(pages: ModuleType) -> None:
    there = {
        (c.__name__, key.name) for section in pages.sections() for c in section.cls.__mro__ for key in section.keys
    }
    said = {(name, key) for name, keys in pages.known()["keys"].items() for key in keys}

    assert said - there == set()


def test_every_section_has_a_heading_of_its_own(pages: ModuleType) -> None:
    titles = [section.title for section in pages.sections()]

    assert len({*titles}) == len(titles)


def test_every_option_says_since_when_it_is_there(pages: ModuleType) -> None:
    options = [(command, option) for command in COMMANDS for option in pages.command_options(command)]

    assert len(options) > 200
    assert [" ".join(pair) for pair in options if not pages.since(*pair)] == [], "see keys.yaml"


@pytest.mark.parametrize("options", [RunOptions, SimulateOptions, SweepOptions, ConvergenceOptions])
def test_every_option_in_python_has_an_example_that_is_taken(pages: ModuleType, options: type[CallOptions]) -> None:
    fields = option_fields(options)
    said = {name: pages.said(options, name) for name in fields}

    assert pages.known()["calls"][options.__name__].keys() <= fields.keys()
    assert [name for name in fields if "since" not in said[name]] == [], "see keys.yaml"
    without = {name for name in fields if "example" not in said[name]}
    assert without <= {"on_progress", "on_event", "on_notice", "executor"}  # objects of a program
    for name in fields.keys() - without:
        options(**{name: said[name]["example"]})


def test_nothing_is_said_of_options_that_are_gone(pages: ModuleType) -> None:
    said = {
        (command, option)
        for commands in pages.known()["options"].values()
        for command, options in commands.items()
        for option in options
    }

    gone = [pair for pair in sorted(said) if pair[1] not in pages.command_options(pair[0])]

    assert gone == []
