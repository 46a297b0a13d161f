"""The table of commands: each module has what the table says, and a command imports only what it needs."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

import pytest

from fmu_mesh.cli.main import COMMANDS, main

HEAVY = {"numpy", "zenoh", "rich", "fmpy", "lxml", "ruamel", "logging", "matplotlib", "argcomplete"}


@pytest.fixture(autouse=True)
def no_other_meshes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(tmp_path / "runtime"))


def imported(*arguments: str) -> set[str]:
    """The modules that a command has imported at its end."""
    program = (
        "import contextlib, io, sys\n"
        "from fmu_mesh.__main__ import main\n"
        "sys.argv[0] = 'fmu-mesh'\n"
        "with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()): main()\n"
        "print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_each_module_has_the_commands_that_the_table_names() -> None:
    arguments = {f"{of}_arguments" for of, _, _ in COMMANDS.values()}
    modules = {module for _, module, _ in COMMANDS.values()}

    parsers = {(name, module) for module in arguments for name in import_module(f"fmu_mesh.cli.{module}").PARSERS}
    runs = {(name, module) for module in modules for name in import_module(f"fmu_mesh.cli.{module}").RUNS}

    assert parsers == {(name, f"{of}_arguments") for name, (of, _, _) in COMMANDS.items()}
    assert runs == {(name, module) for name, (_, module, _) in COMMANDS.items()}


@pytest.mark.parametrize("arguments", [("--version",), ("--help",)])
def test_the_version_and_the_list_of_commands_need_nothing_large(arguments: Sequence[str]) -> None:
    assert imported(*arguments) & HEAVY == set()


def test_the_arguments_of_all_commands_need_nothing_large() -> None:
    program = "import sys; from fmu_mesh.cli.main import command_parser; command_parser(); print(*sys.modules)"

    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)

    modules = {one for one in done.stdout.split() if one != "fmu_mesh.api" and not one.endswith("_options")}
    assert modules & (HEAVY - {"logging"}) == set()
    assert not [name for name in modules if name.startswith(("fmu_mesh.api", "fmu_mesh.node", "fmu_mesh.ros.bags."))]


@pytest.mark.parametrize(
    ("arguments", "not_needed"),
    [
        (("ls",), {"fmpy", "ruamel", "matplotlib", "rich"}),
        (("inspect", "fmus/Gain.fmu"), {"zenoh", "matplotlib", "rich"}),
        (
            ("check", "configs/pendulum_delay.yaml"),
            {"zenoh", "matplotlib", "rich", "importlib.metadata", "fmu_mesh.api.run_handle", "fmu_mesh.ros.bags"},
        ),
    ],
)
def test_a_command_does_not_import_what_only_others_need(arguments: Sequence[str], not_needed: set[str]) -> None:
    assert imported(*arguments) & not_needed == set()


def test_the_version_imports_this_much_of_the_package_and_little_else() -> None:
    """`python -m benchmarks.imports` tells how long it takes."""
    modules = imported("--version")
    own = {name.removeprefix("fmu_mesh.") for name in modules if name.startswith("fmu_mesh.")}
    program = [sys.executable, "-c", "import sys, msgspec; print(*sys.modules)"]
    of_msgspec = subprocess.run(program, capture_output=True, text=True, check=True).stdout.split()

    assert len(modules) <= 2 * len(of_msgspec)
    assert own <= {
        "__main__",
        "cli",
        "cli.arguments",
        "cli.main",
        "config",
        "config.base",
        "errors",
        "printing",
        "run",
        "run.limits",
        "run.threads",
        "text",
        "wire",
        "wire.last_exit",
    }


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("launch", "--json"), "`fmu-mesh launch` needs CONFIG"),
        (("launch", "a.yaml", "--json", "--plto", "x"), "Did you mean '--plot'?"),
        (
            ("check", "a.yaml", "--json", "--plot", "x.png"),
            "It is an option of `launch`, `simulate`, `convergence`, `compare`, `master`.",
        ),
        (("lunch", "--json"), "Did you mean 'launch'?"),
        (("--json", "launch", "a.yaml"), "It comes after the command: `fmu-mesh launch --json`."),
    ],
)
def test_a_wrong_usage_is_an_object_for_programs_and_sentence_for_people(
    arguments: Sequence[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main(arguments)

    out, err = capsys.readouterr()
    report = json.loads(out)
    assert (code, report["exit_code"], report["error"]["kind"]) == (2, 2, "ConfigurationError")
    assert words in err
    assert words.rstrip("?.").split("'")[0] in f"{report['error']['message']} {report['error']['hint']}"


def test_an_fmu_that_cannot_be_inspected_is_an_object_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(tmp_path / "Gone.fmu"), "--json"]) == 2

    assert json.loads(capsys.readouterr().out)["error"]["exit_code"] == 2
