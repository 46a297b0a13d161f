"""What a node is doing right now: the source of `status`, and the check for steps that do not return.

The main thread only writes a few attributes; the server thread reads them and the points of the instances.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping

from ..errors import FmuMeshError, StepFailed
from ..instances.call_guard import doing, not_returned
from ..system.plan import NodePlan
from ..wire.refusals import Refusals
from ..wire.views import InstanceStatus
from .engine import Engine
from .stepping import Runner

__all__ = ["Activity"]

log = logging.getLogger(__name__)


class Activity:
    """What one node is doing.

    Attributes:
        state: in one or two words, for `status`.
        runners: the instances, once all are loaded.

    Args:
        plan: the node's plan.
        refusals: counts the messages that its process refused.
    """

    def __init__(self, plan: NodePlan, refusals: Refusals) -> None:
        self.state = "starting"
        self.runners: Mapping[str, Runner] = {}
        self._plan = plan
        self._refusals = refusals
        self._started: float | None = None
        self._engine: Engine | None = None
        self._under_way: tuple[str, int, float] | None = None

    def enter(self, state: str) -> None:
        """From now on the node is in this state."""
        self.state = state

    def serve(self, runners: Mapping[str, Runner]) -> None:
        """All instances are loaded."""
        self.runners = runners

    def steps_with(self, engine: Engine) -> None:
        """The engine of this node, once there is one."""
        self._engine = engine

    def started(self) -> None:
        """The instances are at their first point."""
        self._started = time.monotonic()

    def status(self, name: str) -> InstanceStatus:
        """What `status` answers for an instance of this process."""
        runner = self.runners.get(name)
        if runner is None:
            start = self._plan.grid.time(0)
            return InstanceStatus(
                name,
                self.state,
                self.state,
                0,
                start,
                0.0,
                0.0,
                restarts=self._plan.restarts,
                refused=self._refusals.count,
            )
        step = runner.step  # the main thread continues meanwhile: all values of an answer must belong to one point
        point = step * runner.plan.step_points
        return InstanceStatus(
            instance=name,
            state=self.state,
            activity=self._in_words(runner),
            point=point,
            time=self._plan.grid.time(point),
            step_time=self._spent_s(runner) / step if step else 0.0,
            wait_time=self._engine.waited_s if self._engine is not None else 0.0,
            restarts=self._plan.restarts,
            refused=self._refusals.count,
            running_time=time.monotonic() - self._started if self._started is not None else 0.0,
        )

    def look_at_steps(self, now: float) -> StepFailed | None:
        """Look at the running step; return an error if it has not returned within the time limit.

        The burst ends after this step. If the step takes longer than the time between two looks, the rows before it are
        sent: other nodes may wait for them, and they must not be lost if this process dies. Other calls of an FMU are
        watched by `fmu_mesh.instances.call_guard.CallWatch`.
        """
        engine = self._engine
        if engine is None or self.state != "running" or (runner := engine.current) is None:
            self._under_way = None
            return None
        under_way_s = now - self._since(runner, now)
        if under_way_s > 0.0:
            with engine.sending:
                self._send()
        else:
            engine.ring_bell()
        if under_way_s <= self._plan.timeouts.step:
            return None
        return StepFailed(
            not_returned(threading.main_thread().ident or 0, under_way_s, doing(runner.stage)),
            instance=runner.name,
            point=runner.point,
            time=self._plan.grid.time(runner.point),
            hint="If it needs that long, raise `timeouts.step` in the configuration.",
        )

    def _send(self) -> None:
        try:
            for runner in self.runners.values():
                runner.flush()
        except FmuMeshError as unreachable:  # the main thread will get the same error
            log.info("rows_not_sent", extra={"error": str(unreachable)})

    def _in_words(self, runner: Runner) -> str:
        if self.state != "running":
            return self.state
        current = self._engine.current if self._engine is not None else None
        if current is None:
            return f"waiting at point {runner.point} for {runner.waits_for}"
        if current is not runner:
            return f"waiting at point {runner.point} for its turn: '{current.name}' is in doStep"
        now = time.monotonic()
        return f"in doStep at point {runner.point} for {now - self._since(runner, now):.1f} s"

    def _spent_s(self, runner: Runner) -> float:
        """How long the unit of a runner was stepped, in s."""
        engine = self._engine
        if engine is None:
            return 0.0
        return next(spent for unit, spent in zip(engine.units, engine.spent_s, strict=True) if runner in unit)

    def _since(self, runner: Runner, now: float) -> float:
        """When this thread first saw the running step of a runner; the stepping loop measures no time for this."""
        if self._under_way is None or self._under_way[:2] != (runner.name, runner.step):
            self._under_way = (runner.name, runner.step, now)
        return self._under_way[2]
