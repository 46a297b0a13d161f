"""FMUs that hang in any call, or do to their process what a library must not do: nobody else is hurt."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import psutil
import pytest

import fmu_mesh
from fmu_mesh.run.child import Child
from tests.fmus.helpers import NO_COMPILER, built_once
from tests.helpers import DEADLINE_S, Place, row_count, rows_of, wait_until, write_config

SHORT = {"call": 2.0, "step": 2.0, "terminate": 2.0, "start": 60.0, "initialize": 60.0}
STATE_FAULTS = (
    "chdir",
    "locale",
    "threadlocale",
    "rounding",
    "flushing",
    "traps",
    "handlers",
    "blocking",
    "umask",
    "environment",
)
CALLS = (
    "fmi2Instantiate",
    "fmi2SetupExperiment",
    "fmi2EnterInitializationMode",
    "fmi2ExitInitializationMode",
    "fmi2SetReal",
    "fmi2DoStep",
    "fmi2GetReal",
    "fmi2Terminate",
    "fmi2FreeInstance",
)


@pytest.fixture(scope="module")
def hostile() -> Path:
    """The FMU that does what its instance name says."""
    if NO_COMPILER is not None:
        pytest.skip(NO_COMPILER)
    return built_once(Path(__file__).parent / "fmus" / "Hostile")


def mesh_of(place: Place, hostile: Path, names: Sequence[str], *, group: str | None = None, **more: object) -> Path:
    """A chain of instances, each the third of the one before, for ten points; the last one is polite."""
    everyone = [*names, "polite"]
    return write_config(
        place.folder,
        instances={name: {"fmu": str(hostile)} | ({"group": group} if group else {}) for name in everyone},
        connections=[f"{a}.third -> {b}.u" for a, b in pairwise(everyone)],
        stop_time=float(str(more.pop("stop_time", 0.01))),
        **more,  # type: ignore[arg-type]  # sections of the file
    )


HANGS = [
    ("fmi2Instantiate", "fmi2Instantiate", "call", ""),
    ("fmi2ExitInitializationMode", "fmi2ExitInitializationMode", "call", ""),
    ("fmi2DoStep", "doStep", "step", ", point 4, t = 0.004 s"),
    ("fmi2GetReal", "reading the outputs", "step", ", point 4, t = 0.004 s"),
    ("fmi2SetReal", "setting the inputs", "step", ", point 5, t = 0.005 s"),
]


# A step that hangs in a node is in `test_failing_fmus`.
@pytest.mark.parametrize(
    ("options", "hang"),
    [*(((), hang) for hang in (*HANGS[:2], *HANGS[3:])), *((("--local",), hang) for hang in HANGS)],
    ids=lambda value: value[0] if value else "distributed",
)
def test_an_fmu_that_hangs_in_a_call_is_ended_and_named(
    place: Place, hostile: Path, hang: tuple[str, str, str, str], options: tuple[str, ...]
) -> None:
    function, said, setting, point = hang
    name = f"hang_{function}"
    config = mesh_of(place, hostile, ["first", name], timeouts=SHORT)

    launched = place.run("launch", config, *options)

    assert launched.wait() == 3
    assert launched.message.startswith(f"fmu-mesh: instance {name}{point}: the FMU has not returned for ")
    assert f" s from {said}{'' if options else '; its process is ended'}. " in launched.message
    assert f"`timeouts.{setting}`" in launched.message
    place.assert_nothing_left()


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])
@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("segfault_fmi2FreeInstance", ": the FMU ended its process in fmi2FreeInstance (SIGSEGV)"),
        ("abort_fmi2Terminate", ": the FMU ended its process in fmi2Terminate (SIGABRT)"),
        ("exit_fmi2FreeInstance", ": the FMU ended its process in fmi2FreeInstance (exit)"),
        ("hang_fmi2Terminate", "s from fmi2Terminate"),
    ],
)
def test_how_an_fmu_ends_after_the_last_row_is_a_warning(
    place: Place, hostile: Path, fault: str, says: str, options: tuple[str, ...]
) -> None:
    config = mesh_of(place, hostile, ["first", fault], timeouts=SHORT)

    launched = place.run("launch", config, *options)

    assert launched.wait() == 0
    assert f"warning: instance {fault}, point 10, t = 0.01 s: the FMU " in launched.output + launched.errors
    assert says in launched.output + launched.errors
    assert launched.output.splitlines()[-1].startswith("10 points in ")
    assert len(rows_of(config.with_suffix(".csv"))) == 11
    place.assert_nothing_left()


def test_a_node_that_is_lost_after_the_last_row_is_a_warning(place: Place, hostile: Path) -> None:
    config = mesh_of(place, hostile, ["kill_fmi2Terminate"])

    launched = place.run("launch", config)

    assert launched.wait() == 0
    assert (
        "warning: instance kill_fmi2Terminate, point 10, t = 0.01 s: node 'kill_fmi2Terminate' was lost: its process "
        "was ended by SIGKILL. Its FMU was in terminate or freeInstance. All rows are recorded."
    ) in launched.output
    assert len(rows_of(config.with_suffix(".csv"))) == 11
    place.assert_nothing_left()


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])
def test_a_thread_that_an_fmu_leaves_behind_costs_nothing(
    place: Place, hostile: Path, options: tuple[str, ...]
) -> None:
    launched = place.run("launch", mesh_of(place, hostile, ["thread_fmi2Instantiate"]), *options)

    assert launched.wait() == 0
    assert "warning" not in launched.output + launched.errors


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])
def test_what_an_fmu_says_in_terminate_is_shown(place: Place, hostile: Path, options: tuple[str, ...]) -> None:
    launched = place.run("launch", mesh_of(place, hostile, ["talker"]), *options)

    assert launched.wait() == 0
    assert "talker at point 10: farewell" in launched.errors


def test_an_fmu_that_crashes_at_its_end_costs_no_run_of_sweep(
    place: Place, hostile: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(place.folder / "run"))
    fault = "segfault_fmi2FreeInstance"
    config = mesh_of(place, hostile, [fault], timeouts=SHORT)

    with fmu_mesh.sweep(config, [{f"{fault}.u": float(k)} for k in range(4)], workers=1) as running:
        result = running.wait(DEADLINE_S)

    assert [row.exit_code for row in result] == [0] * 4
    assert {row.message for row in result} == {
        f"instance {fault}, point 10, t = 0.01 s: the FMU ended its process in fmi2FreeInstance (SIGSEGV)"
    }
    assert [float(result.curves(k)[f"{fault}.third"][-1]) for k in range(4)] == [k / 3.0 for k in range(4)]


def test_an_fmu_that_initializes_slowly_makes_no_node_miss_the_master(place: Place, hostile: Path) -> None:
    slow = mesh_of(place, hostile, ["slow_fmi2ExitInitializationMode"], timeouts={"step": 3.0})

    launched = place.run("launch", slow)

    assert launched.wait() == 0
    assert len(rows_of(slow.with_suffix(".csv"))) == 11


def test_a_step_that_hangs_in_group_is_told_of_instance_that_hangs(place: Place, hostile: Path) -> None:
    config = mesh_of(place, hostile, ["first", "hang_fmi2DoStep"], group="together", timeouts=SHORT)

    launched = place.run("launch", config)

    assert launched.wait() == 3
    assert launched.message.startswith("fmu-mesh: instance hang_fmi2DoStep, point 4, t = 0.004 s: the FMU has not ")
    place.assert_nothing_left()


def test_an_instance_without_a_step_does_not_hang_while_its_group_steps(place: Place, hostile: Path) -> None:
    config = write_config(
        place.folder,
        instances={
            "tardy_fmi2DoStep": {"fmu": str(hostile), "group": "together"},
            "rare": {"fmu": str(hostile), "group": "together", "step_size": 0.005},
        },
        connections=[],
        stop_time=0.010,
        timeouts={"step": 3.0},
    )

    launched = place.run("launch", config)

    assert launched.wait() == 0
    assert len(rows_of(config.with_suffix(".csv"))) == 11


def test_an_fmu_that_suddenly_becomes_slow_still_reports_its_progress(place: Place, hostile: Path) -> None:
    """More than four hundred steps take no time, and the next twelve together more than a mesh may stand still."""
    config = write_config(
        place.folder,
        instances={"tardy_fmi2DoStep": {"fmu": str(hostile)}},
        connections=[],
        stop_time=0.00461,
        simulation={"step_size": 1e-5},
        timeouts={"step": 3.0},
        record={"file": None},
    )

    assert place.run("launch", config).wait() == 0


@pytest.mark.parametrize("group", [None, "together"])
def test_slow_steps_one_after_other_may_take_longer_than_one_step_may(
    place: Place, hostile: Path, group: str | None
) -> None:
    names = [f"tardy{number}_fmi2DoStep" for number in range(7)]
    config = mesh_of(
        place, hostile, names, group=group, stop_time=0.006, timeouts={"step": 2.0}, simulation={"window": 1}
    )

    launched = place.run("launch", config)

    assert launched.wait() == 0
    assert len(rows_of(config.with_suffix(".csv"))) == 7


def test_a_step_that_wall_clock_was_waited_for_has_its_whole_time(place: Place, hostile: Path) -> None:
    """Points are seven seconds apart, and a mesh may stand still for six."""
    config = mesh_of(
        place,
        hostile,
        ["tardy_fmi2DoStep"],
        stop_time=2.0,
        timeouts={"step": 2.0},
        simulation={"step_size": 1.0, "real_time_factor": 1 / 7},
    )

    launched = place.run("launch", config)

    assert launched.wait() == 0
    assert len(rows_of(config.with_suffix(".csv"))) == 3


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("segfault_fmi2DoStep", "was ended by SIGSEGV"),
        ("segfault_fmi2Instantiate", "was ended by SIGSEGV"),
        ("exit_fmi2DoStep", "ended with exit code 0"),
    ],
)
def test_an_fmu_that_ends_its_process_ends_no_other(place: Place, hostile: Path, fault: str, says: str) -> None:
    launched = place.run("launch", mesh_of(place, hostile, [fault]))

    assert launched.wait() == 4
    assert f"instance {fault}, point " in launched.message
    assert f"node '{fault}' was lost: its process {says}" in launched.message
    place.assert_nothing_left()


@pytest.mark.parametrize("way", ["launch", "--local", "repeated", "open"])
def test_what_fmu_does_to_its_process_in_any_call_changes_no_result(place: Place, hostile: Path, way: str) -> None:
    faults = [f"{fault}_{function}" for fault in STATE_FAULTS for function in CALLS]
    faults.remove("traps_fmi2SetReal")  # its own doStep follows, and divides by zero
    config = write_config(
        place.folder,
        instances={
            name: {"fmu": str(hostile), "group": "together"} for name in ("polite", *faults, "leak_fmi2Instantiate")
        },
        connections=[
            f"polite.plain_locale -> {name}.u" for name in faults
        ],  # 1 from the first step on, so that all are alike
        stop_time=0.01,
    )

    seen = values_seen(place, config, way)

    folder = Path.cwd() if way in {"repeated", "open"} else place.folder
    alike = {"third": 1 / 3, "subnormal": 2e-310, "plain_locale": 1.0, "folder": folder.stat().st_ino, "undisturbed": 1}
    assert len(seen) == 5 * (len(faults) + 2)
    changed = [name for name, values in seen.items() if values[1:] != [alike[name.partition(".")[2]]] * 10]
    assert [name for name in changed if "_fmi2SetReal." not in name] == []  # whose own doStep follows
    place.assert_nothing_left()


def values_seen(place: Place, config: Path, way: str) -> dict[str, list[float]]:
    """All outputs at all points of a run of a mesh."""
    if way in {"launch", "--local"}:
        assert place.run("launch", config, *([way] if way == "--local" else [])).wait() == 0
        result = fmu_mesh.Result.read(config.with_suffix(".csv"))
        return {name: result[name].tolist() for name in result}
    mesh = fmu_mesh.load(config)
    if way == "repeated":
        with mesh.repeated() as runs:
            result = runs.run()
        return {name: result[name].tolist() for name in result}
    names = [
        f"{name}.{output}"
        for name in mesh.instances
        for output in ("third", "subnormal", "undisturbed", "folder", "plain_locale")
    ]
    seen: dict[str, list[float]] = {name: [] for name in names}
    with mesh.open() as system:
        for point in range(11):
            for name, values in seen.items():
                values.append(float(system.get(name)))
            if point < 10:
                system.step()
    return seen


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])
def test_what_fmu_does_to_floating_point_mode_changes_no_result_of_cycle(
    place: Place, hostile: Path, options: tuple[str, ...]
) -> None:
    results = []
    for name in ("peaceful", "flushing_fmi2DoStep"):
        config = write_config(
            place.folder,
            instances={own: {"fmu": str(hostile), "group": "together"} for own in (name, "polite")},
            connections=[f"{name}.third -> polite.u", f"polite.subnormal -> {name}.u"],
            stop_time=0.01,
        )
        assert place.run("launch", config, *options).wait() == 0
        results.append(rows_of(config.with_suffix(".csv")))

    assert results[0] == results[1]
    assert 0.0 < results[0][-1][1] < 2e-310


@pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])
def test_an_fmu_that_fills_standard_output_neither_blocks_nor_garbles_the_launcher(
    place: Place, hostile: Path, options: tuple[str, ...]
) -> None:
    config = mesh_of(place, hostile, ["flood_fmi2DoStep"])

    launched = place.run("launch", config, *options)

    assert launched.wait() == 0
    assert [line.split(" ")[0] for line in launched.output.splitlines()] == ["result:", "10"]
    if not options:
        assert "flood_fmi2DoStep | the flood begins" in launched.errors
        assert "(it writes a lot; nothing more of it is shown)" in launched.errors
        assert len(launched.errors) < 500_000
        assert "\033" not in launched.errors


def test_a_process_that_an_fmu_leaves_behind_ends_with_the_run(place: Place, hostile: Path) -> None:
    config = mesh_of(place, hostile, ["orphan_fmi2Instantiate"])

    launched = place.run("launch", config)

    assert launched.wait() == 0
    assert len(rows_of(config.with_suffix(".csv"))) == 11
    place.assert_nothing_left()


def test_a_daemon_that_an_fmu_starts_keeps_no_run_from_its_end(place: Place, hostile: Path) -> None:
    """It has left the session of its process, but not the pipe that was standard output there."""
    launched = place.run("launch", mesh_of(place, hostile, ["daemon_fmi2Instantiate"]))

    assert launched.wait() == 0
    assert [process.parent() for process in place.processes("node")]


# The FMU does it in each step; so that a signal hardly ever meets it there, the wall clock is waited for.
@pytest.mark.parametrize("fault", ["handlers_fmi2Instantiate", "handlers_fmi2DoStep", "blocking_fmi2DoStep"])
def test_an_fmu_that_ignores_signals_does_not_take_ctrl_c_away(place: Place, hostile: Path, fault: str) -> None:
    config = mesh_of(place, hostile, [fault], stop_time=1000.0, simulation={"real_time_factor": 0.01})
    launched = place.start("launch", config, "--local")
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 10, "10 rows")

    launched.signal(signal.SIGINT)

    assert launched.wait() == 130
    assert ": interrupted. " in launched.message
    place.assert_nothing_left()


_LEAVES_ONE = """
import os, signal
signal.signal(signal.SIGTERM, signal.SIG_IGN)
if (pid := os.fork()) == 0:
    while True:
        signal.pause()
print(pid, flush=True)
"""


class _KnownLate:
    """A process whose end is known to others before `wait` returns, as that of a process of the fork server."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 of any type
        return getattr(self._process, name)

    def wait(self) -> int:
        code = self._process.wait()
        threading.Event().wait(0.3)
        return code


def test_process_left_behind_is_killed_although_its_end_was_known_first() -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", _LEAVES_ONE],
        start_new_session=True,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    lines: list[bytes] = []
    known_late = cast("subprocess.Popen[bytes]", _KnownLate(process))  # it has all of that
    child = Child("one", known_late, lambda action: action())
    child.watch(lines.append, lambda _name, _line: None, lambda _name, _code: None)
    assert process.wait(DEADLINE_S) == 0
    wait_until(lambda: len(lines), "its line")
    left = psutil.Process(int(lines[0]))

    child.close()

    try:
        left.wait(10.0)
    finally:
        with suppress(psutil.NoSuchProcess):
            left.kill()
