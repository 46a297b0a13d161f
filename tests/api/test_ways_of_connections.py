"""How the values of a connection come from another process, as `info`, `graph` and `status` show it."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

import fmu_mesh
from fmu_mesh.cli.output.pages import instance_info, mesh_status
from fmu_mesh.wire.views import MeshStatus
from tests.helpers import BY_STREAMS, BY_ZENOH, FMUS


def paused(zenoh: Mapping[str, bool], group: str | None = None) -> fmu_mesh.Run:
    mesh = fmu_mesh.Mesh("ways", step_size=0.01, stop_time=60.0)
    mesh.add("source", fmu=FMUS / "Integrator.fmu", group=group)
    mesh.add("gain", fmu=FMUS / "Gain.fmu", group=group)
    mesh.connect("source.y", "gain.u")
    mesh.configure(zenoh=dict(zenoh))
    run = mesh.start(record="memory", paused=True)
    run.wait_for("paused")
    return run


@pytest.mark.parametrize(
    ("zenoh", "way", "remark"),
    [({}, "ring", ""), (BY_STREAMS, "stream", "row stream"), (BY_ZENOH, "zenoh", "Zenoh")],
    ids=["ring", "stream", "zenoh"],
)
def test_info_and_graph_of_a_running_mesh_show_the_way(zenoh: Mapping[str, bool], way: str, remark: str) -> None:
    with paused(zenoh), fmu_mesh.attach("ways") as run:
        info = run.instance_info("gain")
        text = run.graph().text()

    assert [own.way for own in info.connections] == [way]
    fed_by = next(line for line in instance_info(info) if line.startswith("fed by"))
    assert fed_by.endswith(f"source.y -> gain.u{f' ({remark})' if remark else ''}")
    edge = next(line for line in text.splitlines() if "-> gain.u" in line)
    assert edge.partition("gain.u")[2].strip() == remark


def test_within_one_process_there_is_no_way() -> None:
    with paused({}, group="one") as run:
        assert [own.way for own in run.instance_info("gain").connections] == [None]


def test_status_names_the_nodes_whose_links_are_cut() -> None:
    status = MeshStatus("far", "running", 5, 10, 0.5, 1.0, 1.0, {}, cut={"delay": 3.2})

    assert "the master waits for node 'delay' for 3 s" in "\n".join(mesh_status(status, ()))
