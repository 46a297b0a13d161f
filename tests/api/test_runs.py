"""Runs in the hands of a program: looked into, steered, several at once, from threads and under asyncio."""

from __future__ import annotations

import asyncio
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

import fmu_mesh
from fmu_mesh.api.run_handle import TIMEOUT_S
from fmu_mesh.run.events import Event, Reachable, Status
from fmu_mesh.wire.views import MeshStatus
from tests.api.test_mesh_building import built, same
from tests.fmus.helpers import find_fmu
from tests.helpers import DEADLINE_S, FMUS, Place, write_config


def steered(stop_time: float | None = 60.0) -> fmu_mesh.Mesh:
    """A gain in real time, until it is stopped."""
    mesh = fmu_mesh.Mesh("steered", step_size=0.01, stop_time=stop_time, real_time_factor=1.0)
    mesh.add("gain", fmu=FMUS / "Gain.fmu")
    return mesh


def test_a_run_is_set_paused_stepped_resumed_and_stopped() -> None:
    with steered().start(record="memory", paused=True) as run:
        assert run.set("gain.u", 3.0).point == 0
        assert run.set("gain.k", 2.5, at=0.05).point == 5
        assert run.step(4).point == 4
        assert (run.get("gain.y"), run.status.point, run.status.state) == (3.0, 4, "paused")
        assert run.step(10).point == 14
        assert run.get("gain.y") == 7.5
        assert run.resume().state == "running"
        run.stop()
        result = run.wait(DEADLINE_S)

    assert result["gain.y"][:14].tolist() == [0.0] + [3.0] * 5 + [7.5] * 8
    assert result.outcome is not None
    assert result.outcome.rows == len(result.times)


def test_pauses_at_any_moment_hold_all_instances_at_one_point_without_changes() -> None:
    mesh = built(stop_time=None)
    with mesh.start(record=None) as run:
        for _ in range(20):
            paused = run.pause()
            assert {*run.status.progress.values()} == {paused.point}
            assert run.step(3).point == paused.point + 3
            run.resume()
        paused = run.pause()
        samples = {sample.name: sample.value for sample in run.samples("pendulum.a", "delay.y")}
        run.resume()
        run.stop()
    with mesh.open() as system:
        system.step(paused.point)
        assert {name: system.get(name) for name in samples} == samples


def test_a_pause_takes_effect_after_steps_under_way_however_large_window_is(tmp_path: Path) -> None:
    mesh = fmu_mesh.Mesh("slow", step_size=0.1, stop_time=1000.0)
    mesh.add("slow", fmu=find_fmu("Faulty", tmp_path), start_values={"slow": 0.02})
    with mesh.start(record=None) as run:
        run.wait_for("running")
        assert run.pause().point < 200
        run.stop()


def test_a_run_that_is_left_is_stopped() -> None:
    with steered(stop_time=None).start(record="memory") as run:
        assert run.status.state in ("starting", "initializing", "running")
    assert run.wait(DEADLINE_S).outcome is not None


def test_infos_and_samples_have_names_values_units_and_points() -> None:
    with steered().start(record="memory", paused=True) as run:
        assert run.info().instances == ("gain",)
        assert run.instance_info("gain").fmi_version == "2.0"
        assert run.instance_status("gain").instance == "gain"
        assert run.variables["gain.k"].variability == "tunable"
        run.step(3)
        assert {sample.name for sample in run.samples("gain.*")} == {"gain.u", "gain.k", "gain.y"}
        [sample] = run.samples("gain.y")
        assert sample == ("gain.y", 0.0, 3, 0.03, None)


def test_every_value_is_watched_until_the_end() -> None:
    mesh = built(stop_time=2.0)
    mesh.configure(simulation={"real_time_factor": 1.0})
    with mesh.start(record="memory", paused=True) as run:
        values = run.watch("delay.y", "pendulum.a")
        threading.Thread(target=run.resume).start()
        samples = list(values)
        result = run.wait(DEADLINE_S)

    for name in ("delay.y", "pendulum.a"):
        own = [sample for sample in samples if sample.name == name]
        assert own[-1].point == 2000
        assert [sample.value for sample in own] == [result[name][sample.point] for sample in own]


def test_a_mesh_that_somebody_else_started_is_found_and_followed(place: Place) -> None:
    config = write_config(place.folder, stop_time=1.0, simulation={"real_time_factor": 1.0})
    launched = place.start("launch", config, "--no-progress", "--paused")
    place.note()
    place.run("wait", "--state", "paused")

    with fmu_mesh.attach("pair") as run:
        run.resume()
        result = run.wait(DEADLINE_S)

    assert launched.wait() == 0
    assert same(result, fmu_mesh.Result.read(config.with_suffix(".csv")))
    with pytest.raises(fmu_mesh.ConfigurationError, match="no mesh is running here"):
        fmu_mesh.attach("pair")


def test_a_handle_that_was_attached_leaves_the_mesh_running() -> None:
    with steered().start(record="memory") as own:
        assert own.status.mesh == "steered"
        with fmu_mesh.attach() as other:
            assert other.name == "steered"
        with pytest.raises(fmu_mesh.CallRefused, match="this handle of mesh 'steered' is closed"):
            other.get("gain.y")
        assert own.get("gain.y") == 0.0


def test_arrays_and_texts_are_values_as_well(tmp_path: Path) -> None:
    mesh = fmu_mesh.Mesh("types", step_size=0.1, stop_time=None, real_time_factor=1.0)
    mesh.add("it", fmu=find_fmu("AllTypes3", tmp_path))
    with mesh.start(record="memory", paused=True) as run:
        views = run.variables
        arrays = {name for name, view in views.items() if view.shape}
        samples = {sample.name: sample.value for sample in run.samples("it.*")}
        assert all(
            isinstance(samples[name], np.ndarray) and samples[name].shape == views[name].shape for name in arrays
        )
        for name, view in views.items():
            if view.causality == "input" and view.key.startswith("in/"):
                run.set(name, samples[name])
        run.step(1)
        for name, value in {sample.name: sample.value for sample in run.samples("it.*")}.items():
            if views[name].causality == "input":
                assert np.array_equal(value, samples[name]), name
        assert {type(value) for value in samples.values()} >= {float, int, bool, str, bytes, np.ndarray}


def test_runs_one_after_the_other_and_at_once_are_apart() -> None:
    expected = built().run(record="memory")
    with built().start(record="memory") as one, built().start(record="memory") as two:
        assert same(one.wait(DEADLINE_S), expected)
        assert same(two.wait(DEADLINE_S), expected)
    assert same(built().run(record="memory", processes=False), expected)


def test_runs_in_this_process_at_once_are_apart() -> None:
    expected = built().run(record="memory")
    runs = [built().start(record="memory", processes=False) for _ in range(3)]
    for run in runs:
        assert same(run.wait(DEADLINE_S), expected)


def test_a_run_belongs_to_no_thread() -> None:
    results: list[fmu_mesh.Result] = []
    runs: list[fmu_mesh.Run] = []
    starter = threading.Thread(target=lambda: runs.append(built().start(record="memory")))
    starter.start()
    starter.join(DEADLINE_S)  # its children do not go with it
    waiters = [threading.Thread(target=lambda: results.append(runs[0].wait(DEADLINE_S))) for _ in range(2)]
    for waiter in waiters:
        waiter.start()
    for waiter in waiters:
        waiter.join(DEADLINE_S)
    assert same(results[0], results[1])
    assert same(results[0], built().run(record="memory"))


def test_two_threads_steer_one_run() -> None:
    with steered(stop_time=None).start(record="memory", paused=True) as run:
        problems: list[BaseException] = []

        def work(name: str, values: range) -> None:
            try:
                for value in values:
                    run.set(name, float(value))
                    run.get(name)
            except BaseException as error:  # noqa: BLE001  looked at below
                problems.append(error)

        threads = [threading.Thread(target=work, args=(name, range(20))) for name in ("gain.u", "gain.k")]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(DEADLINE_S)
        assert not problems
        run.step(2)
        assert run.get("gain.y") == 19.0 * 19.0


def test_asyncio_goes_on_while_a_run_is_waited_for() -> None:
    async def both() -> tuple[fmu_mesh.Result, int]:
        looks = 0
        with built(stop_time=0.3).start(record="memory", real_time_factor=1.0) as run:
            waiting = asyncio.ensure_future(run.wait_async())
            while not waiting.done():
                await asyncio.wait([waiting], timeout=0.01)
                looks += 1
            return waiting.result(), looks

    result, looks = asyncio.run(both())
    assert len(result.times) == 301
    assert looks > 10


def test_a_cancelled_wait_leaves_the_run() -> None:
    async def cancelled(run: fmu_mesh.Run) -> None:
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(run.wait_async(), 0.05)

    with steered(stop_time=None).start(record="memory") as run:
        asyncio.run(cancelled(run))
        assert run.get("gain.y") == 0.0


def test_a_host_is_told_by_its_id_and_not_by_its_name() -> None:
    with steered().start(record="memory", paused=True) as run:
        here = run.info()

    elsewhere = msgspec.structs.replace(here, host_id="another")

    assert (here.is_here, elsewhere.is_here) == (True, False)
    assert here.host == elsewhere.host


def test_one_of_several_meshes_is_found_by_its_name() -> None:
    other = fmu_mesh.Mesh("other", step_size=0.01, stop_time=1.0)
    other.add("gain", fmu=FMUS / "Gain.fmu")
    with steered().start(record="memory", paused=True) as first, other.start(record="memory", paused=True) as second:
        first.wait_for("paused")
        second.wait_for("paused")
        assert {status.mesh for status in fmu_mesh.meshes()} == {first.name, "other"}
        with fmu_mesh.attach("other", wait=10.0) as found:
            assert found.info().mesh == "other"
            assert found.step(5).point == 5
            assert [line.category for line in found.logs()] == ["audit"]  # of the step
            with pytest.raises(fmu_mesh.DeadlineExceeded, match="was not done in time"):
                found.wait_for("done", timeout=0.3)
            with pytest.raises(fmu_mesh.CallRefused, match="started by somebody else"):
                found.interrupt()
            assert found.stop() is not None
    with pytest.raises(fmu_mesh.DeadlineExceeded, match="there is no mesh 'other' after"):
        fmu_mesh.attach("other", wait=0.3)


def test_an_interrupted_run_raises_and_keeps_its_rows() -> None:
    with steered(stop_time=None).start(record="memory") as run:
        run.get("gain.y")
        run.interrupt()
        with pytest.raises(fmu_mesh.Interrupted) as caught:
            run.wait()
    assert len(caught.value.result.times) > 0


def test_events_and_progress_come_while_it_runs() -> None:
    events: list[Event] = []
    statuses: list[MeshStatus] = []
    built(stop_time=0.5).run(record="memory", real_time_factor=1.0, on_event=events.append, on_progress=statuses.append)
    assert any(isinstance(event, Reachable) for event in events)
    assert [event.status for event in events if isinstance(event, Status)] == statuses
    points = [status.point for status in statuses]
    assert points == sorted(points)
    assert any(0 < point < 500 for point in points)


def test_a_program_that_forgets_its_run_ends_it(place: Place) -> None:
    script = place.folder / "forgets.py"
    script.write_text(
        "import fmu_mesh\n"
        "mesh = fmu_mesh.Mesh('forgotten', step_size=0.01, stop_time=None, real_time_factor=1.0)\n"
        f"mesh.add('gain', fmu={str(FMUS / 'Gain.fmu')!r})\n"
        "run = mesh.start(record='memory')\n"
        "print(run.get('gain.y'))\n"
    )
    forgotten = place.start_command([sys.executable, str(script)])
    assert forgotten.wait() == 0
    assert forgotten.output == "0.0\n"
    assert not forgotten.errors


def asked_in_vain(run: fmu_mesh.Run) -> list[str]:
    """The errors of all questions and commands to a mesh that has ended."""
    questions: list[Callable[[], object]] = [
        run.info,
        run.all_status,
        run.pause,
        run.step,
        run.resume,
        lambda: run.variables,
        lambda: run.instance_info("gain"),
        lambda: run.instance_status("gain"),
        lambda: run.get("gain.y"),
        lambda: run.samples("gain.*"),
        lambda: run.set("gain.u", 1.0),
        lambda: run.watch("gain.y"),
        lambda: list(run.logs()),
        lambda: run.replay([]),
        lambda: run.wait_for("paused"),
        lambda: run.until_end().__enter__(),
    ]
    errors = []
    for question in questions:
        with pytest.raises(fmu_mesh.MeshLost) as caught:
            question()
        errors.append(str(caught.value))
    return errors


@pytest.mark.parametrize("processes", [True, False])
def test_a_run_that_has_ended_says_so_at_once(processes: bool) -> None:  # noqa: FBT001  a parameter of the test
    with steered(stop_time=0.1).start(record="memory", processes=processes) as run:
        result = run.wait(DEADLINE_S)
        began = time.monotonic()
        errors = asked_in_vain(run)
        took = time.monotonic() - began

    assert {*errors} == {"the run of mesh 'steered' has ended. Its values are in `run.wait()`."}
    assert took < TIMEOUT_S  # one question without an answer takes longer
    assert (run.status.state, run.status.point, run.wait_for("done")) == ("done", 10, run.status)
    assert run.stop() is None
    assert run.wait() is result


def test_a_run_that_has_failed_says_where_its_error_is(tmp_path: Path) -> None:
    mesh = fmu_mesh.Mesh("failing", step_size=0.1, stop_time=1.0)
    mesh.add("gain", fmu=find_fmu("Faulty", tmp_path), start_values={"fail_at": 0.5})
    run = mesh.start(record="memory", processes=False)
    with pytest.raises(fmu_mesh.FmuError):
        run.wait(DEADLINE_S)

    with pytest.raises(fmu_mesh.MeshLost, match=r"`run\.wait\(\)` raises why"):
        run.get("gain.y")
    assert run.status.state == "failed"


def test_a_question_under_way_ends_with_the_run() -> None:
    def look_for_ever(run: fmu_mesh.Run) -> None:
        while True:
            run.get("delay.y")

    with built().start(record="memory") as run, pytest.raises(fmu_mesh.MeshLost) as caught:
        look_for_ever(run)

    assert str(caught.value) == "the run of mesh 'pair' has ended. Its values are in `run.wait()`."


def test_a_mesh_of_somebody_else_that_has_ended_says_so_at_once() -> None:
    with steered().start(record="memory", paused=True) as own:
        own.wait_for("paused")
        with fmu_mesh.attach("steered") as run:
            assert run.get("gain.y") == 0.0
            own.stop()
            own.wait(DEADLINE_S)
            began = time.monotonic()
            errors = asked_in_vain(run)
            took = time.monotonic() - began

    assert {*errors} == {"mesh 'steered' has ended"}
    assert took < TIMEOUT_S
