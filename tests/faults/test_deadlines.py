"""Deadlines of `timeouts`: each test misses exactly one, whose error says what was waited for, and the way out."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh.config.mesh import TimeoutsConfig
from fmu_mesh.errors import DeadlineExceeded
from fmu_mesh.instances.gazebo.gazebo_process import GazeboGone, GazeboProcess
from fmu_mesh.run import fork_server
from fmu_mesh.run.fork_server import ForkServer
from tests.helpers import BY_ZENOH, Place, rows_of, wait_until, write_config

PIPE_BYTES = 65536


@contextmanager
def full_pipe(path: Path) -> Iterator[None]:
    """A pipe at ``path`` that somebody has opened, and never reads: its writer blocks after 64 KiB."""
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        yield
    finally:
        os.close(reader)


@pytest.mark.parametrize("local", [(), ("--local",)], ids=["in processes", "local"])
@pytest.mark.parametrize("stop_time", [None, 3.0], ids=["in the run", "at its end"])
def test_a_write_that_does_not_return_ends_the_run(
    place: Place, stop_time: float | None, local: tuple[str, ...]
) -> None:
    """3000 rows have more than 64 KiB, and are written when all of them are there."""
    config = write_config(
        place.folder,
        simulation={"stop_time": stop_time},
        timeouts={"write": 0.5},
        record={"file": "blocked.csv"},
    )

    with full_pipe(place.folder / "blocked.csv"):
        launched = place.run("launch", config, "--no-progress", *local)

    assert launched.wait() == 4, launched.story()
    assert f"'{place.folder / 'blocked.csv'}' has not taken what the recorder writes for 0." in launched.errors
    assert "Does its file system answer? `timeouts.write` limits it." in launched.errors
    place.assert_nothing_left(within_s=5.0)


def test_a_write_of_a_program_that_returns_too_late_ends_its_thread(tmp_path: Path) -> None:
    config = write_config(
        tmp_path, simulation={"stop_time": None}, timeouts={"write": 0.3}, record={"file": "blocked.csv"}
    )

    before = threading.enumerate()  # an earlier test may have left a thread, too
    with full_pipe(tmp_path / "blocked.csv"):
        with pytest.raises(DeadlineExceeded, match=r"has not taken what the recorder writes for 0\.") as refused:
            fmu_mesh.load(config).run(processes=False)
        assert refused.value.point is not None
        [left] = [own for own in threading.enumerate() if own.name.startswith("run of") and own not in before]

    left.join(5.0)  # the pipe is closed, and so the write returns
    assert not left.is_alive()


def test_a_node_says_what_it_waits_for_and_so_does_the_error(place: Place) -> None:
    config = write_config(place.folder, stop_time=1e6, timeouts={"step": 1.5}, record={"file": "pair.csv"})
    launched = place.start("launch", config, "--no-progress")
    wait_until(lambda: (place.folder / "pair.csv").is_file() and rows_of(place.folder / "pair.csv"), "rows")
    [pendulum] = [p for p in place.processes("node") if p.cmdline()[0].endswith("pendulum")]

    pendulum.send_signal(signal.SIGSTOP)

    assert launched.wait() == 4
    told = [line for line in launched.errors.splitlines() if "it has waited" in line]
    assert "for 'pendulum.a', which feeds 'delay.x'" in told[0]
    assert "node 'pendulum'" in told[-1]
    assert "no progress for 1." in told[-1]
    assert "delay at point" in told[-1]
    place.assert_nothing_left(within_s=5.0)


def test_a_paused_mesh_says_nothing_of_its_waits(place: Place) -> None:
    config = write_config(place.folder, stop_time=1e6, timeouts={"step": 0.6}, zenoh=BY_ZENOH)
    launched = place.start("launch", config, "--no-progress", "--paused")

    wait_until(lambda: place.run("step", "pair", "10").wait() == 0, "a mesh")
    assert place.run("status", "delay").wait() == 0  # each command takes longer than a third of the deadline
    assert place.run("status", "delay").wait() == 0
    assert place.run("stop", "pair").wait() in (0, 130)

    launched.wait()
    assert "it has waited" not in launched.errors


def test_a_router_is_waited_for_as_long_as_said(place: Place) -> None:
    endpoint = "tcp/127.0.0.1:1"
    config = write_config(
        place.folder, timeouts={"router": 0.4}, zenoh={"mode": "client", "connect": [endpoint], "insecure": True}
    )

    launched = place.run("master", config)

    assert launched.wait() == 4
    assert f"nobody listens at {endpoint}. The router, or the master, had 0.4 s to start" in launched.errors


def test_a_command_that_gazebo_does_not_take_has_the_deadline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    silent = tmp_path / "silent.py"
    silent.write_text("import threading\nthreading.Event().wait(30)\n")
    monkeypatch.setenv("FMU_MESH_GAZEBO", f"{sys.executable} {silent}")
    monkeypatch.setattr("fmu_mesh.instances.gazebo.gazebo_process._END_S", 0.1)

    with pytest.raises(GazeboGone, match=r"it has not taken a command for 0\.3 s"):
        GazeboProcess(b" " * (2 * PIPE_BYTES), [], [], TimeoutsConfig(start=0.3))


def test_a_child_that_a_kill_does_not_end_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """As one in state D, which waits for a disk that does not answer: here SIGKILL does not reach it."""
    monkeypatch.setattr(fork_server, "_KILL_S", 0.2)
    server = ForkServer()
    with monkeypatch.context() as patched:
        patched.setattr(subprocess.Popen, "kill", lambda _self: None)
        server.discard()

    assert server.process.poll() is None or server.process.returncode == 0
    server.process.kill()
    server.process.communicate(timeout=10.0)
