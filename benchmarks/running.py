"""Running contestants: one at a time, interleaved, each with a deadline, and every result checked."""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

from benchmarks.chatty import CHATTY, build_chatty
from benchmarks.commands import Command, Ended, RunFailed, run_command
from benchmarks.comparing import Reference, compare
from benchmarks.contestants.fmu_mesh_launch import configuration, launch_command
from benchmarks.environment import ROOT, Peers
from benchmarks.first_step import FirstStep, Started
from benchmarks.jobs import Entry, Job
from benchmarks.task import Outcome, System, Task
from benchmarks.windows import why_no_windows

__all__ = ["Bench", "Measured"]

RUN_S = 120.0
"""A run of a contestant that takes longer is ended."""

_LEAST_S = 20.0
_TRIES = 4
"""So often a contestant may fail before its first result: one that crashes now and then is measured."""

_WITH_CLOCK = {"multiplied": "", "summed": " (to a loop with a summed clock)"}


@dataclass
class Measured:
    """What is known of one entry.

    Attributes:
        instances: how many its system has; 1 where it has no system.
        points: communication steps of one run.
        costs: of every run, in s: of a communication step, or of a whole command.
        first_points: of every watched command, the time in s to its first point.
        started: of every watched command, its processes.
        result: how its values compare with the reference.
        failure: why it has none.
        failed: how many of its runs failed; the others count.
    """

    instances: int
    points: int
    costs: list[float] = field(default_factory=list)
    first_points: list[float] = field(default_factory=list)
    started: list[Started] = field(default_factory=list)
    result: str = ""
    failure: str | None = None
    failed: int = 0

    @property
    def cost(self) -> float | None:
        """The median cost in s."""
        return statistics.median(self.costs) if self.costs else None

    @property
    def first_point_s(self) -> float | None:
        """The median time to the first point in s."""
        return statistics.median(self.first_points) if self.first_points else None

    @property
    def node_mb(self) -> float | None:
        """The median private memory of a process with an instance in MB."""
        return statistics.median(started.node_mb for started in self.started) if self.started else None


class Bench:
    """Runs jobs. Use it as a context manager.

    Args:
        jobs: what to run.
        peers: the environment of the others.
        folder: for files.
        quick: whether contestants take fewer points.
        only: part of the module or label of the entries that run.

    Attributes:
        results: by job name, then by entry label.
        versions: of all that ran.
        broken: entries of ours whose values differ or that failed; the benchmark fails with them.
    """

    def __init__(self, jobs: Sequence[Job], peers: Peers, folder: Path, *, quick: bool, only: str = "") -> None:
        self._jobs = jobs
        self._only = only
        self._peers = peers
        self._folder = folder
        self._quick = quick
        self._references: dict[str, Reference] = {}
        self._first_step: FirstStep | None = None
        self._open = ExitStack()
        self.results: dict[str, dict[str, Measured]] = {}
        self.versions: dict[str, str] = {}
        self.broken: list[str] = []
        for job in jobs:
            self.results[job.name] = {entry.label: self._empty(job, entry) for entry in job.entries}

    def __enter__(self) -> Self:
        watched = [job for job in self._jobs if job.watched]
        chatty = [job for job in self._jobs if any(member.fmu == CHATTY for member in job.system.members)]
        try:
            self._first_step = self._open.enter_context(FirstStep()) if watched else None
            if chatty:
                build_chatty()
        except RuntimeError as error:
            for measured in (measured for job in (*watched, *chatty) for measured in self.results[job.name].values()):
                measured.failure = str(error)
        return self

    def __exit__(self, *_error: object) -> None:
        self._open.close()

    def run(self, repeat: int, budget_s: float) -> int:
        """Run every entry ``repeat`` times in turn, or as often as fits into the time; how many rounds it were."""
        started = time.monotonic()
        longest = 0.0
        for number in range(repeat):
            begun = time.monotonic()
            if number and begun - started + longest > budget_s:
                print(f"the time is over after {number} of {repeat} rounds", flush=True)
                return number
            for job in self._jobs:
                # Another one goes first in every round, so that none always follows the same neighbour.
                turn = number % len(job.entries)
                for entry in (*job.entries[turn:], *job.entries[:turn]):
                    if entry.rounds and number >= entry.rounds:
                        continue
                    left = budget_s - (time.monotonic() - started)
                    if left < _LEAST_S:
                        print(f"the time is over within round {number + 1} of {repeat}", flush=True)
                        return number + 1
                    self._measure(job, entry, f"round {number + 1}", min(RUN_S, left))
            longest = max(longest, time.monotonic() - begun)
        return repeat

    def _empty(self, job: Job, entry: Entry) -> Measured:
        system = entry.system or job.system
        points = (entry.quick or entry.points) if self._quick else entry.points
        missing = "not in a quick run" if self._quick and entry.rounds == 1 else self._peers.missing(entry.packages)
        if entry.options.get("windows") == "yes":
            missing = missing or why_no_windows()
        return Measured(max(len(system.members), 1), points, failure=missing)

    def _measure(self, job: Job, entry: Entry, about: str, timeout_s: float) -> None:
        measured = self.results[job.name][entry.label]
        gives_up = measured.failed >= _TRIES and not measured.costs
        missing = measured.failure is not None and not measured.failed
        if missing or gives_up or not any(self._only in name for name in (entry.module, entry.label)):
            return
        print(f"{about}: {job.name}: {entry.label}", flush=True)
        try:
            self._run_once(job, entry, measured, timeout_s)
        except RunFailed as error:
            measured.failure = str(error)
            measured.failed += 1
            self._note(job, entry, str(error))

    def _run_once(self, job: Job, entry: Entry, measured: Measured, timeout_s: float) -> None:
        system = entry.system or job.system
        if not system.members:
            outcome, _ = self._start(job, entry, Task(system, measured.points, entry.options), timeout_s)
        else:
            system = _coupled(system, entry)
            reference = self._reference(system, measured.points, entry.clock)
            options = dict(entry.options)
            result_file = self._folder / "result.csv"
            if entry.is_ours and options.get("record") != "none":
                options["result"] = str(result_file)
            task = Task(system, measured.points, options, reference.initial_inputs)
            outcome, ended = self._start(job, entry, task, timeout_s)
            result = compare(system, reference, outcome, measured.points) + _WITH_CLOCK[entry.clock]
            if not measured.result.startswith("DIFFERS"):
                measured.result = result
            if result.startswith("DIFFERS"):
                self._note(job, entry, result)
            result_file.unlink(missing_ok=True)
            if ended.started is not None and ended.first_point_s is not None:
                measured.first_points.append(ended.first_point_s)
                measured.started.append(ended.started)
        self.versions |= outcome.versions
        measured.costs.append(outcome.seconds / (measured.points if job.timed == "steps" else 1))

    def _note(self, job: Job, entry: Entry, problem: str) -> None:
        """Our own results have to be right; what another checkout does is its own affair."""
        if entry.is_ours and "checkout" not in entry.options:
            self.broken.append(f"{job.name}: {entry.label}: {problem}")

    def _reference(self, system: System, points: int, clock: str) -> Reference:
        """All rows of a system; computed once for the largest number of points."""
        task = Task(system, points, {"clock": clock})
        key = Task(system, 0, {"clock": clock}).to_json()
        known = self._references.get(key)
        if known is None or len(known.rows) <= points:
            file = self._folder / "reference.json"
            run_command(self._contestant("reference", task, str(file)), RUN_S)
            raw = json.loads(file.read_text())
            self._references[key] = known = Reference(raw["rows"], tuple(raw["initial_inputs"]))
        return known

    def _start(self, job: Job, entry: Entry, task: Task, timeout_s: float) -> tuple[Outcome, Ended]:
        """Run a contestant, or the command of ours where whole commands are timed."""
        watched = None
        if job.watched and self._first_step is not None:
            self._first_step.hold()
            watched = (self._first_step, len(task.system.members))
        if entry.is_ours and job.timed == "commands":
            arguments, root = launch_command(configuration(task), task.options, self._folder)
            ended = run_command(Command(arguments, root), timeout_s, watched)
            return Outcome(ended.seconds, result_file=task.options.get("result")), ended
        ended = run_command(self._contestant(entry.module, task, ours=entry.is_ours), timeout_s, watched)
        outcome = _outcome_of(ended)
        return (outcome if job.timed == "steps" else replace(outcome, seconds=ended.seconds)), ended

    def _contestant(self, module: str, task: Task, *arguments: str, ours: bool = False) -> Command:
        """The command of a contestant; the others run in the environment of the peers."""
        file = self._folder / "task.json"
        file.write_text(task.to_json())
        program = ["-m", f"benchmarks.contestants.{module}", str(file), *arguments]
        if ours:
            return Command([sys.executable, *program], ROOT)
        environment = {**self._peers.variables(), "PYTHONPATH": str(ROOT)}
        # proxyfmu leaves its logs where it was started.
        return Command([str(self._peers.python), *program], self._folder, environment)


def _outcome_of(ended: Ended) -> Outcome:
    try:
        return Outcome(**({"seconds": 0.0} | json.loads(ended.output.strip().splitlines()[-1])))
    except (IndexError, ValueError, TypeError):
        raise RunFailed("it printed no result") from None


def _coupled(system: System, entry: Entry) -> System:
    coupling = entry.coupling or system.algorithm
    return System(system.kind, coupling, system.step_size, system.members)
