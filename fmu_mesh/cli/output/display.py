"""The output of a run for a person: log messages, one progress line below them, and a summary at the end."""

from __future__ import annotations

import socket
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cached_property, partial
from typing import TYPE_CHECKING, Final, Self

from ...api.result import summary_of
from ...config.access_sections import is_socket
from ...config.deploy_section import HostConfig
from ...errors import from_report
from ...pictures.plan_page import slower_than_it_could_be
from ...pictures.tables import DEFECT_COLUMNS, defect_rows, table
from ...printing import paragraph, printable
from ...run.events import Event, Log, OutputLine, Reachable, Restarted, Status, WasReset
from ...run.outcome import Outcome
from ...system.placement import manual_hosts
from ...system.plan import Plan
from ...text import short_path
from ...wire.views import LogLine, MeshStatus
from .progress import ProgressLine, progress_parts
from .terminal import error_console, say, say_warning

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["Display", "summary", "warn"]

_SHOWN_TIMES: Final = 5
_WARNINGS: Final = 5
"""Number of warnings that are shown before a run."""
_COUNTED: Final = 1000
"""Number of different messages that are counted."""
_HELD: Final = 100
"""Number of messages that are held back because their FMU may fail next."""
_ERRORS: Final = ("error", "fatal")
_STYLES = {"ok": "dim", "warning": "yellow", "discard": "yellow", "error": "red", "fatal": "red"}


class Display:
    """Shows the events of a run on standard error; if it is quiet, only errors, and what processes of the run write.

    ``waits_for_nodes`` shows the address only when all instances answer: nodes that are started manually need it
    earlier. Where persons start the nodes of other hosts, it shows with which commands, and who is missing; ``file`` is
    the configuration in these.
    """

    def __init__(
        self,
        plan: Plan,
        *,
        show_progress: bool,
        quiet: bool = False,
        waits_for_nodes: bool = True,
        file: str = "CONFIG",
    ) -> None:
        self._plan = plan
        self._quiet = quiet
        last = plan.grid.last_point if plan.grid.stop_time is not None else None
        console = (lambda: self._console) if show_progress and not quiet else None
        self._progress = ProgressLine(
            plan.system.config.mesh, last, partial(progress_parts, plan.grid), console, self._missing
        )
        self._waits_for_nodes = waits_for_nodes
        self._file, self._hosts = file, manual_hosts(plan)
        self._waiting: dict[str, list[str]] = {}
        self._times: Counter[tuple[str, str]] = Counter()
        self._held: deque[LogLine] = deque()
        self._over = False
        self._endpoints: Sequence[str] = ()

    @cached_property
    def _console(self) -> Console:
        return error_console()  # needed when the processes of a run have started

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        self._progress.stop()
        self._over = True  # what an FMU of this process says now is said in its last functions
        self.flush(str(error or ""))
        for (instance, message), times in self._times.items():
            if times > _SHOWN_TIMES:
                more = f"{times - _SHOWN_TIMES} more {'times' if times > _SHOWN_TIMES + 1 else 'time'}"
                self._print(f"{instance}: {paragraph(message)} ({more})", "dim")

    def event(self, event: Event) -> None:
        """Show one event of the master."""
        match event:
            case Reachable(endpoints):
                self._endpoints = endpoints if not self._quiet else ()
                self._show_commands()
                if not self._waits_for_nodes:
                    self._show_address()
                elif self._endpoints:
                    self._console.print(end="")  # the first print takes some milliseconds: not when the nodes step
            case Status(status):
                self._status(status)
            case Log(line):
                self.log(line)
            case OutputLine(process, text) if text:
                self._print(printable(text.expandtabs()), front=f"{process} | ")
            case Restarted(error, number, most, point):
                again = f"The run starts again and goes on from point {point} (restart {number} of {most})."
                say(str(from_report(error).instead_of_hint(again)))
            case WasReset(outcome, number) if not self._quiet:
                files = "".join(f"; result: {short_path(file)} ({rows} rows)" for file, rows in outcome.files)
                self._print(f"reset {number} at point {outcome.point}{files}")
            case Outcome():
                self._end(event)

    def _show_address(self) -> None:
        """Show the endpoints that the user asked for, or else the socket."""
        if shown := ", ".join([one for one in self._endpoints if not is_socket(one)] or self._endpoints):
            self._print(f"mesh '{self._plan.system.config.mesh}' at {shown}")
        self._endpoints = ()

    def _show_commands(self) -> None:
        """Show what starts the nodes of each host that `launch` does not start."""
        config = self._plan.system.config
        where = [one for one in self._endpoints if not is_socket(one)] or config.zenoh.connect
        name = socket.gethostname()
        where = [one.replace("/0.0.0.0:", f"/{name}:").replace("/[::]:", f"/{name}:") for one in where]
        access = " --insecure" if config.zenoh.insecure else " --security DIR" if config.security is not None else ""
        for host, nodes in self._hosts.items() if not self._quiet else ():
            python = self._plan.hosts[host].python
            program = "fmu-mesh" if python == HostConfig().python else f"{python} -m fmu_mesh"
            command = f"{program} node {self._file} --host {host} --connect {next(iter(where), 'ENDPOINT')}{access}"
            self._print(f"start on {host} ({', '.join(nodes)}): {command}")

    def _missing(self) -> list[str]:
        """One line for each host, while nodes of any are missing."""
        if not any(self._waiting.values()):
            return []
        rows = [[host, f"waits for {', '.join(own)}" if own else "is there"] for host, own in self._waiting.items()]
        return table(rows, indent=2)

    def _end(self, outcome: Outcome) -> None:
        """Show why a run ended early; and what its rows warn of, where there is no summary with that."""
        if outcome.ended_by is not None and not self._quiet:
            self._print(str(from_report(outcome.ended_by)))
        for warning in outcome.warnings if outcome.state == "failed" else ():
            say(f"warning: {warning}")

    def log(self, line: LogLine) -> None:
        """Show one log message of an FMU. After five times, the same text is only counted.

        A warning or error is held back until the FMU has taken the next step. If that fails, the error has the text.
        """
        if self._quiet and line.status not in _ERRORS:
            return
        if line.status == "ok" or self._over:
            self._show(line)
            return
        self._held.append(line)
        if len(self._held) > _HELD:
            self._show(self._held.popleft())

    def flush(self, error: str = "") -> None:
        """Show the messages that are held back, except those in the text of ``error``."""
        told = error.partition("the FMU says: ")[2]
        self._held = deque(line for line in self._held if line.message not in told)
        self._release()

    def _release(self, may_go: Callable[[LogLine], bool] = lambda _line: True) -> None:
        """Show the messages that are held back, all of them or those for which ``may_go`` is true."""
        held, self._held = self._held, deque()
        for line in held:
            if may_go(line):
                self._show(line)
            else:
                self._held.append(line)

    def _show(self, line: LogLine) -> None:
        key = line.instance, line.message
        if key in self._times or len(self._times) < _COUNTED:
            self._times[key] += 1
            if self._times[key] > _SHOWN_TIMES:
                return
        style = _STYLES.get(line.status, "dim")
        where = f"{line.instance} at point {line.point}"
        self._print(f"{where}: {paragraph(line.message)}", style)

    def _print(self, text: str, style: str = "", *, front: str = "") -> None:
        """Print printable text, after a dim ``front``; nobody needs it so much that a full disk ends the run."""
        from rich.text import Text  # noqa: PLC0415 as `_console`

        with suppress(OSError):  # a wrapped line could begin with words of a model
            self._console.print(Text.assemble((front, "dim"), (text, style)), soft_wrap=True)

    def _status(self, status: MeshStatus) -> None:
        self._progress.update(status.point, status)
        waiting = {host: [n for n in nodes if n in status.missing] for host, nodes in self._hosts.items()}
        for host, missing in self._waiting.items() if not self._quiet and status.state != "failed" else ():
            if missing and not waiting[host]:
                self._print(f"all nodes of {host} are there", "dim")
        self._waiting = waiting
        if status.state in ("running", "paused", "stopping", "done"):
            self._show_address()
        if status.state == "paused":
            self._release()
        elif self._held:
            self._release(lambda line: status.progress[self._plan.node_of(line.instance)] > line.point)


def warn(plan: Plan) -> None:
    """Print the first five warnings about a system on standard error before it runs, and that it could be faster."""
    if (slower := slower_than_it_could_be()) is not None:
        say_warning(slower)
    for warning in plan.system.warnings[:_WARNINGS]:
        say_warning(str(warning))
    if (rest := len(plan.system.warnings) - _WARNINGS) > 0:
        say_warning(f"and {rest} more, which `fmu-mesh check` shows")


def summary(plan: Plan, outcome: Outcome) -> list[str]:
    """The closing lines of a run; the last one is `20000 points in 1.234 s: 16207 points/s, real-time factor 32.4`."""
    lines = [f"result: {short_path(file)} ({rows} rows)" for file, rows in outcome.files]
    lines += [f"warning: {warning}" for warning in outcome.warnings]
    if rows := defect_rows(outcome.defects):
        title = "defects: a pointer to the connection, no error estimate"
        lines += [title, *table(rows, heading=DEFECT_COLUMNS, indent=2)]
    lines.append(summary_of(outcome, plan.grid.step_size))
    return lines
