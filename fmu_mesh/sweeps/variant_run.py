"""Variants of a sweep in a worker: from their parameters to their rows of the table.

A worker keeps the models of the sweep that it works for loaded, one set for each thread that asks for runs. Each set
has a thread of its own, because an FMU may not return: then the row says so, and that thread is left.
"""

# Threads of a worker: that of the executor waits for rows, and a thread "variants" runs them, because an FMU may not
# return: then a row says so, and that thread is left (ADR 59). The queue between them has one job at a time. The
# watch over calls of FMUs is a third thread, which ends the wait (`_Hung`).

from __future__ import annotations

import base64
import mmap
import os
import socket
import threading
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from functools import partial
from multiprocessing.process import parent_process
from pathlib import Path
from queue import SimpleQueue
from typing import Any, cast

import msgspec
import numpy as np

from .. import __version__
from ..api.mesh_builder import Mesh
from ..api.repeated_mesh import RepeatedMesh
from ..api.rerunning import ALONE, on_this_host
from ..api.result import Result
from ..config.loading import PlainConfig
from ..errors import ConfigurationError, ErrorReport, FmuError, FmuMeshError, NotInOneProcess, from_report
from ..system.run_metadata import machine
from .reductions import read_reduction, reduced_value
from .variants import Parameters

__all__ = ["Common", "Row", "SweepTask", "curves_of", "options_of_variant", "path_of", "run_variants"]

_GROWTH_BYTES = 256 * 2**20

Cell = float | int | bool | str | None
"""One value of the table."""

Variant = tuple[str, Parameters]
"""The id of a variant, and its parameters."""

_End = Result | BaseException
"""How a run ended."""

_Jobs = SimpleQueue[tuple[Callable[[RepeatedMesh], _End | None], Future[_End | None]] | None]
"""What runs variants, and who waits for it; None at the end."""

OwnReductions = Mapping[str, Callable[[Result], object]]
"""Functions of the user by the name of their column."""


class Common(msgspec.Struct, frozen=True, kw_only=True):
    """What all variants of a sweep have in common."""

    version: str  # that of fmu_mesh, which all workers must have
    file: str  # the file of the configuration, absolute
    data: Any  # the values of the configuration
    options: dict[str, Any]  # the options of each run that have another value than their default
    reductions: tuple[str, ...] = ()  # columns that are calculated from the curves of each run
    processes: bool = False  # whether each run starts processes, as `launch` does
    reset: bool = False  # whether instances are reset between two runs, and not made anew


class SweepTask(Common, frozen=True, kw_only=True):
    """What every worker gets."""

    folder: Path | None = None  # for the curves of each run; None: they are not kept
    foreign: str = ""  # as in `PlainConfig`


class Row(msgspec.Struct, frozen=True):
    """How one variant ended: a row of the table."""

    id: str  # SHA-256 of the configuration, the parameters, and the files of all models
    exit_code: int  # 0, or that of `launch` for the same error
    message: str  # why it failed, or what its result warns of; empty if there is nothing to say
    # by the name of the column, what was calculated from its curves; None where there is nothing
    values: dict[str, Cell]
    seconds: float  # wall-clock time of the run in s, with its planning
    worker: str  # host and process id of the worker
    # whether the worker is to be replaced: an FMU has not returned, or has crashed while it was closed, or the
    # process has grown, because an FMU does not free its memory
    spent: bool = False
    machine: str = ""  # what the last digits of results depend on, on the host of the worker


def options_of_variant(options: Mapping[str, Any], instances: Sequence[str], parameters: Parameters) -> dict[str, Any]:
    """The options of a variant: `instance.variable` is a start value, any other name a key of the configuration."""
    start = {name: value for name, value in parameters.items() if name.partition(".")[0] in instances}
    keys = {name: value for name, value in parameters.items() if name not in start}
    own = {"start_values": start, "config_values": keys}
    return {**options, **{name: {**options.get(name, {}), **values} for name, values in own.items()}}


def run_variants(
    task: bytes, functions: OwnReductions, variants: Sequence[Variant], *, ours: bool = False
) -> list[Row]:
    """Run variants one after another, up to one whose row is `Row.spent`; a run that failed has a row, too.

    Called in a worker, by whichever executor; ``ours`` says that the process does nothing else.
    """
    alone = (ours or parent_process() is not None) and not functions  # those of a user may change what they like
    return _mine.loaded_for(task, alone=alone).rows(variants, functions)


class _Mine(threading.local):
    """What the thread that asks for runs has loaded; it is let go with the thread."""

    def __init__(self) -> None:
        self._loaded: _Loaded | None = None

    def loaded_for(self, task: bytes, *, alone: bool) -> _Loaded:
        if self._loaded is None or self._loaded.task != task or self._loaded.hung.stuck:
            self._loaded = _Loaded(task, alone=alone)
        return self._loaded


_mine = _Mine()


class _Loaded:
    """The models of a sweep in this process, and the thread that runs them; it ends with this object."""

    def __init__(self, task: bytes, *, alone: bool) -> None:
        self.task = task
        self._task = msgspec.msgpack.decode(task, type=SweepTask, dec_hook=path_of)
        self._reductions = [read_reduction(text) for text in self._task.reductions]
        data = self._task.data
        if isinstance(data, dict):  # variants must not listen at the same ports, nor write into the same files
            zenoh = {**(data.get("zenoh") or {}), **ALONE["zenoh"]}
            data = {**data, **on_this_host(data), "zenoh": zenoh, "runtime": ALONE["runtime"]}
            if isinstance(records := data.get("record"), list):
                data["record"] = records[:1]
        self._mesh = Mesh.from_configuration(PlainConfig(data, Path(self._task.file), foreign=self._task.foreign))
        self._jobs: _Jobs = SimpleQueue()
        self.hung = _Hung()
        self._instances = frozenset(self._mesh.instances)
        self._memory = os.open("/proc/self/statm", os.O_RDONLY | os.O_CLOEXEC)
        weakref.finalize(self, os.close, self._memory)
        self._bytes = 0
        self._started = 0.0
        self._worker, self._machine = f"{socket.gethostname()}:{os.getpid()}", ", ".join(machine().values())
        work = partial(_work, self._mesh, self._jobs, self.hung, reset=self._task.reset, alone=alone)
        threading.Thread(target=work, name="variants", daemon=True).start()
        weakref.finalize(self, self._jobs.put, None)

    def rows(self, variants: Sequence[Variant], functions: OwnReductions) -> list[Row]:
        """The rows of variants, up to one after which this worker is of no use."""
        rows: list[Row] = []
        while len(rows) < len(variants) and not (rows and rows[-1].spent):
            apart, end = self._task.processes, cast("_End | None", None)
            if not apart:
                ended: Future[_End | None] = Future()
                self._jobs.put((partial(self._run_all, variants[len(rows) :], functions, rows), ended))
                end = ended.result()
                apart = isinstance(end, NotInOneProcess)  # a parameter may be the path of a model
            if apart:
                end = self._run(lambda *variant: self._mesh.run(**self._options(*variant)), variants[len(rows)])
            if end is not None:
                rows.append(self._row(variants[len(rows)], end, functions))
        return rows

    def _run_all(
        self, variants: Sequence[Variant], functions: OwnReductions, rows: list[Row], runs: RepeatedMesh
    ) -> _End | None:
        """On the thread of the models: add the rows of variants; returns why one cannot run here."""
        for variant in variants:
            end = self._run(partial(self._run_here, runs), variant)
            if self.hung.stuck or isinstance(end, NotInOneProcess):
                return end
            rows.append(self._row(variant, end, functions))
            if rows[-1].spent:
                break
        return None

    def _run_here(self, runs: RepeatedMesh, identity: str, parameters: Parameters) -> Result:
        """A run with the models of this process; without files of their own, runs with equal keys share a plan."""
        instances = self._instances
        start = {name: value for name, value in parameters.items() if name.partition(".")[0] in instances}
        keys = tuple((name, value) for name, value in parameters.items() if name not in start)
        key = tuple(start), msgspec.json.encode(keys), identity if self._task.folder is not None else None
        return runs.run_planned(key, start, partial(self._options, identity, parameters))

    def _run(self, run: Callable[[str, Parameters], Result], variant: Variant) -> _End:
        self._started = time.perf_counter()
        self.hung.begin()
        try:
            return run(*variant)
        except BaseException as error:  # noqa: BLE001  it becomes a row
            return error

    def _options(self, identity: str, parameters: Parameters) -> dict[str, Any]:
        task = self._task
        if task.version != __version__:
            raise ConfigurationError(f"this worker has fmu_mesh {__version__}, and the sweep {task.version}")
        options = options_of_variant(task.options, self._mesh.instances, parameters)
        if task.folder is not None:
            return {**options, "output": curves_of(task.folder, identity)}
        return {**options, "record": "memory"}

    def _row(self, variant: Variant, end: _End, functions: OwnReductions) -> Row:
        values: dict[str, Cell] = {}
        error, warnings = end if isinstance(end, BaseException) else None, list[str]()
        if not isinstance(end, BaseException):
            try:
                values, warnings = self._values(end, functions), [*end.warnings, self.hung.warning]
            except Exception as failure:  # noqa: BLE001  the other variants go on
                error = failure
        report = _report(error) if error is not None else None
        return Row(
            id=variant[0],
            exit_code=report.exit_code if report is not None else 0,
            message=_line(report) if report is not None else " ".join(filter(None, warnings)),
            values=values,
            seconds=time.perf_counter() - self._started,
            worker=self._worker,
            spent=self.hung.stuck or self._has_grown(),
            machine=self._machine,
        )

    def _values(self, result: Result, functions: OwnReductions) -> dict[str, Cell]:
        values = {one.text: _cell(reduced_value(one, result)) for one in self._reductions}
        for name, function in functions.items():
            try:
                values[name] = _cell(function(result))
            except Exception as error:
                text = f"the reduction '{name}' raised {type(error).__name__}: {error}"
                raise FmuMeshError(text) from error
        return values

    def _has_grown(self) -> bool:
        """Whether this process has more than twice the memory that it had after its first run."""
        now = int(os.pread(self._memory, 100, 0).split()[1]) * mmap.PAGESIZE
        self._bytes = self._bytes or now
        return now - self._bytes > max(self._bytes, _GROWTH_BYTES)


class _Hung:
    """Tells whoever waits for runs that an FMU does not return."""

    def __init__(self) -> None:
        self.ended: Future[_End | None] = Future()  # the job under way
        self.stuck = False  # whether it has not returned
        self.warning = ""  # why, if the run was over before
        self._end: _End | None = None

    def watch(self, ended: Future[_End | None]) -> None:
        """Another job begins."""
        self.ended = ended

    def begin(self) -> None:
        """Another run begins."""
        self._end = None

    def over(self, end: _End) -> None:
        """The run is over, and its instances are closed now."""
        self._end = end

    def tell(self, error: FmuError) -> None:
        """An FMU has not returned in time, or has crashed while it was closed; the row of a complete run stays."""
        self.stuck = True
        end = self._end if self._end is not None else error
        if not isinstance(end, BaseException):
            self.warning = _line(error.report())
        self.ended.set_result(end)


def _work(mesh: Mesh, jobs: _Jobs, hung: _Hung, *, reset: bool, alone: bool) -> None:
    """Run variants in this process, until there is none; on a thread of its own."""
    own = mesh.from_configuration(mesh.configuration, keeps_code=True)
    with RepeatedMesh(repr(own), own.plan, reset=reset, on_hang=hung.tell, alone=alone, before_close=hung.over) as runs:
        while (job := jobs.get()) is not None:
            run_all, ended = job
            hung.watch(ended)
            end = run_all(runs)
            if not hung.stuck:
                ended.set_result(end)
            del job, run_all  # they have the object whose end is the end of this thread


def curves_of(folder: Path, identity: str) -> Path:
    """The file with the curves of a run, in the folder of the curves."""
    return folder / f"{identity}.csv"


def path_of(type_: type, value: object) -> object:
    """The `dec_hook` of msgspec for what holds a path, which is written as text."""
    if type_ is Path:
        return Path(str(value))
    raise NotImplementedError(type_)


def _cell(value: object) -> Cell:
    """A value of a function of the user as the table has it."""
    plain = value.item() if isinstance(value, np.generic | np.ndarray) else value
    if isinstance(plain, bytes):
        return base64.b64encode(plain).decode()
    if not isinstance(plain, float | int | bool | str | None):
        msg = f"expected a number, a truth value or a text, and got {type(plain).__name__}"
        raise TypeError(msg)
    return plain


def _report(error: BaseException) -> ErrorReport:
    if isinstance(error, FmuMeshError):
        return error.report()
    return ErrorReport("FmuMeshError", f"{type(error).__name__}: {error}", FmuMeshError.exit_code)


def _line(error: ErrorReport) -> str:
    """An error in one line, without the way out: that names files of this run."""
    return " ".join(str(from_report(error).instead_of_hint("")).split())
