"""What a person sees during a run: one progress line, log messages above it, and a summary at the end."""

from __future__ import annotations

import ctypes
import os
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn

from ..errors import ErrorReport, FmuMeshError, from_report
from ..launch.events import End, Event, Log, Ready, Status
from ..launch.wiring import is_socket, leaves_host
from ..model.plan import Plan
from ..wire.views import LogLine, MeshStatus

__all__ = ["Display", "say", "stdout_as_stderr", "summary", "warn"]

_SHOWN_TIMES: Final = 5
_WARNINGS: Final = 5
"""How many warnings are told before a run."""
_COUNTED: Final = 1000
"""How many different messages are counted."""
_STYLES = {"ok": "dim", "warning": "yellow", "discard": "yellow", "error": "red", "fatal": "red"}


class Display:
    """Shows events of a run on standard error.

    Args:
        plan: what runs.
        show_progress: whether to draw the bar; never drawn where standard error is no terminal.
    """

    def __init__(self, plan: Plan, *, show_progress: bool) -> None:
        self._plan = plan
        self._console = Console(stderr=True, highlight=False)
        self._progress = Progress(
            TextColumn("[bold]{task.description}"),
            BarColumn(bar_width=None),
            TextColumn("{task.fields[text]}"),
            console=self._console,
            disable=not show_progress or not self._console.is_terminal,
            transient=True,
        )
        self._times: Counter[tuple[str, str]] = Counter()
        total = plan.grid.last_point if plan.grid.stop_time is not None else None
        self._task = self._progress.add_task(plan.system.config.mesh, total=total, text="starting")

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()
        for (instance, message), times in self._times.items():
            if times > _SHOWN_TIMES:
                more = f"{times - _SHOWN_TIMES} more {'times' if times > _SHOWN_TIMES + 1 else 'time'}"
                self._console.print(f"[dim]{escape(instance)}: {escape(message)} ({more})[/]")

    def event(self, event: Event) -> None:
        """Show one event of the master."""
        match event:
            case Ready(endpoints):
                self._ready(endpoints)
            case Status(status):
                self._status(status)
            case Log(line):
                self.log(line)
            case End(ended_by=ErrorReport() as report):
                self.ended(from_report(report))
            case End():
                pass

    def _ready(self, endpoints: Sequence[str]) -> None:
        """Show where the mesh can be reached: where it was asked to listen, or else its socket; and who can."""
        config = self._plan.system.config
        shown = ", ".join([one for one in endpoints if not is_socket(one)] or endpoints)
        if shown:
            self._console.print(escape(f"mesh '{config.mesh}' at {shown}"), soft_wrap=True)
        if config.zenoh.mode == "peer" and (wide := ", ".join(filter(leaves_host, config.zenoh.listen))):
            text = f"warning: whoever can reach this host at {wide} can read, set and end this mesh"
            self._console.print(f"[yellow]{escape(text)}[/]", soft_wrap=True)

    def ended(self, early: FmuMeshError) -> None:
        """Show why a run ended before its last point although nothing failed."""
        self._console.print(escape(str(early)))

    def progress(self, point: int) -> None:
        """Show the point of a run in this process."""
        self._progress.update(self._task, completed=point, text=f"t = {self._plan.grid.time(point):.6g} s")

    def log(self, line: LogLine) -> None:
        """Show one log message of an FMU; the same text is shown a few times, and then only counted."""
        key = line.instance, line.message
        if key in self._times or len(self._times) < _COUNTED:
            self._times[key] += 1
            if self._times[key] > _SHOWN_TIMES:
                return
        style = _STYLES.get(line.status, "dim")
        where = f"{line.instance} at point {line.point}"
        self._console.print(f"[{style}]{escape(where)}: {escape(line.message)}[/]")

    def output(self, name: str, text: str) -> None:
        """Show a line that a process wrote by itself."""
        if text:
            shown = "".join(c if c.isprintable() or c == "\t" else "\N{REPLACEMENT CHARACTER}" for c in text)
            self._console.print(f"[dim]{escape(name)} |[/] {escape(shown)}")

    def _status(self, status: MeshStatus) -> None:
        text: str = status.state
        if status.state in ("running", "paused", "stopping"):
            text = (
                f"t = {status.time:.6g} s  {status.points_per_second:,.0f} points/s  "
                f"real-time factor {status.real_time_factor:.3g}" + ("  paused" if status.state == "paused" else "")
            )
        self._progress.update(self._task, completed=status.point, text=text)


def say(text: str) -> None:
    """Tell what takes its time before a run, on standard error."""
    print(f"fmu-mesh: {text}", file=sys.stderr, flush=True)


def warn(plan: Plan) -> None:
    """Tell on standard error what is odd in a system that is about to run; of many warnings the first ones."""
    for warning in plan.system.warnings[:_WARNINGS]:
        say(f"warning: {warning}")
    if (rest := len(plan.system.warnings) - _WARNINGS) > 0:
        say(f"warning: and {rest} more, which `fmu-mesh check` shows")


@contextmanager
def stdout_as_stderr() -> Iterator[None]:
    """While inside, what an FMU in this process prints goes to standard error: standard output is for results."""
    sys.stdout.flush()
    stdout = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        ctypes.CDLL(None).fflush(None)  # what the FMU printed may still be in the buffer of the C library
        os.dup2(stdout, 1)
        os.close(stdout)


def summary(plan: Plan, *, point: int, seconds: float, rows: int, result_file: str | None) -> list[str]:
    """The closing lines of a run; the last one is `20000 points in 1.234 s: 16207 points/s, real-time factor 32.4`."""
    lines = []
    if result_file is not None:
        lines.append(f"result: {_short(Path(result_file))} ({rows} rows)")
    rate = point / seconds if seconds > 0 else 0.0
    factor = rate * plan.grid.step_size
    lines.append(f"{point} points in {seconds:.3f} s: {rate:.0f} points/s, real-time factor {factor:.3g}")
    return lines


def _short(path: Path) -> str:
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return str(path)
