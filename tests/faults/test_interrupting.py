"""Ctrl-C, SIGTERM and a stop by a person: the run ends within two seconds and leaves a readable partial result."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from tests.fmus.chatty_fmus import chatty_fmu
from tests.fmus.helpers import NO_COMPILER
from tests.helpers import DEADLINE_S, Place, braked, on_a_busy_machine, row_count, rows_of, wait_until, write_config

FAR_S = 1_000_000.0
SIGNALS = [signal.SIGINT, signal.SIGTERM]


_INTERRUPTED_WHILE_LOADING = """
import os, runpy, signal, sys

class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "MODULE":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Finder())
sys.argv = ["fmu-mesh", "check", "gone.yaml"]
runpy.run_module("fmu_mesh", run_name="__main__")
"""


def is_pending(pid: int, number: signal.Signals) -> bool:
    """Whether a signal waits for a process that is stopped (Linux)."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    waiting = next(line.split()[1] for line in status.splitlines() if line.startswith("ShdPnd:"))
    return bool(int(waiting, 16) >> (number - 1) & 1)


def test_ctrl_c_ends_the_run_within_two_seconds_without_an_answering_master(place: Place) -> None:
    config = write_config(place.folder, instances=braked(place.folder), stop_time=FAR_S)
    launched = place.start("launch", config)
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 1000, "1000 rows")
    launched.child("master").suspend()

    launched.signal(signal.SIGINT)

    assert launched.wait() == 130
    assert launched.ended_after_s < on_a_busy_machine(2.0)
    assert "interrupted" in launched.message
    place.assert_nothing_left()


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])
@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
def test_a_signal_ends_run_within_two_seconds_with_a_readable_partial_result(
    place: Place, number: signal.Signals, options: tuple[str, ...]
) -> None:
    config = write_config(place.folder, instances=braked(place.folder), stop_time=FAR_S)
    result = config.with_suffix(".csv")
    launched = place.start("launch", config, *options)
    wait_until(lambda: row_count(result) > 1000, "1000 rows")

    launched.signal(number)

    assert launched.wait() == 130
    assert launched.ended_after_s < on_a_busy_machine(2.0)
    place.assert_nothing_left()
    rows = rows_of(result)
    assert f"({len(rows)} rows) is in '{result}'" in launched.message
    assert f"point {len(rows) - 1}, t = " in launched.message


@pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
@pytest.mark.parametrize(("options", "rows"), [((), 10_000), (("--local",), 2000)], ids=["distributed", "local"])
def test_ctrl_c_ends_a_run_whose_fmu_logs_without_end(place: Place, options: tuple[str, ...], rows: int) -> None:
    instances = {**braked(place.folder), "chatty": {"fmu": str(chatty_fmu(2, place.folder, "co_simulation"))}}
    config = write_config(place.folder, instances=instances, stop_time=FAR_S)
    launched = place.start("launch", config, *options)
    wait_until(lambda: row_count(config.with_suffix(".csv")) > rows, f"{rows} rows")

    launched.signal(signal.SIGINT)

    assert launched.wait() == 130
    assert launched.ended_after_s < on_a_busy_machine(2.0)
    assert "not shown" in launched.errors
    assert len(launched.errors) < 100_000


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])
def test_a_run_that_is_interrupted_is_plotted_up_to_there(place: Place, options: tuple[str, ...]) -> None:
    config = write_config(place.folder, instances=braked(place.folder), stop_time=FAR_S)
    plot = place.folder / "run.png"
    launched = place.start("launch", config, *options, "--plot", plot)
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 1000, "1000 rows")

    launched.signal(signal.SIGINT)

    assert launched.wait() == 130
    assert f"plot: {plot}" in launched.output
    assert plot.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("module", ["fmu_mesh.cli.main", "fmu_mesh.cli.run_arguments", "fmu_mesh.cli.checking"])
def test_ctrl_c_while_command_is_being_loaded_is_told_like_any_other(module: str) -> None:
    program = [sys.executable, "-c", _INTERRUPTED_WHILE_LOADING.replace("MODULE", module)]

    done = subprocess.run(program, capture_output=True, text=True, check=False, timeout=DEADLINE_S)

    assert (done.returncode, done.stdout, done.stderr) == (130, "", "fmu-mesh: interrupted\n")


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="looks into /proc")
def test_a_second_ctrl_c_waits_for_nobody(place: Place) -> None:
    config = write_config(place.folder, instances=braked(place.folder), stop_time=FAR_S)
    result = config.with_suffix(".csv")
    launched = place.start("launch", config)
    wait_until(lambda: row_count(result) > 1000, "1000 rows")
    master = launched.child("master")
    master.suspend()  # so that it cannot do what the first one asks for

    launched.signal(signal.SIGINT)
    wait_until(lambda: is_pending(master.pid, signal.SIGTERM), "what the launcher makes of the first one")
    launched.signal(signal.SIGINT)

    assert launched.wait() == 130
    assert launched.ended_after_s < on_a_busy_machine(2.0)
    assert "interrupted" in launched.message
    place.assert_nothing_left()
    assert rows_of(result)


def test_ctrl_c_before_the_first_point_ends_the_run_too(place: Place) -> None:
    launched = place.start("launch", write_config(place.folder, stop_time=FAR_S))
    launched.child("delay")

    launched.signal(signal.SIGINT)

    assert launched.wait() == 130
    assert launched.ended_after_s < on_a_busy_machine(2.0)
    assert "interrupted" in launched.message
    place.assert_nothing_left()


def test_ctrl_c_ends_a_run_in_one_process_while_its_fmu_hangs(place: Place, faulty: Path) -> None:
    config = write_config(
        place.folder,
        instances={"faulty": {"fmu": str(faulty), "start_values": {"hang_at": 0.5}}},
        connections=[],
        stop_time=FAR_S,
    )
    launched = place.start("launch", config, "--local")
    wait_until(place.extracted, "an extracted FMU")
    process = psutil.Process(launched.pid)
    wait_until(lambda: process.status() == psutil.STATUS_SLEEPING, "the hang")

    launched.signal(signal.SIGINT)

    assert launched.wait() == 130
    assert launched.ended_after_s < on_a_busy_machine(2.0)
    place.assert_nothing_left()
