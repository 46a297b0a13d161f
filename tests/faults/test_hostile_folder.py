"""A current folder with files that are called like modules: Python looks there first, unless it is told not to."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.helpers import Place, row_count, rows_of, wait_until, write_config

NAMES = ("token", "random", "numpy", "msgspec", "zenoh", "fmpy", "site")
FIRST = ("fmu_mesh", "typing")
"""What `python -m fmu_mesh` itself finds there, before anything of ours can prevent it; the command does not."""


def write_modules(folder: Path, names: Sequence[str]) -> None:
    """Write modules with these names, of which each tells when it is executed."""
    for name in names:
        text = f"raise SystemExit('the {name}.py of the current folder was executed')\n"
        (folder / f"{name}.py").write_text(text, encoding="utf-8")


@pytest.fixture
def place(place: Place) -> Place:
    """A place whose folder, the current one of all that is started there, has such files."""
    write_modules(place.folder, NAMES)
    return place


def command(*arguments: str | Path) -> list[str]:
    """The installed command, as a person types it."""
    return [str(Path(sys.executable).with_name("fmu-mesh")), *map(str, arguments)]


def test_mesh_is_launched_from_folder_with_files_that_are_called_like_modules(place: Place) -> None:
    write_modules(place.folder, FIRST)
    config = write_config(place.folder)

    launched = place.start_command(command("launch", config))

    assert launched.wait() == 0, launched.errors
    assert "was executed" not in launched.errors
    assert len(rows_of(config.with_suffix(".csv"))) == 1001
    place.assert_nothing_left()


def test_python_m_is_the_same_command_there(place: Place) -> None:
    launched = place.run("launch", write_config(place.folder))

    assert launched.wait() == 0, launched.errors
    place.assert_nothing_left()


def test_commands_look_into_a_mesh_from_there(place: Place) -> None:
    config = write_config(place.folder, stop_time=10_000.0, simulation={"real_time_factor": 1})
    place.start_command(command("launch", config))
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 10, "10 rows")

    asked = place.start_command(command("get", "pendulum.a"))

    assert asked.wait() == 0, asked.errors
    assert "fmu_mesh/pair/pendulum/out/a" in asked.output
