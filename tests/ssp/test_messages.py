"""What a user reads about a package: one message for each mistake, in words of SSP, none that follows from others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import fmu_mesh
from fmu_mesh.cli.main import main
from tests.ssp.packages import (
    Files,
    bound,
    component,
    connection,
    connector,
    description,
    element,
    fmus,
    mapped,
    mapping_file,
    parameter,
    parameter_file,
    system,
    write_package,
)

SSD = "SystemStructure.ssd"
OPTIONS: dict[str, Any] = {"algorithm": "jacobi", "step_size": 0.125}


def check(folder: Path, root: str, **files: str) -> fmu_mesh.Check:
    """What `check` says about a package with a pendulum and gains."""
    package = {SSD: description(root), **fmus("DampedPendulum", "Gain"), **files}
    return fmu_mesh.load(write_package(folder / "own.ssp", package)).check(**OPTIONS)


def test_a_system_without_components_has_nothing_to_run(tmp_path: Path) -> None:
    found = check(tmp_path, system("root", system("inner", connectors=[connector("u", "input")]))).findings

    assert [(one.path, one.found) for one in found] == [
        ("System 'root'", "no component in it, nor in a system inside it: there is nothing to run")
    ]


def test_a_system_whose_only_component_cannot_be_read_has_one_finding(tmp_path: Path) -> None:
    found = check(tmp_path, system("root", component("motor", "resources/Motor.fmu"))).findings

    assert [(one.path, one.found) for one in found] == [
        ("Component 'motor' of System 'root'", "no such file 'resources/Motor.fmu' in the package")
    ]


def test_an_unknown_attribute_means_the_only_one_that_is_missing(tmp_path: Path) -> None:
    names = mapping_file(mapped("length", "pendulum.l").replace("target=", "destination="))
    root = system("root", component("pendulum", "DampedPendulum"), bindings=[bound("values.ssv", "names.ssm")])
    values = parameter_file(parameter("length", 1.5))

    (found,) = check(tmp_path, root, **{"values.ssv": values, "names.ssm": names}).findings

    assert (found.path, found.found, found.suggestion) == (
        "MappingEntry 'length'",
        "the attribute 'destination'",
        "target",
    )


def test_values_that_are_not_converted_for_one_reason_are_one_warning(tmp_path: Path) -> None:
    values = parameter_file(*(parameter(f"{name}.l", 1.0, unit="[m]") for name in ("one", "two", "three")))
    pendulums = (component(name, "DampedPendulum") for name in ("one", "two", "three"))

    warnings = check(
        tmp_path, system("root", *pendulums, bindings=[bound("values.ssv")]), **{"values.ssv": values}
    ).warnings

    assert len(warnings) == 2
    assert "the unit '[m]', which the file does not define" in warnings[0]
    assert "a value in '[m]' for the Real 'l' of 'one' in 'm' is not converted" in warnings[1]
    assert warnings[1].endswith("; 2 more values likewise")


def test_connections_that_are_not_converted_for_one_reason_are_one_warning(tmp_path: Path) -> None:
    own = connector("u", "input", unit="angle")
    gains = (component(name, "Gain", own) for name in ("one", "two"))
    connections = [connection("pendulum.a", f"{name}.u") for name in ("one", "two")]
    source = component("pendulum", "DampedPendulum", connector("a", "output"))

    warnings = check(tmp_path, system("root", source, *gains, connections=connections)).warnings

    assert len(warnings) == 2
    assert "'pendulum.a' in 'rad' goes to 'one.u' in 'angle' unconverted" in warnings[1]
    assert warnings[1].endswith("; one more connection likewise")


def test_components_that_have_the_same_connectors_too_many_are_one_warning(tmp_path: Path) -> None:
    gains = (component(name, "Gain", connector("stopTime", "parameter")) for name in ("one", "two", "three"))

    (warning,) = check(tmp_path, system("root", *gains)).warnings

    assert "Component 'one' of System 'root': connectors for variables that resources/Gain.fmu does not have" in warning
    assert warning.endswith(": stopTime; 2 more components likewise")


def test_annotations_of_one_unknown_type_are_one_warning(tmp_path: Path) -> None:
    unknown = element("ssc:Annotation", element("x", xmlns="http://example.com"), type="com.example.tool")
    gains = (component(name, "Gain", annotations=[unknown]) for name in ("one", "two"))

    (warning,) = check(tmp_path, system("root", *gains, annotations=[unknown])).warnings

    assert "Annotation 'com.example.tool' of System 'root'" in warning
    assert warning.endswith(": its type is not known: it has no effect; 2 more annotations likewise")


@pytest.mark.parametrize(
    ("options", "command"),
    [
        ((), "copy.ssp"),
        (("--ssd", "variant"), "copy.ssp --ssd 'Variant B.ssd'"),
        (("--ssd", "variant", "--version", "2.0"), "copy.ssp"),
    ],
)
def test_the_command_that_runs_a_converted_package_chooses_its_description(
    options: tuple[str, ...],
    command: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    root = system("root", component("gain", "Gain"))
    variant = description(root, name="variant")
    package: dict[str, str | bytes] = {SSD: description(root), "Variant B.ssd": variant, **fmus("Gain")}
    write_package(Path("own.ssp"), package)
    needed = ("--step-size", "0.125", "--algorithm", "jacobi")

    assert main(["convert", "own.ssp", "copy.ssp", *needed, *options]) == 0

    assert capsys.readouterr().out == f"copy.ssp: run it with `fmu-mesh launch {command}`\n"


@pytest.mark.parametrize("hint", ["1e300", "1.7e308"])
def test_step_size_that_no_run_can_reach_is_told_and_ends_nothing(hint: str, tmp_path: Path) -> None:
    def annotation(inside: str) -> str:
        return element("ssc:Annotation", inside, type="com.opensimulationplatform")

    slow = component("pendulum", "DampedPendulum", annotations=[annotation(f'<StepSizeHint value="{hint}"/>')])
    root = system("root", slow, annotations=[annotation('<FixedStepAlgorithm baseStepSize="0.125"/>')])
    package: Files = {SSD: description(root), **fmus("DampedPendulum")}

    warnings = fmu_mesh.load(write_package(tmp_path / "own.ssp", package)).check().warnings

    assert any(f"the step size {float(hint):g} s, for which" in str(warning) for warning in warnings)
