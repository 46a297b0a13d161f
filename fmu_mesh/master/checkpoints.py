"""Checkpoints: the nodes stand at one point while they save their states, and who has asked for them gets the file.

Owns the states that have come so far and the commands that wait for them. `MasterStates` holds the grant meanwhile.
"""

# All of it runs on the main thread of the master. What may go wrong: a node does not answer (its process is gone, and
# the run ends; or a message is lost, and after the deadline the run goes on without a checkpoint), an instance cannot
# write its state, another command comes meanwhile, or an FMU ends the simulation before that point. In each case the
# grant goes on, and who has asked is told why.
# A state that comes too late has another point than the present checkpoint, and is dropped (ADR 90).

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress

import zenoh

from ..errors import (
    CallRefused,
    ConfigurationError,
    DeadlineExceeded,
    FmuMeshError,
    MeshLost,
    MessageRefused,
    from_report,
)
from ..system.played_nodes import stateless
from ..wire.messages import MAX_STATES_SIZE, InstanceState, decode_state
from ..wire.refusals import Refusals
from .master_states import MasterStates
from .mesh_server import MasterSettings
from .registrations import spoken

__all__ = ["Checkpoints"]

log = logging.getLogger(__name__)

_WAIT_S = 5.0
"""How long a command waits that does not say how long."""

_LEAST_TIMES = 50
"""So many times as long as a checkpoint has taken, there is no other one: they cost 2 % of the time at most."""


class Checkpoints:
    """The checkpoints of one run.

    Args:
        mesh: its name.
        withdraw: takes the grant back; see `MasterStates.command`.
    """

    def __init__(
        self,
        mesh: str,
        states: MasterStates,
        withdraw: Callable[[], int],
        settings: MasterSettings,
        refusals: Refusals,
    ) -> None:
        self._mesh = f"mesh '{mesh}'"
        self._states = states
        self._withdraw, self._settings, self._refusals = withdraw, settings, refusals
        self._every_s = settings.checkpoint_s
        self._saving = {item.name for node in states.plan.nodes.values() if node.saves for item in node.instances}
        self._due_at = self._every_s if self._every_s is not None else math.inf
        self._now = 0.0
        self._waiting: list[tuple[zenoh.Query, float]] = []
        self._found: dict[str, InstanceState] = {}
        self._came: dict[str, bytearray] = {}
        self._stands_since: float | None = None
        self._complete: tuple[int, Mapping[str, bytes]] | None = None

    def ask(self, query: zenoh.Query, wait_s: float, now: float) -> None:
        """Answer a query with the file of a checkpoint, or why there is none; in ``wait_s`` seconds, 0: in 5 s."""
        for name, why in stateless(self._states.plan.system).items():  # a restart does without
            self._answer(CallRefused(f"its state cannot be written to a file: {why}.", instance=name), [query])
            return
        try:
            if self._states.saves_at is None:
                self._begin()
            self._waiting.append((query, now + (wait_s or _WAIT_S)))
        except CallRefused as refused:
            self._answer(refused, [query])

    def _begin(self) -> None:
        self._found.clear()
        self._came.clear()
        self._stands_since, states = None, self._states
        every = math.lcm(*(own.step_points for own in states.plan.system.instances.values()))
        if not states.save(self._withdraw(), every):
            last, hold = states.granting.last_point, states.hold
            where = f"{self._mesh} {f'pauses at point {hold}' if hold is not None else f'ends at point {last}'}"
            text = f"{where}, and all instances have a point of their own only at every {every}th point"
            raise CallRefused(text, hint=f"`step` it by {-hold % every}." if hold is not None else None)

    def take(self, node: str, point: int, data: bytes) -> None:
        """A node has sent the state of an instance, or a part of it.

        Raises:
            MessageRefused: it is none of its instances.
        """
        own = decode_state(data)
        if own.instance not in [item.name for item in self._states.plan.nodes[node].instances]:
            raise MessageRefused(f"'{own.instance}' is no instance of it")
        if point == self._states.saves_at:
            self._came.setdefault(own.instance, bytearray()).extend(own.state)
            if sum(map(len, self._came.values())) > MAX_STATES_SIZE:
                error = CallRefused(
                    f"with its state, all take more than {MAX_STATES_SIZE} bytes", instance=own.instance
                )
                own = InstanceState(own.instance, error=error.report())
            if not own.more:
                self._found[own.instance] = own

    def settle(self, now: float) -> None:
        """Go on if all states are there, or if there will be no checkpoint."""
        states, at, found, self._now = self._states, self._states.saves_at, self._found, now
        if at is None:
            if now >= self._due_at and states.state == "running" and not states.is_replaying:
                self._due_at = now + (self._every_s or 0.0)
                with suppress(CallRefused):  # the run is about to pause, or to end
                    self._begin()
            return
        if self._stands_since is None and states.granting.reached >= at:
            self._stands_since = now
        missing = self._saving - found.keys()
        failed = [own.error for own in found.values() if own.error is not None]
        limit_s = states.deadlines.silence
        if not states.takes_commands or states.ended_by is not None:  # then nobody may come to that point
            state = states.state if states.ended_by is None else "ending"
            self.give_up(MeshLost(f"{self._mesh} is {state}, and there is no checkpoint any more"))
        elif failed:
            self.give_up(from_report(failed[0]))
        elif not missing:
            states.saved()
            if self._every_s is not None:
                took_s = now - (self._stands_since if self._stands_since is not None else now)
                self._due_at = now + max(self._every_s, _LEAST_TIMES * took_s)
            self._complete = (
                at,
                {name: bytes(self._came.pop(name)) for name in states.plan.system.instances if name in found},
            )
        elif now - (self._stands_since if self._stands_since is not None else math.inf) > limit_s:
            nodes = sorted({states.plan.node_of(name) for name in missing})
            text = f"the states of {spoken(*nodes)} at point {at} have not come within {limit_s:g} s"
            self.give_up(DeadlineExceeded(f"{text}; the run goes on without a checkpoint"))
        else:
            self._refuse_late(at, now)

    def answer(self) -> None:
        """When the nodes go on: answer those who have waited for a checkpoint that is complete."""
        if self._complete is not None:
            point, states = self._complete
            data, self._complete = self._settings.as_file(point, states), None
            if self._every_s is not None:
                self._keep(point, data)
            self._answer(data, [query for query, _ in self._waiting])
            self._waiting.clear()

    def _keep(self, point: int, data: bytes) -> None:
        try:
            self._settings.keep(point, data)
        except ConfigurationError as error:  # such as on a full disk; an older one may be there
            self._due_at = math.inf
            log.warning("there are no more checkpoints: %s", error)

    def give_up(self, error: FmuMeshError) -> None:
        """There is no checkpoint, and why; nothing happens if none is under way."""
        self._came.clear()
        if self._states.saves_at is not None:
            self._states.saved()
            if self._every_s is not None:
                self._due_at = self._now + _LEAST_TIMES * self._every_s
        self._answer(error, [query for query, _ in self._waiting])
        self._waiting.clear()

    def _refuse_late(self, at: int, now: float) -> None:
        late = [query for query, until in self._waiting if now >= until]
        if late:
            where = f"{self._mesh} is at point {self._states.granting.reached}, on its way to point {at}"
            text = f"{where}, where it saves its states"
            self._answer(DeadlineExceeded(f"{text}.", hint="A larger `timeout=...` waits longer."), late)
            self._waiting = [own for own in self._waiting if own[0] not in late]
            if not self._waiting and self._every_s is None:
                self._states.saved()

    def _answer(self, answer: bytes | FmuMeshError, queries: Iterable[zenoh.Query]) -> None:
        for query in queries:
            with self._refusals.guard(str(query.key_expr)):  # the client may be gone
                if isinstance(answer, bytes):
                    query.reply(query.key_expr, answer, encoding=zenoh.Encoding.APPLICATION_OCTET_STREAM)
                else:
                    query.reply_err(str(answer))
                query.drop()
