"""The gateway: what flows between the mesh and ROS while a mesh runs.

It is a Zenoh client of the mesh like any other (docs/key-space.md), in a process and with a session towards ROS of its
own: whatever becomes of ROS, no node and no master ever waits for it. All work is done on the thread that calls `run`;
callbacks only put into a bounded queue. What does not fit is left out, counted and told.
"""

from __future__ import annotations

import logging
import queue
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import zenoh

from ...errors import MeshLost, MessageRefused
from ...simtime import TimeGrid
from ...wire.client.readings import latecomers
from ...wire.keys import Keys
from ...wire.messages import decode_json
from ...wire.refusals import Refusals
from ...wire.session import Question, ask, undeclare_all
from ...wire.values import decode_stamp, encode_time, encode_value, json_encoding
from ...wire.views import MeshInfo
from ..messages.assembling import Assembler, Disassembler
from ..messages.cdr import CdrError, Codec
from ..messages.definitions import CLOCK, MessageTypes
from ..messages.stamp import to_stamp
from .profile import Profile, Put
from .topics import Port, RosPlan, Topic

__all__ = ["Gateway"]

log = logging.getLogger(__name__)

_WAITING_EVENTS = 1 << 16
_REPEAT_S = 1.0

Event = Callable[[], None]


class Gateway:
    """Carries topics between one mesh and ROS.

    Args:
        plan: the topics.
        types: the message types.
        mesh: a session that reaches the mesh; stays the caller's.
        keys: the keys of the mesh.
        grid: the communication points of the run.
        profiles: the profile of every topic, by name, that of the clock first; they stay the caller's.
        patience_s: how long `open` waits for the master, in s.

    Call `open`, then `run`, then `close`.
    """

    def __init__(  # noqa: PLR0913, PLR0917  the parts that it brings together
        self,
        plan: RosPlan,
        types: MessageTypes,
        mesh: zenoh.Session,
        keys: Keys,
        grid: TimeGrid,
        profiles: dict[str, Profile],
        patience_s: float = 60.0,
    ) -> None:
        self._plan = plan
        self._types = types
        self._mesh = mesh
        self._keys = keys
        self._grid = grid
        self._profiles = profiles
        self._patience_s = patience_s
        self._refusals = Refusals()
        self._leaving = False
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._left_out = 0
        self._ended = False
        self._mesh_ended = False
        self._entities: list[zenoh.Subscriber[None] | zenoh.LivelinessToken] = []
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._watches: dict[str, _Watch] = {}
        self._clock: _Clock | None = None
        self._reached = -1
        self._complete = -1
        self._now = -1

    def open(self) -> None:
        """Declare everything; from now on nothing is missed.

        Raises:
            MeshLost: the master does not answer.
        """
        for topic in self._plan.topics:
            if topic.direction == "out":
                self._open_output(topic)
            else:
                self._open_input(topic)
        if not self._watches and self._plan.time_source is not None and self._plan.clock_points:
            self._watch(self._plan.time_source)
        if self._plan.clock_points is not None:
            profile = next(iter(self._profiles.values()))
            self._clock = _Clock(
                profile.publish(_clock_topic(self._plan)), self._types, self._plan.clock_points, self._grid
            )
        for key, watch in self._watches.items():
            self._entities.append(self._mesh.declare_subscriber(key, partial(self._value_arrived, key, watch)))
        self._entities.append(
            self._mesh.liveliness().declare_subscriber(self._keys.master, self._token_changed, history=True)
        )
        self._follow()

    def run(self) -> None:
        """Carry until the mesh has ended and its last sample is carried, or until `end` is called."""
        due = time.monotonic() + _REPEAT_S
        while not (self._ended or self._mesh_ended):
            now = time.monotonic()
            if now >= due:
                due = now + _REPEAT_S
                self._tell_left_out()
                if self._clock is not None:
                    self._clock.repeat()
            try:
                event = self._events.get(timeout=due - now if due > now else 0)
            except queue.Empty:
                continue
            self._handle(event)
        late = latecomers(self._events)
        while not self._is_over() and (late_event := next(late, None)) is not None:
            self._handle(late_event)

    def end(self) -> None:
        """From any thread: let `run` return once everything that has come is carried."""
        self._leaving = True
        self._events.put(self._end)

    def close(self) -> None:
        """Undeclare what belongs to the mesh."""
        self._tell_left_out()
        undeclare_all(self._entities, self._publishers.values())

    def _handle(self, event: Callable[[], None]) -> None:
        with self._refusals.guard("a topic or a variable"):
            event()

    def _follow(self) -> None:
        """Let the master, which may be a moment late, stay at the end until the last sample has come here."""
        key = self._keys.mesh_key("info")
        try:
            answer = ask(self._mesh, Question(key, "the master", self._patience_s), lambda: self._leaving)
        except MeshLost:
            if not self._leaving:
                raise
            return
        run = self._keys.run(decode_json(answer, MeshInfo).run)
        token = self._mesh.liveliness().declare_token(run.follower(str(self._mesh.zid())))
        self._entities.append(token)

    # --- from the mesh to ROS

    def _open_output(self, topic: Topic) -> None:
        output = _Output(Assembler(topic, self._types), self._profiles[topic.profile].publish(topic))
        for index, port in enumerate(topic.ports):
            self._watch(port).outputs.append((output, index))

    def _watch(self, port: Port) -> _Watch:
        key = self._keys.variable(port.instance, port.kind, port.variable.name)
        return self._watches.setdefault(key, _Watch(f"{port.instance}.{port.variable.name}", port.step_points))

    def _value_arrived(self, key: str, watch: _Watch, sample: zenoh.Sample) -> None:
        # Without an attachment it is what somebody puts on the key of an input.
        if sample.attachment is not None and str(sample.key_expr) == key:
            self._post(partial(self._take_value, watch, sample.payload.to_bytes(), sample.attachment.to_bytes()))

    def _take_value(self, watch: _Watch, data: bytes, attachment: bytes) -> None:
        try:
            stamp = decode_stamp(attachment)
        except MessageRefused:  # likewise: it says from when on it holds, and no point
            return
        try:
            value: Any = decode_json(data, object)
        except MessageRefused as error:
            watch.complain(f"a value that is not understood: {error}")
            return
        for output, port in watch.outputs:
            try:
                for message, stamp_s in output.assembler.add(port, stamp.point, stamp.time, value):
                    output.put(message, stamp_s)
            except CdrError as error:
                watch.complain(f"{value!r} cannot be sent on '{output.assembler.topic.name}': {error}")
        self._went_on(watch, stamp.point)

    def _went_on(self, watch: _Watch, point: int) -> None:
        """Everything up to a point that no watched variable is behind has been published."""
        if watch.point < 0 and self._clock is not None:
            self._clock.begin(point)
        was_last = watch.holds_until <= self._complete
        watch.point = point
        self._reached = max(self._reached, point)
        if was_last:
            self._complete = min(other.holds_until for other in self._watches.values())
        now = min(self._reached, self._complete)
        if now > self._now:
            self._now = now
            if self._clock is not None:
                self._clock.advance(now)

    # --- from ROS to the mesh

    def _open_input(self, topic: Topic) -> None:
        own = _Input(Disassembler(topic, self._types), self._grid.stop_time)
        for port in topic.ports:
            key = self._keys.variable(port.instance, port.kind, port.variable.name)
            if key not in self._publishers:
                self._publishers[key] = self._mesh.declare_publisher(
                    key, encoding=json_encoding, congestion_control=zenoh.CongestionControl.BLOCK
                )
            own.keys.append(key)

        def take(data: bytes) -> None:
            self._post(partial(self._take_message, own, data))

        self._profiles[topic.profile].subscribe(topic, take)

    def _take_message(self, own: _Input, data: bytes) -> None:
        try:
            values, stamp = own.disassembler.values(data)
        except CdrError as error:
            own.complain(f"a message of {len(data)} bytes is no '{own.topic.message}' that can be used: {error}")
            return
        attachment = own.attachment(stamp)
        for key, value in zip(own.keys, values, strict=True):
            self._publishers[key].put(encode_value(value), attachment=attachment)

    # --- the queue

    def _post(self, event: Event) -> None:
        """On a foreign thread: enqueue what came, unless too much is waiting already."""
        if self._events.qsize() < _WAITING_EVENTS:
            self._events.put(event)
        else:
            self._left_out += 1

    def _tell_left_out(self) -> None:
        count, self._left_out = self._left_out, 0
        if count:
            log.warning("%d samples were left out: the mesh is faster than ROS can be told", count)

    def _token_changed(self, sample: zenoh.Sample) -> None:
        self._events.put(self._end_mesh if sample.kind == zenoh.SampleKind.DELETE else self._meet_mesh)

    def _is_over(self) -> bool:
        """Whether nothing is left to be carried."""
        return self._ended or not self._watches or self._complete >= self._grid.last_point

    def _end_mesh(self) -> None:
        self._mesh_ended = True

    def _meet_mesh(self) -> None:
        """If it had gone, it is another run, or this process was let go of: its samples are not all there."""
        self._ended = self._ended or self._mesh_ended

    def _end(self) -> None:
        self._ended = True


class _Complaints:
    """Warns of each thing once, however often it happens."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._told: set[str] = set()

    def complain(self, text: str) -> None:
        """Warn, unless the same was told before."""
        if text not in self._told and len(self._told) < 10:
            self._told.add(text)
            log.warning("'%s': %s", self._name, text)


class _Output:
    """A published topic."""

    def __init__(self, assembler: Assembler, put: Put) -> None:
        self.assembler = assembler
        self.put = put


class _Watch(_Complaints):
    """A variable that is watched, for the topics that need it.

    Attributes:
        point: the last that was seen.
        outputs: the topics, and which of their ports it is.
    """

    def __init__(self, name: str, step_points: int) -> None:
        super().__init__(name)
        self.step_points = step_points
        self.point = -1
        self.outputs: list[tuple[_Output, int]] = []

    @property
    def holds_until(self) -> int:
        """The last point at which the value that was seen still holds."""
        return self.point + self.step_points - 1 if self.point >= 0 else -1


class _Input(_Complaints):
    """A subscribed topic."""

    def __init__(self, disassembler: Disassembler, stop_time: float | None) -> None:
        super().__init__(disassembler.topic.name)
        self.disassembler = disassembler
        self.topic = disassembler.topic
        self.keys: list[str] = []
        self._stop_time = stop_time

    def attachment(self, stamp: float | None) -> bytes | None:
        """What tells from when on a value holds, for a message with this stamp in s; None: as soon as it comes."""
        if stamp is not None and self._stop_time is not None and stamp > self._stop_time:
            self.complain(
                "its stamps are behind the end of the simulation, so its messages hold as they come; "
                "does its publisher run with use_sim_time?"
            )
            return None
        return encode_time(stamp) if stamp is not None else None


class _Clock:
    """`/clock`: the time of every n-th point, once everything up to it has been published."""

    def __init__(self, put: Put, types: MessageTypes, stride: int, grid: TimeGrid) -> None:
        self._put = put
        self._codec = Codec(types, CLOCK)
        self._stride = stride
        self._grid = grid
        self._next: int | None = None
        self._last: int | None = None
        self._moved = False

    def begin(self, point: int) -> None:
        """A first value has come, of this point: what was before it, nobody was there to publish."""
        if self._last is None:
            first = -(-point // self._stride) * self._stride
            self._next = first if self._next is None else min(first, self._next)

    def advance(self, point: int) -> None:
        """Everything up to ``point`` has been published."""
        while self._next is not None and self._next <= point:
            self._publish(self._next)
            self._last = self._next
            self._next += self._stride
            self._moved = True

    def repeat(self) -> None:
        """Tell the time to those who came while it stood still."""
        if self._last is not None and not self._moved:
            self._publish(self._last)
        self._moved = False

    def _publish(self, point: int) -> None:
        time_s = self._grid.time(point)
        self._put(self._codec.encode({"clock": to_stamp(time_s)}), time_s)


def _clock_topic(plan: RosPlan) -> Topic:
    profile: Any = plan.topics[0].profile if plan.topics else "ros2dds"
    return Topic("/clock", CLOCK, "out", (), profile, stamped=False, frame_id="", reliability="reliable")
