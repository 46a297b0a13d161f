"""What `process` limits, and what a run that reaches a limit says."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

import fmu_mesh
from fmu_mesh.errors import NotInOneProcess
from tests.fmus.helpers import NO_COMPILER, built_once
from tests.helpers import Place, rows_of, write_config


@pytest.fixture(scope="module")
def prying() -> Path:
    """The FMU that looks at what it may do to the host, and takes what it is told to take."""
    if NO_COMPILER is not None:
        pytest.skip(NO_COMPILER)
    return built_once(Path(__file__).parent / "fmus" / "Prying")


def taking(
    place: Place, prying: Path, process: Mapping[str, Any], takes: Mapping[str, Any], *, steps_per_s: float = 0.0
) -> Path:
    """A mesh of one instance that takes something in each of its steps."""
    return write_config(
        place.folder,
        instances={"taker": {"fmu": str(prying), "start_values": takes}, "other": {"fmu": "Gain"}},
        connections=["taker.shadow -> other.u"],
        stop_time=0.5,
        process=process,
        simulation={"window": 1, "real_time_factor": steps_per_s / 1000},
    )


def test_memory_above_the_limit_is_refused_to_the_model(place: Place, prying: Path) -> None:
    config = taking(place, prying, {"memory": "64 MiB"}, {"grow": 4.0})

    launched = place.run("launch", config)

    assert launched.wait() == 3
    said = re.search(
        r"instance taker, point (\d+), .*In its process, (\d+) % of its memory limit \(64 MiB\) is in use",
        launched.message.replace("%", " %"),
    )
    assert said is not None, launched.message
    assert 16 <= int(said[1]) <= 64
    assert int(said[2]) > 90
    place.assert_nothing_left()


def test_a_model_with_enough_memory_runs_to_the_end(place: Place, prying: Path) -> None:
    config = taking(place, prying, {"memory": "64 MiB"}, {"grow": 0.1})

    assert place.run("launch", config).wait() == 0


def test_a_crash_without_memory_names_the_limit(place: Place, prying: Path) -> None:
    config = taking(place, prying, {"memory": 64 << 20}, {"grow": 0.5, "crashes": True}, steps_per_s=100.0)

    launched = place.run("launch", config)

    assert launched.wait() == 4
    said = re.search(r"process was ended by SIGSEGV with (\d+)% of its memory limit in use", launched.message)
    assert said is not None, launched.message
    assert int(said[1]) > 50
    place.assert_nothing_left()


def test_a_node_that_has_used_its_processor_time_ends(place: Place, prying: Path) -> None:
    config = taking(place, prying, {"cpu_time": 1.0}, {"burn": 0.05})

    launched = place.run("launch", config)

    assert launched.wait() == 4
    assert "node 'taker' was lost: its process has used its cpu_time of 1 s" in launched.message
    place.assert_nothing_left()


def test_descriptors_at_the_limit_are_named(place: Place, prying: Path) -> None:
    config = taking(place, prying, {"open_files": 100}, {"open": 1.0})

    launched = place.run("launch", config)

    assert launched.wait() == 3
    assert "In its process, 100 of 100 descriptors are open (`process` in the configuration)." in launched.message
    place.assert_nothing_left()


def test_an_instance_has_limits_of_its_own(place: Place, prying: Path) -> None:
    config = write_config(
        place.folder,
        instances={
            "taker": {"fmu": str(prying), "start_values": {"open": 1.0}, "process": {"open_files": 2000}},
            "other": {"fmu": "Gain"},
        },
        connections=["taker.shadow -> other.u"],
        stop_time=0.2,
        process={"open_files": 100},
    )

    assert place.run("launch", config).wait() == 0


def test_instances_of_one_node_have_the_same_limits(place: Place) -> None:
    gain: dict[str, Any] = {"fmu": "Gain", "group": "both"}
    instances = {"a": {**gain, "process": {"cpu_time": 5.0}}, "b": gain}
    config = write_config(place.folder, instances=instances, connections=["a.y -> b.u"])

    launched = place.run("check", config)

    assert launched.wait() == 2
    assert "expected one process for all instances of the group" in launched.errors


@pytest.mark.parametrize(
    "run",
    [lambda mesh: mesh.run(processes=False), lambda mesh: mesh.open(), lambda mesh: mesh.batch(2)],
    ids=["local", "open", "batch"],
)
def test_limits_are_refused_where_one_process_runs_all(place: Place, run: Callable[[fmu_mesh.Mesh], object]) -> None:
    mesh = fmu_mesh.load(write_config(place.folder, process={"cpu_time": 100.0}))

    with pytest.raises(NotInOneProcess, match="`process` limits 'pendulum'"):
        run(mesh)


def test_limits_change_no_float(place: Place) -> None:
    plain = write_config(place.folder, name="plain")
    limits = {"memory": "256 MiB", "cpu_time": 100.0, "open_files": 500, "working_folder": "private"}
    limited = write_config(place.folder, name="limited", process=limits)

    assert place.run("launch", plain).wait() == place.run("launch", limited).wait() == 0
    assert rows_of(limited.with_suffix(".csv")) == rows_of(plain.with_suffix(".csv"))


@pytest.mark.parametrize("folder", ["shared", "private"])
def test_a_private_folder_takes_the_files_of_an_fmu(place: Place, prying: Path, folder: str) -> None:
    config = taking(place, prying, {"working_folder": folder}, {})

    assert place.run("launch", config).wait() == 0

    assert (place.folder / "relative.txt").exists() is (folder == "shared")
    place.assert_nothing_left()


def test_a_node_inherits_no_descriptor(place: Place, prying: Path) -> None:
    config = taking(place, prying, {}, {"burn": 0.001})
    secret = place.folder / "secret"
    secret.write_text("secret")
    program = (
        "import os, runpy, sys; os.dup2(os.open(sys.argv.pop(1), os.O_RDONLY), 30); "
        "runpy.run_module('fmu_mesh', run_name='__main__', alter_sys=True)"
    )

    launched = place.start_command([sys.executable, "-c", program, str(secret), "launch", str(config)])

    node = launched.child("taker")
    held = {pid: {one.readlink() for one in Path(f"/proc/{pid}/fd").iterdir()} for pid in (launched.pid, node.pid)}
    assert launched.wait() == 0
    assert [pid for pid, own in held.items() if secret in own] == [launched.pid]
