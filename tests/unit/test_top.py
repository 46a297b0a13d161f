"""The table of `top`: rates since the first point at the first look, and since the look before at the others."""

from __future__ import annotations

import msgspec
import pytest

from fmu_mesh.cli.top import page
from fmu_mesh.simtime import ENDLESS
from fmu_mesh.wire.views import InstanceStatus, MeshStatus


def mesh(point: int, *, last_point: int = 1000, overruns: int = 0) -> MeshStatus:
    return MeshStatus("demo", "running", point, last_point, 0.5 * point, 10.0, 5.0, {}, None, overruns)


def own(point: int, wait_time: float, running_time: float) -> InstanceStatus:
    return InstanceStatus(
        "gain", "running", "waiting", point, 0.5 * point, 2e-5, wait_time, restarts=1, running_time=running_time
    )


def test_the_first_look_shows_what_happened_since_the_first_point() -> None:
    assert page((mesh(100), {"gain": own(100, 5.0, 10.0)})) == [
        "demo: running, point 100 of 1000, 50 s, 10 points/s, real-time factor 5",
        "",
        "instance  state    point  time  step time  wait  points/s  factor  restarts  activity",
        "gain      running  100    50 s  20 us      50 %  10        5       1         waiting",
    ]


def test_a_later_look_shows_what_happened_since_the_one_before() -> None:
    before = (mesh(100), {"gain": own(100, 5.0, 10.0)})

    assert page((mesh(180), {"gain": own(180, 6.0, 12.0)}), before)[-1].split()[7:12] == ["50", "%", "40", "20", "1"]


def test_an_instance_that_began_again_is_shown_since_then() -> None:
    before = (mesh(100), {"gain": own(100, 5.0, 10.0)})

    assert page((mesh(20), {"gain": own(20, 1.0, 2.0)}), before)[-1].split()[7:10] == ["50", "%", "10"]


def test_before_the_first_point_there_are_no_rates() -> None:
    start = MeshStatus("demo", "starting", 0, ENDLESS, 0.0, 0.0, 0.0, {}, overruns=3)

    lines = page((start, {"gain": own(0, 0.0, 0.0)}))

    assert lines[0] == "demo: starting, point 0, 0 s, 0 points/s, real-time factor 0, 3 overruns"
    assert lines[-1].split()[7:11] == ["0", "%", "0", "0"]


@pytest.mark.parametrize("width", [60, 80, 100, 200])
def test_no_line_is_wider_than_the_terminal(width: int) -> None:
    names = [f"the_wheel_of_the_front_axle_{side}" for side in ("left", "right")]
    instances = {
        name: InstanceStatus(
            name, "running", f"waiting at point 12345678 for '{names[0]}.angle'", 12_345_678, 0.1, 2e-5, 1
        )
        for name in names
    }
    status = msgspec.structs.replace(
        mesh(12_345_678, last_point=10**9, overruns=12), mesh="a_mesh_with_a_long_name" * 3
    )

    lines = page((status, instances), width=width)

    assert max(map(len, lines)) <= width
    assert [line for line in lines if line.startswith("a_mesh")] == lines[:1]
    rows = [line.split()[0] for line in lines[-2:]]
    assert len({*rows}) == 2
    assert rows == names or width < 200


def test_a_wide_terminal_shows_what_no_terminal_does() -> None:
    look = (mesh(100), {"gain": own(100, 5.0, 10.0)})

    assert page(look, width=200) == page(look)


def test_columns_that_the_head_line_replaces_are_left_out_first() -> None:
    activity = "waiting at point 100000 for 'pendulum.a', which feeds 'gain.u'"
    instance = msgspec.structs.replace(own(100_000, 5.0, 10.0), activity=activity)

    heading, row = page((mesh(100), {"gain": instance}), width=80)[-2:]

    assert heading.split() == ["instance", "state", "point", "step", "time", "wait", "points/s", "activity"]
    assert row.startswith("gain      running  100000  20 us      50 %  10000     waiting for 'pendulum.a'")
    assert row.endswith("\N{HORIZONTAL ELLIPSIS}")
    assert len(row) == 80
