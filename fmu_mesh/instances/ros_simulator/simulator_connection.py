"""How a simulator in ROS is reached: as a client on the keys of rmw_zenoh, or through rclpy in this process.

Owns the session or the ROS node. What topics and services mean is not known here.
"""

# Threads: with rmw_zenoh, Zenoh calls `take` on a thread of its own; it puts a message into a queue and sets an event,
# for which the thread of the instance waits. With rclpy there is one thread: `wait` and a call let callbacks run, with
# an executor of this node alone (ADR 78).

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from typing import Any, Protocol

from ...errors import DeadlineExceeded, MeshLost
from ...ros_wire.cdr import Codec, Message
from ...ros_wire.definitions import MessageTypes
from ...ros_wire.profile import Put, Take
from ...ros_wire.rclpy_profile import RclpyProfile, ros_module
from ...ros_wire.rmw_zenoh import Call, RmwZenoh
from ...ros_wire.topics import RosPlan, Topic
from ...wire.session import Wiring, close_session, open_session
from .simulator_section import SimulatorConfig

__all__ = ["RclpyConnection", "SimulatorConnection", "ZenohConnection"]

_REPEAT_S = 2.0
"""DDS may lose the answer to a client of which the server has not heard; what changes nothing is asked again."""
_SPIN_S = 0.1


class SimulatorConnection(Protocol):
    """Topics and services of one simulator. Call it from one thread, and `close` last."""

    def publish(self, topic: Topic) -> Put:
        """Declare a publisher of ``topic``."""

    def subscribe(self, topic: Topic, take: Take) -> None:
        """Declare a subscriber of ``topic``; ``take`` must not wait."""

    def client(self, name: str, kind: str, *, repeats: bool = False) -> Call:
        """Declare a client of the service ``name``; ``repeats`` says that a request may be sent again."""

    def wait(self, timeout_s: float) -> None:
        """Wait until a message may have come, for so long at most."""

    def unheard(self) -> list[str]:
        """The published topics that nobody subscribes to."""

    def close(self) -> None:
        """Undeclare everything."""


class ZenohConnection:
    """One ROS node on the keys of rmw_zenoh.

    It is a client of ROS's router, which forwards to and from clients, wherever they are.
    """

    def __init__(self, section: SimulatorConfig, types: MessageTypes, node: str) -> None:
        patience_s = section.timeout
        self._session = open_session(
            Wiring("client", connect=tuple(section.connect), patience_s=patience_s, timestamps=True, insecure=True)
        )
        self._profile = RmwZenoh(self._session, RosPlan(types, node=node), section.domain or 0)
        self._arrived = threading.Event()
        self.publish = self._profile.publish
        self.unheard = self._profile.unheard

    def subscribe(self, topic: Topic, take: Take) -> None:
        """See `SimulatorConnection`."""

        def arrived(data: bytes) -> None:
            take(data)
            self._arrived.set()

        self._profile.subscribe(topic, arrived)

    def client(self, name: str, kind: str, *, repeats: bool = False) -> Call:
        """See `SimulatorConnection`."""
        return self._profile.client(name, kind)

    def wait(self, timeout_s: float) -> None:
        """See `SimulatorConnection`."""
        self._arrived.wait(timeout_s)
        self._arrived.clear()  # whoever waits looks into its queue next

    def close(self) -> None:
        """See `SimulatorConnection`."""
        self._profile.close()
        close_session(self._session)


class RclpyConnection:
    """One node of rclpy with a context of its own.

    Raises:
        ConfigurationError: this Python has no ROS, or its ROS lacks a package.
    """

    def __init__(self, section: SimulatorConfig, types: MessageTypes, node: str) -> None:
        rclpy, executors = ros_module("rclpy"), ros_module("rclpy.executors")
        self._services, self._serialization = ros_module("simulation_interfaces.srv"), ros_module("rclpy.serialization")
        self._types = types
        with ExitStack() as stack:
            context = rclpy.Context()
            no_handlers = ros_module("rclpy.signals").SignalHandlerOptions.NO
            rclpy.init(context=context, domain_id=section.domain, signal_handler_options=no_handlers)
            stack.callback(rclpy.shutdown, context=context)
            self._node = rclpy.create_node(node, context=context)
            stack.callback(self._node.destroy_node)
            self._executor = executors.SingleThreadedExecutor(context=context)
            stack.callback(self._executor.shutdown)
            self._executor.add_node(self._node)
            self._profile = RclpyProfile(self._node)
            stack.callback(self._profile.close)
            self._open = stack.pop_all()
        self.publish = self._profile.publish
        self.subscribe = self._profile.subscribe
        self.unheard = self._profile.unheard

    def client(self, name: str, kind: str, *, repeats: bool = False) -> Call:
        """See `SimulatorConnection`."""
        service = getattr(self._services, kind.rpartition("/")[2])
        client = self._node.create_client(service, name)
        request_codec, response_codec = (Codec(self._types, f"{kind}_{part}") for part in ("Request", "Response"))

        def call(request: Message, deadline_s: float) -> Message:
            end, sent, asked = time.monotonic() + deadline_s, 0.0, list[Any]()
            data = request_codec.encode(request_codec.empty() | request)
            message = self._serialization.deserialize_message(data, service.Request)
            while (now := time.monotonic()) < end:
                if not client.service_is_ready():
                    if asked and not repeats:
                        raise MeshLost(f"the server of '{name}' is gone")
                elif not asked or (repeats and now - sent > _REPEAT_S):
                    asked.append(client.call_async(message))
                    sent = now
                self.wait(min(end - now, _SPIN_S))
                if (done := next((future for future in asked if future.done()), None)) is not None:
                    return response_codec.decode(self._serialization.serialize_message(done.result()))
            raise DeadlineExceeded(f"'{name}' did not answer within {deadline_s:g} s")

        return call

    def wait(self, timeout_s: float) -> None:
        """See `SimulatorConnection`."""
        self._executor.spin_once(timeout_sec=timeout_s)

    def close(self) -> None:
        """See `SimulatorConnection`."""
        self._open.close()
