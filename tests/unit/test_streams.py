"""Streams of a variable: each sample has the value of its point."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from fmu_mesh.node.streams import InstanceStreams
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.layout import Layout
from fmu_mesh.variables.model_description import Variable
from fmu_mesh.wire.keys import Keys


def watched_streams(runner: Any) -> InstanceStreams:  # noqa: ANN401  what a runner has of it
    """The streams of a runner whose variables all have a subscriber."""
    publisher = SimpleNamespace(
        matching_status=SimpleNamespace(matching=True), declare_matching_listener=lambda _changed: None
    )
    session: Any = SimpleNamespace(declare_publisher=lambda *_, **__: publisher)
    grid = TimeGrid(start_time=0.0, step_size=0.1, last_point=100)
    return InstanceStreams(runner, session, Keys("fmu_mesh", "m"), grid, lambda _streams: None)


def test_rows_that_were_overwritten_before_they_were_read_are_dropped() -> None:
    variable = Variable("y", 0, "Float64", "output", "continuous")
    outputs = Ring(Layout.of([variable]), 4)
    description = SimpleNamespace(variables=[variable])
    runner = SimpleNamespace(
        name="a", outputs=outputs, watched=None, step=0, instance=SimpleNamespace(description=description)
    )
    streams = watched_streams(runner)
    streams.update()

    for row in range(10):
        outputs.put(row, "y", float(row))
    runner.step = 9
    batch = streams.collect(0)

    assert batch is not None
    assert batch[1].tolist() == [6, 7, 8, 9]
    assert batch[2]["y"].tolist() == [6.0, 7.0, 8.0, 9.0]
    assert streams.take_dropped() == 6
