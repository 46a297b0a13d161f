"""What goes wrong with the run of a program: an exception with its fields, what was recorded, and nothing left."""

from __future__ import annotations

import signal
import sys
import threading
from pathlib import Path

import pytest

import fmu_mesh
from tests.api.test_runs import steered
from tests.helpers import DEADLINE_S, FMUS, Place, wait_until


def failing(faulty: Path, **start_values: float) -> fmu_mesh.Mesh:
    mesh = fmu_mesh.Mesh("fails", step_size=0.001, stop_time=2.0)
    mesh.add("pendulum", fmu=FMUS / "DampedPendulum.fmu")
    mesh.add("faulty", fmu=faulty, start_values=start_values)
    mesh.connect("pendulum.a", "faulty.u")
    return mesh


@pytest.mark.parametrize("processes", [True, False])
def test_a_file_that_is_not_there_is_an_error_at_once(*, processes: bool) -> None:
    with pytest.raises(fmu_mesh.ConfigurationError, match="no such file"):
        fmu_mesh.load("nothing.yaml").run(processes=processes)


@pytest.mark.parametrize("processes", [True, False])
def test_a_failing_fmu_is_named_with_its_point_and_rows_are_kept(faulty: Path, *, processes: bool) -> None:
    with pytest.raises(fmu_mesh.StepFailed) as caught:
        failing(faulty, fail_at=1.0).run(record="memory", processes=processes)

    error = caught.value
    assert (error.instance, error.point, error.time) == ("faulty", 1000, 1.0)
    assert "the reactor is empty" in error.message
    assert error.result.times.tolist() == [point * 0.001 for point in range(1001)]
    assert "in the `result` of this error" in str(error)
    assert error.result.outcome.state == "failed"


@pytest.mark.parametrize("processes", [True, False])
def test_an_fmu_that_hangs_is_named(faulty: Path, *, processes: bool) -> None:
    mesh = failing(faulty, hang_at=0.5)
    mesh.configure(timeouts={"step": 1.0})

    with pytest.raises(fmu_mesh.FmuError, match="has not returned for 1") as caught:
        mesh.run(record="memory", processes=processes)

    assert (caught.value.instance, caught.value.point) == ("faulty", 500)
    assert len(caught.value.result.times) == 501


def test_a_killed_node_is_named(place: Place) -> None:
    with steered().start(record="memory") as run:
        run.get("gain.y")
        [node] = place.processes("node")
        node.kill()
        with pytest.raises(fmu_mesh.MeshLost, match="node 'gain' was lost: its process was ended by SIGKILL") as caught:
            run.wait(DEADLINE_S)
        assert caught.value.instance == "gain"
        assert caught.value.result.outcome.state == "failed"
        with pytest.raises(fmu_mesh.MeshLost, match="has ended"):
            run.get("gain.y")
        assert run.status.state in ("running", "failed", "stopping")


def test_a_killed_node_is_started_again_if_asked(place: Place) -> None:
    numbers: list[int] = []
    mesh = fmu_mesh.Mesh("again", step_size=0.01, stop_time=1.0, real_time_factor=1.0)
    mesh.add("gain", fmu=FMUS / "Gain.fmu")
    with mesh.start(
        record="memory", restarts=1, on_event=lambda event: numbers.append(getattr(event, "number", 0))
    ) as run:
        run.get("gain.y")
        [node] = place.processes("node")
        node.kill()
        result = run.wait(DEADLINE_S)
    assert len(result.times) == 101
    assert 1 in numbers


def test_ctrl_c_ends_the_run_and_names_the_point(place: Place) -> None:
    script = place.folder / "waits.py"
    script.write_text(
        "import fmu_mesh\n"
        "mesh = fmu_mesh.Mesh('waits', step_size=0.01, stop_time=None, real_time_factor=1.0)\n"
        f"mesh.add('gain', fmu={str(FMUS / 'Gain.fmu')!r})\n"
        "try:\n"
        "    mesh.run(record='memory', on_progress=lambda status: status.point > 5 and print('runs', flush=True))\n"
        "except KeyboardInterrupt as error:\n"
        "    print(type(error).__name__, error.point > 5, len(error.result.times) > 5)\n"
    )
    program = place.start_command([sys.executable, str(script)])
    wait_until(lambda: "runs" in program.output, "a running mesh")
    program.signal(signal.SIGINT)

    assert program.wait() == 0
    assert program.output.splitlines()[-1] == "KeyboardInterrupted True True"
    assert not program.errors


@pytest.mark.parametrize("processes", [True, False])
def test_a_full_disk_ends_the_run(*, processes: bool) -> None:
    mesh = fmu_mesh.Mesh("full", step_size=0.001, stop_time=100.0)
    mesh.add("pendulum", fmu=FMUS / "DampedPendulum.fmu")
    with pytest.raises(fmu_mesh.ConfigurationError, match="'/dev/full' cannot be written: No space left") as caught:
        mesh.run(output="/dev/full", processes=processes)
    assert caught.value.result.outcome.rows == 0
    assert len(caught.value.result.times) == 0


def test_an_error_in_a_callback_ends_the_run_and_comes_out() -> None:
    def fail(_status: object) -> None:
        raise ZeroDivisionError("mine")

    with pytest.raises(ZeroDivisionError, match="mine"):
        steered().run(record="memory", on_progress=fail)


def test_a_closed_handle_says_so() -> None:
    run = steered().start(record="memory")
    run.close()
    run.close()
    with pytest.raises(fmu_mesh.CallRefused, match="is closed"):
        run.pause()


def test_a_run_in_this_process_cannot_be_reached() -> None:
    with steered().start(record="memory", processes=False) as run:
        with pytest.raises(fmu_mesh.CallRefused, match="is in this process"):
            run.get("gain.y")
        run.stop()
        assert run.wait(DEADLINE_S).outcome is not None


def test_what_cannot_be_set_says_why() -> None:
    with steered().start(record="memory", paused=True) as run:
        with pytest.raises(fmu_mesh.CallRefused, match="is no input and no parameter"):
            run.set("gain.y", 1.0)
        with pytest.raises(fmu_mesh.CallRefused, match="is no Real value for it; expected a number"):
            run.set("gain.u", "much")
        with pytest.raises(fmu_mesh.UnknownName, match=r"Did you mean 'gain'\?"):
            run.get("gian.y")
        assert len(run.samples("gain.*")) > 1
        for use in (run.get, lambda name: run.set(name, 1.0)):
            with pytest.raises(fmu_mesh.UnknownName, match=r"'gain\.\*' means \d+ variables: gain\.u"):
                use("gain.*")


def test_a_wait_has_an_end() -> None:
    with steered().start(record="memory") as run:
        with pytest.raises(fmu_mesh.DeadlineExceeded, match=r"has not ended within 0\.1 s"):
            run.wait(0.1)
        assert run.get("gain.y") == 0.0


def test_no_thread_of_a_run_is_left() -> None:
    before = threading.active_count()
    with steered().start(record="memory") as run:
        run.get("gain.y")
    wait_until(lambda: threading.active_count() <= before, "the end of all threads")


def test_another_system_is_told_that_linux_is_needed(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    program = (
        "import sys; sys.modules['fcntl'] = None\n"
        "import fmu_mesh\n"
        "try:\n"
        "    fmu_mesh.load\n"
        "except fmu_mesh.ConfigurationError as error:\n"
        "    print(error)\n"
    )
    done = place.start_command([sys.executable, "-c", program])
    assert (done.wait(), done.errors) == (0, "")
    assert done.output.startswith("fmu_mesh.load needs Linux: this system has no module `fcntl`. On Windows, ")

    monkeypatch.setattr(sys, "platform", "darwin")
    with pytest.raises(fmu_mesh.ConfigurationError, match="a mesh runs on Linux, and this system is 'darwin'"):
        steered().start(record="memory")
