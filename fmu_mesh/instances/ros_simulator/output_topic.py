"""Which message of a topic belongs to a point: values are matched by time or number, not by arrival.

A simulator that is paused has a time, counted here in its own steps from point 0. A message with a header belongs to
the step nearest to its stamp. Without one there are two ways: the simulator publishes one message every so many steps,
and they are counted; or the newest message counts that is here when the simulator says that it has stepped.
"""

# Threads: `take` is called on a thread of Zenoh or on that of the instance, and only puts a message into a queue. All
# else is for the thread of the instance (ADR 78).

from __future__ import annotations

from collections import deque

from ...ros_wire.assembling import Disassembler
from ...ros_wire.cdr import CdrError
from ...ros_wire.definitions import MessageTypes
from ...ros_wire.stamp import nanoseconds
from ...ros_wire.topics import Topic
from ...variables.model_description import Value
from .simulator_section import SimulatorTopicConfig

__all__ = ["OutputTopic", "SimulatorTime", "WrongMessage"]


class WrongMessage(Exception):
    """A message cannot be used, or shows that the simulator is not where it should be; the text says why."""


class SimulatorTime:
    """The time in a simulator, which takes steps of ``step_s`` from point 0 on."""

    def __init__(self, step_s: float) -> None:
        self._step_s = step_s
        self._start_s: float | None = None

    def begin(self, start_s: float | None) -> None:
        """Set the time of point 0 in s; None: the first stamp says it."""
        self._start_s = start_s

    def at(self, step: int) -> float:
        """The time of a step in s."""
        return (self._start_s or 0.0) + step * self._step_s

    def step_of(self, stamp: int, now: int) -> int:
        """The step nearest to a stamp in ns; ``now`` is that of the first stamp, where the time of point 0 is open."""
        if self._start_s is None:
            self._start_s = stamp / 1e9 - now * self._step_s
        return round((stamp - nanoseconds(self._start_s)) / (1e9 * self._step_s))


class OutputTopic:
    """One topic of a simulator whose fields are outputs.

    Attributes:
        name: of the topic.
        variables: of its fields.
        values: of the message of the last point, by variable.
    """

    def __init__(self, topic: Topic, own: SimulatorTopicConfig, types: MessageTypes, time: SimulatorTime) -> None:
        self.name = topic.name
        self.variables = [port.variable.name for port in topic.ports]
        self.values: dict[str, Value] = {}
        self._match = own.match
        self._every = own.every
        self._time = time
        self._disassembler = Disassembler(topic, types)
        # As a history in ROS: a simulator may publish while it is paused. Only those that are counted are all needed.
        self._waiting: deque[bytes] = deque(maxlen=topic.qos.depth)
        self._at = -1  # the step that the values are of; before the first message, none
        self._is_silent = False
        self._in_order = False  # a message was used, so what follows it in the topic is no older one
        self._newest = ""

    def take(self, data: bytes) -> None:
        """On any thread: take a message."""
        self._waiting.append(data)  # whose signature rclpy would not find

    def begin(self, *, silent: bool) -> None:
        """Forget all messages so far; ``silent`` says that there is none for point 0."""
        self._waiting.clear()
        self._at, self._is_silent, self._in_order = 0 if silent else -1, silent, False

    def is_at(self, step: int) -> bool:
        """Take what has come; whether the values are those of ``step``, counted in steps of the simulator.

        Raises:
            WrongMessage: a message is none of this type, or the simulator is beyond this step.
        """
        if self._match == "count" and len(self._waiting) == self._waiting.maxlen:
            text = f"{self._waiting.maxlen:,} messages on '{self.name}' wait, and more are lost"
            raise WrongMessage(f"{text}: raise `depth` of the topic, if the simulator does not run by itself")
        wanted = step - step % self._every
        while self._waiting and (self._match == "newest" or self._at < wanted):
            try:
                values, stamp = self._disassembler.values(self._waiting.popleft())
            except CdrError as error:
                raise WrongMessage(f"a message on '{self.name}' cannot be used: {error}") from error
            if (at := self._step_of(stamp or 0, step)) > step and self._in_order:
                text = f"'{self.name}' is {self._newest} already: does another program step the simulator?"
                raise WrongMessage(text)
            if at == wanted or self._match == "count":
                self._at, self._in_order = at, True
                pairs = zip(self.variables, values, strict=True)
                self.values.update((name, value) for name, value in pairs if value is not None)
        return self._at == wanted or (self._match == "newest" and (self._in_order or self._is_silent))

    def missing(self) -> str:
        """In words what has not come."""
        newest = f"; the newest is {self._newest}" if self._newest else ""
        return f"no message of this point on '{self.name}'{newest}"

    def _step_of(self, stamp: int, step: int) -> int:
        """The step of a message that has come in ``step`` with a stamp in ns."""
        match self._match:
            case "stamp":
                self._newest = f"at {stamp / 1e9:.9g} s"
                return self._time.step_of(stamp, step)
            case "count":
                return self._at + self._every if self._at >= 0 else 0
            case "newest":
                return step - step % self._every
