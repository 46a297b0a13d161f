"""Slurm: its programs, a mesh as a batch script, and what is known of a job that runs.

In the script, the first host runs the master, and `srun --multi-prog` starts the nodes, which connect to it. Nodes with
the same `host` are a component of a heterogeneous job, on one machine. It knows the programs of Slurm and what they
print, and needs no accounting database: where there is one, it also tells how jobs ended that `squeue` has forgotten.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
from msgspec.structs import replace

from .. import __version__
from ..errors import ConfigurationError, DeadlineExceeded, FmuMeshError, MeshLost
from ..files import write_whole
from ..run.events import Event, decode_event
from ..run.outcome import Outcome
from ..run.run_plan import RunPlan
from .processes import MeshProcess, identity_folder, processes_of

__all__ = [
    "COMPLETED",
    "ENDED",
    "MeshScript",
    "SlurmJob",
    "accounted",
    "batch_script",
    "cancel",
    "check_option",
    "end_of_log",
    "followed",
    "log_option",
    "queued",
    "submitted",
]

_LOG: Final = "slurm-{task}.log"
_SUBMIT_S, _ASK_S = 60.0, 30.0
_LOOK_S, _POLL_S = 1.0, 10.0
"""Time in s between two questions: the controller serves all users."""
_SILENCE_S: Final = 600.0
"""How long Slurm may leave questions without an answer, in s."""
_REST_S: Final = 60
"""How long the other tasks may go on when one has ended, in s."""
_TAIL = 1 << 16
"""Length in bytes of the end of a log that is looked at."""
_EVENTS: Final = "events.jsonl"

COMPLETED: Final = "COMPLETED"
ENDED: Final = frozenset(
    f"BOOT_FAIL CANCELLED {COMPLETED} DEADLINE FAILED NODE_FAIL OUT_OF_MEMORY PREEMPTED REVOKED TIMEOUT".split()
)
"""States in which a task never runs again. A task that Slurm queues again is PENDING (squeue, job state codes)."""

_OWN_OPTIONS: Final = {"--chdir": "-D", "--error": "-e", "--ntasks": "-n", "--output": "-o", "--wait": "-W"}
"""Options of `sbatch` that belong to the job of a mesh, with their short form."""

_OVERRULING: Final = (
    *("SBATCH_ARRAY_INX", "SBATCH_ERROR", "SBATCH_OPEN_MODE", "SBATCH_OUTPUT", "SBATCH_WAIT"),
    *("SQUEUE_", "SCANCEL_"),
)
"""Beginnings of the environment variables with which a user changes what the programs do or print."""


class SlurmJob(msgspec.Struct, frozen=True):
    """A job that was submitted: an array, or one that runs a mesh.

    Example:
        >>> SlurmJob("4711", Path("damping/sweep.sbatch"), tasks=8).log(3)
        PosixPath('damping/slurm-3.log')
    """

    id: str  # number of the job, as `squeue --jobs` and `scancel` take it
    script: Path  # its batch script, in the folder that also has the logs
    tasks: int = 1  # those of an array; they are numbered from 1
    cluster: str | None = None  # name of the cluster, if `sbatch` has named one

    def log(self, task: int = 1) -> Path:
        """The file with what a task has printed."""
        return self.script.with_name(_LOG.format(task=task))


def log_option(folder: Path, task: str) -> str:
    """The option of `sbatch` with the log of a task, in the folder of the script; ``task`` may be words of Slurm.

    Raises:
        ConfigurationError: Slurm cannot write there.
    """
    if "\\" in str(folder.absolute()):
        raise ConfigurationError(f"Slurm can write no log into '{folder}': there is a backslash in its name")
    log = str(folder.absolute()).replace("%", "%%") + "/" + _LOG.format(task=task)  # Slurm replaces %a, in folders, too
    if not log.isprintable():  # a line break would end the comment; tasks run in this folder anyway
        log = _LOG.format(task=task)
    return f"--output={shlex.quote(log)}"


class MeshScript(NamedTuple):
    """The batch script of a mesh.

    Attributes:
        text: all of it.
        components: the names of the processes of each component of the job, in the order of their tasks.
    """

    text: str
    components: tuple[tuple[str, ...], ...]


def batch_script(
    run: RunPlan, options: Sequence[str | Path], slurm_options: Sequence[str] = (), *, folder: Path | None = None
) -> MeshScript:
    """Write the batch script of a mesh; a job ends with the exit code of the master.

    Args:
        run: the plan.
        options: those of the command line with which it was made; all processes get them.
        slurm_options: more options of `sbatch`, such as ``--partition=short``, for each component of the job.
        folder: an existing folder that all hosts share, for the log, and for the events of the master, which
            `followed` reads; None: there are no events, and the log is where `sbatch` puts it.

    Raises:
        ConfigurationError: the mesh cannot be started in parts, or an option is none.
    """
    for option in slurm_options:
        check_option(option, _OWN_OPTIONS, "the job of a mesh")
    master, *others = processes_of(
        run, options, address="$address", port="$port", security=lambda role: identity_folder(run.loaded, role)
    )
    groups: dict[str | None, list[MeshProcess]] = {None: []}
    for process in others:
        groups.setdefault(process.host, []).append(process)
    settings = [f"--job-name={shlex.quote(run.mesh)}", "--no-requeue"]
    settings += [log_option(folder, "1")] if folder is not None else []
    starts: list[str] = []
    for number, (host, members) in enumerate(groups.items()):
        limits = [process.memory for process in members]
        settings += ["hetjob"] if number else []
        settings += [f"--ntasks={len(members) + (host is None)}", "--cpus-per-task=1"]  # one more for the master
        settings += ["--nodes=1"] if host is not None else []
        settings += [f"--mem-per-cpu={-(-max(filter(None, limits)) >> 20)}M"] if limits and all(limits) else []
        settings += slurm_options
        if members:
            starts += _step(number, f" --het-group={number}" if len(groups) > 1 else "", members)
    events = ("--events", str(folder / _EVENTS)) if folder is not None else ()
    text = _SCRIPT.format(
        version=__version__,
        mesh=run.mesh,
        settings="\n".join(f"#SBATCH {setting}" for setting in settings),
        folder=shlex.quote(os.getcwd()),  # noqa: PTH109  where `launch` would run
        python=shlex.quote(sys.executable),
        master=_command(master, shlex.quote, *events),
        starts="\n".join(starts),
    )
    return MeshScript(text, tuple(tuple(process.name for process in members) for members in groups.values()))


_SCRIPT: Final = """\
#!/bin/sh
{settings}
# Mesh '{mesh}', written by fmu-mesh {version}. The exit code is that of the master.
cd {folder} || exit 2
address=$(hostname)
port=$({python} -c 'import socket; print(socket.create_server(("", 0)).getsockname()[1])') || exit 2
tasks=$(mktemp -d) || exit 2
trap 'rm -r "$tasks"' EXIT
{master} &
master=$!
trap 'kill -TERM "$master"' TERM INT
{starts}
wait "$master"; code=$?
while kill -0 "$master" 2>/dev/null; do wait "$master"; code=$?; done
wait
exit "$code"
"""
"""A signal interrupts `wait`, so the master is waited for until it is gone."""


def _step(number: int, group: str, members: Sequence[MeshProcess]) -> list[str]:
    """The lines of a script that start the nodes of a component. What srun says of a task gets the number of it.

    With `--label`, no task can write a line that looks like one of srun.
    """
    rows = [f"{rank} {_command(process, _for_srun)}" for rank, process in enumerate(members)]
    options = f"--ntasks={len(members)} --label --wait={_REST_S} --kill-on-bad-exit=0 --multi-prog"
    named = f"sed -u 's/^srun: error: /&component {number}: /'"
    return [f'cat >"$tasks/{number}" <<END', *rows, "END", f'srun{group} {options} "$tasks/{number}" 2>&1 | {named} &']


def _command(process: MeshProcess, quoted: Callable[[str], str], *more: str) -> str:
    """The command of a process; where the master is, in words of the shell, is not quoted."""
    words = [process.python or sys.executable, "-Pm", "fmu_mesh", *map(str, process.words), *more]
    return " ".join(word if word.endswith(":$port") else quoted(word) for word in words)


def _for_srun(word: str) -> str:
    """A word in a file of `srun --multi-prog`, which has single quotes only, in a here-document of a shell."""
    if "'" in word or not word.isprintable():
        text = f"`srun --multi-prog` cannot take {word!r}: there is a quote or a line break in it"
        raise ConfigurationError(text, hint="Choose another path, or write the value into the configuration.")
    shown = word if shlex.quote(word) == word and "%" not in word else f"'{word}'"
    return re.sub(r"([\\$`])", r"\\\1", shown)


def followed(
    job: SlurmJob, script: MeshScript, show: Callable[[Event], None], say: Callable[[str], None] = lambda _text: None
) -> Outcome:
    """Follow the job of a mesh to its end, and show the events of its master.

    Args:
        job: it was submitted with the ``script``, whose folder has the events.
        script: as `batch_script` has made it.
        show: gets each event.
        say: gets why the job waits.

    Returns:
        The outcome; of an error that says that something was lost, its hint has what Slurm says.

    Raises:
        MeshLost: the job has ended without an outcome, or Slurm does not answer.
    """
    never, events, over = threading.Event(), _Tail(job.script.with_name(_EVENTS)), False
    answered, asked, told = time.monotonic(), 0.0, ""
    while True:
        for line in events.lines():
            event = decode_event(line)
            if isinstance(event, Outcome):
                event = _explained(event, job, script)
            show(event)
            if isinstance(event, Outcome):
                return event
        if over:
            text = f"job {job.id} of Slurm has ended, and its master has not told how"
            raise MeshLost(text, hint=_said(job, script))
        never.wait(_LOOK_S)
        now = time.monotonic()
        if now - asked < _POLL_S:
            continue
        asked, lines = now, queued(job, "%T|%r")
        answered = now if lines is not None else answered
        if now - answered > _SILENCE_S:
            raise MeshLost(f"Slurm has not told the state of job {job.id} for {_SILENCE_S:g} s")
        over = lines is not None and all(line.partition("|")[0] in ENDED for line in lines)
        waits = next((line for line in lines or () if line.startswith("PENDING|")), "").partition("|")[2]
        if waits not in ("", "None", told):
            told = waits
            say(f"job {job.id} of Slurm waits: {waits}")


class _Tail:
    """The complete lines of a file that grows, each once; the file may not be there yet."""

    def __init__(self, path: Path) -> None:
        self._path, self._at = path, 0

    def lines(self) -> Iterator[bytes]:
        """Those that are new."""
        with suppress(FileNotFoundError), self._path.open("rb") as file:  # NFS asks its server when it is opened
            file.seek(self._at)
            for line in file:
                if line.endswith(b"\n"):
                    self._at += len(line)
                    yield line


def _explained(outcome: Outcome, job: SlurmJob, script: MeshScript) -> Outcome:
    """An outcome with what Slurm says, if something was lost: the job ends at once, and Slurm knows why."""
    error = outcome.error
    if error is None or error.exit_code != MeshLost.exit_code:
        return outcome
    end, never = time.monotonic() + 2 * _REST_S, threading.Event()
    while time.monotonic() < end and ((lines := queued(job, "%T")) is None or not ENDED.issuperset(lines)):
        never.wait(2 * _LOOK_S)
    hint = f"{error.hint} {_said(job, script)}" if error.hint else _said(job, script)
    return replace(outcome, error=replace(error, hint=hint))


_OF_TASKS: Final = re.compile(r"^srun: error: component (\d+): (\S+): tasks? ([\d,-]+): (?!Exited)(.+)$", re.MULTILINE)
_OF_STEPS: Final = re.compile(
    r"^(?:srun|slurmstepd\S*): error: (?!component \d+: \S+: task)(?:component \d+: )?(.+)$", re.MULTILINE
)


def _said(job: SlurmJob, script: MeshScript) -> str:
    """What Slurm says of a job that has ended: of tasks with the names of their nodes, and of the job."""
    log, words = end_of_log(job.log()) or "", []
    for component, host, ranks, reason in _OF_TASKS.findall(log):
        names = dict(enumerate(script.components)).get(int(component), ())
        for first, last in re.findall(r"(\d+)(?:-(\d+))?", ranks):
            tasks = range(int(first), min(int(last or first) + 1, len(names)))
            words += [f"task {rank} (node '{names[rank]}') on {host}: {reason}" for rank in tasks]
    words += dict.fromkeys(_OF_STEPS.findall(log))
    states = [line for line in queued(job, "%T") or () if line not in (COMPLETED, "FAILED")]
    states = [state for state in accounted(job).values() if not state.startswith(COMPLETED)] or states
    words += [f"the job ended as {state}" for state in dict.fromkeys(states)]
    words = words or [f"nothing; the last line of '{job.log()}' is {next(reversed(log.splitlines()), '')!r}"]
    return f"Slurm says: {'; '.join(words)}."


def check_option(option: str, own: Mapping[str, str], whose: str) -> None:
    """Check that an option can be a line of a script of `sbatch`, and is none of its ``own``, by their long form.

    Raises:
        ConfigurationError: it is not.
    """
    if not option.startswith("-") or not option.isprintable():
        hint = "Write it as `sbatch` takes it, such as --slurm-option=--partition=short."
        raise ConfigurationError(f"{option!r} is no option of `sbatch`", hint=hint)
    for long, short in own.items():  # `sbatch` understands the beginning of a long option, too
        if long.startswith(re.split(r"[= ]", option)[0]) or (short and option.startswith(short)):
            raise ConfigurationError(f"'{option}' cannot be given to `sbatch`: {whose} sets {long} itself")


def submitted(script: Path, text: str, *, tasks: int = 1) -> SlurmJob:
    """Write a batch script into its folder, and submit it.

    Raises:
        ConfigurationError: there is no `sbatch`, it refuses the job, or the script cannot be written.
        DeadlineExceeded: `sbatch` has not answered.
    """
    write_whole(script, text.encode(errors="surrogateescape"), "the batch script ")
    try:
        code, printed, errors = _run(["sbatch", "--parsable", script.name], _SUBMIT_S, folder=script.parent)
    except DeadlineExceeded as error:
        raise error.with_hint("`squeue --me` shows whether the job was submitted.") from None
    if code:
        hint = f"The batch script is '{script}'."
        raise ConfigurationError(f"`sbatch` has not submitted the job: {_words(errors)}", hint=hint)
    found = re.findall(r"^(\d+)(?:;(\S+))?$", printed, re.MULTILINE)
    if not found:
        hint = "`squeue --me` shows whether the job was submitted."
        raise ConfigurationError(f"`sbatch` has printed no number of a job, but {printed.strip()!r}", hint=hint)
    return SlurmJob(found[-1][0], script, tasks, found[-1][1] or None)


def queued(job: SlurmJob, form: str) -> list[str] | None:
    """What `squeue` says of the tasks or components of a job, in its format; None if it does not answer.

    It forgets a task some minutes after its end (MinJobAge in slurm.conf), and then the whole job. It takes up to 30 s.
    """
    words = ["--noheader", "--array", "--states=all", f"--format={form}", f"--jobs={job.id}"]
    try:
        code, printed, errors = _run(["squeue", *_on_cluster(job), *words], _ASK_S)
    except FmuMeshError:
        return None
    if code:
        return [] if _is_forgotten(errors) else None
    return [line.strip() for line in printed.splitlines() if line.strip() and not line.startswith("CLUSTER:")]


def accounted(job: SlurmJob) -> dict[int, str]:
    """The states of ended tasks in the accounting database, with exit code and signal; empty where there is none.

    The tasks of an array are counted from 1, as are the components of a job.
    """
    form = ["--noheader", "--allocations", "--parsable2", "--format=JobID,State,ExitCode"]
    try:
        code, printed, _ = _run(["sacct", *_on_cluster(job), *form, f"--jobs={job.id}"], _ASK_S)
    except FmuMeshError:
        return {}
    line = rf"^{job.id}(?:_(\d+)|\+(\d+))?\|([A-Z_]+)[^|]*\|(\d+):(\d+)$"
    states = {}
    for match in re.finditer(line, printed if not code else "", re.MULTILINE):
        task, component, state, exit_code, number = match.groups()
        how = f" by signal {number}" if number != "0" else f" with exit code {exit_code}" if exit_code != "0" else ""
        if state in ENDED:
            states[int(task or 1 + int(component or 0))] = f"{state}{how}"
    return states


def cancel(job: SlurmJob) -> None:
    """Cancel a job, with all its tasks; one that has ended stays as it is.

    Raises:
        ConfigurationError: `scancel` refuses it, or is missing.
        DeadlineExceeded: `scancel` has not answered.
    """
    code, _, errors = _run(["scancel", *_on_cluster(job), job.id], _ASK_S)
    if code and not _is_forgotten(errors):
        raise ConfigurationError(f"`scancel {job.id}` failed: {_words(errors)}")


def end_of_log(log: Path) -> str | None:
    """The end of a log, without white space at its own end; None if it cannot be read."""
    try:
        with log.open("rb") as file:
            file.seek(-min(_TAIL, os.fstat(file.fileno()).st_size), os.SEEK_END)
            return file.read().decode(errors="replace").rstrip()
    except OSError:
        return None


def _is_forgotten(errors: str) -> bool:
    """Whether Slurm says that it does not know a job: it has ended long ago."""
    return "Invalid job id specified" in errors


def _on_cluster(job: SlurmJob) -> list[str]:
    return [f"--clusters={job.cluster}"] if job.cluster else []


def _words(errors: str) -> str:
    """What a program of Slurm has written to standard error, in one line and without its own name."""
    lines = [re.sub(r"^\w+: (error: |fatal: )?", "", line.strip()) for line in errors.splitlines()]
    return "; ".join(filter(None, lines)) or "it gives no reason"


def _run(command: Sequence[str], deadline_s: float, *, folder: Path | None = None) -> tuple[int, str, str]:
    """Run a program of Slurm; returns its exit code, output and errors.

    It is in a process group of its own: Ctrl-C does not reach it, and after the deadline it ends with all that it has
    started, since on some clusters it is a script around the real one.
    """
    environment = {name: value for name, value in os.environ.items() if not name.startswith(_OVERRULING)}
    try:
        child = subprocess.Popen(
            command,
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            process_group=0,
        )
    except OSError as error:
        hint = "Install the programs of Slurm (Debian, Ubuntu: apt install slurm-client), or run this on a login host."
        raise ConfigurationError(f"`{command[0]}` cannot be started: {error.strerror}", hint=hint) from error
    with child:
        try:
            output, errors = child.communicate(timeout=deadline_s)
        except BaseException as error:
            os.killpg(child.pid, signal.SIGKILL)  # `child` was not waited for, so its number is still its own
            if isinstance(error, subprocess.TimeoutExpired):
                raise DeadlineExceeded(f"`{command[0]}` has not answered for {deadline_s:g} s") from None
            raise
    return child.returncode, output, errors
