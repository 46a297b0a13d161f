"""Everything of a run is killed at a random moment: `recover` makes a result that is the beginning of the whole one.

`FMU_MESH_KILLS` says how many times for each format; by default three times.
"""

from __future__ import annotations

import os
import random
import signal
from collections.abc import Mapping
from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.results.formats import result_format
from tests.helpers import BY_STREAMS, BY_ZENOH, Place, wait_until, write_config

KILLS = int(os.environ.get("FMU_MESH_KILLS", "3"))
NAMES = ["pair.csv", "pair.parquet", "pair.mcap"]
RATE = 20_000
"""Rows per second."""


def size_of(file: Path) -> int:
    return file.stat().st_size if file.exists() else 0


def recovered(path: Path) -> int | None:
    """The number of rows; None while a process that was killed is not gone, and has the file."""
    try:
        return fmu_mesh.recover(path)
    except ConfigurationError as error:
        if "another run is writing" not in str(error):
            raise
        return None


def assert_beginning(path: Path, rows: int, place: Place) -> None:
    """A file has the rows of a run that nobody has disturbed."""
    config = write_config(place.folder, name="whole", stop_time=max(rows - 1, 1) * 0.001)
    whole = place.run("launch", config, "--local", "--output", place.folder / "whole.csv")
    assert whole.wait() == 0, place.story()
    expected, found = fmu_mesh.Result.read(place.folder / "whole.csv"), fmu_mesh.Result.read(path)
    assert len(found.times) == rows
    assert found.times.tobytes() == expected.times[:rows].tobytes()
    assert list(found) == list(expected)
    for name in expected:
        assert found[name].tobytes() == expected[name][:rows].tobytes(), name


@pytest.mark.parametrize("kill", range(KILLS))
@pytest.mark.parametrize("name", NAMES)
def test_all_is_killed_at_a_random_moment_and_the_rows_are_recovered(place: Place, name: str, kill: int) -> None:
    seed = random.SystemRandom().randrange(2**32) if kill else 0
    chance = random.Random(seed)  # noqa: S311  a moment
    config = write_config(
        place.folder, record={"file": name}, simulation={"real_time_factor": RATE * 0.001}, stop_time=10_000.0
    )
    result = place.folder / name
    format_ = result_format(result)
    assert format_ is not None
    growing = format_.growing_file(result)
    launched = place.start("launch", config)
    wanted = int(20_000 * 2 ** chance.uniform(0, 5))
    wait_until(lambda: size_of(growing) > wanted, f"{wanted} bytes")

    launched.signal(signal.SIGSTOP)  # so that it does not do what `recover` does
    for process in place.processes():
        process.kill()

    rows = wait_until(lambda: recovered(result), "rows")
    assert rows > 1, f"seed {seed}"
    assert_beginning(result, rows, place)
    assert not list(place.folder.glob("*.arrows")), f"seed {seed}"
    assert not list(place.folder.glob("*.unfinished.*")), f"seed {seed}"


@pytest.mark.parametrize("name", NAMES[1:])
def test_launch_finishes_the_file_of_a_killed_master(place: Place, name: str) -> None:
    config = write_config(place.folder, record={"file": name}, simulation={"real_time_factor": 1}, stop_time=10_000.0)
    result = place.folder / name
    format_ = result_format(result)
    assert format_ is not None
    growing = format_.growing_file(result)
    launched = place.start("launch", config)
    wait_until(lambda: size_of(growing) > 20_000, "rows")

    launched.child("master").kill()

    assert launched.wait() == 4
    rows = len(fmu_mesh.Result.read(result).times)
    assert f"({rows} rows) is in '{result}'" in launched.message
    assert_beginning(result, rows, place)
    assert {path.name for path in place.folder.glob("pair.*")} == {name, "pair.yaml"}


@pytest.mark.parametrize(
    ("options", "zenoh"),
    [((), BY_STREAMS), ((), BY_ZENOH), (("--local",), {})],
    ids=["streams", "frames", "local"],
)
def test_parquet_file_on_disk_that_gets_full_has_rows_that_are_told(
    place: Place, options: tuple[str, ...], zenoh: Mapping[str, bool]
) -> None:
    """The limit for the size of a file is the disk that a test can fill. The stream reaches it before the file."""
    config = write_config(place.folder, record={"file": "pair.parquet"}, stop_time=100.0, zenoh=zenoh)
    result = place.folder / "pair.parquet"

    launched = place.start("launch", config, *options, prefix=["prlimit", "--fsize=1000000"])

    assert launched.wait() == 2
    assert f"the result file '{result}' cannot be written: File too large" in launched.message
    rows = len(fmu_mesh.Result.read(result).times)
    assert rows > 10_000
    assert f"({rows} rows) is in '{result}'" in launched.message
    assert_beginning(result, rows, place)


def test_parquet_file_for_whose_end_there_is_no_room_is_recovered_later(place: Place) -> None:
    """A draft that cannot be written, as a folder is in its place; the stream stays, and the error says where it is."""
    config = write_config(place.folder, record={"file": "pair.parquet"})
    result, in_the_way = place.folder / "pair.parquet", place.folder / "pair.unfinished.parquet"
    in_the_way.mkdir()

    launched = place.run("launch", config, "--local")

    assert launched.wait() == 2
    assert "cannot be written" in launched.message
    assert f"is in '{result}.arrows', from which `fmu-mesh recover {result}` makes" in launched.message
    in_the_way.rmdir()
    recovered = place.run("recover", result)
    rows = len(fmu_mesh.Result.read(result).times)
    assert recovered.output == f"{result}: {rows} rows\n"
    assert_beginning(result, rows, place)


def test_ctrl_c_leaves_a_parquet_file(place: Place) -> None:
    config = write_config(
        place.folder, record={"file": "pair.parquet"}, simulation={"real_time_factor": 1}, stop_time=10_000.0
    )
    result = place.folder / "pair.parquet"
    launched = place.start("launch", config)
    wait_until(lambda: size_of(Path(f"{result}.arrows")) > 20_000, "rows")

    launched.signal(signal.SIGINT)

    assert launched.wait() == 130
    rows = len(fmu_mesh.Result.read(result).times)
    assert f"({rows} rows) is in '{result}'" in launched.message
    assert_beginning(result, rows, place)
    place.assert_nothing_left()
