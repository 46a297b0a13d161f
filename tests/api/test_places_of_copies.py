"""Where copies of a batch are: in this process or in several, what is refused, and what comes back from them."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
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
    titles = [own.cmdline()[0] for own in psutil.Process().children(recursive=True)]
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
def test_copies_that_do_not_fit_into_memory_are_refused(monkeypatch: pytest.MonkeyPatch, processes: int) -> None:
    system = os.sysconf
    monkeypatch.setattr(os, "sysconf", lambda name: 1 if name == "SC_AVPHYS_PAGES" else system(name))
    with pytest.raises(fmu_mesh.CallRefused, match=r"200 copies take about .* KiB each; 0\.0 GiB are free"):
        gains().batch(200, processes=processes)
    assert places() == []
