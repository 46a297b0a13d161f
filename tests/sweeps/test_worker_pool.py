"""What starts the workers of a sweep: a fork of the program where that is as good as a new process, or a program."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import psutil
import pytest

import fmu_mesh
from tests.helpers import DEADLINE_S, FMUS, wait_until, write_config

PROGRAM = """
import json, os, signal, sys, threading
from fmu_mesh.sweeps.worker_pool import WorkerPool
import fmu_mesh, psutil

config, folder, before, fmu = sys.argv[1:]

def look(descriptor):
    return os.readlink(f"/proc/self/fd/{descriptor}")

if __name__ == "__main__":
    reading, writing = os.pipe()
    match before:
        case "a thread":
            threading.Thread(target=threading.Event().wait, daemon=True).start()
        case "a model":
            fmu_mesh.load(config).run(record="memory", processes=False)
        case "a sweep":
            with fmu_mesh.sweep(config, {"pendulum.d": [0.1, 0.2]}, folder="before", workers=2) as running:
                running.wait()
        case "FMPy":
            import fmpy
            model = fmpy.instantiate_fmu(fmpy.extract(fmu), fmpy.read_model_description(fmu, validate=False))
        case "a comma":
            import ctypes, locale
            locale.setlocale = lambda *_: "de_DE.UTF-8"
    with WorkerPool(1) as pool:
        server = psutil.Process(pool.pids[0] if pool.submit(abs, -1).result() else 0).parent()
        found = {"forked": "serve(" not in server.cmdline()[-1], "pipe": pool.submit(look, writing).result()}
        found["of program"] = server.ppid() == os.getpid()
    with fmu_mesh.sweep(config, {"pendulum.d": [0.1, 0.2, 0.4]}, folder=folder, workers=2, curves=False) as running:
        found["values"] = [row.values for row in running.wait()]
        found["messages"] = [row.message for row in running.result]
    found["left"] = [child.cmdline() for child in psutil.Process().children(recursive=True)]
    print(json.dumps(found))
"""


def told(tmp_path: Path, before: str) -> dict[str, Any]:
    """What the program has found, in a process of its own: that of the tests has threads."""
    (tmp_path / "program.py").write_text(PROGRAM)
    command = [sys.executable, "program.py", str(write_config(tmp_path)), "swept", before, str(FMUS / "Gain.fmu")]
    done = subprocess.run(command, cwd=tmp_path, check=False, capture_output=True, text=True, timeout=DEADLINE_S)
    assert (done.returncode, done.stderr) == (0, "")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.parametrize("before", ["nothing", "a sweep", "a thread", "a model", "FMPy", "a comma"])
def test_the_program_is_forked_only_where_that_changes_nothing(tmp_path: Path, before: str) -> None:
    found = told(tmp_path, before)

    is_forked = before in {"nothing", "a sweep"}
    assert found["forked"] is is_forked
    assert found["of program"]
    if is_forked:
        assert found["pipe"] == "/dev/null"
        assert not found["left"]
    with fmu_mesh.load(tmp_path / "pair.yaml").repeated() as runs:
        plain = [runs.run(start_values={"pendulum.d": d}) for d in (0.1, 0.2, 0.4)]
    assert found["values"] == [{f"last({name})": float(run[name][-1]) for name in run} for run in plain]
    assert found["messages"] == ["", "", ""]


@pytest.mark.parametrize("before", ["nothing", "a thread"])
def test_the_workers_end_with_a_program_that_is_killed(tmp_path: Path, before: str) -> None:
    waits = "print(pool.submit(os.getpid).result(), flush=True); pool.submit(signal.pause).result(); server ="
    text = PROGRAM.replace("server =", waits)
    (tmp_path / "program.py").write_text(text)
    command = [sys.executable, "program.py", str(write_config(tmp_path)), "swept", before, str(FMUS / "Gain.fmu")]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        worker = psutil.Process(int(program.stdout.readline()))
        family = [worker, *worker.parents()[:1]]
        program.send_signal(signal.SIGKILL)
        assert program.wait(DEADLINE_S) == -signal.SIGKILL
        wait_until(lambda: not any(one.is_running() for one in family), "the end of server and worker")
