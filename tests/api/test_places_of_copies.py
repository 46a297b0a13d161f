"""Where copies of a batch are: in this process or in several, what is refused, and what comes back from them."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

import fmu_mesh
from tests.fmus.chatty_fmus import chatty_fmu
from tests.helpers import FMUS

H = 0.01


def gains() -> fmu_mesh.Mesh:
    mesh = fmu_mesh.Mesh("places", step_size=H, stop_time=1.0)
    mesh.add("gain", fmu=str(FMUS / "Gain.fmu"))
    return mesh


def places() -> list[str]:
    """The titles of the processes with copies."""
    titles = []
    for child in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):  # it is that of an earlier test, and has ended
            titles.append(" ".join(child.cmdline()))
    return sorted(title for title in titles if title.startswith("fmu-mesh copies "))


@pytest.mark.parametrize(
    ("copies", "processors", "processes", "expected"),
    [(1023, 2, None, 0), (1024, 2, None, 2), (1024, 1, None, 0), (5, 1, 3, 3), (2, 1, 9, 2), (1024, 2, 1, 0)],
)
def test_many_copies_get_processes_and_few_do_not(
    monkeypatch: pytest.MonkeyPatch, copies: int, processors: int, processes: int | None, expected: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: {*range(processors)})
    with gains().batch(copies, processes=processes) as batch:
        assert len(places()) == expected
        batch.set("gain.u", 3.0)
        batch.step()
        assert set(batch.get("gain.y").tolist()) == {3.0}
    assert places() == []


def test_threads_and_processes_exclude_each_other() -> None:
    with pytest.raises(fmu_mesh.CallRefused, match="`threads=2` and `processes=2` exclude each other"):
        gains().batch(4, threads=2, processes=2)
    with gains().batch(4, threads=2, processes=1) as batch:
        batch.step()


def test_an_fmu_that_allows_one_instance_gets_processes(event_fmu: Callable[..., Path]) -> None:
    mesh = fmu_mesh.Mesh("places", step_size=H, stop_time=1.0)
    mesh.add("ball", fmu=str(event_fmu("Ball", 2, canBeInstantiatedOnlyOncePerProcess="true")), kind="co_simulation")
    for processes in (1, 2):
        with pytest.raises(fmu_mesh.ConfigurationError, match=r"cannot run in one process.* Give each copy a process"):
            mesh.batch(3, processes=processes)
    assert places() == []
    with mesh.batch(3, processes=3) as batch, mesh.open() as system:
        batch.step(20)
        system.step(20)
        assert batch.get("ball.h").tolist() == [system.get("ball.h")] * 3


def test_messages_of_models_come_back(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    logs = 'instance->logger(instance->environment, instance->name, fmi2Warning, "a", "the pump is dry");'
    once = f'if (strcmp(function, "fmi2DoStep") == 0 && instance->model.time > 0.05) {{ {logs} }}'
    mesh = fmu_mesh.Mesh("places", step_size=H, stop_time=1.0)
    mesh.add("pump", fmu=str(chatty_fmu(2, tmp_path, "co_simulation", once)))
    with caplog.at_level(logging.WARNING), mesh.batch(2, processes=2) as batch:
        batch.step(8)
    found = [record.getMessage() for record in caplog.records]
    assert found.count("fmu_message instance=pump category=a: the pump is dry") == 4


@pytest.mark.parametrize("processes", [1, 2])
def test_copies_that_do_not_fit_into_memory_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, processes: int
) -> None:
    # A MiB each, straight from the system: what malloc gives may be memory that the process already has.
    block = "void *mmap(void *, size_t, int, int, int, long); char *block = mmap(0, 1 << 20, 3, 0x22, -1, 0);"
    pages = "for (int at = 0; at < 1 << 20; at += 4096) ((volatile char *)block)[at] = 1;"
    takes = f'if (strstr(function, "ExitInit")) {{ {block} {pages} }}'
    mesh = fmu_mesh.Mesh("places", step_size=H, stop_time=1.0)
    mesh.add("tank", fmu=str(chatty_fmu(2, tmp_path, "co_simulation", takes)))
    system = os.sysconf
    monkeypatch.setattr(os, "sysconf", lambda name: 1 if name == "SC_AVPHYS_PAGES" else system(name))
    with pytest.raises(fmu_mesh.CallRefused, match=r"200 copies take about .* [0-9]{3,4} KiB each; 0\.0 GiB are free"):
        mesh.batch(200, processes=processes)
    assert places() == []


def recorded_mesh() -> fmu_mesh.Mesh:
    mesh = fmu_mesh.Mesh("recorded", step_size=H, stop_time=0.5)
    mesh.add("fast", fmu=str(FMUS / "Integrator.fmu"), start_values={"y": 1.0})
    mesh.add("slow", fmu=str(FMUS / "Integrator.fmu"), start_values={"k": -2.0}, step_size=3 * H)
    mesh.connect("fast.y", "slow.u")
    mesh.connect("slow.y", "fast.u")
    return mesh


@pytest.mark.parametrize("processes", [1, 2])
def test_results_of_copies_are_those_of_runs(processes: int) -> None:
    mesh, names = recorded_mesh(), ["slow.y", "fast.y", "fast.u"]
    with mesh.batch(3, record=names, processes=processes) as batch:
        batch.reset(start_values={"fast.y": [1.0, 2.0, 3.0]})
        for points in (1, 20, 100):
            batch.step(points)
        runs = [mesh.run(processes=False, record=names, start_values={"fast.y": 1.0 + copy}) for copy in range(3)]
        for copy, run in enumerate(runs):
            own = batch.result(copy)
            assert own.names == run.names == names
            assert own.times.tolist() == run.times.tolist()
            assert {name: own[name].tolist() for name in names} == {name: run[name].tolist() for name in names}
            assert own.units == run.units
            assert own.outcome is not None
            assert own.outcome.point == 50
        batch.reset([True, False, False])
        batch.step(4)
        assert batch.result(0).times.tolist() == batch.result(1).times.tolist()[:5]
        with batch.save() as state:
            batch.step(3)
            batch.restore(state)
        batch.step(1)
        assert batch.result(0).times.tolist() == runs[0].times.tolist()[4:6]


def test_a_failed_copy_has_its_rows_and_why(faulty: Path) -> None:
    mesh = fmu_mesh.Mesh("recorded", step_size=H, stop_time=None)
    mesh.add("faulty", fmu=str(faulty))
    for what, processes in (("fail_at", 1), ("crash_at", 2)):
        with mesh.batch(2, record="memory", processes=processes) as batch:
            batch.reset(start_values={f"faulty.{what}": [0.05, 1e300]})
            batch.step(20)
            result = batch.result(0)
            assert result.outcome is not None
            assert result.outcome.error is not None
            assert len(result.times) == batch.point[0] + 1 == 6
            assert len(batch.result(1).times) == 21


def test_rows_without_room_and_results_without_rows_are_refused() -> None:
    with gains().batch(10, record=["gain.y"], memory_limit=10 * 8 * 21) as batch:
        batch.step(20)
        with pytest.raises(fmu_mesh.CallRefused, match="the rows of 10 copies up to point 21 take 1760 bytes"):
            batch.step()
        assert batch.point.tolist() == [20] * 10
        batch.reset()
        batch.step(20)
        for copy in (10, -1, "a"):
            with pytest.raises(fmu_mesh.CallRefused, match="expected a number from 0 to 9"):
                batch.result(copy)  # type: ignore[arg-type]  # it is refused
    with gains().batch(1) as batch, pytest.raises(fmu_mesh.CallRefused, match="records nothing"):
        batch.result(0)
