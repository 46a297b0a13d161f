"""Runs of a mesh whose processes are killed, stopped and delayed while they run, and what becomes of their results.

The seed of a run decides the kind and the role of each fault, the row after which it comes, and how long it lasts. What
comes after a row is found by reading the growth of the result file. Every wait has a deadline, and nothing of a run is
left at its end, whatever happens.
"""

from __future__ import annotations

import random
import signal
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import psutil

import fmu_mesh
from benchmarks.chaos_meshes import Mesh
from benchmarks.kept_rows import Differences, GrowingFile, differences, first_difference, other_values
from tests.helpers import Launched, Place

__all__ = [
    "EVERYBODY",
    "FAULTS",
    "GATEWAY",
    "RESUME",
    "ROLES",
    "RUN_S",
    "Disturbed",
    "Fault",
    "Given",
    "Run",
    "Undisturbed",
    "disturbed",
    "drawn_faults",
    "factor",
    "recovering",
    "undisturbed",
]

FAULTS: Final = ("kill", "stop", "delay")
"""What is done to a process."""

RESUME: Final = "resume"
"""The kind of a fault that kills `launch`, with all others or alone; then `launch --resume` goes on."""

ROLES: Final = ("node", "master", "fork")
"""Of processes that each run has; `fork` is the fork server."""

GATEWAY: Final = "gateway"
"""The role of the process that a mesh with the section `ros` has besides."""

EVERYBODY: Final = "all"
"""All processes of a run at once, but `launch` itself."""

_LAUNCH: Final = "launch"
"""`launch` alone: the others end by themselves."""

MOST_RESTARTS: Final = 50
"""More than one run needs; a mesh that is lost again and again meets its deadline first."""

RUN_S: Final = 120.0
"""Of a run with its faults, besides what an undisturbed one takes."""

_LATER_S: Final = 0.25
"""A fault comes up to so much after its row: the recorder writes every 0.2 s, and faults come between writes, too."""

_STOPPED_S: Final = (0.05, 1.0)
_DELAYED_S: Final = (0.2, 1.0)
_PART_S: Final = 0.01
"""A process that is delayed stands and runs in turn, for so long each."""

_LOOK_S: Final = 0.002
_LEFT_S: Final = 5.0
"""So long after the end of `launch` something of its run may still be there: what was killed with its parent."""

_KEPT: Final = "kept"
"""The directory of `recovery`, in the folder of a run."""

_AGAIN: Final = 3
"""At most so often a run is killed again before it has come back."""


@dataclass(frozen=True)
class Fault:
    """What is done to a process.

    Attributes:
        kind: one of `FAULTS`, or `RESUME`.
        role: one of `ROLES`; of `RESUME`, who is killed with `launch`.
        which: which process of this role, from 0 to 1.
        after: the part of all rows that the file has before; less than 0: at the start, before the first one.
        later_s: how much later, in s.
        lasts_s: of a stop or a delay, in s.
        again: the faults of kind `kill` that follow while the run comes back; for these only ``role``, ``which`` and
            ``later_s`` count.
    """

    kind: str
    role: str
    which: float
    after: float = 0.0
    later_s: float = 0.0
    lasts_s: float = 0.0
    again: Sequence[Fault] = ()


@dataclass(frozen=True)
class Given:
    """A fault that a process has got.

    Attributes:
        label: its kind and role.
        row: rows in the file before it.
        next_row_s: from it, or from the end of a stop or a delay, to the next new row; None if there was none to come.
    """

    label: str
    row: int
    next_row_s: float | None


@dataclass
class Disturbed:
    """One run with faults.

    Attributes:
        mesh: its name.
        number: of the run; with the seed, it decides the faults.
        options: of `launch`.
        first_row_s: from the command to the first row.
        given: its faults.
        problem: why the result is not that of the undisturbed run, or what was left; empty if all is well.
        found: of its result.
    """

    mesh: str
    number: int
    options: Sequence[str]
    first_row_s: float = 0.0
    given: list[Given] = field(default_factory=list)
    problem: str = ""
    found: Differences = field(default_factory=Differences)


@dataclass(frozen=True)
class Undisturbed:
    """A run without faults.

    Attributes:
        content: of its result.
        first_row_s: from the command to its first row.
        seconds: from the command to its end.
        others: the values of its other results, by the name of a file and of a variable.
    """

    content: bytes
    first_row_s: float
    seconds: float
    others: Mapping[str, Mapping[str, bytes]]

    @property
    def rows(self) -> int:
        """How many there are."""
        return self.content.count(b"\n") - 1

    @property
    def time_span_s(self) -> float:
        """Simulation time from the first to the last row."""
        _, first, *others = self.content.splitlines()
        return float((others or [first])[-1].split(b",")[0]) - float(first.split(b",")[0])


def drawn_faults(
    chance: random.Random, count: int, kinds: Sequence[str], roles: Sequence[str], while_coming_back: float = 0.0
) -> list[Fault]:
    """Faults of one run, in the order of their rows.

    Args:
        chance: what decides.
        count: of the faults, without those that follow a kill.
        kinds: some of `FAULTS`, and `RESUME`.
        roles: some of `ROLES`.
        while_coming_back: the probability that a kill is followed by another one, and that one again.
    """
    faults = []
    for after in sorted(chance.uniform(-0.05, 1.0) for _ in range(count)):
        kind, role = chance.choice(kinds), chance.choice(roles)
        role = chance.choice((EVERYBODY, _LAUNCH)) if kind == RESUME else role
        lasts_s = chance.uniform(*(_STOPPED_S if kind == "stop" else _DELAYED_S))
        again = []
        while kind == "kill" and len(again) < _AGAIN and chance.random() < while_coming_back:
            again.append(
                Fault("kill", chance.choice(roles), chance.random(), later_s=chance.uniform(0.0, 2 * _LATER_S))
            )
        faults.append(Fault(kind, role, chance.random(), after, chance.uniform(0.0, _LATER_S), lasts_s, again))
    return faults


def undisturbed(mesh: Mesh, options: Sequence[str]) -> Undisturbed:
    """Run a mesh once, as fast as possible, and return what it gives.

    Raises:
        RuntimeError: it failed.
    """
    with Place() as place:
        run = _started(place, mesh, [*options, "--real-time-factor", "0"], 10 * RUN_S)
        run.wait(lambda: run.file.rows > 0, "the first row")
        first_row_s = time.monotonic() - run.begun
        if run.launched.wait(10 * RUN_S):
            raise RuntimeError(run.launched.story())
        seconds = time.monotonic() - run.begun
        return Undisturbed(run.file.path.read_bytes(), first_row_s, seconds, _values(mesh))


def disturbed(  # noqa: PLR0913, PLR0917  one run and its faults
    mesh: Mesh,
    options: Sequence[str],
    expected: Undisturbed,
    faults: Sequence[Fault],
    number: int,
    checkpoint_s: float | None = None,
) -> Disturbed:
    """Run a mesh with faults, until it has ended; it begins again as `recovering` says."""
    told = Disturbed(mesh.name, number, options, expected.first_row_s)
    own = [*options, "--real-time-factor", str(factor(mesh, expected)), *recovering(MOST_RESTARTS, checkpoint_s)]
    with Place() as place:
        if any(fault.kind == RESUME for fault in faults):
            own += ["--set-config", f"recovery.directory={place.folder / _KEPT}"]
        run = _started(place, mesh, own, RUN_S + expected.seconds + mesh.lasts_s)
        try:
            for fault in faults:
                run.give(fault, expected.rows, told)
            code = run.launched.wait(run.left_s)
        except AssertionError as error:
            told.problem = f"{error}\n{place.story()}"
            return told
        run.judge(code, expected.content, told)
        if not told.problem:
            told.problem = ". ".join(other_values(expected.others, _values(mesh)))
        if not told.problem:
            with suppress(AssertionError):
                run.wait(lambda: not place.left(), "an empty place", _LEFT_S)
            told.problem = "\n".join(f"left: {one}" for one in place.left())
    return told


def recovering(most: int, checkpoint_s: float | None) -> list[str]:
    """Options of `launch`: it starts again so often at ``most``, from checkpoints, or None: from its first point."""
    if checkpoint_s is None:
        return ["--restarts", str(most)]
    values = {"mode": "restart", "max_restarts": most, "checkpoint_s": checkpoint_s}
    return [part for key, value in values.items() for part in ("--set-config", f"recovery.{key}={value}")]


def factor(mesh: Mesh, expected: Undisturbed) -> float:
    """The real-time factor of a mesh whose runs last as long as they should; 0: as fast as possible."""
    return expected.time_span_s / mesh.lasts_s if mesh.lasts_s else 0.0


def _started(place: Place, mesh: Mesh, options: Sequence[str], most_s: float) -> Run:
    for name in mesh.files:  # of the run before
        mesh.config.with_name(name).unlink(missing_ok=True)
    file = mesh.config.with_name(mesh.files[0]) if mesh.files else place.folder / "result.csv"
    output = [] if mesh.files else ["--output", str(file)]
    command: list[str | Path] = ["launch", mesh.config, "--no-progress", *output, *options]

    def again() -> Launched:
        """Where there is nothing to resume, it was killed before its beginning, or after its end."""
        return place.start(*command, *(["--resume"] if (place.folder / _KEPT / "run").exists() else []))

    return Run(place.start(*command), GrowingFile(file), most_s, again)


def _values(mesh: Mesh) -> dict[str, dict[str, bytes]]:
    """All values of the results that are no CSV files."""
    results = {name: fmu_mesh.Result.read(mesh.config.with_name(name)) for name in mesh.files[1:]}
    return {
        name: {"time": result.times.tobytes(), **{own: result[own].tobytes() for own in result}}
        for name, result in results.items()
    }


class Run:
    """A run that has just been started, and what is done to it.

    Args:
        launched: its command, or that of its master.
        file: its result.
        most_s: its deadline.
        again: starts the command again, after all was killed.

    Attributes:
        launched: as above, the newest.
        file: as above.
        begun: when it was started.
    """

    def __init__(
        self, launched: Launched, file: GrowingFile, most_s: float, again: Callable[[], Launched] | None = None
    ) -> None:
        self.launched, self._again = launched, again
        self.file = file
        self.begun = time.monotonic()
        self._end = self.begun + most_s
        self._never = threading.Event()

    @property
    def left_s(self) -> float:
        """The time until its deadline."""
        return max(self._end - time.monotonic(), 0.1)

    def wait(self, condition: Callable[[], object], what: str, most_s: float | None = None) -> None:
        """Wait for a condition, or for the end of the run; an `AssertionError` if neither comes in time."""
        end = self._end if most_s is None else time.monotonic() + most_s
        while not condition() and (self.launched.running or most_s is not None):
            assert time.monotonic() < end, f"not in time: {what}"
            self._never.wait(_LOOK_S)

    def reach(self, fault: Fault, rows: int, told: Disturbed) -> None:
        """Wait for the moment of a fault in a result of so many rows."""
        if not told.given and fault.after > 0:
            self.wait(lambda: self.file.rows > 0, "the first row")
            told.first_row_s = time.monotonic() - self.begun
        wanted = max(0, int(fault.after * rows))
        self.wait(lambda: self.file.rows >= wanted, f"row {wanted}")
        self.let_pass(fault.later_s)

    def give(self, fault: Fault, rows: int, told: Disturbed) -> None:
        """Give a fault, and wait for the next new row; nothing is done if the run ends before."""
        self.reach(fault, rows, told)
        victims = self._found(fault, ())
        if not victims:
            return
        label, row = f"{fault.kind} {fault.role}", self.file.recounted()
        match fault.kind:
            case "kill":
                self._kill(victims, fault, label, row, told)
            case "resume":
                self._resume(victims if fault.role == EVERYBODY else (), label, row, told)
            case "stop":
                _signal(victims, signal.SIGSTOP)
                self.let_pass(fault.lasts_s)
                _signal(victims, signal.SIGCONT)
                told.given.append(self.next_row(label, row, self.file.recounted()))
            case _:
                end = time.monotonic() + fault.lasts_s
                while time.monotonic() < end and self.launched.running:
                    for number in (signal.SIGSTOP, signal.SIGCONT):
                        _signal(victims, number)
                        self._never.wait(_PART_S)
                told.given.append(self.next_row(label, row, self.file.recounted()))

    def judge(self, code: int, expected: bytes, told: Disturbed) -> None:
        """Compare the result of a run that has ended with this exit code."""
        found = self.file.path.read_bytes() if self.file.path.exists() else b""
        told.found = differences(expected, found)
        if code:
            told.problem = self.launched.story()
        elif told.found.other:
            told.problem = first_difference(expected, found)

    def _kill(self, victims: Sequence[psutil.Process], fault: Fault, label: str, row: int, told: Disturbed) -> None:
        """Kill processes, and others while the run comes back."""
        again = list(fault.again)
        while True:
            attempt = self._processes()
            begun = time.monotonic()
            _signal(victims, signal.SIGKILL)
            masters = [process for process, words in attempt if words[:1] == ["master"]]
            self.wait(lambda: not any(map(_is_there, masters)), "the end of the master")  # noqa: B023  called here
            kept = self.file.recounted()
            if not again:
                told.given.append(self.next_row(label, row, kept, begun))
                return
            told.given.append(Given(label, row, None))
            old = [process.pid for process, _ in attempt]
            fault, row = again.pop(0), kept
            self.let_pass(fault.later_s)
            victims = self._found(fault, old, kept)
            if not victims:
                return
            label = f"kill {fault.role}, {'coming back' if self.file.rows <= kept else 'again'}"

    def _resume(self, victims: Sequence[psutil.Process], label: str, row: int, told: Disturbed) -> None:
        """Kill `launch` with these processes, and start it again: it waits for the others."""
        assert self._again is not None
        begun = time.monotonic()
        self.launched.signal(signal.SIGKILL)
        _signal(victims, signal.SIGKILL)
        self.launched.close()
        self.wait(lambda: not any(map(_is_there, victims)), "the end of all processes", _LEFT_S)
        kept = self.file.recounted()
        self.launched = self._again()
        told.given.append(self.next_row(label, row, kept, begun))

    def next_row(self, label: str, row: int, kept: int, begun: float | None = None) -> Given:
        """A fault given at ``row``, after the first row beyond ``kept``; its time begins at ``begun``, or now."""
        begun = begun or time.monotonic()
        self.wait(lambda: self.file.rows > kept, "a new row")
        came = self.file.rows > kept
        return Given(label, row, time.monotonic() - begun if came else None)

    def let_pass(self, seconds: float) -> None:
        """Let time pass, as long as the run goes on."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and self.launched.running:
            self._never.wait(_LOOK_S)

    def _found(self, fault: Fault, old: Sequence[int], kept: int | None = None) -> list[psutil.Process]:
        """Those that get a fault, as soon as they are there; nobody if the run has ended, or goes on again."""
        there: list[psutil.Process] = []
        any_role = fault.role in {EVERYBODY, _LAUNCH}

        def look() -> bool:
            there[:] = [
                one
                for one, words in self._processes()
                if one.pid not in old and (any_role or words[:1] == [fault.role])
            ]
            return bool(there) or (kept is not None and self.file.rows > kept)

        self.wait(look, f"a process of the role {fault.role}")
        return there if any_role else there[int(fault.which * len(there)) :][:1]

    def _processes(self) -> list[tuple[psutil.Process, list[str]]]:
        """Those that it has started, with the words of their titles, in the order of these."""
        found = []
        with suppress(psutil.NoSuchProcess):
            for process in psutil.Process(self.launched.pid).children(recursive=True):
                with suppress(psutil.Error):
                    words = " ".join(process.cmdline()).split()
                    if words[:1] == ["fmu-mesh"] and _is_there(process):
                        found.append((process, words[1:]))
        return sorted(found, key=lambda one: one[1])


def _signal(processes: Sequence[psutil.Process], number: signal.Signals) -> None:
    for process in processes:
        with suppress(psutil.NoSuchProcess):
            process.send_signal(number)


def _is_there(process: psutil.Process) -> bool:
    with suppress(psutil.NoSuchProcess):
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    return False
