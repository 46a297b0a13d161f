"""A mesh in Foxglove for as long as the user wants: it may start later, end, and start again."""

# Threads of a shown mesh: the one of `show` sends values, `_follow_status` and `_follow_log` send what they hear, and
# `_ask` asks for values that are not published now. The SDK calls the parameters on threads of its own. `_questions`
# and `_answers` are queues, so nobody holds a lock while the mesh is asked. All end with the mesh or after a deadline.

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Final

from ..errors import DeadlineExceeded, FmuMeshError, Interrupted, from_report
from ..ros_wire.stamp import nanoseconds
from ..simtime import ENDLESS, TimeGrid
from ..web_server import ServedMesh
from ..wire.client.following import ValueStream
from ..wire.client.mesh_client import MeshClient
from ..wire.client.reaching import Meshes
from ..wire.client.readings import Reading, Target
from ..wire.views import MeshInfo, MeshStatus
from .foxglove_server import FoxgloveServer
from .mesh_parameters import MeshParameters
from .mesh_topics import message_of, status_message, topic_of, topics_by_instance

__all__ = ["Serving", "serve"]

_START_S: Final = 1.0
"""Time between two looks for a mesh that does not run yet, in s."""
_WAITING_VALUES: Final = 1 << 14
_TAKE_S: Final = 0.05
"""How long to wait for a value before readers and the end of the mesh are looked at, in s."""
_LAST_LOOKS: Final = 5
"""Looks without a value after the end of the mesh, as in `latecomers`."""
_ASK_S: Final = 0.5
"""Time between two looks at the parameters that clients follow, in s."""
_FOREVER_S: Final = 1e9


class Serving(ServedMesh, frozen=True):
    """What is served, and where.

    Attributes:
        variables: what is offered, as names with `*`; none: all outputs.
        origins: further origins whose pages may connect.
    """

    variables: tuple[str, ...] = ()
    origins: tuple[str, ...] = ()


def serve(serving: Serving, say: Callable[[str], None], stop: threading.Event | None = None) -> None:
    """Serve a mesh, and again when it starts again; ``say`` gets what happens in sentences.

    ``stop`` ends it when it is set, within a second if no mesh runs; without it, only an exception does.

    Raises:
        ConfigurationError: the port cannot be used, there are several meshes, or no variable fits a pattern.
    """
    mesh, stop = serving.mesh, stop or threading.Event()
    name = f"fmu_mesh: {mesh}" if mesh is not None else "fmu_mesh"
    with FoxgloveServer(name, serving.host, serving.port, serving.origins) as server:
        say(f"Foxglove can connect to {server.url}, or open {server.link}")
        is_reported = False
        while not stop.is_set():
            if not is_reported:
                which = f"mesh '{mesh.rpartition('/')[2]}'" if mesh is not None else "a mesh"
                server.tell(f"waiting for {which} to start", about="mesh")
                say(f"waiting for {which} to start")
                is_reported = True
            try:
                with Meshes(**serving.reach) as meshes:
                    client = meshes.appearance(mesh, _START_S)
                    try:
                        _show(serving, client, server, say)
                    except FmuMeshError:
                        if client.info_if_running() is not None:
                            raise  # otherwise nobody answered because the mesh has just ended
                    mesh, is_reported = client.keys.root, False
            except DeadlineExceeded:
                stop.wait(_START_S)


def _show(serving: Serving, client: MeshClient, server: FoxgloveServer, say: Callable[[str], None]) -> None:
    """Serve a mesh that runs until it ends."""
    mesh = client.keys.mesh
    shown = _ShownMesh(client, server, serving.variables, read_only=serving.read_only)
    server.withdraw("mesh", "end", "lost", "refused", "shift")
    say(f"mesh '{mesh}' is shown")
    if shown.shift_s:
        text = f"mesh '{mesh}' starts before 0 s, which Foxglove does not have: its times are {shown.shift_s:g} s later"
        server.tell(text, about="shift")
        say(text)
    last = shown.show()
    error = from_report(last.error) if last is not None and last.error is not None else None
    text = f"mesh '{mesh}' has ended" + (f": {error}" if error is not None else "")
    server.tell(text, about="end", severe=error is not None and not isinstance(error, Interrupted))
    say(text)


class _ShownMesh:
    """A mesh, from when it was found until it ends, and what is shown of it.

    The thread that calls `show` sends the values. Others follow the state and the log, and ask for values that nothing
    publishes now, so that an instance that answers late does not delay the values of the others.

    Raises:
        ConfigurationError: no variable fits a pattern.
        DeadlineExceeded: an instance does not answer.
    """

    def __init__(self, client: MeshClient, server: FoxgloveServer, patterns: Sequence[str], *, read_only: bool) -> None:
        self._client = client
        self._server = server
        self._info: MeshInfo = client.info()
        self._grid = TimeGrid(self._info.start_time, self._info.step_size, ENDLESS)
        self._shift_ns = max(0, -nanoseconds(self._info.start_time))
        self._infos = {name: client.instance_info(name) for name in self._info.instances}
        everything = client.targets("*")
        offered = (
            client.targets(*patterns)
            if patterns
            else [target for target in everything if target.variable.causality == "output"]
        )
        self._targets = {topic_of(target): target for target in offered}
        has_field = {one.name: one for one in everything if one.variable.type != "Binary"}  # Foxglove has none for it
        settable = {name: target for name, target in has_field.items() if target.variable.settable}
        refused = partial(server.tell, about="refused", severe=True)
        self._parameters = MeshParameters(client, settable, refused, read_only=read_only)
        self._stream = ValueStream(client.session, _WAITING_VALUES)
        self._without: dict[str, Target] = {}
        self._asking = False
        self._questions: queue.SimpleQueue[list[Target] | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[list[Reading]] = queue.SimpleQueue()

        self._last: MeshStatus | None = None
        self._over = threading.Event()

    @property
    def shift_s(self) -> float:
        """By how much the times in Foxglove are later, in s: it has no times before 0."""
        return self._shift_ns / 1e9

    def show(self) -> MeshStatus | None:
        """Show it until it ends; returns its last status, if one has come."""
        with self._stream, self._client.until_end(self._stream.wake) as ended:
            self._server.begin(self._targets, self._parameters, self._stream.wake)
            self._server.show_graph(topics_by_instance(self._infos, list(self._targets.values())))
            threads = [
                threading.Thread(target=work, name=work.__name__, daemon=True)
                for work in (self._follow_status, self._follow_log, self._ask)
            ]
            for thread in threads:
                thread.start()
            try:
                self._send_values(ended)
            finally:
                self._over.set()
                self._questions.put(None)
            for thread in threads:
                thread.join(_TAKE_S * _LAST_LOOKS)  # they may be waiting for an answer
            self._server.end()
        return self._last

    # --- values

    def _send_values(self, ended: threading.Event) -> None:
        looks = 0
        while looks < _LAST_LOOKS:
            self._follow_readers()
            taken = self._stream.take(_TAKE_S)
            for target, reading in taken:
                self._without.pop(target.key, None)
                self._send(target, reading)
            self._send_where_it_pauses(idle=not taken)
            looks = 0 if taken or not ended.is_set() else looks + 1
            if lost := self._stream.take_lost():
                text = f"{lost} values are not shown, because mesh '{self._info.mesh}' is faster than Foxglove is fed"
                self._server.tell(text, about="lost")

    def _follow_readers(self) -> None:
        """Follow the variables that clients have subscribed to, and no others."""
        for topic in sorted(self._server.take_touched()):
            target = self._targets[topic]
            if self._server.is_read(topic):
                self._stream.follow(target)
                self._without[target.key] = target
            else:
                self._stream.leave(target)
                self._without.pop(target.key, None)

    def _send_where_it_pauses(self, *, idle: bool) -> None:
        """While the mesh is paused, no value comes to a new reader; the current ones are asked for and sent instead."""
        with suppress(queue.Empty):
            readings = self._answers.get_nowait()
            self._asking = False
            for reading in readings:
                if (target := self._without.pop(reading.key, None)) is not None:
                    self._send(target, reading)
        paused = self._last is not None and self._last.state == "paused"
        if idle and paused and self._without and not self._asking:
            self._asking = True
            self._questions.put(list(self._without.values()))

    def _send(self, target: Target, reading: Reading) -> None:
        time_ns = nanoseconds(reading.time) + self._shift_ns
        self._server.show(topic_of(target), message_of(target, reading), time_ns)
        self._server.show_time(time_ns)

    # --- other threads

    def _follow_status(self) -> None:
        with suppress(FmuMeshError), self._client.statuses(_FOREVER_S) as statuses:
            for status in statuses:
                self._last = status
                time_ns = nanoseconds(status.time) + self._shift_ns
                self._server.show_status(status_message(status), time_ns)
                self._server.show_time(time_ns, at_once=True)

    def _follow_log(self) -> None:
        with suppress(FmuMeshError), self._client.logs(follow=True) as lines:
            for line in lines:
                time_ns = nanoseconds(self._grid.time(line.point)) + self._shift_ns
                self._server.show_log(line, time_ns)

    def _ask(self) -> None:
        """Ask for the current values of variables, and again and again for the parameters that clients follow."""
        while not self._over.is_set():
            try:
                targets = self._questions.get(timeout=_ASK_S)
            except queue.Empty:
                targets = []
            if targets is None:
                return
            if targets:
                readings: list[Reading] = []
                with suppress(FmuMeshError):  # they are asked for again
                    readings = self._client.get(targets)
                self._answers.put(readings)
                self._stream.wake()
            self._server.show_parameters(self._parameters)
