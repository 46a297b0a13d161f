"""What `top` and `launch` draw on a real terminal, and what they leave behind there."""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import pytest

from fmu_mesh.cli.output.sparklines import BLOCKS
from tests.helpers import FMUS, Place, wait_until, write_config
from tests.terminal import Terminal

PACED = {"real_time_factor": 1.0, "step_size": 0.01}
LONG = "the_left_wheel_of_the_front_axle_with_its_own_long_name"
MESH = "mesh_of_a_test_with_long_names"


def long_names(place: Place) -> Path:
    """The configuration of a mesh by the wall clock whose names are longer than there is room."""
    instances = {
        f"{LONG}_{number}": {"fmu": str(FMUS / f"{fmu}.fmu")} for number, fmu in ((1, "DampedPendulum"), (2, "Gain"))
    }
    return write_config(
        place.folder,
        name=MESH,
        instances=instances,
        connections=[f"{LONG}_1.a -> {LONG}_2.u"],
        stop_time=3600.0,
        simulation=PACED,
    )


def started(place: Place, config: Path) -> Place:
    """A place where this mesh runs."""
    place.start("launch", config, "--no-progress")
    assert place.run("wait").wait() == 0
    return place


def start_pair(place: Place) -> None:
    started(place, write_config(place.folder, stop_time=3600.0, simulation=PACED))


@pytest.fixture(scope="module")
def long_pair() -> Iterator[Place]:
    """A place with a mesh of long names that is only looked at."""
    with Place() as place:
        yield started(place, long_names(place))


# --- top


@pytest.mark.parametrize("columns", [80, 100, 200])
def test_top_fits_its_terminal_and_has_one_head_line(place: Place, columns: int) -> None:
    start_pair(place)

    with Terminal(place, "top", "--interval", "0.05", columns=columns) as top:

        def look(*, other_than: Sequence[str] = ()) -> Sequence[str] | None:
            """A whole page on which the delay waits for its input; now and then it waits for the grant."""
            shown = top.shown
            is_whole = len(shown) == 5 and "waiting for 'p" in shown[3]
            return shown if is_whole and shown[:1] != other_than[:1] else None

        first = wait_until(look, "a look")
        later = wait_until(partial(look, other_than=first), "another look")

    for shown in (first, later):
        assert [line.partition(":")[0] for line in shown if line.startswith("pair")] == ["pair"]
        assert [line.split()[0] for line in shown[2:]] == ["instance", "delay", "pendulum"]
        assert shown[3].endswith("which feeds 'delay.x'") == (columns > 100)
        assert max(map(len, shown)) <= columns
        assert ("factor" in shown[2].split()) == (columns > 80)


@pytest.mark.parametrize("columns", [80, 200])
def test_top_draws_the_course_of_watched_variables(place: Place, columns: int) -> None:
    start_pair(place)

    with Terminal(place, "top", "--interval", "0.1", "--watch", "pendulum.a", "delay.y", columns=columns) as top:

        def course() -> Sequence[str] | None:
            """A whole page on which the sparkline of the angle has several heights."""
            shown = top.shown
            return shown if len(shown) == 8 and len({*shown[6]} & {*BLOCKS}) > 4 else None

        shown = wait_until(course, "a sparkline")

    assert [line.split()[0] for line in shown[6:]] == ["pendulum.a", "delay.y"]
    assert shown[6].endswith(" rad")
    assert max(map(len, shown)) <= columns


def test_top_draws_with_plain_signs_where_the_terminal_has_no_blocks(place: Place) -> None:
    start_pair(place)
    place.environment = {**place.environment, "PYTHONIOENCODING": "ascii:replace"}

    with Terminal(place, "top", "--interval", "0.1", "--watch", "pendulum.a") as top:
        shown = top.wait_for("#")

    assert not {*"".join(shown)} & {*BLOCKS}


@pytest.mark.parametrize("columns", [80, 200])
def test_top_shortens_long_names_in_the_middle_where_they_do_not_fit(long_pair: Place, columns: int) -> None:
    with Terminal(long_pair, "top", columns=columns) as top:
        shown = top.wait_for("instance")
        rows = [line.split() for line in shown if re.search(r"_[12] ", line)]

    assert len(rows) == 2
    assert rows[0][0] != rows[1][0]
    assert [row[0].startswith("the_") for row in rows] == [True, True]
    assert (f"{LONG}_1" == rows[0][0]) == (columns > 80)
    assert "points/s" in "".join(shown)


@pytest.mark.parametrize(
    ("how", "code", "last"),
    [
        ("q", 0, ""),
        ("\x03", 130, ""),
        ("end", 0, "mesh 'pair' has ended"),
        (signal.SIGTERM, 143, ""),
        ("error", 4, "no answer"),
    ],
    ids=["q", "Ctrl-C", "end", "SIGTERM", "error"],
)
def test_top_puts_the_terminal_back_as_it_was(place: Place, how: str | signal.Signals, code: int, last: str) -> None:
    start_pair(place)

    with Terminal(place, "top", "--interval", "0.1" if how == "error" else "60", "--timeout", "1") as top:
        top.wait_for("pendulum")
        assert top.modes() != top.modes_before
        if how == "end":
            place.run("stop", "pair")
        elif how == "error":
            for process in place.processes("master"):
                process.suspend()
        elif isinstance(how, signal.Signals):
            top.signal(how)
        else:
            top.press(how)

        assert top.wait() == code
        assert top.modes() == top.modes_before
        assert bool(top.shown) == bool(last)
        assert last in "".join(top.shown)
        assert "instance  state" not in "".join(top.shown)
        assert top.shows_cursor


def test_top_tells_how_many_lines_do_not_fit(place: Place) -> None:
    start_pair(place)

    with Terminal(place, "top", lines=4) as top:
        shown = top.wait_for("more lines")

    assert shown[-1] == "(2 more lines)"
    assert shown[0].startswith("pair: running")


# --- the progress line


@pytest.mark.parametrize("options", [[], ["--local"]], ids=["distributed", "local"])
def test_the_progress_line_fits_and_tells_percent_stop_time_and_time_left(place: Place, options: list[str]) -> None:
    config = write_config(place.folder, stop_time=3600.0, simulation=PACED)

    with Terminal(place, "launch", config, *options) as launch:
        shown = launch.wait_for("left")
        line = shown[-1]
        launch.press("\x03")
        assert launch.wait() == 130
        assert not any("left" in rest for rest in launch.shown)

    assert line.startswith("pair  ")
    assert re.search(r"  0 %  [0-9.]+ of 3600 s  \d+:\d\d(:\d\d)? left(  [0-9,]+ points/s|$)", line), line
    assert [row for row in shown if "%" in row] == [line]


def test_without_a_stop_time_the_progress_line_tells_what_is_known(place: Place) -> None:
    with Terminal(place, "run", FMUS / "Gain.fmu") as run:
        line = run.wait_for("factor")[-1]

    assert re.search(r"^Gain  .*  [0-9.]+ s  [0-9,]+ points/s  factor [0-9.]+$", line), line
    assert "%" not in line
    assert "left" not in line


@pytest.mark.parametrize("columns", [60, 80])
def test_the_progress_line_of_long_names_is_one_line(place: Place, columns: int) -> None:
    with Terminal(place, "launch", long_names(place), "--local", columns=columns) as launch:
        launch.wait_for(" % ")
        for _ in range(3):
            before = launch.shown
            shown = wait_until(lambda: now if (now := launch.shown) != before else None, "another point")  # noqa: B023 it is called within the turn
            assert len([line for line in shown if "%" in line]) == 1
            assert shown[-1].startswith("mesh")


@pytest.mark.parametrize("environment", [{}, {"FORCE_COLOR": "1"}], ids=["plain", "forced"])
def test_there_is_no_progress_line_where_standard_error_is_no_terminal(
    place: Place, environment: dict[str, str]
) -> None:
    place.environment |= environment
    config = write_config(place.folder, stop_time=0.5, simulation=PACED)

    launched = place.run("launch", config)

    assert launched.wait() == 0
    assert "%" not in launched.errors
    assert "points/s" not in launched.errors
    assert [line.partition(" at ")[0] for line in launched.errors.splitlines()] == ["mesh 'pair'"]
