"""Processes of a batch that crash, hang, are stopped or killed: which copies have ended, why, and what goes on."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil
import pytest

import fmu_mesh
from fmu_mesh.wire.runtime import runtime_folder
from tests.fmus.chatty_fmus import chatty_fmu
from tests.helpers import FMUS, wait_until

H = 0.01
NEVER = 1e300


def faulty_mesh(faulty: Path) -> fmu_mesh.Mesh:
    mesh = fmu_mesh.Mesh("faults", step_size=H, stop_time=None)
    mesh.add("source", fmu=str(FMUS / "Integrator.fmu"), start_values={"y": 1.0})
    mesh.add("faulty", fmu=str(faulty))
    mesh.connect("source.y", "faulty.u")
    return mesh


def processes() -> list[psutil.Process]:
    """Those with copies, in the order of their copies."""
    titles = {own: title for own, title in below().items() if title.startswith("fmu-mesh copies ")}
    return sorted(titles, key=lambda own: int(titles[own].split()[2].split(":")[0]))


def below() -> dict[psutil.Process, str]:
    """The processes of a batch that this one has started, and their titles."""
    titles = {}
    for own in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):  # it has ended
            titles[own] = " ".join(own.cmdline())
    return {own: title for own, title in titles.items() if title.startswith("fmu-mesh ") or "fmu_mesh.run" in title}


def seconds_in(reason: str, why: str) -> float:
    """How long a process has done nothing, as the reason says; that of a start would be a minute."""
    found = re.search(rf"{re.escape(why)} for ([\d.]+) s", reason)
    assert found is not None, reason
    return float(found[1])


@pytest.fixture
def nothing_is_left() -> Iterator[None]:
    """After the test no process and no file of a batch is there."""
    yield
    wait_until(lambda: not below(), "the end of all processes")
    assert not [*runtime_folder().glob(f"*.{os.getpid()}-*")]


@pytest.mark.usefixtures("nothing_is_left")
@pytest.mark.parametrize(
    ("what", "words"),
    [("crash_at", r"ended its process in doStep \(SIGABRT\)"), ("hang_at", "has not returned for .* s from doStep")],
)
def test_only_copies_of_a_lost_process_end_and_others_go_on(faulty: Path, what: str, words: str) -> None:
    when = [NEVER, 0.05, NEVER, NEVER]
    with faulty_mesh(faulty).batch(4, config_values={"timeouts.step": 1.0}, processes=2) as batch:
        batch.reset(start_values={f"faulty.{what}": when})
        batch.step(3)
        batch.step(20)

        assert batch.done.tolist() == [True, True, False, False]
        assert batch.point.tolist()[1:] == [5, 23, 23]
        assert sorted(batch.reasons) == [0, 1]
        assert batch.reasons[1].startswith("instance faulty, point 5, t = 0.05 s: the FMU")
        assert "of copies 0 to 1 has ended, because of copy 1: instance faulty, point 5" in batch.reasons[0]
        for reason in batch.reasons.values():
            assert re.search(words, reason), reason
        out = np.full(4, -1.0)
        batch.get("source.y", out=out)
        assert np.isnan(batch.get("source.y")).tolist() == [True, True, False, False]
        assert out.tolist()[:2] == [-1.0, -1.0]

        batch.reset([False, True, False, False])
        batch.step(2)
        assert batch.done.tolist() == [True, False, False, False]
        assert batch.point.tolist()[1:] == [2, 25, 25]
        assert [*batch.reasons] == [0]
        with faulty_mesh(faulty).open() as system:
            system.step(2)
            assert batch.get("source.y")[1] == system.get("source.y")
            system.step(23)
            assert batch.get("source.y").tolist()[2:] == [system.get("source.y")] * 2
        batch.reset()
        assert not batch.reasons


@pytest.mark.usefixtures("nothing_is_left")
def test_a_killed_process_is_told_and_its_states_are_gone() -> None:
    with fmu_mesh.load("configs/cart_pole.yaml").batch(4, processes=2) as batch:
        batch.step(3)
        state = batch.save()
        batch.step(3)
        first, _ = processes()
        first.kill()
        first.wait()
        wait_until(lambda: any(batch.done), "the end of its copies")

        assert batch.done.tolist() == [True, True, False, False]
        assert batch.reasons[0].startswith("point 6, t = ")
        assert "the process of copies 0 to 1 was ended by SIGKILL" in batch.reasons[1]
        batch.restore(state, [False, False, True, True])
        batch.set("cart.force", 1.0)
        batch.step()
        assert batch.point.tolist() == [6, 6, 4, 4]
        with pytest.raises(fmu_mesh.CallRefused, match="the states of copies 0 to 1 are gone"):
            batch.restore(state)
        batch.reset([True, False, False, False])
        with pytest.raises(fmu_mesh.CallRefused, match="the states of copies 0 to 1 are gone"):
            batch.restore(state)
        state.close()
        with batch.save() as again:
            batch.step()
            batch.restore(again)
        assert batch.point.tolist() == [0, 6, 4, 4]


@pytest.mark.usefixtures("nothing_is_left")
def test_a_lost_fork_server_is_replaced_by_reset(faulty: Path) -> None:
    with faulty_mesh(faulty).batch(4, processes=2) as batch:
        before = processes()
        server = before[0].parent()
        assert server is not None
        server.kill()
        wait_until(lambda: all(batch.done), "the end of all copies")
        assert len(batch.reasons) == 4
        batch.reset()
        batch.step(3)
        assert batch.point.tolist() == [3] * 4
        assert not {own.pid for own in before} & {own.pid for own in processes()}


@pytest.mark.usefixtures("nothing_is_left")
def test_a_stopped_process_is_ended_after_the_time_of_a_step(faulty: Path) -> None:
    with faulty_mesh(faulty).batch(2, config_values={"timeouts.step": 1.5}, processes=2) as batch:
        batch.step()
        processes()[1].suspend()
        batch.step()
        assert batch.done.tolist() == [False, True]
        assert 1.5 <= seconds_in(batch.reasons[1], "is stopped (state T)") < 15.0


@pytest.mark.usefixtures("nothing_is_left")
def test_a_component_that_keeps_the_interpreter_is_ended(tmp_path: Path) -> None:
    (tmp_path / "busy.py").write_text(
        "import ctypes, fmu_mesh\n"
        "class Busy(fmu_mesh.Component):\n"
        "    y = fmu_mesh.Output(0.0)\n"
        "    def step(self, time, step_size):\n"
        "        ctypes.PyDLL(None).sleep(600 if time > 0.02 else 0)\n"
    )
    (tmp_path / "busy.yaml").write_text(
        "{mesh: busy, simulation: {stop_time: 1.0, step_size: 0.01}, instances: {busy: {python: 'busy.py:Busy'}}}"
    )
    mesh = fmu_mesh.load(tmp_path / "busy.yaml")
    with mesh.batch(2, config_values={"timeouts.step": 1.5}, processes=2) as batch:
        batch.step(5)
        assert batch.done.all()
        assert 1.5 <= seconds_in(batch.reasons[0], "does not answer, because a component does not let it") < 15.0


@pytest.mark.usefixtures("nothing_is_left")
def test_ctrl_c_for_the_processes_is_ignored(faulty: Path) -> None:
    with faulty_mesh(faulty).batch(2, processes=2) as batch:
        for own in processes():
            own.send_signal(signal.SIGINT)
        batch.step(3)
        assert batch.point.tolist() == [3, 3]


PROGRAM = """
import sys, time
import fmu_mesh
mesh = fmu_mesh.load("configs/cart_pole.yaml")
batch = mesh.batch(4, processes=2)  # without a guard of __main__
batch.step()
print("stepped", batch.point.tolist(), flush=True)
if sys.argv[1] == "waits":
    time.sleep(600)
if sys.argv[1] == "steps":
    batch.step(2**40)
"""


@pytest.mark.parametrize("how", ["ends", "waits", "steps"])
def test_nothing_is_left_of_a_program_that_ends_or_is_killed(how: str, tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    environment = os.environ | {"FMU_MESH_RUNTIME_DIR": f"{tmp_path}/run", "TMPDIR": str(tmp_path)}
    with subprocess.Popen([sys.executable, program, how], stdout=subprocess.PIPE, text=True, env=environment) as own:
        assert own.stdout is not None
        assert own.stdout.readline() == "stepped [1, 1, 1, 1]\n"
        started = psutil.Process(own.pid).children(recursive=True) if how != "ends" else []
        assert len(started) == (3 if how != "ends" else 0)
        if how != "ends":
            own.kill()
        assert own.wait(30) == (0 if how == "ends" else -signal.SIGKILL)
    wait_until(lambda: not any(one.is_running() for one in started), "the end of all processes")
    wait_until(lambda: [*tmp_path.rglob("*.fmu"), *tmp_path.glob("run/*")] == [], "the end of all files")
    assert [one.name for one in tmp_path.iterdir() if one.name.startswith("fmu_mesh-")] == []


@pytest.mark.usefixtures("nothing_is_left")
def test_the_last_reference_may_go_on_another_thread(faulty: Path) -> None:
    owned = [faulty_mesh(faulty).batch(2, processes=2)]
    thread = threading.Thread(target=owned.clear)
    thread.start()
    thread.join()


@pytest.mark.usefixtures("nothing_is_left")
@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("abort();", r"ended its process in fmi2\w+ \(SIGABRT\)"),
        ("for (volatile int i = 0;; i = 1 - i) {}", r"has not returned for 1\.\d s"),
    ],
)
def test_an_fmu_that_fails_at_start_is_told(tmp_path: Path, what: str, words: str) -> None:
    once = f'if (strcmp(function, "fmi2EnterInitializationMode") == 0) {{ {what} }}'
    mesh = fmu_mesh.Mesh("faults", step_size=H, stop_time=1.0)
    mesh.add("pump", fmu=str(chatty_fmu(2, tmp_path, "co_simulation", once)))
    with pytest.raises(fmu_mesh.FmuError, match=words) as raised:
        mesh.batch(2, config_values={"timeouts.call": 1.0}, processes=2)
    assert raised.value.instance == "pump"
