"""The gateway's own view of the mesh: what the coming and going of the master's token means to it."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any, cast

import pytest
import zenoh

from fmu_mesh.ros.gateway.gateway import Gateway
from fmu_mesh.ros_wire.topics import RosPlan
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.wire.keys import Keys
from tests.helpers import DEADLINE_S, wait_until

GONE, THERE = zenoh.SampleKind.DELETE, zenoh.SampleKind.PUT


def run_while_samples_come(*tokens: zenoh.SampleKind) -> bool:
    """Whether a gateway that is told this, all before it looks, ends though the samples of the mesh go on and on."""
    nothing: Any = None
    plan = RosPlan(nothing)
    gateway = Gateway(plan, nothing, Keys("fmu_mesh", "lab"), TimeGrid(0.0, 0.1, 1000))
    port = SimpleNamespace(instance="a", kind="out", variable=SimpleNamespace(name="y"), step_points=1)
    gateway._watch(cast("Any", port))
    for kind in tokens:
        gateway._token_changed(cast("zenoh.Sample", SimpleNamespace(kind=kind)))
    over = threading.Event()
    carried: list[int] = []

    def another_sample() -> None:
        carried.append(len(carried))
        if not over.wait(0.001):
            gateway._events.put(another_sample)

    gateway._events.put(another_sample)
    thread = threading.Thread(target=gateway.run)
    thread.start()
    wait_until(lambda: not thread.is_alive() or len(carried) >= 50, "its end, or 50 samples")
    ended = not thread.is_alive()
    over.set()
    gateway.end()
    thread.join(DEADLINE_S)
    assert not thread.is_alive()
    return ended


@pytest.mark.parametrize("tokens", [(THERE, GONE, THERE), (GONE, THERE)])
def test_mesh_that_let_go_of_it_and_is_there_again_ends_it(tokens: tuple[zenoh.SampleKind, ...]) -> None:
    assert run_while_samples_come(*tokens)


@pytest.mark.parametrize("tokens", [(), (THERE,), (THERE, THERE)])
def test_it_goes_on_as_long_as_the_mesh_is_there(tokens: tuple[zenoh.SampleKind, ...]) -> None:
    assert not run_while_samples_come(*tokens)


def test_late_samples_are_carried_as_long_as_they_come() -> None:
    assert not run_while_samples_come(THERE, GONE)
