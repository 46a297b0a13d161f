"""Writes the rows of a run in this process, from the rings of its instances into the result file.

Knows neither how the instances are stepped nor when the run ends.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..files import unwritable
from ..node.stepping import Runner
from ..recorder.recorder import RecordedSource
from ..system.plan import RECORDER, Plan
from ..system.recording import ResultFile
from ..wire.frames import SourceRows
from .results import what_is_kept

__all__ = ["RowWriter"]

_FLUSH_S = 0.2
_CLOSE_S = 0.5


class RowWriter:
    """Writes the rows of a run, from its rings into the result file.

    Args:
        file: the file; None: nothing is recorded.

    Attributes:
        written: number of points whose rows are written.
    """

    def __init__(self, file: ResultFile | None) -> None:
        self.written = 0
        self._result = file
        self._open = file
        self._sources: list[RecordedSource] = []
        self._columns: list[Callable[[int, int], NDArray[Any]]] = []
        self._times: Callable[[int, int], NDArray[np.float64]]
        self._rows = 1
        self._flushed = 0.0
        self._writing = threading.Lock()

    def begin(self, plan: Plan, runners: Mapping[str, Runner]) -> None:
        """All instances are at point 0."""
        if RECORDER not in plan.nodes:
            return
        node = plan.nodes[RECORDER]
        own = {link.source: runners[link.source] for link in node.links_in}
        sources = {
            link.source: RecordedSource(
                link, plan.grid.last_point, [SourceRows(own[link.source].outputs, own[link.source].counter)], None
            )
            for link in node.links_in
        }
        self._rows = node.rings[0].rows
        self._times = plan.grid.times
        self._sources = list(sources.values())
        self._columns = [sources[instance].column(variable) for instance, variable in node.recorded]

    @property
    def rows(self) -> int:
        """Number of rows in the file."""
        return self._result.rows if self._result is not None else 0

    @property
    def file(self) -> str | None:
        """The path of the file."""
        return str(self._result.path) if self._result is not None else None

    @property
    def complete(self) -> int:
        """The last point whose row is complete."""
        return min((source.covered for source in self._sources), default=-1)

    def write(self, end: int, many: int) -> None:
        """Write the rows of all points before ``end``, if they are ``many``, or were not written for 0.2 s.

        Raises:
            ConfigurationError: the file cannot be written.
        """
        now = time.monotonic()
        is_late = now - self._flushed > _FLUSH_S
        if end - self.written < (1 if is_late else many):
            return
        with self._writing:
            if (file := self._open) is not None and self._columns:
                try:
                    self._write(file, end)
                    if is_late:
                        file.flush()
                except OSError as error:
                    raise unwritable(file.path, error) from error
            self.written = end
            self._flushed = now if is_late else self._flushed

    def close(self) -> None:
        """Close the file; from any thread, and nothing happens if it is closed.

        Raises:
            ConfigurationError: the file cannot be written.
        """
        if not self._writing.acquire(timeout=_CLOSE_S):
            return  # another thread is writing to a disk that does not answer
        try:
            file, self._open = self._open, None
            if file is not None:
                _close(file)
        finally:
            self._writing.release()

    def kept(self) -> str | None:
        """The sentence about the rows of a run that ended early."""
        return what_is_kept(self.file, self.rows)

    def _write(self, file: ResultFile, end: int) -> None:
        while (first := self.written) < end:
            last = min(end, first - first % self._rows + self._rows)  # read without wrap-around
            file.write(self._times(first, last), [column(first, last) for column in self._columns])
            self.written = last


def _close(file: ResultFile) -> None:
    try:
        file.close()
    except OSError as error:
        raise unwritable(file.path, error) from error
