"""What a node is doing right now: the source of `status`, and the check for steps that do not return."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator, Mapping, Sequence

from ..awake import AwakeClock
from ..errors import FmuMeshError, Interrupted, MeshLost, StepFailed
from ..instances.call_guard import not_returned
from ..system.attempt import Attempt
from ..system.plan import NodePlan
from ..wire.refusals import Refusals
from ..wire.solved_loop import SolvedLoop
from ..wire.stream_keeper import StreamKeeper
from ..wire.views import WAITING, InstanceStatus, LogLine
from ..wire.ways import Ways
from .engine import Engine
from .inputs import TimedInputs
from .key_ends import KeyEnds
from .stepping import Runner

__all__ = ["Activity"]

# Threads: the main thread writes `state`, `runners` and the engine, each in one assignment; the server thread reads
# them, and the tables of the engine, while a step is under way. Nothing here takes a lock but `engine.sending`: a
# thread that answers `status` must never wait for one that is inside an FMU (ADR 12). So an answer takes the step of
# a runner once and derives all else from it: the main thread goes on meanwhile.

log = logging.getLogger(__name__)


class Activity:
    """What one node is doing."""

    def __init__(self, plan: NodePlan, refusals: Refusals) -> None:
        self.state = "starting"
        self.runners: Mapping[str, Runner] = {}
        self.ways: Ways | None = None
        self.loops: Sequence[SolvedLoop] = ()
        self._plan = plan
        self._refusals = refusals
        self._started = 0.0
        self._clock = AwakeClock()
        self._engine: Engine | None = None
        self._keeper: StreamKeeper | None = None
        self._keys: KeyEnds | None = None
        self._attempt = plan.attempt
        self._under_way: tuple[str, int, float] | None = None
        self._waits: dict[str, tuple[int, float, bool]] = {}  # own step, since when, whether it was told

    def enter(self, state: str) -> None:
        """From now on the node is in this state."""
        self.state = state

    def serve(self, runners: Mapping[str, Runner], keys: KeyEnds, attempt: Attempt) -> None:
        """All instances are loaded; these are the keys at ends of their connections, in this attempt of the run."""
        self.runners, self._keys, self._attempt = runners, keys, attempt

    def steps_with(self, engine: Engine, ways: Ways, keeper: StreamKeeper | None, loops: Sequence[SolvedLoop]) -> None:
        """The instances are at their first point; the keeper is that of row streams, and the loops have been solved."""
        self.ways, self._keeper, self.loops = ways, keeper, loops
        self._started = time.monotonic()
        self._engine = engine

    def status(self, name: str) -> InstanceStatus:
        """What `status` answers for an instance of this process."""
        runner = self.runners.get(name)
        # The main thread continues meanwhile: all values of an answer must belong to one point.
        step, points = (runner.step, runner.plan.step_points) if runner is not None else (0, 1)
        instance, engine, step_time = runner.instance if runner is not None else None, self._engine, 0.0
        own = instance.late if isinstance(instance, TimedInputs) else {}
        late = {variable: at * points for variable, at in own.items()}
        if engine is not None and step:
            spent = zip(engine.units, engine.spent_s, strict=True)
            step_time = next(spent_s for unit, spent_s in spent if runner in unit) / step
        return InstanceStatus(
            instance=name,
            state=self.state,
            activity=self._in_words(runner, late) if runner is not None and self.state == "running" else self.state,
            point=step * points,
            time=self._plan.grid.time(step * points),
            step_time=step_time,
            wait_time=engine.waited_s if engine is not None else 0.0,
            restarts=self._attempt.number - 1,
            refused=self._refusals.count,
            timed_out=late,
            running_time=time.monotonic() - self._started if engine is not None else 0.0,
            keys=self._keys.statuses(name) if self._keys is not None else (),
            deploy_host=self._plan.host or "",
            failed=runner.failed if runner is not None else "",
        )

    def as_others_see(self, error: FmuMeshError) -> FmuMeshError:
        """The error as other processes see it: if a signal ends this process, for them this node is lost."""
        if not isinstance(error, Interrupted):
            return error
        point = min((runner.point for runner in self.runners.values()), default=0)
        return MeshLost(
            f"node '{self._plan.node}' was lost: its process was told to end ({error.message})",
            instance=", ".join(item.name for item in self._plan.instances),
            point=point,
            time=self._plan.grid.time(point),
        )

    def look_at_steps(self) -> StepFailed | None:
        """Look at the running step; return an error if it has not returned within the time limit.

        The burst ends after this step. If the step takes longer than the time between two looks, the rows before it are
        sent: other nodes may wait for them, and they must not be lost if this process dies. Other calls of an FMU are
        watched by `fmu_mesh.instances.call_guard.CallWatch`.
        """
        engine, now = self._engine, self._clock()
        if engine is None or self.state != "running" or (runner := engine.current) is None or runner.awaited:
            self._under_way = None
            return None
        under_way_s = now - self._since(runner, now)
        if under_way_s > 0.0:
            try:
                with engine.sending:
                    engine.send()
            except FmuMeshError as unreachable:  # the main thread will get the same error
                log.info("rows_not_sent", extra={"error": str(unreachable)})
        else:
            engine.ring_bell()
        if under_way_s <= self._plan.timeouts.step:
            return None
        return StepFailed(
            not_returned(threading.main_thread().ident or 0, under_way_s, runner.doing),
            instance=runner.name,
            point=runner.point,
            time=self._plan.grid.time(runner.point),
            hint="If it needs that long, raise `timeouts.step` in the configuration.",
        )

    def look_at_waits(self) -> Iterator[LogLine]:
        """What instances wait for: a row or a value of a key, for a third of `timeouts.step`; once for each wait.

        Call it several times a second, on one thread. Who waits for the grant of the master, as in a pause, is quiet.
        """
        engine, now = self._engine, self._clock()
        for name, runner in self.runners.items() if engine is not None and self.state == "running" else ():
            step, points = runner.step, runner.plan.step_points
            own, since, told = self._waits.get(name, (-1, now, False))
            may_step = engine is not None and (step + 1) * points <= engine.granted
            what = self._waits_for(runner) if may_step else None
            if what is None or own != step:
                since, told = now, False
            elif not told and now - since > self._plan.timeouts.step / 3:
                told = True
                yield LogLine(name, *WAITING, f"it has waited {now - since:.3g} s for {what}", step * points)
            self._waits[name] = step, since, told

    def _waits_for(self, runner: Runner) -> str | None:
        """In words the row or the value of a key that the next step waits for; None: it has all of them."""
        if any(runner.lacking):
            return runner.waits_for
        key = self._keys.waits_for(runner.name) if self._keys is not None else None
        return f"a value of {key}" if key is not None else None

    def _in_words(self, runner: Runner, late: Mapping[str, int]) -> str:
        if runner.failed:
            return f"its outputs are {runner.failed}"
        if late:
            without = (f"no value for '{name}' since point {point}" for name, point in late.items())
            return "; ".join((self._in_words(runner, {}), *without))
        if awaited := runner.awaited:
            return f"waiting at point {runner.point} for {awaited}"
        current = self._engine.current if self._engine is not None else None
        if current is None:
            cut = self._keeper.cut_in_words(self._plan.node) if self._keeper is not None else ()
            what = self._waits_for(runner) or runner.waits_for
            return "; ".join((f"waiting at point {runner.point} for {what}", *cut))
        if current is not runner:
            return f"waiting at point {runner.point} for its turn: '{current.name}' is in doStep"
        now = self._clock()
        return f"in doStep at point {runner.point} for {now - self._since(runner, now):.1f} s"

    def _since(self, runner: Runner, now: float) -> float:
        """When this thread first saw the running step of a runner; the stepping loop measures no time for this."""
        if self._under_way is None or self._under_way[:2] != (runner.name, runner.step):
            self._under_way = (runner.name, runner.step, now)
        return self._under_way[2]
