"""Completion in real shells: what they offer for a line that is not finished."""

from __future__ import annotations

import os
import pty
import shlex
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.helpers import FMUS, Place, wait_until, write_config
from tests.ssp.packages import write_package
from tests.ssp.ship import SHIP

BASH = """
source <(fmu-mesh completion bash)
COMP_WORDS=(fmu-mesh "$@") COMP_CWORD=$# COMP_LINE="fmu-mesh $*" COMP_TYPE=9
COMP_POINT=${#COMP_LINE}
_python_argcomplete fmu-mesh
printf '%s\\n' "${COMPREPLY[@]}"
"""
FISH = 'fmu-mesh completion fish | source; complete --do-complete "fmu-mesh $argv"'
ZSH = """
fmu-mesh completion zsh > $HOME/_fmu-mesh
fpath=($HOME $fpath)
autoload -Uz compinit && compinit -u
_describe() { shift; print -l -- ${(P)1} }
compadd() { :; }
BUFFER="fmu-mesh $*" CURSOR=$((${#BUFFER}))
words=(fmu-mesh "$@")
source $HOME/_fmu-mesh
_python_argcomplete
"""


def environment_of(place: Place) -> dict[str, str]:
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    return {**place.environment, "PATH": path, "HOME": str(place.folder), "TERM": "dumb", "INPUTRC": "/dev/null"}


def offered(place: Place, shell: str, *words: str) -> list[str]:
    """What a shell offers for the last of these words."""
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    if shell == "fish":
        command = ["fish", "--no-config", "-c", FISH, *words]
    else:
        command = [
            shell,
            *(["-f"] if shell == "zsh" else ["--norc"]),
            "-c",
            BASH if shell == "bash" else ZSH,
            shell,
            *words,
        ]
    done = subprocess.run(
        command, env=environment_of(place), cwd=place.folder, capture_output=True, text=True, check=False
    )
    return [line.partition("\t")[0].partition(":")[0].strip() for line in done.stdout.splitlines() if line.strip()]


def after_tab(place: Place, line: str) -> str:
    """What a person sees in bash after the Tab key at the end of a line."""
    ours, theirs = pty.openpty()
    with subprocess.Popen(
        ["setsid", "--ctty", "bash", "--norc", "-i"],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env=environment_of(place),
        cwd=place.folder,
    ) as bash:
        os.close(theirs)
        show = """bind -x '"\\C-o": printf "%s" "$READLINE_LINE" > shown'"""
        os.write(ours, f"source <(fmu-mesh completion bash); {show}; touch ready\n".encode())
        wait_until((place.folder / "ready").exists, "a bash that is ready")
        os.write(ours, f"{line}\t\x0f".encode())
        shown = wait_until(
            lambda: (place.folder / "shown").exists() and (place.folder / "shown").read_text(), "the line"
        )
        bash.kill()
    os.close(ours)
    for name in ("ready", "shown"):
        (place.folder / name).unlink()
    return str(shown)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_completes_commands_options_files_and_instances_of_a_file(place: Place, shell: str) -> None:
    write_config(place.folder)
    (place.folder / "notes.txt").touch()

    assert offered(place, shell, "la") == ["launch"]
    assert offered(place, shell, "launch", "--set-") == ["--set-config"]
    assert offered(place, shell, "launch", "p") == ["pair.yaml"]
    assert offered(place, shell, "launch", "n") == []
    assert offered(place, shell, "node", "pair.yaml", "d") == ["delay"]
    assert offered(place, shell, "launch", "pair.yaml", "--algorithm", "j") == ["jacobi"]
    assert offered(place, shell, "wait", "--state", "run") == ["running"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_completes_what_security_does_for_whom(place: Place, shell: str) -> None:
    for name in ("alice", "bob"):
        (place.folder / "lab" / name).mkdir(parents=True)
        (place.folder / "lab" / name / "certificate.pem").touch()

    assert offered(place, shell, "security", "re") == ["renew", "remove"]
    assert offered(place, shell, "security", "add", "lab", "carol", "--role", "o") == ["observer", "operator"]
    assert offered(place, shell, "security", "renew", "lab", "a") == ["alice"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_completes_packages_and_their_descriptions_and_instances(place: Place, shell: str) -> None:
    write_package(place.folder / "ship.ssp", SHIP)
    write_package(place.folder / "unpacked", SHIP)

    assert offered(place, shell, "launch", "s") == ["ship.ssp"]
    assert offered(place, shell, "convert", "s") == ["ship.ssp"]
    for command in ("launch", "check", "inspect", "graph", "sweep", "convert"):
        assert offered(place, shell, command, "ship.ssp", "--ssd", "") == ["SystemStructure.ssd", "VarB.ssd"], command
    assert offered(place, shell, "check", "unpacked", "--ssd", "V") == ["VarB.ssd"]
    assert offered(place, shell, "check", "nothing.ssp", "--ssd", "V") == []
    assert offered(place, shell, "node", "ship.ssp", "D") == ["DP-32-Controller"]


def test_a_shell_completes_what_is_running(place: Place) -> None:
    config = write_config(place.folder, stop_time=3600.0, simulation={"real_time_factor": 1.0, "step_size": 0.01})
    place.start("launch", config, "--quiet")
    assert place.run("wait").wait() == 0

    def both(*words: str) -> Sequence[str]:
        return offered(place, "bash", *words)

    assert both("pause", "") == ["pair"]
    assert both("get", "") == ["pendulum.", "delay."]
    assert both("get", "delay.") == ["delay.x", "delay.y", "delay.d"]
    assert both("set", "pair/del") == ["pair/delay."]
    assert both("logs", "--instance", "p") == ["pendulum"]
    assert both("status", "") == ["pair", "pendulum", "delay"]


def test_where_nothing_is_running_nothing_is_offered(place: Place) -> None:
    assert [offered(place, "bash", command, "") for command in ("get", "stop", "status")] == [[], [], []]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_completes_long_names_in_parts(place: Place, shell: str) -> None:
    write_config(place.folder)
    opened = r"max\(" if shell == "bash" else "max("  # as the harness prints it

    assert offered(place, shell, "launch", "pair.yaml", "--set", "pen") == ["pendulum."]
    assert offered(place, shell, "launch", "pair.yaml", "--set", "pendulum.l") == ["pendulum.l="]
    assert offered(place, shell, "sweep", "pair.yaml", "--vary", "del") == ["delay."]
    assert offered(place, shell, "sweep", "pair.yaml", "--vary", "simulation.sto") == ["simulation.stop_time="]
    assert offered(place, shell, "sweep", "pair.yaml", "--reduce", "max") == [opened]
    assert offered(place, shell, "sweep", "pair.yaml", "--reduce", "'max(delay.") == ["max(delay.y)"]
    assert offered(place, shell, "sweep", "pair.yaml", "--sampler", "h") == ["halton"]
    assert offered(place, shell, "inspect", str(FMUS / "Gain.fmu"), "k") == ["k"]


def test_a_shell_completes_the_variables_of_files(place: Place) -> None:
    (place.folder / "r.csv").write_text('time,"arm.q[1,2]",arm.motor.tau,arm.motor.w\n0.0,1.0,2.0,3.0\n')

    assert offered(place, "bash", "plot", "r.csv", "--variables", "arm.m") == ["arm.motor."]
    assert offered(place, "bash", "plot", "r.csv", "--x", "arm.motor.") == ["arm.motor.tau", "arm.motor.w"]
    assert offered(place, "bash", "compare", "r.csv", "r.csv", "--variables", "arm.q") == [r"arm.q\[1,2\]"]
    assert offered(place, "bash", "run", str(FMUS / "Gain.fmu"), "--set", "k") == ["k="]


def test_a_name_that_a_shell_would_run_is_quoted(place: Place) -> None:
    hostile = "k $(touch pwned)`touch pwned`[2,1]"
    with zipfile.ZipFile(FMUS / "Gain.fmu") as source, zipfile.ZipFile(place.folder / "g.fmu", "w") as copy:
        for name in source.namelist():
            data = source.read(name).replace(b'name="k"', f'name="{hostile}"'.encode())
            copy.writestr(name, data.replace(b'name="u"', b'name="k&#10;touch pwned"'))
    (place.folder / "m.yaml").write_text(
        "{mesh: m, simulation: {stop_time: 1.0, step_size: 0.1}, instances: {g: {fmu: g.fmu}}}"
    )

    line = after_tab(place, "fmu-mesh launch m.yaml --set g.k")

    assert shlex.split(line) == ["fmu-mesh", "launch", "m.yaml", "--set", f"g.{hostile}="]
    assert line.endswith("=")  # no space: a value follows
    assert after_tab(place, "fmu-mesh launch m.yaml --set g") == "fmu-mesh launch m.yaml --set g."
    assert after_tab(place, "fmu-mesh launch m.yaml --set=g.k") == line.replace("--set ", "--set=")
    assert not (place.folder / "pwned").exists()


def test_where_names_cannot_be_known_nothing_is_offered_and_no_code_runs(place: Place) -> None:
    code = "import pathlib\nimport fmu_mesh\npathlib.Path('ran').touch()\nclass C(fmu_mesh.Component):\n    pass\n"
    (place.folder / "c.py").write_text(code)
    (place.folder / "broken.fmu").write_bytes(b"PK\x03\x04")
    (place.folder / "m.yaml").write_text(
        "{mesh: m, simulation: {stop_time: 1, step_size: 1}, instances: {c: {python: 'c.py:C'}, b: {fmu: broken.fmu}}}"
    )
    os.mkfifo(place.folder / "endless.csv")  # nobody writes it

    assert offered(place, "bash", "launch", "m.yaml", "--set", "c.") == []
    assert offered(place, "bash", "launch", "m.yaml", "--set", "b.") == []
    assert offered(place, "bash", "launch", "gone.yaml", "--set", "") == []
    assert offered(place, "bash", "launch", "--set", "") == []
    assert offered(place, "bash", "plot", "endless.csv", "--variables", "") == []
    assert not (place.folder / "ran").exists()
