"""Zenoh keys that feed inputs: values of other programs, each at its point.

Owns when a value takes effect, and for which value a step waits. Payloads are `fmu_mesh.node.key_payloads`; how a step
gets its value is `fmu_mesh.node.inputs`, as for values that are set.
"""

# Threads: those of Zenoh, one for each link, call `arrived`, which counts a sample, puts it into a deque and posts
# `_take` once; `_lock` is theirs alone. The main thread calls `_take` between two steps, or `_take_newest` before one,
# and everything that changes an input. The thread of the server calls `look` and `status`, which read numbers that
# somebody else writes in one assignment.
#
# What may go wrong, and what then happens:
# * A flood. On arrival only the newest value counts, and a step asks for it, so few are decoded at a point; of values
#   with times `_MOST_WAITING` may wait, of `_MOST_BYTES` in all. What is more is counted and lost. The sender is never
#   held back: it may be a stranger. `_take` returns after `_MOST_AT_ONCE` values, so steps go on.
# * Silence. A step that waits ends with the deadline of a step. Else the input holds, or falls back (`timeout`).
# * A step must not wait inside an instance: the main thread would not see the end of the run. So a key that is waited
#   for limits the node as the window of another node does, by a counter that only the main thread raises.

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from threading import Lock
from typing import Any, Final

import zenoh
import zenoh.ext
from msgspec.structs import asdict, replace

from ..errors import DeadlineExceeded, MeshLost
from ..rings.host_memory import Counter
from ..system.live_keys import KeyInput, KeyValue, key_views
from ..variables.value_conversion import to_plain
from ..wire.values import ValueRefused
from ..wire.views import KeyStatus, LogLine
from .inputs import TimedInputs, TooManyWait, set_input
from .key_payloads import KeyReader
from .stepping import Runner

__all__ = ["KeyFeed", "Patience"]

_MOST_WAITING: Final = 1 << 16
_NEWEST: Final = 16
"""On arrival, the newest values that wait for a step: it uses the newest one that is a value."""

_MOST_BYTES: Final = 1 << 27
_MOST_AT_ONCE: Final = 64
_MOST_BYTES_AT_ONCE: Final = 1 << 16


class Patience:
    """For how long a runner has been held at one point."""

    def __init__(self, runner: Runner) -> None:
        self._runner = runner
        self._since: tuple[int, float] | None = None

    def spent_s(self, most: int, granted: int, now: float) -> float:
        """The time in s; 0 if it may go on, which it may up to the points ``most`` and ``granted``; ``now`` is in s."""
        point = self._runner.point
        if min(point + 1, granted, self._runner.grid.last_point) <= most:
            self._since = None
        elif self._since is None or self._since[0] != point:
            self._since = point, now
        return now - self._since[1] if self._since is not None else 0.0


class KeyFeed:
    """One key for one variable.

    Args:
        counter: one more than the last point at which a step may begin, if steps wait for the key.
        post: lets the main thread do something, from any thread.
        log: publishes a log message; from any thread.
        tell: tells the recorder, if there is one, which values have come.

    Attributes:
        words: the key and its variable, for messages.
    """

    def __init__(  # noqa: PLR0913, PLR0917  one key and its surroundings
        self,
        own: KeyInput,
        runner: Runner,
        counter: Counter | None,
        post: Callable[..., None],
        log: Callable[[LogLine], None],
        tell: Callable[[Sequence[KeyValue]], None],
    ) -> None:
        variable = runner.instance.description.variable(own.variable)
        assert variable is not None  # the plan has it
        self.runner, self.counter = runner, counter
        self._name = f"{runner.name}.{own.variable}"
        self.words = f"'{own.key}', which feeds '{self._name}'"
        self._own, self._post, self._log, self._tell = own, post, log, tell
        self._reader = KeyReader(own, variable, finite=runner.plan.not_finite == "stop")
        self._only_newest = own.time == "arrival" and not own.wait
        self._waiting: deque[zenoh.Sample] = deque()
        assert isinstance(runner.instance, TimedInputs)  # `with_times`
        self._inputs = runner.instance
        if self._only_newest:
            self._inputs.ask(self._take_newest)
        self._posted = self._begun = False
        self._counts = KeyStatus(**asdict(key_views(runner.name, own)[0]))
        self._lock = Lock()
        self._received = self._replaced = self._lost = 0
        self._came_bytes = self._taken_bytes = 0  # each of them is written by one side only
        self._first_at = self._last_at = 0.0
        self._told: set[str] = set()
        self._shift: float | None = None  # simulation time minus that of the values
        self._newest: float | None = None
        self._used = self._tried = 0
        self._declared_at = time.monotonic()
        self._patience = Patience(runner)

    def arrived(self, sample: zenoh.Sample) -> None:
        """On a thread of Zenoh: each link has its own."""
        with self._lock:
            self._last_at = time.monotonic()
            self._first_at = self._first_at or self._last_at
            self._received += 1
            size = len(sample.payload)
            while self._only_newest and self._waiting and (len(self._waiting) >= _NEWEST or self._is_full(size)):
                self._came_bytes -= len(self._waiting.popleft().payload)
                self._replaced += 1
            if self._waiting and self._is_full(size):
                self._lost += 1
            else:
                self._came_bytes += size
                self._waiting.append(sample)
        self._post_take()

    def _is_full(self, size: int) -> bool:
        return self._came_bytes - self._taken_bytes + size > _MOST_BYTES or len(self._waiting) >= _MOST_WAITING

    def missed(self, miss: zenoh.ext.Miss) -> None:
        """On a thread of Zenoh: so many values of another mesh were lost on their way, and cannot be had again."""
        self._lost += miss.nb
        self._post_take()

    def _post_take(self, *, later: bool = False) -> None:
        if not self._posted:
            self._posted = True
            self._post(self._take, later=later)

    def begin(self) -> None:
        """At point 0: use what has come before."""
        self._begun = True
        self._take()

    def _take(self) -> None:
        """On the main thread, between two steps."""
        if not self._begun:
            return
        if self._only_newest:
            self._inputs.expect(self.runner.step)
            self.runner.follow_inputs()
            return
        self._use(self._some())
        if (self._lost or self._counts.lost) and "lost" not in self._told:
            why = f"is lost: {_MOST_WAITING} wait for their points, or the link was cut for too long"
            self._say("lost", f"{why}. More are only counted")
            if self._own.wait:
                hint = "Its publisher has to wait for this run."
                raise MeshLost(f"a value of {self.words} {why}", **self._place(), hint=hint)
        self._posted = False  # not before: each that arrives would end the next steps after one
        if self._waiting:
            self._post_take(later=True)

    def _take_newest(self) -> None:
        """On the main thread, at the begin of a step."""
        if not self._begun:  # after a restart: what came before is given again first
            return
        self._posted = False
        with self._lock:
            found = [*self._waiting]
            self._waiting.clear()
            self._came_bytes = 0
        self._use(reversed(found))  # what is no value does not replace one
        with self._lock:
            self._replaced += max(0, len(found) - self._tried)

    def _use(self, samples: Iterable[zenoh.Sample]) -> None:
        """Let values take effect, each at its time; on arrival, the first that is one."""
        values: list[KeyValue] = []
        at = self.runner.point
        self._tried = 0
        for sample in samples:
            self._tried += 1
            try:
                values.append(self._used_now(sample, at))
                if self._only_newest:
                    break
            except TooManyWait:
                self._counts = replace(self._counts, lost=self._counts.lost + 1)
            except ValueRefused as refused:
                self._counts = replace(self._counts, refused=self._counts.refused + 1)
                self._say("refused", f"is refused: {refused}. More are only counted in `status`")
        if values:
            self.runner.follow_inputs()
            self._let_step()
            self._tell(values)

    def _some(self) -> Iterator[zenoh.Sample]:
        """Some of those that wait, so that steps go on, and the recorder gets no message that is too large."""
        end = self._taken_bytes + _MOST_BYTES_AT_ONCE
        with suppress(IndexError):  # also if a newer one replaces the last one just now
            for _ in range(_MOST_AT_ONCE):
                sample = self._waiting.popleft()
                self._taken_bytes += len(sample.payload)
                yield sample
                if self._taken_bytes > end:
                    break

    def _used_now(self, sample: zenoh.Sample, at: int) -> KeyValue:
        own, grid, points = self._own, self.runner.grid, self.runner.plan.step_points
        value, said, is_simulated = self._reader.read(sample)
        if said is None:
            when = grid.time(self._used * points) if own.wait else None
        else:
            if self._shift is None:
                self._shift = self._first_shift(said, is_simulated=is_simulated)
            # Seconds since 1970 have steps of 0.2 us, so that a value would be a point too late as often as not.
            blur = math.ulp(said) + math.ulp(self._shift)
            when = grid.snapped(said + self._shift + own.delay, blur)
            if own.wait and not self._used and when > (first := grid.start_time + own.delay) + grid.rounding(first):
                text = (
                    f"the first value that came by {self.words} is for {when:.9g} s: the one for {first:.9g} s is lost"
                )
                raise MeshLost(
                    text,
                    **self._place(),
                    hint="Start this run before its publisher, or let that one wait (`congestion: block`).",
                )
        step = set_input(self.runner, own.variable, value, when, more=True)
        self._used += 1
        if when is not None:
            self._look_at_time(when, late=step * points == at and step > grid.step_at(when, points))
        return self._name, at, when, to_plain(value)

    def _let_step(self) -> None:
        """The steps that begin by the time of the newest value need not wait for the key any more."""
        grid, points, when = self.runner.grid, self.runner.plan.step_points, self._newest
        if self.counter is not None and when is not None and when >= grid.start_time - grid.rounding(when):
            reached = grid.step_at(when, points)
            reached -= grid.time(reached * points) > when + grid.rounding(when)
            self.counter.raise_to(max(self.counter.value, (reached + 1) * points))

    def _first_shift(self, said: float, *, is_simulated: bool) -> float:
        grid = self.runner.grid
        if self._own.origin is not None:
            return grid.start_time - self._own.origin
        return 0.0 if is_simulated else grid.time(self.runner.point) - said

    def _look_at_time(self, when: float, *, late: bool) -> None:
        if late and not self._own.wait:
            self._counts = replace(self._counts, late=self._counts.late + 1)
            self._say("late", "has come after its time: a later one stays in effect. Is its `delay` too short?")
        if self._newest is not None and when < self._newest:
            self._counts = replace(self._counts, disordered=self._counts.disordered + 1)
            self._say("disordered", "is for an earlier time than the one before it: has a clock jumped?")
        self._newest = when if self._newest is None else max(when, self._newest)

    def holds(self, point: int) -> bool:
        """Whether a step may not go to a point because a value has not come."""
        return self.counter is not None and point > self.counter.value

    def check(self, granted: int, now: float, limit_s: float) -> None:
        """Look whether a value that a step up to the point ``granted`` needs has come in ``limit_s``; ``now`` is in s.

        Raises:
            DeadlineExceeded: it has not.
        """
        if self.counter is None:
            return
        if (waited_s := self._patience.spent_s(self.counter.value, granted, now)) > limit_s:
            newest = f"; the last one was for {self._newest:.9g} s" if self._newest is not None else ""
            text = f"no value for this point has come in {waited_s:.1f} s by the key {self.words}{newest}"
            hint = "Is its publisher running, and connected? `timeouts.step` is the longest wait."
            raise DeadlineExceeded(text, **self._place(), hint=hint)

    def look(self, now: float, limit_s: float) -> None:
        """On the thread of the server: tell if nobody has published the key in ``limit_s``."""
        if not self._received and now - self._declared_at > limit_s:
            self._say("silent", f"has not come in {limit_s:g} s: does somebody publish this key, on this network?")

    @property
    def status(self) -> KeyStatus:
        """What has come; from any thread."""
        received, took_s = self._received, self._last_at - self._first_at
        rate = (received - 1) / took_s if took_s > 0.0 else 0.0
        age = time.monotonic() - self._last_at if received else None
        lost = self._counts.lost + self._lost
        replaced = self._replaced + max(0, len(self._waiting) - 1 if self._only_newest else 0)
        return replace(self._counts, received=received, replaced=replaced, lost=lost, rate=rate, age=age)

    def _say(self, what: str, text: str) -> None:
        """Warn once of each kind of trouble."""
        if what not in self._told:
            self._told.add(what)
            line = f"a value of {self.words}, {text}"
            self._log(LogLine(self.runner.name, "warning", "key", line, self.runner.point))

    def _place(self) -> dict[str, Any]:
        point = self.runner.point
        at = {"point": point, "time": self.runner.grid.time(point)}
        return {"instance": self.runner.name, "variable": self._own.variable, **at}
