"""Sweeps as arrays of jobs: what is submitted and asked, with false programs that fail, and with a real Slurm."""

from __future__ import annotations

import csv
import errno
import json
import os
import shlex
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import psutil
import pytest
import yaml

import fmu_mesh
from fmu_mesh.errors import ConfigurationError, DeadlineExceeded
from fmu_mesh.hosts import slurm
from fmu_mesh.hosts.slurm import SlurmJob, cancel
from fmu_mesh.sweeps.planned_sweep import planned_sweep
from fmu_mesh.sweeps.slurm_array import PART, ended_tasks, submit, unfinished
from fmu_mesh.sweeps.slurm_sweep import SlurmSweep
from fmu_mesh.sweeps.sweep_folder import SweepFolder
from fmu_mesh.sweeps.variant_run import Row
from tests.helpers import Launched, Place, wait_until
from tests.sweeps.slurm_cluster import NODES, SlurmCluster, missing

needs_slurm = pytest.mark.skipif(missing() is not None, reason=str(missing()))

Fake = Callable[[str, str], None]
"""Puts a program on the path: its name, and what it does, in the words of a shell."""


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fake:
    """No program of Slurm is on the path but those that the test makes."""
    programs = tmp_path / "programs"
    programs.mkdir()
    for name in ("cat", "env", "sleep"):
        (programs / name).symlink_to(f"/bin/{name}" if Path(f"/bin/{name}").exists() else f"/usr/bin/{name}")
    monkeypatch.setenv("PATH", str(programs))

    def make(name: str, text: str) -> None:
        program = programs / name
        program.write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
        program.chmod(0o755)

    return make


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder of a sweep, with a name that a shell, Slurm and its patterns could misunderstand."""
    made = tmp_path / "a sweep, 5 %a"
    made.mkdir()
    return made


def submitted(
    folder: Path, *command: str, tasks: int = 3, at_once: int | None = None, options: tuple[str, ...] = ()
) -> SlurmJob:
    """A job of one processor for each task."""
    words = command or ("true", PART)
    return submit(folder, words, name="fmu_mesh damping", tasks=tasks, at_once=at_once, cpus=1, options=options)


def job_in(folder: Path, tasks: int = 3) -> SlurmJob:
    return SlurmJob("17", folder / "sweep.sbatch", tasks)


def test_the_script_says_all_that_slurm_and_the_task_need(fake: Fake, folder: Path) -> None:
    fake("sbatch", 'echo "$PWD" "$@" >called; echo 17')

    job = submit(
        folder,
        ["/opt/my python", "-Pm", "fmu_mesh", "sweep", str(folder), "--part", PART],
        name="damping",
        tasks=8,
        at_once=3,
        cpus=4,
        options=["--partition=short", "--time 1:00:00"],
    )

    assert job == SlurmJob("17", folder / "sweep.sbatch", 8)
    assert (folder / "called").read_text() == f"{folder} --parsable sweep.sbatch\n"
    assert job.script.read_text().splitlines() == [
        "#!/bin/sh",
        "#SBATCH --job-name=damping",
        "#SBATCH --array=1-8%3",
        "#SBATCH --nodes=1",
        "#SBATCH --ntasks=1",
        "#SBATCH --cpus-per-task=4",
        f"#SBATCH --output='{folder.parent}/a sweep, 5 %%a/slurm-%a.log'",
        "#SBATCH --open-mode=append",
        "#SBATCH --requeue",
        "#SBATCH --partition=short",
        "#SBATCH --time 1:00:00",
        f"""exec '/opt/my python' -Pm fmu_mesh sweep {shlex.quote(str(folder))} --part "$SLURM_ARRAY_TASK_ID"/8""",
    ]


def test_a_command_reaches_its_program_word_by_word(fake: Fake, folder: Path) -> None:
    fake("sbatch", 'SLURM_ARRAY_TASK_ID=2 sh "$2" >words; echo 17')
    fake("sh", 'exec /bin/sh "$@"')
    words = ["$HOME", "a b", "'", '"', "`id`", "\\", "*", "{part}s"]

    submitted(folder, sys.executable, "-c", "import sys; print(sys.argv[1:])", PART, *words)

    assert (folder / "words").read_text() == f"{['2/3', *words]}\n"


def test_settings_of_the_user_do_not_overrule_the_script(
    fake: Fake, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake("sbatch", "env >called; echo 17")
    monkeypatch.setenv("SBATCH_ARRAY_INX", "1-2")
    monkeypatch.setenv("SBATCH_OUTPUT", "/dev/null")
    monkeypatch.setenv("SBATCH_PARTITION", "short")

    submitted(folder)

    known = {line.partition("=")[0] for line in (folder / "called").read_text().splitlines()}
    assert known & {"SBATCH_ARRAY_INX", "SBATCH_OUTPUT", "SBATCH_PARTITION"} == {"SBATCH_PARTITION"}


def test_a_host_without_slurm_is_told_what_to_install(fake: Fake, folder: Path) -> None:
    del fake

    with pytest.raises(ConfigurationError) as caught:
        submitted(folder)

    assert str(caught.value) == (
        "`sbatch` cannot be started: No such file or directory. Install the programs of Slurm "
        "(Debian, Ubuntu: apt install slurm-client), or run this on a login host."
    )
    assert unfinished(job_in(folder)) is None
    with pytest.raises(ConfigurationError, match="`scancel` cannot be started"):
        cancel(job_in(folder))


def test_a_line_break_in_the_name_of_the_folder_is_not_executed(fake: Fake, folder: Path) -> None:
    fake("sbatch", 'sh "$2"; echo 17')
    hostile = folder / "a\ntouch executed\n"
    hostile.mkdir()

    submitted(hostile)

    assert [path.name for path in hostile.iterdir()] == ["sweep.sbatch"]
    settings = [line for line in (hostile / "sweep.sbatch").read_text().splitlines() if not line.startswith("exec ")]
    assert all(line.startswith("#") for line in settings)


def test_the_words_of_sbatch_are_shown_if_it_refuses_a_job(fake: Fake, folder: Path) -> None:
    fake("sbatch", "echo 'sbatch: error: invalid partition specified: x' >&2; echo 'sbatch: error: Failed' >&2; exit 1")

    with pytest.raises(ConfigurationError) as caught:
        submitted(folder)

    script = folder / "sweep.sbatch"
    text = (
        f"`sbatch` has not submitted the job: invalid partition specified: x; Failed. The batch script is '{script}'."
    )
    assert str(caught.value) == text


def test_an_sbatch_that_prints_no_number_is_an_error_that_quotes_it(fake: Fake, folder: Path) -> None:
    fake("sbatch", "echo 'Welcome to the cluster 17'")

    with pytest.raises(ConfigurationError) as caught:
        submitted(folder)

    assert str(caught.value) == (
        "`sbatch` has printed no number of a job, but 'Welcome to the cluster 17'. "
        "`squeue --me` shows whether the job was submitted."
    )


def test_what_a_cluster_prints_around_the_number_is_ignored(fake: Fake, folder: Path) -> None:
    fake("sbatch", "echo 'You have 1000 hours left'; echo '4711;north'; echo 'sbatch: a warning' >&2")

    assert submitted(folder) == SlurmJob("4711", folder / "sweep.sbatch", 3, "north")


def test_a_folder_that_cannot_be_written_is_a_configuration_error(fake: Fake, folder: Path) -> None:
    fake("sbatch", "echo 17")
    (folder / "sweep.sbatch").mkdir()

    with pytest.raises(ConfigurationError, match=r"sweep\.sbatch' cannot be written: Is a directory"):
        submitted(folder)


def test_programs_that_hang_are_ended_with_all_that_they_have_started(
    fake: Fake, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(slurm, "_SUBMIT_S", 1.0)
    monkeypatch.setattr(slurm, "_ASK_S", 1.0)
    for name in ("sbatch", "squeue", "sacct", "scancel"):
        fake(name, f"sleep 1000 & echo $! >'{folder}/{name}.pid'; echo 17; wait")

    with pytest.raises(DeadlineExceeded, match=r"`sbatch` has not answered for 1 s\. `squeue --me` shows"):
        submitted(folder)
    assert unfinished(job_in(folder)) is None
    assert [task.state for task in ended_tasks(job_in(folder))] == [None, None, None]
    with pytest.raises(DeadlineExceeded, match="`scancel` has not answered for 1 s"):
        cancel(job_in(folder))

    for name in ("sbatch", "squeue", "sacct", "scancel"):
        started = int((folder / f"{name}.pid").read_text())
        wait_until(partial(has_ended, started), f"the end of what {name} has started")


def has_ended(pid: int) -> bool:
    try:
        return bool(psutil.Process(pid).status() == psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return True


@pytest.mark.parametrize(
    "option",
    [
        "--array=1-2",
        "--arr 1-2",
        "-a1-2",
        "--output=/tmp/x",
        "-o x",
        "--cpus-per-task=4",
        "-c 4",
        "--chdir=/tmp",
        "--wait",
        "--open-mode=truncate",
    ],
)
def test_an_option_that_belongs_to_the_sweep_is_refused(fake: Fake, folder: Path, option: str) -> None:
    fake("sbatch", "echo 17")

    with pytest.raises(ConfigurationError, match=r"cannot be given to `sbatch`: the sweep sets --[a-z-]+ itself"):
        submitted(folder, options=(option,))

    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("option", ["partition=short", "", "--comment=a\nrm -rf x"])
def test_what_is_no_option_is_refused(fake: Fake, folder: Path, option: str) -> None:
    fake("sbatch", "echo 17")

    with pytest.raises(ConfigurationError, match="is no option of `sbatch`"):
        submitted(folder, options=(option,))


@pytest.mark.parametrize(
    "option", ["--account=a", "-A a", "--clusters=a", "--error-free", "--wait-all-nodes=1", "-t1:00"]
)
def test_any_other_option_is_given_to_sbatch(fake: Fake, folder: Path, option: str) -> None:
    fake("sbatch", "echo 17")

    assert f"#SBATCH {option}\n" in submitted(folder, options=(option,)).script.read_text()


@pytest.mark.parametrize(
    ("does", "tasks"),
    [
        ("echo '1|COMPLETED'; echo '2|RUNNING'; echo '3|PENDING'", 2),
        ("echo '1|COMPLETING'; echo '2|REQUEUED'; echo '3|CONFIGURING'", 3),
        ("echo '1|SUSPENDED'; echo '2|REQUEUE_HOLD'; echo '3|SPECIAL_EXIT'", 3),
        ("echo '1|FAILED'; echo '2|TIMEOUT'; echo '3|OUT_OF_MEMORY'; echo '4|NODE_FAIL'; echo '5|CANCELLED'", 0),
        ("echo '1|PREEMPTED'; echo '2|BOOT_FAIL'; echo '3|DEADLINE'; echo '4|REVOKED'", 0),
        ("echo 'CLUSTER: north'; echo '  2|RUNNING'; echo", 1),
        ("exit 0", 0),
        ("echo 'slurm_load_jobs error: Invalid job id specified' >&2; exit 1", 0),
        ("echo 'slurm_load_jobs error: Unable to contact slurm controller (connect failure)' >&2; exit 1", None),
        ("echo 'squeue: error: Socket timed out on send/recv operation' >&2; exit 1", None),
        ("echo 'Welcome to the cluster'", None),
        ("echo '2|RUNNING'; echo 'N/A|RUNNING'", None),
        ("kill -9 $$", None),
    ],
)
def test_tasks_count_until_they_can_never_run_again(fake: Fake, folder: Path, does: str, tasks: int | None) -> None:
    fake("squeue", does)

    assert unfinished(job_in(folder)) == tasks


def test_a_job_on_another_cluster_is_asked_for_and_cancelled_there(fake: Fake, folder: Path) -> None:
    fake("squeue", f'echo "$@" >"{folder}/asked"')
    fake("scancel", f'echo "$@" >"{folder}/cancelled"')
    job = SlurmJob("17", folder / "sweep.sbatch", 3, "north")

    unfinished(job)
    cancel(job)

    assert "--clusters=north" in (folder / "asked").read_text().split()
    assert (folder / "cancelled").read_text() == "--clusters=north 17\n"


def test_an_ended_task_is_reported_with_its_state_and_last_log_line(fake: Fake, folder: Path) -> None:
    fake("squeue", "echo '1|COMPLETED'; echo '2|RUNNING'; echo '3|FAILED'; echo '4|TIMEOUT'; echo '5|NODE_FAIL'")
    job = job_in(folder, tasks=6)
    job.log(3).write_text("a line\n" * 10_000 + "MemoryError\n\n  \n")
    job.log(4).write_bytes(b"\xff\n")
    job.log(5).touch()

    assert [str(task) for task in ended_tasks(job)] == [
        f"task 3: FAILED; the last line of '{folder}/slurm-3.log': MemoryError",
        f"task 4: TIMEOUT; the last line of '{folder}/slurm-4.log': \N{REPLACEMENT CHARACTER}",
        f"task 5: NODE_FAIL; '{folder}/slurm-5.log' is empty",
        (
            f"task 6: its state is not known; there is no '{folder}/slurm-6.log'; "
            "it did not start, or its host cannot write to this folder"
        ),
    ]


def test_an_accounting_database_tells_how_tasks_ended_that_squeue_has_forgotten(fake: Fake, folder: Path) -> None:
    fake("squeue", "echo '5|PENDING'; echo '6|FAILED'")
    fake(
        "sacct",
        """cat <<'END'
17_1|COMPLETED|0:0
17_2|FAILED|3:0
17_3|OUT_OF_MEMORY|0:125
17_4|CANCELLED by 1000|0:0
17_5|NODE_FAIL|1:0
17_6|FAILED|0:9
17_[7-8%2]|PENDING|0:0
END""",
    )

    found = {task.task: task.state for task in ended_tasks(job_in(folder, tasks=7))}

    assert found == {
        2: "FAILED with exit code 3",
        3: "OUT_OF_MEMORY by signal 125",
        4: "CANCELLED",
        6: "FAILED by signal 9",
        7: None,
    }


def test_a_job_that_has_ended_can_be_cancelled(fake: Fake, folder: Path) -> None:
    fake("scancel", "echo 'scancel: error: Kill job error on job id 17: Invalid job id specified' >&2; exit 1")

    cancel(job_in(folder))


def test_a_job_that_cannot_be_cancelled_is_an_error(fake: Fake, folder: Path) -> None:
    fake("scancel", "echo 'scancel: error: Kill job error on job id 17: Access/permission denied' >&2; exit 1")

    with pytest.raises(
        ConfigurationError, match="`scancel 17` failed: Kill job error on job id 17: Access/permission denied"
    ):
        cancel(job_in(folder))


def test_rows_are_kept_on_a_file_system_without_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def lock(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", lock)
    row = Row("a", 0, "", {}, 0.5, "n1:1")

    with SweepFolder(tmp_path).writing(3) as rows:
        rows.add([row])

    assert SweepFolder(tmp_path).rows() == {"a": row}


PART_OF_A_SWEEP = """
import json, os, pathlib, signal, sys, threading, time

part, of = map(int, sys.argv[1].split("/"))
what = sys.argv[2]
rows = pathlib.Path(f"rows-{part}.jsonl")

def note(**values):
    with rows.open("a") as file:
        file.write(json.dumps({"part": part, "of": of, "node": os.environ["SLURMD_NODENAME"], **values}) + "\\n")

def terminated(*_):
    note(what="terminated")
    print("told to end", flush=True)
    sys.exit(1)

signal.signal(signal.SIGTERM, terminated)
print("begins", flush=True)
note(what="begun", pid=os.getpid(), cpus=os.environ["SLURM_CPUS_PER_TASK"])
end = time.monotonic() + 60
while what == "together" and len(list(pathlib.Path().glob("rows-*.jsonl"))) < of:
    assert time.monotonic() < end, "the other parts do not run at the same time"
    threading.Event().wait(0.05)
while what == "waiting" and not pathlib.Path("go").exists():
    assert time.monotonic() < end, "nobody says go"
    threading.Event().wait(0.05)
if what == "alone":
    os.close(os.open("alone", os.O_CREAT | os.O_EXCL))
    threading.Event().wait(0.3)
    os.unlink("alone")
note(what="done")
"""
"""Stands for a part of a sweep: says when it begins and ends, in a file of rows of its own."""


@pytest.fixture(scope="module")
def running() -> Iterator[SlurmCluster]:
    """A cluster."""
    with tempfile.TemporaryDirectory(prefix="slurm", dir="/tmp") as place, SlurmCluster(Path(place)) as cluster:
        yield cluster


@pytest.fixture
def cluster(running: SlurmCluster, monkeypatch: pytest.MonkeyPatch) -> SlurmCluster:
    """The cluster, which the programs of Slurm reach from here."""
    for name, value in running.environment.items():
        monkeypatch.setenv(name, value)
    return running


def part_of_a_sweep(
    folder: Path, what: str, *, tasks: int, at_once: int | None = None, options: tuple[str, ...] = ()
) -> SlurmJob:
    command = (sys.executable, "-c", PART_OF_A_SWEEP, PART, what)
    return submitted(folder, *command, tasks=tasks, at_once=at_once, options=options)


def rows_in(folder: Path) -> list[dict[str, object]]:
    return [json.loads(line) for file in sorted(folder.glob("rows-*.jsonl")) for line in file.read_text().splitlines()]


def ends(job: SlurmJob) -> None:
    wait_until(lambda: unfinished(job) == 0, f"the end of job {job.id}")


def begun(folder: Path, tasks: int) -> dict[int, int]:
    """The process ids of the first tasks, when they all run."""

    def found() -> dict[int, int]:
        rows = [row for row in rows_in(folder) if row["what"] == "begun"]
        return {int(str(row["part"])): int(str(row["pid"])) for row in rows} if len(rows) >= tasks else {}

    return wait_until(found, f"{tasks} tasks that run")


@needs_slurm
def test_the_tasks_of_an_array_run_together_on_several_hosts(cluster: SlurmCluster, folder: Path) -> None:
    del cluster

    job = part_of_a_sweep(folder, "together", tasks=4, options=("--comment='a b'", "--partition=all"))
    ends(job)

    rows = rows_in(folder)
    assert [(row["part"], row["of"], row["what"]) for row in rows] == [
        (part, 4, what) for part in (1, 2, 3, 4) for what in ("begun", "done")
    ]
    assert {row["node"] for row in rows} == {*NODES}
    assert ended_tasks(job) == ()
    assert [job.log(task).read_text() for task in (1, 2, 3, 4)] == ["begins\n"] * 4


@needs_slurm
def test_no_more_tasks_than_wanted_run_at_the_same_time(cluster: SlurmCluster, folder: Path) -> None:
    del cluster

    job = part_of_a_sweep(folder, "alone", tasks=4, at_once=1)
    ends(job)

    assert ended_tasks(job) == ()
    assert len(rows_in(folder)) == 8


@needs_slurm
def test_a_killed_task_ends_alone_and_is_told(cluster: SlurmCluster, folder: Path) -> None:
    job = part_of_a_sweep(folder, "waiting", tasks=3)
    pids = begun(folder, 3)

    os.kill(pids[2], signal.SIGKILL)
    wait_until(lambda: unfinished(job) == 2, "the end of the killed task")
    (folder / "go").touch()
    ends(job)

    assert cluster.states(job.id) == {1: "COMPLETED", 2: "FAILED", 3: "COMPLETED"}
    assert [str(task) for task in ended_tasks(job)] == [
        f"task 2: FAILED; the last line of '{folder}/slurm-2.log': begins"
    ]


@needs_slurm
def test_a_task_that_slurm_queues_again_runs_again(cluster: SlurmCluster, folder: Path) -> None:
    job = part_of_a_sweep(folder, "waiting", tasks=2)
    begun(folder, 2)

    cluster.ask("scontrol", "requeue", f"{job.id}_1")
    wait_until(lambda: {"part": 1, "what": "terminated"}.items() <= rows_in(folder)[1].items(), "the end of task 1")
    assert unfinished(job) == 2
    (folder / "go").touch()
    cluster.begin_again(f"{job.id}_1")
    ends(job)

    assert [row["what"] for row in rows_in(folder) if row["part"] == 1] == ["begun", "terminated", "begun", "done"]
    assert ended_tasks(job) == ()
    assert job.log(1).read_text().splitlines()[0] == "begins"
    assert job.log(1).read_text().splitlines()[-1] == "begins"


@needs_slurm
def test_a_cancelled_job_tells_its_tasks_to_end(cluster: SlurmCluster, folder: Path) -> None:
    job = part_of_a_sweep(folder, "waiting", tasks=2)
    begun(folder, 2)

    cancel(job)
    ends(job)
    cancel(job)

    assert [row["what"] for row in rows_in(folder)] == ["begun", "terminated"] * 2
    assert [(task.task, task.state, task.last_line) for task in ended_tasks(job)] == [
        (1, "CANCELLED", "told to end"),
        (2, "CANCELLED", "told to end"),
    ]
    assert cluster.states(job.id) == {1: "CANCELLED", 2: "CANCELLED"}


@needs_slurm
def test_slurm_itself_refuses_what_it_cannot_run(cluster: SlurmCluster, folder: Path) -> None:
    del cluster

    with pytest.raises(
        ConfigurationError, match=r"`sbatch` has not submitted the job: .*Invalid partition name specified"
    ):
        part_of_a_sweep(folder, "together", tasks=2, options=("--partition=nowhere",))
    with pytest.raises(ConfigurationError, match="Invalid job array specification"):
        part_of_a_sweep(folder, "together", tasks=100_000)


@needs_slurm
def test_a_controller_that_does_not_answer_is_asked_again_later(
    cluster: SlurmCluster, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = part_of_a_sweep(folder, "waiting", tasks=2)
    begun(folder, 2)

    cluster.controller.send_signal(signal.SIGSTOP)
    with monkeypatch.context() as patched:
        patched.setattr(slurm, "_ASK_S", 1.0)
        stopped = unfinished(job)
    cluster.controller.send_signal(signal.SIGCONT)

    assert stopped is None
    assert wait_until(lambda: unfinished(job), "an answer") == 2
    (folder / "go").touch()
    ends(job)


@needs_slurm
def test_a_job_that_slurm_has_forgotten_has_ended(cluster: SlurmCluster, folder: Path) -> None:
    del cluster
    job = SlurmJob("999999", folder / "sweep.sbatch", 1)

    assert unfinished(job) == 0
    assert [task.state for task in ended_tasks(job)] == [None]
    cancel(job)


GATE = """
import threading
from pathlib import Path

import fmu_mesh


class Gate(fmu_mesh.Component):
    number = fmu_mesh.Parameter(0.0)
    passed = fmu_mesh.Output()

    def step(self, time, step_size):
        while self.number == 9.0 and not Path(__file__).with_name("open").exists():
            Path(__file__).with_name("at_gate").touch()
            threading.Event().wait(0.02)
        self.passed = self.number
"""
"""The variant 9 does not end before there is a file `open`, and a file `at_gate` says that it has begun."""


def test_the_tasks_of_a_sweep_may_run_its_code(fake: Fake, tmp_path: Path) -> None:
    fake("sbatch", "echo 17")
    fake("squeue", "echo '1|RUNNING'")
    (tmp_path / "gate.py").write_text(GATE, encoding="utf-8")
    mesh = fmu_mesh.Mesh("gates", step_size=0.01, stop_time=0.02)
    mesh.add("gate", python=tmp_path / "gate.py:Gate")
    planned = planned_sweep(mesh, {"gate.number": [1.0, 2.0]}, folder=tmp_path / "held")

    with SlurmSweep(planned, tasks=1) as sweep:
        assert sweep.again.endswith("held --slurm --allow-code")

    script = (tmp_path / "held" / "sweep.sbatch").read_text(encoding="utf-8")
    assert "--no-progress --allow-code\n" in script


@pytest.fixture
def shared(cluster: SlurmCluster) -> Iterator[Place]:
    """A place that all hosts of the cluster share."""
    with Place() as place:
        place.environment |= cluster.environment
        yield place
        cluster.cancel_all()


def table_of(folder: Path) -> list[dict[str, str]]:
    """The rows of a table, without what is different on each machine."""
    with (folder / "table.csv").open(encoding="utf-8", newline="") as file:
        return [{name: row[name] for name in row if name not in {"seconds", "worker"}} for row in csv.DictReader(file)]


def start_held_sweep(place: Place, *options: str) -> Launched:
    """Start a sweep of 16 variants, of which task 2 of 2 cannot end; returns when all is done that can be."""
    (place.folder / "gate.py").write_text(GATE, encoding="utf-8")
    config = {
        "mesh": "gates",
        "simulation": {"stop_time": 0.02, "step_size": 0.01},
        "instances": {"gate": {"python": "gate.py:Gate"}},
    }
    (place.folder / "gates.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    vary = ("--vary", "gate.number=0:15:16", "--folder", "held")
    launched = place.start("sweep", "gates.yaml", *vary, "--slurm", "--tasks", "2", *options)

    def waits() -> bool:
        assert launched.running or launched.wait() == 0, launched.story()
        return row_lines(place.folder / "held" / "rows-1.jsonl") == 8 and (place.folder / "at_gate").exists()

    wait_until(waits, "8 rows of task 1, and the variant of task 2 that cannot end")
    return launched


def row_lines(file: Path) -> int:
    return file.read_bytes().count(b"\n") if file.exists() else 0


@needs_slurm
def test_a_sweep_as_an_array_equals_the_pool(shared: Place) -> None:
    config = Path(__file__).resolve().parents[2] / "configs" / "pendulum_delay.yaml"
    what = ("sweep", config, "--vary", "pendulum.d=0.05:0.8:16", "--stop-time", "1")

    pool = shared.run(*what, "--folder", "pool", "--workers", "2")
    array = shared.run(*what, "--folder", "array", "--slurm", "--tasks", "4", "--slurm-option=--partition=all")

    assert (pool.wait(), array.wait()) == (0, 0), shared.story()
    pool_folder, array_folder = shared.folder / "pool", shared.folder / "array"
    assert len(table_of(pool_folder)) == 16
    assert table_of(array_folder) == table_of(pool_folder)
    curves = sorted(file.name for file in (pool_folder / "runs").iterdir())
    assert len(curves) == 16
    assert sorted(file.name for file in (array_folder / "runs").iterdir()) == curves
    assert [(array_folder / "runs" / name).read_bytes() for name in curves] == [
        (pool_folder / "runs" / name).read_bytes() for name in curves
    ]
    assert [row_lines(array_folder / f"rows-{part}.jsonl") for part in (1, 2, 3, 4)] == [4, 4, 4, 4]


@needs_slurm
def test_the_variants_of_a_killed_task_run_again_by_resume(shared: Place) -> None:
    following = start_held_sweep(shared)

    own = {process.pid: process for process in shared.processes() if "2/2" in process.cmdline()}
    [task] = [process for process in own.values() if process.ppid() not in own]  # its workers are forked from it
    task.kill()
    code = following.wait()
    left = 8 - row_lines(shared.folder / "held" / "rows-2.jsonl")
    (shared.folder / "open").touch()
    resumed = shared.run("sweep", "held", "--resume", "--allow-code")

    assert code == 4, shared.story()
    assert 4 <= left <= 8  # those before the one that is held may be of the same job, which gives its rows together
    assert f"{left} variants have no row: task 2: FAILED" in following.errors
    assert f"16 of 16 runs, {16 - left} of them before, 0 failed" in resumed.output
    assert [(row["gate.number"], row["last(gate.passed)"]) for row in table_of(shared.folder / "held")] == [
        (str(number), str(float(number))) for number in range(16)
    ]


@needs_slurm
def test_ctrl_c_leaves_the_tasks_and_the_same_job_is_followed_again(cluster: SlurmCluster, shared: Place) -> None:
    following = start_held_sweep(shared)

    following.signal(signal.SIGINT)
    code = following.wait()
    [job] = cluster.jobs()
    again = shared.start("sweep", "held", "--slurm", "--allow-code")
    wait_until(lambda: f"job {job} of Slurm" in again.errors, "the second command, which follows")
    (shared.folder / "open").touch()

    assert code == 130
    assert f"`scancel {job}`" in following.errors
    assert again.wait() == 0, shared.story()
    assert [row["gate.number"] for row in table_of(shared.folder / "held")] == [str(n) for n in range(16)]
    assert [row_lines(shared.folder / "held" / f"rows-{part}.jsonl") for part in (1, 2)] == [8, 8]


@needs_slurm
def test_a_command_that_does_not_wait_ends_without_an_error(cluster: SlurmCluster, shared: Place) -> None:
    submitting = start_held_sweep(shared, "--no-wait")
    code = submitting.wait()
    [job] = cluster.jobs()

    (shared.folder / "open").touch()
    wait_until(lambda: not cluster.jobs(), "the end of the job")
    resumed = shared.run("sweep", "held", "--resume", "--allow-code")

    assert code == 0, shared.story()
    assert submitting.errors.splitlines() == [
        f"fmu-mesh: job {job} of Slurm has 2 tasks",
        f"fmu-mesh: `fmu-mesh sweep held --slurm --allow-code` follows it, and `scancel {job}` ends it",
    ]
    assert "16 of 16 runs, 16 of them before" in resumed.output


@needs_slurm
def test_sweep_is_not_submitted_again_while_nobody_knows_whether_its_tasks_run(
    cluster: SlurmCluster, shared: Place
) -> None:
    start_held_sweep(shared, "--no-wait")
    broken = shared.folder / "programs"
    broken.mkdir()
    (broken / "squeue").write_text("#!/bin/sh\necho 'Unable to contact slurm controller' >&2; exit 1\n")
    (broken / "squeue").chmod(0o755)

    shared.environment["PATH"] = f"{broken}:{cluster.environment['PATH']}"
    again = shared.start("sweep", "held", "--slurm", "--allow-code")
    wait_until(lambda: again.errors or not again.running, "the second command")

    assert len(cluster.jobs()) == 1
