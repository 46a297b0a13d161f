"""A mesh as a job of Slurm: its batch script, and how the job is followed to its end.

In the script, the first host runs the master, and `srun --multi-prog` starts the nodes, which connect to it. Nodes with
the same `host` are a component of a heterogeneous job, on one machine. Without such hosts, a mesh with a directory for
`--resume` is one `launch` on one host: only that goes on when Slurm queues the job again (ADR 86).
"""

from __future__ import annotations

import os
import re
import shlex
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

from msgspec.structs import replace

from .. import __version__
from ..errors import ConfigurationError, Interrupted, MeshLost
from ..run.events import Event, decode_event
from ..run.outcome import Outcome
from ..run.run_directory import run_file
from ..run.run_plan import RunPlan
from .processes import MeshProcess, identity_folder, processes_of
from .slurm import COMPLETED, ENDED, SlurmJob, accounted, check_option, end_of_log, log_option, queued

__all__ = ["MeshScript", "batch_script", "followed"]

_LOOK_S, _POLL_S = 1.0, 10.0
"""Time in s between two questions: the controller serves all users."""
_SILENCE_S: Final = 600.0
"""How long Slurm may leave questions without an answer, in s."""
_REST_S: Final = 60
"""How long the other tasks may go on when one has ended, in s."""
_EVENTS: Final = "events.jsonl"
_MAY_GO_ON: Final = (MeshLost.exit_code, Interrupted.exit_code)
"""With these, the job says whether the run has ended: Slurm may have ended all processes, to queue it again."""

_OWN_OPTIONS: Final = {"--chdir": "-D", "--error": "-e", "--ntasks": "-n", "--output": "-o", "--wait": "-W"}
"""Options of `sbatch` that belong to the job of a mesh, with their short form."""


class MeshScript(NamedTuple):
    """The batch script of a mesh.

    Attributes:
        text: all of it.
        components: the names of the processes of each component of the job, in the order of their tasks.
    """

    text: str
    components: tuple[tuple[str, ...], ...]


def batch_script(
    run: RunPlan,
    options: Sequence[str | Path],
    slurm_options: Sequence[str] = (),
    *,
    folder: Path | None = None,
    resume: bool = False,
) -> MeshScript:
    """Write the batch script of a mesh; a job ends with the exit code of the master, or of `launch`.

    Args:
        run: the plan.
        options: those of the command line with which it was made; all processes get them.
        slurm_options: more options of `sbatch`, such as ``--partition=short``, for each component of the job.
        folder: an existing folder that all hosts share, for the log, and for the events of the run, which
            `followed` reads; None: there are no events, and the log is where `sbatch` puts it.
        resume: whether the job begins with the run that `recovery.directory` has.

    Raises:
        ConfigurationError: the mesh cannot be started in parts, or keeps nothing to resume; or an option is none.
    """
    for option in slurm_options:
        check_option(option, _OWN_OPTIONS, "the job of a mesh")
    resumes = run.loaded.config.recovery.directory is not None and not run.plan.hosts
    if resume and not resumes:
        text = f"the job of mesh '{run.mesh}' cannot be resumed: it keeps nothing"
        raise ConfigurationError(text, hint="`recovery: {directory: DIR}` keeps what this needs.")
    address, security = None if resumes else "$address", partial(identity_folder, run.loaded)
    first, *others = processes_of(run, options, address=address, port="$port", security=security)
    groups: dict[str | None, list[MeshProcess]] = {None: []}
    for process in others:
        groups.setdefault(process.host, []).append(process)
    settings = [f"--job-name={shlex.quote(run.mesh)}"]
    settings += ["--requeue", "--open-mode=append"] if resumes else ["--no-requeue"]
    settings += [log_option(folder, "1")] if folder is not None else []
    starts: list[str] = []
    for number, (host, members) in enumerate(groups.items()):
        limits, tasks = [process.memory for process in members], len(members) + (host is None)  # one for the master
        settings += ["hetjob"] if number else []
        settings += [f"--ntasks={1 if resumes else tasks}", f"--cpus-per-task={tasks if resumes else 1}"]
        settings += ["--nodes=1"] if host is not None else []
        settings += [f"--mem-per-cpu={-(-max(filter(None, limits)) >> 20)}M"] if limits and all(limits) else []
        settings += slurm_options
        if members and not resumes:
            starts += _step(number, f" --het-group={number}" if len(groups) > 1 else "", members)
    events = ("--events", str(folder / _EVENTS)) if folder is not None else ()
    text = (_HEAD + (_RESUMING if resumes else _SCRIPT)).format(
        version=__version__,
        mesh=run.mesh,
        settings="\n".join(f"#SBATCH {setting}" for setting in settings),
        folder=shlex.quote(os.getcwd()),  # noqa: PTH109  where `launch` would run
        python=shlex.quote(sys.executable),
        first=_command(first, shlex.quote, *events),
        starts="\n".join(starts),
        resume="--resume" if resume else "",
        kept=shlex.quote(str(run_file(run.loaded))),
    )
    return MeshScript(text, tuple(tuple(process.name for process in members) for members in groups.values()))


_HEAD: Final = """\
#!/bin/sh
{settings}
# Mesh '{mesh}', written by fmu-mesh {version}. The exit code is that of the run.
cd {folder} || exit 2
"""
_RESUMING: Final = """\
resume={resume}
if [ -n "$SLURM_RESTART_COUNT" ]; then resume=$([ ! -e {kept} ] || echo --resume); fi
exec {first} $resume
"""
"""`exec`: Slurm ends all processes of a job by the same signal, and another one from a shell would not let them end."""
_SCRIPT: Final = """\
address=$(hostname)
port=$({python} -c 'import socket; print(socket.create_server(("", 0)).getsockname()[1])') || exit 2
tasks=$(mktemp -d) || exit 2
trap 'rm -r "$tasks"' EXIT
{first} &
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
        show: gets each event; of outcomes that of the job alone, which Slurm may queue again.
        say: gets why the job waits.

    Returns:
        The outcome; of an error that says that something was lost, its hint has what Slurm says.

    Raises:
        MeshLost: the job has ended without an outcome, or Slurm does not answer.
    """
    never, events, over = threading.Event(), _Tail(job.script.with_name(_EVENTS)), False
    answered, asked, told, ended = time.monotonic(), 0.0, "", 0.0
    lost: Outcome | None = None  # that of the job, unless Slurm queues it again
    while True:
        for line in events.lines():
            event = decode_event(line)
            if isinstance(event, Outcome) and event.error is not None and event.error.exit_code in _MAY_GO_ON:
                lost, ended = event, time.monotonic()
                continue
            lost = None
            show(event)
            if isinstance(event, Outcome):
                return event
        if over and lost is not None:
            show(lost := _explained(lost, job, script))
            return lost
        if over:
            text = f"job {job.id} of Slurm has ended, and its master has not told how"
            raise MeshLost(text, hint=_said(job, script))
        never.wait(_LOOK_S)
        now = time.monotonic()
        if now - asked < (_POLL_S if lost is None else 2 * _LOOK_S):
            continue
        asked, lines = now, queued(job, "%T|%r")
        answered = now if lines is not None else answered
        if now - answered > _SILENCE_S:
            raise MeshLost(f"Slurm has not told the state of job {job.id} for {_SILENCE_S:g} s")
        waits = next((line for line in lines or () if line.startswith("PENDING|")), "").partition("|")[2]
        lost = None if waits else lost
        over = lines is not None and all(line.partition("|")[0] in ENDED for line in lines)
        over |= lost is not None and now - ended > 2 * _REST_S
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
    """An outcome with what Slurm says, if something was lost: the job has ended, and Slurm knows why."""
    error = outcome.error
    if error is None or error.exit_code != MeshLost.exit_code:
        return outcome
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
