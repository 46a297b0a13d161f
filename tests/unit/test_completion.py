"""Completion in real shells: what they offer for a line that is not finished."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.helpers import Place, write_config
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
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment = {**place.environment, "PATH": path, "HOME": str(place.folder), "TERM": "dumb"}
    done = subprocess.run(command, env=environment, cwd=place.folder, capture_output=True, text=True, check=False)
    return [line.partition("\t")[0].partition(":")[0].strip() for line in done.stdout.splitlines() if line.strip()]


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
