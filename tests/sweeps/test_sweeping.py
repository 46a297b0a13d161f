"""Sweeps in the hands of a program: every row is that of a run alone, on any executor, and nothing is lost."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import psutil
import pytest

import fmu_mesh
from fmu_mesh.sweeps.sweep_folder import SweepFolder
from fmu_mesh.sweeps.variant_run import curves_of
from fmu_mesh.sweeps.worker_pool import WorkerLost, WorkerPool
from fmus.build import build
from tests.fmus.helpers import NO_COMPILER
from tests.helpers import DEADLINE_S, FMUS, PAIR, wait_until, write_config

VARY: Mapping[str, Any] = {
    "pendulum.d": [0.05, 0.3, 0.8],
    "simulation.algorithm": ["jacobi", "gauss_seidel"],
    "delay.d": [0.1, 0.25],
}
REDUCE = ["max(pendulum.a)", "last(delay.y)"]


@pytest.fixture
def config(tmp_path: Path) -> Path:
    return write_config(tmp_path)


def table(result: fmu_mesh.SweepResult) -> list[list[str]]:
    """The cells of the table but the last three, which tell how a variant was run."""
    return [line.rsplit(",", 3)[:1] for line in result.table.read_text().splitlines()]


def contents(result: fmu_mesh.SweepResult) -> list[bytes]:
    """The curves of all variants as they are in their files."""
    return [row.file.read_bytes() if row.file is not None else b"" for row in result]


@contextmanager
def executor_named(name: str) -> Iterator[Executor | None]:
    match name:
        case "workers":
            yield None
        case "threads":
            with ThreadPoolExecutor(2) as threads:
                yield threads
        case _:
            with ProcessPoolExecutor(2, get_context("forkserver")) as processes:
                yield processes


@pytest.mark.parametrize("name", ["workers", "threads", "processes"])
def test_every_row_and_curve_is_that_of_run_alone_on_every_executor(config: Path, tmp_path: Path, name: str) -> None:
    mesh = fmu_mesh.load(config)

    with executor_named(name) as executor:
        running = fmu_mesh.sweep(mesh, VARY, executor=executor, workers=2, reduce=REDUCE, folder=tmp_path / "sweep")
        with running:
            result = running.wait(DEADLINE_S)

    assert [row.variant for row in result] == [*range(12)]
    assert [*result[-1].parameters.values()] == [0.8, "gauss_seidel", 0.25]
    for row in result:
        alone = mesh.run(
            processes=False,
            output=tmp_path / "alone.csv",
            start_values={name: row.parameters[name] for name in ("pendulum.d", "delay.d")},
            algorithm=str(row.parameters["simulation.algorithm"]),
        )
        assert row.file is not None
        assert row.file.read_bytes() == (tmp_path / "alone.csv").read_bytes()
        assert row.values == {"max(pendulum.a)": alone["pendulum.a"].max(), "last(delay.y)": alone["delay.y"][-1]}
        assert (row.exit_code, row.message) == (0, "")


def test_models_that_a_thread_has_loaded_go_with_the_thread(config: Path, tmp_path: Path) -> None:
    with ThreadPoolExecutor(2) as threads:
        with fmu_mesh.sweep(config, {"pendulum.d": [0.1, 0.2]}, executor=threads, folder=tmp_path / "sweep") as running:
            running.wait(DEADLINE_S)
        assert "variants" in {thread.name for thread in threading.enumerate()}

    wait_until(lambda: "variants" not in {thread.name for thread in threading.enumerate()}, "the end of the threads")


def test_a_sweep_in_processes_has_the_rows_of_one_in_one_process(config: Path, tmp_path: Path) -> None:
    found = {}
    told: list[str] = []
    for processes in (False, True):
        options: dict[str, Any] = {
            "processes": processes,
            "folder": tmp_path / f"{processes}",
            "on_notice": told.append,
        }
        with fmu_mesh.sweep(config, {"pendulum.d": [0.1, 0.4]}, **options) as running:
            found[processes] = running.wait(DEADLINE_S)

    assert contents(found[True]) == contents(found[False])
    assert [row.values for row in found[True]] == [row.values for row in found[False]]
    assert sum("goes in two versions: leave it out" in text for text in told) == 1


def test_rows_and_progress_are_there_while_the_sweep_goes_on(faulty: Path, tmp_path: Path) -> None:
    config = write_config(tmp_path, instances={"f": {"fmu": str(faulty)}}, connections=[], stop_time=0.01)

    with fmu_mesh.sweep(config, [{"f.slow": slow} for slow in (0.0, 1e-4, 2e-4, 60.0)], workers=1) as running:
        wait_until(lambda: running.progress.done == 3, "three rows")
        progress, early = running.progress, running.result
        running.cancel()
        result = running.wait(DEADLINE_S)

    assert (progress.total, progress.failed) == (4, 0)
    assert progress.left is not None
    assert [row.variant for row in early] == [row.variant for row in result] == [0, 1, 2]
    assert result.table.read_text().count("\n") == 4
    with fmu_mesh.sweep(config, [{"f.slow": 0.0}, {"f.slow": 3e-4}], resume=True) as running:
        assert [row.exit_code for row in running.wait(DEADLINE_S)] == [0, 0]
        assert running.ran == 1


@pytest.mark.parametrize("curves", [True, False])
def test_a_failed_run_is_a_row_with_its_exit_code_and_message(faulty: Path, tmp_path: Path, *, curves: bool) -> None:
    config = write_config(
        tmp_path, instances={"f": {"fmu": str(faulty)}}, connections=[], stop_time=0.01, timeouts={"step": 1.0}
    )
    variants: list[dict[str, Any]] = [
        {"f.fail_at": 0.0045, "f.hang_at": 1e9, "f.crash_at": 1e9},
        {"f.fail_at": 1e9, "f.hang_at": 0.0045, "f.crash_at": 1e9},
        {"f.fail_at": 1e9, "f.hang_at": 1e9, "f.crash_at": 0.0045},
        {"f.fail_at": 1e9, "f.hang_at": 1e9, "f.crash_at": 1e9},
        {"f.fail_at": 1e9, "f.hang_at": 1e9, "f.crash_at": "soon"},
    ]

    with fmu_mesh.sweep(config, variants, workers=2, curves=curves) as running:
        result = running.wait(DEADLINE_S)

    assert [row.exit_code for row in result] == [3, 3, 4, 0, 2]
    failed, hung, crashed, fine, wrong = (row.message for row in result)
    assert failed == (
        "instance f, point 4, t = 0.004 s: fmi2DoStep returned error; the FMU says: the reactor is empty."
    )
    # On a busy machine, the watching thread looks a little after the deadline of 1 s.
    assert re.match(r"instance f, point 4, t = 0\.004 s: the FMU has not returned for 1\.\d s from doStep", hung)
    assert crashed == "the worker process was ended by SIGABRT in each of 2 attempts"
    assert "'soon' for the Real 'crash_at'" in wrong
    assert fine == ""
    assert result.summary == "5 of 5 runs, 4 failed"
    with fmu_mesh.sweep(config, variants, workers=2, resume=True, curves=curves) as running:
        assert [row.exit_code for row in running.wait(DEADLINE_S)] == [3, 3, 4, 0, 2]
    assert running.ran == 2  # what an FMU has failed would fail again
    if curves:
        assert len(result.curves(0).times) == 5  # what it has recorded is kept


def test_many_short_variants_in_one_job_fail_each_on_its_own(faulty: Path, tmp_path: Path) -> None:
    config = write_config(
        tmp_path, instances={"f": {"fmu": str(faulty)}}, connections=[], stop_time=0.01, timeouts={"step": 1.0}
    )
    never = {"f.fail_at": 1e9, "f.hang_at": 1e9, "f.crash_at": 1e9, "f.slow": 0.0}
    variants = [{**never, "f.slow": 1e-9 * number} for number in range(200)]
    for number, name in ((77, "f.fail_at"), (121, "f.hang_at"), (160, "f.crash_at")):
        variants[number] = {**never, name: 0.0045}

    with fmu_mesh.sweep(config, variants, workers=1, curves=False) as running:
        result = running.wait(DEADLINE_S)

    assert {row.variant: row.exit_code for row in result if row.exit_code} == {77: 3, 121: 3, 160: 4}
    assert result[77].message.startswith("instance f, point 4, t = 0.004 s: fmi2DoStep returned error")
    assert "the FMU has not returned for 1." in result[121].message
    assert "was ended by SIGABRT" in result[160].message
    assert len(result) == 200


def test_a_killed_worker_loses_nothing(tmp_path: Path) -> None:
    """Three variants kill their worker in the middle of their first run, so none is lost in both of its attempts."""
    killed_in = {3, 10, 25}
    (tmp_path / "killer.py").write_text(
        "import os, pathlib, signal\n"
        "import fmu_mesh\n"
        "class Killer(fmu_mesh.Component):\n"
        "    number = fmu_mesh.Parameter(0.0)\n"
        "    y = fmu_mesh.Output(start=0.0)\n"
        "    def step(self, time, step_size):\n"
        "        first = pathlib.Path(__file__).with_name(f'{self.number:g}')\n"
        "        if time > 0.5 and first.exists():\n"
        "            first.unlink()\n"
        "            os.kill(os.getpid(), signal.SIGKILL)\n"
        "        self.y = time\n"
    )
    config = write_config(tmp_path, instances={**PAIR, "killer": {"python": "killer.py:Killer"}})
    variants = [{"pendulum.d": 0.05 + 0.02 * number, "killer.number": float(number)} for number in range(40)]
    with fmu_mesh.sweep(config, variants, folder=tmp_path / "quiet") as running:
        undisturbed = running.wait(DEADLINE_S)
    assert not undisturbed.failed
    for number in killed_in:
        (tmp_path / f"{number}").touch()

    with fmu_mesh.sweep(config, variants, workers=2, folder=tmp_path / "killed") as running:
        result = running.wait(DEADLINE_S)

    assert not any((tmp_path / f"{number}").exists() for number in killed_in)
    assert len({row.worker for row in result}) > 2
    assert table(result) == table(undisturbed)
    assert contents(result) == contents(undisturbed)
    assert [row.values for row in result] == [row.values for row in undisturbed]


def test_a_job_with_a_lost_worker_reports_it_and_waiting_jobs_run() -> None:
    with WorkerPool(1) as pool:
        assert pool.submit(os.getpid).result(DEADLINE_S) == pool.pids[0]
        lost = pool.submit(os.kill, pool.pids[0], signal.SIGSEGV)
        waiting = [pool.submit(abs, -number) for number in range(4)]

        with pytest.raises(WorkerLost, match="was ended by SIGSEGV"):
            lost.result(DEADLINE_S)
        assert [future.result(DEADLINE_S) for future in waiting] == [0, 1, 2, 3]
        idle = pool.pids[0]
        os.kill(idle, signal.SIGKILL)
        wait_until(lambda: not psutil.pid_exists(idle), "the end of an idle worker")
        try:
            assert pool.submit(abs, -5).result(DEADLINE_S) == 5
        except WorkerLost:  # nobody had noticed yet
            assert pool.submit(abs, -5).result(DEADLINE_S) == 5


@pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))
def test_a_worker_that_grows_is_replaced_and_the_rows_are_the_same(tmp_path: Path) -> None:
    shutil.copytree(FMUS / "src" / "Gain", tmp_path / "leaking" / "Gain")
    source = tmp_path / "leaking" / "Gain" / "Gain.c"
    leak = "    if (time == 0.0) memset(lost = malloc(60 << 20), 1, 60 << 20);\n    calculate(s);\n    return fmi2OK;"
    text = source.read_text(encoding="utf-8").replace("    (void)time;\n", "")
    source.write_text(
        "#include <stdlib.h>\n#include <string.h>\nstatic char *volatile lost;\n"
        + text.replace("    calculate(s);\n    return fmi2OK;", leak),
        encoding="utf-8",
    )
    values: dict[bool, list[Any]] = {}
    workers: dict[bool, int] = {}
    for leaks in (False, True):
        fmu = build(source.parent, tmp_path / "leaking") if leaks else FMUS / "Gain.fmu"
        instances = {"gain": {"fmu": str(fmu), "start_values": {"u": 2.0}}}
        config = write_config(tmp_path, instances=instances, connections=[], stop_time=0.01)
        wanted = {"gain.k": [float(number) for number in range(14)]}

        with fmu_mesh.sweep(config, wanted, workers=1, folder=tmp_path / f"{leaks}") as running:
            result = running.wait(DEADLINE_S)

        assert [row.exit_code for row in result] == [0] * 14
        values[leaks] = [row.values for row in result]
        workers[leaks] = len({row.worker for row in result})

    assert values[True] == values[False]
    assert workers[False] == 1
    assert workers[True] > 1


def test_an_executor_that_is_broken_ends_the_sweep_and_keeps_the_rows(config: Path, tmp_path: Path) -> None:
    vary = {"pendulum.d": fmu_mesh.Range(0.05, 0.8, 200)}
    with ProcessPoolExecutor(1, get_context("forkserver")) as processes:
        pid = processes.submit(os.getpid).result(DEADLINE_S)
        with fmu_mesh.sweep(config, vary, executor=processes, folder=tmp_path / "sweep") as running:
            wait_until(lambda: running.progress.done > 2, "some rows")
            os.kill(pid, signal.SIGKILL)
            with pytest.raises(fmu_mesh.MeshLost, match="BrokenProcessPool") as raised:
                running.wait(DEADLINE_S)

    assert isinstance(raised.value.result, fmu_mesh.SweepResult)
    assert 2 < len(raised.value.result) < 200
    assert "`resume=True`" in str(raised.value)


def test_resume_runs_what_is_missing_and_the_table_is_the_same(config: Path, tmp_path: Path) -> None:
    folder = SweepFolder(tmp_path / "sweep")
    with fmu_mesh.sweep(config, VARY, reduce=REDUCE, folder=folder.path) as running:
        whole = running.wait(DEADLINE_S)
    before, lines = table(whole), (folder.path / "rows.jsonl").read_bytes().splitlines(keepends=True)
    torn = b"".join(lines[:5]) + lines[5][:20]
    (folder.path / "rows.jsonl").write_bytes(torn)  # killed while it wrote the sixth row
    identities = SweepFolder(folder.path).wanted().identities
    lost = next(identity for identity in identities if identity in torn.decode())
    curves_of(folder.curves, lost).unlink()

    with fmu_mesh.sweep(config, VARY, reduce=REDUCE, folder=folder.path, resume=True) as running:
        result = running.wait(DEADLINE_S)

    assert table(result) == before
    assert running.ran == 8
    assert all(row.file is not None for row in result)
    with fmu_mesh.sweep(config, VARY, reduce=[*REDUCE, "min(delay.y)"], folder=folder.path, resume=True) as running:
        running.wait(DEADLINE_S)
    assert running.ran == 12  # a new column needs all runs


def test_rows_of_other_machines_are_told(config: Path, tmp_path: Path) -> None:
    folder = tmp_path / "sweep"
    with fmu_mesh.sweep(config, {"pendulum.d": [0.1]}, folder=folder) as running:
        assert running.wait(DEADLINE_S).warnings == ()
    rows = folder / "rows.jsonl"
    row = json.loads(rows.read_text(encoding="utf-8"))
    rows.write_text(json.dumps(row | {"machine": "an older one"}) + "\n", encoding="utf-8")

    with fmu_mesh.sweep(config, {"pendulum.d": [0.1, 0.2]}, folder=folder, resume=True) as running:
        (warning,) = running.wait(DEADLINE_S).warnings

    assert running.ran == 1
    assert "may differ in the last digits" in warning
    assert "an older one" in warning
    assert row["machine"] in warning


def test_a_sweep_is_not_mixed_up_with_another_one(config: Path, tmp_path: Path) -> None:
    with fmu_mesh.sweep(config, {"pendulum.d": [0.1]}, folder=tmp_path / "sweep") as running:
        running.wait(DEADLINE_S)

    with pytest.raises(fmu_mesh.ConfigurationError, match=r"there is a sweep in .* already") as raised:
        fmu_mesh.sweep(config, {"pendulum.d": [0.1]}, folder=tmp_path / "sweep")
    assert "`resume=True`" in str(raised.value)
    with fmu_mesh.sweep(config, {"pendulum.d": [0.2]}, folder=tmp_path / "sweep", resume=True) as running:
        result = running.wait(DEADLINE_S)
    assert [row.parameters["pendulum.d"] for row in result] == [0.2]
    with (
        SweepFolder(tmp_path / "sweep").writing(),
        fmu_mesh.sweep(config, {"pendulum.d": [0.3]}, folder=tmp_path / "sweep", resume=True) as running,
        pytest.raises(fmu_mesh.ConfigurationError, match="another sweep is writing"),
    ):
        running.wait(DEADLINE_S)


def test_an_id_depends_on_configuration_parameters_and_models(config: Path, tmp_path: Path) -> None:
    def identity(path: Path, parameters: Sequence[Mapping[str, Any]], **options: Any) -> str:  # noqa: ANN401  those of `sweep`
        folder = tmp_path / f"sweep{len([*tmp_path.glob('sweep*')])}"
        with fmu_mesh.sweep(path, parameters, folder=folder, curves=False, **options) as running:
            [file] = [running.wait(DEADLINE_S)]
        return SweepFolder(folder).wanted().identities[0] if file else ""

    base = identity(config, [{"pendulum.d": 0.1}])
    model = tmp_path / "Pendulum.fmu"
    model.write_bytes((Path(__file__).parents[2] / "fmus" / "DampedPendulum.fmu").read_bytes())
    vary_model = [{"pendulum.d": 0.1, "instances.pendulum.fmu": str(model)}]
    others = [
        identity(config, [{"pendulum.d": 0.2}]),
        identity(config, [{"pendulum.d": 0.1}], stop_time=0.5),
        identity(config, [{"pendulum.d": 0.1, "pendulum.l": 1.0}]),
        identity(config, vary_model),
    ]
    with model.open("ab") as file:
        file.write(b"\0")  # another file, and still the same archive

    assert identity(config, [{"pendulum.d": 0.1}]) == base
    assert len({base, *others, identity(config, vary_model)}) == 6


def extreme(result: fmu_mesh.Result) -> float:
    """A reduction of a user."""
    return float(abs(result["pendulum.a"]).max())


def wrong(result: fmu_mesh.Result) -> object:
    """A reduction of a user that fails."""
    nothing: dict[str, object] = {}
    return nothing[result.title]


def test_functions_of_a_program_become_columns(config: Path, tmp_path: Path) -> None:
    with fmu_mesh.sweep(config, {"pendulum.a": [-1.0, 0.5]}, reduce=["max(pendulum.a)", extreme]) as running:
        result = running.wait(DEADLINE_S)
    assert result.columns == ("max(pendulum.a)", "extreme")
    assert result.values("extreme") == [1.0, 0.5]
    assert result.values("max(pendulum.a)") != [1.0, 0.5]

    with fmu_mesh.sweep(config, {"pendulum.a": [0.5]}, reduce=[wrong], folder=tmp_path / "wrong") as running:
        [row] = running.wait(DEADLINE_S)
    assert (row.exit_code, row.message) == (1, "the reduction 'wrong' raised KeyError: 'pair'")
    with pytest.raises(fmu_mesh.ConfigurationError, match="cannot be imported by the workers"):
        fmu_mesh.sweep(config, {"pendulum.a": [0.5]}, reduce=[lambda _result: 1.0], folder=tmp_path / "no")


WRONG: list[tuple[Mapping[str, Any], Mapping[str, Any], str]] = [
    ({"pendlum.d": [1.0]}, {}, "'pendlum.d' is neither .* Did you mean 'pendulum.d'"),
    ({"pendulum.dd": [1.0]}, {}, "`vary={'pendulum.dd': 1.0}`: the unknown variable 'dd' .* Did you mean 'd'"),
    ({"simulation.stop": [1.0]}, {}, "`vary={'simulation.stop': 1.0}`: an unknown key; .* 'stop_time'"),
    ({"pendulum.d": [1.0]}, {"reduce": ["max(pendulum.b)"]}, "pendulum.b"),
    ({"pendulum.d": [1.0]}, {"max_instances": {"Gain.fmu": 1}}, "no instance has the model 'Gain.fmu'"),
    ({"pendulum.d": [1.0]}, {"max_instances": {"DampedPendulum.fmu": 0}}, "one run needs 1 instances"),
]


@pytest.mark.parametrize(("vary", "options", "said"), WRONG, ids=lambda _value: None)
def test_what_is_wrong_is_told_before_anything_runs(
    config: Path, tmp_path: Path, vary: Mapping[str, Any], options: Mapping[str, Any], said: str
) -> None:
    with pytest.raises(fmu_mesh.ConfigurationError, match=said):
        fmu_mesh.sweep(config, vary, folder=tmp_path / "sweep", **options)

    assert not (tmp_path / "sweep").exists()


def test_no_more_instances_of_a_model_exist_than_are_allowed(tmp_path: Path) -> None:
    (tmp_path / "counted.py").write_text(
        "import os, pathlib\n"
        "import fmu_mesh\n"
        "HERE = pathlib.Path(__file__).parent / 'alive'\n"
        "class Counted(fmu_mesh.Component):\n"
        "    number = fmu_mesh.Parameter(0.0)\n"
        "    y = fmu_mesh.Output()\n"
        "    def initialize(self):\n"
        "        (HERE / f'{self.number:g}').touch()\n"
        "    def step(self, time, step_size):\n"
        "        self.y = max(self.y, float(len([*HERE.iterdir()])))\n"
        "    def close(self):\n"
        "        (HERE / f'{self.number:g}').unlink(missing_ok=True)\n"
    )
    (tmp_path / "alive").mkdir()
    mesh = fmu_mesh.Mesh("counted", step_size=0.01, stop_time=100.0)
    mesh.add("c", python=str(tmp_path / "counted.py") + ":Counted")
    most = {}
    for allowed in (1, 2):
        with fmu_mesh.sweep(
            mesh,
            {"c.number": [float(n) for n in range(8)]},
            workers=3,
            max_instances={"counted.py": allowed},
            reduce=["max(c.y)"],
            folder=tmp_path / f"sweep{allowed}",
        ) as running:
            result = running.wait(DEADLINE_S)
        assert not result.failed, result.failed[0].message
        most[allowed] = max(result.values("max(c.y)"))

    assert most == {1: 1.0, 2: 2.0}


def test_a_sweep_is_cancelled_by_whoever_leaves_it_and_leaves_no_process(config: Path, tmp_path: Path) -> None:
    vary = {"pendulum.d": fmu_mesh.Range(0.05, 0.8, 2000)}
    with fmu_mesh.sweep(config, vary, folder=tmp_path / "sweep") as running:
        wait_until(lambda: running.progress.done > 3, "some rows")
        workers = {int(row.worker.partition(":")[2]) for row in running.result}

    assert 3 < running.progress.done < 2000
    assert not any(psutil.pid_exists(pid) for pid in workers)
    assert running.result.table.is_file()
    with fmu_mesh.sweep(config, vary, folder=tmp_path / "two") as other:
        other.interrupt()
        with pytest.raises(fmu_mesh.Interrupted) as raised:
            other.wait(DEADLINE_S)
    assert "of 2000 runs are in" in str(raised.value)


def test_the_result_of_a_sweep_is_read_from_its_folder(config: Path, tmp_path: Path) -> None:
    with fmu_mesh.sweep(config, VARY, reduce=REDUCE, folder=tmp_path / "sweep") as running:
        result = running.wait(DEADLINE_S)

    again = fmu_mesh.SweepResult.read(tmp_path / "sweep")

    assert [*again] == [*result]
    assert (again.names, again.columns) == (result.names, result.columns)
    frame = again.to_pandas()
    assert frame["pendulum.d"].tolist() == result.values("pendulum.d")
    assert frame["max(pendulum.a)"].tolist() == result.values("max(pendulum.a)")
    assert again.curves(3)["delay.y"].tolist() == result.curves(3)["delay.y"].tolist()
    curves = again.curves_to_pandas()
    assert (curves.index.names, (*curves.columns,)) == (["variant", "time"], again.variables)
    assert curves.attrs["units"] == result.curves(0).units
    assert [*curves.index.unique("variant")] == [row.variant for row in again]
    assert curves.loc[3]["delay.y"].tolist() == again.curves(3)["delay.y"].tolist()
    assert [*again.curves_to_pandas("delay.*").columns] == ["delay.y"]
    with pytest.raises(fmu_mesh.UnknownName, match=r"Did you mean 'max\(pendulum.a\)'"):
        again.values("max(pendulum.b)")
    with pytest.raises(fmu_mesh.ConfigurationError, match="there is no sweep in"):
        fmu_mesh.SweepResult.read(tmp_path)
