"""`pause` and `step` answer when the mesh rests, and say at once if it does not come to rest."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh.api.run_handle import TIMEOUT_S
from fmu_mesh.master.mesh_server import STATUS_S
from tests.api.test_mesh_building import built
from tests.api.test_runs import steered
from tests.fmus.helpers import find_fmu
from tests.helpers import DEADLINE_S, Place, wait_until, write_config

LONG = 10_000
"""Points that take 100 s by the wall clock."""


def slow(folder: Path, *, stop_time: float | None = None, **start_values: float) -> fmu_mesh.Mesh:
    """A mesh whose steps take 10 ms."""
    mesh = fmu_mesh.Mesh("slow", step_size=0.1, stop_time=stop_time)
    mesh.add("slow", fmu=find_fmu("Faulty", folder), start_values={"slow": 0.01, **start_values})
    return mesh


@contextmanager
def stepping(run: fmu_mesh.Run, points: int, timeout: float = DEADLINE_S) -> Iterator[Callable[[], int]]:
    """A step on a thread of its own, and what waits for its point or its error."""
    before = max(run.status.progress.values())
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(lambda: run.step(points, timeout=timeout).point)
        wait_until(lambda: max(run.status.progress.values()) > before, "the first point of the step")
        yield lambda: future.result(DEADLINE_S)


def test_steps_pauses_and_waits_do_not_wait_for_the_periodic_status() -> None:
    mesh = built(stop_time=None)
    mesh.configure(simulation={"real_time_factor": 1.0})
    with mesh.start(record=None) as run:
        run.wait_for("running")
        began = time.monotonic()
        for _ in range(20):
            paused = run.pause().point
            assert run.wait_for("paused").point == paused
            assert [run.step().point - paused for _ in range(3)] == [1, 2, 3]
            run.resume()
            run.wait_for("running")
        took = time.monotonic() - began
        run.stop()

    assert took < 20 * 6 * STATUS_S / 2  # half of what six waits for a periodic status take on average


def test_two_programs_that_step_at_once_step_for_both() -> None:
    with built(stop_time=None).start(record=None, paused=True) as run, fmu_mesh.attach(wait=DEADLINE_S) as other:
        other.wait_for("paused")

        def steps(one: fmu_mesh.Run) -> list[int]:
            return [one.step(3).point for _ in range(25)]

        with ThreadPoolExecutor(2) as pool:
            points = list(pool.map(steps, (run, other), timeout=DEADLINE_S))

        assert run.status.point == 2 * 25 * 3
        for own in points:
            assert own == sorted(own)


def test_a_long_step_tells_its_progress_and_returns_at_its_end() -> None:
    with built(stop_time=None).start(record=None, paused=True) as run, ThreadPoolExecutor(1) as pool:
        run.wait_for("paused")
        future = pool.submit(lambda: run.step(1_000_000, timeout=DEADLINE_S).point)
        seen = {run.status.point}
        while not future.done():
            seen.add(run.status.point)

        assert future.result() == 1_000_000
        assert run.status.state == "paused"
    assert len([point for point in seen if 0 < point < 1_000_000]) > 1


def test_a_pause_by_another_program_ends_the_wait_for_a_step() -> None:
    with steered(stop_time=None).start(record=None, paused=True) as run, fmu_mesh.attach(wait=DEADLINE_S) as other:
        with stepping(run, LONG) as end:
            paused = other.pause().point
            words = f"pauses at point {paused}, before point {LONG}: another program controls it too"
            with pytest.raises(fmu_mesh.MeshLost, match=words):
                end()
        with stepping(run, LONG) as end:
            other.resume()
            with pytest.raises(fmu_mesh.MeshLost, match=r"is running at point \d+, and does not come to rest any more"):
                end()


@pytest.mark.parametrize(
    ("stop_time", "error", "words"),
    [
        (None, fmu_mesh.MeshLost, "is stopping at point .*, and does not come to rest any more"),
        (1e6, fmu_mesh.Interrupted, "has failed and does not come to rest: stopped by a command before its stop time"),
    ],
    ids=["endless", "with_stop_time"],
)
def test_a_stop_ends_the_wait_for_a_step(stop_time: float | None, error: type[Exception], words: str) -> None:
    with (
        steered(stop_time=stop_time).start(record=None, paused=True) as run,
        fmu_mesh.attach(wait=DEADLINE_S) as other,
        stepping(run, LONG) as end,
    ):
        assert other.stop() is not None
        with pytest.raises(error, match=words):
            end()


def test_a_step_that_fails_says_which_instance_and_point(folder: Path) -> None:
    with slow(folder, fail_at=0.5).start(record=None, paused=True) as run:
        with pytest.raises(fmu_mesh.StepFailed, match="mesh 'slow' has failed and does not come to rest: ") as caught:
            run.step(100)
        assert (caught.value.instance, caught.value.point) == ("slow", 5)


def test_a_step_to_the_last_point_returns_and_one_beyond_is_told() -> None:
    with built(stop_time=1.0).start(record="memory", paused=True) as run:
        assert run.step(1000).point == 1000
        assert len(run.wait(DEADLINE_S).times) == 1001
    words = "is stopping at point 1000, and does not come to rest any more"
    with built(stop_time=1.0).start(record=None, paused=True) as run, pytest.raises(fmu_mesh.MeshLost, match=words):
        run.step(1001)


def test_a_step_that_takes_too_long_says_what_it_waits_for(folder: Path) -> None:
    with slow(folder).start(record=None, paused=True) as run:
        words = r"is at point \d+, on its way to point 10000, where .* rest; node 'slow' is at point \d+\. A larger"
        began = time.monotonic()
        with pytest.raises(fmu_mesh.DeadlineExceeded, match=words):
            run.step(LONG, timeout=0.5)
        assert time.monotonic() - began < TIMEOUT_S
        assert run.pause().point < LONG


def test_a_master_that_is_stopped_or_gone_ends_the_wait_in_time(place: Place) -> None:
    config = write_config(place.folder, stop_time=1e6, simulation={"real_time_factor": 1.0, "step_size": 0.01})
    launched = place.start("launch", config, "--no-progress", "--paused")
    place.note()
    with fmu_mesh.attach("pair") as run:
        run.wait_for("paused")
        master = run.info().pid
        os.kill(master, signal.SIGSTOP)
        try:
            with pytest.raises(fmu_mesh.DeadlineExceeded, match=r"no answer from mesh 'pair' within 0\.5 s"):
                run.step(1, timeout=0.5)
        finally:
            os.kill(master, signal.SIGCONT)
        with ThreadPoolExecutor(1) as pool:
            future = pool.submit(run.step, LONG, timeout=10 * DEADLINE_S)
            wait_until(lambda: run.status.point > 1, "a step under way")
            os.kill(master, signal.SIGKILL)
            with pytest.raises(fmu_mesh.MeshLost, match="mesh 'pair' has ended"):
                future.result(DEADLINE_S)
    assert launched.wait() == 4
