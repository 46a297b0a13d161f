"""The gateway: carries samples between a running mesh and ROS.

It is a Zenoh client of the mesh like any other (docs/key-space.md). It has its own process and its own session towards
ROS, so no node and no master ever waits for ROS.
"""

# Threads: Zenoh calls `arrived` and `take` on threads of its own, rclpy calls `take` on those of its executor. They
# only put events into a queue. `Gateway.run` handles the events one by one on the thread of its caller, so nothing here
# needs a lock. `Gateway.end` may be called from any thread, also while `open` waits for the master.
#
# What may go wrong:
# * ROS is slower than the mesh. A callback must not wait, because the values of the mesh come on its thread. So the
#   queue is bounded; what does not fit is left out, counted and reported. Only `run` waits for slow subscribers, on the
#   second session, which the mesh does not know.
# * The mesh ends while samples are on their way. The token of a follower makes the master stay until they are carried;
#   the loss of the master's token can overtake samples (`latecomers`), so it is no reason to stop at once.
# * The mesh is reset: its points begin again, and `/clock` jumps back. A point before the one of the last sample tells
#   it, or point 0 after point 0; each node has sent its last samples before the first new one of any (ADR 75). So every
#   topic has a message of point 0 after a reset, for which programs wait that step the mesh.
# * The token of the mesh comes back. It belongs to another run, whose points begin again: this gateway ends.
#
# A variable of a slower instance holds its value between two of its points. So everything up to a point has been
# published once every watched variable has a value that holds there, and `/clock` follows that point.
#
# Given up: a gateway in the process of the master, and one that the grant waits for; both let ROS slow the mesh
# (ADR 0030).

from __future__ import annotations

import logging
import queue
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import zenoh

from ...errors import MeshLost, MessageRefused
from ...ros_wire.assembling import Assembler, Disassembler
from ...ros_wire.cdr import CdrError, Codec
from ...ros_wire.definitions import CLOCK
from ...ros_wire.profile import Profile, Put, Take
from ...ros_wire.stamp import to_stamp
from ...ros_wire.topics import CLOCK_TOPIC, DIAGNOSTICS, DIAGNOSTICS_TOPIC, Port, RosPlan, Topic
from ...simtime import TimeGrid
from ...text import shown
from ...wire.client.readings import latecomers
from ...wire.keys import Keys
from ...wire.messages import decode_json
from ...wire.refusals import Refusals
from ...wire.session import Question, ask, undeclare_all
from ...wire.values import Stamp, encode_origin, encode_value, encode_values, json_encoding
from ...wire.views import MeshInfo
from .deadline import Deadline
from .diagnostics import Diagnostics
from .simulation_services import Settling

__all__ = ["Gateway"]

log = logging.getLogger(__name__)

_MAX_EVENTS = 1 << 16
_MAX_WARNINGS = 10
_REPEAT_S = 1.0
"""How often `/clock` is repeated while it stands still, for new subscribers, and lost samples are reported."""

Event = Callable[[], None]


class Gateway:
    """Carries topics between one mesh and ROS.

    The caller closes the session and the profiles. Call `open`, then `run`, then `close`.

    Attributes:
        settle: from any thread: wait until the mesh has the values of all messages that have arrived from ROS.
        ignored: by topic, how many elements of messages had keys that no variable has.
        deadlines: of the topics that have one.
    """

    def __init__(self, plan: RosPlan, mesh: zenoh.Session, keys: Keys, grid: TimeGrid) -> None:
        self.ignored: dict[str, int] = {}
        self.deadlines: list[Deadline] = []
        self._plan = plan
        self._mesh = mesh
        self._keys = keys
        self._grid = grid
        self._profiles: Mapping[str, Profile] = {}
        self._refusals = Refusals()
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self.settle = Settling(mesh, self._events.put)
        self._left_out = 0
        self._interrupted = False
        self._ended = False
        self._mesh_ended = False
        self._entities: list[zenoh.Subscriber[None] | zenoh.LivelinessToken] = []
        self._publishers: dict[str, zenoh.Publisher] = {}
        # What ROS keeps for late subscribers comes at once, and would be lost before the nodes of the mesh are there:
        # these are subscribed with the first sample of the mesh.
        self._awaited: list[tuple[Topic, Take]] = []
        # The variables by their keys, the last point at which the newest samples of all of them hold, and the newest.
        self._watched: dict[str, _WatchedVariable] = {}
        self._complete = self._newest = -1
        self._clock: _ClockPublisher | None = None
        self._diagnostics: Diagnostics | None = None

    def open(self, profiles: Mapping[str, Profile], patience_s: float = 60.0) -> None:
        """Declare all topics; every later sample is carried. The first profile has `/clock`.

        Raises:
            MeshLost: the master does not answer.
        """
        self._profiles = profiles
        for topic in self._plan.topics:
            if topic.direction == "out":
                self._open_output(topic)
            else:
                self._open_input(topic)
        shows_time = self._plan.clock_points or self._awaited
        if not self._watched and self._plan.time_source is not None and shows_time:
            self._watch(self._plan.time_source)
        if self._plan.clock_points is not None:
            first = self._plan.topics[0].profile if self._plan.topics else "ros2dds"
            put = next(iter(profiles.values())).publish(Topic(CLOCK_TOPIC, CLOCK, "out", (), first))
            self._clock = _ClockPublisher(put, self._plan, self._grid)
        if self._plan.may_fail and all(topic.name != DIAGNOSTICS_TOPIC for topic in self._plan.topics):
            put = next(iter(profiles.values())).publish(Topic(DIAGNOSTICS_TOPIC, DIAGNOSTICS, "out", ()))
            self._diagnostics = Diagnostics(put, self._plan, self._keys)
            self._entities += self._diagnostics.follow(self._mesh, self._post)
        for key, variable in self._watched.items():
            self._take_values(key, variable)
        if not self._watched:  # nothing shows when they are there
            self._subscribe_awaited()
        self._entities.append(
            self._mesh.liveliness().declare_subscriber(self._keys.master, self._token_changed, history=True)
        )
        self._follow(patience_s)

    def run(self) -> None:
        """Carry samples until the mesh has ended and its last sample is carried, or until `end` is called."""
        due = time.monotonic() + _REPEAT_S
        while not (self._ended or self._mesh_ended):
            now = time.monotonic()
            if now >= due:
                due = now + _REPEAT_S
                self._report_left_out()
                if self._clock is not None:
                    self._clock.repeat()
                if self._diagnostics is not None:
                    self._diagnostics.publish()
            # A message that waits in the queue has met its deadline.
            waits = min([due - now, *(own.left(now) for own in self.deadlines)]) if self._events.empty() else 0
            try:
                event = self._events.get(timeout=max(waits, 0))
            except queue.Empty:
                continue
            self._handle(event)
        late = latecomers(self._events)
        while not self._is_over() and (late_event := next(late, None)) is not None:
            self._handle(late_event)

    def end(self) -> None:
        """From any thread: let `run` return once every sample that has arrived is carried."""
        self._interrupted = True
        self._events.put(self._end)

    def close(self) -> None:
        """Undeclare everything that was declared on the session of the mesh."""
        self._report_left_out()
        for own in self.deadlines:
            own.report()
        undeclare_all(self._entities, self._publishers.values())

    def _handle(self, event: Event) -> None:
        with self._refusals.guard("a topic or a variable"):
            event()

    def _follow(self, patience_s: float) -> None:
        """Wait for the master, which may start later, and make it stay at the end until the last sample is here."""
        key = self._keys.mesh_key("info")
        try:
            answer = ask(self._mesh, Question(key, "the master", patience_s), lambda: self._interrupted)
        except MeshLost:
            if not self._interrupted:
                raise
            return
        run = self._keys.run(decode_json(answer, MeshInfo).run)
        token = self._mesh.liveliness().declare_token(run.follower(str(self._mesh.zid())))
        self._entities.append(token)

    # --- from the mesh to ROS

    def _open_output(self, topic: Topic) -> None:
        assembler = Assembler(topic, self._plan.types)
        put = self._profiles[topic.profile].publish(topic)
        if not topic.ports:
            put(assembler.make([], self._grid.start_time), self._grid.start_time)
        if (deadline := self._deadline(topic)) is not None:
            put = deadline.watched(put)
        for index, port in enumerate(topic.ports):
            self._watch(port).outputs.append((assembler, index, put))

    def _watch(self, port: Port) -> _WatchedVariable:
        key = self._keys.variable(port.instance, port.kind, port.variable.name)
        variable = _WatchedVariable(f"{port.instance}.{port.variable.name}", port.step_points)
        return self._watched.setdefault(key, variable)  # several topics share it

    def _take_values(self, key: str, variable: _WatchedVariable) -> None:
        def arrived(sample: zenoh.Sample) -> None:
            # A sample without an attachment is a value that somebody puts on the key of an input.
            if sample.attachment is not None and str(sample.key_expr) == key:
                self._post(partial(self._take_value, variable, sample.payload.to_bytes(), sample.attachment.to_bytes()))

        self._entities.append(self._mesh.declare_subscriber(key, arrived))

    def _take_value(self, variable: _WatchedVariable, data: bytes, attachment: bytes) -> None:
        try:
            stamp = decode_json(attachment, Stamp)
        except MessageRefused:  # somebody put it on the key of an input, with a time but without a point
            return
        try:
            value: Any = decode_json(data, object)
        except MessageRefused as error:
            variable.warn(f"a value that is not understood: {error}")
            return
        if stamp.point < variable.newest or stamp.point == variable.newest == 0:
            self._begin_again()
        self._subscribe_awaited()
        for assembler, port, put in variable.outputs:
            try:
                for message, time_s in assembler.add(port, stamp.point, stamp.time, value):
                    put(message, time_s)
            except CdrError as error:
                variable.warn(f"{shown(value)} cannot be sent on '{assembler.topic.name}': {error}")
        if self._clock is not None and variable.holds_until < 0:
            self._clock.begin(stamp.point)
        was_last = variable.holds_until <= self._complete
        variable.advance(stamp.point)
        self._newest = max(self._newest, stamp.point)
        if was_last:
            self._complete = min(other.holds_until for other in self._watched.values())
        if self._clock is not None:
            self._clock.advance(min(self._newest, self._complete))

    def _begin_again(self) -> None:
        self._complete = self._newest = -1
        for variable in self._watched.values():
            variable.begin_again()
        if self._clock is not None:
            self._clock.begin_again()

    # --- from ROS to the mesh

    def _open_input(self, topic: Topic) -> None:
        subscribed = _SubscribedTopic(Disassembler(topic, self._plan.types))
        places: dict[str, dict[str, int]] = {}
        for place, port in enumerate(topic.ports):
            places.setdefault(port.instance, {})[port.variable.name] = place
        for instance, own in places.items():
            key = self._keys.setting(instance, *(own if len(own) == 1 else ()))
            subscribed.inputs[key] = own
            first = topic.ports[next(iter(own.values()))]
            subscribed.shown[key] = self._keys.variable(instance, first.kind, first.variable.name)
            if key not in self._publishers:
                self._publishers[key] = self._mesh.declare_publisher(
                    key, encoding=json_encoding, congestion_control=zenoh.CongestionControl.BLOCK
                )
        deadline = self._deadline(topic)

        def take(data: bytes) -> None:
            if deadline is not None:
                self._post(partial(deadline.met, time.monotonic()))
            self._post(partial(self._take_message, subscribed, data))

        if topic.qos.durability == "volatile":
            self._profiles[topic.profile].subscribe(topic, take)
        else:
            self._awaited.append((topic, take))

    def _take_message(self, subscribed: _SubscribedTopic, data: bytes) -> None:
        try:
            values, stamp = subscribed.disassembler.values(data)
        except CdrError as error:
            message = subscribed.disassembler.topic.message
            subscribed.warn(f"a message of {len(data)} bytes is no '{message}' that can be used: {error}")
            return
        attachment = encode_origin(stamp / 1_000_000_000 if stamp is not None else None, subscribed.who)
        for key, places in subscribed.inputs.items():
            if sent := {name: value for name, at in places.items() if (value := values[at]) is not None}:
                payload = encode_values(sent) if len(places) > 1 else encode_value(*sent.values())
                self._publishers[key].put(payload, attachment=attachment)
                self.settle.sent(subscribed.shown[key])
        fields = subscribed.disassembler.fields
        if fields.ignored:
            self.ignored[subscribed.disassembler.topic.name] = fields.ignored
            if fields.warning:
                subscribed.warn(fields.warning)

    def _subscribe_awaited(self) -> None:
        while self._awaited:
            topic, take = self._awaited.pop()
            self._profiles[topic.profile].subscribe(topic, take)

    # --- the queue

    def _deadline(self, topic: Topic) -> Deadline | None:
        if topic.qos.deadline is None:
            return None
        self.deadlines.append(Deadline(topic.name, topic.qos.deadline))
        return self.deadlines[-1]

    def _post(self, event: Event) -> None:
        """On a thread of Zenoh or ROS: put an event into the queue, unless the queue is full."""
        if self._events.qsize() < _MAX_EVENTS:
            self._events.put(event)
        else:
            self._left_out += 1

    def _report_left_out(self) -> None:
        count, self._left_out = self._left_out, 0
        if count:
            log.warning("%d samples were left out: the mesh is faster than ROS can receive", count)

    def _token_changed(self, sample: zenoh.Sample) -> None:
        def changed() -> None:
            # A token after its end belongs to another run, or the connection was lost meanwhile: samples are missing.
            self._ended = self._ended or (self._mesh_ended and not gone)
            self._mesh_ended = self._mesh_ended or gone

        gone = sample.kind == zenoh.SampleKind.DELETE
        self._events.put(changed)

    def _is_over(self) -> bool:
        """Whether every sample has been carried."""
        return self._ended or not self._watched or self._complete >= self._grid.last_point

    def _end(self) -> None:
        self._ended = True


class _WarnOnce:
    """Logs each warning about one topic or variable once, and at most ten of them."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._logged: set[str] = set()

    def warn(self, text: str) -> None:
        if text not in self._logged and len(self._logged) < _MAX_WARNINGS:
            self._logged.add(text)
            log.warning("'%s': %s", self._name, text)


class _SubscribedTopic(_WarnOnce):
    """A topic that the gateway subscribes to.

    Attributes:
        inputs: by the key that sets a variable, or several of an instance: the variables, and the place of the field of
            each in the topic.
        shown: by the same, the key that shows the value of one of them.
    """

    def __init__(self, disassembler: Disassembler) -> None:
        super().__init__(disassembler.topic.name)
        self.disassembler = disassembler
        self.inputs: dict[str, dict[str, int]] = {}
        self.shown: dict[str, str] = {}
        self.who = f"ros {disassembler.topic.name}"


class _WatchedVariable(_WarnOnce):
    """A variable whose samples the gateway takes; it has one every ``step_points`` points.

    Attributes:
        outputs: (assembler of a topic, index of the variable's port there, publishes its messages).
        holds_until: the last point at which the newest sample holds; -1 before the first sample.
    """

    def __init__(self, name: str, step_points: int) -> None:
        super().__init__(name)
        self.outputs: list[tuple[Assembler, int, Put]] = []
        self._step_points = step_points
        self.holds_until = -1

    @property
    def newest(self) -> int:
        """The point of the newest sample; negative before the first one."""
        return self.holds_until - self._step_points + 1

    def begin_again(self) -> None:
        """The mesh was reset: forget the samples so far."""
        self.holds_until = -1
        for assembler, _, _ in self.outputs:
            assembler.begin_again()

    def advance(self, point: int) -> None:
        """Note that the newest sample is that of ``point``."""
        self.holds_until = point + self._step_points - 1


class _ClockPublisher:
    """`/clock`: the time of every n-th point, once everything up to that point has been published."""

    def __init__(self, put: Put, plan: RosPlan, grid: TimeGrid) -> None:
        self._put = put
        self._codec = Codec(plan.types, CLOCK)
        self._stride = plan.clock_points or 1
        self._grid = grid
        self._next: int | None = None
        self._last: int | None = None
        self._moved = False

    def begin(self, point: int) -> None:
        """Start at the first sample, which is of ``point``; earlier points were not published here."""
        if self._last is None:
            first = -(-point // self._stride) * self._stride
            self._next = first if self._next is None else min(first, self._next)

    def begin_again(self) -> None:
        """The points begin again."""
        self._next = self._last = None

    def advance(self, point: int) -> None:
        """Publish every n-th point up to ``point``, up to which everything else has been published."""
        while self._next is not None and self._next <= point:
            self._publish(self._next)
            self._last = self._next
            self._next += self._stride
            self._moved = True

    def repeat(self) -> None:
        """Publish the last time again if it has not changed since the last call, for new subscribers."""
        if self._last is not None and not self._moved:
            self._publish(self._last)
        self._moved = False

    def _publish(self, point: int) -> None:
        time_s = self._grid.time(point)
        self._put(self._codec.encode({"clock": to_stamp(time_s)}), time_s)
