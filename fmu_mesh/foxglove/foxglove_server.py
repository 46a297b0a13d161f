"""The WebSocket server of the Foxglove SDK: channels, time, parameters and messages for its clients.

Owns what is on the wire between runs of the mesh, and the time that clients are told. Nothing here waits for a client:
the SDK keeps a bounded number of messages for each, and drops the oldest ones of a client that does not read.
"""

# Threads: the SDK calls `_Requests` on threads of its own; the threads of a shown mesh call everything else. Each lock
# is held for a moment: `_Requests._lock` for what clients want, `_clock` for the time, which must not go back, and
# `_logging` for the order of log messages.

from __future__ import annotations

import secrets
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Final, Self
from urllib.parse import urlencode

import foxglove
from foxglove import Channel, ConnectionGraph, Context, Parameter, StatusLevel
from foxglove.channels import LogChannel
from foxglove.messages import Log, LogLevel, Timestamp
from foxglove.websocket import Capability, ChannelView, Client, ServerListener

from ..errors import ConfigurationError
from ..web_server import listening, shown_host
from ..wire.client.readings import Target
from ..wire.views import LogLine
from .mesh_parameters import MeshParameters
from .mesh_topics import STATUS_SCHEMA, metadata_of, schema_of
from .relay import Relay, let_in

__all__ = ["FoxgloveServer"]

_WAITING_MESSAGES: Final = 4096
"""Messages that wait for one client at most; of more, the oldest are lost."""
_WAITING_LINES: Final = 1000
_LOG: Final = "/log"
_TIME_S: Final = 1 / 60
"""Shortest time between two messages about the time, in s."""
_NS: Final = 1_000_000_000
_LEVELS: Final = {
    "ok": LogLevel.Info,
    "warning": LogLevel.Warning,
    "discard": LogLevel.Warning,
    "error": LogLevel.Error,
    "fatal": LogLevel.Fatal,
}


class FoxgloveServer:
    """Serves clients from when it was made until it is closed, whether a mesh runs or not.

    Attributes:
        url: where clients connect to; has a token.

    Raises:
        ConfigurationError: the port cannot be used.
    """

    def __init__(self, name: str, host: str, port: int, origins: Iterable[str] = ()) -> None:
        _check_filters()
        listener = listening(host, port, "the server for Foxglove")
        self._context = Context()
        self._listener = _Requests()
        self._server = foxglove.start_server(
            name=name,
            host="127.0.0.1",
            port=0,
            capabilities=[Capability.Time, Capability.Parameters, Capability.ConnectionGraph],
            server_listener=self._listener,
            context=self._context,
            message_backlog_size=_WAITING_MESSAGES,
        )
        token = secrets.token_urlsafe(24)
        self._relay = Relay(listener, self._server.port, token, origins)
        self.url = f"ws://{shown_host(host)}:{listener.getsockname()[1]}/?token={token}"
        self._clock = threading.Lock()
        self._time_ns = -1
        self._told_at = 0.0
        self._status = Channel("/mesh/status", schema=STATUS_SCHEMA, context=self._context)
        self._log = LogChannel(_LOG, context=self._context)
        self._lines: deque[tuple[Log, int]] = deque(maxlen=_WAITING_LINES)
        self._logging = threading.Lock()
        self._variables: dict[str, Channel] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._relay.close()
        self._server.stop()

    @property
    def link(self) -> str:
        """The address of Foxglove in a browser with this server as its source."""
        return f"https://app.foxglove.dev?{urlencode({'ds': 'foxglove-websocket', 'ds.url': self.url})}"

    # --- one run

    def begin(self, targets: Mapping[str, Target], parameters: MeshParameters, changed: Callable[[], None]) -> None:
        """Offer variables by topic, and parameters of a run; clients forget the one before.

        ``changed`` is called on a thread of the SDK when a client subscribes to a topic or unsubscribes.
        """
        for channel in self._variables.values():
            channel.close()
        with self._clock:
            self._time_ns = -1
        with self._logging:
            self._lines.clear()
        self._listener.serve((parameters, changed))
        self._server.clear_session()  # whereupon clients ask for parameters again
        self._variables = {
            topic: Channel(topic, schema=schema_of(target), metadata=metadata_of(target), context=self._context)
            for topic, target in targets.items()
        }

    def end(self) -> None:
        """Take back the parameters of a run. Its topics stay: messages may still be on their way to clients."""
        self._listener.serve(None)

    def take_touched(self) -> set[str]:
        """The topics to which clients have subscribed or from which they have unsubscribed since the last call."""
        touched = self._listener.take_touched()
        if _LOG in touched:
            self._send_lines()
        return touched & self._variables.keys()

    def is_read(self, topic: str) -> bool:
        """Whether a client subscribes to a topic of the run."""
        return self._variables[topic].has_sinks()

    def show(self, topic: str, message: bytes, time_ns: int) -> None:
        """Send the message of a variable at a time in ns."""
        self._variables[topic].log(message, log_time=time_ns)

    def show_status(self, message: bytes, time_ns: int) -> None:
        """Send the status of the mesh."""
        self._status.log(message, log_time=time_ns)

    def show_log(self, line: LogLine, time_ns: int) -> None:
        """Send a log message of an FMU; without a reader it waits for the first one."""
        sec, nsec = divmod(time_ns, _NS)
        level = _LEVELS.get(line.status.lower(), LogLevel.Unknown)
        text = f"{line.category}: {line.message}" if line.category else line.message
        message = Log(timestamp=Timestamp(sec=sec, nsec=nsec), level=level, message=text, name=line.instance)
        with self._logging:
            self._lines.append((message, time_ns))
        self._send_lines()

    def show_time(self, time_ns: int, *, at_once: bool = False) -> None:
        """Tell clients the time in ns, at most 60 times a second unless ``at_once``; it never goes back in a run."""
        with self._clock:
            now = time.monotonic()
            if time_ns > self._time_ns and (at_once or now - self._told_at >= _TIME_S):
                self._time_ns, self._told_at = time_ns, now
                self._server.broadcast_time(time_ns)

    def show_graph(self, topics: Mapping[str, tuple[str, Collection[str]]]) -> None:
        """Offer which instance publishes a topic, and which instances read it."""
        graph = ConnectionGraph()
        for topic, (source, readers) in topics.items():
            graph.set_published_topic(topic, [source])
            if readers:
                graph.set_subscribed_topic(topic, list(readers))
        self._server.publish_connection_graph(graph)

    def show_parameters(self, parameters: MeshParameters) -> None:
        """Send the parameters that have changed to the clients that follow them."""
        if (names := self._listener.subscribed_parameters) and (changed := parameters.changes(names)):
            self._server.publish_parameter_values(changed)

    def _send_lines(self) -> None:
        """Send the log messages that wait, if there is a reader."""
        with self._logging:
            while self._lines and self._log.has_sinks():
                message, time_ns = self._lines.popleft()
                self._log.log(message, log_time=time_ns)

    # --- messages

    def tell(self, message: str, *, about: str, severe: bool = False) -> None:
        """Show clients a message among their problems, instead of the last one about the same thing."""
        self._server.publish_status(message, StatusLevel.Error if severe else StatusLevel.Warning, about)

    def withdraw(self, *about: str) -> None:
        """Remove messages about these things."""
        self._server.remove_status(list(about))


class _Requests(ServerListener):
    """What clients ask for; the SDK calls it on threads of its own."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._served: tuple[MeshParameters, Callable[[], None]] | None = None
        self._touched: set[str] = set()
        self._subscribed: dict[str, None] = {}

    def serve(self, served: tuple[MeshParameters, Callable[[], None]] | None) -> None:
        """Answer from now on for a run: its parameters, and what is called when clients want other topics."""
        self._served = served

    def take_touched(self) -> set[str]:
        with self._lock:
            touched, self._touched = self._touched, set()
        return touched

    @property
    def subscribed_parameters(self) -> tuple[str, ...]:
        with self._lock:
            return tuple(self._subscribed)

    def on_subscribe(self, _client: Client, channel: ChannelView) -> None:
        self._touch(channel.topic)

    def on_unsubscribe(self, _client: Client, channel: ChannelView) -> None:
        self._touch(channel.topic)

    def on_get_parameters(
        self, _client: Client, param_names: list[str], _request_id: str | None = None
    ) -> list[Parameter]:
        served = self._served
        return served[0].values(param_names) if served is not None else []

    def on_set_parameters(
        self, _client: Client, parameters: list[Parameter], _request_id: str | None = None
    ) -> list[Parameter]:
        served = self._served
        return served[0].set(parameters) if served is not None else []

    def on_parameters_subscribe(self, param_names: list[str]) -> None:
        with self._lock:
            self._subscribed.update(dict.fromkeys(param_names))

    def on_parameters_unsubscribe(self, param_names: list[str]) -> None:
        with self._lock:
            for name in param_names:
                self._subscribed.pop(name, None)

    def _touch(self, topic: str) -> None:
        with self._lock:
            self._touched.add(topic)
        if (served := self._served) is not None:
            served[1]()


def _check_filters() -> None:
    """Raise ConfigurationError if this process cannot filter what comes to a socket."""
    try:
        with socket.socket() as own:
            let_in(own, None)
    except OSError as error:
        text = f"the kernel lets nobody protect the server with a socket filter: {error.strerror}."
        hint = "Start it with --connect where a usual Linux kernel runs; `fmu-mesh dashboard` needs no filter."
        raise ConfigurationError(text, hint=hint) from error
