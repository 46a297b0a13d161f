"""Follows one mesh on threads of its own, and keeps what pages show of it.

Owns the handle of the mesh, the history of chosen variables, and the log. Pages ask it as often as they like: an answer
is made of what is there, and never waits for the mesh.
"""

# Threads:
# * `follow KEY` lives as long as the follower: it attaches to the mesh, requests its status four times a second
#   until it ends, and attaches again. Everything else is started and stopped from here.
# * `sample`, one for each run, feeds curves: from the result file, or by questions for what is in no file. It goes on
#   after the end of the run, since a page may still choose curves from the file, and ends with the next run. It also
#   reads the defects of all of the run, which the file has when it is closed.
# * `log`, one for each run, collects the log; it ends with the mesh or with its session, so nobody joins it.
# * Pages: the event loop of the server calls `view`, `log` and `changes`, which take a lock for a moment and never
#   wait; `ask` and `picture` may take long, and pages call them on other threads.
#
# What may go wrong:
# * The thread of the samples of one run adds values to the curves of the next one. So it is joined before these are
#   cleared, and a page says with each question which run its curves are of.
# * The result file is replaced while it is read (a run that was restarted in place): all curves begin anew.
# * The end comes between two looks. `until_end` wakes the threads; how the run ended is known only if the handle has
#   requested it once before (`wait(0.0)`), because nobody answers afterwards.
# * Many pages request many variables: of more than 64, the curve that no page has requested for longest is dropped.
#
# Given up: to push changes to pages, and to follow the values of nodes instead of the file (ADR 0061).

from __future__ import annotations

import math
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from ..api.attaching import attach
from ..api.result import Result
from ..api.run_handle import Run
from ..errors import DeadlineExceeded, FmuMeshError, Interrupted, MeshLost
from ..pictures.system_graph import SystemGraph, graph_of_infos
from ..system.defect import Defect
from ..variables.value_types import element_names
from ..wire.views import InstanceInfo, InstanceStatus, LogLine, MeshInfo, MeshStatus, VariableView
from .curve import BoundedCurve, CurveChange, Looks
from .result_source import ResultSource

__all__ = ["MOST_CURVES", "Catalogue", "CurveQuestion", "MeshFollower", "MeshView"]

MOST_CURVES: Final = 64
"""Variables whose history is kept for one mesh; beyond it, that of the one that no page has asked for longest goes."""
_STATUS_S: Final = 0.25
"""Time between two looks at the status, in s: it is published four times a second."""
_SAMPLE_S: Final = 0.05
"""Time between two looks for new values while the mesh runs, in s."""
_AGAIN_S: Final = 1.0
"""Time until a mesh that has ended is looked for again, and how long the report of its failure may take, in s."""
_CLOSED_S: Final = 10.0
"""How long a run may take after its end to close its result file, in s."""
_ASKED_S: Final = 10.0
"""A value that is in no result file is asked for this long after the last page has shown it."""
_LOG_LINES: Final = 500
_CONSTANT: Final = ("constant", "fixed")


class Catalogue(NamedTuple):
    """The variables of a mesh.

    Attributes:
        variables: all of them by `instance.variable`.
        elements: what can be drawn: of each number and each element of an array its variable, and which element it is.
        settable: the unconnected inputs and the tunable parameters.
        graph: instances and connections, without their state.
    """

    variables: Mapping[str, VariableView]
    elements: Mapping[str, tuple[str, int]]
    settable: Mapping[str, VariableView]
    graph: SystemGraph


class MeshView(msgspec.Struct, frozen=True):
    """What is known of a mesh at one moment.

    Attributes:
        info: None before it was reached.
        status: the newest one; after the end the last one.
        before: the ``instances`` of the look before, for rates.
        infos: what the instances are, in the order of the mesh.
        trouble: why it is not reached.
        failure: why the run failed; None if it did not, or goes on.
        defects: those of the newest status; of a run that has ended, those in its result file if that is here.
        run: counts the runs of a mesh of this name that were seen.
    """

    key: str
    info: MeshInfo | None = None
    status: MeshStatus | None = None
    instances: Mapping[str, InstanceStatus] = {}
    before: Mapping[str, InstanceStatus] = {}
    infos: Mapping[str, InstanceInfo] = {}
    catalogue: Catalogue = Catalogue({}, {}, {}, SystemGraph("", (), ()))
    ended: bool = False
    trouble: str | None = None
    failure: str | None = None
    defects: Mapping[str, Defect] = {}
    run: int = 0


class CurveQuestion(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a page asks.

    Attributes:
        run: that of the `MeshView` that the page shows.
        curves: of each variable the version that it has drawn.
        span: the last so many seconds; 0: from the start on.
    """

    mesh: str
    run: int
    curves: dict[str, int]
    span: int = 0


class MeshFollower:
    """Follows a mesh, also through its end and its next run, until it is closed."""

    def __init__(self, key: str, reach: Mapping[str, Any]) -> None:
        self._key = key
        self._reach = reach
        self._lock = threading.Lock()
        self._view = MeshView(key)
        self._run: Run | None = None
        self._curves: OrderedDict[str, BoundedCurve] = OrderedDict()
        self._asked: dict[str, float] = {}
        self._log: deque[LogLine] = deque(maxlen=_LOG_LINES)
        self._drawing = threading.Lock()
        self._drawn: tuple[tuple[object, ...], str] | None = None
        self._sampler: threading.Thread | None = None
        self._next_run = threading.Event()
        self._closing = threading.Event()
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._live, name=f"follow {key}", daemon=True)
        self._thread.start()

    @property
    def view(self) -> MeshView:
        """What is known now."""
        return self._view

    def picture(self) -> str:
        """The SVG of the graph with the state and the speed of each instance, and with defects; pages share it."""
        view = self._view
        drawn_of = view.run, view.instances, view.defects
        with self._drawing:
            if self._drawn is None or self._drawn[0] != drawn_of:
                graph = view.catalogue.graph.with_status(view.instances, view.before, view.defects)
                self._drawn = drawn_of, graph.svg()
            return self._drawn[1]

    @property
    def log(self) -> list[LogLine]:
        """The newest 500 log messages, the oldest first."""
        with self._lock:
            return list(self._log)

    def changes(self, question: CurveQuestion) -> dict[str, CurveChange]:
        """What has changed in curves since a page has drawn them; from now on they are kept."""
        view, now = self._view, time.monotonic()
        if view.info is None:
            return {}
        known, answer = view.catalogue.elements, {}
        with self._lock:
            for name, version in list(question.curves.items())[:MOST_CURVES]:
                if name not in known:
                    continue
                curve = self._curves.get(name)
                if curve is None:
                    curve = self._curves[name] = BoundedCurve(view.info.start_time, view.info.step_size)
                    self._wake.set()
                self._curves.move_to_end(name)
                self._asked[name] = now
                change = curve.since(version if question.run == view.run else 0, question.span)
                if change.at or change.whole:
                    answer[name] = change
            while len(self._curves) > MOST_CURVES:
                oldest, _ = self._curves.popitem(last=False)
                self._asked.pop(oldest, None)
        return answer

    def ask(self, question: Callable[[Run], object]) -> object:
        """Ask the mesh itself, such as for a value, or to set one; waits for the answer.

        Raises:
            FmuMeshError: it refuses, does not answer in time, or does not run.
        """
        run = self._run
        if run is None:
            raise MeshLost(f"mesh '{self._key}' does not run")
        return question(run)

    def close(self) -> None:
        """End the threads and let go of the mesh."""
        self._closing.set()
        self._wake.set()
        self._thread.join()
        self._stop_sampling()

    # --- on the thread of the mesh

    def _live(self) -> None:
        while not self._closing.is_set():
            try:
                with attach(self._key, **self._reach) as run:
                    self._follow(run)
            except FmuMeshError as error:
                ended = self._view.ended or self._view.info is not None
                self._change(trouble=None if ended else str(error), ended=ended)
            finally:
                self._run = None
            self._closing.wait(_AGAIN_S)

    def _follow(self, run: Run) -> None:
        info = run.info()
        with run.until_end(self._wake.set) as ended:
            infos = {name: run.instance_info(name) for name in info.instances}
            before, catalogue = self._view, _catalogue_of(info.mesh, infos)
            self._stop_sampling()  # or that of the run before would add values to the curves of this one
            with self._lock:
                same = before.status is None or before.status.resets == run.status.resets
                if before.info is None or before.info.run != info.run or not same:
                    self._curves.clear()
                    self._log.clear()
                    before = MeshView(self._key, run=before.run + 1)
                self._view = msgspec.structs.replace(
                    before, info=info, infos=infos, catalogue=catalogue, ended=False, trouble=None
                )
            self._run = run
            sampler = self._sampler = threading.Thread(
                target=self._sample, args=(run, info, ended), name="sample", daemon=True
            )
            logger = threading.Thread(target=self._read_log, args=(run,), name="log", daemon=True)
            for thread in (sampler, logger):
                thread.start()
            with suppress(FmuMeshError):
                run.wait(0.0)  # from now on the handle knows how the run ends
            try:
                while not (ended.is_set() or self._closing.is_set()):
                    if not self._look(run):
                        return
                    ended.wait(_STATUS_S)
            finally:
                if not self._closing.is_set():
                    last = {
                        name: msgspec.structs.replace(
                            own, state=own.state if own.state in ("done", "failed") else "ended", activity=""
                        )
                        for name, own in self._view.instances.items()
                    }
                    self._change(ended=True, failure=_failure(run), instances=last, before=last)
                self._run = None
        # The thread of the log ends with the mesh, or with the session that `attach` closes.

    def _stop_sampling(self) -> None:
        """End the thread that reads the result file of the run before."""
        if self._sampler is not None:
            self._next_run.set()
            self._wake.set()
            self._sampler.join()
            self._next_run.clear()

    def _look(self, run: Run) -> bool:
        """Look at all states; False: the mesh was reset, so that it is to be followed anew."""
        try:
            status, instances = run.all_status()
        except FmuMeshError as error:
            self._change(trouble=str(error))
            return True
        before = self._view
        if before.status is not None and before.status.resets != status.resets:
            return False
        # Rates are those of about a second: in a shorter time an instance may take no step at all.
        old = before.instances if _is_a_second(before.before, before.instances) else before.before
        self._change(status=status, instances=instances, before=old, trouble=None, defects=status.defects)
        return True

    def _change(self, **fields: object) -> None:
        with self._lock:
            self._view = msgspec.structs.replace(self._view, **fields)

    def _read_log(self, run: Run) -> None:
        try:
            for line in run.logs(follow=True):
                with self._lock:
                    self._log.append(line)
                if self._closing.is_set():
                    return
        except FmuMeshError:
            return  # it has ended

    # --- on the thread of the samples

    def _sample(self, run: Run, info: MeshInfo, ended: threading.Event) -> None:
        path = Path(info.result_file) if info.result_file is not None and info.is_here else None
        source, looks, until = ResultSource(path), Looks(_SAMPLE_S), math.inf
        try:
            while not (self._closing.is_set() or self._next_run.is_set()):
                over = ended.is_set()
                if over:  # a page may still choose other curves
                    if source.replaced:
                        return
                    source.read_all(self._held)
                    until = min(until, time.monotonic() + _CLOSED_S)
                    # Before, the newest status could still replace those of the file.
                    has_any = self._view.ended and self._view.defects
                    if has_any and time.monotonic() < until and (defects := _defects_in(path)):
                        until = 0.0
                        self._change(defects=defects)
                else:
                    source.read(self._held, self._forget)
                    self._ask_for_values(run, source.names, looks)
                self._wake.wait(_STATUS_S if over else _SAMPLE_S)
                self._wake.clear()
        finally:
            source.close()

    def _held(self) -> dict[str, BoundedCurve]:
        with self._lock:
            return dict(self._curves)

    def _forget(self) -> None:
        """The file has been replaced: what was read is of another run."""
        with self._lock:
            for name in self._curves:
                info = self._view.info
                assert info is not None  # it was there before there were samples
                self._curves[name] = BoundedCurve(info.start_time, info.step_size)

    def _ask_for_values(self, run: Run, in_file: Sequence[str], looks: Looks) -> None:
        """Ask for the values that are in no file and on a page."""
        now = time.monotonic()
        looks.begin(now)
        with self._lock:
            names = [n for n in self._curves if n not in in_file and now - self._asked.get(n, 0.0) < _ASKED_S]
        for name in names:
            try:
                variable, number = self._view.catalogue.elements[name]
                sample = run.samples(variable)[0]
                value = float(np.asarray(sample.value, float).reshape(-1)[number])
            except (FmuMeshError, ValueError, TypeError, LookupError):
                continue  # it has ended, or the value is no number
            own = self._view.catalogue.variables[variable]
            # Of two points of the instance none lies between them, and what cannot change was known all the time.
            step = self._view.infos[name.partition(".")[0]].step_size if own.variability not in _CONSTANT else np.inf
            after = looks.after(name, time.monotonic(), sample.time, step)
            with self._lock:
                if (curve := self._curves.get(name)) is not None:
                    curve.add(np.array([sample.time]), np.array([value]), after)
            if self._closing.is_set():
                return


def _failure(run: Run) -> str | None:
    """Why a run has failed that is at its end."""
    try:
        run.wait(_AGAIN_S)
    except FmuMeshError as error:
        return None if isinstance(error, DeadlineExceeded | Interrupted) else str(error)
    return None


def _defects_in(path: Path | None) -> Mapping[str, Defect]:
    """Those of a whole run, which its file has when it is closed."""
    try:
        return Result("", file=path).defects
    except FmuMeshError:
        return {}


def _catalogue_of(mesh: str, infos: Mapping[str, InstanceInfo]) -> Catalogue:
    variables = {f"{name}.{v.name}": v for name, info in infos.items() for v in info.variables}
    elements = {
        f"{name.partition('.')[0]}.{element}": (name, number)
        for name, v in variables.items()
        if v.type not in ("String", "Binary")
        for number, element in enumerate(element_names(v.name, v.shape))
    }
    settable = {name: v for name, v in variables.items() if v.settable}
    return Catalogue(variables, elements, settable, graph_of_infos(mesh, [*infos.values()]))


def _is_a_second(old: Mapping[str, InstanceStatus], new: Mapping[str, InstanceStatus]) -> bool:
    """Whether the newest of two looks is a second later."""
    return not old or any(
        own.running_time - old[name].running_time >= 1.0 or own.running_time < old[name].running_time
        for name, own in new.items()
        if name in old
    )
