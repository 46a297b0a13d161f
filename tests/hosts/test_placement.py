"""The section `deploy`: what is wrong with it, and what a plan, its pages and its errors say of hosts."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

import fmu_mesh
from fmu_mesh.api.rerunning import on_this_host
from fmu_mesh.errors import ConfigurationError, DeadlineExceeded, MeshLost, StepFailed, from_report
from fmu_mesh.master.master_states import MasterStates
from fmu_mesh.pictures.plan_page import plan_page
from fmu_mesh.pictures.plan_view import plan_view
from fmu_mesh.pictures.system_graph import graph_of_plan
from fmu_mesh.run.options import PlanOptions
from fmu_mesh.system.placement import manual_hosts, two_trips
from fmu_mesh.system.plan import RECORDER, Plan
from fmu_mesh.system.round_trip import round_trip_cost
from tests.helpers import FMUS, write_config
from tests.planning import plan_run, prepare

PAIR = {"pendulum": {"fmu": "DampedPendulum"}, "delay": {"fmu": "TransportDelay"}}
SSH = {"ssh": "user@b", "python": "~/mesh/bin/python"}


def placed(folder: Path, hosts: dict[str, Any] | None, **of: str) -> Path:
    """A pendulum and a delay on these hosts, with these entries of `deploy.hosts`; None: without the section."""
    instances = {name: {**own, **({"host": of[name]} if name in of else {})} for name, own in PAIR.items()}
    if hosts is None:
        return write_config(folder, instances=instances)
    return write_config(folder, instances=instances, deploy={"hosts": hosts})


def findings_of(file: Path) -> list[str]:
    with pytest.raises(ConfigurationError) as caught:
        prepare(file)
    return [str(finding).partition(f"{file}:")[2].partition(" ")[2] for finding in caught.value.findings]


def test_a_plan_knows_the_hosts_of_its_nodes(tmp_path: Path) -> None:
    plan = prepare(placed(tmp_path, {"b": SSH, "unused": {}}, delay="b"))

    assert {name: node.host for name, node in plan.nodes.items()} == {"pendulum": None, "delay": "b", RECORDER: None}
    assert [(name, host.ssh, host.python, host.rows) for name, host in plan.hosts.items()] == [
        ("b", "user@b", "~/mesh/bin/python", "sockets")
    ]
    assert manual_hosts(plan) == {}


def test_hosts_change_no_digest(tmp_path: Path) -> None:
    here = prepare(placed(tmp_path, None)).digest

    assert prepare(placed(tmp_path, {"b": SSH}, delay="b")).digest == here
    assert prepare(placed(tmp_path, {"b": {"ssh": "other"}}, pendulum="b")).digest == here


def test_a_file_without_hosts_is_as_before_and_warns(tmp_path: Path) -> None:
    plan = prepare(placed(tmp_path, None, delay="lab2"))

    assert {node.host for node in plan.nodes.values()} == {None}
    [warning] = [str(one) for one in plan.system.warnings if one.path.endswith(".host")]
    assert warning.endswith(
        "instances.delay.host: the host 'lab2', which has no entry in `deploy.hosts`, so `launch` runs 'delay' here; "
        "expected `deploy: {hosts: {lab2: {ssh: ...}}}`; from version 0.6 on, it is needed"
    )


def test_an_unknown_host_is_refused_with_the_nearest_name(tmp_path: Path) -> None:
    [finding] = findings_of(placed(tmp_path, {"lab2": SSH, "other": {}}, delay="lab"))

    assert finding == (
        "instances.delay.host: the unknown host 'lab'; expected one of lab2, other, or null: where `launch` runs. "
        "Did you mean 'lab2'?"
    )


@pytest.mark.parametrize(
    ("entry", "finding"),
    [
        ({"ssh": "-oProxyCommand=date"}, ".ssh: '-oProxyCommand=date'; expected a destination of ssh such as"),
        ({"ssh": "a b"}, ".ssh: 'a b'; expected a destination of ssh such as user@lab2 or null"),
        ({"python": "python3; date"}, ".python: 'python3; date'; expected a path such as ~/mesh/bin/python or a name"),
        ({"python": "-c"}, ".python: '-c'; expected a path such as"),
        ({"rows": "udp"}, ".rows: 'udp'; expected sockets or tcp"),
        ({"ssh": "b", "rows": "tcp"}, ".rows: tcp, for rows without encryption; expected `zenoh: {insecure: true}`"),
    ],
)
def test_an_entry_that_ssh_must_not_get_is_refused(entry: dict[str, Any], finding: str, tmp_path: Path) -> None:
    [found] = findings_of(placed(tmp_path, {"b": entry}, delay="b"))

    assert found.startswith(f"deploy.hosts.b{finding}")


def test_a_group_on_two_hosts_is_refused(tmp_path: Path) -> None:
    instances = {name: {**own, "group": "g", "host": name[0]} for name, own in PAIR.items()}
    file = write_config(tmp_path, instances=instances, deploy={"hosts": {"p": {}, "d": {}}})

    assert findings_of(file) == [
        "instances.delay.host: 'd', while 'pendulum' has 'p'; expected one host for all instances of the group 'g'"
    ]


def test_a_sandbox_on_another_host_is_refused(tmp_path: Path) -> None:
    file = placed(tmp_path, {"b": SSH}, delay="b")

    with pytest.raises(ConfigurationError, match=r"a sandbox for 'delay', which has a `host` or an `interpreter`"):
        prepare(file, PlanOptions(config_values={"instances.delay.process": {"sandbox": "bubblewrap"}}))


def test_another_user_cannot_name_a_host_to_log_in_to(tmp_path: Path) -> None:
    file = placed(tmp_path, {"b": SSH, "c": {}}, delay="b")
    told: list[str] = []
    os.chown(file, 65_533, -1)

    [finding] = findings_of(file)
    allowed = fmu_mesh.load(file).plan(allow_code=True, on_notice=told.append).plan

    assert finding.startswith("deploy.hosts.b.ssh: a host that you would log in to, in a file of the user 65533; ")
    assert allowed.nodes["delay"].host == "b"
    [text] = told
    assert text == (
        "nodes run on host 'b', by `ssh user@b` and its `~/mesh/bin/python`, because of `allow_code=True` "
        "(as a file of the user 65533 says)"
    )


def test_a_rerun_and_a_sweep_stay_on_one_host() -> None:
    data = {"instances": {"a": {"fmu": "a.fmu", "host": "b"}, "c": None}, "deploy": {"hosts": {"b": SSH}}}

    assert {**data, **on_this_host(data)} == {"instances": {"a": {"fmu": "a.fmu"}, "c": None}, "deploy": {}}


def test_a_result_of_several_hosts_is_made_again_on_one(tmp_path: Path) -> None:
    file = placed(tmp_path, {"b": SSH}, delay="b")
    first = fmu_mesh.load(file).run(processes=False)

    again = fmu_mesh.rerun(str(first.file), processes=False)

    assert again["delay.y"].tolist() == first["delay.y"].tolist()


# --- what is shown


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    """A chain from host b over c to the host of `launch`."""
    gain = {"fmu": str(FMUS / "Gain.fmu")}
    file = write_config(
        tmp_path,
        instances={"first": {**gain, "host": "b"}, "second": {**gain, "host": "c"}, "third": gain},
        connections=["first.y -> second.u", "second.y -> third.u", "third.y -> first.u"],
        simulation={"real_time_factor": 1.0},
        deploy={"hosts": {"b": SSH, "c": {"ssh": "c"}}},
    )
    return prepare(file)


def test_check_says_what_runs_where(plan: Plan) -> None:
    page = "\n".join(plan_page(plan))

    assert "\n".join(page.partition("Hosts\n")[2].split("\n\n")[0].splitlines()) == (
        "  where `launch` runs  master, whose clock paces all, third, recorder\n"
        "  b                    first                                           ssh user@b\n"
        "  c                    second                                          ssh c\n"
        "  first.y -> second.u: from 'b' to 'c' through the host of `launch`, which is two trips"
    )


def test_check_says_nothing_of_hosts_without_any(tmp_path: Path) -> None:
    assert "Hosts" not in plan_page(prepare(placed(tmp_path, None)))


def test_hosts_that_reach_each_other_make_one_trip(tmp_path: Path) -> None:
    direct = {"ssh": "b", "rows": "tcp"}
    file = placed(tmp_path, {"b": direct, "c": direct}, pendulum="b", delay="c")

    assert two_trips(prepare(file, PlanOptions(insecure=True))) == []


def test_a_plan_as_values_has_hosts(tmp_path: Path) -> None:
    run = plan_run(placed(tmp_path, {"b": SSH, "c": SSH}, pendulum="b", delay="c"))

    view = plan_view(run.plan, run.loaded)

    assert [own.host for own in view.instances] == ["b", "c"]
    assert len(view.two_trips) == 1


def test_a_graph_shows_hosts_as_text_and_as_picture(plan: Plan) -> None:
    graph = graph_of_plan(plan)

    assert "3 instances in 3 processes on 3 hosts" in graph.title
    assert "first  Gain.fmu  on b" in graph.text()
    assert "Gain.fmu on c" in graph.svg()


def test_a_cycle_on_one_host_costs_no_round_trip(tmp_path: Path) -> None:
    gain = {"fmu": str(FMUS / "Gain.fmu"), "host": "b"}
    chain = ["one.y -> two.u", "two.y -> one.u"]
    file = write_config(tmp_path, instances={"one": gain, "two": gain}, connections=chain, deploy={"hosts": {"b": SSH}})

    assert [line.partition(":")[0].split()[0] for line in round_trip_cost(prepare(file), 0.05)] == ["window"]


def test_a_cycle_over_hosts_costs_round_trips_for_sure(plan: Plan) -> None:
    _, cycle = round_trip_cost(plan, 0.05)

    assert cycle == "cycle first, second, third: at least 0.05 s per point, 50 s for 1000 points"


# --- errors


@pytest.mark.parametrize(("instance", "host"), [("first", " on b"), ("third", ""), ("first, second", "")])
def test_an_error_of_an_instance_names_its_host(plan: Plan, instance: str, host: str) -> None:
    states = MasterStates(plan)

    states.fail(StepFailed("doStep returned error", instance=instance, point=3, time=0.3))

    assert str(states.failure) == f"instance {instance}{host}, point 3, t = 0.3 s: doStep returned error"
    assert states.failure is not None
    assert str(from_report(states.failure.report())) == str(states.failure)


def test_a_lost_node_and_missing_ones_are_named_with_hosts(plan: Plan) -> None:
    lost, late = MasterStates(plan), MasterStates(plan)

    lost.lose("second")
    late.decide(100.0, paced=0)

    assert isinstance(lost.failure, MeshLost)
    assert str(lost.failure).startswith("instance second on c, point 0, t = 0 s: node 'second' was lost")
    assert isinstance(late.failure, DeadlineExceeded)
    assert "node 'first' on b, node 'second' on c, node 'third'" in str(late.failure)


def test_a_silent_node_is_named_with_its_host(plan: Plan) -> None:
    states = MasterStates(plan)

    states.fail(states.granting.no_progress(7.0, ["first"]))

    assert str(states.failure).startswith("instance node 'first' on b, point ")


def test_a_program_reads_the_host_of_an_error(plan: Plan) -> None:
    states = MasterStates(plan)

    states.fail(fmu_mesh.StepFailed("it failed", instance="second"))

    assert states.failure is not None
    assert states.failure.host == "c"
