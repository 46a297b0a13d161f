"""What `--profile` shows of profiles made by hand: the table, the critical path and the trace file."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import msgspec
import pytest

from fmu_mesh.cli.main import main
from fmu_mesh.cli.output.profile_table import critical_path, profile_page, show_profile, trace
from fmu_mesh.master.pacing import GrantWatch
from fmu_mesh.system.plan import RECORDER, Plan
from fmu_mesh.wire.time_profile import GRANT, Burst, MeshProfile, NodeProfile, UnitProfile, Wait
from tests.helpers import write_config
from tests.planning import prepare

GAIN = {"fmu": "Gain"}


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    instances = {
        "controller": GAIN,
        "plant": GAIN,
        "first": {**GAIN, "group": "tail"},
        "last": {**GAIN, "group": "tail"},
    }
    connections = ["controller.y -> plant.u", "plant.y -> first.u", "first.y -> last.u"]
    return prepare(write_config(tmp_path, instances=instances, connections=connections, name="loop"))


def node(name: str, *units: UnitProfile, wait_s: dict[str, float], transport_s: float = 0.1) -> NodeProfile:
    """A node that ran for one second, with one burst of a quarter of it and one wait of another."""
    reason = next(iter(wait_s), GRANT)
    return NodeProfile(
        node=name,
        host="host",
        pid=42,
        started=100.0,
        ended=101.0,
        units=units,
        transport_s=transport_s,
        wait_s=wait_s,
        bursts=(Burst(100.0, 100.25, 0, 10), Burst(100.5, 100.75, len(units) - 1, 5)),
        waits=(Wait(100.25, 100.5, reason),),
    )


def unit(*instances: str, compute_s: float, steps: int = 1000) -> UnitProfile:
    return UnitProfile(instances, steps, 10, compute_s)


def mesh(*nodes: NodeProfile, **held_s: float) -> MeshProfile:
    return MeshProfile(nodes, held_s)


def slow_controller() -> MeshProfile:
    return mesh(
        node("controller", unit("controller", compute_s=0.8), wait_s={GRANT: 0.05}),
        node("plant", unit("plant", compute_s=0.15), wait_s={"controller": 0.71, GRANT: 0.01}),
        node("tail", unit("first", compute_s=0.2), unit("last", compute_s=0.1, steps=500), wait_s={"plant": 0.55}),
        controller=0.9,
    )


def test_the_table_has_every_unit_and_the_path_finds_the_slowest_node(plan: Plan) -> None:
    page = "\n".join(profile_page(plan, slow_controller()))

    assert (
        page
        == """\
Profile
  node        instance    steps  steps/s  time     compute  transport  wait  other  waits for
  controller  controller  1000   1000     1.000 s  80 %     10 %       5 %   5 %    the grant 5 %
  plant       plant       1000   1000     1.000 s  15 %     10 %       72 %  3 %    controller 71 %, the grant 1 %
  tail        first       1000   1000     1.000 s  20 %     10 %       55 %  5 %    plant 55 %
              last        500    500               10 %
Critical path
  'plant' waits 71 % for 'controller'
  'controller' sets the pace: 80 % compute, 10 % transport"""
    )


def test_nodes_that_wait_for_each_other_are_named_as_such(plan: Plan) -> None:
    profile = mesh(
        node("controller", unit("controller", compute_s=0.1), wait_s={"first": 0.7}),
        node("plant", unit("plant", compute_s=0.1), wait_s={}),
        node("tail", unit("first", compute_s=0.1), wait_s={"controller": 0.6}),
    )

    assert critical_path(plan, profile) == [
        "'controller' waits 70 % for 'first' in 'tail'",
        "'tail' waits 60 % for 'controller'",
        "'controller' and 'tail' wait for each other: the messages between them set the pace",
    ]


def test_a_wait_for_the_grant_leads_to_what_holds_it(plan: Plan) -> None:
    waiting = node("plant", unit("plant", compute_s=0.1), wait_s={GRANT: 0.8})
    busy = node("controller", unit("controller", compute_s=0.9), wait_s={})

    by_node = critical_path(plan, mesh(waiting, busy, controller=0.7, plant=0.1))
    by_recorder = critical_path(plan, MeshProfile((waiting, busy), {RECORDER: 0.7}))
    by_itself = critical_path(plan, mesh(waiting, busy, plant=0.7))

    assert by_node == [
        "'plant' waits 80 % for the grant, which 'controller' holds back",
        "'controller' sets the pace: 90 % compute, 10 % transport",
    ]
    assert by_recorder == ["'plant' waits 80 % for the grant, which the recorder holds back"]
    (line,) = by_itself
    assert line.endswith("which its own progress holds back: the way to the master and back sets the pace")


def test_nodes_that_only_the_window_holds_together_are_told_so(plan: Plan) -> None:
    profile = mesh(
        node("controller", unit("controller", compute_s=0.1), wait_s={GRANT: 0.8}),
        node("plant", unit("plant", compute_s=0.2), wait_s={"controller": 0.7}),
        plant=1.0,
    )

    assert critical_path(plan, profile)[-1] == (
        f"the window of {plan.window} points holds them together; the busiest of them is 'plant': "
        "20 % compute, 10 % transport"
    )


def test_a_run_without_any_point_has_a_table_and_no_path(plan: Plan) -> None:
    empty = msgspec.structs.replace(node("plant", unit("plant", compute_s=0.0, steps=0), wait_s={}), ended=100.0)

    assert "Critical path" not in profile_page(plan, mesh(empty))


def test_what_the_time_lines_leave_out_is_said(plan: Plan) -> None:
    cut = msgspec.structs.replace(slow_controller().nodes[0], cut=7)

    assert "  The time lines leave out the last 7 bursts and waits; the table holds all." in profile_page(
        plan, mesh(cut)
    )


def test_trace_has_one_process_per_node_and_slices_that_follow_one_another(plan: Plan) -> None:
    document = json.loads(json.dumps(trace(plan, slow_controller(), seconds=1.25)))

    events = document["traceEvents"]
    names = {e["pid"]: e["args"]["name"] for e in events if e["name"] == "process_name"}
    assert names == {n: f"{name} (process 42 on host)" for n, name in enumerate(("controller", "plant", "tail"), 1)}
    for process in names:
        slices = [e for e in events if e["ph"] == "X" and e["pid"] == process]
        assert all(e["dur"] >= 0.0 and e["ts"] >= 0.0 for e in slices)
        for before, after in pairwise(slices):
            assert before["ts"] + before["dur"] <= after["ts"] + 1e-3
    tail = [(e["name"], e["cat"], e["ts"], e["dur"]) for e in events if e["ph"] == "X" and e["pid"] == 3]
    assert tail == [
        ("first", "compute", 0.0, 250_000.0),
        ("wait for plant", "wait", 250_000.0, 250_000.0),
        ("last", "compute", 500_000.0, 250_000.0),
    ]


def test_the_trace_carries_the_figures_of_the_table(plan: Plan) -> None:
    summary = trace(plan, slow_controller(), seconds=1.25)["otherData"]["fmu_mesh"]

    assert (summary["points"], summary["points_per_second"], summary["real_time_factor"]) == (1000, 800.0, 0.8)
    assert summary["nodes"][1]["wait_s"] == {"controller": 0.71, "grant": 0.01}
    assert [unit["instances"] for unit in summary["nodes"][2]["units"]] == [("first",), ("last",)]
    assert summary["nodes"][2]["units"][1]["steps_per_second"] == 500.0
    assert summary["critical_path"][0] == "'plant' waits 71 % for 'controller'"


def test_nodes_of_another_host_begin_at_their_own_origin(plan: Plan) -> None:
    here = slow_controller().nodes[0]
    there = msgspec.structs.replace(
        here, node="plant", host="other", started=5.0, ended=6.0, bursts=(Burst(5.5, 5.6, 0, 1),), waits=()
    )

    events = trace(plan, mesh(here, there), seconds=1.0)["traceEvents"]

    assert [e["ts"] for e in events if e["ph"] == "X" and e["pid"] == 2] == [500_000.0]


def test_the_trace_file_is_written_where_it_was_wanted(
    plan: Plan, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "made" / "trace.json"

    show_profile(plan, slow_controller(), 1.0, file)

    assert json.loads(file.read_bytes())["displayTimeUnit"] == "ms"
    assert f"trace: {file}" in capsys.readouterr().out


def test_a_profile_survives_the_wire() -> None:
    profile = slow_controller()

    assert msgspec.json.decode(msgspec.json.encode(profile), type=MeshProfile) == profile


def test_the_time_of_a_grant_belongs_to_what_held_it() -> None:
    watch = GrantWatch()

    for holder in ("a", "a", "b", None, "a"):
        watch.note(holder)

    assert set(watch.held_s) == {"a", "b"}
    assert all(seconds >= 0.0 for seconds in watch.held_s.values())


@pytest.mark.parametrize("value", ["mesh.yaml", "trace.txt"])
def test_a_profile_goes_into_a_json_file_only(value: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["launch", "--profile", value]) == 2
    assert f"'{value}' is no .json file; write --profile after the other arguments" in capsys.readouterr().err


def test_a_run_in_one_process_has_no_nodes_to_measure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["launch", str(write_config(tmp_path)), "--local", "--profile"])

    assert code == 2
    assert "--profile measures nodes, and --local has none" in capsys.readouterr().err
