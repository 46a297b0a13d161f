"""Commands whose answer waits until the mesh rests where they let it pause, or until that cannot happen any more."""

from __future__ import annotations

from collections.abc import Callable

import zenoh
from msgspec.structs import replace

from ..errors import DeadlineExceeded, FmuMeshError, MeshLost, from_report
from ..system.plan import RECORDER
from ..wire.views import CommandAnswer
from .master_states import MasterStates
from .registrations import spoken

__all__ = ["Resting"]

_MOST_WAITING = 1024


class Resting:
    """The commands that wait; ``reply`` answers one. Times are those of `MasterStates.decide`."""

    def __init__(self, mesh: str, states: MasterStates, reply: Callable[[zenoh.Query, CommandAnswer], None]) -> None:
        self._mesh = f"mesh '{mesh}'"
        self._states = states
        self._reply = reply
        self._waiting: list[tuple[zenoh.Query, CommandAnswer, float]] = []

    def add(self, query: zenoh.Query, answer: CommandAnswer, until: float) -> None:
        """The answer to a command waits, ``until`` this time or shortly after; at once if too many wait already."""
        self._waiting.append((query, answer, until if len(self._waiting) < _MOST_WAITING else 0.0))

    def settle(self, now: float) -> None:
        """Answer the commands that do not wait any more."""
        waiting, self._waiting = self._waiting, []
        for query, answer, until in waiting:
            states, point = self._states, self._states.granting.slowest
            rests = answer.hold is None or point >= answer.hold
            error = None if rests else self._error(answer.hold or 0, late=now >= until)
            if rests or error is not None:
                report = error.report() if error is not None else None
                self._reply(query, replace(answer, state=states.state, point=point, error=report))
            else:
                self._waiting.append((query, answer, until))

    def _error(self, goal: int, *, late: bool) -> FmuMeshError | None:
        """Why the mesh does not come to rest at this point, or not in time; None while it may."""
        states, granting, mesh = self._states, self._states.granting, self._mesh
        if states.failure is not None:
            error = from_report(states.failure.report())  # not the exception that the run itself raises
            return error.saying(f"{mesh} has failed and does not come to rest: {error.message}")
        if states.state != "paused":
            return MeshLost(f"{mesh} is {states.state} at point {granting.slowest}, and does not come to rest any more")
        if states.hold is not None and states.hold < goal:
            text = f"{mesh} pauses at point {states.hold}, before point {goal}: another program controls it too"
            return MeshLost(text)
        if not late:  # also after `stop` (hold None), until all have come to the last point
            return None
        nodes = [node for node in granting.progress if node != RECORDER]
        slowest = min(nodes, key=granting.progress.__getitem__)
        if granting.progress[slowest] >= goal:
            slowest = RECORDER
        text = f"{mesh} is at point {granting.slowest}, on its way to point {goal}, where it is going to rest"
        text += f"; {spoken(slowest)} is at point {granting.progress[slowest]}"
        if granting.grant < min(goal, granting.last_point) and not granting.is_led:
            text += f", and the wall clock allows point {granting.grant}"
        return DeadlineExceeded(f"{text}.", hint="A larger `timeout=...` waits longer.")
