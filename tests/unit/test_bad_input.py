"""Bad input on the command line: exit code 2, the place, the nearest right name, and nothing is started."""

from __future__ import annotations

import socket
import subprocess
import sys
import zipfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import fmu_mesh
from fmu_mesh import text
from fmu_mesh.cli.main import main
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.results.csv_file import CsvFile
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
    pytest.param(
        ("pendulum.a -> delay.x", "pendulum.a -> delay.y"),
        ["connections[0].to", "'delay.y' is an output", "expected an input of 'delay': x"],
        id="output to output",
    ),
    pytest.param(
        ("pendulum.a -> delay.x", "pendulum.a -> delay.d"),
        ["'delay.d' is a parameter", "expected an input of 'delay': x; a parameter gets its value once"],
        id="output to parameter",
    ),
    pytest.param(
        ("pendulum.a -> delay.x", "pendulum.a -> delay"), ["'delay'", "expected delay.x"], id="no variable named"
    ),
    pytest.param(("  delay: {", "\tdelay: {"), ["mesh.yaml:5", "a tab", "YAML takes no tabs"], id="a tab"),
    pytest.param(("  delay: {", "   delay: {"), ["mesh.yaml:5", "in another column"], id="a line too far right"),
    pytest.param(("  delay: {", "  - delay: {"), ["mesh.yaml:5", "an item of a list"], id="a list among keys"),
    pytest.param(
        ("record:", "zenoh: {listen: [tcp/127.0.0.1]}\nrecord:"),
        ["zenoh.listen[0]", "a Zenoh endpoint such as tcp/192.168.1.2:7447"],
        id="an endpoint without a port",
    ),
    pytest.param(("TransportDelay.fmu", "TransportDelai.fmu"), ["instances.delay.fmu", "TransportDelay"], id="no FMU"),
]


@pytest.fixture
def nothing_is_spawned(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make every attempt to start a process fail the test."""

    def fail(*_: object, **__: object) -> None:
        pytest.fail("a process was started before everything was checked")

    monkeypatch.setattr("subprocess.Popen", fail)


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


MANY = f"""\
mesh: many
simulation: {{stop_time: 1, step_size: 0.01, windw: 3}}
instances:
  gain: {{fmu: {FMUS}/Gain.fmu, start_values: {{kk: 2}}}}
  delay: {{fmu: {FMUS}/TransportDelay.fmu}}
  two words: {{fmu: {FMUS}/Gain.fmu}}
  lost: {{fmu: lost.fmu}}
  seven: 7
connections:
  - {{from: gain.yy, to: delay.x}}
  - {{from: gain.y, too: delay.x}}
  - {{from: 7, to: gain.uu}}
  - lost.y -> gain.u
  - {{from: gain.y, to: gain.u, delay: 0}}
  - seven.y -> delay.xx
record:
  file: mesh.yaml/many.csv
  variables:
    - 7
    - gain.q
    - gain.z*
    - re:(
scenario:
  values:
    gain.q: 1
    gain.k: {{times: [0, later], values: [1, 2]}}
    delay.x: 1
  events:
    - {{at: later, set: {{gain.q: 1}}}}
    - 7
    - {{at: 1, set: {{gain.k: fast}}}}
ros:
  topics:
    - 7
    - gain.q
    - {{topic: /y, variables: gain.y}}
    - {{topic: /1 a, variable: gain.y}}
  clock_rate: -1
zenoh: {{config: lost.json5}}
"""
"""Mistakes of all phases; none is a consequence of another one."""

MANY_PLACES = """
2 simulation.windw
4 instances.gain.start_values.kk
6 instances.two words
7 instances.lost.fmu
8 instances.seven
10 connections[0].from
11 connections[1].too
12 connections[2].from
12 connections[2].to
14 connections[4]
14 connections[4].delay
15 connections[5].to
17 record.file
19 record.variables[0]
20 record.variables[1]
21 record.variables[2]
22 record.variables[3]
25 scenario.values.gain.q
26 scenario.values.gain.k.times[1]
27 scenario.values.delay.x
29 scenario.events[0].at
29 scenario.events[0].set.gain.q
30 scenario.events[1]
31 scenario.events[2].set.gain.k
34 ros.topics[0]
35 ros.topics[1]
36 ros.topics[2].variables
37 ros.topics[3].topic
38 ros.clock_rate
39 zenoh.config
"""


def test_no_mistake_of_any_phase_hides_another_one(tmp_path: Path) -> None:
    path = tmp_path / "mesh.yaml"
    path.write_text(MANY)

    findings = fmu_mesh.load(path).check().findings

    assert [f"{one.line} {one.path}" for one in sorted(findings, key=lambda one: (one.line, one.path))] == (
        MANY_PLACES.split("\n")[1:-1]
    )


def test_mistakes_in_a_scenario_of_its_own_are_told_together(tmp_path: Path) -> None:
    lines = MANY.splitlines()
    (tmp_path / "drive.yaml").write_text("\n".join(line[2:] for line in lines[lines.index("scenario:") + 1 :][:8]))
    (tmp_path / "mesh.yaml").write_text(f"{GOOD}scenario: drive.yaml\n".replace("pendulum", "gain"))

    findings = fmu_mesh.load(tmp_path / "mesh.yaml").check().findings

    own = [f"{one.line} {one.path}" for one in findings if Path(one.file).name == "drive.yaml"]
    places = [line.removeprefix("scenario.") for line in MANY_PLACES.split() if line.startswith("scenario.")]
    assert sorted(line.split()[1] for line in own) == sorted(places)


@pytest.mark.parametrize("wrong_too", [False, True])
def test_missing_packages_and_files_in_the_way_hide_no_plan(
    *, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wrong_too: bool
) -> None:
    for package in ("pyarrow", "rosbags", "rosbags.typesys"):
        monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / "out.csv").mkdir()
    text = GOOD.replace("record: {file: pair.csv}", "record: [{file: out.csv}, {file: pair.parquet}]")
    topics = "[nobody.y, delay.q]" if wrong_too else "[delay.y]"
    (tmp_path / "mesh.yaml").write_text(f"{text}ros: {{topics: {topics}}}\n" if wrong_too else text)

    check = fmu_mesh.load(tmp_path / "mesh.yaml").check()

    places = [finding.path for finding in check.findings]
    ros = ["ros", "ros.topics[0]", "ros.topics[1]"] if wrong_too else []
    assert (sorted(places), bool(check), check.plan is None) == (
        sorted(["record[0].file", "record[1].file", *ros]),
        False,
        wrong_too,
    )


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
def test_file_that_is_no_fmu_for_this_platform_is_told_with_reason(
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
    ("typed", "meant"),
    [
        ("pendulum.yml", "pendulum.yaml"),
        ("Gain.fmy", "gain.fmu"),
        ("gain", "gain.fmu"),
        ("pendulum_dely.yaml", "pendulum_delay.yaml"),
        ("other.yaml", None),
        ("lost.fmu", None),
    ],
)
def test_the_nearest_file_is_found_whatever_its_ending(typed: str, meant: str | None, tmp_path: Path) -> None:
    for name in (
        "pendulum.yaml",
        "pendulums.yml",
        "pendulum.csv",
        "pendulum_delay.yaml",
        "pendulum_delay.csv",
        "gain.fmu",
    ):
        (tmp_path / name).touch()

    assert text.nearest_file(tmp_path / typed) == (str(tmp_path / meant) if meant is not None else None)


@pytest.mark.parametrize(
    ("option", "says"),
    [
        ("--set=pendulun.l=2", "Did you mean 'pendulum'?"),
        ("--set=pendulum.ll=2", "--set pendulum.ll=2"),
        ("--set=pendulum.l", "expected INSTANCE.VARIABLE=VALUE"),
    ],
)
def test_a_wrong_option_is_told_as_it_was_written(
    option: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mesh.yaml"
    file.write_text(GOOD, encoding="utf-8")

    assert main(["launch", str(file), option]) == 2

    assert says in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["lunch", "mesh.yaml"], "there is no command 'lunch'. Did you mean 'launch'?"),
        (["mesh.yaml"], "Did you mean `fmu-mesh launch mesh.yaml`?"),
        (["Gain.fmu"], "Did you mean `fmu-mesh simulate Gain.fmu`?"),
        (
            ["launch", "Gain.fmu"],
            "expected a configuration file; `fmu-mesh simulate Gain.fmu` (`fmu_mesh.simulate`) simulates one FMU",
        ),
        (["run", "mesh.yaml"], "A configuration is run by `fmu-mesh launch mesh.yaml`."),
        (["inspect", "mesh.yaml"], "A configuration is run by `fmu-mesh launch mesh.yaml`."),
        (["run", "Gian.fmu"], "'Gian.fmu' does not exist. Did you mean 'Gain.fmu'?"),
        (["run", "Gain.fmu", "--name", "my gain"], "'my gain' is not a name"),
        (["run", "Gain.fmu", "--set", "kk=2"], "--set kk=2: the unknown variable 'kk'"),
        (["lanch", "mesh.yaml"], "there is no command 'lanch'. Did you mean 'launch'?"),
        (
            ["launch", "mesh.yaml", "--plto", "x.png"],
            "`fmu-mesh launch` has no option '--plto'. Did you mean '--plot'?",
        ),
        (["launch", "mesh.yaml", "--windw=3"], "`fmu-mesh launch` has no option '--windw'. Did you mean '--window'?"),
        (
            ["check", "mesh.yaml", "--plot", "x.png"],
            "`fmu-mesh check` has no option '--plot'. It is an option of `launch`",
        ),
        (["--plot", "launch", "mesh.yaml"], "It comes after the command: `fmu-mesh launch --plot`."),
        (["launch", "mesh.yaml", "more.yaml"], "`fmu-mesh launch` takes no 'more.yaml'. `fmu-mesh launch --help`"),
        (["set", "Gain.u", "-1e-3"], "no mesh is running here"),
        (["set", "Gain.u", "-inf"], "no mesh is running here"),
        (["--versoin"], "`fmu-mesh` has no option '--versoin'. Did you mean '--version'?"),
        (["launch", "mesh.yaml", "--output", "folder"], "mesh.yaml: --output folder: the folder '"),
        (["check", "nothing.yaml"], "fmu-mesh: nothing.yaml: no such file\n"),
        (["launch", "mesh.yaml", "--plot", "plot.xyz"], "a plot cannot be written as 'plot.xyz'"),
        (["launch", "mesh.yaml", "--real-time-factor", "-1"], "--real-time-factor -1"),
        (["plot", "mesh.csv"], "the result file 'mesh.csv' cannot be read"),
        (["play", "mesh.yam"], "the bag 'mesh.yam' does not exist. Did you mean 'mesh.yaml'?"),
        (["play", "."], "it has no metadata.yaml"),
    ],
)
def test_the_wrong_thing_for_a_command_is_told_with_the_right_one(
    arguments: list[str],
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    nothing_is_spawned: None,  # noqa: ARG001 it is there for what it does
) -> None:
    (tmp_path / "mesh.yaml").write_text(GOOD, encoding="utf-8")
    (tmp_path / "Gain.fmu").symlink_to(FMUS / "Gain.fmu")
    (tmp_path / "folder").mkdir(mode=0o700)
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(tmp_path / "folder"))
    monkeypatch.chdir(tmp_path)

    assert main(arguments) == 2

    said = capsys.readouterr()
    assert says in said.err
    assert said.out == ""


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["get", "--connect", "localhost", "pendulum.a"], "'localhost' is no Zenoh endpoint such as tcp/"),
        (["launch", "mesh.yaml", "--connect", "tcp/localhost"], "'tcp/localhost' is no Zenoh endpoint such as tcp/"),
        (["launch", "mesh.yaml", "--window", "0"], "'0' is no window: auto, or from 1 to 1000000 points"),
        (["check", "mesh.yaml", "--window", "9999999"], "'9999999' is no window: auto, or from 1 to 1000000 points"),
        (["step", "pair", "some"], "'some' is not a whole number of 1 or more"),
        (["top", "--interval", "often"], "'often' is no number"),
        (["run", "Gain.fmu", "--step-size", "small"], "fmu-mesh: --step-size: 'small' is no number\n"),
        (["launch", "mesh.yaml", "--window"], "fmu-mesh: --window needs a value, as in `--window N`\n"),
        (["set", "Gain.k"], "fmu-mesh: `fmu-mesh set` needs VALUE. `fmu-mesh set --help` tells more.\n"),
        (["set"], "fmu-mesh: `fmu-mesh set` needs KEY and VALUE. "),
        (["inspect"], "fmu-mesh: `fmu-mesh inspect` needs MODEL.fmu|PACKAGE. "),
    ],
)
def test_a_wrong_value_of_an_option_is_told_in_words(
    arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2

    message = capsys.readouterr().err
    assert says in message
    assert "usage:" not in message


def test_a_path_from_working_folder_is_told_to_be_relative_to_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "configs").mkdir()
    (tmp_path / "Gain.fmu").symlink_to(FMUS / "Gain.fmu")
    text = "mesh: one\nsimulation: {stop_time: 1, step_size: 0.1}\ninstances: {gain: {fmu: Gain.fmu}}\n"
    (tmp_path / "configs/mesh.yaml").write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)

    assert main(["check", "configs/mesh.yaml"]) == 2

    assert "paths are relative to the configuration file" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["launch", "run"])
def test_a_port_in_use_is_told_and_is_no_loss_of_master(
    command: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mesh.yaml"
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        file.write_text(GOOD + f"zenoh: {{listen: [{endpoint}]}}\n", encoding="utf-8")
        what = [str(file)] if command == "launch" else [str(FMUS / "Gain.fmu"), "--listen", endpoint]

        code = main([command, *what])

    assert code == 2
    said = capfd.readouterr().err
    assert f"nothing can listen at {endpoint}: another process does. End that process, or take another port" in said


def test_two_runs_do_not_write_into_one_result_file(tmp_path: Path) -> None:
    kept = b"time,gain.y\n0.0,1.0\n"
    file = tmp_path / "result.csv"
    with closing(CsvFile(file, [("gain.y", "Float64")])) as first:
        first.flush()

        with pytest.raises(ConfigurationError, match="another run is writing the result file"):
            CsvFile(file, [("gain.y", "Float64")])

        first.write(np.array([0.0]), [np.array([1.0])])
    assert file.read_bytes() == kept
    with closing(CsvFile(file, [("gain.y", "Float64")])) as second:
        second.write(np.array([0.5]), [np.array([2.0])])
    assert file.read_bytes() == b"time,gain.y\n0.5,2.0\n"


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


def test_a_level_of_logging_that_there_is_not_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FMU_MESH_LOG", "loud")

    assert main(["schema"]) == 2
    assert capsys.readouterr().err == (
        "fmu-mesh: FMU_MESH_LOG is 'loud', which is no level. There are DEBUG, INFO, WARNING, ERROR and CRITICAL.\n"
    )


def test_a_pattern_that_would_match_for_ever_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(text, "_MATCHING_S", 2.0)

    with pytest.raises(ConfigurationError, match=r"'re:\(a\*\)\*b' is no regular expression: it takes more than 2 s"):
        text.matching("re:(a*)*b", ["a" * 60])


def test_a_pattern_with_many_stars_is_matched_at_once() -> None:
    names = ["a" * 500, "a" * 500 + "b", "b"]

    assert text.matching("*a" * 30 + "*b", names) == names[1:2]
    assert text.matching("re:(a|b)*b", names) == names[1:]
    assert text.matching("re:(a+)+b", names[1:]) == names[1:2]
