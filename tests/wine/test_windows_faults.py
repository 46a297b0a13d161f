"""What a Windows FMU may do, and what may happen to it: a defined end with names, and nothing left."""

from __future__ import annotations

import shutil
import signal
import zipfile
from collections.abc import Mapping
from pathlib import Path

import psutil
import pytest

from fmus.build import WINDOWS_FROM_LINUX, build
from tests.fmus.helpers import FMUS, SOURCES
from tests.helpers import Place, row_count, rows_of, wait_until, write_config
from tests.wine.windows import NEEDS_WINE, windows_fmu

pytestmark = NEEDS_WINE

FAR_S = 1e4
LEFT_S = 15.0
"""How long the server of Wine and processes whose launcher was killed may take to end."""


def with_faulty(
    place: Place,
    start_values: Mapping[str, float | bool],
    stop_time: float = 2.0,
    step_s: float = 60.0,
    fmu: Path | None = None,
) -> Path:
    """A native pendulum that feeds the Windows FMU with faults, in steps of 1 ms."""
    return write_config(
        place.folder,
        instances={
            "pendulum": {"fmu": str(FMUS / "DampedPendulum.fmu")},
            "faulty": {"fmu": str(fmu or windows_fmu("Faulty")), "start_values": dict(start_values)},
        },
        connections=["pendulum.a -> faulty.u"],
        stop_time=stop_time,
        timeouts={"step": step_s},
    )


def host_in(place: Place) -> psutil.Process:
    """The Windows program that has loaded the FMU, as soon as it runs."""

    def find() -> psutil.Process | None:
        for process in place.processes():
            try:
                if "burst-windows" in " ".join(process.cmdline()) and process.children() == []:
                    return process
            except psutil.NoSuchProcess:
                continue
        return None

    return wait_until(find, "the Windows program")


BOTH_WAYS = pytest.mark.parametrize("options", [(), ("--local",)], ids=["distributed", "local"])


@BOTH_WAYS
def test_a_failed_step_is_told_with_what_the_fmu_says(place: Place, options: tuple[str, ...]) -> None:
    config = with_faulty(place, {"fail_at": 1.0})

    launched = place.run("launch", config, *options)

    assert launched.wait() == 3
    said = "instance faulty, point 1000, t = 1 s: fmi2DoStep returned error; the FMU says: the reactor is empty."
    assert said in launched.message
    assert [row[0] for row in rows_of(config.with_suffix(".csv"))] == [point * 0.001 for point in range(1001)]
    place.assert_nothing_left(LEFT_S)


@BOTH_WAYS
def test_a_crash_in_a_step_names_instance_and_point(place: Place, options: tuple[str, ...]) -> None:
    config = with_faulty(place, {"crash_at": 1.0})

    launched = place.run("launch", config, *options)

    assert launched.wait() == 3
    said = (
        "point 1000, t = 1 s: fmi2DoStep returned fatal; the FMU says: the process of the FMU under Wine has ended with"
    )
    assert f"instance faulty, {said} exit code 3" in launched.message  # of `abort`
    assert [row[0] for row in rows_of(config.with_suffix(".csv"))] == [point * 0.001 for point in range(1001)]
    place.assert_nothing_left(LEFT_S)


def test_an_access_violation_names_its_place_in_the_dll(place: Place) -> None:
    sources = shutil.copytree(SOURCES / "Faulty", place.folder / "Faulty")
    code = (sources / "Faulty.c").read_text(encoding="utf-8")
    assert "abort();" in code
    (sources / "Faulty.c").write_text(code.replace("abort();", "*(volatile int *)16 = 1;"), encoding="utf-8")
    fmu = build(sources, place.folder, WINDOWS_FROM_LINUX)
    config = with_faulty(place, {"crash_at": 1.0}, fmu=fmu)

    launched = place.run("launch", config)

    assert launched.wait() == 3
    assert "instance faulty, point 1000, t = 1 s: fmi2DoStep returned fatal; the FMU says: " in launched.message
    assert "crashed under Wine: exception 0xC0000005 (access violation) at 0x" in launched.message
    assert " of Faulty.dll" in launched.message
    place.assert_nothing_left(LEFT_S)


@BOTH_WAYS
def test_a_step_that_hangs_ends_at_its_deadline(place: Place, options: tuple[str, ...]) -> None:
    config = with_faulty(place, {"hang_at": 1.0}, step_s=2.0)

    launched = place.run("launch", config, *options)

    assert launched.wait() == 3
    assert "instance faulty, point 1000, t = 1 s: the FMU has not returned for " in launched.message
    assert "`timeouts.step`" in launched.message
    place.assert_nothing_left(LEFT_S)


@BOTH_WAYS
def test_an_error_in_initialization_is_told(place: Place, options: tuple[str, ...]) -> None:
    launched = place.run("launch", with_faulty(place, {"fail_in_init": True}), *options)

    assert launched.wait() == 3
    assert "instance faulty: " in launched.message
    assert "the FMU says: the reactor does not start" in launched.message
    place.assert_nothing_left(LEFT_S)


def test_a_windows_program_that_is_killed_ends_the_run_with_names(place: Place) -> None:
    config = with_faulty(place, {}, FAR_S)
    launched = place.start("launch", config)
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 100, "rows")

    host_in(place).kill()

    assert launched.wait() == 3
    assert "instance faulty, point " in launched.message
    assert "the FMU says: the process of the FMU under Wine was ended by signal 9" in launched.message
    place.assert_nothing_left(LEFT_S)


def test_a_node_that_is_killed_takes_its_windows_program_along(place: Place) -> None:
    config = with_faulty(place, {}, FAR_S)
    launched = place.start("launch", config)
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 100, "rows")

    launched.child("faulty").kill()

    assert launched.wait() == 4
    assert "its process was ended by SIGKILL" in launched.message
    place.assert_nothing_left(LEFT_S)


def test_a_launcher_that_is_killed_leaves_nothing_of_wine(place: Place) -> None:
    config = with_faulty(place, {}, FAR_S)
    launched = place.start("launch", config)
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 100, "rows")

    launched.signal(signal.SIGKILL)

    launched.wait()
    place.assert_nothing_left(LEFT_S)


def test_ctrl_c_ends_a_run_with_a_windows_fmu(place: Place) -> None:
    config = with_faulty(place, {}, FAR_S)
    launched = place.start("launch", config)
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 100, "rows")

    launched.signal(signal.SIGINT)

    assert launched.wait() == 130
    place.assert_nothing_left(LEFT_S)


@BOTH_WAYS
def test_a_missing_dll_is_named(place: Place, options: tuple[str, ...]) -> None:
    target = place.folder / "Lacking.fmu"
    with zipfile.ZipFile(windows_fmu("Gain")) as kept, zipfile.ZipFile(target, "w") as archive:
        for name in kept.namelist():
            archive.writestr(name, kept.read(name).replace(b"KERNEL32.dll", b"LACKING1.dll"))
    config = write_config(place.folder, instances={"gain": {"fmu": str(target)}}, connections=[])

    launched = place.run("launch", config, *options)

    assert launched.wait() == 3
    assert "instance gain: " in launched.message
    assert "LACKING1.dll" in launched.message
    place.assert_nothing_left(LEFT_S)
