"""`run`: one FMU as a free-running node, with inputs from any Zenoh program."""

from __future__ import annotations

import json
import signal
from typing import Any

import pytest
import zenoh

from tests.helpers import DEADLINE_S, FMUS, Place, rows_of, wait_until, write_config


def ask(session: zenoh.Session, key: str, value: object, attachment: str | None = None) -> Any:  # noqa: ANN401 JSON
    """The answer to a query with a value, as soon as it is not refused: first the FMU has to be loaded and to run."""

    def answer() -> zenoh.Sample | None:
        replies = list(session.get(key, payload=json.dumps(value), attachment=attachment, timeout=DEADLINE_S))
        return next((reply.ok for reply in replies if reply.ok is not None), None)

    return json.loads(wait_until(answer, f"an answer from {key}").payload.to_bytes())


def test_inputs_follow_their_time_stamps_and_run_ends_at_its_stop_time(place: Place) -> None:
    output = place.folder / "result.csv"
    process = place.start(
        "run", FMUS / "Gain.fmu", "--name", "amplifier", "--set", "k=2", "--step-size", "0.5",
        "--real-time-factor", "100", "--stop-time", "400", "--output", output, "--no-progress",
    )  # fmt: skip
    root = "fmu_mesh/amplifier/amplifier"
    with place.session() as session:
        ask(session, "fmu_mesh/amplifier/mesh/command", {"command": "pause"})
        for time, value in ((300.0, 1.0), (302.0, 5.0), (303.0, 5.0), (301.0, 3.0)):
            answer = ask(session, f"{root}/set/u", value, json.dumps({"time": time}))
            assert answer["time"] == time
        ask(session, "fmu_mesh/amplifier/mesh/command", {"command": "resume"})

    assert process.wait() == 0, process.errors
    used = {time: value / 2.0 for time, value in rows_of(output)}
    assert len(used) == 801
    # The step from 300 s uses the input at 300 s; its output is that of 300.5 s.
    assert [used[t + 0.5] for t in (300.0, 300.5, 301.0, 301.5, 302.0, 302.5, 399.5)] == [
        1.0,
        2.0,
        3.0,
        4.0,
        5.0,
        5.0,
        5.0,
    ]
    assert process.output.splitlines()[-1].startswith("800 points in ")
    place.assert_nothing_left()


@pytest.mark.parametrize("window", ["1", "1000"])
def test_an_input_of_a_mesh_holds_from_its_time_for_all_instances(place: Place, window: str) -> None:
    config = write_config(
        place.folder,
        instances={"free": {"fmu": "Gain"}, "pendulum": {"fmu": "DampedPendulum"}},
        connections=[],
    )
    process = place.start("launch", config, "--paused", "--window", window, "--no-progress")
    with place.session() as session:
        for time, value in ((0.5, 3.0), (0.25, 2.0), (0.9, 4.0)):
            answer = ask(session, "fmu_mesh/pair/free/set/u", value, json.dumps({"time": time}))
            assert answer["time"] == time
        ask(session, "fmu_mesh/pair/mesh/command", {"command": "resume"})

    assert process.wait() == 0, process.errors
    rows = rows_of(config.with_suffix(".csv"))
    expected = [0.0] * 251 + [2.0] * 250 + [3.0] * 400 + [4.0] * 100
    assert [row[1] for row in rows] == expected


def test_it_runs_by_wall_clock_until_it_is_interrupted_and_leaves_nothing(place: Place) -> None:
    process = place.start("run", FMUS / "DampedPendulum.fmu", "--no-progress")
    status = wait_until(lambda: place.run("status", "--json").output, "a status")
    wait_until(lambda: '"state":"running"' in place.run("status", "--json").output, "a running mesh")

    info = place.run("info", "DampedPendulum").output
    process.signal(signal.SIGINT)

    assert process.wait() == 130
    assert '"mesh":"DampedPendulum"' in status
    assert "0 s to an open end in steps of 0.002 s" in info
    assert "interrupted" in process.message
    place.assert_nothing_left()


def test_options_that_do_not_fit_are_told_by_their_names(place: Place) -> None:
    process = place.run("run", FMUS / "Gain.fmu", "--stop-time", "0.055", "--set", "q=1", "--real-time-factor", "-1")

    assert process.wait() == 2
    for option in ("--stop-time 0.055: ", "--set q=1: ", "--real-time-factor -1: "):
        assert option in process.errors
    place.assert_nothing_left()


def test_what_is_no_fmu_is_refused(place: Place) -> None:
    process = place.run("run", place.folder / "none.fmu")

    assert process.wait() == 2
    assert "does not exist" in process.message
