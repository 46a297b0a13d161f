"""Running a command to its end: in a session of its own, with a deadline, and nothing of it is left."""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.environment import ROOT
from benchmarks.first_step import FirstStep, Started

__all__ = ["Command", "Ended", "RunFailed", "run_command"]


class RunFailed(RuntimeError):
    """A contestant did not get to its end; the message is why."""


@dataclass(frozen=True)
class Command:
    """A program with its arguments, and where it runs; without an environment it has ours."""

    arguments: Sequence[str]
    folder: Path
    environment: Mapping[str, str] | None = None


@dataclass(frozen=True)
class Ended:
    """A command that has ended well.

    Attributes:
        output: what it wrote to its standard output.
        seconds: time from its start to its end, without the time in which it was stopped to be looked at.
        first_point_s: time from its start to the first step of its last instance, where that was watched.
        started: the processes that it had then.
    """

    output: str
    seconds: float
    first_point_s: float | None = None
    started: Started | None = None


def run_command(command: Command, timeout_s: float, watched: tuple[FirstStep, int] | None = None) -> Ended:
    """Run a command; it and all that it started are ended at the deadline.

    Args:
        command: the command.
        timeout_s: the deadline, from now.
        watched: if its first steps are watched: by whom, and how many instances it has.

    Raises:
        RunFailed: it was not done in time, its exit code is not 0, or its first steps were not seen.
    """
    deadline = time.monotonic() + max(timeout_s, 1.0)
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        begin = time.monotonic_ns()
        with subprocess.Popen(
            command.arguments,
            cwd=command.folder,
            env=command.environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=errors,
            start_new_session=True,
        ) as process:
            try:
                started = watched[0].watch(process, watched[1], deadline) if watched is not None else None
                process.wait(max(deadline - time.monotonic(), 0.1))
                end = time.monotonic_ns()
            except subprocess.TimeoutExpired:
                raise RunFailed(f"not done within {timeout_s:.0f} s") from None
            finally:
                _end_group(process)
        errors.seek(0)
        output.seek(0)
        if process.returncode:
            raise RunFailed(_reason(errors.read().decode(errors="replace"), process.returncode))
        text = output.read().decode(errors="replace")
    if started is None:
        if watched is not None:
            raise RunFailed("its first steps were not seen")
        return Ended(text, 1e-9 * (end - begin))
    return Ended(text, 1e-9 * (end - begin - started.held_ns), 1e-9 * (started.first_point_ns - begin), started)


def _end_group(process: subprocess.Popen[bytes]) -> None:
    """Whatever of a command is left: the group is its own, so nobody else is in it."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        return


def _reason(errors: str, code: int) -> str:
    lines = [line.strip() for line in errors.splitlines() if line.strip()]
    text = lines[-1] if lines else f"exit code {code}"
    return text.replace(str(ROOT), ".").replace(str(Path.home()), "~")[:200]
