"""Contestants of the benchmarks: the C programs equal the reference, and start-up is seen from outside."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import psutil
import pytest

from benchmarks.commands import Command, RunFailed, run_command
from benchmarks.contestants import (
    c_environment,
    c_model_exchange,
    c_program,
    fmpy_environment,
    fmpy_model_exchange,
    fmu_mesh_environment,
    fmu_mesh_kinds,
    ping_pong,
)
from benchmarks.contestants.entry import compiled
from benchmarks.contestants.reference import rows_of
from benchmarks.environment import Peers
from benchmarks.first_step import FirstStep
from benchmarks.jobs import JOBS, Job
from benchmarks.running import Bench
from benchmarks.task import System, Task
from tests.fmus.helpers import NO_COMPILER
from tests.helpers import Place, wait_until, write_config
from tests.helpers import rows_of as rows_in
from tests.plain_run import PlainRun
from tests.planning import prepare

needs_compiler = pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
BY_NAME = {job.name: job for job in JOBS}
ROUND_THE_RING = 10_000
"""More points than a ring of the C program has rows."""


def task_of(system: System, points: int, **options: str) -> tuple[Task, list[float]]:
    """A task with the initial inputs of the reference, and the last row of that."""
    task = Task(system, points, options)
    rows, inputs = rows_of(task)
    return replace(task, initial_inputs=tuple(inputs)), rows[-1]


@needs_compiler
@pytest.mark.parametrize("processes", ["one", "own"])
@pytest.mark.parametrize("name", ["pendulum", "cycle2"])
def test_the_c_program_equals_the_reference_in_every_float(name: str, processes: str) -> None:
    task, last = task_of(BY_NAME[name].system, ROUND_THE_RING, processes=processes)

    outcome = c_program.run(task)

    assert list(outcome.last.values()) == last
    assert outcome.seconds > 0.0


@needs_compiler
def test_a_chain_of_eight_c_processes_equals_the_reference() -> None:
    system = BY_NAME["chain8"].entries[-1].system
    assert system is not None
    assert len(system.members) == 8
    task, last = task_of(system, 5_000, processes="own")

    assert list(c_program.run(task).last.values()) == last


@needs_compiler
@pytest.mark.parametrize("name", ["pendulum", "cycle2", "chain8"])
def test_c_processes_over_sockets_equal_the_reference(name: str) -> None:
    job = BY_NAME[name]
    task, last = task_of(job.entries[-1].system or job.system, 5_000, processes="own", transport="tcp")

    assert list(c_program.run(task).last.values()) == last


@needs_compiler
@pytest.mark.parametrize("index", [0, 1])
def test_a_c_program_whose_fmu_fails_ends_in_words(index: int) -> None:
    pendulum = BY_NAME["pendulum"].system
    members = list(pendulum.members)
    # A step beyond the stop time is an error of the FMU, and so is a delay below 0.
    members[index] = replace(members[index], start_values={"a": float("nan"), "l": -1.0} if index == 0 else {"d": -1.0})
    task = Task(replace(pendulum, members=tuple(members)), 10, {"processes": "own"}, (None, 1.3))

    with pytest.raises(RuntimeError, match="exit code"):
        c_program.run(task)


@needs_compiler
@pytest.mark.parametrize(
    "options",
    [
        {"transport": "memory"},
        {"transport": "tcp", "spins": "trip", "bytes": "40"},
        {"transport": "unix", "spins": "exchange", "bytes": "40"},
    ],
    ids=lambda options: options["transport"],
)
def test_a_round_trip_between_two_c_programs_is_measured(options: dict[str, str]) -> None:
    outcome = ping_pong.run(Task(System("chain", "jacobi", 1.0, ()), 1_000, {"language": "c", **options}))

    assert outcome.seconds > 0.0


@pytest.mark.parametrize("way", ["streams", "zenoh"])
def test_a_star_without_shared_memory_equals_the_reference(tmp_path: Path, way: str) -> None:
    job = BY_NAME["apart_star"]
    (entry,) = (entry for entry in job.entries if entry.options.get("apart") == "streams")
    chosen = replace(job, entries=(replace(entry, points=500, quick=0, options={"apart": way}),))

    with Bench([chosen], Peers(Path(sys.executable)), tmp_path, quick=True) as bench:
        bench.run(1, 200.0)

    assert bench.broken == []
    assert [measured.result for measured in bench.results[job.name].values()] == ["all points equal"]


@needs_compiler
@pytest.mark.parametrize("kind", fmu_mesh_kinds.KINDS)
def test_two_instances_of_each_kind_step_in_one_process(kind: str) -> None:
    outcome = fmu_mesh_kinds.run(Task(System("chain", "jacobi", 1.0, ()), 20, {"kind": kind}))

    assert outcome.seconds > 0.0


@needs_compiler
def test_the_c_program_of_model_exchange_has_our_floats(place: Place) -> None:
    """So the job `model_exchange` compares the same calculation. FMPy interpolates the input, which we hold."""
    task = Task(System("chain", "jacobi", 1.0, ()), 300, {"kind": "model_exchange_dopri5"})
    fmu_mesh_kinds.run(task)
    oscillator = {"fmu": str(fmu_mesh_kinds.BUILT / "Oscillator2.fmu"), "kind": "model_exchange"}
    config = write_config(
        place.folder,
        instances={name: {**oscillator, "solver": {"name": "dopri5"}} for name in ("first", "second")},
        connections=["first.x -> second.u"],
        stop_time=300 * fmu_mesh_kinds.STEP_SIZE,
        simulation={"step_size": fmu_mesh_kinds.STEP_SIZE},
        record={"file": "m.csv", "variables": ["first.x", "second.x"]},
    )
    PlainRun(prepare(config)).run()
    ours = rows_in(place.folder / "m.csv")[-1][1:]

    assert [*c_model_exchange.run(task).last.values()] == [*ours]
    theirs = [*fmpy_model_exchange.run(task).last.values()]
    assert theirs == pytest.approx([*ours], abs=1e-3)


@needs_compiler
@pytest.mark.parametrize("what", ["steps", "state", "values"])
def test_an_environment_has_the_same_floats_in_c_and_fmpy(what: str) -> None:
    task = Task(BY_NAME["environment"].system, 50, {"what": what})
    ours = fmu_mesh_environment.run(task)

    assert ours.last == c_environment.run(task).last
    assert ours.last["cart.theta"] != 0.0 or what == "state"
    if what != "state":
        assert ours.last == fmpy_environment.run(task).last
    if what == "values":
        assert ours.last == fmu_mesh_environment.run(replace(task, options={"what": "open"})).last


def started(tmp_path: Path, *labels: str) -> Bench:
    """One round of these rows of the start-up job; the peers have our environment."""
    job = BY_NAME["startup"]
    chosen: Job = replace(job, entries=tuple(entry for entry in job.entries if entry.label in labels))
    with Bench([chosen], Peers(Path(sys.executable)), tmp_path, quick=True) as bench:
        bench.run(1, 200.0)
    return bench


@needs_compiler
def test_the_start_up_of_a_mesh_is_seen_from_outside(tmp_path: Path) -> None:
    bench = started(tmp_path, "2: fmu_mesh", "2: FMPy script, one process")

    mesh, script = bench.results["startup"].values()
    assert not bench.broken
    assert (mesh.result, script.result) == ("all points equal", "last values equal")
    for measured, most in ((mesh, 20), (script, 1)):
        (seen,) = measured.started
        assert 0.0 < measured.first_points[0] < measured.costs[0]
        assert 1 <= seen.processes <= most
        assert 0.0 < seen.node_mb <= seen.private_mb <= seen.pss_mb
    assert mesh.started[0].processes >= 3, "a master and two nodes"


def test_without_a_compiler_a_contestant_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)

    with pytest.raises(RuntimeError, match="there is no C compiler"):
        compiled(Path(c_program.__file__).with_suffix(".c"))
    with pytest.raises(RuntimeError, match="no C compiler found"):
        FirstStep(tmp_path)


@needs_compiler
def test_a_command_that_takes_no_step_is_a_failure(tmp_path: Path) -> None:
    with FirstStep(tmp_path) as first_step:
        first_step.hold()

        with pytest.raises(RunFailed, match="not seen"):
            run_command(Command([sys.executable, "-c", "pass"], tmp_path), 60.0, (first_step, 1))


def test_nothing_is_left_of_a_command_that_is_not_done_in_time(tmp_path: Path) -> None:
    program = (
        "import json, pathlib, subprocess, sys\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])\n"
        "pathlib.Path('child.json').write_text(json.dumps(child.pid))\n"
        "child.wait()\n"
    )

    with pytest.raises(RunFailed, match="not done within 2 s"):
        run_command(Command([sys.executable, "-c", program], tmp_path), 2.0)

    child = json.loads((tmp_path / "child.json").read_text())
    wait_until(lambda: not psutil.pid_exists(child) or psutil.Process(child).status() == "zombie", "the end of a child")


def test_the_message_of_a_failed_command_is_its_last_line(tmp_path: Path) -> None:
    program = "import sys; print('first', file=sys.stderr); sys.exit('what went wrong')"

    with pytest.raises(RunFailed, match=r"^what went wrong$"):
        run_command(Command([sys.executable, "-c", program], tmp_path), 60.0)
