"""Another program beside a mesh, for the benchmark `live_data`: it publishes values, by Zenoh or by MQTT.

One argument, JSON: `role`, `port` of the session that it joins, `key` of what it publishes and `back` of what the mesh
publishes, and what the role needs. With `mqtt`, a port, its values go to `mosquitto_pub`. It prints one JSON line.

* `plain` sends `count` values at `rate_hz`, and looks when each comes back: in ms, and in points of `step_s`.
* `timed` sends as many, each with the time at which it takes effect, `ahead_s` later than the mesh is at the start.
* `ahead` sends one value for each of `count` points, as fast as the mesh takes them: at most `window` points ahead.
* `flood` sends as many values as it can in `seconds`.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import zenoh

from fmu_mesh.wire.session import matches

_DEADLINE_S: Final = 60.0
_LAST_S: Final = 5.0
"""How long a value that has not come back may still be on its way."""

_PART_S: Final = 0.25
"""The fastest row of each such time says when its points were due."""

_LOOK: Final = 500
"""After so many values, `ahead` looks how far the mesh is."""

Put = Callable[[bytes], None]


def joined(port: int) -> zenoh.Session:
    """A session as any program opens it."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    return zenoh.open(config)


class Returned:
    """What has come back: when each value has come first and at which point, and when each point was due, in s."""

    def __init__(self, session: zenoh.Session, key: str, step_s: float) -> None:
        self.at: dict[float, tuple[float, int]] = {}
        self.point = -1
        self._began: dict[int, float] = {}
        self._step_s = step_s
        self._changed = threading.Condition()
        self._subscriber = session.declare_subscriber(key, self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        now, message = time.monotonic(), json.loads(sample.payload.to_bytes())
        point = message.get("point", 0)
        with self._changed:
            self.at.setdefault(message["value"], (now, point))
            self.point = max(self.point, point)
            # No row is published before its time, so the fastest one says when point 0 was. A run that has fallen
            # behind gives points up, and goes on as if it had begun later.
            part, began = int(now / _PART_S), now - point * self._step_s
            self._began[part] = min(self._began.get(part, began), began)
            self._changed.notify()

    def point_at(self, time_s: float) -> float:
        """The point that was due at a time; NaN where nothing came at that time."""
        return (time_s - self._began.get(int(time_s / _PART_S), math.nan)) / self._step_s

    def wait(self, is_enough: Callable[[], bool], seconds: float = _DEADLINE_S) -> bool:
        """Wait until something is so, at most for some seconds."""
        with self._changed:
            return self._changed.wait_for(is_enough, seconds)


def paced(rate_hz: float, count: int, send: Callable[[int], None]) -> None:
    """Send values at a rate."""
    began, pause = time.monotonic(), threading.Event()
    for number in range(count):
        if (left := began + number / rate_hz - time.monotonic()) > 0:
            pause.wait(left)
        send(number)


def plain(put: Put, back: Returned, orders: dict[str, Any]) -> dict[str, Any]:
    """See the top of this file."""
    first, count, sent = 1, orders["count"], np.zeros(orders["count"])

    def is_back() -> bool:
        put(b'{"value": -1.0}')
        return back.wait(lambda: -1.0 in back.at, 0.1)

    assert any(is_back() for _ in range(int(10 * _DEADLINE_S))), "nothing comes back"

    def send(number: int) -> None:
        sent[number] = time.monotonic()
        put(b'{"value": %d.0}' % (first + number))

    paced(orders["rate_hz"], count, send)
    back.wait(lambda: first + count - 1.0 in back.at, _LAST_S)
    known = [(number, *back.at[first + number]) for number in range(count) if first + number in back.at]
    numbers, times, points = (np.array(own) for own in zip(*known, strict=True))
    trips_ms = 1000 * (times - sent[numbers])
    effects = points - np.array([back.point_at(time_s) for time_s in sent[numbers].tolist()])
    return {
        "missing": count - len(known),
        "round_trips_ms": np.percentile(trips_ms, [50, 99]).tolist(),
        "points": np.nanpercentile(effects, [50, 99]).tolist(),
    }


def timed(put: Put, back: Returned, orders: dict[str, Any]) -> dict[str, Any]:
    """See the top of this file."""
    count, step_s = orders["count"], orders["step_s"]
    lead = round(orders["ahead_s"] / step_s)
    assert back.wait(lambda: back.point >= 0), "the mesh publishes nothing"

    def is_back() -> bool:
        """What comes to a bridge before it knows the subscription of the mesh is lost."""
        put(b'{"value": -1.0, "t": %.6f}' % ((back.point + lead) * step_s))
        return back.wait(lambda: -1.0 in back.at, 0.1)

    assert any(is_back() for _ in range(int(10 * _DEADLINE_S))), "nothing comes back"
    first = back.point + lead
    paced(orders["rate_hz"], count, lambda n: put(b'{"value": %d.0, "t": %.6f}' % (n + 1, (first + n) * step_s)))
    assert back.wait(lambda: back.point > first + count), "the mesh does not go on"
    return {"first": first}


def ahead(put: Put, back: Returned, orders: dict[str, Any]) -> dict[str, Any]:
    """See the top of this file."""
    count, step_s, window = orders["count"], orders["step_s"], orders["window"]
    for point in range(count):
        if point % _LOOK == 0:
            assert back.wait(lambda: point < back.point + window), f"the mesh stands at point {back.point}"  # noqa: B023
        put(b'{"value": %d.25, "t": %.6f}' % (point, point * step_s))
    return {}


def flood(put: Put, _back: Returned, orders: dict[str, Any]) -> dict[str, Any]:
    """See the top of this file."""
    end, sent = time.monotonic() + orders["seconds"], 0
    while time.monotonic() < end:
        put(b'{"value": %d.0, "t": %.6f}' % (sent, sent * orders["step_s"]))
        sent += 1
    return {"sent": sent}


_ROLES: Final = {"plain": plain, "timed": timed, "ahead": ahead, "flood": flood}


def main() -> None:
    """Be the program that the argument says."""
    orders = json.loads(sys.argv[1])
    with joined(orders["port"]) as session:
        back = Returned(session, orders["back"], orders["step_s"])
        role = _ROLES[orders["role"]]
        if orders.get("mqtt"):
            command = ["mosquitto_pub", "-p", str(orders["mqtt"]), "-q", "1", "-t", orders["key"], "-l"]
            with subprocess.Popen(command, stdin=subprocess.PIPE, bufsize=0) as mosquitto:
                assert mosquitto.stdin is not None
                write = mosquitto.stdin.write
                answer = role(lambda data: (write(data + b"\n"), None)[1], back, orders)
        else:
            publisher = session.declare_publisher(
                orders["key"],
                congestion_control=zenoh.CongestionControl.BLOCK,
                encoding=zenoh.Encoding.APPLICATION_JSON,
            )
            assert _matched(publisher), "nobody subscribes"
            answer = role(publisher.put, back, orders)
        print(json.dumps(answer), flush=True)
        sys.stdin.read()


def _matched(publisher: zenoh.Publisher) -> bool:
    pause = threading.Event()
    return any(matches(publisher) or pause.wait(0.01) for _ in range(int(100 * _DEADLINE_S)))


if __name__ == "__main__":
    main()
