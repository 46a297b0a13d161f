"""The progress line of a run or a sweep: how far it is, its speed and the time left, in the width of the terminal.

Owns which parts are left out on a narrow terminal. It never wraps: a wrapped line cannot be erased.
"""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Final

from ...pictures.tables import shortened
from ...simtime import TimeGrid
from ...system.plan import Plan
from ...wire.views import MeshStatus
from .terminal import may_draw

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderResult
    from rich.live import Live

    from ...sweeps.sweeping import SweepProgress

__all__ = ["RunProgressLine", "SweepProgressLine", "progress_parts"]

_LEAST_BAR: Final = 8
_MOST_NAME: Final = 20
_GAP: Final = "  "
_ECHO: Final = 3
"""Columns for the `^C` that a terminal echoes, which would wrap the line."""


class ProgressLine(ABC):
    """One line at the bottom of a terminal, while it is started.

    Args:
        name: of what is going on.
        console: returns where it is drawn, if standard error is a terminal: Rich is slow to import.
        show: False never draws it.
    """

    def __init__(self, name: str, console: Callable[[], Console], *, show: bool) -> None:
        self._name = name
        self._live: Live | None = None
        if show and may_draw(sys.stderr) and console().is_terminal and not console().is_dumb_terminal:
            from rich.live import Live  # noqa: PLC0415 see above

            self._live = Live(self, console=console(), transient=True, refresh_per_second=10)

    def start(self) -> None:
        """Start to draw it."""
        if self._live is not None:
            self._live.start()

    def stop(self) -> None:
        """Erase it."""
        if self._live is not None:
            self._live.stop()

    @abstractmethod
    def _parts(self, width: int) -> list[str]:
        """What fits into ``width`` columns beside the bar."""

    @property
    @abstractmethod
    def _completed(self) -> tuple[int, int | None]:
        """How much is done, and how much there is; None if that is not known."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The line; Rich calls this ten times a second."""
        from rich.progress_bar import ProgressBar  # noqa: PLC0415 as above
        from rich.table import Table  # noqa: PLC0415 as above
        from rich.text import Text  # noqa: PLC0415 as above

        width = max(options.max_width - _ECHO, 1)
        name = shortened(self._name, min(_MOST_NAME, width // 4))
        parts = self._parts(width - len(name) - len(_GAP) - _LEAST_BAR - len(_GAP))
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
        completed, total = self._completed
        bar = ProgressBar(total=total, completed=completed, pulse=total is None)
        line.add_row(Text(name, style="bold"), bar, Text(_GAP.join(parts)))
        yield line


class RunProgressLine(ProgressLine):
    """The progress line of a run."""

    def __init__(self, plan: Plan, console: Callable[[], Console], *, show: bool) -> None:
        super().__init__(plan.system.config.mesh, console, show=show)
        self._grid = plan.grid
        self._status: MeshStatus | None = None

    def status(self, status: MeshStatus) -> None:
        """Show this status of the mesh."""
        self._status = status

    def _parts(self, width: int) -> list[str]:
        return progress_parts(self._grid, self._status, width)

    @property
    def _completed(self) -> tuple[int, int | None]:
        point = self._status.point if self._status is not None else 0
        return point, self._grid.last_point if self._grid.stop_time is not None else None


class SweepProgressLine(ProgressLine):
    """The progress line of a sweep."""

    def __init__(self, name: str, console: Callable[[], Console], *, show: bool) -> None:
        super().__init__(name, console, show=show)
        self._progress: SweepProgress | None = None

    def update(self, progress: SweepProgress) -> None:
        """Show how far the sweep is."""
        self._progress = progress

    def _parts(self, width: int) -> list[str]:
        progress = self._progress
        if progress is None:
            return ["starting"]
        parts = [f"{progress.done} of {progress.total} runs"]
        if progress.failed:
            parts.append(f"{progress.failed} failed")
        if progress.left is not None:
            parts.append(f"{_duration(progress.left)} left")
        return _fitting(parts, width)

    @property
    def _completed(self) -> tuple[int, int | None]:
        return (self._progress.done, self._progress.total) if self._progress is not None else (0, None)


def progress_parts(grid: TimeGrid, status: MeshStatus | None, width: int) -> list[str]:
    """The parts of the line besides the name that fit into ``width`` columns, the most important first."""
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
    return _fitting(parts, width)


def _fitting(parts: Iterable[str], width: int) -> list[str]:
    """The first parts that fit into ``width`` columns."""
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
