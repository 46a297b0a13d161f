"""`examples/ros/path_filter/`: a bag that is played into the filter gives the floats of figure 18."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fmu_mesh
from tests.helpers import FMUS
from tests.ros.test_bag import messages_of

ROOT = FMUS.parent
EXAMPLE = ROOT / "examples" / "ros" / "path_filter"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clone with the results of the example."""
    clone = tmp_path_factory.mktemp("clone")
    for name in ("fmus", "configs"):
        (clone / name).symlink_to(ROOT / name)
    own = clone / "examples" / "ros" / "path_filter"
    own.mkdir(parents=True)
    for file in ("drive.yaml", "path_filter.yaml"):
        (own / file).write_bytes((EXAMPLE / file).read_bytes())
    (own / "msg").symlink_to(EXAMPLE / "msg")
    for file in ("drive.yaml", "path_filter.yaml"):
        fmu_mesh.load(own / file).run(processes=False)
    return clone / "results"


def test_played_command_gives_floats_of_figure_18_one_point_later(folder: Path) -> None:
    from_bag = fmu_mesh.Result.read(folder / "path_filter_ros.mcap")
    direct = fmu_mesh.load(ROOT / "configs" / "path_filter.yaml").run(processes=False, record="memory")

    # There, the vehicles step with the command at the end of a step; a bag sets it for the step that comes next.
    for vehicle in ("bare", "filtered"):
        for side in ("currentLeft", "currentRight"):
            np.testing.assert_array_equal(from_bag[f"{vehicle}.{side}"][1:], direct[f"{vehicle}.{side}"][:-1])
    assert np.abs(from_bag["filtered.currentLeft"]).max() < np.abs(from_bag["bare.currentLeft"]).max()


def test_two_independent_readers_find_the_same_messages(folder: Path) -> None:
    from rosbags.highlevel import AnyReader  # noqa: PLC0415 an optional dependency

    bag = folder / "path_filter_ros.mcap"
    decoded = messages_of(bag)
    result = fmu_mesh.Result.read(bag)

    engine = [message for _, message in decoded["/enginedata"]]
    assert [own.current_left for own in engine] == list(result["filtered.currentLeft"])
    velocities = [message.twist.linear.x for _, message in decoded["/velDesFil"]]
    assert velocities == list(result["filter.filteredLinearVelocity"])
    assert decoded["/velDesFil"][-1][1].header.frame_id == "base_link"
    with AnyReader([bag]) as reader:
        wanted = [own for own in reader.connections if own.topic in {"/enginedata", "/velDesFil"}]
        found: list[tuple[str, Any]] = [
            (own.topic, reader.deserialize(data, own.msgtype)) for own, _, data in reader.messages(wanted)
        ]
    assert [own.current_left for topic, own in found if topic == "/enginedata"] == [own.current_left for own in engine]
    assert [own.twist.linear.x for topic, own in found if topic == "/velDesFil"] == velocities
