"""Bad input on the command line: exit code 2, the place, the nearest right name, and nothing is started."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from fmu_mesh.cli.main import main
from tests.helpers import FMUS

GOOD = f"""\
mesh: pair
simulation: {{start_time: 0, stop_time: 1, step_size: 0.01}}
instances:
  pendulum: {{fmu: {FMUS}/DampedPendulum.fmu, start_values: {{l: 2.0}}}}
  delay: {{fmu: {FMUS}/TransportDelay.fmu, start_values: {{d: 0.1}}}}
connections:
  - pendulum.a -> delay.x
record: {{file: pair.csv}}
"""

CYCLE = f"""\
mesh: cycle
simulation: {{stop_time: 1, step_size: 0.01}}
instances:
  first: {{fmu: {FMUS}/Gain.fmu}}
  second: {{fmu: {FMUS}/Gain.fmu}}
connections:
  - {{from: first.y, to: second.u, delay: 0}}
  - {{from: second.y, to: first.u, delay: 0}}
"""

BAD = [
    pytest.param(("step_size", "step_sise"), ["mesh.yaml:2", "step_sise", "'step_size'"], id="an unknown key"),
    pytest.param(("mesh: pair", "mesh: pair\nmesh: two"), ["mesh.yaml:2", "mesh"], id="a duplicate key"),
    pytest.param(("{start_time", "{[start_time"), ["mesh.yaml:2"], id="broken YAML"),
    pytest.param(
        ("pendulum.a ->", "pendulun.a ->"), ["mesh.yaml:7", "connections[0].from", "'pendulum"], id="an instance"
    ),
    pytest.param(
        ("delay.x", "delay.xx"), ["mesh.yaml:7", "connections[0].to", "'xx'", "Did you mean 'x'?"], id="a variable"
    ),
    pytest.param(("l: 2.0", "ll: 2.0"), ["mesh.yaml:4", "instances.pendulum.start_values.ll"], id="a start value"),
    pytest.param(("pendulum.a -> delay.x", "delay.x -> pendulum.a"), ["connections[0]", "input"], id="causality"),
    pytest.param(
        ("- pendulum.a -> delay.x", "- pendulum.a -> delay.x\n  - pendulum.der(a) -> delay.x"),
        ["mesh.yaml:8", "connections[1]", "delay.x"],
        id="two sources for one input",
    ),
    pytest.param(("l: 2.0", "l: long"), ["mesh.yaml:4", "instances.pendulum.start_values.l", "'long'"], id="a type"),
    pytest.param(("step_size: 0.01", "step_size: 0"), ["mesh.yaml:2", "simulation.step_size"], id="step size 0"),
    pytest.param(("step_size: 0.01", "step_size: -0.01"), ["simulation.step_size", "-0.01"], id="negative"),
    pytest.param(("step_size: 0.01", "step_size: .nan"), ["simulation.step_size", "nan"], id="not a number"),
    pytest.param(("stop_time: 1,", "stop_time: 1.005,"), ["simulation.stop_time"], id="not a multiple"),
    pytest.param(("stop_time: 1,", "stop_time: -1,"), ["mesh.yaml:2", "simulation.stop_time"], id="stop before start"),
    pytest.param(("TransportDelay.fmu", "TransportDelai.fmu"), ["instances.delay.fmu", "TransportDelay"], id="no FMU"),
]


@pytest.fixture
def nothing_is_spawned(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make every attempt to start a process fail the test."""

    def fail(*_: object, **__: object) -> None:
        pytest.fail("a process was started before everything was checked")

    monkeypatch.setattr("fmu_mesh.launch.child.subprocess.Popen", fail)


@pytest.fixture(params=[("launch",), ("launch", "--local"), ("check",)], ids=["launch", "local", "check"])
def refused(
    request: pytest.FixtureRequest,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    nothing_is_spawned: None,  # noqa: ARG001 it is there for what it does
) -> Callable[[str], str]:
    """Run the command with a configuration that it must refuse; returns what it says."""
    command, *options = request.param

    def run(text: str) -> str:
        file = tmp_path / "mesh.yaml"
        file.write_text(text, encoding="utf-8")
        code = main([command, str(file), *options])
        said = capsys.readouterr()
        assert code == 2, said.err
        assert said.out == ""
        assert said.err.startswith("fmu-mesh: ")
        assert "Traceback" not in said.err
        assert not (tmp_path / "pair.csv").exists()
        return said.err

    return run


@pytest.mark.parametrize(("change", "says"), BAD)
def test_bad_input_is_told_with_its_place(
    refused: Callable[[str], str], change: tuple[str, str], says: list[str]
) -> None:
    assert change[0] in GOOD

    message = refused(GOOD.replace(*change))

    for part in says:
        assert part in message


def test_a_cycle_without_a_delay_is_told_with_the_names_on_it(refused: Callable[[str], str]) -> None:
    message = refused(CYCLE)

    assert "first" in message
    assert "second" in message
    assert "delay: 1" in message


def test_all_errors_of_a_file_are_told_at_once(refused: Callable[[str], str]) -> None:
    text = GOOD
    for old, new in [
        ("mesh: pair", "mesh: 2 pairs"),
        ("start_time: 0", "start_tine: 0"),
        ("step_size: 0.01", "step_size: -0.01"),
        ("l: 2.0", "ll: 2.0"),
        ("d: 0.1", "d: long"),
        ("- pendulum.a -> delay.x", "- pendulun.a -> delay.x\n  - pendulum.a -> delay.xx\n  - delay.x -> delay.y"),
    ]:
        text = text.replace(old, new)

    message = refused(text)

    assert message.splitlines()[0].endswith(": 8 problems")
    findings = [line for line in message.splitlines() if line.startswith("  - ")]
    assert len(findings) == 8
    for place in ("mesh.yaml:1: mesh", "start_tine", "simulation.step_size", "start_values.ll", "start_values.d"):
        assert place in message
    for number in range(3):
        assert f"connections[{number}]" in message


def no_archive(path: Path) -> None:
    path.write_bytes(b"an FMU is a ZIP archive")


def no_description(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "there is no modelDescription.xml")


def no_binary(path: Path) -> None:
    with zipfile.ZipFile(FMUS / "Gain.fmu") as kept, zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", kept.read("modelDescription.xml"))
        archive.writestr("binaries/win32/Gain.dll", b"")


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (no_archive, "is no ZIP archive, so it is no FMU"),
        (no_description, "has no modelDescription.xml"),
        (no_binary, "has no binary for this platform"),
    ],
)
def test_a_file_that_is_no_fmu_for_this_platform_is_told_with_the_reason(
    refused: Callable[[str], str], tmp_path: Path, make: Callable[[Path], None], says: str
) -> None:
    make(tmp_path / "broken.fmu")

    message = refused(GOOD.replace(f"{FMUS}/DampedPendulum.fmu", "broken.fmu"))

    assert "mesh.yaml:4: instances.pendulum.fmu" in message
    assert says in message


@pytest.mark.parametrize("command", ["launch", "check"])
def test_a_missing_file_is_told_with_the_nearest_that_there_is(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "pendulum.yaml").write_text(GOOD, encoding="utf-8")

    assert main([command, str(tmp_path / "pendulun.yaml")]) == 2

    message = capsys.readouterr().err
    assert "pendulun.yaml: no such file" in message
    assert f"Did you mean '{tmp_path / 'pendulum.yaml'}'?" in message


@pytest.mark.parametrize(
    ("option", "says"),
    [
        ("--set=pendulun.l=2", "Did you mean 'pendulum'?"),
        ("--set=pendulum.ll=2", "--set pendulum.ll=2"),
        ("--set=pendulum.l", "instance.variable=value"),
        ("--window=0", "--window 0"),
    ],
)
def test_a_wrong_option_is_told_as_it_was_written(
    option: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mesh.yaml"
    file.write_text(GOOD, encoding="utf-8")

    assert main(["launch", str(file), option]) == 2

    assert says in capsys.readouterr().err


def test_the_command_itself_ends_with_exit_code_2_and_no_traceback(tmp_path: Path) -> None:
    file = tmp_path / "mesh.yaml"
    file.write_text(GOOD.replace("step_size", "step_sise"), encoding="utf-8")

    ended = subprocess.run(
        [sys.executable, "-m", "fmu_mesh", "launch", str(file)], capture_output=True, text=True, check=False, timeout=50
    )

    assert ended.returncode == 2
    assert ended.stdout == ""
    assert "Did you mean 'step_size'?" in ended.stderr
    assert "Traceback" not in ended.stderr
