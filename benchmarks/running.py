"""Running contestants: one process at a time, interleaved, each with a deadline, and every result checked."""

from __future__ import annotations

import csv
import json
import os
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.environment import ROOT, Peers
from benchmarks.jobs import OURS, Entry, Job
from benchmarks.task import Outcome, System, Task

__all__ = ["Bench", "Measured"]

RUN_S = 120.0
"""A run of a contestant that takes longer is ended."""

_LEAST_S = 20.0


_WITH_CLOCK = {"multiplied": "", "summed": " (to a loop with a summed clock)"}


class RunFailed(Exception):
    """A contestant did not get to its end; the message is why."""


@dataclass
class Measured:
    """What is known of one entry.

    Attributes:
        costs: of every run, in s per point and instance.
        points: communication steps of one run.
        result: how its values compare with the reference.
        failure: why it has none.
    """

    entry: Entry
    instances: int
    points: int
    costs: list[float] = field(default_factory=list)
    result: str = ""
    failure: str | None = None

    @property
    def cost(self) -> float | None:
        """Median cost in s per point and instance."""
        return statistics.median(self.costs) if self.costs else None


@dataclass(frozen=True)
class _Reference:
    rows: list[list[float]]
    initial_inputs: tuple[float | None, ...]


class Bench:
    """Runs jobs.

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
        self._references: dict[str, _Reference] = {}
        self.results: dict[str, dict[str, Measured]] = {}
        self.versions: dict[str, str] = {}
        self.broken: list[str] = []
        for job in jobs:
            self.results[job.name] = {entry.label: self._empty(job, entry) for entry in job.entries}

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
                    left = budget_s - (time.monotonic() - started)
                    if left < _LEAST_S:
                        print(f"the time is over within round {number + 1} of {repeat}", flush=True)
                        return number + 1
                    self._measure(job, entry, f"round {number + 1}", min(RUN_S, left))
            longest = max(longest, time.monotonic() - begun)
        return repeat

    def _empty(self, job: Job, entry: Entry) -> Measured:
        system = entry.system or job.system
        measured = Measured(
            entry, len(system.members) if system is not None else 1, entry.quick if self._quick else entry.points
        )
        measured.failure = self._peers.missing(entry.packages)
        return measured

    def _measure(self, job: Job, entry: Entry, about: str, timeout_s: float) -> None:
        measured = self.results[job.name][entry.label]
        if measured.failure is not None or not any(self._only in name for name in (entry.module, entry.label)):
            return
        print(f"{about}: {job.name}: {entry.label}", flush=True)
        try:
            self._run_once(job, entry, measured, timeout_s)
        except RunFailed as error:
            measured.failure = str(error)
            if entry.module == OURS:
                self.broken.append(f"{job.name}: {entry.label}: {error}")

    def _run_once(self, job: Job, entry: Entry, measured: Measured, timeout_s: float) -> None:
        system = entry.system or job.system
        if system is None:
            some = System("chain", "jacobi", 1.0, ())
            outcome = self._start(entry.module, Task(some, measured.points, entry.options), timeout_s)
        else:
            system = _coupled(system, entry)
            reference = self._reference(system, measured.points, entry.clock)
            options = dict(entry.options)
            result_file = self._folder / "result.csv"
            if entry.module == OURS and options.get("record") != "none":
                options["result"] = str(result_file)
            task = Task(system, measured.points, options, reference.initial_inputs)
            outcome = self._start(entry.module, task, timeout_s)
            self._check(job, measured, _compare(system, reference, outcome, measured.points) + _WITH_CLOCK[entry.clock])
            result_file.unlink(missing_ok=True)
        self.versions |= outcome.versions
        measured.costs.append(outcome.seconds / (measured.points * measured.instances))

    def _check(self, job: Job, measured: Measured, result: str) -> None:
        if not measured.result.startswith("DIFFERS"):
            measured.result = result
        if result.startswith("DIFFERS") and measured.entry.module == OURS:
            self.broken.append(f"{job.name}: {measured.entry.label}: {result}")

    def _reference(self, system: System, points: int, clock: str) -> _Reference:
        """All rows of a system; computed once for the largest number of points."""
        task = Task(system, points, {"clock": clock})
        key = Task(system, 0, {"clock": clock}).to_json()
        known = self._references.get(key)
        if known is None or len(known.rows) <= points:
            file = self._folder / "reference.json"
            self._start("reference", task, RUN_S, str(file))
            raw = json.loads(file.read_text())
            self._references[key] = known = _Reference(raw["rows"], tuple(raw["initial_inputs"]))
        return known

    def _start(self, module: str, task: Task, timeout_s: float, *arguments: str) -> Outcome:
        """Run a contestant's process to its end; it and all that it started are ended at the deadline."""
        file = self._folder / "task.json"
        file.write_text(task.to_json())
        python = sys.executable if module == OURS else str(self._peers.python)
        command = [python, "-m", f"benchmarks.contestants.{module}", str(file), *arguments]
        environment = None if module == OURS else {**self._peers.variables(), "PYTHONPATH": str(ROOT)}
        with subprocess.Popen(
            command,
            cwd=ROOT if module == OURS else self._folder,  # proxyfmu leaves its logs where it was started
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        ) as process:
            try:
                output, errors = process.communicate(timeout=max(timeout_s, 1.0))
            except subprocess.TimeoutExpired:
                raise RunFailed(f"not done within {timeout_s:.0f} s") from None
            finally:
                _end_group(process)
        if process.returncode:
            raise RunFailed(_reason(errors, process.returncode))
        try:
            return Outcome(**({"seconds": 0.0} | json.loads(output.strip().splitlines()[-1])))
        except (IndexError, ValueError, TypeError):
            raise RunFailed("it printed no result") from None


def _end_group(process: subprocess.Popen[str]) -> None:
    """Whatever of a contestant is left: the group is its own, so nobody else is in it."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        return


def _coupled(system: System, entry: Entry) -> System:
    coupling = entry.coupling or system.algorithm
    return System(system.kind, coupling, system.step_size, system.members)


def _compare(system: System, reference: _Reference, outcome: Outcome, points: int) -> str:
    """In words how an outcome compares with the reference, with ``==`` on every float."""
    names = [member.column for member in system.members]
    if outcome.result_file is not None:
        return _compare_file(names, reference, Path(outcome.result_file), system.step_size, points)
    if not outcome.last:
        return "nothing to see"
    for name, expected in zip(names, reference.rows[points], strict=True):
        if outcome.last[name] != expected:
            return f"DIFFERS: {name} is {outcome.last[name]!r} at the end, not {expected!r}"
    return "last values equal"


def _compare_file(names: list[str], reference: _Reference, file: Path, step_size: float, points: int) -> str:
    with file.open(newline="") as lines:
        rows = csv.reader(lines)
        header = next(rows)
        columns = [header.index(name) for name in names]
        count = 0
        for point, row in enumerate(rows):
            count += 1
            if point > points or float(row[0]) != point * step_size:
                return f"DIFFERS: row {point} has time {row[0]}"
            for name, column, expected in zip(names, columns, reference.rows[point], strict=True):
                if float(row[column]) != expected:
                    return f"DIFFERS: {name} is {row[column]} at point {point}, not {expected!r}"
    return "all points equal" if count == points + 1 else f"DIFFERS: {count} rows, not {points + 1}"


def _reason(errors: str, code: int) -> str:
    lines = [line.strip() for line in errors.splitlines() if line.strip()]
    text = lines[-1] if lines else f"exit code {code}"
    return text.replace(str(ROOT), ".").replace(str(Path.home()), "~")[:200]
