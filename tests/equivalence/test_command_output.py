"""What commands print for programs and for people: `--json`, `--quiet`, `NO_COLOR` and `FORCE_COLOR`."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest

from tests.helpers import DEADLINE_S, FMUS, Launched, Place, row_count, wait_until, write_config

LOCAL = pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])
PACED = {"real_time_factor": 1.0, "step_size": 0.01}
FIELDS = {
    "mesh", "state", "exit_code", "point", "time", "seconds", "rows", "file", "restarts", "resets", "error", "ended_by",
    "files", "warnings", "defects",
}  # fmt: skip


def report_of(launched: Launched) -> Any:  # noqa: ANN401 it is JSON
    """The one object on standard output, whose exit code is that of the process."""
    [line] = launched.output.splitlines()
    report = json.loads(line)
    assert report["exit_code"] == launched.wait()
    return report


@LOCAL
def test_a_launch_for_programs_prints_its_outcome_and_nothing_else(place: Place, options: tuple[str, ...]) -> None:
    config = write_config(place.folder)

    report = report_of(place.run("launch", config, "--json", "--plot", "p.png", *options))

    assert report.keys() == FIELDS
    assert report["seconds"] > 0.0
    assert {**report, "seconds": None} == {
        "mesh": "pair",
        "state": "done",
        "exit_code": 0,
        "point": 1000,
        "time": 1.0,
        "seconds": None,
        "rows": 1001,
        "file": str(place.folder / "pair.csv"),
        "restarts": 0,
        "resets": 0,
        "error": None,
        "ended_by": None,
        "files": [{"file": str(place.folder / "pair.csv"), "rows": 1001}],
        "warnings": [],
        "defects": {},
    }


@LOCAL
def test_a_launch_that_fails_prints_its_error_with_all_fields(
    place: Place, faulty: Path, options: tuple[str, ...]
) -> None:
    instances = {"faulty": {"fmu": str(faulty), "start_values": {"fail_at": 0.5}}}
    config = write_config(place.folder, instances=instances, connections=[])

    launched = place.run("launch", config, "--json", *options)

    report = report_of(launched)
    error = report["error"]
    assert (report["state"], report["exit_code"], report["point"], report["rows"]) == ("failed", 3, 500, 501)
    assert report["file"] == str(place.folder / "pair.csv")
    assert (error["kind"], error["instance"], error["point"], error["time"]) == ("StepFailed", "faulty", 500, 0.5)
    assert "the reactor is empty" in error["message"]
    assert "the reactor is empty" in launched.message  # a person sees it as well


def test_a_launch_of_a_wrong_file_prints_all_findings_with_their_places(place: Place) -> None:
    config = write_config(place.folder, connections=["pendulum.b -> delay.x", "pendulum.a -> dely.x"])

    report = report_of(place.run("launch", config, "--json"))

    assert (report["mesh"], report["state"], report["exit_code"]) == (None, "failed", 2)
    findings = report["error"]["findings"]
    assert [finding["path"] for finding in findings] == ["connections[0].from", "connections[1].to"]
    assert [finding["suggestion"] for finding in findings] == [None, "delay"]
    assert all(finding["line"] and finding["file"] == str(config) for finding in findings)
    assert report_of(place.run("check", config, "--json"))["error"]["findings"] == findings


@LOCAL
def test_an_interrupted_launch_says_how_far_it_came(place: Place, options: tuple[str, ...]) -> None:
    config = write_config(place.folder, stop_time=3600.0, simulation=PACED)
    launched = place.start("launch", config, "--json", *options)
    wait_until(lambda: row_count(place.folder / "pair.csv") > 10, "some rows")

    launched.signal(signal.SIGINT)
    launched.wait()

    report = report_of(launched)
    assert (report["exit_code"], report["error"]["kind"]) == (130, "Interrupted")
    assert report["rows"] == row_count(place.folder / "pair.csv") == report["point"] + 1


def test_a_free_running_fmu_says_how_it_ended(place: Place) -> None:
    launched = place.start("run", FMUS / "Gain.fmu", "--json")
    place.run("wait")
    place.run("stop", "--quiet")
    launched.wait()

    report = report_of(launched)
    assert (report["mesh"], report["state"], report["file"]) == ("Gain", "done", None)
    assert report["ended_by"]["kind"] == "TerminationRequested"


def test_a_check_for_programs_prints_the_plan(place: Place) -> None:
    config = write_config(place.folder)

    report = report_of(place.run("check", config, "--json", "--window", "8", "--set", "pendulum.l=2"))

    plan = report["plan"]
    assert (report["file"], report["error"], plan["mesh"], plan["window"]) == (str(config), None, "pair", 8)
    assert (plan["order"], plan["last_point"], plan["cycles"]) == (["pendulum", "delay"], 1000, [])
    [connection] = plan["connections"]
    assert (connection["from"], connection["to"], connection["delay"]) == ("pendulum.a", "delay.x", 0)
    assert plan["instances"][0]["start_values"] == {"l": 2.0}
    assert plan["recorded"] == ["pendulum.a", "pendulum.der(a)", "pendulum.der(a,2)", "delay.y"]
    assert plan["result_file"] == str(place.folder / "pair.csv")
    [record] = plan["records"]
    assert record == {"file": plan["result_file"], "variables": plan["recorded"], "first": 0, "every": 1}


def test_options_of_a_launch_replace_keys_of_the_file(place: Place) -> None:
    config = write_config(place.folder)
    options = (
        "--step-size",
        "0.01",
        "--stop-time",
        "0.5",
        "--algorithm",
        "jacobi",
        "--set-config",
        "record.variables=[delay.y]",
    )

    distributed, local = (place.run("launch", config, "-q", *options, *way) for way in ((), ("--local",)))

    assert (distributed.wait(), local.wait()) == (0, 0)
    header, *rows = (place.folder / "pair.csv").read_text().splitlines()
    assert (header, len(rows), rows[-1].partition(",")[0]) == ("time,delay.y", 51, "0.5")


@LOCAL
def test_a_quiet_launch_prints_nothing(place: Place, options: tuple[str, ...]) -> None:
    config = write_config(place.folder)

    launched = place.run("launch", config, "--quiet", *options)

    assert (launched.wait(), launched.output, launched.errors) == (0, "", "")
    assert row_count(place.folder / "pair.csv") == 1001


def test_a_quiet_command_still_tells_errors(place: Place) -> None:
    for command in ("launch", "check"):
        done = place.run(command, place.folder / "gone.yaml", "-q")
        assert (done.wait(), done.output) == (2, "")
        assert "no such file" in done.message
    assert place.run("check", write_config(place.folder), "-q").output == ""


def on_a_terminal(
    place: Place,
    *arguments: str | Path,
    environment: Mapping[str, str] = MappingProxyType({}),
    looked: Callable[[bytes], object] = len,
) -> bytes:
    """All that a command writes to a terminal; ``looked`` is called with what it has written, whenever that is more."""
    own, other = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "fmu_mesh", *map(str, arguments)],
        cwd=place.folder,
        env={**place.environment, "TERM": "xterm-256color", **environment},
        stdin=subprocess.DEVNULL,
        stdout=other,
        stderr=other,
    ) as process:
        os.close(other)
        written = b""
        while data := _read(own):
            written += data
            looked(written)
        assert process.wait(DEADLINE_S) == 0, written
    os.close(own)
    return written


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 1 << 16)
    except OSError:  # nobody holds the other end any more
        return b""


def messages_of(place: Place) -> Path:
    """The configuration of a mesh that warns, and that lasts as long as some looks of a terminal."""
    return write_config(
        place.folder, stop_time=1.0, simulation=PACED, zenoh={"listen": ["tcp/0.0.0.0:0"], "insecure": True}
    )


@pytest.mark.parametrize(
    ("environment", "escapes"), [({"NO_COLOR": "1"}, False), ({"NO_COLOR": "1", "FORCE_COLOR": "1"}, False), ({}, True)]
)
def test_no_color_leaves_no_escape_sequence_on_a_terminal(
    place: Place, environment: Mapping[str, str], *, escapes: bool
) -> None:
    written = on_a_terminal(place, "launch", messages_of(place), environment=environment)

    assert b"whoever can reach this host" in written
    assert (b"\x1b" in written) == escapes


def test_no_color_makes_top_print_plain_tables(place: Place) -> None:
    config = write_config(place.folder, stop_time=3600.0, simulation=PACED)
    launched = place.start("launch", config, "-q")
    place.run("wait")

    def stop_after_two(written: bytes) -> None:
        if launched.running and written.count(b"pair: running") > 1:
            place.run("stop")

    written = on_a_terminal(place, "top", "--interval", "0.1", environment={"NO_COLOR": "1"}, looked=stop_after_two)

    assert written.count(b"pair: running") > 1
    assert b"\x1b" not in written


@pytest.mark.parametrize(("environment", "escapes"), [({}, False), ({"FORCE_COLOR": "1"}, True)])
def test_a_pipe_gets_colours_only_by_force(place: Place, environment: dict[str, str], *, escapes: bool) -> None:
    place.environment.update(environment)

    launched = place.run("launch", messages_of(place))

    assert "whoever can reach this host" in launched.errors
    assert ("\x1b[33m" in launched.errors) == escapes
    assert "\x1b[?25l" not in launched.errors  # no progress line in a pipe


def test_with_several_meshes_a_command_without_a_name_lists_them(place: Place) -> None:
    for name in ("one", "two"):
        place.start("launch", write_config(place.folder, name=name, stop_time=3600.0, simulation=PACED), "-q")
        assert place.run("wait", name).wait() == 0

    assert place.run("pause").message == "fmu-mesh: 2 meshes are running: one, two. Give the name of one."
    assert place.run("step", "10").message == "fmu-mesh: 2 meshes are running: one, two. Give the name of one."
    assert "as in 'one/INSTANCE.VARIABLE'" in place.run("get", "delay.y").message
    assert "fmu_mesh/two/delay/out/y" in place.run("get", "two/delay.y").output
    assert place.run("stop", "two").output.startswith("mesh 'two' is stopping at point")


def test_a_log_is_followed_to_the_end_of_the_mesh(place: Place) -> None:
    config = write_config(place.folder, stop_time=3600.0, simulation=PACED)
    place.start("launch", config, "-q")
    assert place.run("wait").wait() == 0
    follower = place.start("logs", "-f", "--json", "--instance", "delay")
    with place.session() as session:
        session.put("fmu_mesh/pair/delay/set/x", "1")
        wait_until(lambda: follower.output, "the first message")
        session.put("fmu_mesh/pair/delay/set/x", "2")
        wait_until(lambda: follower.output.count("\n") == 2, "the second message")

    place.run("stop")

    assert follower.wait() == 0
    numbers = [json.loads(line)["number"] for line in follower.output.splitlines()]
    assert numbers == sorted(set(numbers))
