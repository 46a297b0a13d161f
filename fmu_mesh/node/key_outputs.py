"""Values of outputs under Zenoh keys for other programs.

Those that may be lost are published by the thread of the server, as streams are. Where the file says `block`, the main
thread publishes them between two steps: the run waits for who is slow, and while a key has no reader, also at the
start. So no value is lost, but those that are on their way when a link is cut.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Final

import numpy as np
import zenoh
import zenoh.ext
from msgspec.structs import asdict
from numpy.typing import NDArray
from zenoh.handlers import Callback

from ..errors import DeadlineExceeded
from ..rings.host_memory import Counter
from ..system.live_keys import KeyOutput, key_views
from ..text import listed
from ..variables.model_description import Value, Variable
from ..variables.value_types import is_text, nested
from ..wire.session import matches, undeclare_all
from ..wire.views import KeyStatus
from .key_inputs import Patience
from .key_payloads import key_writer
from .stepping import Runner
from .streams import PRIORITY, Picked, RowsFor

__all__ = ["KeyOutputs"]

_NOTHING: Final = object()

_KEPT: Final = 1 << 9
"""Values that who waits for them gets again: those from before it came, and those that a link has lost."""

_KEPT_BYTES: Final = 1 << 22
_ELEMENT_BYTES: Final = 24
_TEXT_BYTES: Final = 1 << 17
"""What is kept of an array, or of texts, is less; these are their usual sizes."""

_BEAT_S: Final = 0.2
"""How often in s it is told which value was the last one, if there was one."""


class KeyOutputs(RowsFor):
    """The keys with values of one instance: those that block, or all others.

    Args:
        counter: if they block, one more than the last point that is published: the node is never far ahead of it.
        post: lets the main thread do something, from any thread.
    """

    def __init__(
        self,
        runner: Runner,
        session: zenoh.Session,
        counter: Counter | None,
        post: Callable[[Callable[[], None]], None],
    ) -> None:
        super().__init__(runner)
        self.counter = counter
        self._patience = Patience(runner)
        self.window = max(1, runner.outputs.rows // 2) * runner.plan.step_points
        self._sinks: dict[str, list[_Sink]] = {}
        for own in runner.plan.keys_out:
            variable = runner.instance.description.variable(own.variable)
            if own.blocks == (counter is not None) and variable is not None:
                wake = partial(post, self.publish_now) if own.blocks else None
                self._sinks.setdefault(own.variable, []).append(_Sink(own, runner.name, variable, session, wake))

    def begin(self) -> None:
        """On the main thread, at point 0: from now on each point counts."""
        self._pick(self._sinks)

    def publish(self, steps: NDArray[np.intp], blocks: list[tuple[Picked, NDArray[Any]]]) -> None:
        """Publish what `collect` returned, point by point."""
        lists = [(picked.keys, block.tolist()) for picked, block in blocks]
        for offset, point in enumerate((steps * self.runner.plan.step_points).tolist()):
            time_s = self.runner.grid.time(point)
            for keys, rows in lists:
                row, first = rows[offset], 0
                for sinks, size, shape in keys:
                    elements = row[first : first + size]
                    value = nested(elements, shape)
                    first += size
                    for sink in sinks:
                        sink.publish(value if sink.place is None else elements[sink.place], point, time_s)
            if self.counter is not None:
                self.counter.raise_to(point + 1)

    def publish_now(self) -> None:
        """On the main thread: publish all rows while all keys are read, and wait for who is slow."""
        if not self._unread and (batch := self.collect(0)) is not None:
            self.publish(*batch[1:])

    def check(self, granted: int, now: float, limit_s: float) -> None:
        """Look whether nobody reads a key that blocks; arguments and errors are those of `KeyFeed.check`."""
        if self.counter is None or not (unread := self._unread):
            return
        runner, most = self.runner, self.counter.value - 1 + self.window
        if (waited_s := self._patience.spent_s(most, granted, now)) > limit_s:
            text = f"nobody has read the key {listed(unread)} for {waited_s:.1f} s, which blocks"
            hint = "Is its reader running, and connected? `timeouts.step` is the longest wait."
            raise DeadlineExceeded(text, instance=runner.name, hint=hint).at(
                runner.point, runner.grid.time(runner.point)
            )

    @property
    def _unread(self) -> list[str]:
        """The keys without a reader."""
        return [sink.key for sinks in self._sinks.values() for sink in sinks if not sink.is_read]

    @property
    def statuses(self) -> Iterator[KeyStatus]:
        """What `status` says of these keys; from any thread."""
        return (sink.status for sinks in self._sinks.values() for sink in sinks)

    def close(self) -> None:
        """Undeclare the publishers."""
        undeclare_all(entity for sinks in self._sinks.values() for sink in sinks for entity in sink.entities)


class _Sink:
    """One key of one variable, or of the element at ``place``.

    If it blocks, ``wake`` is called on a thread of Zenoh when it gets a reader, or loses all. Then values are also kept
    for who waits for the key and comes late, or whose link was cut.
    """

    def __init__(
        self, own: KeyOutput, instance: str, variable: Variable, session: zenoh.Session, wake: Callable[[], None] | None
    ) -> None:
        self.key = own.key
        self._own, self._session = own, session
        self._view = key_views(instance, own)[0]
        self.place = int(np.ravel_multi_index(own.index, variable.shape)) if own.index else None
        self._write, encoding = key_writer(own, variable)
        self._last: object = _NOTHING
        self._slot = -1
        self._count = 0
        self._first_at = self._last_at = 0.0
        self._publisher: zenoh.Publisher | zenoh.ext.AdvancedPublisher
        if wake is None:
            self._publisher = self._told = session.declare_publisher(own.key, encoding=encoding, priority=PRIORITY)
            self.entities: list[Any] = [self._publisher]
            return
        bytes_each = math.prod(variable.shape) * (_TEXT_BYTES if is_text(variable.type) else _ELEMENT_BYTES)
        self._publisher = zenoh.ext.declare_advanced_publisher(
            session,
            own.key,
            encoding=encoding,
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=PRIORITY,
            cache=zenoh.ext.CacheConfig(max(4, min(_KEPT, _KEPT_BYTES // bytes_each))),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_BEAT_S),
            publisher_detection=True,
        )
        self._told = session.declare_publisher(own.key)  # only it knows readers
        notice: Callback[Any] = Callback(lambda _status: wake(), indirect=False)  # without a thread
        self.entities = [self._told.declare_matching_listener(notice), self._told, self._publisher]

    @property
    def is_read(self) -> bool:
        """Whether somebody subscribes to the key."""
        return matches(self._told)

    def publish(self, value: Value, point: int, time_s: float) -> None:
        """Publish a value, if one is due at this point."""
        if (slot := point // self._own.every) == self._slot or (self._own.on == "change" and value == self._last):
            return
        self._slot, self._last = slot, value
        self._publisher.put(self._write(value, point, time_s), timestamp=self._session.new_timestamp())
        self._last_at = time.monotonic()
        self._first_at = self._first_at or self._last_at
        self._count += 1

    @property
    def status(self) -> KeyStatus:
        """See `KeyOutputs.statuses`."""
        took_s = self._last_at - self._first_at
        rate, age = (self._count - 1) / took_s if took_s > 0.0 else 0.0, time.monotonic() - self._last_at
        return KeyStatus(**asdict(self._view), received=self._count, rate=rate, age=age if self._count else None)
