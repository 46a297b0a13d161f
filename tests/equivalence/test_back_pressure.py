"""A fast chain in front of a slow end, with little room on the way and a window that lets everybody run far ahead."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from fmu_mesh.run.options import PlanOptions
from tests.helpers import BY_STREAMS, BY_ZENOH, Place, write_config
from tests.plain_run import PlainRun
from tests.planning import prepare

POINTS = 12_000
SLOW_S = 0.0001

TINY_QUEUES = """
{transport: {link: {tx: {queue: {size: {
    control: 1, real_time: 1, interactive_high: 1, interactive_low: 1, data_high: 1, data: 1, data_low: 1, background: 1
}}}}}}
"""


@pytest.mark.parametrize("way", [{}, BY_STREAMS, BY_ZENOH], ids=["shared memory", "streams", "zenoh"])
def test_a_chain_of_eight_with_slow_end_runs_through_with_nothing_lost(
    way: Mapping[str, bool], place: Place, faulty: Path
) -> None:
    """The queues of Zenoh hold one message each; that shared memory blocks when it is full has tests of its own."""
    (place.folder / "zenoh.json5").write_text(TINY_QUEUES, encoding="utf-8")
    names = [f"i{number}" for number in range(7)]
    members = {name: {"fmu": "Gain", "start_values": {"k": 1.001}} for name in names}
    members["i0"] = {"fmu": "Integrator", "start_values": {"u": 1.0}}
    members["slow"] = {"fmu": str(faulty), "start_values": {"slow": SLOW_S}}
    connections = [f"{source}.y -> {target}.u" for source, target in zip(names, [*names[1:], "slow"], strict=True)]
    config = write_config(
        place.folder,
        instances=members,
        connections=connections,
        stop_time=POINTS * 0.001,
        simulation={"window": 8192},
        zenoh={**way, "config": "zenoh.json5"},
    )

    assert place.run("launch", config, "--no-progress").wait() == 0

    local = place.folder / "local.csv"
    members["slow"]["start_values"] = {"slow": 0.0}  # the same values, sooner
    write_config(place.folder, instances=members, connections=connections, stop_time=POINTS * 0.001, name="quick")
    PlainRun(prepare(place.folder / "quick.yaml", PlanOptions(output=local))).run()
    assert config.with_suffix(".csv").read_bytes() == local.read_bytes()


@pytest.mark.parametrize("way", [{}, BY_STREAMS, BY_ZENOH], ids=["shared memory", "streams", "zenoh"])
def test_a_fast_instance_waits_for_a_slow_one_of_its_node(way: Mapping[str, bool], place: Place, faulty: Path) -> None:
    """Nothing is recorded, so the ring of the fast one has 32 rows; it would overwrite what was not read."""
    members = {
        "fast": {"fmu": "Integrator", "start_values": {"u": 1.0}, "group": "both"},
        "slow": {"fmu": str(faulty), "start_values": {"slow": SLOW_S}, "group": "both"},
    }
    config = write_config(
        place.folder,
        instances=members,
        connections=["fast.y -> slow.u"],
        stop_time=2.0,
        simulation={"window": 16},
        zenoh=way,
        record=[],  # type: ignore[arg-type]  # this section is a list
    )

    launched = place.run("launch", config, "--no-progress")

    assert launched.wait() == 0, launched.story()
