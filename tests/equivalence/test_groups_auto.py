"""`group: auto` puts each cycle into one node, and every grouping gives the same floats."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from fmu_mesh.config.loading import read_file
from fmu_mesh.instances.configuration import examine_data
from fmu_mesh.pictures.plan_page import plan_page
from fmu_mesh.run.preparing import prepare
from fmu_mesh.system.plan import RECORDER, Plan
from fmu_mesh.system.process_sharing import automatic_nodes
from tests.helpers import Place, rows_of, write_config

ADDER = {"fmu": "Adder"}
INTEGRATOR = {"fmu": "Integrator"}

# pendulum -> (sum <-> loop) -> (position <-> velocity <-> brake) -> delay
INSTANCES: dict[str, dict[str, Any]] = {
    "pendulum": {"fmu": "DampedPendulum", "start_values": {"a": 1.0}},
    "sum": ADDER,
    "loop": {"fmu": "Gain", "start_values": {"k": -0.5}},
    "position": {**INTEGRATOR, "start_values": {"y": 0.3}},
    "velocity": {**INTEGRATOR, "start_values": {"k": -1.0}},
    "brake": {**ADDER, "step_size": 0.003},
    "delay": {"fmu": "TransportDelay", "start_values": {"d": 0.05}},
}
CONNECTIONS = [
    "pendulum.a -> sum.u1",
    "sum.y -> loop.u",
    "loop.y -> sum.u2",
    "velocity.y -> position.u",
    "position.y -> brake.u1",
    "sum.y -> brake.u2",
    "brake.y -> velocity.u",
    "velocity.y -> delay.x",
]
CYCLES = {"sum": "sum-cycle", "loop": "sum-cycle", **dict.fromkeys(("position", "velocity", "brake"), "position-cycle")}


@pytest.fixture
def place() -> Iterator[Place]:
    with Place() as place:
        yield place


def written(
    folder: Path,
    changes: Mapping[str, Mapping[str, Any]] = {},
    *,
    group: str | None = "auto",
    name: str = "grouped",
    connections: Sequence[str] = CONNECTIONS,
) -> Path:
    """The system above with some fields of some instances changed."""
    instances = {own: {**fields, **changes.get(own, {})} for own, fields in INSTANCES.items()}
    path = write_config(folder, instances=instances, connections=connections, name=name, stop_time=0.3)
    return path if group is None else with_group(path, group)


def with_group(path: Path, group: str) -> Path:
    path.write_text(f"group: {group}\n{path.read_text(encoding='utf-8')}", encoding="utf-8")
    return path


def nodes_of(plan: Plan) -> dict[str, str]:
    """The instances that share a node, with its name."""
    return {name: own.node for name, own in plan.system.instances.items() if own.node != name}


def groups_section(plan: Plan) -> list[str]:
    page = plan_page(plan)
    if "Groups" not in page:
        return []
    start = page.index("Groups") + 1
    return [line.strip() for line in page[start : page.index("", start)]]


APART = "groups, hosts, or what cannot share a process keep them apart"


def over(nodes: int) -> str:
    return f"form a cycle over {nodes} nodes: each point costs a round trip"


def test_each_cycle_gets_one_node_that_is_stepped_as_one_unit(tmp_path: Path) -> None:
    plan = prepare(written(tmp_path))

    assert nodes_of(plan) == CYCLES
    assert set(plan.nodes) == {"pendulum", "sum-cycle", "position-cycle", "delay", RECORDER}
    assert plan.nodes["sum-cycle"].units == (("sum", "loop"),)
    assert len(plan.nodes["position-cycle"].units) == 1
    assert groups_section(plan) == [
        "sum, loop form a cycle: together in 'sum-cycle', each point costs no round trip",
        "position, velocity, brake form a cycle: together in 'position-cycle', each point costs no round trip",
    ]


def test_without_it_every_instance_has_a_node_and_check_suggests_it(tmp_path: Path) -> None:
    plan = prepare(written(tmp_path, group=None))

    assert nodes_of(plan) == {}
    assert groups_section(plan) == [
        f"sum, loop {over(2)}; `group: auto` would put them into one",
        f"position, velocity, brake {over(3)}; `group: auto` would put them into one",
    ]


def test_a_system_without_cycles_stays_as_it_is_and_check_says_nothing(tmp_path: Path) -> None:
    connections = ["pendulum.a -> sum.u1", "sum.y -> delay.x"]

    plan = prepare(written(tmp_path, connections=connections))

    assert nodes_of(plan) == {}
    assert groups_section(plan) == []


def test_a_group_of_an_instance_comes_before_that_of_its_cycle(tmp_path: Path) -> None:
    plan = prepare(written(tmp_path, {"brake": {"group": "brake"}, "pendulum": {"group": "a"}, "sum": {"group": "a"}}))

    assert nodes_of(plan) == {"pendulum": "a", "sum": "a", "position": "position-cycle", "velocity": "position-cycle"}
    assert groups_section(plan) == [
        f"sum, loop {over(2)}; {APART}",
        f"position, velocity, brake {over(2)}; {APART}",
    ]


def test_instances_of_different_hosts_are_not_put_together(tmp_path: Path) -> None:
    changes = {"loop": {"host": "b"}, "brake": {"host": "b"}}

    grouped = prepare(written(tmp_path, changes))
    single = prepare(written(tmp_path, changes, group=None))

    assert nodes_of(grouped) == {"position": "position-cycle", "velocity": "position-cycle"}
    assert groups_section(single) == [
        f"sum, loop {over(2)}; {APART}",
        f"position, velocity, brake {over(3)}; `group: auto` would put them into 2, since {APART}",
    ]


def test_the_name_of_a_node_collides_with_no_other(tmp_path: Path) -> None:
    changes = {"pendulum": {"group": "sum-cycle"}, "delay": {"group": "sum-cycle-2"}}

    nodes = nodes_of(prepare(written(tmp_path, changes)))

    assert (nodes["sum"], nodes["loop"]) == ("sum-cycle-3", "sum-cycle-3")


def test_two_instances_of_an_fmu_that_allows_one_per_process_get_two_nodes(tmp_path: Path) -> None:
    plan = prepare(written(tmp_path))
    once = {name for name, own in plan.system.instances.items() if own.description.model_name == "Integrator"}
    edges = [(c.source_instance, c.target_instance) for c in plan.connections]

    nodes = automatic_nodes(
        examine_data(read_file(written(tmp_path)))[0].config, edges, lambda name: {"once": ""} if name in once else {}
    )

    assert nodes == {"sum": "sum-cycle", "loop": "sum-cycle", "position": "position-cycle", "brake": "position-cycle"}


GROUPINGS: dict[str, dict[str, Any]] = {
    "none": {"group": None},
    "auto": {},
    "across": {  # groups that cut both cycles, and have data going both ways
        "changes": {name: {"group": "ab"[place % 2]} for place, name in enumerate(INSTANCES)},
        "group": None,
    },
    "one": {"changes": {name: {"group": "all"} for name in INSTANCES}, "group": None},
}


@pytest.mark.parametrize("algorithm", ["gauss_seidel", "jacobi"])
def test_the_result_is_the_same_whatever_the_grouping(place: Place, algorithm: str) -> None:
    results = {}
    for grouping, arguments in GROUPINGS.items():
        config = written(place.folder, name=f"{algorithm}_{grouping}", **arguments)
        text = config.read_text(encoding="utf-8").replace("simulation:\n", f"simulation:\n  algorithm: {algorithm}\n")
        config.write_text(text, encoding="utf-8")
        run = place.run("launch", config)
        assert run.wait() == 0, run.errors
        results[grouping] = config.with_suffix(".csv").read_bytes()
    local = place.run("launch", place.folder / f"{algorithm}_auto.yaml", "--local", "--output", "local.csv")
    assert local.wait() == 0, local.errors

    assert len(rows_of(place.folder / "local.csv")) == 301
    assert all(result == (place.folder / "local.csv").read_bytes() for result in results.values())
