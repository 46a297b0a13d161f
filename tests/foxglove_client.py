"""A client of Foxglove's protocol `foxglove.sdk.v1`, over a WebSocket of another library."""

from __future__ import annotations

import json
import re
import struct
import time
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from types import TracebackType
from typing import Any, Self

from websockets.sync.client import connect
from websockets.typing import Subprotocol

from tests.helpers import DEADLINE_S

__all__ = ["FoxgloveClient"]

_MESSAGE = 1
_TIME = 2


class FoxgloveClient:
    """What one client of a server has received; only `until` reads.

    Attributes:
        info: the newest `serverInfo`.
        channels: those that are advertised, by topic.
        messages: by topic, (log time in ns, data) of each message.
        times: what the server has told as the time, in ns.
        texts: all other messages, the oldest first.
    """

    def __init__(self, url: str) -> None:
        self._connection = connect(
            url,
            subprotocols=[Subprotocol("foxglove.sdk.v1")],
            max_size=None,
            open_timeout=DEADLINE_S,
            ping_interval=None,  # a client that does not read takes no answer to a ping either
        )
        self._topics: dict[int, str] = {}
        self.info: dict[str, Any] = {}
        self.channels: dict[str, dict[str, Any]] = {}
        self.messages: dict[str, list[tuple[int, bytes]]] = defaultdict(list)
        self.times: list[int] = []
        self.texts: list[dict[str, Any]] = []

    def __enter__(self) -> Self:
        self._socket = self._connection.__enter__()
        assert self._socket.subprotocol == "foxglove.sdk.v1"
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._connection.__exit__(kind, error, trace)

    def send(self, **message: object) -> None:
        """Send a message of the protocol."""
        self._socket.send(json.dumps(message))

    def subscribe(self, *topics: str) -> None:
        """Subscribe to topics, as soon as they are advertised."""
        for topic in topics:
            self.until(partial(self._offers, topic), f"the topic {topic}")
            self._subscribe(topic)

    def values(self, topic: str) -> list[tuple[int, int, Any]]:
        """(log time in ns, point, value) of all messages about a variable."""
        decoded = [(stamp, json.loads(data)) for stamp, data in self.messages[topic]]
        return [(stamp, message["point"], message["value"]) for stamp, message in decoded]

    def value(self, topic: str) -> Any:  # noqa: ANN401  the variable says which
        """The newest value of a variable; None before the first one."""
        return values[-1][2] if (values := self.values(topic)) else None

    def parameters(self, *names: str) -> dict[str, Any]:
        """The values of these parameters, of all without names."""
        return self._ask(op="getParameters", parameterNames=list(names))

    def set(self, **values: object) -> dict[str, Any]:
        """Set parameters; `__` in a name is a dot. Returns the values in the answer."""
        parameters = [{"name": name.replace("__", "."), "value": value} for name, value in values.items()]
        return self._ask(op="setParameters", parameters=parameters)

    def statuses(self) -> list[str]:
        """The messages among the problems, the oldest first."""
        return [text["message"] for text in self.texts if text["op"] == "status"]

    def updated(self) -> dict[str, Any]:
        """The parameters that the server has sent without a question, with their newest values."""
        updates = [text for text in self.texts if text["op"] == "parameterValues" and "id" not in text]
        return {parameter["name"]: parameter["value"] for text in updates for parameter in text["parameters"]}

    def ended(self) -> bool:
        """Whether the server has told that the mesh has ended."""
        return any("has ended" in text for text in self.statuses())

    def until(self, condition: Callable[[], object], what: str) -> None:
        """Read until this is true."""
        end = time.monotonic() + DEADLINE_S
        while not condition():
            left = end - time.monotonic()
            assert left > 0, f"not within {DEADLINE_S:g} s: {what}"
            try:
                self._take(self._socket.recv(timeout=left))
            except TimeoutError:
                raise AssertionError(f"not within {DEADLINE_S:g} s: {what}; {self.texts[-5:]}") from None

    def _subscribe(self, topic: str) -> None:
        number = len(self._topics) + 1
        self._topics[number] = topic
        self.send(op="subscribe", subscriptions=[{"id": number, "channelId": self.channels[topic]["id"]}])

    def _offers(self, topic: str) -> bool:
        return topic in self.channels

    def _ask(self, **message: object) -> dict[str, Any]:
        asked = f"question {len(self.texts)}"

        def answers() -> list[dict[str, Any]]:
            return [text for text in self.texts if text.get("id") == asked]

        self.send(**message, id=asked)
        self.until(answers, "the answer about parameters")
        return {parameter["name"]: parameter["value"] for parameter in answers()[0]["parameters"]}

    def _take(self, message: str | bytes) -> None:
        if isinstance(message, bytes):
            if message[0] == _MESSAGE:
                number, stamp = struct.unpack_from("<IQ", message, 1)
                self.messages[self._topics[number]].append((stamp, message[13:]))
            elif message[0] == _TIME:
                self.times.append(struct.unpack_from("<Q", message, 1)[0])
            return
        text = json.loads(message)
        match text["op"]:
            case "serverInfo":
                self.info = text
            case "advertise":
                self.channels.update({channel["topic"]: channel for channel in text["channels"]})
            case "unadvertise":
                gone = set(text["channelIds"])
                self.channels = {topic: c for topic, c in self.channels.items() if c["id"] not in gone}
            case "status" if (unknown := re.fullmatch(r"Unknown channel ID: (\d+)", text["message"])) is not None:
                # The SDK (0.30) tells clients about a channel just before it takes subscriptions to it.
                for topic in [topic for topic, c in self.channels.items() if c["id"] == int(unknown[1])]:
                    self._subscribe(topic)
            case _:
                self.texts.append(text)
