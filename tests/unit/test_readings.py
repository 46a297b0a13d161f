"""What a reader still gets once the mesh has said that it has ended."""

from __future__ import annotations

import queue
import threading

from fmu_mesh.wire.client.readings import latecomers


def test_what_comes_behind_the_end_is_taken_until_nothing_comes() -> None:
    arrived: queue.SimpleQueue[int] = queue.SimpleQueue()
    arrived.put(1)
    late = latecomers(arrived)

    assert next(late) == 1
    timer = threading.Timer(0.05, arrived.put, [2])
    timer.start()
    rest = list(late)
    timer.join()

    assert rest == [2]
