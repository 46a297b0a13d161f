"""The progress line of a run: its point, its speed and the time left, in the width of the terminal.

Owns which parts are left out on a narrow terminal. It never wraps: a wrapped line cannot be erased.
"""

from __future__ import annotations

from typing import Final

from rich.console import Console, ConsoleOptions, RenderResult
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from ...simtime import TimeGrid
from ...system.plan import Plan
from ...wire.views import MeshStatus
from .tables import shortened
from .terminal import may_draw

__all__ = ["ProgressLine", "progress_parts"]

_LEAST_BAR: Final = 8
_MOST_NAME: Final = 20
_GAP: Final = "  "
_ECHO: Final = 3
"""Columns for the `^C` that a terminal echoes, which would wrap the line."""


class ProgressLine:
    """One line at the bottom of a terminal, while it is started.

    Args:
        plan: the plan of the run.
        console: where it is drawn, if that is a terminal.
        show: False never draws it.
    """

    def __init__(self, plan: Plan, console: Console, *, show: bool) -> None:
        self._name = plan.system.config.mesh
        self._grid = plan.grid
        self._status: MeshStatus | None = None
        self._started: float | None = None
        drawn = show and may_draw(console.file) and console.is_terminal and not console.is_dumb_terminal
        self._live = Live(self, console=console, transient=True, refresh_per_second=10) if drawn else None

    def start(self) -> None:
        """Start to draw it."""
        if self._live is not None:
            self._live.start()

    def stop(self) -> None:
        """Erase it."""
        if self._live is not None:
            self._live.stop()

    def status(self, status: MeshStatus) -> None:
        """Show this status of the mesh."""
        self._status = status

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The line; Rich calls this ten times a second."""
        width = max(options.max_width - _ECHO, 1)
        name = shortened(self._name, min(_MOST_NAME, width // 4))
        parts = progress_parts(self._grid, self._status, width - len(name) - len(_GAP) - _LEAST_BAR - len(_GAP))
        padding = (0, len(_GAP), 0, 0)
        line = Table(
            width=width,
            padding=padding,
            box=None,
            collapse_padding=True,
            show_header=False,
            show_edge=False,
            pad_edge=False,
        )
        line.add_column(no_wrap=True)
        line.add_column(ratio=1, no_wrap=True)
        line.add_column(no_wrap=True)
        point = self._status.point if self._status is not None else 0
        total = self._grid.last_point if self._grid.stop_time is not None else None
        bar = ProgressBar(total=total, completed=point, pulse=total is None)
        line.add_row(Text(name, style="bold"), bar, Text(_GAP.join(parts)))
        yield line


def progress_parts(grid: TimeGrid, status: MeshStatus | None, width: int) -> list[str]:
    """The parts of the line besides the name that fit into ``width`` columns, the most important first.

    Args:
        grid: the points of the run.
        status: the status of the mesh; None before the first one.
        width: in columns.
    """
    if status is None or status.state in ("starting", "initializing"):
        return [status.state if status is not None else "starting"]
    rate, parts = status.points_per_second, []
    if grid.stop_time is not None:
        parts.append(f"{100 * status.point // max(grid.last_point, 1)} %")
        parts.append(f"{status.time:.6g} of {grid.stop_time:.6g} s")
    else:
        parts.append(f"{status.time:.6g} s")
    if status.state != "running":
        parts.append(status.state)
    elif grid.stop_time is not None and rate > 0.0:
        parts.append(f"{_duration((grid.last_point - status.point) / rate)} left")
    parts += [f"{rate:,.0f} points/s", f"factor {status.real_time_factor:.3g}"]
    shown: list[str] = []
    for part in parts:
        if len(_GAP.join([*shown, part])) > width:
            break
        shown.append(part)
    return shown


def _duration(seconds: float) -> str:
    """A duration such as `0:23`, `1:02:03` or `2 d 5 h`."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    days, hours = divmod(hours, 24)
    if days:
        return f"{days} d {hours} h"
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
