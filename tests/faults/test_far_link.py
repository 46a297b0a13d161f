"""The program that delays packets between two hosts: what it delays, loses and limits, and a mesh over it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from benchmarks import far
from benchmarks.far_link import FarLink, far_link, why_not
from tests.helpers import wait_until
from tests.network_hosts import started_hosts

pytestmark = pytest.mark.skipif(bool(why_not()), reason=why_not() or "it can be tried here")

ANSWERING = """
import socket
own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
own.bind(("10.77.0.1", 7000))
print("here", flush=True)
while True:
    data, asker = own.recvfrom(2000)
    own.sendto(data, asker)
"""

ASKING = """
import socket, sys, time
count, size = map(int, sys.argv[1:])
own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
own.settimeout(1.0)
begin = time.monotonic()
for number in range(count):
    own.sendto(number.to_bytes(size, "big"), ("10.77.0.1", 7000))
came = 0
try:
    while came < count:
        own.recv(2000)
        came += 1
        seconds = time.monotonic() - begin
except TimeoutError:
    pass
print(came, seconds)
"""


def echoes(folder: Path, link: FarLink, count: int, size: int = 8) -> tuple[int, float]:
    """How many of so many packets come back, and after how many seconds the last one."""
    with started_hosts(folder, wired=False) as (first, second), far_link([first.pid, second.pid], link):
        answering = first.start(sys.executable, "-c", ANSWERING)
        wait_until(lambda: "here" in answering.output, f"who answers; {answering.errors}")
        asking = second.start(sys.executable, "-c", ASKING, str(count), str(size))
        assert asking.wait() == 0, asking.story()
        came, seconds = asking.output.split()
        return int(came), float(seconds)


def test_a_round_trip_takes_at_least_the_delay(tmp_path: Path) -> None:
    came, seconds = echoes(tmp_path, FarLink(round_trip_ms=50.0), 1)

    assert came == 1
    assert seconds >= 0.05


def test_some_packets_are_lost(tmp_path: Path) -> None:
    came, _ = echoes(tmp_path, FarLink(round_trip_ms=0.0, loss_percent=50.0), 100)

    assert 0 < came < 100


def test_a_slow_line_takes_its_time_and_drops_what_is_too_much(tmp_path: Path) -> None:
    one = 1028 * 8 / 200e3

    came, seconds = echoes(tmp_path, FarLink(round_trip_ms=0.0, kbit_per_s=200.0), 50, 1000)

    assert 1 < came < 50
    assert seconds >= came * one


def test_a_cycle_over_a_far_network_equals_one_process(capsys: pytest.CaptureFixture[str]) -> None:
    assert far.main(["--delays", "5", "--jobs", "far_cycle", "--repeat", "1"]) == 0

    (row,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("  5 ms"))
    assert row.endswith("all bytes equal")
