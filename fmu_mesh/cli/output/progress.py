"""The progress line of a run or a sweep: how far it is, its speed and the time left, in the width of the terminal.

Owns which parts are left out on a narrow terminal. It never wraps: a wrapped line cannot be erased.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Final, Generic, TypeVar

from ...pictures.tables import shortened
from ...simtime import TimeGrid
from ...wire.views import MeshStatus
from .terminal import may_draw

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderResult
    from rich.live import Live

    from ...sweeps.sweeping import SweepProgress

__all__ = ["ProgressLine", "progress_parts", "sweep_parts"]

T = TypeVar("T")
"""A status."""

_LEAST_BAR: Final = 8
_MOST_NAME: Final = 20
_GAP: Final = "  "
_ECHO: Final = 3
"""Columns for the `^C` that a terminal echoes, which would wrap the line."""


class ProgressLine(Generic[T]):
    """One line at the bottom of a terminal, while it is started.

    Args:
        name: of what is going on.
        total: how much there is to do; None if that is not known.
        parts: of the last status, what fits into a number of columns beside the bar.
        console: where it is drawn, if standard error is a terminal; None never draws it. Rich is slow to import.
        below: the lines below it.
    """

    def __init__(
        self,
        name: str,
        total: int | None,
        parts: Callable[[T, int], list[str]],
        console: Callable[[], Console] | None,
        below: Callable[[], list[str]] = list,
    ) -> None:
        self._name, self._total, self._parts, self._below = name, total, parts, below
        self._done = 0
        self._status: T | None = None
        self._live: Live | None = None
        if console is not None and may_draw(sys.stderr) and console().is_terminal and not console().is_dumb_terminal:
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

    def update(self, done: int, status: T) -> None:
        """Show how much is done, and this status."""
        self._done, self._status = done, status

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The line; Rich calls this ten times a second."""
        from rich.progress_bar import ProgressBar  # noqa: PLC0415 as above
        from rich.table import Table  # noqa: PLC0415 as above
        from rich.text import Text  # noqa: PLC0415 as above

        width = max(options.max_width - _ECHO, 1)
        name = shortened(self._name, min(_MOST_NAME, width // 4))
        room = width - len(name) - len(_GAP) - _LEAST_BAR - len(_GAP)
        parts = self._parts(self._status, room) if self._status is not None else ["starting"]
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
        bar = ProgressBar(total=self._total, completed=self._done, pulse=self._total is None)
        line.add_row(Text(name, style="bold"), bar, Text(_GAP.join(parts)))
        yield line
        for text in self._below():
            yield Text(shortened(text, width))


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
        parts.append(status.restarting or status.state)
    elif grid.stop_time is not None and rate > 0.0:
        parts.append(f"{_duration((grid.last_point - status.point) / rate)} left")
    parts += [f"{rate:,.0f} points/s", f"factor {status.real_time_factor:.3g}"]
    return _fitting(parts, width)


def sweep_parts(progress: SweepProgress, width: int) -> list[str]:
    """As `progress_parts`, of a sweep."""
    parts = [f"{progress.done} of {progress.total} runs"]
    if progress.failed:
        parts.append(f"{progress.failed} failed")
    if progress.left is not None:
        parts.append(f"{_duration(progress.left)} left")
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
