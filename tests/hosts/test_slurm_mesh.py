"""A mesh as a job: what is said of its end, with false programs of Slurm, and the job itself, with a real Slurm."""

from __future__ import annotations

import re
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from fmu_mesh.cli.main import main
from fmu_mesh.errors import FmuMeshError, MeshLost, from_report
from fmu_mesh.hosts import slurm_mesh
from fmu_mesh.hosts.slurm import SlurmJob
from fmu_mesh.hosts.slurm_mesh import MeshScript, followed
from fmu_mesh.run.events import Event, EventWriter
from fmu_mesh.run.outcome import Outcome
from tests.helpers import DEADLINE_S, Launched, Place, row_count, wait_until, write_config
from tests.pages.blocks import blocks_of
from tests.sweeps.slurm_cluster import SlurmCluster, missing

needs_slurm = pytest.mark.skipif(missing() is not None, reason=str(missing()))

SCRIPT = MeshScript("", (("pendulum", "delay"), ("pump",)))
"""A job of two components."""
DONE = Outcome("done", 10, 0.01, 1.0, 11, None)
LOST = Outcome("failed", 7, 0.007, 1.0, 8, None, MeshLost("node 'delay' was lost", instance="delay", point=7).report())

Fake = Callable[[str, str], None]


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fake:
    """No program of Slurm is on the path but those that the test makes: its name, and what it does in a shell."""
    (programs := tmp_path / "programs").mkdir()
    monkeypatch.setenv("PATH", str(programs))
    monkeypatch.setattr(slurm_mesh, "_LOOK_S", 0.01)
    monkeypatch.setattr(slurm_mesh, "_POLL_S", 0.02)

    def make(name: str, text: str) -> None:
        (programs / name).write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
        (programs / name).chmod(0o755)

    return make


@pytest.fixture
def job(tmp_path: Path) -> SlurmJob:
    return SlurmJob("17", tmp_path / "mesh.sbatch")


def has_events(job: SlurmJob, *events: Event) -> None:
    """Let the master of a job have written these."""
    with job.script.with_name("events.jsonl").open("ab", buffering=0) as file:
        write = EventWriter(file.fileno())
        for event in events:
            write(event)


def command_of(process: psutil.Process) -> list[str]:
    """Its words; none if it has ended meanwhile."""
    try:
        return process.cmdline()
    except psutil.NoSuchProcess:
        return []


def end_of(job: SlurmJob) -> str:
    """What is said of the end of a job that has failed."""
    with pytest.raises(FmuMeshError) as raised:
        raise from_report(followed(job, SCRIPT, lambda _event: None).error or pytest.fail("it has not failed"))
    return str(raised.value)


def test_a_job_is_followed_to_its_outcome(fake: Fake, job: SlurmJob) -> None:
    fake("squeue", "echo '17|RUNNING|None'")
    shown: list[Event] = []
    has_events(job, DONE)

    assert followed(job, SCRIPT, shown.append) == DONE
    assert shown == [DONE]


def test_a_job_that_is_queued_again_has_no_outcome_yet(fake: Fake, job: SlurmJob, tmp_path: Path) -> None:
    has_events(job, LOST)
    file = job.script.with_name("events.jsonl")
    file.rename(tmp_path / "lost")
    has_events(job, DONE)
    file.rename(tmp_path / "done")
    (tmp_path / "lost").rename(file)
    line = f"read -r line <'{tmp_path}/done'; echo \"$line\" >>'{file}'"
    fake("squeue", f"echo 'PENDING|BeginTime'; if test -e '{tmp_path}/asked'; then {line}; fi; : >'{tmp_path}/asked'")
    shown: list[Event] = []
    said: list[str] = []

    assert followed(job, SCRIPT, shown.append, said.append) == DONE
    assert (shown, said) == ([DONE], ["job 17 of Slurm waits: BeginTime"])


def test_a_job_that_cannot_go_on_is_no_earlier_loss(fake: Fake, job: SlurmJob, tmp_path: Path) -> None:
    has_events(job, LOST)
    asked = f"test -e '{tmp_path}/asked'"
    fake("squeue", f"if {asked}; then echo FAILED; else echo 'PENDING|None'; : >'{tmp_path}/asked'; fi")
    job.log().write_text("fmu-mesh: the run in 'kept' cannot be resumed\n", encoding="utf-8")

    with pytest.raises(MeshLost, match=r"has not told how.*the run in 'kept' cannot be resumed"):
        followed(job, SCRIPT, lambda _event: None)


def test_half_a_line_is_read_when_it_is_whole(fake: Fake, job: SlurmJob, tmp_path: Path) -> None:
    has_events(job, DONE)
    file = job.script.with_name("events.jsonl")
    whole = file.read_bytes()
    file.write_bytes(whole[:20])
    (tmp_path / "rest").write_bytes(whole[20:])
    fake("squeue", f"read -r rest <'{tmp_path}/rest'; echo \"$rest\" >>'{file}'; echo '17|RUNNING|None'")

    assert followed(job, SCRIPT, lambda _event: None) == DONE


def test_why_a_job_waits_is_said_once(fake: Fake, job: SlurmJob, tmp_path: Path) -> None:
    has_events(job, DONE)
    events = job.script.with_name("events.jsonl").rename(tmp_path / "later")
    again = f"if test -e '{tmp_path}/twice'; then exec <'{events}'; while read -r line; do echo \"$line\"; done"
    again += f" >'{job.script.with_name('events.jsonl')}'; elif test -e '{tmp_path}/once'; then : >'{tmp_path}/twice';"
    again += f" else : >'{tmp_path}/once'; fi; echo 'PENDING|Resources'"
    fake("squeue", again)
    said: list[str] = []

    followed(job, SCRIPT, lambda _event: None, said.append)

    assert said == ["job 17 of Slurm waits: Resources"]


def test_a_killed_task_is_said_with_node_host_and_reason(fake: Fake, job: SlurmJob) -> None:
    fake("squeue", "echo FAILED")
    has_events(job, LOST)
    lines = [
        "instance pump at point 3: a message of srun: error: component 1: n9: task 0: Killed",
        "srun: error: component 0: n1: task 1: Killed",
        "srun: error: component 1: n2: task 0: Exited with exit code 4",
        "srun: launch/slurm: _step_signal: Terminating StepId=17.0",
    ]
    job.log().write_text("\n".join(lines), encoding="utf-8")

    assert end_of(job) == (
        "instance delay, point 7: node 'delay' was lost. Slurm says: task 1 (node 'delay') on n1: Killed."
    )


def test_what_kills_for_memory_is_said(fake: Fake, job: SlurmJob) -> None:
    fake("squeue", "echo OUT_OF_MEMORY; echo FAILED")
    fake("sacct", "echo '17+0|OUT_OF_MEMORY|0:125'; echo '17+1|FAILED|4:0'")
    has_events(job, LOST)
    lines = [
        "slurmstepd: error: Detected 1 oom_kill event in StepId=17.0. Some of the step tasks have been OOM Killed.",
        "srun: error: component 0: n1: tasks 0-1: Out Of Memory",
        "srun: error: component 1: n2: task 0: Terminated",
    ]
    job.log().write_text("\n".join(lines), encoding="utf-8")

    said = end_of(job)

    assert "task 0 (node 'pendulum') on n1: Out Of Memory; task 1 (node 'delay') on n1: Out Of Memory" in said
    assert "task 0 (node 'pump') on n2: Terminated; Detected 1 oom_kill event in StepId=17.0" in said
    assert "the job ended as OUT_OF_MEMORY by signal 125" in said


def test_a_job_whose_master_says_nothing_ends_with_the_words_of_slurm(fake: Fake, job: SlurmJob) -> None:
    fake("squeue", "echo 'NODE_FAIL|None'")
    job.log().write_text("srun: error: Node failure on n2\n", encoding="utf-8")

    with pytest.raises(MeshLost) as raised:
        followed(job, SCRIPT, lambda _event: None)

    text = "job 17 of Slurm has ended, and its master has not told how. Slurm says: Node failure on n2; "
    assert str(raised.value).startswith(text)


def test_a_slurm_that_says_nothing_has_a_deadline(fake: Fake, job: SlurmJob, monkeypatch: pytest.MonkeyPatch) -> None:
    fake("squeue", "echo 'Unable to contact slurm controller' >&2; exit 1")
    monkeypatch.setattr(slurm_mesh, "_SILENCE_S", 0.5)

    with pytest.raises(MeshLost, match=r"Slurm has not told the state of job 17 for 0\.5 s"):
        followed(job, SCRIPT, lambda _event: None)


@pytest.fixture(scope="module")
def running() -> Iterator[SlurmCluster]:
    """A cluster."""
    with tempfile.TemporaryDirectory(prefix="slurm", dir="/tmp") as place, SlurmCluster(Path(place)) as cluster:
        yield cluster


@pytest.fixture
def shared(running: SlurmCluster) -> Iterator[Place]:
    """A place that all hosts of the cluster share."""
    with Place() as place:
        place.environment |= running.environment
        yield place
        running.cancel_all()


def long_job(place: Place) -> tuple[Path, Launched]:
    """A job that goes on until it is ended, and has its first rows."""
    config = write_config(place.folder, stop_time=1e4, simulation={"real_time_factor": 1.0})
    submitting = place.start("submit", "slurm", config, "--insecure", "--no-progress")

    def has_rows() -> bool:
        assert submitting.running, submitting.story()
        return row_count(config.with_suffix(".csv")) > 0

    wait_until(has_rows, "rows")
    return config, submitting


@needs_slurm
def test_the_main_job_through_slurm_has_the_bytes_of_one_process(shared: Place) -> None:
    config = Path(__file__).resolve().parents[2] / "configs" / "pendulum_delay.yaml"
    local = shared.run("launch", config, "--local", "--output", "local.csv")

    job = shared.run("submit", "slurm", config, "--insecure", "--output", "job.csv", "--slurm-option=--partition=all")

    assert (local.wait(), job.wait()) == (0, 0), shared.story()
    assert (shared.folder / "job.csv").read_bytes() == (shared.folder / "local.csv").read_bytes()
    assert re.search(r"^20000 points in ", job.output, re.MULTILINE)
    assert "result: job.csv (20001 rows)" in job.output
    assert list(shared.folder.glob("*slurm*")) == []


@needs_slurm
def test_paths_that_srun_could_misread_reach_nodes(shared: Place) -> None:
    folder = shared.folder / "a $HOME, `5%t` mesh"
    folder.mkdir()
    config = write_config(folder)

    job = shared.run("submit", "slurm", config, "--insecure")

    assert job.wait() == 0, shared.story()
    assert row_count(config.with_suffix(".csv")) == 1001


def test_a_folder_in_which_slurm_writes_no_log_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder := tmp_path / "a\\b").mkdir()

    assert main(["submit", "slurm", str(write_config(folder)), "--insecure"]) == 2

    assert "there is a backslash in its name" in capsys.readouterr().err
    assert [path.name for path in folder.iterdir()] == ["pair.yaml"]


@needs_slurm
def test_nodes_with_a_host_are_a_component_of_their_own(shared: Place, running: SlurmCluster) -> None:
    instances: dict[str, dict[str, Any]] = {
        "pendulum": {"fmu": "DampedPendulum"},
        "delay": {"fmu": "TransportDelay", "start_values": {"d": 0.1}, "host": "other"},
    }
    config = write_config(shared.folder, instances=instances, deploy={"hosts": {"other": {}}})
    local = shared.run("launch", config, "--local", "--output", "local.csv")

    job = shared.run("submit", "slurm", config, "--insecure")

    assert (local.wait(), job.wait()) == (0, 0), shared.story()
    assert config.with_suffix(".csv").read_bytes() == (shared.folder / "local.csv").read_bytes()
    assert "+1" in running.ask("squeue", "--noheader", "--states=all", "--format=%i")


@needs_slurm
def test_a_task_that_is_killed_is_told_with_host_and_reason(shared: Place) -> None:
    _, submitting = long_job(shared)

    [node] = [one for one in shared.processes() if {"node", "delay"} <= {*command_of(one)}]
    node.kill()

    assert submitting.wait() == 4, shared.story()
    told = submitting.errors.splitlines()[-1]
    assert re.search(r"instance delay, point \d+.*: node 'delay' was lost", told), told
    assert re.search(r"Slurm says: task 1 \(node 'delay'\) on n[12]: Killed", told), told
    wait_until(lambda: not shared.processes(), "the end of all processes", DEADLINE_S)


@needs_slurm
def test_a_failing_fmu_ends_the_command_with_its_code(shared: Place, running: SlurmCluster) -> None:
    text = "import fmu_mesh\nclass Failing(fmu_mesh.Component):\n    y = fmu_mesh.Output(start=0.0)\n"
    text += "    def step(self, time, step_size):\n        raise ValueError('the tank is empty')\n"
    (shared.folder / "failing.py").write_text(text, encoding="utf-8")
    config = write_config(shared.folder, instances={"tank": {"python": "failing.py:Failing"}}, connections=())

    job = shared.run("submit", "slurm", config, "--insecure")

    assert job.wait() == 3, shared.story()
    assert "instance tank, point 0" in job.errors
    assert "the tank is empty" in job.errors
    wait_until(lambda: not running.jobs(), "the end of the job")


@needs_slurm
def test_ctrl_c_leaves_the_job_and_scancel_ends_it(shared: Place, running: SlurmCluster) -> None:
    config, submitting = long_job(shared)
    rows = row_count(config.with_suffix(".csv"))

    submitting.signal(signal.SIGINT)
    code, [job] = submitting.wait(), running.jobs()
    wait_until(lambda: row_count(config.with_suffix(".csv")) > rows, "more rows")
    running.ask("scancel", job)

    assert code == 130
    assert f"job {job} of Slurm goes on. `scancel {job}` ends it." in submitting.errors
    wait_until(lambda: not shared.processes(), "the end of all processes", DEADLINE_S)


def kept_job(place: Place, name: str) -> Path:
    """The configuration of a job of ten seconds that can go on; `local.csv` beside it is its result in one process."""
    recovery, pace = {"directory": "kept"}, {"real_time_factor": 2.0}
    config = write_config(place.folder, name=name, stop_time=20.0, simulation=pace, recovery=recovery)
    alone = ["--set-config", "recovery.directory=null", "--real-time-factor", "0"]
    local = place.run("launch", config, "--local", *alone, "--output", "local.csv")
    assert local.wait() == 0, local.story()
    return config


def queue_again(cluster: SlurmCluster, config: Path) -> None:
    """As soon as the only job has a checkpoint and rows, end it as the administrator of a cluster does."""
    wait_until(lambda: row_count(config.with_suffix(".csv")) > 0, "rows")
    wait_until(lambda: [*config.with_name("kept").glob("*.state")], "a checkpoint")
    [job] = cluster.jobs()
    cluster.ask("scontrol", "requeue", job)
    cluster.begin_again(job)


@needs_slurm
def test_a_job_that_slurm_queues_again_equals_one_process(shared: Place, running: SlurmCluster) -> None:
    config = kept_job(shared, "pair")
    job = shared.start("submit", "slurm", config, "--slurm-option=--cpus-per-task=2")  # the hosts have no third one

    queue_again(running, config)

    assert job.wait() == 0, shared.story()
    assert "the run is resumed, and goes on from point" in job.errors
    assert config.with_suffix(".csv").read_bytes() == (shared.folder / "local.csv").read_bytes()
    assert list(shared.folder.glob("*slurm*")) == []


@needs_slurm
def test_a_new_job_goes_on_where_it_is_told_to(shared: Place) -> None:
    config, option = kept_job(shared, "pair"), "--slurm-option=--cpus-per-task=2"
    launched = shared.start("launch", config)
    wait_until(lambda: [*config.with_name("kept").glob("*.state")], "a checkpoint")
    launched.signal(signal.SIGINT)
    launched.wait()

    plain = shared.run("submit", "slurm", config, option)
    resumed = shared.run("submit", "slurm", config, option, "--resume", "--real-time-factor", "0")

    assert (plain.wait(), resumed.wait()) == (2, 0), shared.story()
    assert "has a run of mesh 'pair' that has not ended. Go on with it with `--resume`" in plain.errors
    assert config.with_suffix(".csv").read_bytes() == (shared.folder / "local.csv").read_bytes()


@needs_slurm
def test_the_script_of_the_page_goes_on_when_queued_again(shared: Place, running: SlurmCluster) -> None:
    page = Path(__file__).resolve().parents[2] / "docs" / "recovery.md"
    [text] = [block.text for block in blocks_of(page) if "SLURM_RESTART_COUNT" in block.text]
    (script := shared.folder / "job.sbatch").write_text(text, encoding="utf-8")
    config = kept_job(shared, "plant")
    programs = f"{Path(sys.executable).parent}:{running.environment['PATH']}"
    running.ask("sbatch", f"--chdir={shared.folder}", f"--export=ALL,PATH={programs}", str(script))

    queue_again(running, config)

    wait_until(lambda: not running.jobs(), "the end of the job", DEADLINE_S)
    said = next(shared.folder.glob("slurm-*.out")).read_text(encoding="utf-8")
    assert "the run is resumed, and goes on from point" in said
    assert config.with_suffix(".csv").read_bytes() == (shared.folder / "local.csv").read_bytes(), said


@needs_slurm
def test_slurm_itself_refuses_a_partition_and_nothing_is_left(shared: Place) -> None:
    config = write_config(shared.folder)

    job = shared.run("submit", "slurm", config, "--insecure", "--slurm-option=--partition=nowhere")

    assert job.wait() == 2
    assert "invalid partition specified: nowhere" in job.errors.lower()
    assert list(shared.folder.glob("*slurm*")) == []
