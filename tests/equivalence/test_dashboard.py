"""The dashboard as a process: who may open it, what it knows of a mesh, and that the run does not notice it."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import sys
from pathlib import Path

import psutil
import pytest

import fmu_mesh
from tests.dashboards import Dashboard
from tests.helpers import Place, rows_of, wait_until, write_config

KEY = "fmu_mesh/pair"
PACED = {"real_time_factor": 1.0, "step_size": 0.002}


def _reached(dashboard: Dashboard, key: str = KEY, run: int = 1) -> dict[str, dict[str, list[float]]]:
    """The curve of the pendulum as soon as it begins at the start of the run."""
    return wait_until(
        lambda: (
            found
            if (found := dashboard.curves(key, run, pendulum__a=0)) and _first_time(found["pendulum.a"]) == 0.0
            else None
        ),
        "the history from the start",
    )


def _first_time(curve: dict[str, list[float]]) -> float | None:
    """The time of the first value that a curve has."""
    return min(curve["tl"][0], curve["th"][0]) if curve["tl"] else None


def test_only_requests_with_token_and_a_name_of_this_host_get_page(place: Place) -> None:
    dashboard = Dashboard(place)

    inside, headers, page = dashboard.ask()
    stranger = dashboard.ask(headers={"Cookie": ""})
    script = dashboard.ask("/dashboard/static/plots.js", headers={"Cookie": "fmu_mesh_dashboard=x"})
    rebound = dashboard.ask(headers={"Host": f"evil.example:{dashboard.port}"})
    other_page = dashboard.ask("/dashboard/curves", b"{}", {"Origin": "http://127.0.0.1:1"})

    assert inside == 200
    assert b"http://" not in page.replace(b"http://www.w3.org/", b"")
    assert headers["x-frame-options"] == "DENY"
    assert [answer[0] for answer in (stranger, script, rebound, other_page)] == [403, 403, 403, 403]
    assert b"token" in stranger[2]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_arguments_of_a_browser_do_not_have_the_token(place: Place, number: signal.Signals) -> None:
    opened, browser = place.folder / "opened", place.folder / "browser"
    copied = (
        f'path="${{1#file://}}"; stat -c %a "$path" > {opened}.mode; cp "$path" {opened}.html; echo "$*" > {opened}'
    )
    browser.write_text(f"#!/bin/sh\n{copied}\n", encoding="utf-8")
    browser.chmod(0o755)
    place.environment |= {"BROWSER": f"{browser} %s"}

    process = place.start("dashboard")
    url = wait_until(lambda: re.search(r"dashboard: (http://\S+)\n", process.output), "the address")[1]
    wait_until(lambda: opened.is_file() and opened.read_text(encoding="utf-8").strip(), "the browser")
    arguments = opened.read_text(encoding="utf-8").split()
    process.signal(number)
    process.wait()

    [page] = [Path(argument.removeprefix("file://")) for argument in arguments]
    assert url.partition("token=")[2] not in str(arguments)
    assert opened.with_suffix(".mode").read_text(encoding="utf-8").strip() == "600"
    assert f"url={url}" in opened.with_suffix(".html").read_text(encoding="utf-8")
    assert not page.exists()


def test_ctrl_c_ends_it_and_leaves_nothing(place: Place) -> None:
    dashboard = Dashboard(place)
    dashboard.ask()

    dashboard.process.signal(signal.SIGINT)

    assert dashboard.process.wait() == 130
    assert dashboard.process.errors == ""
    place.assert_nothing_left()


def test_sigterm_ends_it_and_leaves_nothing(place: Place) -> None:
    dashboard = Dashboard(place)

    dashboard.process.signal(signal.SIGTERM)

    assert dashboard.process.wait() in (-signal.SIGTERM, 128 + signal.SIGTERM)
    assert dashboard.process.errors == ""
    place.assert_nothing_left()


def test_a_used_port_and_a_missing_mesh_are_errors_with_advice(place: Place) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        on_port = place.run("dashboard", "--no-browser", "--port", str(port))
    absent = place.run("dashboard", "--no-browser", "missing")
    elsewhere = place.run("dashboard", "--no-browser", "--host", "203.0.113.1")
    no_port = place.run("dashboard", "--port", "65536")

    assert [one.wait() for one in (on_port, absent, elsewhere, no_port)] == [2, 2, 2, 2]
    assert on_port.message == (
        f"fmu-mesh: port {port} of 127.0.0.1 is taken by another program. `--port 0` takes a free one."
    )
    assert "no mesh is running here" in absent.message
    assert "203.0.113.1" in elsewhere.message
    assert "0 to 65535" in no_port.message


def test_without_the_extra_it_says_how_to_install_it(place: Place) -> None:
    folder = place.folder / "site"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text('import sys\nsys.modules["nicegui"] = None\n')
    place.environment = {
        **place.environment,
        "PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]),
    }

    missing = place.run("dashboard", "--no-browser")

    assert missing.wait() == 2
    assert missing.message == (
        "fmu-mesh: dashboards need the library nicegui. "
        f"Install it with `{sys.executable} -m pip install 'nicegui<4,>=3.18'`."
    )


def test_beyond_loopback_it_warns(place: Place) -> None:
    dashboard = Dashboard(place, "--host", "0.0.0.0")  # noqa: S104  this is what is warned of

    assert "everybody who can reach 0.0.0.0" in dashboard.process.errors


@pytest.mark.parametrize("body", [b"", b"{", b'{"mesh":1}', b'{"mesh":"a","run":1,"curves":{},"x":1}', b"[" * 70_000])
def test_a_malformed_question_is_refused(place: Place, body: bytes) -> None:
    dashboard = Dashboard(place)

    assert dashboard.ask("/dashboard/curves", body)[0] == 400
    assert dashboard.curves("fmu_mesh/nobody", a__b=0) == {}


def test_history_begins_at_the_start_also_for_a_dashboard_that_comes_later(place: Place) -> None:
    config = write_config(place.folder, stop_time=3600.0, simulation=PACED)
    place.start("launch", config, "--no-progress")
    wait_until((place.folder / "pair.csv").exists, "the first row")
    wait_until(lambda: len((place.folder / "pair.csv").read_bytes()) > 20_000, "some rows")

    dashboard = Dashboard(place)
    curve = _reached(dashboard)["pendulum.a"]
    newer = wait_until(
        lambda: (
            found["pendulum.a"]
            if (found := dashboard.curves(KEY, pendulum__a=curve["version"]))  # type: ignore[arg-type]  # a number
            and max(found["pendulum.a"]["tl"]) > max(curve["tl"])
            else None
        ),
        "newer values",
    )
    place.run("stop", "pair")

    wait_until(lambda: not place.processes("master"), "the end of the mesh")
    rows = {time: values[0] for time, *values in rows_of(place.folder / "pair.csv")}
    for change in (curve, newer):
        assert all(rows[time] == value for time, value in zip(change["tl"], change["l"], strict=True))
        assert all(rows[time] == value for time, value in zip(change["th"], change["h"], strict=True))


def test_history_of_parquet_file_begins_at_start_and_stays_after_its_end(place: Place) -> None:
    # Of values that only grow, the first and the last one are also the smallest and the largest of their intervals.
    ramps = {name: {"fmu": "Integrator", "start_values": {"u": rate}} for name, rate in (("slow", 0.1), ("fast", 2.0))}
    config = write_config(
        place.folder,
        instances=ramps,
        connections=(),
        stop_time=3600.0,
        simulation=PACED,
        record={"file": "pair.parquet"},
    )
    stream = place.folder / "pair.parquet.arrows"
    place.start("launch", config, "--no-progress")
    wait_until(lambda: stream.exists() and stream.stat().st_size > 20_000, "some batches")

    dashboard = Dashboard(place)

    def from_the_start(name: str) -> dict[str, list[float]] | None:
        found = dashboard.curves(KEY, **{name.replace(".", "__"): 0}).get(name)
        return found if found and _first_time(found) == 0.0 else None

    early = wait_until(lambda: from_the_start("slow.y"), "the history from the start")
    place.run("stop", "pair")
    wait_until(lambda: not place.processes("master"), "the end of the mesh")
    result = fmu_mesh.Result.read(place.folder / "pair.parquet")

    def at_the_end(name: str) -> dict[str, list[float]] | None:
        found = from_the_start(name)
        return found if found and found["th"][-1] == result.times[-1] else None

    whole = wait_until(lambda: at_the_end("slow.y"), "all of it")
    late = wait_until(lambda: at_the_end("fast.y"), "a curve that was chosen after the end")
    for name, change in (("slow.y", early), ("slow.y", whole), ("fast.y", late)):
        rows = dict(zip(result.times.tolist(), result[name].tolist(), strict=True))
        assert all(rows[time] == value for time, value in zip(change["tl"], change["l"], strict=True))
        assert all(rows[time] == value for time, value in zip(change["th"], change["h"], strict=True))


def test_values_that_are_not_recorded_are_asked_for(place: Place) -> None:
    config = write_config(
        place.folder,
        stop_time=3600.0,
        simulation=PACED,
        record={"file": "pair.csv", "variables": ["pendulum.a"]},
    )
    place.start("launch", config, "--no-progress")

    dashboard = Dashboard(place)
    found = wait_until(
        lambda: len(dashboard.curves(KEY, delay__y=0).get("delay.y", {}).get("at", [])) > 3, "some values"
    )

    assert found
    place.run("stop", "pair")


def test_time_in_which_nobody_looked_is_a_gap_of_unrecorded_values(place: Place) -> None:
    config = write_config(
        place.folder,
        stop_time=3600.0,
        simulation=PACED,
        record={"file": "pair.csv", "variables": ["pendulum.a"]},
    )
    place.start("launch", config, "--no-progress")
    dashboard = Dashboard(place)

    def values_after(time: float) -> dict[str, list[float]] | None:
        found = dashboard.curves(KEY, delay__y=0).get("delay.y")
        return found if found and sum(own > time for own in found["th"]) > 5 else None

    before = wait_until(lambda: values_after(0.0), "some values")
    process = psutil.Process(dashboard.process.pid)
    process.suspend()
    try:
        asleep = max(before["th"]) + 2.0
        wait_until(lambda: json.loads(place.run("status", "pair", "--json").output)["time"] > asleep, "2 s")
    finally:
        process.resume()
    after = wait_until(lambda: values_after(asleep), "values after it woke")

    seen = [at for at, time in zip(after["at"], after["th"], strict=True) if time < asleep]
    assert seen[-1] in after["g"]
    assert len(after["g"]) < len(after["at"])
    place.run("stop", "pair")


def test_a_mesh_that_starts_later_appears_and_its_next_run_begins_anew(place: Place) -> None:
    dashboard = Dashboard(place)
    config = write_config(place.folder, stop_time=3600.0, simulation=PACED)

    for run in (1, 2):
        place.start("launch", config, "--no-progress")
        curve = _reached(dashboard, run=run)["pendulum.a"]
        assert curve["h"][0] == rows_of_first(place.folder / "pair.csv")  # the pendulum falls
        place.run("stop", "pair")
        wait_until(lambda: not place.processes("master"), "the end of the mesh")
    assert _reached(dashboard, run=2)  # what was seen stays


def rows_of_first(file: Path) -> float:
    """The first value of the first row."""
    return float(file.read_text().splitlines()[1].split(",")[1])


def test_a_mesh_that_was_reset_is_another_run_on_the_page(place: Place) -> None:
    config = write_config(place.folder, stop_time=60.0, simulation=PACED)
    mesh = place.start("launch", config, "--no-progress")
    place.note()
    dashboard = Dashboard(place)
    assert _reached(dashboard)

    assert place.run("reset", "pair", "--set", "pendulum.a=0.25").wait() == 0
    wait_until(lambda: _reached(dashboard, run=2), "the curve of the next run")

    mesh.signal(signal.SIGINT)
    mesh.wait()


def test_the_result_is_same_bytes_with_a_dashboard_that_reads_all_time(place: Place) -> None:
    config = write_config(place.folder, stop_time=20.0)
    place.run("launch", config, "--no-progress", "--output", place.folder / "alone.csv")

    dashboard = Dashboard(place)
    run = place.start("launch", config, "--no-progress", "--set", "pendulum.d=0.0")
    asked = 0
    while run.running:
        dashboard.curves(KEY, pendulum__a=0, delay__y=0, delay__d=0)
        asked += 1
    assert run.wait() == 0
    assert asked > 0

    alone = place.run("launch", config, "--no-progress", "--local", "--set", "pendulum.d=0.0", "--output", "again.csv")
    assert alone.wait() == 0
    assert (place.folder / "pair.csv").read_bytes() == (place.folder / "again.csv").read_bytes()


def test_curves_that_are_chosen_after_end_of_run_are_there_as_well(place: Place) -> None:
    config = write_config(place.folder, stop_time=2.0, simulation=PACED)
    dashboard = Dashboard(place)
    run = place.start("launch", config, "--no-progress")
    _reached(dashboard)
    assert run.wait() == 0

    last = wait_until(
        lambda: (
            found["delay.y"]
            if (found := dashboard.curves(KEY, delay__y=0)) and max(found["delay.y"]["th"], default=0.0) == 2.0
            else None
        ),
        "the last point of a new curve",
    )

    assert _first_time(last) == 0.0
