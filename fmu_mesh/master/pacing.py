"""The pace of a run: its wall-clock time, how far real time and slow instances limit the grant, and what did."""

from __future__ import annotations

import math
import time

from ..system.plan import Plan

__all__ = ["CLOCK", "PAUSE", "GrantWatch", "Pacer", "Reach", "RunClock"]

CLOCK = "@clock"
"""Name of what limits the grant if the run follows the wall clock."""

PAUSE = "@pause"
"""Name of what limits the grant while the mesh is paused."""

_LATE = 4
"""After so many times of what a grant should take, fewer points are granted. TCP begins slowly, too."""
_TICK_S = 1e-6


class RunClock:
    """Wall-clock time since the first point, without pauses."""

    def __init__(self) -> None:
        self._before = 0.0
        self._since: float | None = None

    def start(self) -> None:
        """Start, or continue after a pause."""
        if self._since is None:
            self._since = time.perf_counter()

    def stop(self) -> None:
        """Stop until `start` is called again."""
        self._before = self.elapsed()
        self._since = None

    def elapsed(self) -> float:
        """Seconds so far."""
        return self._before + (time.perf_counter() - self._since if self._since is not None else 0.0)


class Reach:
    """How many points a grant that cannot be taken back may be ahead of the slowest instance.

    A pause takes effect at such a grant. So it reaches as far as the nodes come in ``steady_s``, and in the time that a
    grant and the answer are on their way. It begins with one point, and is measured again each time the nodes have used
    it.

    Attributes:
        granted: the farthest point that a grant has reached so far.
    """

    def __init__(self, steady_s: float = 0.05, first: int = -1) -> None:
        self._steady_s = steady_s
        self._points = self._fresh = 1
        self._slowest = self.granted = self._mark = first
        self._since = 0.0
        self._shortest_s = math.inf

    def points(self, slowest: int, now: float, round_trip_s: float | None = None) -> int:
        """Number of points the grant may lead the slowest instance, at ``slowest``; ``now`` is monotonic, in s.

        Without a known round trip, it is at most the shortest time in which the nodes have used a grant.
        """
        elapsed_s = now - self._since
        if is_used := slowest >= self._mark:
            self._shortest_s = min(self._shortest_s, elapsed_s)
        if is_used or elapsed_s >= _LATE * (self._steady_s + (round_trip_s or 0.0)):
            gone, on_way_s = slowest - self._slowest, self._shortest_s if round_trip_s is None else round_trip_s
            passing = gone / max(elapsed_s, _TICK_S)
            # Who has used a far grant soon had waited for it, and steps faster than points have come.
            stepping_s = max(elapsed_s - (round_trip_s or 0.0), _TICK_S)
            waited = is_used and stepping_s < self._steady_s / 2
            speed = max(passing, self._fresh / stepping_s) if waited else passing
            wanted = speed * self._steady_s + passing * on_way_s
            least = 1 if is_used else self._points // 2  # what is late may be on its way
            self._points = max(1, least, math.ceil(wanted))
            self._slowest, self._since = slowest, now
            self._mark = max(self.granted + 1, slowest + self._points)  # nobody can be there before this round trip
            self._fresh = self._mark - self.granted
        self.granted = max(self.granted, slowest + self._points)
        return self._points


class Pacer:
    """Limits the grant to the points that are due by the wall clock; with a real-time factor of 0 there is no limit.

    The ``overruns`` are points by which the run fell behind the wall clock beyond `catch_up`.
    """

    def __init__(self, plan: Plan, real_time_factor: float) -> None:
        simulation = plan.system.config.simulation
        self.overruns = 0
        self._rate = real_time_factor / plan.grid.step_size
        self._paced = True
        self._period = simulation.update_period
        self._catch_up = simulation.catch_up
        self._origin = 0
        self._started = 0.0

    def start(self, point: int, *, paced: bool = True) -> None:
        """Note that ``point`` is due now; or there is no limit from now on, if the run is not ``paced``."""
        self._origin, self._paced = point, paced
        self._started = time.perf_counter()

    def limit(self, wanted: int, reached: int) -> tuple[int, float]:
        """The point that may be granted now, and the time until the next check in s; all are at ``reached``."""
        if self._rate <= 0 or not self._paced:
            return wanted, math.inf
        elapsed = time.perf_counter() - self._started
        elapsed -= self._give_up(self._origin + elapsed * self._rate - reached)
        update = math.floor(elapsed / self._period) * self._period if self._period else elapsed
        due = self._origin + update * self._rate
        allowed = math.floor(due) + 1
        if allowed >= wanted:
            return wanted, math.inf
        next_update = update + self._period if self._period else elapsed + (allowed - due) / self._rate
        return allowed, max(0.0005, next_update - elapsed)

    def _give_up(self, behind: float) -> float:
        """Move the schedule if the run is ``behind`` by too many points; return by how much, in s."""
        if self._catch_up is None:
            return 0.0
        lost = math.floor(behind - (self._catch_up + self._period) * self._rate) - 1  # one point is being computed
        if lost <= 0:
            return 0.0
        self.overruns += lost
        self._started += lost / self._rate
        return lost / self._rate


class GrantWatch:
    """Sums up how long each participant limited the grant; call `note` at every grant."""

    def __init__(self) -> None:
        self.held_s: dict[str, float] = {}
        self._holder: str | None = None
        self._since = 0.0

    def note(self, holder: str | None) -> None:
        """From now on ``holder`` limits the grant; None: the grant is the last point."""
        now = time.perf_counter()
        if self._holder is not None:
            self.held_s[self._holder] = self.held_s.get(self._holder, 0.0) + now - self._since
        self._holder, self._since = holder, now
