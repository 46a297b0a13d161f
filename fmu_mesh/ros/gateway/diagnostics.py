"""`/diagnostics` of a gateway: which instances have failed, and hold their outputs or have substitutes.

There is one only where an instance has `on_failure`; without it, a failure ends the mesh and its gateway. ROS expects
such messages about once a second, and an operator sees the worst level of all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final

import zenoh

from ...ros_wire.cdr import Codec
from ...ros_wire.profile import Put
from ...ros_wire.stamp import to_stamp
from ...ros_wire.topics import DIAGNOSTICS, RosPlan
from ...wire.keys import Keys
from ...wire.messages import decode_json
from ...wire.views import InstanceStatus

__all__ = ["Diagnostics"]

_OK: Final = 0
_ERROR: Final = 2
"""Levels of `diagnostic_msgs/msg/DiagnosticStatus`."""


class Diagnostics:
    """Publishes the state of these instances: at once when one fails, and whenever `publish` is called.

    Args:
        put: publishes a message, with its time in s.
        plan: with the instances that may fail without an end of the run.
        keys: of the mesh; its name begins the name of each status.
    """

    def __init__(self, put: Put, plan: RosPlan, keys: Keys) -> None:
        self._put = put
        self._codec = Codec(plan.types, DIAGNOSTICS)
        self._keys, self._instances = keys, plan.may_fail
        self._statuses: dict[str, InstanceStatus] = {}

    def follow(
        self, mesh: zenoh.Session, post: Callable[[Callable[[], None]], None]
    ) -> Iterator[zenoh.Subscriber[None]]:
        """Subscribe the statuses of these instances; ``post`` calls `take` on the thread of the gateway."""

        def arrived(sample: zenoh.Sample) -> None:
            data = sample.payload.to_bytes()
            post(lambda: self.take(decode_json(data, InstanceStatus)))

        for name in self._instances:
            yield mesh.declare_subscriber(f"{self._keys.instance(name)}/status", arrived)

    def take(self, status: InstanceStatus) -> None:
        """The newest status of an instance."""
        before = self._statuses.get(status.instance)
        self._statuses[status.instance] = status
        if before is None or before.failed != status.failed:
            self.publish()

    def publish(self) -> None:
        """Publish what is known; nothing before the first status."""
        known = [own for name in self._instances if (own := self._statuses.get(name)) is not None]
        if known:
            time_s = max(own.time for own in known)
            header = {"stamp": to_stamp(time_s), "frame_id": ""}
            self._put(self._codec.encode({"header": header, "status": [*map(self._as_message, known)]}), time_s)

    def _as_message(self, own: InstanceStatus) -> dict[str, Any]:
        values = [{"key": "point", "value": str(own.point)}, {"key": "state", "value": own.state}]
        level, name = _ERROR if own.failed else _OK, f"{self._keys.mesh}/{own.instance}"
        return {"level": level, "name": name, "message": own.failed or "OK", "hardware_id": "", "values": values}
