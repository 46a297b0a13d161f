"""The benchmarks: what a target names is there, what differs is found, and figures are put into words."""

from __future__ import annotations

import importlib.util
import json
import random
import re
import sys
from pathlib import Path

import pytest

from benchmarks import far
from benchmarks.commands import RunFailed
from benchmarks.comparing import Reference, compare
from benchmarks.disturbing import FAULTS, ROLES, drawn_faults
from benchmarks.first_step import Started
from benchmarks.jobs import JOBS, OTHER, Entry, Job, with_checkout
from benchmarks.kept_rows import Differences, GrowingFile, differences
from benchmarks.live_data import Watched, misplaced
from benchmarks.publishing import BLOCKS, PAGE, PATIENCE_S, Figures, Host, markers, publish
from benchmarks.recording import main as measure_recording
from benchmarks.report import Report
from benchmarks.running import Measured
from benchmarks.soak import Sample, has_grown
from benchmarks.targets import TARGETS, Figure, Target
from benchmarks.task import Member, Outcome, System

ROOT = Path(__file__).resolve().parents[2]
PAIR = System("chain", "jacobi", 0.5, (Member("a", "Gain", "u", "y"), Member("b", "Gain", "u", "y")))
REFERENCE = Reference([[float(point), point / 2] for point in range(3)], (None, 0.0))
CSV = "time,a.y,b.y\n0.0,0.0,0.0\n0.5,1.0,0.5\n1.0,2.0,1.0\n"


def reported(target: Target, entries: dict[str, Measured], timed: str = "steps") -> tuple[Report, Job]:
    """The report of a job with these results."""
    rows = tuple(Entry(label, "fmu_mesh_launch" if label == "ours" else "fmpy_loop", 4) for label in entries)
    job = Job("pair", "a pair", PAIR, rows, "commands" if timed == "commands" else "steps", timed == "commands")
    return Report([job], {"pair": entries}, ["a test"], [target]), job


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.what)
def test_a_target_names_rows_of_its_job(target: Target) -> None:
    jobs = [*with_checkout(JOBS, ROOT), *(job.table(far.LINKS, None) for job in far.JOBS)]
    labels = {entry.label for job in jobs if job.name == target.job for entry in job.entries}

    assert target.entry in labels
    assert not target.against or target.against in labels


@pytest.mark.parametrize("job", with_checkout(JOBS, ROOT), ids=lambda job: job.name)
def test_the_rows_of_a_job_have_different_labels_and_a_module(job: Job) -> None:
    labels = [entry.label for entry in job.entries]

    assert len(set(labels)) == len(labels)
    assert all(not entry.beside or entry.beside in labels for entry in job.entries)
    for entry in job.entries:
        assert importlib.util.find_spec(f"benchmarks.contestants.{entry.module}") is not None, entry.module


def test_another_checkout_runs_each_of_our_rows_and_no_other(tmp_path: Path) -> None:
    (job,) = with_checkout([JOBS[0]], tmp_path)

    added = job.entries[len(JOBS[0].entries) :]
    assert [entry.label for entry in added] == [e.label + OTHER for e in JOBS[0].entries if e.is_ours]
    assert all(entry.options["checkout"] == str(tmp_path) for entry in added)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (CSV, "all points equal"),
        (CSV.replace("2.0,", "2.0000000000000004,"), "DIFFERS: a.y is 2.0000000000000004 at point 2, not 2.0"),
        (CSV.replace("0.5,1.0", "0.25,1.0"), "DIFFERS: row 1 has time 0.25"),
        (CSV.removesuffix("1.0,2.0,1.0\n"), "DIFFERS: 2 rows, not 3"),
    ],
    ids=["equal", "a value", "a time", "a row is missing"],
)
def test_every_point_of_a_file_is_compared(text: str, found: str, tmp_path: Path) -> None:
    file = tmp_path / "result.csv"
    file.write_text(text)

    assert compare(PAIR, REFERENCE, Outcome(0.1, result_file=str(file)), 2) == found


def test_the_last_values_are_compared_where_there_is_no_file() -> None:
    assert compare(PAIR, REFERENCE, Outcome(0.1, {"a.y": 2.0, "b.y": 1.0}), 2) == "last values equal"
    assert compare(PAIR, REFERENCE, Outcome(0.1), 2) == "nothing to see"
    wrong = compare(PAIR, REFERENCE, Outcome(0.1, {"a.y": 2.0, "b.y": 1.0000000000000002}), 2)
    assert wrong == "DIFFERS: b.y is 1.0000000000000002 at the end, not 1.0"


@pytest.mark.parametrize(
    ("figure", "value", "verdict"),
    [
        ("times as fast", 4.0, "PASS"),
        ("times as long", 0.25, "PASS"),
        ("times as long, each", 0.0625, "PASS"),
        ("first point, s", 3.0, "BELOW"),
        ("MB per node", 20.0, "BELOW"),
    ],
)
def test_each_figure_of_a_target_is_the_median_of_what_was_measured(figure: Figure, value: float, verdict: str) -> None:
    seen = Started(first_point_ns=0, held_ns=0, processes=3, private_mb=50.0, pss_mb=60.0, node_mb=20.0)
    ours = Measured(8, 4, [9e-6, 1e-6, 5e-7], [9.0, 3.0, 1.0], [seen], "all points equal")
    target = Target("a figure", "pair", "ours", figure, 2, 1, "theirs")

    report, _ = reported(target, {"ours": ours, "theirs": Measured(2, 4, [4e-6])})

    assert report.value_of(target) == value
    (row,) = [line for line in report.markdown().splitlines() if "a figure" in line]
    assert row.endswith(f"{verdict} |")
    assert json.loads(report.json())["targets"][0]["value"] == value


def test_a_target_without_figures_is_missed_and_another_jobs_is_left_out() -> None:
    target = Target("speed", "pair", "ours", "times as fast", 2, 3, "theirs")
    report, job = reported(target, {"ours": Measured(2, 4, [1e-6]), "theirs": Measured(2, 4, failure="no compiler")})

    assert report.value_of(target) is None
    assert "| speed (times as fast) | - | 2 | 3 | - |" in report.markdown()
    assert "| theirs | - | - | - | - | - | no compiler |" in report.markdown()
    elsewhere = Target("speed", "elsewhere", "ours", "times as fast", 2, 3)
    assert "speed" not in Report([job], {"pair": {}}, [], [elsewhere]).json()


def test_a_row_of_another_checkout_is_compared_with_ours_of_same_label() -> None:
    target = Target("speed", "pair", "ours", "times as fast", 2, 3, "first")
    first, ours, other = Measured(2, 4, [1e-6]), Measured(2, 4, [2e-6]), Measured(2, 4, [3e-6])

    report, _ = reported(target, {"first": first, "ours": ours, "ours" + OTHER: other})

    ratios = [
        line.split("|")[6].strip() for line in report.markdown().splitlines() if line.startswith(("| first", "| ours"))
    ]
    assert ratios == ["", "2.00", "1.50"]


def test_the_table_of_start_up_has_times_and_memory() -> None:
    seen = Started(first_point_ns=0, held_ns=0, processes=3, private_mb=50.0, pss_mb=60.4, node_mb=20.0)
    target = Target("start", "pair", "ours", "first point, s", 2, 3)

    report, _ = reported(target, {"ours": Measured(2, 4, [1.5], [1.0], [seen], "all points equal")}, "commands")

    assert "| ours | 1.00 | 1.50 | 1.50-1.50 |  | 3 | 50 | 60 | 20.0 | all points equal |" in report.markdown()
    assert "all points equal" in report.text()


def host(*loads: float) -> Host:
    """A machine with these loads, one after another and the last for ever, on which waiting takes no time."""
    left, now = list(loads), [0.0]

    def pause(seconds: float) -> None:
        now[0] += seconds

    return Host(lambda: left.pop(0) if len(left) > 1 else left[0], lambda: now[0], pause)


@pytest.mark.parametrize("block", BLOCKS)
def test_a_table_replaces_that_of_the_page_and_nothing_else(block: str, tmp_path: Path) -> None:
    page = tmp_path / "performance.md"
    before = PAGE.read_text(encoding="utf-8")
    page.write_text(before, encoding="utf-8")
    begin, end = markers(block)

    code = publish(block, lambda: Figures("one round", "| a table |"), write=True, host=host(0.5), page=page)

    after = page.read_text(encoding="utf-8")
    assert code == 0
    assert after.partition(begin)[0] == before.partition(begin)[0]
    assert after.partition(end)[2] == before.partition(end)[2]
    about, table = after.partition(begin)[2].partition(end)[0].strip().split("\n\n")
    assert re.fullmatch(r"one round; .+; \d{4}-\d\d-\d\d, commit .+; load average before .+, after .+\.", about)
    assert table == "| a table |"


def test_a_page_without_the_markers_is_refused(tmp_path: Path) -> None:
    page = tmp_path / "performance.md"
    page.write_text("no markers")

    with pytest.raises(ValueError, match="no markers of the block 'scale'"):
        publish("scale", lambda: Figures("one round", "new"), write=True, host=host(0.5), page=page)


def test_the_docs_wait_for_a_quiet_machine_before_the_first_round(tmp_path: Path) -> None:
    page = tmp_path / "performance.md"
    page.write_text("\n".join(markers("scale")))
    busy = host(4.0, 2.0, 1.0, 0.99)

    code = publish("scale", lambda: Figures(f"load {busy.load()}", "new"), write=True, host=busy, page=page)

    assert code == 0
    assert busy.clock() == 15.0
    assert "load 0.99; " in page.read_text()


def test_a_machine_that_stays_busy_writes_nothing_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "performance.md"
    page.write_text("\n".join(markers("scale")))
    busy = host(1.0)
    before, rounds = page.read_text(), 0

    def measure() -> Figures:
        nonlocal rounds
        rounds += 1
        return Figures("one round", "new")

    code = publish("scale", measure, write=True, host=busy, page=page)

    assert (code, rounds, busy.clock()) == (1, 0, PATIENCE_S)
    assert page.read_text() == before
    assert "error: the load average is 1.00 after 5 minutes, and has to be below 1." in capsys.readouterr().err


def test_without_a_page_to_write_nobody_waits(capsys: pytest.CaptureFixture[str]) -> None:
    busy = host(20.0)

    code = publish("scale", lambda: Figures("one round", "| a table |"), write=False, host=busy)

    assert (code, busy.clock()) == (0, 0.0)
    assert "| a table |" in capsys.readouterr().out


def test_figures_with_a_problem_do_not_get_into_the_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "performance.md"
    page.write_text("\n".join(markers("arrays")))
    before = page.read_text()

    code = publish("arrays", lambda: Figures("", "new", problems=["DIFFERS"]), write=True, host=host(0.5), page=page)

    assert code == 1
    assert page.read_text() == before
    assert "error: DIFFERS" in capsys.readouterr().err


def test_a_run_that_fails_leaves_the_page_as_it_was(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "performance.md"
    page.write_text("\n".join(markers("sweeps")))
    before = page.read_text()

    def measure() -> Figures:
        raise RunFailed("not done within 300 s")

    code = publish("sweeps", measure, write=True, host=host(0.5), page=page)

    assert code == 1
    assert page.read_text() == before
    assert "error: not done within 300 s. performance.md is as it was." in capsys.readouterr().err


@pytest.mark.parametrize("command", BLOCKS.values())
def test_the_program_of_each_block_takes_the_option(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module, *options = command.split()
    program = importlib.import_module(f"{module}.__main__" if module == "benchmarks" else module)
    monkeypatch.setattr(sys, "argv", [command, "--help"])

    with pytest.raises(SystemExit, match="0"):
        program.main()

    shown = capsys.readouterr().out
    assert [option for option in ("--write-docs", *options) if option not in shown] == []


@pytest.mark.parametrize(
    ("column", "found"),
    [
        ([0.0, 0.0, 0.0, 1.0, 2.0, 3.0], (0, 0)),
        ([0.0, 0.0, 0.0, 1.0, 3.0, 3.0], (1, 0)),
        ([0.0, 0.0, 1.0, 2.0, 3.0, 3.0], (0, 2)),
        ([0.0, 0.0, 0.0, 1.0, 2.0], (1, 0)),
    ],
    ids=["all", "one is missing", "too early", "the run ended"],
)
def test_values_that_are_lost_or_at_another_point_are_counted(column: list[float], found: tuple[int, int]) -> None:
    assert misplaced(column, first=2, count=3) == found


def test_growth_of_a_run_is_seen_from_a_part_of_it_on() -> None:
    seen = Watched([90.0, 100.0, 104.0, 101.0], [30, 40, 41, 40])

    assert seen.grown(0.25) == (100.0, 104.0, 40, 41)


def test_faults_of_a_run_are_decided_by_its_seed() -> None:
    first, again, other = (drawn_faults(random.Random(seed), 9, FAULTS, ROLES, 0.5) for seed in (1, 1, 2))  # noqa: S311  faults

    assert first == again != other
    assert [fault.after for fault in first] == sorted(fault.after for fault in first)
    assert {len(fault.again) for fault in first} > {0}
    assert all(not fault.again for fault in first if fault.kind != "kill")


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (b"time,y\n0,1\n1,2\n2,3\n", Differences()),
        (b"time,y\n0,1\n2,3\n", Differences(lost=1, other=True)),
        (b"time,y\n0,1\n1,2\n1,2\n2,3\n", Differences(doubled=1, other=True)),
        (b"time,y\n0,1\n1,2\n2,4\n", Differences(other=True)),
        (b"", Differences(lost=3, other=True)),
    ],
    ids=["equal", "lost", "doubled", "another value", "no file"],
)
def test_rows_that_are_lost_or_doubled_are_counted(found: bytes, expected: Differences) -> None:
    assert differences(b"time,y\n0,1\n1,2\n2,3\n", found) == expected


def test_rows_are_counted_after_a_cut_and_a_new_file(tmp_path: Path) -> None:
    path = tmp_path / "result.csv"
    growing = GrowingFile(path)
    assert growing.rows == 0
    path.write_text("time\n0\n1\n2")
    assert growing.rows == 2
    path.write_text("time\n0\n1\n2\n")
    assert growing.rows == 3
    path.write_text("time\n0\n")
    assert growing.rows == 1
    path.rename(tmp_path / "old.csv")
    path.write_text("time\n0\n1\n2\n3\n")
    assert growing.rows == 4


def test_what_grows_in_a_long_run_is_told() -> None:
    steady = [Sample(float(at), 100.0, 50.0, 1.0, 9.0) for at in range(40)]
    leaking = [Sample(float(at), 100.0 + at, 50.0 + at, 1.0, 9.0) for at in range(40)]

    assert has_grown(steady) == []
    assert has_grown(leaking) == [
        "memory_mb has grown from 114.5 to 134.5",
        "open_files has grown from 64.5 to 84.5",
    ]


UNSEEN = re.compile(
    r"<!-- ([\w ]+): begin .*?<!-- \1: end -->|<!--.*?-->|^```.*?^```|^ {4}.*?$", re.DOTALL | re.MULTILINE
)
"""The measured tables, comments and listings of a page; what is left is prose."""

FIGURE = re.compile(r"\d[\d.,]* ?(?:ns|us|µs|ms|s|minutes|points/s|kB|MB|GB|%)(?![\w/])|\d[\d.,]* times (?:as|the)\b")
COST = re.compile(
    r"\b(?:takes?|took|costs?)\s(?:about |around |only |less than |some )?\d[\d.,]* (?:to \d+ )?(?:ns|us|µs|ms)\b"
    r"|\d[\d.,]* (?:to \d+ )?times (?:as (?:fast|slow|long)|faster|slower)"
)


def test_the_page_of_figures_has_none_outside_its_tables() -> None:
    assert FIGURE.findall(UNSEEN.sub("", PAGE.read_text(encoding="utf-8"))) == []


def test_no_page_says_in_prose_how_fast_something_is() -> None:
    pages = {*(ROOT / "docs").glob("*.md")} - {ROOT / "docs" / "upgrading.md"}  # what older versions took

    found = {page.name: COST.findall(UNSEEN.sub("", page.read_text(encoding="utf-8"))) for page in pages}

    assert {name: figures for name, figures in found.items() if figures} == {}


def test_the_cost_of_recording_is_measured_for_each_format(capsys: pytest.CaptureFixture[str]) -> None:
    code = measure_recording(["--formats", "none", "csv", "--points", "1000", "--repeat", "1"])

    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines()[-2:]]
    assert code == 0
    assert [row[0] for row in rows] == ["| none", "| csv"]
    assert rows[0][3] == "100 %"
