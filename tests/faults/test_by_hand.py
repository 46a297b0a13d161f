"""Nodes and master that a person starts in separate terminals: the same job as `launch`, and what can go wrong."""

from __future__ import annotations

import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fmu_mesh.instances.fmi.archive.reading import read_description
from fmus.build import build
from tests.fmus.helpers import NO_COMPILER
from tests.fmus.packing import unpacked
from tests.helpers import (
    DEADLINE_S,
    FMUS,
    Launched,
    Place,
    on_a_busy_machine,
    row_count,
    rows_of,
    wait_until,
    write_config,
)


def start(place: Place, config: Path, role: str, *options: str) -> Launched:
    """Start the master, or the node of this name."""
    return place.start("master", config, *options) if role == "master" else place.start("node", config, role, *options)


def wait_until_there(place: Place, count: int) -> None:
    """Wait until so many processes listen for others."""
    wait_until(lambda: len(place.sockets()) == count, f"{count} processes that listen")


@pytest.mark.parametrize(
    "order",
    [("pendulum", "delay", "master"), ("master", "delay", "pendulum"), ("delay", "master", "pendulum")],
    ids=", ".join,
)
def test_processes_started_by_hand_in_any_order_do_same_job_as_launch(place: Place, order: tuple[str, ...]) -> None:
    config = write_config(place.folder)
    result = config.with_suffix(".csv")
    assert place.run("launch", config).wait() == 0
    expected = result.read_bytes()
    result.unlink()

    by_hand = {}
    for number, role in enumerate(order, 1):
        by_hand[role] = start(place, config, role)
        if number < len(order):
            wait_until_there(place, number)

    assert {role: launched.wait() for role, launched in by_hand.items()} == dict.fromkeys(order, 0)
    assert result.read_bytes() == expected
    assert "1000 points in" in by_hand["master"].output
    place.assert_nothing_left()


@pytest.mark.parametrize("order", [("pendulum", "master"), ("master", "pendulum")], ids=", ".join)
def test_a_node_that_nobody_starts_is_named_after_the_deadline(place: Place, order: tuple[str, ...]) -> None:
    config = write_config(place.folder, timeouts={"start": 2.0})

    by_hand = {}
    for number, role in enumerate(order, 1):
        by_hand[role] = start(place, config, role)
        if number < len(order):
            wait_until_there(place, number)

    assert {role: launched.wait() for role, launched in by_hand.items()} == dict.fromkeys(order, 4)
    assert "node 'delay'" in by_hand["master"].message
    assert "within 2 s" in by_hand["master"].message
    message = by_hand["pendulum"].message  # the master tells those that have registered
    assert "within 2 s" in message or "the master is gone" in message
    place.assert_nothing_left()


def test_a_node_without_a_master_gives_up_after_the_deadline(place: Place) -> None:
    launched = place.run("node", write_config(place.folder, timeouts={"start": 1.0}), "pendulum")

    assert launched.wait() == 4
    assert "the master" in launched.message
    assert "within 1 s" in launched.message
    place.assert_nothing_left()


def test_a_second_master_of_a_mesh_is_refused_and_first_goes_on(place: Place) -> None:
    config = write_config(place.folder)
    first = start(place, config, "master")
    place.note()

    second = start(place, config, "master", "--output", "second.csv")

    assert second.wait() == 2
    assert "already" in second.message
    nodes = [start(place, config, name) for name in ("pendulum", "delay")]
    assert [launched.wait() for launched in (first, *nodes)] == [0, 0, 0]
    assert len(rows_of(config.with_suffix(".csv"))) == 1001
    place.assert_nothing_left()


def test_a_second_process_for_a_node_is_refused_and_first_goes_on(place: Place) -> None:
    config = write_config(place.folder)
    first = start(place, config, "pendulum")
    wait_until_there(place, 1)

    second = start(place, config, "pendulum")

    assert second.wait() == 2
    assert "already" in second.message
    others = [start(place, config, role) for role in ("delay", "master")]
    assert [launched.wait() for launched in (first, *others)] == [0, 0, 0]
    place.assert_nothing_left()


def test_a_node_with_another_configuration_is_refused_with_the_reason(place: Place) -> None:
    config = write_config(place.folder)
    master = start(place, config, "master")
    place.note()

    other = place.run("node", config, "pendulum", "--set", "pendulum.l=2")

    assert other.wait() == 4
    assert "node 'pendulum'" in other.message
    assert "has another configuration, not that of the master" in other.message
    nodes = [start(place, config, name) for name in ("pendulum", "delay")]  # the master has only refused that one
    assert [launched.wait() for launched in (master, *nodes)] == [0, 0, 0]
    place.assert_nothing_left()


def test_a_master_that_waits_in_vain_says_whom_it_has_refused(place: Place) -> None:
    config = write_config(place.folder, timeouts={"start": on_a_busy_machine(3.0)})
    master = start(place, config, "master")
    place.note()

    place.run("node", config, "pendulum", "--set", "pendulum.l=2")

    assert master.wait() == 4
    assert "Refused: node 'pendulum' (process " in master.message
    assert "has another configuration, not that of the master" in master.message
    place.assert_nothing_left()


def gains(place: Place, name: str, fmu: Path) -> Path:
    """A configuration in a folder of its own with two Gains, of which the second is ``fmu``."""
    folder = place.folder / name
    folder.mkdir()
    instances: dict[str, dict[str, Any]] = {
        "first": {"fmu": "Gain", "start_values": {"u": 1.5}},
        "second": {"fmu": str(fmu)},
    }
    return write_config(folder, instances=instances, connections=["first.y -> second.u"], timeouts={"start": 60.0})


def archive_of_other_gain(place: Place, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An FMU with the description and the GUID of Gain that computes something else."""
    if NO_COMPILER is not None:
        pytest.skip(NO_COMPILER)
    sources = shutil.copytree(FMUS / "src", place.folder / "src")
    program = sources / "Gain" / "Gain.c"
    text = program.read_text(encoding="utf-8")
    assert "s->k * s->u" in text
    program.write_text(text.replace("s->k * s->u", "s->k * s->u * 1.001"), encoding="utf-8")
    guid = read_description(FMUS / "Gain.fmu").guid
    monkeypatch.setattr("fmus.build.guid_of", lambda *_: guid)
    return build(sources / "Gain", place.folder / "other")


def folder_of_other_gain(place: Place, _monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = unpacked(place.folder / "other")
    (folder / "resources").mkdir()
    (folder / "resources" / "table.txt").write_text("1", encoding="utf-8")
    return folder


@pytest.mark.parametrize("other", [archive_of_other_gain, folder_of_other_gain])
def test_a_node_with_another_fmu_of_the_same_guid_is_refused(
    place: Place, monkeypatch: pytest.MonkeyPatch, other: Callable[[Place, pytest.MonkeyPatch], Path]
) -> None:
    fmu = other(place, monkeypatch)
    assert read_description(fmu) == read_description(FMUS / "Gain.fmu")
    config = gains(place, "a", FMUS / "Gain.fmu")
    master, first = [start(place, config, role) for role in ("master", "first")]
    wait_until_there(place, 2)

    other_second = start(place, gains(place, "b", fmu), "second")

    assert other_second.wait() == 4
    assert "has another model of 'second', not that of the master" in other_second.message
    second = start(place, config, "second")  # the others have not noticed
    assert [launched.wait() for launched in (master, first, second)] == [0, 0, 0]
    assert len(rows_of(config.with_suffix(".csv"))) == 1001
    place.assert_nothing_left()


def test_the_same_fmu_may_lie_elsewhere_on_the_host_of_a_node(place: Place) -> None:
    copy = Path(shutil.copy(FMUS / "Gain.fmu", place.folder / "copied.fmu"))
    config = gains(place, "a", FMUS / "Gain.fmu")
    started = [start(place, config, role) for role in ("master", "first")]

    started.append(start(place, gains(place, "b", copy), "second"))

    assert [launched.wait() for launched in started] == [0, 0, 0]
    assert len(rows_of(config.with_suffix(".csv"))) == 1001


def test_a_node_of_another_version_of_ours_is_refused(place: Place) -> None:
    config = write_config(place.folder, timeouts={"start": on_a_busy_machine(5.0)})
    master = start(place, config, "master")
    place.note()
    program = (
        "import sys, fmu_mesh; fmu_mesh.__version__ = '0.0.1'; from fmu_mesh.__main__ import main; sys.exit(main())"
    )

    node = place.start_command([sys.executable, "-c", program, "node", str(config), "pendulum"])

    assert node.wait() == 4
    assert "has another version of fmu_mesh than " in node.message
    assert master.wait() == 4
    assert "Refused: node 'pendulum'" in master.message
    place.assert_nothing_left()


@pytest.mark.parametrize("name", ["pendulun", "mesh"])
def test_an_unknown_node_is_told_with_the_names_that_there_are(place: Place, name: str) -> None:
    launched = place.run("node", write_config(place.folder), name)

    assert launched.wait() == 2
    assert f"there is no node '{name}'; there are: pendulum, delay" in launched.message
    assert ("Did you mean 'pendulum'?" in launched.message) == (name == "pendulun")
    place.assert_nothing_left()


@pytest.mark.parametrize("victim", ["master", "pendulum"])
def test_when_process_started_by_hand_is_killed_others_end_and_say_so(place: Place, victim: str) -> None:
    config = write_config(place.folder, stop_time=10_000.0, simulation={"real_time_factor": 1})
    by_hand = {role: start(place, config, role) for role in ("pendulum", "delay", "master")}
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 100, "100 rows")

    by_hand.pop(victim).signal(signal.SIGKILL)

    assert {launched.wait() for launched in by_hand.values()} == {4}
    for launched in by_hand.values():
        assert ("the master" if victim == "master" else "node 'pendulum' was lost") in launched.message
    assert len(rows_of(config.with_suffix(".csv"))) > 100
    place.assert_nothing_left()  # the others have tidied up for the one that was killed


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL], ids=lambda number: number.name)
def test_master_that_ends_before_all_nodes_are_there_ends_those_that_are(place: Place, number: signal.Signals) -> None:
    """Long before the deadline of the start: what it waited for cannot come any more."""
    config = write_config(place.folder, timeouts={"start": 10 * DEADLINE_S})
    master = start(place, config, "master")
    place.note()
    node = start(place, config, "pendulum")
    wait_until(lambda: "waiting for the mesh" in place.run("status", "pendulum").output, "a node that waits")

    master.signal(number)

    assert master.wait() == (130 if number == signal.SIGINT else -signal.SIGKILL)
    assert node.wait() in (4, 130)
    place.assert_nothing_left()


def test_ctrl_c_at_the_master_started_by_hand_ends_the_nodes_too(place: Place) -> None:
    config = write_config(place.folder, stop_time=10_000.0)
    by_hand = {role: start(place, config, role) for role in ("pendulum", "delay", "master")}
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 100, "100 rows")

    by_hand["master"].signal(signal.SIGINT)

    assert {launched.wait() for launched in by_hand.values()} == {130}
    for launched in by_hand.values():
        assert "SIGINT was received" in launched.message
    assert rows_of(config.with_suffix(".csv"))
    place.assert_nothing_left()


@pytest.mark.parametrize("next_start", ["launch", "node"])
def test_what_a_killed_process_has_left_is_removed_by_the_next_start(place: Place, next_start: str) -> None:
    config = write_config(place.folder, timeouts={"start": 60.0})
    killed = start(place, config, "pendulum")
    wait_until(place.extracted, "an FMU that is extracted")
    killed.signal(signal.SIGKILL)
    killed.wait()
    assert place.extracted()

    if next_start == "launch":
        assert place.run("launch", config).wait() == 0
    else:
        by_hand = [start(place, config, role) for role in ("pendulum", "delay", "master")]
        assert [launched.wait() for launched in by_hand] == [0, 0, 0]

    place.assert_nothing_left()


def test_the_next_start_removes_what_a_killed_local_run_left(place: Place) -> None:
    config = write_config(place.folder, stop_time=10_000.0)
    killed = place.start("launch", config, "--local")
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 100, "100 rows")
    killed.signal(signal.SIGKILL)
    killed.wait()
    assert place.extracted()

    assert place.run("launch", write_config(place.folder), "--local").wait() == 0

    place.assert_nothing_left()
