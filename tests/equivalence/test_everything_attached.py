"""All that one can attach to a run changes no float of it: watchers, a dashboard, Foxglove, pauses and three files."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fmu_mesh
from tests.dashboards import Dashboard
from tests.foxglove_client import FoxgloveClient
from tests.helpers import BY_STREAMS, BY_ZENOH, DEADLINE_S, Place, braked, wait_until, write_config

FILES = ("all.csv", "all.parquet", "bag.mcap")
EVERYTHING = ["*", "in:*", "param:*.k"]


def config(folder: Path, way: Mapping[str, bool]) -> Path:
    """A pendulum, a delay, a brake, and gains that a scenario and people may drive; three recorders."""
    folder.mkdir(exist_ok=True)
    instances: Mapping[str, Mapping[str, Any]] = {
        **braked(folder),
        "driven": {"fmu": "Gain"},
        "slow": {"fmu": "Gain", "step_size": 0.005},
    }
    return write_config(
        folder,
        instances=instances,
        connections=("pendulum.a -> delay.x", "driven.y -> slow.u"),
        stop_time=20.0,
        simulation={"window": 64},
        record=[  # type: ignore[arg-type]  # a list, as a file may have it
            {"file": "all.csv", "variables": EVERYTHING},
            {"file": "all.parquet", "variables": EVERYTHING, "every": 7},
            {"file": "bag.mcap", "from": 3.0},
        ],
        scenario={
            "values": {"driven.u": {"times": [0, 4, 15], "values": [0, 5, -3], "interpolation": "linear"}},
            "events": [{"at": 2.0, "set": {"slow.k": 0.5}}, {"at": 11.1, "set": {"slow.k": 2.5}}],
        },
        zenoh=way,
    )


@pytest.mark.parametrize("way", [{}, BY_STREAMS, BY_ZENOH], ids=["shared memory", "streams", "zenoh"])
def test_a_run_with_everything_attached_is_that_of_one_process(place: Place, way: Mapping[str, bool]) -> None:
    alone = config(place.folder / "alone", way)
    assert place.run("launch", alone, "--local", "--no-progress").wait() == 0
    watched = config(place.folder / "watched", way)

    mesh = place.start("launch", watched, "--paused", "--no-progress")
    place.note()
    dashboard = Dashboard(place)
    watcher = place.start("watch", "pair/*.*", "--json")
    served = place.start("foxglove", "pair", "--port", "0")
    [url] = wait_until(
        lambda: re.findall(r"ws://127\.0\.0\.1:\d+/\?token=[\w-]+", served.output)[:1], "the address of the server"
    )
    with FoxgloveClient(url) as client:
        client.until(lambda: {"/pendulum/a", "/slow/y"} <= {*client.channels}, "the topics")
        client.subscribe("/pendulum/a", "/slow/y")
        for _ in range(3):
            place.run("step", "pair", "400")
            place.run("resume", "pair")
            assert dashboard.curves("fmu_mesh/pair", pendulum__a=0) is not None
            place.run("get", "pair/pendulum.a", "slow.k")
            place.run("pause", "pair")
        place.run("resume", "pair")
        client.until(lambda: client.messages["/pendulum/a"], "values")
        assert mesh.wait(DEADLINE_S) == 0
    assert watcher.wait(DEADLINE_S) == 0
    assert len(watcher.output.splitlines()) > 100

    assert (watched.parent / "all.csv").read_bytes() == (alone.parent / "all.csv").read_bytes()
    for name in FILES[1:]:
        one, other = (fmu_mesh.Result.read(path.parent / name) for path in (alone, watched))
        assert other.times.tobytes() == one.times.tobytes()
        assert [*other] == [*one]
        assert all(np.array_equal(other[column], one[column], equal_nan=True) for column in one)
    shutil.rmtree(alone.parent)
