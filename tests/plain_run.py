"""A run in the plainest way, which every other run must equal in each float: a loop over the points of a `LocalSystem`.

It shares with the package what happens inside a step, the coupling rule, and the writers of result files. It knows no
rings between instances, no windows, no bursts, and no wall clock.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path

import numpy as np

from fmu_mesh.config.loading import LoadedConfig
from fmu_mesh.errors import FmuMeshError, TerminationRequested
from fmu_mesh.instances.call_guard import CallWatch, Guarded
from fmu_mesh.instances.contract import Instance, Showing
from fmu_mesh.instances.registry import open_instance
from fmu_mesh.results.growth import GrowthWatch, ReadColumn
from fmu_mesh.results.record_files import RecordFiles, open_results, what_is_kept
from fmu_mesh.run.local_system import LocalSystem, opening_of
from fmu_mesh.run.one_process import OneProcess
from fmu_mesh.run.outcome import Outcome, outcome_at
from fmu_mesh.system.layout import Layout
from fmu_mesh.system.plan import Plan
from fmu_mesh.variables.value_types import DTYPES, Value

__all__ = ["PlainRun"]

log = logging.getLogger(__name__)


class PlainRun:
    """Runs a plan in this process, as fast as it goes, and writes all rows at the end.

    Args:
        plan: the plan; its nodes and its window are not used.
        open_instance: opens an instance by name, instead of the model of the plan; it is closed here.
        loaded: the configuration; None: that of the plan, with paths relative to the working directory.

    Attributes:
        files: each result file and the number of its rows, once the run is over.
    """

    def __init__(
        self,
        plan: Plan,
        open_instance: Callable[[str], Instance] | None = None,
        loaded: LoadedConfig | None = None,
    ) -> None:
        self.files: tuple[tuple[str, int], ...] = ()
        self._plan = plan
        self._open_instance = open_instance
        self._loaded = loaded if loaded is not None else LoadedConfig(plan.system.config, Path())
        self._growth = GrowthWatch(plan)

    def run(self) -> Outcome:
        """Run from the first to the last point.

        Raises:
            FmuMeshError: as a run of the package; the rows before are kept.
        """
        plan, system, ended = self._plan, LocalSystem(self._plan), None
        if self._open_instance is None:
            OneProcess().check(plan, {})
        rows: list[list[Value]] = []
        try:
            with ExitStack() as stack:
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="fmu_mesh-")))
                watch = stack.enter_context(closing(CallWatch(lambda error: log.error("%s", error))))
                files = RecordFiles(open_results(self._loaded, plan.system, digest=plan.digest), self._growth)
                stack.callback(system.close)
                stack.callback(self._save, files, rows)
                timeouts = plan.system.config.timeouts
                system.start(lambda name: Guarded(name, partial(self._open, name, folder), watch, timeouts))
                readers = [system.reader(*column) for column in plan.system.recorded]
                try:
                    for point in range(plan.grid.last_point + 1):
                        rows.append([read(point // points) for read, points in readers])
                        if point < plan.grid.last_point:
                            system.step()
                except TerminationRequested as asked:
                    ended = asked
        except FmuMeshError as error:
            error.with_hint(what_is_kept(self.files))
            raise
        return outcome_at(plan, system.point, self.files, None, ended, warnings=self._growth.warnings)

    def _open(self, name: str, folder: Path) -> Instance:
        if self._open_instance is not None:
            return self._open_instance(name)
        return open_instance(opening_of(self._plan, name, folder, lambda _message: None, Showing()))

    def _save(self, files: RecordFiles, rows: list[list[Value]]) -> None:
        plan = self._plan
        layouts = {name: Layout.of(own.description.variables) for name, own in plan.system.instances.items()}
        columns = plan.system.recorded
        places = {column: place for place, column in enumerate(columns)}
        types = [layouts[instance].column(name).type for instance, name in columns]
        values = [np.array([row[i] for row in rows], dtype=DTYPES[type_]) for i, type_ in enumerate(types)]

        def column_of(instance: str, variable: str) -> ReadColumn:
            return lambda first, end: values[places[instance, variable]][first:end]

        try:
            files.begin(plan.grid, plan.system.records, column_of)
            files.write(0, len(rows))
        finally:
            files.close()
            self.files = files.counted
