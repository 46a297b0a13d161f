"""What a master tells its launcher, while that reads and while it does not."""

from __future__ import annotations

import contextlib
import os
import threading

from fmu_mesh.run.events import Event, EventWriter, Status, decode_event
from fmu_mesh.run.outcome import Outcome
from fmu_mesh.wire.views import MeshStatus
from tests.helpers import DEADLINE_S, wait_until


def fill(pipe: int) -> None:
    """Write blanks, which mean nothing before an event, until no more fit."""
    os.set_blocking(pipe, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(pipe, b" " * 4096)
    os.set_blocking(pipe, True)


def status(point: int) -> MeshStatus:
    return MeshStatus(
        mesh="pair",
        state="running",
        point=point,
        last_point=100_000,
        time=0.0,
        points_per_second=0.0,
        real_time_factor=0.0,
        progress={},
        error=None,
        overruns=0,
    )


def test_a_master_whose_launcher_reads_nothing_keeps_the_newest_status_and_end() -> None:
    reading, writing = os.pipe()
    fill(writing)
    emit = EventWriter(writing)
    told: list[int] = []
    count = 1000

    def run() -> None:
        for point in range(count):
            emit(Status(status(point)))
            told.append(point)
        emit(Outcome("done", count, 0.0, 1.0, 0, None))

    master = threading.Thread(target=run, daemon=True)
    master.start()
    wait_until(lambda: len(told) == count, "all statuses told to nobody")
    assert master.is_alive()  # the end waits to be read

    events: list[Event] = []
    with open(reading, "rb") as pipe:  # noqa: PTH123 a descriptor
        for line in pipe:
            events.append(decode_event(line))
            if isinstance(events[-1], Outcome):
                break
    master.join(DEADLINE_S)
    os.close(writing)

    assert not master.is_alive()
    points = [event.status.point for event in events if isinstance(event, Status)]
    assert len(points) <= 2  # the one that was being written, and the newest
    assert points[-1] == count - 1


def test_a_launcher_that_is_gone_keeps_nobody_waiting() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    emit = EventWriter(writing)

    emit(Status(status(0)))
    emit(Outcome("done", 1, 0.0, 1.0, 0, None))

    os.close(writing)
