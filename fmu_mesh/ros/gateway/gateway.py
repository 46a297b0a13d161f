"""The gateway: carries samples between a running mesh and ROS.

It is a Zenoh client of the mesh like any other (docs/key-space.md). It has its own process and its own session towards
ROS, so no node and no master ever waits for ROS. All work is done on the thread that calls `Gateway.run`; callbacks
only put into a bounded queue. Samples that do not fit into the queue are left out, counted and reported.
"""

from __future__ import annotations

import logging
import queue
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

import zenoh

from ...config.mesh import RosConfig
from ...errors import MeshLost, MessageRefused
from ...simtime import TimeGrid
from ...wire.client.readings import latecomers
from ...wire.keys import Keys
from ...wire.messages import decode_json
from ...wire.refusals import Refusals
from ...wire.session import Question, ask, undeclare_all
from ...wire.values import Stamp, encode_origin, encode_value, json_encoding
from ...wire.views import MeshInfo
from ..messages.assembling import Assembler, Disassembler
from ..messages.cdr import CdrError
from ..messages.topics import Port, RosPlan, Topic
from .clock_progress import ClockPublisher, Progress, WarnOnce, WatchedVariable, clock_topic
from .parameters import ParameterServices
from .profile import Profile
from .rmw_zenoh import RmwZenoh
from .ros2dds import Ros2Dds

__all__ = ["Gateway", "open_profiles"]

log = logging.getLogger(__name__)

_MAX_EVENTS = 1 << 16
_REPEAT_S = 1.0

Event = Callable[[], None]


@contextmanager
def open_profiles(
    section: RosConfig, ros: zenoh.Session, plan: RosPlan, mesh: zenoh.Session, keys: Keys
) -> Iterator[dict[str, Profile]]:
    """Open the profiles that a plan needs, and the parameter services of the node if it is one of rmw_zenoh.

    Args:
        section: the section `ros` of the configuration.
        ros: the session towards ROS.
        plan: the topics and the parameters.
        mesh: a session that reaches the mesh.
        keys: the keys of the mesh.

    Yields:
        The profiles by name, that of the section first.
    """
    profiles: dict[str, Profile] = {}
    with ExitStack() as stack:
        for name in dict.fromkeys((section.profile, *(topic.profile for topic in plan.topics))):
            if name == "rmw_zenoh":
                node = profiles[name] = RmwZenoh(ros, plan, section.domain)
                stack.callback(node.close)
                stack.enter_context(ParameterServices(plan, mesh, keys).served_by(node))
            else:
                profile = profiles[name] = Ros2Dds(ros, plan.types)
                stack.callback(profile.close)
        yield profiles


class Gateway:
    """Carries topics between one mesh and ROS.

    Call `open`, then `run`, then `close`.

    Args:
        plan: the topics.
        mesh: a session that reaches the mesh; the caller closes it.
        keys: the keys of the mesh.
        grid: the communication points of the run.
        profiles: the profiles of the topics by name, that of `/clock` first; the caller closes them.
    """

    def __init__(
        self, plan: RosPlan, mesh: zenoh.Session, keys: Keys, grid: TimeGrid, profiles: dict[str, Profile]
    ) -> None:
        self._plan = plan
        self._mesh = mesh
        self._keys = keys
        self._grid = grid
        self._profiles = profiles
        self._refusals = Refusals()
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._left_out = 0
        self._interrupted = False
        self._ended = False
        self._mesh_ended = False
        self._entities: list[zenoh.Subscriber[None] | zenoh.LivelinessToken] = []
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._progress = Progress()

    def open(self, patience_s: float = 60.0) -> None:
        """Declare all topics; every later sample is carried.

        Args:
            patience_s: how long to wait for the master, in s.

        Raises:
            MeshLost: the master does not answer.
        """
        for topic in self._plan.topics:
            if topic.direction == "out":
                self._open_output(topic)
            else:
                self._open_input(topic)
        watched = self._progress.watched
        if not watched and self._plan.time_source is not None and self._plan.clock_points:
            self._watch(self._plan.time_source)
        if self._plan.clock_points is not None:
            put = next(iter(self._profiles.values())).publish(clock_topic(self._plan))
            self._progress.start_clock(ClockPublisher(put, self._plan, self._grid))
        for key, variable in watched.items():
            self._entities.append(self._mesh.declare_subscriber(key, partial(self._value_arrived, key, variable)))
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
                self._progress.repeat_clock()
            try:
                event = self._events.get(timeout=due - now if due > now else 0)
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
        for index, port in enumerate(topic.ports):
            self._watch(port).outputs.append((assembler, index, put))

    def _watch(self, port: Port) -> WatchedVariable:
        key = self._keys.variable(port.instance, port.kind, port.variable.name)
        return self._progress.watch(key, f"{port.instance}.{port.variable.name}", port.step_points)

    def _value_arrived(self, key: str, variable: WatchedVariable, sample: zenoh.Sample) -> None:
        # A sample without an attachment is a value that somebody puts on the key of an input.
        if sample.attachment is not None and str(sample.key_expr) == key:
            self._post(partial(self._take_value, variable, sample.payload.to_bytes(), sample.attachment.to_bytes()))

    def _take_value(self, variable: WatchedVariable, data: bytes, attachment: bytes) -> None:
        try:
            stamp = decode_json(attachment, Stamp)
        except MessageRefused:  # somebody put it on the key of an input, with a time but without a point
            return
        try:
            value: Any = decode_json(data, object)
        except MessageRefused as error:
            variable.warn(f"a value that is not understood: {error}")
            return
        for assembler, port, put in variable.outputs:
            try:
                for message, time_s in assembler.add(port, stamp.point, stamp.time, value):
                    put(message, time_s)
            except CdrError as error:
                variable.warn(f"{value!r} cannot be sent on '{assembler.topic.name}': {error}")
        self._progress.published(variable, stamp.point)

    # --- from ROS to the mesh

    def _open_input(self, topic: Topic) -> None:
        keys = [self._keys.variable(port.instance, port.kind, port.variable.name) for port in topic.ports]
        for key in keys:
            if key not in self._publishers:
                self._publishers[key] = self._mesh.declare_publisher(
                    key, encoding=json_encoding, congestion_control=zenoh.CongestionControl.BLOCK
                )
        subscribed = _SubscribedTopic(Disassembler(topic, self._plan.types), keys, self._grid.stop_time)

        def take(data: bytes) -> None:
            self._post(partial(self._take_message, subscribed, data))

        self._profiles[topic.profile].subscribe(topic, take)

    def _take_message(self, subscribed: _SubscribedTopic, data: bytes) -> None:
        try:
            values, stamp = subscribed.disassembler.values(data)
        except CdrError as error:
            message = subscribed.disassembler.topic.message
            subscribed.warn(f"a message of {len(data)} bytes is no '{message}' that can be used: {error}")
            return
        attachment = subscribed.attachment(stamp)
        for key, value in zip(subscribed.keys, values, strict=True):
            self._publishers[key].put(encode_value(value), attachment=attachment)

    # --- the queue

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
        self._events.put(self._end_mesh if sample.kind == zenoh.SampleKind.DELETE else self._meet_mesh)

    def _is_over(self) -> bool:
        """Whether every sample has been carried."""
        return self._ended or not self._progress.watched or self._progress.complete >= self._grid.last_point

    def _end_mesh(self) -> None:
        self._mesh_ended = True

    def _meet_mesh(self) -> None:
        # A token after its end belongs to another run, or the connection was lost meanwhile: samples are missing.
        self._ended = self._ended or self._mesh_ended

    def _end(self) -> None:
        self._ended = True


class _SubscribedTopic(WarnOnce):
    """A topic that the gateway subscribes to, and the keys of its variables."""

    def __init__(self, disassembler: Disassembler, keys: list[str], stop_time: float | None) -> None:
        super().__init__(disassembler.topic.name)
        self.disassembler = disassembler
        self.keys = keys
        self._stop_time = stop_time
        self._who = f"ros {disassembler.topic.name}"

    def attachment(self, stamp: float | None) -> bytes:
        """Who sends a value, and from which time on it holds: its stamp in s; None: it takes effect at once."""
        if stamp is not None and self._stop_time is not None and stamp > self._stop_time:
            self.warn(
                "its stamps are after the end of the simulation, so its messages hold as soon as they arrive; "
                "does its publisher run with use_sim_time?"
            )
            stamp = None
        return encode_origin(stamp, self._who)
