"""A process that is killed or stopped in mid-run: who notices, what is told, what is kept, and what is left."""

from __future__ import annotations

import re
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import psutil
import pytest
import yaml

from fmu_mesh.cli.main import main
from fmu_mesh.system.window import AUTO_WINDOW_POINTS
from tests.helpers import (
    BY_STREAMS,
    BY_ZENOH,
    DEADLINE_S,
    FMUS,
    Launched,
    Place,
    braked,
    on_a_busy_machine,
    row_count,
    rows_of,
    wait_until,
    write_config,
)

FAST = pytest.param({}, 2000, id="as fast as possible")
PACED = pytest.param({"real_time_factor": 1}, 300, id="in real time")

FAR_S = 1_000_000.0
"""A stop time that no test ever reaches."""


def started(
    place: Place,
    simulation: dict[str, float],
    rows: int,
    timeouts: dict[str, float] | None = None,
    way: Mapping[str, bool] = {},
) -> tuple[Launched, Path]:
    """A pendulum and a delay that run, and their result file with ``rows`` rows or more."""
    config = write_config(
        place.folder,
        instances=braked(place.folder),
        stop_time=FAR_S,
        simulation=simulation,
        timeouts=timeouts or {},
        zenoh=way,
    )
    launched = place.start("launch", config)
    result = config.with_suffix(".csv")
    wait_until(lambda: row_count(result) > rows, f"{rows} rows")
    return launched, result


def assert_is_what_one_process_calculates(place: Place, result: Path) -> None:
    """The rows that were kept are those of a run in one process that stops at the last of them, byte for byte."""
    config, local, last = result.with_suffix(".yaml"), place.folder / "local.csv", row_count(result) - 1
    options = ["--output", str(local), "--stop-time", str(last * 0.001), "--real-time-factor", "0"]
    assert main(["launch", str(config), "--local", "--no-progress", *options]) == 0
    assert result.read_bytes() == local.read_bytes()


def point_in(message: str) -> int:
    """The point that a message names; its time must be that of the point."""
    found = re.search(r"point (\d+), t = ([\d.e+]+) s: ", message)
    assert found is not None, message
    assert float(found[2]) == pytest.approx(int(found[1]) * 0.001, rel=1e-11)
    return int(found[1])


@pytest.mark.parametrize("victim", ["pendulum", "delay", "master"])
@pytest.mark.parametrize(
    ("simulation", "rows", "way"),
    [
        pytest.param({}, 2000, {}, id="as fast as possible"),
        pytest.param({"real_time_factor": 1}, 300, {}, id="in real time"),
        pytest.param({"real_time_factor": 1}, 300, BY_STREAMS, id="by streams"),
    ],
)
def test_killed_process_ends_run_within_two_seconds_and_rows_before_are_kept(
    place: Place, victim: str, simulation: dict[str, float], rows: int, way: Mapping[str, bool]
) -> None:
    launched, result = started(place, simulation, rows, way=way)

    launched.child(victim).kill()

    assert launched.wait() == 4
    assert launched.ended_after_s < on_a_busy_machine(2.0)
    place.assert_nothing_left()
    kept = len(rows_of(result))
    assert kept > rows
    message = launched.message
    who = "the master was lost" if victim == "master" else f"instance {victim}, point"
    assert who in message
    assert "its process was ended by SIGKILL" in message
    assert f"({kept} rows) is in '{result}'" in message
    # Its last rows stay in the memory; the other node may be a window behind.
    assert kept - 1 <= point_in(message) <= kept - 1 + AUTO_WINDOW_POINTS
    assert_is_what_one_process_calculates(place, result)


@pytest.mark.parametrize("victim", ["delay", "master"])
def test_with_restarts_a_run_whose_process_is_killed_ends_with_same_numbers(place: Place, victim: str) -> None:
    config = write_config(place.folder, stop_time=3.0, simulation={"real_time_factor": 1})
    result = config.with_suffix(".csv")
    launched = place.start("launch", config, "--restarts", "2")
    wait_until(lambda: row_count(result) > 300, "300 rows")

    launched.child(victim).kill()

    said = launched.wait_for_error_line("starts again")
    assert re.search(rf"{victim}.* was lost: its process was ended by SIGKILL", said), said
    assert "(restart 1 of 2)." in said
    assert launched.wait() == 0
    assert "result: " in launched.output
    place.assert_nothing_left()
    assert len(rows_of(result)) == 3001
    assert_is_what_one_process_calculates(place, result)


KILLER = """
import os, signal
import fmu_mesh

class Killer(fmu_mesh.Component):
    \"\"\"Is killed in a step: its inputs are read, and its row is begun.\"\"\"
    u = fmu_mesh.Input()
    y = fmu_mesh.Output()
    z = fmu_mesh.Output()

    def step(self, time, step_size):
        self.y = self.y + self.u * step_size
        self.z = -self.y
        if time > 1.2345:
            os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("way", [{}, BY_STREAMS, BY_ZENOH], ids=["shared memory", "streams", "Zenoh"])
@pytest.mark.parametrize("window", [1, 300, "auto"])
def test_of_process_killed_in_step_all_rows_before_it_are_kept(
    place: Place, window: int | str, way: Mapping[str, bool]
) -> None:
    (place.folder / "killer.py").write_text(KILLER, encoding="utf-8")
    content: dict[str, Any] = {
        "mesh": "killed",
        "simulation": {"stop_time": FAR_S, "step_size": 0.001, "window": window},
        "instances": {
            "pendulum": {"fmu": str(FMUS / "DampedPendulum.fmu"), "start_values": {"a": 1.3}},
            "killer": {"python": "killer.py:Killer"},
            "gain": {"fmu": str(FMUS / "Gain.fmu")},
        },
        "connections": ["pendulum.a -> killer.u", "killer.y -> gain.u"],
        # gain is not recorded: nobody knows how far it was when the run ended
        "record": {"variables": ["pendulum.a", "pendulum.der(a)", "killer.y", "killer.z"]},
        "zenoh": dict(way),
    }
    config = place.folder / "killed.yaml"
    config.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")

    launched = place.run("launch", config, "--no-progress")

    assert launched.wait() == 4, launched.story()
    assert "node 'killer' was lost: its process was ended by SIGKILL" in launched.message
    place.assert_nothing_left()
    [result] = place.folder.glob("**/killed*.csv")
    rows = rows_of(result)
    if not way:  # what a process wrote there stays when it is killed; a frame may be lost with its sender
        assert len(rows) == 1236
    content["simulation"]["stop_time"] = (len(rows) - 1) * 0.001
    config.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    assert main(["launch", str(config), "--local", "--no-progress", "--output", str(place.folder / "local.csv")]) == 0
    assert rows == rows_of(place.folder / "local.csv")


@pytest.mark.parametrize(
    ("number", "how"),
    [
        (signal.SIGKILL, "its process was ended by SIGKILL"),
        (signal.SIGTERM, "its process was told to end (SIGTERM was received)"),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_run_lost_again_and_again_starts_again_as_often_as_it_may(
    place: Place, number: signal.Signals, how: str
) -> None:
    config = write_config(place.folder, stop_time=FAR_S, simulation={"real_time_factor": 1})
    launched = place.start("launch", config, "--restarts", "1")

    for time in range(2):
        wait_until(lambda: launched.errors.count("mesh 'pair' at") > time, f"mesh {time}")  # noqa: B023 it is called within the turn
        launched.child("pendulum").send_signal(number)

    assert launched.wait() == 4
    place.assert_nothing_left()
    assert launched.errors.count("starts again") == 1
    assert f"node 'pendulum' was lost: {how}" in launched.errors.splitlines()[-1]


def test_a_node_that_is_killed_before_the_first_point_is_named(place: Place) -> None:
    launched = place.start("launch", write_config(place.folder, stop_time=FAR_S))
    place.note()

    launched.child("pendulum").kill()

    assert launched.wait() == 4
    assert "node 'pendulum' was lost: its process was ended by SIGKILL" in launched.message
    place.assert_nothing_left()


@pytest.mark.parametrize("victim", ["pendulum", "master", "gateway"])
def test_process_stopped_before_it_has_met_others_is_named_long_before_deadline(place: Place, victim: str) -> None:
    sections: dict[str, dict[str, Any]] = {"timeouts": {"start": 10 * DEADLINE_S, "link": 4.0}}
    if victim == "gateway":
        sections["ros"] = {"profile": "ros2dds", "distribution": "jazzy"}
    config = write_config(place.folder, stop_time=FAR_S, **sections)  # type: ignore[arg-type]  # they are sections
    place.hold({"pendulum": "node pendulum"}.get(victim, f"{victim} pair"))

    launched = place.start("launch", config)

    assert launched.wait(30.0) == 4
    who = {"pendulum": "node 'pendulum'", "master": "the master", "gateway": "the gateway to ROS"}[victim]
    assert f"{who} was lost: its process is stopped" in launched.message
    place.assert_nothing_left()


def test_a_process_that_goes_on_in_time_is_not_lost(place: Place) -> None:
    config = write_config(place.folder)
    place.hold("node pendulum")
    launched = place.start("launch", config)
    child = launched.child("pendulum")
    wait_until(lambda: child.status() == psutil.STATUS_STOPPED, "a stopped node")
    place.note()

    child.resume()

    assert launched.wait() == 0, launched.errors
    assert len(rows_of(config.with_suffix(".csv"))) == 1001


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT], ids=lambda number: number.name)
def test_a_signal_of_somebody_else_to_master_is_loss_and_says_which(place: Place, number: signal.Signals) -> None:
    launched, result = started(place, {"real_time_factor": 1}, 300)

    launched.child("master").send_signal(number)

    assert launched.wait() == 4
    assert f"the master was lost: its process received {number.name}" in launched.message
    assert f"({len(rows_of(result))} rows) is in '{result}'" in launched.message
    point_in(launched.message)
    place.assert_nothing_left()
    assert_is_what_one_process_calculates(place, result)


def test_a_run_whose_master_somebody_else_ends_starts_again_if_it_may(place: Place) -> None:
    config = write_config(place.folder, stop_time=3.0, simulation={"real_time_factor": 1})
    result = config.with_suffix(".csv")
    launched = place.start("launch", config, "--restarts", "1")
    wait_until(lambda: row_count(result) > 300, "300 rows")

    launched.child("master").terminate()

    said = launched.wait_for_error_line("starts again")
    assert "the master was lost: its process received SIGTERM" in said
    assert launched.wait() == 0
    assert len(rows_of(result)) == 3001
    place.assert_nothing_left()


def test_a_gateway_that_somebody_else_ends_is_lost(place: Place) -> None:
    ros = {"profile": "ros2dds", "distribution": "jazzy"}
    config = write_config(place.folder, stop_time=FAR_S, simulation={"real_time_factor": 1}, ros=ros)
    launched = place.start("launch", config)
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 100, "100 rows")

    launched.child("gateway").terminate()

    assert launched.wait() == 4
    said = launched.errors.splitlines()[-1]
    assert "the gateway to ROS was lost: its process was asked to end by a signal" in said
    place.assert_nothing_left()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT], ids=lambda number: number.name)
def test_a_node_that_somebody_else_ends_is_lost_and_named(place: Place, number: signal.Signals) -> None:
    launched, result = started(place, {"real_time_factor": 1}, 100)

    launched.child("pendulum").send_signal(number)

    assert launched.wait() == 4
    text = f"node 'pendulum' was lost: its process was told to end ({number.name} was received)"
    assert text in launched.message
    place.assert_nothing_left()
    assert_is_what_one_process_calculates(place, result)


@pytest.mark.parametrize("step_s", [0.3, 0.15])
def test_a_healthy_mesh_with_a_short_deadline_for_steps_is_left_alone(place: Place, step_s: float) -> None:
    """Its master grants a point a second: what it says in between is that it lives."""
    config = write_config(
        place.folder,
        stop_time=2.0,
        simulation={"step_size": 1.0, "real_time_factor": 1},
        timeouts={"step": step_s},
    )

    launched = place.run("launch", config)

    assert launched.wait() == 0, launched.story()


def test_ctrl_c_ends_a_run_that_may_start_again(place: Place) -> None:
    config = write_config(place.folder, stop_time=FAR_S, simulation={"real_time_factor": 1})
    launched = place.start("launch", config, "--restarts", "3")
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 100, "100 rows")

    launched.signal(signal.SIGINT)

    assert launched.wait() == 130
    assert "starts again" not in launched.errors
    place.assert_nothing_left()


def test_restarts_do_not_go_together_with_one_process(place: Place) -> None:
    launched = place.run("launch", write_config(place.folder), "--restarts", "1", "--local")

    assert launched.wait() == 2
    assert "--restarts and --local do not go together" in launched.message


@pytest.mark.parametrize(("simulation", "rows"), [FAST, PACED])
def test_when_launcher_is_killed_its_children_end_and_remove_their_files(
    place: Place, simulation: dict[str, float], rows: int
) -> None:
    launched, result = started(place, simulation, rows)
    assert place.extracted()

    launched.signal(signal.SIGKILL)

    assert launched.wait() == -signal.SIGKILL
    place.assert_nothing_left(within_s=15.0)
    assert_is_what_one_process_calculates(place, result)


def test_a_launcher_that_is_killed_while_the_processes_start_leaves_nothing_either(place: Place) -> None:
    launched = place.start("launch", write_config(place.folder, stop_time=FAR_S))
    launched.child("delay")

    launched.signal(signal.SIGKILL)

    launched.wait()
    wait_until(lambda: not place.processes(), "the end of the children", 15.0)
    # What they could not remove because nobody had told them whose it is, the next run removes.
    assert place.run("launch", write_config(place.folder, name="next", stop_time=0.01)).wait() == 0
    place.assert_nothing_left()


@pytest.mark.parametrize("victim", ["pendulum", "delay", "master"])
@pytest.mark.parametrize(("simulation", "rows"), [FAST, PACED])
def test_a_process_that_stays_stopped_is_named_at_deadline_of_a_step(
    place: Place, victim: str, simulation: dict[str, float], rows: int
) -> None:
    launched, result = started(place, simulation, rows, timeouts={"step": 5.0})

    launched.child(victim).suspend()

    assert launched.wait(60.0) == 4
    place.assert_nothing_left()
    who = "the master was lost" if victim == "master" else f"node '{victim}', point"
    assert who in launched.message
    assert "its process is stopped (state T)" in launched.message
    assert_is_what_one_process_calculates(place, result)


def test_run_over_before_its_launcher_looks_is_run_like_any_other(place: Place) -> None:
    config = write_config(place.folder, stop_time=0.1)
    place.hold("node pendulum")
    launched = place.start("launch", config)
    children = [launched.child(role) for role in ("master", "delay", "pendulum")]
    launcher = psutil.Process(launched.pid)
    launcher.suspend()
    wait_until(lambda: children[-1].status() == psutil.STATUS_STOPPED, "a stopped node")
    children[-1].resume()
    wait_until(lambda: all(child.status() == psutil.STATUS_ZOMBIE for child in children), "the end of the processes")

    launcher.resume()

    assert launched.wait() == 0, launched.errors
    assert len(rows_of(config.with_suffix(".csv"))) == 101
    place.assert_nothing_left()


def test_a_killed_process_of_a_group_is_named_with_all_its_instances(place: Place) -> None:
    gains = {name: {"fmu": "Gain", "group": "both"} for name in ("first", "second")}
    config = write_config(
        place.folder,
        instances={"pendulum": {"fmu": "DampedPendulum"}, **gains},
        connections=["pendulum.a -> first.u", "first.y -> second.u"],
        stop_time=FAR_S,
        simulation={"real_time_factor": 1},
    )
    launched = place.start("launch", config)
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 100, "100 rows")

    launched.child("both").kill()

    assert launched.wait() == 4
    assert "instance first, second, point" in launched.message
    assert "node 'both' was lost" in launched.message
    place.assert_nothing_left()


def test_a_mesh_that_does_not_answer_keeps_nobody_from_another_one(place: Place) -> None:
    for name in ("one", "two"):
        place.start(
            "launch",
            write_config(place.folder, name=name, stop_time=FAR_S, simulation={"real_time_factor": 1}),
        )
    results = [place.folder / f"{name}.csv" for name in ("one", "two")]
    wait_until(lambda: min(map(row_count, results)) > 10, "rows")
    for process in place.processes():  # a launcher that is stopped, too, does not end its mesh meanwhile
        if any("two" in part for part in process.cmdline()):
            process.suspend()

    status = place.run("status", "one", "--timeout", "10")
    both = place.run("ls", "--timeout", "10")

    assert status.wait() == 0
    assert "running" in status.output
    assert both.wait() == 4
    assert "one" in both.output
    assert both.message.startswith("fmu-mesh: mesh 'two' did not answer at unixsock-stream/")
