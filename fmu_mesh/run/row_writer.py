"""Writes the rows of a run in this process, from the rings of its instances into the result files.

Knows neither how the instances are stepped nor when the run ends.
"""

# Two threads meet here: the one that steps and writes, and the one that watches it, which closes the files if a call of
# an FMU does not return. Both write under a lock. If the disk does not answer either, the watching thread gives up
# after half a second: a process that ends must not wait for it. The files are ADR 50 and 60.

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence

from ..node.stepping import Runner
from ..recorder.recorded_source import RecordedSource
from ..results.defects import DefectWatch
from ..results.growth import GrowthWatch
from ..results.record_files import RecordFiles, what_is_kept
from ..results.recording import ResultFile
from ..system.defect import Defect
from ..system.plan import RECORDER, Plan
from ..wire.frames import SourceRows

__all__ = ["RowWriter"]

_FLUSH_S = 0.2
# Longer than a block takes to be written: whoever still writes then writes to a disk that does not answer.
_OTHER_WRITER_S = 0.5


class RowWriter:
    """Writes the rows of a run, from its rings into the result files.

    Call sequence: `begin`, then `write`; at the end `close`. `begin_again` before another `begin` is for another run of
    the same instances.

    Args:
        files: the files; empty: nothing is recorded.
        plan: the plan of the run: what its rows warn of, and the defects of its connections.

    Attributes:
        written: number of points whose rows are written.
    """

    def __init__(self, files: Sequence[ResultFile], plan: Plan) -> None:
        self.written = 0
        self._files = RecordFiles(files, GrowthWatch(plan), defects=DefectWatch(plan))
        self._sources: list[RecordedSource] = []
        self._rows = 1
        self._flushed = 0.0
        self._writing = threading.Lock()
        self._runners: Mapping[str, Runner] | None = None

    def begin_again(self, files: Sequence[ResultFile]) -> None:
        """Write another run, into as many other files."""
        self.written, self._flushed = 0, 0.0
        self._files.begin_again(files)

    def begin(self, plan: Plan, runners: Mapping[str, Runner]) -> None:
        """All instances are at the first point."""
        self.written = plan.grid.first_point
        if self._files.in_memory:
            self._flushed = time.monotonic()  # nobody can look into memory: the first row waits for others
        if RECORDER not in plan.nodes or runners is self._runners:
            return
        self._runners, node = runners, plan.nodes[RECORDER]
        sources = {}
        for link in node.links_in:
            rows = SourceRows(runners[link.source].outputs, runners[link.source].counter)
            sources[link.source] = RecordedSource(link, plan.grid.last_point, [rows], None)
        self._rows = min(place.rows for place in node.rings)
        self._sources = list(sources.values())
        self._files.begin(plan.grid, node.records, lambda instance, variable: sources[instance].column(variable))

    @property
    def counted(self) -> tuple[tuple[str, int], ...]:
        """The path and the number of rows of each file."""
        return self._files.counted

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the rows so far warn of."""
        return self._files.warnings

    @property
    def defects(self) -> dict[str, Defect]:
        """See `RecordFiles`."""
        return self._files.defects

    @property
    def complete(self) -> int:
        """The last point whose row is complete."""
        return min((source.covered for source in self._sources), default=-1)

    def write(self, end: int, many: int) -> None:
        """Write the rows of all points before ``end``, if they are ``many``, or were not written for 0.2 s.

        Raises:
            ConfigurationError: a file cannot be written.
        """
        now = time.monotonic()
        is_late = now - self._flushed > _FLUSH_S
        if end - self.written < (1 if is_late else many):
            return
        with self._writing:
            while self._sources and (first := self.written) < end:
                last = min(end, first - first % self._rows + self._rows)  # read without wrap-around
                self._files.write(first, last)
                self.written = last
            self.written = end
            if is_late:
                self._files.flush()
            self._flushed = now if is_late else self._flushed

    def check_writing(self, now: float, limit_s: float) -> None:
        """See `RecordFiles`."""
        self._files.check_writing(now, limit_s)

    def note_event(self, what: str, instance: str, point: int, message: str) -> None:
        """See `RecordFiles`; from any thread."""
        with self._writing:
            self._files.note_event(what, instance, point, message)

    def close(self) -> None:
        """Close the files; from any thread, and nothing happens if they are closed.

        Raises:
            ConfigurationError: a file cannot be written.
        """
        if not self._writing.acquire(timeout=_OTHER_WRITER_S):
            return  # another thread is writing to a disk that does not answer
        try:
            self._files.close()
        finally:
            self._writing.release()

    def kept(self) -> str | None:
        """The sentence about the rows of a run that ended early."""
        return what_is_kept(self.counted)
