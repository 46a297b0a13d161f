"""Many runs of one mesh in this process: each has the bytes and the errors of a run of its own; nothing is left."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest
import threadpoolctl
from msgspec.structs import replace

import fmu_mesh
from fmu_mesh.config.mesh import LimitsConfig
from fmu_mesh.errors import ConfigurationError, FmuMeshError, Interrupted, LoadFailed
from fmu_mesh.instances.contract import LogMessage
from fmu_mesh.instances.fmi.loaded_fmu import LoadedFmu
from fmu_mesh.results.record_files import open_results
from fmu_mesh.rings import native
from fmu_mesh.run.outcome import Outcome
from fmu_mesh.run.preparing import KnownModels
from fmu_mesh.run.repeated import RepeatedRuns
from fmu_mesh.run.run_plan import RunPlan
from tests.fmus.helpers import FMUS, NO_COMPILER, find_fmu
from tests.fmus.packing import repacked
from tests.helpers import examples, rows_of, wait_until, write_config
from tests.onnx_models import write_network
from tests.plain_run import PlainRun

ENGINES = pytest.mark.parametrize(
    "library",
    [pytest.param(True, marks=pytest.mark.skipif(native.library is None, reason="no library")), False],
    ids=["C", "Python"],
)
RESETS = pytest.mark.parametrize("reset", [False, True], ids=["new", "reset"])

Ended = tuple[bytes | None, Outcome | tuple[Any, ...]]


@pytest.fixture
def _engine(library: bool, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: FBT001  a parameter of tests
    if not library:
        monkeypatch.setattr(native, "library", None)


@contextmanager
def repeating(folder: Path, **options: Any) -> Iterator[RepeatedRuns]:  # noqa: ANN401  those of the class
    """Runs in a folder of their own, of which nothing is left."""
    own = folder / "runs"
    own.mkdir(exist_ok=True)
    runs = RepeatedRuns(own, **options)
    try:
        yield runs
    finally:
        runs.close()
    assert list(own.iterdir()) == []


def repeated(runs: RepeatedRuns, plan: RunPlan) -> Outcome:
    return runs.run(plan, partial(open_results, plan.loaded, plan.plan.system))


def local(plan: RunPlan) -> Outcome:
    return PlainRun(plan.plan, loaded=plan.loaded).run()


def ended(plan: RunPlan, run: Callable[[RunPlan], Outcome]) -> Ended:
    """What is in the file after a run, and how it ended; the time that it took is left out."""
    file = Path(plan.plan.system.result_file or "/nowhere/at/all")
    file.unlink(missing_ok=True)
    how: Outcome | tuple[Any, ...]
    try:
        how = replace(run(plan), seconds=0.0)
    except FmuMeshError as error:
        how = type(error), str(error), error.instance, error.point, error.time
    return file.read_bytes() if file.is_file() else None, how


def assert_equal(runs: RepeatedRuns, plans: Sequence[RunPlan]) -> list[Ended]:
    """Each plan in a row, and the first twice more, where the last run may begin again: each ends as it does alone."""
    expected = [ended(plan, local) for plan in plans]
    found = [ended(plan, lambda plan: repeated(runs, plan)) for plan in (*plans, plans[0], plans[0])]
    assert found == [*expected, expected[0], expected[0]]
    return expected


def plans_of(config: Path, variants: Sequence[Mapping[str, Any]]) -> list[RunPlan]:
    mesh = fmu_mesh.load(config)
    return [mesh.plan(start_values=values) for values in variants]


def only_once(folder: Path) -> Path:
    """An FMU that allows one instance per process."""
    return repacked(folder / "once.fmu", description=allowing_one)


def allowing_one(description: str) -> str:
    attribute = 'canBeInstantiatedOnlyOncePerProcess="{}"'
    assert attribute.format("false") in description
    return description.replace(attribute.format("false"), attribute.format("true"))


def refusing_fmu(folder: Path, most: int) -> Path:
    """A gain whose library makes so many instances, and no other."""
    if NO_COMPILER is not None:
        pytest.skip(NO_COMPILER)
    skeleton = (FMUS / "src" / "skeleton" / "skeleton.c").read_text()
    made = "    start_again(instance);\n    return instance;\n"
    assert skeleton.count(made) == 1
    refused = f"    static int made;\n    if (made++ >= {most}) return NULL;\n{made}"
    return repacked(
        folder / "refusing.fmu",
        keep=lambda name: not name.startswith("binaries/") and name != "sources/skeleton.c",
        add={"sources/skeleton.c": skeleton.replace(made, refused).encode()},
    )


def counting_fmu(folder: Path, description: Callable[[str], str] = str) -> Path:
    """A gain whose output is 1000 times the number of instances that its library has, plus those that it ever had."""
    if NO_COMPILER is not None:
        pytest.skip(NO_COMPILER)
    sources = FMUS / "src"
    gain = (sources / "Gain" / "Gain.c").read_text()
    skeleton = (sources / "skeleton" / "skeleton.c").read_text()
    made = "    start_again(instance);\n    return instance;\n"
    freed = "void fmi2FreeInstance(fmi2Component c)\n{\n"
    assert (skeleton.count(made), skeleton.count(freed)) == (1, 1)
    skeleton = skeleton.replace(made, f"    fmu_made++, fmu_live++;\n{made}")
    skeleton = skeleton.replace(freed, f"{freed}    fmu_live--;\n")
    gain = gain.replace("s->y = s->k * s->u;", "s->y = 1000 * fmu_live + fmu_made;")
    own = {
        "sources/Gain.c": gain.replace('#include "model.h"', '#include "model.h"\nextern int fmu_made, fmu_live;'),
        "sources/skeleton.c": f"int fmu_made, fmu_live;\n{skeleton}",
    }
    return repacked(
        folder / "counting.fmu",
        description=description,
        keep=lambda name: not name.startswith("binaries/") and name not in own,
        add={name: text.encode() for name, text in own.items()},
    )


def last_y(plan: RunPlan, runs: RepeatedRuns) -> float:
    repeated(runs, plan)
    return rows_of(Path(plan.plan.system.result_file or ""))[-1][1]


# --- equal to a run of its own


@ENGINES
@RESETS
@pytest.mark.usefixtures("_engine")
def test_runs_with_other_start_values_have_the_bytes_of_single_runs(tmp_path: Path, *, reset: bool) -> None:
    plans = plans_of(write_config(tmp_path), [{"pendulum.d": d, "delay.d": 0.25} for d in (0.1, 0.7)])

    with repeating(tmp_path, reset=reset) as runs:
        (first, outcome), (second, _) = assert_equal(runs, plans)

    assert isinstance(outcome, Outcome)
    assert (outcome.point, outcome.rows) == (1000, 1001)
    assert first != second


@ENGINES
@pytest.mark.usefixtures("_engine")
def test_cycles_delays_and_own_step_sizes_give_the_same_bytes(tmp_path: Path) -> None:
    config = write_config(
        tmp_path,
        instances={
            "sum": {"fmu": "Adder", "step_size": 0.003},
            "pendulum": {"fmu": "DampedPendulum", "step_size": 0.002},
            "brake": {"fmu": "Gain", "start_values": {"k": 0.3}},
            "delay": {"fmu": "TransportDelay", "start_values": {"d": 0.05}, "step_size": 0.004},
        },
        connections=[
            "pendulum.a -> brake.u",
            "brake.y -> sum.u1",
            "pendulum.der(a) -> sum.u2",
            "sum.y -> delay.x",
        ],
        record={"file": "pair.csv", "variables": ["delay.y", "sum.y", "brake.y"]},
        stop_time=2.5,
    )

    with repeating(tmp_path) as runs:
        (rows, _), *_ = assert_equal(runs, plans_of(config, [{"brake.k": 0.3}, {"brake.k": 0.9}]))

    assert rows is not None
    assert rows.count(b"\n") == 2502


@ENGINES
@RESETS
@pytest.mark.usefixtures("_engine")
@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize("kind", ["model_exchange", "co_simulation"])
def test_models_with_events_of_all_versions_give_the_same_bytes(
    tmp_path: Path, event_fmu: Callable[..., Path], kind: str, version: int, *, reset: bool
) -> None:
    if (kind, version) == ("co_simulation", 1):
        pytest.skip("these FMUs of FMI 1.0 are for model exchange; AllTypes1 is one for co-simulation")
    config = write_config(
        tmp_path,
        instances={
            "ball": {"fmu": str(event_fmu("Ball", version)), "kind": kind},
            "sum": {"fmu": str(event_fmu("Integral", version)), "kind": kind},
            "stairs": {"fmu": str(event_fmu("Stairs", version)), "kind": kind},
        },
        connections=["ball.h -> sum.u"],
        simulation={"step_size": 0.01},
        stop_time=2.0,
    )

    with repeating(tmp_path, reset=reset) as runs:
        assert_equal(runs, plans_of(config, [{"ball.e": 0.7}, {"ball.e": 0.4}]))


@ENGINES
@RESETS
@pytest.mark.usefixtures("_engine")
@pytest.mark.parametrize("version", [1, 2, 3])
def test_each_run_finds_out_anew_whether_a_model_is_stiff(
    tmp_path: Path, event_fmu: Callable[..., Path], version: int, *, reset: bool
) -> None:
    heater = {"fmu": str(event_fmu("Heater", version)), "kind": "model_exchange"}
    connection: Any = {"from": "one.F", "to": "two.u", "factor": 0.1}
    config = write_config(
        tmp_path,
        instances={"one": heater, "two": heater},
        connections=[connection],
        simulation={"step_size": 0.1},
        stop_time=3.0,
    )
    late = [{"one.late": start, "two.late": 1.0} for start in (0.0, 1.05, 100.0)]

    with repeating(tmp_path, reset=reset) as runs:
        expected = assert_equal(runs, plans_of(config, late))

    assert len({rows for rows, _ in expected}) == len(late)


@ENGINES
@RESETS
@pytest.mark.usefixtures("_engine")
@pytest.mark.parametrize("name", ["AllTypes", "AllTypes1", "AllTypes3"])
def test_all_types_and_texts_give_the_same_bytes(tmp_path: Path, name: str, *, reset: bool) -> None:
    model = {"fmu": str(find_fmu(name, tmp_path))}
    names = [variable.name for variable in fmu_mesh.inspect(model["fmu"]).description.variables]
    pairs = [
        f"one.{name} -> two.{own}" for name in names if (own := name.replace("_out", "_in")) in names and own != name
    ]
    assert len(pairs) > 3
    config = write_config(tmp_path, instances={"one": model, "two": model}, connections=pairs, stop_time=0.1)

    with repeating(tmp_path, reset=reset) as runs:
        assert_equal(runs, plans_of(config, [{}, {}]))


@ENGINES
@pytest.mark.usefixtures("_engine")
def test_components_are_new_in_every_run(tmp_path: Path) -> None:
    (tmp_path / "counting.py").write_text(
        "import fmu_mesh\n\n\nclass Counting(fmu_mesh.Component):\n"
        "    k = fmu_mesh.Parameter(1.0)\n    u = fmu_mesh.Input()\n    y = fmu_mesh.Output()\n    seen = 0.0\n\n"
        "    def step(self, time, step_size):\n        self.seen += self.u * self.k\n        self.y = self.seen\n"
    )
    config = write_config(
        tmp_path,
        instances={"pendulum": {"fmu": "DampedPendulum"}},
        connections=[],
    )
    mesh = fmu_mesh.load(config)
    mesh.add("counting", python="counting.py:Counting")
    mesh.connect("pendulum.a", "counting.u")

    with repeating(tmp_path) as runs:
        assert_equal(runs, [mesh.plan(start_values={"counting.k": k}) for k in (1.0, 3.0)])


def test_a_physics_engine_gives_the_same_bytes(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    mesh = fmu_mesh.load(FMUS.parent / "configs" / "damped_pendulum.yaml")
    plan = mesh.plan(output=tmp_path / "out.csv", stop_time=0.5, real_time_factor=0.0)

    with repeating(tmp_path) as runs:
        assert_equal(runs, [plan, plan])


def test_a_network_gives_the_same_bytes(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    write_network(tmp_path / "policy.onnx", inputs=2)
    mesh = fmu_mesh.load(write_config(tmp_path))
    mesh.add("policy", onnx="policy.onnx")
    mesh.connect("pendulum.a", "policy.observation[1]")
    mesh.connect("policy.action", "brake.u")
    mesh.add("brake", fmu=FMUS / "Gain.fmu")
    plans = [mesh.plan(start_values={"pendulum.d": d}) for d in (0.1, 0.5)]

    with repeating(tmp_path) as runs:
        assert_equal(runs, plans)


def test_loops_at_the_start_are_iterated_in_every_run(tmp_path: Path) -> None:
    back = {"from": "gain.y", "to": "sum.u1", "delay": 1}
    connections: list[Any] = ["sum.y -> gain.u", back, "sum.y -> delay.x"]
    config = write_config(
        tmp_path,
        instances={
            "sum": {"fmu": "Adder"},
            "gain": {"fmu": "Gain", "start_values": {"k": 0.5}},
            "delay": {"fmu": "TransportDelay", "start_values": {"d": 0.1}},
        },
        connections=connections,
    )
    plans = plans_of(config, [{"sum.u2": 1.0, "gain.k": k} for k in (0.5, -0.25, 1.0)])  # with 1, there is no solution

    with repeating(tmp_path) as runs:
        *_, (_, diverges) = assert_equal(runs, plans)

    assert plans[0].plan.initialization.loops
    assert not isinstance(diverges, Outcome)


def test_nothing_may_be_recorded(tmp_path: Path) -> None:
    plans = plans_of(write_config(tmp_path, record={"file": None}), [{}, {"pendulum.d": 0.5}])

    with repeating(tmp_path) as runs:
        (none, outcome), _ = assert_equal(runs, plans)

    assert none is None
    assert isinstance(outcome, Outcome)
    assert (outcome.point, outcome.rows, outcome.file) == (1000, 0, None)


# --- runs that end early


@ENGINES
@RESETS
@pytest.mark.usefixtures("_engine")
def test_a_failed_run_ends_as_single_one_and_next_is_not_affected(tmp_path: Path, faulty: Path, *, reset: bool) -> None:
    """The delay comes after the FMU that fails: within a burst it is behind."""
    config = write_config(
        tmp_path,
        instances={
            "pendulum": {"fmu": "DampedPendulum"},
            "faulty": {"fmu": str(faulty)},
            "delay": {"fmu": "TransportDelay", "start_values": {"d": 0.1}, "step_size": 0.005},
        },
        connections=["pendulum.a -> faulty.u", "faulty.y -> delay.x"],
        stop_time=2.0,
    )
    variants: list[dict[str, float]] = [{}, {"faulty.fail_at": 1.0}, {"faulty.discard_at": 0.5}, {"pendulum.d": 0.5}]

    with repeating(tmp_path, reset=reset) as runs:
        _, (rows, failed), *_ = assert_equal(runs, plans_of(config, variants))

    assert rows is not None
    assert rows.count(b"\n") == 1002
    assert isinstance(failed, tuple)
    assert (failed[2], failed[3]) == ("faulty", 1000)


@ENGINES
@pytest.mark.usefixtures("_engine")
def test_of_two_failures_the_one_at_the_first_point_counts(tmp_path: Path, faulty: Path) -> None:
    """The first instance is stepped ahead in a burst, and fails at a later point than the second one."""
    model = {"fmu": str(faulty)}
    config = write_config(
        tmp_path,
        instances={"first": model, "second": model, "third": model},
        connections=["first.y -> second.u", "second.y -> third.u"],
        stop_time=2.0,
    )
    variants = [{"first.fail_at": 1.5, "second.fail_at": 1.2, "third.fail_at": third} for third in (0.7, 1.2, 1.3, 1.9)]

    with repeating(tmp_path) as runs:
        found = assert_equal(runs, plans_of(config, variants))

    assert [how[2] for _, how in found if isinstance(how, tuple)] == ["third", "second", "second", "second"]


@ENGINES
@pytest.mark.usefixtures("_engine")
@pytest.mark.parametrize("kind", ["model_exchange", "co_simulation"])
def test_an_fmu_may_ask_to_end_the_simulation(
    tmp_path: Path, event_fmu: Callable[..., Path], faulty: Path, kind: str
) -> None:
    config = write_config(
        tmp_path,
        instances={
            "pendulum": {"fmu": "DampedPendulum", "step_size": 0.03},
            "stairs": {"fmu": str(event_fmu("Stairs", 2)), "kind": kind},
            "faulty": {"fmu": str(faulty)},
        },
        connections=["stairs.last_stair -> faulty.u"],
        simulation={"step_size": 0.01},
        stop_time=5.0,
    )
    variants: list[dict[str, float]] = [
        {"stairs.end": 2},
        {"stairs.end": 3, "faulty.fail_at": 2.5},
        {"stairs.end": 1000},
    ]

    with repeating(tmp_path) as runs:
        (_, asked), (_, failed), (_, done) = assert_equal(runs, plans_of(config, variants))

    assert isinstance(asked, Outcome)
    assert asked.ended_by is not None
    assert isinstance(failed, tuple)
    assert isinstance(done, Outcome)
    assert done.ended_by is None


@RESETS
def test_instance_that_cannot_be_made_is_told_and_next_run_makes_it(
    tmp_path: Path, faulty: Path, *, reset: bool
) -> None:
    config = write_config(tmp_path, instances={"faulty": {"fmu": str(faulty)}}, connections=[])
    good = fmu_mesh.load(config).plan()
    wrong = replace(good, contents=dict.fromkeys(good.contents, "0" * 64))

    with repeating(tmp_path, reset=reset) as runs:
        repeated(runs, good)
        with pytest.raises(LoadFailed, match="is not the FMU that this run was planned with"):
            repeated(runs, wrong)
        assert repeated(runs, good).point == 1000


def test_an_instance_that_is_refused_later_is_told_as_at_first(tmp_path: Path) -> None:
    found = []
    for most in (0, 1):
        config = write_config(
            tmp_path, instances={"it": {"fmu": str(refusing_fmu(tmp_path, most))}}, connections=[], stop_time=0.01
        )
        plan = fmu_mesh.load(config).plan()
        with repeating(tmp_path) as runs:
            for _ in range(most):
                assert repeated(runs, plan).point == 10
            with pytest.raises(LoadFailed) as refused:
                repeated(runs, plan)
        found.append(str(refused.value))

    assert found[0] == found[1]
    assert "cannot be instantiated: Failed to instantiate model; the FMU gave no message." in found[0]


def test_two_instances_of_an_fmu_that_allows_one_are_refused(tmp_path: Path) -> None:
    fmu = only_once(tmp_path)
    config = write_config(tmp_path, instances={name: {"fmu": str(fmu)} for name in ("one", "two")}, connections=[])
    plan = fmu_mesh.load(config).plan()

    with repeating(tmp_path) as runs, pytest.raises(ConfigurationError, match="cannot run in one process"):
        repeated(runs, plan)


def test_a_run_is_interrupted_and_the_next_is_not(tmp_path: Path) -> None:
    config = write_config(tmp_path, simulation={"real_time_factor": 1.0}, stop_time=1000.0)
    long, short = fmu_mesh.load(config).plan(), fmu_mesh.load(config).plan(stop_time=0.05)
    found: list[FmuMeshError] = []

    with repeating(tmp_path) as runs:

        def run() -> None:
            try:
                repeated(runs, long)
            except Interrupted as error:
                found.append(error)

        thread = threading.Thread(target=run)
        thread.start()
        wait_until(lambda: runs.point > 100, "points")
        assert runs.writer is not None
        assert runs.writer.counted[0][1] > 0
        asked = time.monotonic()
        runs.interrupt("enough")
        thread.join(10)

        assert time.monotonic() - asked < 5
        assert len(found) == 1
        assert found[0].message == "enough"
        assert found[0].point is not None
        rows = (tmp_path / "pair.csv").read_bytes().count(b"\n") - 1
        assert rows == found[0].point + 1
        assert f"({rows} rows) is in '{tmp_path / 'pair.csv'}'" in str(found[0])
        assert repeated(runs, short).point == 50

        runs.interrupt("before it begins")
        with pytest.raises(Interrupted, match="before it begins"):
            repeated(runs, short)
        assert repeated(runs, short).point == 50


def test_the_wall_clock_holds_a_run(tmp_path: Path) -> None:
    config = write_config(tmp_path, stop_time=0.601)
    slow = fmu_mesh.load(config).plan(real_time_factor=2.0)

    with repeating(tmp_path) as runs:
        assert_equal(runs, [slow])
        assert repeated(runs, slow).seconds >= 0.3


def test_of_an_fmu_that_hangs_the_rows_are_kept(tmp_path: Path, faulty: Path) -> None:
    """In a process of its own, because nobody can end the thread that is in the FMU."""
    config = write_config(
        tmp_path,
        instances={"pendulum": {"fmu": "DampedPendulum"}, "faulty": {"fmu": str(faulty)}},
        connections=["pendulum.a -> faulty.u"],
        stop_time=2.0,
        timeouts={"step": 0.5},
    )
    (tmp_path / "runs").mkdir()
    script = tmp_path / "hanging.py"
    script.write_text(
        "import os, sys\nfrom pathlib import Path\nimport fmu_mesh\n"
        "from fmu_mesh.run.repeated import RepeatedRuns\nfrom fmu_mesh.results.record_files import open_results\n\n"
        "def end(error):\n    print(error, flush=True)\n    os._exit(3)\n\n"
        f"mesh, runs = fmu_mesh.load({str(config)!r}), RepeatedRuns(Path({str(tmp_path / 'runs')!r}), on_hang=end)\n"
        "for hang_at in (1e9, 1.0):\n"
        "    plan = mesh.plan(start_values={'faulty.hang_at': hang_at})\n"
        "    print(runs.run(plan, lambda: open_results(plan.loaded, plan.plan.system)).point, flush=True)\n"
    )

    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=60, check=False)

    assert done.returncode == 3, done
    first, error = done.stdout.splitlines()
    assert first == "2000"
    assert error.startswith("instance faulty, point 1000, t = 1 s: the FMU has not returned for 0.")
    assert f"(1001 rows) is in '{tmp_path / 'pair.csv'}'" in error
    rows = (tmp_path / "pair.csv").read_text().splitlines()
    assert len(rows) == 1002
    assert rows[-1].startswith("1.0,")


# --- what is kept between runs


@RESETS
def test_between_runs_there_is_no_instance_unless_it_is_reset(tmp_path: Path, *, reset: bool) -> None:
    """The FMU says how many instances its library has, and had."""
    fmu = counting_fmu(tmp_path)
    config = write_config(tmp_path, instances={"it": {"fmu": str(fmu)}}, connections=[], stop_time=0.01)
    plan = fmu_mesh.load(config).plan()

    with repeating(tmp_path, reset=reset) as runs:
        found = [last_y(plan, runs) for _ in range(3)]

    assert found == ([1001.0, 1001.0, 1001.0] if reset else [1001.0, 1002.0, 1003.0])


def test_an_fmu_that_allows_one_instance_is_reset(tmp_path: Path) -> None:
    fmu = counting_fmu(tmp_path, allowing_one)
    config = write_config(tmp_path, instances={"it": {"fmu": str(fmu)}}, connections=[], stop_time=0.01)
    plan = fmu_mesh.load(config).plan()

    with repeating(tmp_path) as runs:
        found = [last_y(plan, runs) for _ in range(3)]

    assert found == [1001.0] * 3


@pytest.mark.parametrize(
    ("name", "version", "kind", "resets"),
    [
        ("AllTypes", None, "auto", True),
        ("AllTypes1", None, "auto", True),
        ("AllTypes3", None, "auto", False),
        ("Ball", 1, "model_exchange", False),
        ("Ball", 2, "model_exchange", True),
        ("Ball", 2, "co_simulation", True),
        ("Ball", 3, "model_exchange", True),
        ("Ball", 3, "co_simulation", True),
    ],
)
def test_an_instance_is_reset_where_the_fmu_can(
    tmp_path: Path,
    event_fmu: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    version: int | None,
    kind: str,
    resets: bool,  # noqa: FBT001  a parameter of tests
) -> None:
    """An FMU that refuses has a new instance in each run; these FMUs know the state machine of their version."""
    found: list[bool] = []
    reset = LoadedFmu.reset

    def noted(model: LoadedFmu) -> bool:
        found.append(reset(model))
        return found[-1]

    monkeypatch.setattr(LoadedFmu, "reset", noted)
    fmu = find_fmu(name, tmp_path) if version is None else event_fmu(name, version)
    config = write_config(tmp_path, instances={"it": {"fmu": str(fmu), "kind": kind}}, connections=[], stop_time=0.1)

    with repeating(tmp_path, reset=True) as runs:
        assert_equal(runs, [fmu_mesh.load(config).plan()] * 2)

    assert found == [resets] * 4


def test_messages_go_to_the_instance_of_the_run(tmp_path: Path, faulty: Path) -> None:
    messages: list[LogMessage] = []
    config = write_config(
        tmp_path, instances={name: {"fmu": str(faulty)} for name in ("one", "two")}, connections=[], stop_time=0.5
    )
    plans = plans_of(config, [{}, {"two.fail_at": 0.1}, {"one.fail_at": 0.2}])

    with repeating(tmp_path, log=messages.append, reset=True) as runs:
        for plan in plans:
            ended(plan, lambda plan: repeated(runs, plan))

    assert [(m.instance, m.status) for m in messages] == [("two", "error"), ("one", "error")]


def test_the_memory_stays_the_same(tmp_path: Path) -> None:
    mesh = fmu_mesh.load(write_config(tmp_path, stop_time=0.2))
    process = psutil.Process()

    with repeating(tmp_path) as runs:
        before = 0
        for number in range(300 + examples(1700)):
            repeated(runs, mesh.plan(start_values={"pendulum.d": number * 1e-4}))
            if number == 300:
                before = process.memory_info().rss
        after = process.memory_info().rss
        files = process.num_fds()
        repeated(runs, mesh.plan())
        assert process.num_fds() == files

    assert after - before < 8 * 2**20


def test_second_plan_of_mesh_reads_model_again_only_if_it_has_changed(tmp_path: Path) -> None:
    fmu = repacked(tmp_path / "gain.fmu")
    mesh = fmu_mesh.load(write_config(tmp_path, instances={"gain": {"fmu": str(fmu)}}, connections=[]))

    first, second = (mesh.plan().plan.system.instances["gain"].description for _ in range(2))
    repacked(fmu, description=lambda text: text.replace('modelName="Gain"', 'modelName="Other"'))
    third = mesh.plan().plan.system.instances["gain"].description

    assert second is first
    assert (first.model_name, third.model_name) == ("Gain", "Other")


def test_a_component_is_described_anew_unless_its_process_keeps_its_code(tmp_path: Path) -> None:
    base = "import fmu_mesh\n\n\nclass Base(fmu_mesh.Component):\n    y = fmu_mesh.Output()\n"
    own = "from base import Base\n\n\nclass Own(Base):\n    def step(self, time, step_size):\n        pass\n"
    (tmp_path / "base.py").write_text(base)
    (tmp_path / "own.py").write_text(own)
    mesh = fmu_mesh.Mesh.from_yaml(
        "mesh: m\nsimulation: {stop_time: 1.0, step_size: 0.1}\ninstances: {own: {python: own.py:Own}}\n",
        folder=tmp_path,
    )
    section = mesh.plan().plan.system.config.instances["own"]
    known = KnownModels(keeps_code=True)
    path, limits = tmp_path / "own.py", LimitsConfig()

    first = known.describe(path, section, limits)
    (tmp_path / "base.py").write_text(base.replace(" y = ", " another = "))

    assert known.describe(path, section, limits) is first
    assert [v.name for v in mesh.plan().plan.system.instances["own"].description.variables] == ["another"]


def test_numeric_libraries_use_one_thread_until_the_end(tmp_path: Path) -> None:
    def threads() -> set[int]:
        return {library["num_threads"] for library in threadpoolctl.threadpool_info()}

    plan = fmu_mesh.load(write_config(tmp_path, stop_time=0.1)).plan()
    with threadpoolctl.threadpool_limits(2):
        before = threads()
        with repeating(tmp_path) as runs:
            repeated(runs, plan)
            repeated(runs, plan)

            assert threads() == {1}
        assert threads() == before


ENDER = """
import fmu_mesh

class Ender(fmu_mesh.Component):
    u = fmu_mesh.Input()
    y = fmu_mesh.Output(start=0.0)
    end = fmu_mesh.Parameter(100.0)

    def step(self, time, step_size):
        if time >= self.end:
            raise ValueError("it ends")
"""


@ENGINES
@pytest.mark.usefixtures("_engine")
def test_of_two_that_fail_in_one_step_the_first_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a slice for each step, the second one, whose step is two points long, takes it before the first one."""
    (tmp_path / "ender.py").write_text(ENDER, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    mesh = fmu_mesh.Mesh("enders", stop_time=1.0, step_size=0.1, algorithm="jacobi")
    mesh.add("first", python="ender.py:Ender", start_values={"end": 0.1})
    mesh.add("second", python="ender.py:Ender", start_values={"end": 0.0}, step_size=0.2)
    mesh.add("third", python="ender.py:Ender")
    mesh.connect("third.y", "first.u")
    mesh.connect("second.y", "third.u")
    monkeypatch.setattr("fmu_mesh.node.burst_engine.SLICE_S", 1e-7)

    with pytest.raises(fmu_mesh.StepFailed, match="it ends") as failure:
        mesh.run(processes=False)

    assert (failure.value.instance, failure.value.point) == ("first", 1)
