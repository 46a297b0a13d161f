"""What a model, a file or a mesh says reaches the terminal as text: it clears no screen and forges no line of ours."""

from __future__ import annotations

import io
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import fmu_mesh
from fmu_mesh.cli.main import main
from fmu_mesh.printing import page, paragraph, printable
from tests.fmus.helpers import NO_COMPILER, built_once
from tests.fmus.packing import repacked
from tests.helpers import DEADLINE_S, Place, write_config

SAID = "&#10;fmu-mesh: all is well&#x9b;2J&#x202e;"
"""A line break, a control character of eight bits and one that reverses what follows; XML takes no ESC."""
NAME = "third\nfmu-mesh: all is well\x9b2J\u202e"
HARM = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]|^fmu-mesh: all is", re.MULTILINE
)
COMPONENT = '''
import fmu_mesh

class Liar(fmu_mesh.Component):
    """\\x1b[2J\\nfmu-mesh: all is well"""
    u = fmu_mesh.Input(description="\\x1b]52;c;Zm9v\\a\\nfmu-mesh: all is well", unit="\\x1b[2J")
    y = fmu_mesh.Output(start=0.0, description="\\x9b2J")

    def step(self, time, step_size):
        if time > 0.0055:
            raise ValueError("\\x1b[2J\\nfmu-mesh: all is well")
'''


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mesh of an FMU that lies in its description and its messages, files that lie, and a result."""
    if NO_COMPILER is not None:
        pytest.skip(NO_COMPILER)
    hostile, made = built_once(Path(__file__).parent / "fmus" / "Hostile"), tmp_path_factory.mktemp("lies")

    def lying(text: str) -> str:
        text = text.replace('name="third"', f'name="third{SAID}"').replace("<Real/>", f'<Real unit="N{SAID}"/>')
        for what in ("description", "generationTool", "modelName", "author"):
            text = re.sub(rf'\b{what}="', f'{what}="{SAID}', text)
        return text

    fmu = repacked(made / "lying.fmu", source=hostile, description=lying)
    (made / "liar.py").write_text(COMPONENT, encoding="utf-8")
    forger = {"fmu": str(fmu)}
    write_config(made, name="good", instances={"forger": forger}, connections=(), stop_time=0.008)
    both = {"forger": forger, "liar": {"python": "liar.py:Liar"}}
    write_config(made, name="failing", instances=both, connections=[f"forger.{NAME} -> liar.u"], stop_time=0.01)
    lie = '"\\e[2J\\nfmu-mesh: all is well\\x9b"'
    bad = f"mesh: bad\n{lie}: 1\nsimulation: {{algorithm: {lie}, stop_time: 1.0, step_size: 0.1}}\ninstances:\n"
    (made / "bad.yaml").write_text(f"{bad}  forger: {{fmu: {fmu}, start_values: {{{lie}: 1}}, {lie}: 2}}\n", "utf-8")
    fmu_mesh.load(made / "good.yaml").run(processes=False)
    return made


@pytest.fixture
def here(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(folder)
    return folder


def assert_harmless(printed: str) -> None:
    assert printed
    assert not (found := HARM.search(printed)), repr(printed[max(found.start() - 80, 0) : found.end() + 20])


COMMANDS = [
    ("check", "good.yaml"),
    ("check", "failing.yaml"),
    ("check", "bad.yaml"),
    ("check", "good.yaml", "--set", "forger.third\x1b[2J=1"),
    ("inspect", "lying.fmu"),
    ("inspect", "lying.fmu", "--all", "--variables", "*"),
    ("graph", "failing.yaml"),
    ("launch", "good.yaml", "--local", "--output", "one.csv"),
    ("launch", "failing.yaml", "--local", "--output", "two.csv"),
    ("launch", "good.yaml", "--local", "--profile", "--output", "one.csv"),
    ("compare", "good.csv", "good.csv"),
    ("compare", "good.csv", "good.csv", "--tolerance", "\x1b[2J"),
    ("plot", "good.csv", "--output", "good.svg"),
    ("plot", "good.csv", "--variables", "forger.\x9b2J"),
    ("rerun", "good.csv", "--output", "again.csv"),
    ("sweep", "good.yaml", "--vary", "forger.u=1,2", "--folder", "swept"),
    ("sweep", "failing.yaml", "--vary", "forger.u=1,2", "--folder", "failed"),
    ("new", "lying.fmu", "--output", "new.yaml"),
    ("convert", "good.yaml", "good.ssp"),
    ("\x1b[2Jnonsense",),
]


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: "_".join(command[:2]).replace("\x1b", "ESC"))
def test_a_command_prints_lies_of_others_as_text(
    here: Path, command: tuple[str, ...], capfd: pytest.CaptureFixture[str]
) -> None:
    assert here.is_dir()

    main(command)

    printed = capfd.readouterr()
    assert_harmless(printed.out + printed.err)
    assert "Traceback" not in printed.err


@pytest.mark.parametrize("config", ["good.yaml", "failing.yaml"])
def test_a_launch_prints_lies_of_its_instances_as_text(here: Path, place: Place, config: str) -> None:
    done = place.run("launch", here / config, "--output", "launched.csv", "--no-progress")

    assert done.wait() == (3 if config == "failing.yaml" else 0)
    assert_harmless(done.output + done.errors)
    told = re.findall(r"bad\n    fmu-mesh: all is well\\x1b]52;c;Zm9v\\x07\\x9b\\u202e(?: \((\d+) more)?", done.errors)
    steps = range(6, 11) if config == "failing.yaml" else [8]  # one may be ahead of the one that fails
    assert sum(int(more or 1) for more in told) in steps
    assert ("ValueError: \\x1b[2J" in done.errors) == (config == "failing.yaml")


@pytest.fixture
def running(here: Path) -> Iterator[fmu_mesh.Run]:
    mesh = fmu_mesh.load(here / "good.yaml")
    with mesh.start(output="running.csv", paused=True, stop_time=1000.0, real_time_factor=1.0) as run:
        run.wait_for("paused", DEADLINE_S)
        run.step(3)
        yield run


def test_the_commands_for_a_running_mesh_print_its_lies_as_text(
    running: fmu_mesh.Run, capfd: pytest.CaptureFixture[str]
) -> None:
    assert running.name == "good"
    name = f"forger.{NAME}"
    for command in (
        ["ls"],
        ["ls", "--long"],
        ["status"],
        ["status", "good/forger"],
        ["info", "good"],
        ["info", "good/forger"],
        ["get", name],
        ["get", "forger.*"],
        ["get", "forger.\x1b[2J"],
        ["set", name, "1"],
        ["set", "forger.u", "1"],
        ["logs"],
        ["top", "--once", "--watch", name],
        ["graph", "good"],
        ["resume"],
        ["watch", name, "--count", "1"],
    ):
        main(command)

        printed = capfd.readouterr()
        assert_harmless(printed.out + printed.err)


@pytest.mark.parametrize("how", ["run", "open", "adapter"])
def test_the_library_logs_lies_of_models_as_text(here: Path, how: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG")
    mesh = fmu_mesh.load(here / "good.yaml")

    if how == "run":
        mesh.run(record="memory", processes=False)
    elif how == "open":
        with mesh.open() as system:
            system.step(3)
    else:
        with fmu_mesh.FMIAdapter(here / "lying.fmu", step_size=0.001) as adapter:
            adapter.exit_initialization_mode(0.0)
            adapter.do_step()

    messages = [record.getMessage() for record in caplog.records if "all is well" in record.getMessage()]
    assert messages
    assert_harmless("\n".join(messages))


def test_pictures_have_lies_of_others_as_text(here: Path) -> None:
    assert main(["graph", "failing.yaml", "--output", "graph.svg"]) == 0
    assert main(["plot", "good.csv", "--output", "plot.svg"]) == 0

    for picture in ("graph.svg", "plot.svg"):
        text = (here / picture).read_text(encoding="utf-8")
        assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]|&#", text)
    graph = fmu_mesh.load("failing.yaml").graph().figure()
    assert_harmless("\n".join(text.get_text() for text in graph.axes[0].texts))


def test_json_has_the_names_as_they_are(here: Path, capfdbinary: pytest.CaptureFixture[bytes]) -> None:
    assert here.is_dir()

    main(["inspect", "lying.fmu", "--json"])

    printed = json.loads(capfdbinary.readouterr().out)
    assert NAME in [variable["name"] for variable in printed["description"]["variables"]]


@given(st.text(), st.sampled_from([printable, paragraph, lambda text: page([text])]))
def test_no_text_keeps_what_controls_a_terminal(text: str, shown: object) -> None:
    assert callable(shown)

    safe = shown(f"x{text}")

    assert not re.search("[\x00-\x09\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]", safe)
    assert all(line.startswith(("x", "    ")) for line in safe.split("\n"))
    assert shown(safe) == safe or shown is paragraph


LIMITS = [
    (">/dev/full", 2, "standard output cannot be written: No space left on device"),
    (">&-", 0, ""),
    ("2>&-", 0, ""),
    ("2>/dev/full", 0, ""),
    ("| true", 0, ""),
]


@pytest.mark.parametrize(("where", "code", "said"), LIMITS, ids=[where for where, _, _ in LIMITS])
@pytest.mark.parametrize("how", [(), ("--json",)], ids=["text", "json"])
def test_output_that_goes_nowhere_is_no_internal_error(
    here: Path, place: Place, where: str, code: int, said: str, how: tuple[str, ...]
) -> None:
    command = f"exec {sys.executable} -m fmu_mesh check {here}/good.yaml {' '.join(how)}"

    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", f"({command}) {where}"],
        capture_output=True,
        text=True,
        env=place.environment,
        timeout=DEADLINE_S,
        check=False,
    )

    assert done.returncode == code
    assert said in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("how", [(), ("--json",)], ids=["text", "json"])
def test_a_terminal_of_ascii_shows_other_characters_escaped(here: Path, place: Place, how: tuple[str, ...]) -> None:
    place.environment["PYTHONIOENCODING"] = "ascii"
    (here / "µ.fmu").write_bytes((here / "lying.fmu").read_bytes())

    done = place.run("inspect", here / "µ.fmu", *how)

    assert done.wait() == 0, done.errors
    assert "Traceback" not in done.errors
    assert ("/µ.fmu" if how else "/\\xb5.fmu") in done.output


def test_a_traceback_is_printable(here: Path, place: Place) -> None:
    done = place.run("check", here / "bad.yaml", "--debug")

    assert done.wait() == 1
    assert "Traceback" in done.errors
    assert_harmless(done.errors)


def test_the_node_of_ros_prints_a_traceback_as_text(tmp_path: Path) -> None:
    (tmp_path / "rclpy.py").write_text(r"raise ValueError('\x1b[2J')", encoding="utf-8")

    ended = subprocess.run(
        [sys.executable, "-m", "fmu_mesh.ros.node"],
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )

    assert "ValueError" in ended.stderr
    assert_harmless(ended.stderr)


def test_a_log_message_begins_no_line_of_its_own() -> None:
    program = (
        "import logging\nfrom fmu_mesh.run.program import exit_code_of\n"
        "exit_code_of(lambda: logging.warning('a\\x1b[2J\\nfmu-mesh: all is well') or 0, 0)"
    )

    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=DEADLINE_S, check=True
    )

    assert done.stderr == "root: WARNING: a\\x1b[2J\n    fmu-mesh: all is well\n"
    assert io.StringIO(done.stdout).read() == ""
