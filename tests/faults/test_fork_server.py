"""The fork server: what its processes have from it and what not, and what happens when it is killed or stopped."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

import fmu_mesh
from fmu_mesh.cli.main import main
from tests.helpers import (
    DEADLINE_S,
    FMUS,
    Launched,
    Place,
    on_a_busy_machine,
    row_count,
    rows_of,
    wait_until,
    write_config,
)

FAR_S = 1_000_000.0
ROLES = ("fork", "master", "pendulum", "delay")


def running(place: Place) -> tuple[Launched, Path]:
    """A mesh that runs in real time, and its result file."""
    config = write_config(place.folder, stop_time=FAR_S, simulation={"real_time_factor": 1})
    launched = place.start("launch", config)
    result = config.with_suffix(".csv")
    wait_until(lambda: row_count(result) > 100, "100 rows")
    return launched, result


def status_of(process: psutil.Process) -> dict[str, str]:
    """The lines of `/proc/PID/status` by their names."""
    lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
    return {name: value.strip() for name, _, value in (line.partition(":") for line in lines)}


def sockets_of(process: psutil.Process) -> set[str]:
    """The open sockets of a process by their inodes."""
    links = [str(file.readlink()) for file in Path(f"/proc/{process.pid}/fd").iterdir()]
    return {link for link in links if link.startswith("socket:")}


@pytest.mark.parametrize(
    ("number", "how"), [(signal.SIGKILL, "was ended by SIGKILL"), (signal.SIGTERM, "was asked to end by a signal")]
)
def test_without_its_fork_server_run_ends_with_its_name_and_its_rows(
    place: Place, number: signal.Signals, how: str
) -> None:
    launched, result = running(place)

    launched.child("fork").send_signal(number)

    assert launched.wait() == 4
    assert launched.ended_after_s < on_a_busy_machine(4.0)
    assert f"the fork server was lost: its process {how}" in launched.message
    place.assert_nothing_left()
    rows = len(rows_of(result))
    assert f"({rows} rows) is in '{result}'" in launched.message
    config = write_config(place.folder, name="local", stop_time=(rows - 1) * 0.001)
    assert main(["launch", str(config), "--local", "--no-progress"]) == 0
    assert result.read_bytes() == config.with_suffix(".csv").read_bytes()


def test_a_fork_server_that_is_killed_before_it_has_forked_is_named(place: Place) -> None:
    place.hold("master pair")  # so that the run does not go on meanwhile
    launched = place.start("launch", write_config(place.folder, stop_time=FAR_S))

    launched.child("fork").kill()

    assert launched.wait() == 4
    assert launched.ended_after_s < on_a_busy_machine(5.0)
    assert "the fork server was lost: its process was ended by SIGKILL" in launched.message
    place.assert_nothing_left()


def test_with_restarts_a_run_whose_fork_server_is_killed_starts_again(place: Place) -> None:
    config = write_config(place.folder, stop_time=2.0, simulation={"real_time_factor": 1})
    result = config.with_suffix(".csv")
    launched = place.start("launch", config, "--restarts", "1")
    wait_until(lambda: row_count(result) > 100, "100 rows")

    launched.child("fork").kill()

    assert "the fork server was lost" in launched.wait_for_error_line("starts again")
    assert launched.wait() == 0
    assert len(rows_of(result)) == 2001
    place.assert_nothing_left()


def test_a_fork_server_that_is_stopped_before_it_forks_is_named(place: Place) -> None:
    config = write_config(place.folder, stop_time=FAR_S, timeouts={"start": 10 * DEADLINE_S, "link": 4.0})
    launched = place.start("launch", config)

    launched.child("fork").suspend()

    assert launched.wait(30.0) == 4
    assert "was lost: its process" in launched.message
    place.assert_nothing_left()


def test_a_run_whose_fork_server_is_stopped_meanwhile_ends_as_any_other(place: Place) -> None:
    config = write_config(place.folder, stop_time=1.0, simulation={"real_time_factor": 1})
    result = config.with_suffix(".csv")
    launched = place.start("launch", config)
    wait_until(lambda: row_count(result) > 10, "10 rows")

    launched.child("fork").suspend()

    assert launched.wait() == 0, launched.errors
    assert len(rows_of(result)) == 1001
    place.assert_nothing_left()


@pytest.mark.parametrize(
    ("victim", "lost"), [("pendulum", "node 'pendulum' was lost"), ("master", "the master was lost")]
)
def test_the_end_of_a_process_is_noticed_although_fork_server_is_stopped(place: Place, victim: str, lost: str) -> None:
    launched, _ = running(place)
    launched.child("fork").suspend()

    launched.child(victim).kill()

    assert launched.wait() == 4
    assert launched.ended_after_s < on_a_busy_machine(6.0)
    assert f"{lost}: its process has ended; the fork server, which knows how, does not answer. " in launched.message
    place.assert_nothing_left()


@pytest.mark.parametrize("together", [("fork",), ("fork", "master"), ROLES])
def test_whoever_is_killed_together_with_the_launcher_nothing_is_left(place: Place, together: tuple[str, ...]) -> None:
    launched, _ = running(place)
    victims = [psutil.Process(launched.pid), *map(launched.child, together)]

    for victim in victims:
        victim.kill()

    assert launched.wait() == -signal.SIGKILL
    wait_until(lambda: not place.processes(), "the end of all processes", 15.0)
    # If all were killed at once, the next run removes their files.
    assert place.run("launch", write_config(place.folder, name="next", stop_time=0.01)).wait() == 0
    place.assert_nothing_left()


def test_fork_server_that_is_stopped_does_not_outlive_launcher_that_is_killed(place: Place) -> None:
    launched, _ = running(place)
    launched.child("fork").suspend()

    psutil.Process(launched.pid).kill()

    wait_until(lambda: not place.processes(), "the end of all processes", 15.0)


def test_fork_server_stopped_before_it_forks_does_not_outlive_launcher_killed(place: Place) -> None:
    launched = place.start("launch", write_config(place.folder, stop_time=FAR_S))
    launched.child("fork").suspend()

    psutil.Process(launched.pid).kill()

    wait_until(lambda: not place.processes(), "the end of all processes", 15.0)


def test_a_refused_configuration_leaves_no_fork_server(place: Place) -> None:
    config = write_config(place.folder, instances={"gain": {"fmu": "no.fmu"}}, connections=[])

    launched = place.run("launch", config)

    assert launched.wait() == 2
    place.assert_nothing_left()


def test_a_forked_process_is_one_of_its_own(place: Place) -> None:
    launched, _ = running(place)
    server, *forked = map(launched.child, ROLES)

    assert server.num_threads() == 1  # a fork copies one thread only
    for process in forked:
        status = status_of(process)
        assert int(status["SigBlk"], 16) == 0
        assert not int(status["SigCgt"], 16) >> (signal.SIGCHLD - 1) & 1
        assert os.getsid(process.pid) == os.getpgid(process.pid) == process.pid
        assert not sockets_of(process) & sockets_of(server)
        assert process.ppid() == server.pid
    launched.signal(signal.SIGINT)
    assert launched.wait() == 130
    place.assert_nothing_left()


def test_each_process_has_a_title_and_a_profiler_can_look_into_it(place: Place) -> None:
    launched, _ = running(place)
    processes = [launched.child(role) for role in ROLES]

    titles = [" ".join(process.cmdline()).strip() for process in processes]

    assert titles == [
        "fmu-mesh fork server pair",
        "fmu-mesh master pair",
        "fmu-mesh node pendulum",
        "fmu-mesh node delay",
    ]
    scope = Path("/proc/sys/kernel/yama/ptrace_scope")
    if os.geteuid() and scope.exists() and scope.read_text().strip() != "0":
        return  # this host lets nobody look into a process of its own user
    command = [str(Path(sys.executable).with_name("py-spy")), "dump", "--pid", str(processes[2].pid)]
    stacks = subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE_S, check=True).stdout
    assert "Node.run (" in stacks


NOISE = """
import random

import fmu_mesh
import numpy as np

class Noise(fmu_mesh.Component):
    y = fmu_mesh.Output()

    def initialize(self):
        print("drawn:", random.random(), np.random.random())

    def step(self, time, step_size):
        self.y = time
"""


def test_two_components_do_not_draw_the_same_random_numbers(place: Place) -> None:
    (place.folder / "noise.py").write_text(NOISE)
    mesh = fmu_mesh.Mesh("noises", step_size=0.1, stop_time=1.0)
    for name in ("first", "second"):
        mesh.add(name, python=f"{place.folder / 'noise.py'}:Noise")

    lines: list[str] = []
    mesh.run(record="memory", on_event=lambda event: lines.append(getattr(event, "text", "")))

    drawn = [number for line in lines for number in line.split()[1:] if line.startswith("drawn:")]
    assert len(set(drawn)) == len(drawn) == 4


def test_a_program_gets_the_loss_of_the_fork_server(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "environ", os.environ | place.environment)
    mesh = fmu_mesh.Mesh("steered", step_size=0.01, stop_time=60.0, real_time_factor=1.0)
    mesh.add("gain", fmu=FMUS / "Gain.fmu")
    with mesh.start(record="memory") as run:
        run.get("gain.y")
        [server] = place.processes("fork")
        server.kill()
        with pytest.raises(fmu_mesh.MeshLost, match="the fork server was lost: its process was ended by SIGKILL"):
            run.wait(DEADLINE_S)
    place.assert_nothing_left()
