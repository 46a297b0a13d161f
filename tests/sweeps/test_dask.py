"""Sweeps on Dask: a cluster of this host by the command, and one that somebody else has started."""

from __future__ import annotations

import csv
import re
import signal
import socket
import sys
from pathlib import Path

import psutil
import pytest

from tests.helpers import Launched, Place, wait_until, write_config

pytest.importorskip("distributed")

VARY = ("--vary", "pendulum.d=0.05:0.8:20", "--vary", "delay.d=0.1,0.2", "--reduce", "max(pendulum.a)")


@pytest.fixture
def whole(place: Place) -> Path:
    """The folder of a sweep on the processes of this host."""
    place.run("sweep", write_config(place.folder), *VARY, "--folder", "whole")
    return place.folder / "whole"


def table(folder: Path) -> list[list[str]]:
    """The table without its last two columns, which tell how a variant was run."""
    with (folder / "table.csv").open(newline="") as file:
        return [row[:-2] for row in csv.reader(file)]


def curves(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in (folder / "runs").iterdir()}


def dask_workers(launched: Launched) -> list[psutil.Process]:
    found = psutil.Process(launched.pid).children(recursive=True)
    return [process for process in found if process.cmdline() and process.cmdline()[0].startswith("dask worker")]


def rows(folder: Path) -> int:
    file = folder / "rows.jsonl"
    return file.read_bytes().count(b"\n") if file.exists() else 0


def greets(port: int) -> bool:
    """Whether whoever listens there speaks first, as Dask does where a connection is not encrypted."""
    with socket.create_connection(("127.0.0.1", port), timeout=1.0) as connection:
        try:
            return bool(connection.recv(1))
        except TimeoutError:
            return False


def test_a_killed_worker_of_dask_loses_nothing_and_nothing_is_left(place: Place, whole: Path) -> None:
    sweep = place.start("sweep", "pair.yaml", *VARY, "--folder", "dask", "--dask", "--workers", "2")
    folder = place.folder / "dask"
    wait_until(lambda: rows(folder) > 3, "some rows")
    workers = dask_workers(sweep)
    assert len(workers) == 2

    workers[0].send_signal(signal.SIGKILL)

    assert sweep.wait() == 0
    assert len(table(folder)) == 41
    assert table(folder) == table(whole)
    assert curves(folder) == curves(whole)
    place.assert_nothing_left()


def test_the_cluster_of_this_host_is_reached_by_its_own_keys_only(place: Place) -> None:
    vary = ("--vary", "pendulum.d=0.05:0.8:50000", "--no-curves")
    sweep = place.start("sweep", write_config(place.folder), *vary, "--folder", "dask", "--dask", "--workers", "1")
    wait_until(lambda: rows(place.folder / "dask") > 0, "a row")
    listening = [
        connection.laddr
        for process in (psutil.Process(sweep.pid), *psutil.Process(sweep.pid).children(recursive=True))
        for connection in process.net_connections(kind="tcp")
        if connection.status == psutil.CONN_LISTEN
    ]
    assert len(listening) > 2
    assert {address.ip for address in listening} == {"127.0.0.1"}
    assert [address.port for address in listening if greets(address.port)] == []

    sweep.signal(signal.SIGINT)
    assert sweep.wait() == 130
    place.assert_nothing_left(10.0)


def test_a_cluster_that_somebody_has_started_runs_variants(place: Place, whole: Path) -> None:
    scheduler = place.start_command(
        [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    )
    line = scheduler.wait_for_error_line("Scheduler at:")
    found = re.search(r"tcp://\S+", line)
    assert found is not None
    for _ in range(2):
        place.start_command(
            [sys.executable, "-m", "distributed.cli.dask_worker", found[0], "--nthreads", "1", "--no-dashboard"]
        )

    assert greets(int(found[0].rpartition(":")[2]))

    done = place.run("sweep", "pair.yaml", *VARY, "--folder", "dask", "--dask", found[0])

    assert done.wait() == 0
    assert table(place.folder / "dask") == table(whole)
    assert curves(place.folder / "dask") == curves(whole)


def test_a_scheduler_that_does_not_answer_is_told(place: Place) -> None:
    config = write_config(place.folder)

    done = place.run("sweep", config, *VARY, "--dask", "tcp://127.0.0.1:9")

    assert done.wait() == 4
    assert done.message.startswith("fmu-mesh: the Dask scheduler at 'tcp://127.0.0.1:9' does not answer")
