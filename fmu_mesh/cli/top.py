"""`top`: a live table of all instances of a mesh, and the course of chosen variables.

Owns the rates and shares, which are those between two looks (at the first look those since the first point), and which
columns fit into a terminal.
"""

# Threads: the main one draws, and a thread "values" asks the mesh for the chosen variables, because an answer may take
# longer than a page is shown. `_lock` is for the courses, which one extends and the other draws.

from __future__ import annotations

import argparse
import shutil
import sys
import threading
from collections.abc import Sequence
from typing import Any, Final, Self

import numpy as np

from .. import printing
from ..api.attaching import attach
from ..api.run_handle import Run
from ..errors import DeadlineExceeded, FmuMeshError, Interrupted, MeshLost
from ..pictures.tables import shortened, table, wrapped
from ..wire.views import InstanceStatus, MeshStatus
from .arguments import Runs, reach
from .output.json_output import print_json
from .output.pages import keys, progress, seconds, with_hosts
from .output.screen import Screen
from .output.sparklines import Histories, sparkline_signs
from .output.terminal import may_draw

__all__ = ["RUNS", "page"]

_VALUES_PER_LOOK: Final = 4
"""Values of a variable in the time between two looks."""
_HEADING = ["instance", "state", "point", "time", "step time", "wait", "points/s", "factor", "restarts", "activity"]
_LEAST_NAME: Final = 12
_GOOD_NAME: Final = 32
"""Up to this length a name is more important than the columns that can be left out, except the state."""
_LEAST_ACTIVITY: Final = 20
_DISPENSABLE: Final = ("time", "factor", "restarts", "state")
"""Columns that are left out on a narrow terminal, in this order; the head line has the time and the state."""

Look = tuple[MeshStatus, dict[str, InstanceStatus]]


def _top(arguments: argparse.Namespace) -> int:
    with (
        attach(arguments.mesh, **reach(arguments)) as run,
        _Courses(run, arguments.watch, arguments.interval) as courses,
    ):
        if arguments.once:
            _show_once(run.all_status(), courses, as_json=arguments.json)
            return 0
        try:
            return _follow(run, courses, as_json=arguments.json)
        except KeyboardInterrupt:
            return Interrupted.exit_code


class _Courses:
    """The course of variables, as long as the `with` block lasts.

    A thread asks for the values, because `top` has to show the state of a mesh whose values do not come.
    """

    def __init__(self, run: Run, names: Sequence[str], interval_s: float) -> None:
        self.per_look = _VALUES_PER_LOOK if names else 1  # values in the time between two looks
        self.interval_s = interval_s / self.per_look  # from one value to the next
        self._run = run
        self._names = tuple(names)
        self._histories = Histories()
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._ask, name="values", daemon=True)

    def __enter__(self) -> Self:
        if self._names:
            self._histories.add(self._run.samples(*self._names))
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        if self._names and self._thread.ident is not None:
            self._thread.join()

    def lines(self, width: int | None) -> list[str]:
        with self._lock:
            lines = self._histories.lines(width, sparkline_signs(sys.stdout.encoding))
        return ["", *lines] if lines else []

    def values(self) -> dict[str, list[dict[str, Any]]]:
        """The current values as JSON has them; nothing without variables."""
        with self._lock:
            newest = [sample._asdict() for sample in self._histories.newest]
        for value in newest:
            if isinstance(value["value"], np.ndarray):
                value["value"] = value["value"].tolist()
        return {"values": newest} if self._names else {}

    def _ask(self) -> None:
        while not self._over.wait(self.interval_s):
            try:
                samples = self._run.samples(*self._names)
            except FmuMeshError:  # the mesh ends, or an instance does not answer now
                samples = []
            with self._lock:
                self._histories.add(samples)


def _show_once(look: Look, courses: _Courses, *, as_json: bool) -> None:
    if as_json:
        print_json({"mesh": look[0], "instances": list(look[1].values()), **courses.values()})
    else:
        width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
        print(printing.page([*page(look, width=width), *courses.lines(width)]), flush=True)


def _follow(run: Run, courses: _Courses, *, as_json: bool) -> int:
    """Look again and again until the mesh ends, or `q`; where there is no terminal, one table after the other."""
    with Screen(drawn=may_draw(sys.stdout) and not as_json) as screen, run.until_end(screen.wake) as ended:
        before: Look | None = None
        while not ended.is_set():
            try:
                look = run.all_status()
            except DeadlineExceeded:
                if ended.is_set():
                    break
                raise
            except MeshLost:  # it has ended since
                break
            if not screen.drawn:
                _show_once(look, courses, as_json=as_json)
            for _ in range(courses.per_look):
                if screen.drawn and not ended.is_set():
                    screen.show([*page(look, before, width=screen.width), *courses.lines(screen.width)])
                if screen.quits_within(courses.interval_s):
                    return 0
            before = look
    if not as_json:
        print(f"mesh '{run.name}' has ended")
    return 0


def page(look: Look, before: Look | None = None, *, width: int | None = None) -> list[str]:
    """The lines of one look, in at most ``width`` columns; rates are those since the look ``before``."""
    status, instances = look
    step_size = status.real_time_factor / status.points_per_second if status.points_per_second else 0.0
    head = [
        f"{status.mesh}: {status.state}",
        f"point {progress(status)}",
        seconds(status.time),
        f"{status.points_per_second:.0f} points/s",
        f"real-time factor {status.real_time_factor:.3g}",
        *([f"{status.overruns} overruns"] if status.overruns else []),
    ]
    shown, heading = [own for _, own in sorted(instances.items())], list(_HEADING)
    rows = [_row(own, before[1].get(own.instance) if before is not None else None, step_size) for own in shown]
    rows = with_hosts(shown, rows, heading)
    of_keys = keys(instances.values())
    if width is None:
        return [", ".join(head), "", *table(rows, heading=heading), *of_keys]
    head[0] = f"{shortened(status.mesh, width // 2)}: {status.state}"
    return [*wrapped(head, width), "", *_cut([*_fitted(rows, heading, width), *of_keys], width)]


def _fitted(rows: list[list[str]], heading: list[str], width: int) -> list[str]:
    """The table in ``width`` columns: without dispensable columns, with short names and a cut activity."""
    rows = [list(row) for row in rows]
    longest = max(len(row[0]) for row in (heading, *rows))

    def room() -> int:
        others = table([row[1:-1] for row in rows], heading=heading[1:-1])
        return width - max(map(len, others), default=0) - 4  # two gaps

    for name in _DISPENSABLE:
        if room() >= min(longest, _LEAST_NAME if name == "state" else _GOOD_NAME) + _LEAST_ACTIVITY:
            break
        column = heading.index(name)
        for cells in (heading, *rows):
            del cells[column]
    for row in rows:
        row[0] = shortened(row[0], max(len(heading[0]), room() - _LEAST_ACTIVITY))
    return table(rows, heading=heading)


def _cut(lines: list[str], width: int) -> list[str]:
    return [line if len(line) <= width else f"{line[: width - 1]}\N{HORIZONTAL ELLIPSIS}" for line in lines]


def _row(own: InstanceStatus, before: InstanceStatus | None, step_size: float) -> list[str]:
    rate, _, waited = own.rates_since(before)
    return [
        own.instance,
        own.state,
        str(own.point),
        seconds(own.time),
        f"{1e6 * own.step_time:.3g} us",
        f"{100.0 * waited:.0f} %",
        f"{rate:.0f}",
        f"{rate * step_size:.3g}",
        str(own.restarts),
        own.activity.replace(f" at point {own.point}", "", 1),
    ]


RUNS: Runs = {"top": _top}
