"""The profile of zenoh-bridge-ros2dds: keys are topic names, payloads are CDR, tokens announce topics as a bridge does.

A token is `@/<zid>/@ros2_lv/MP/<key>/<type>/<qos>` (MS for a subscriber), with `§` for every slash within a part. Its
QoS is `<keyless>:<reliability>:<durability>:<history>,<depth>:<user data>` in the numbers of Cyclone DDS; the user data
contain the type hash, as in ROS since Iron.
"""

from __future__ import annotations

from collections.abc import Callable

from ..messages.topics import Reliability
from .profile import DEPTH, ZenohProfile

__all__ = ["Ros2Dds"]

_RELIABLE, _BEST_EFFORT = 1, 0
_VOLATILE, _KEEP_LAST = 0, 0


class Ros2Dds(ZenohProfile):
    """Topics as a bridge between Zenoh and DDS expects them."""

    def _key(self, name: str, message: str) -> str:  # noqa: ARG002  the name says all
        return name.removeprefix("/")

    def _announce(self, kind: str, name: str, message: str, reliability: Reliability) -> str:
        qos = f":{_RELIABLE if reliability == 'reliable' else _BEST_EFFORT}:{_VOLATILE}:{_KEEP_LAST},{DEPTH}"
        if self._types.distribution != "humble":
            qos += f":typehash={self._types.type_hash(message)};"
        parts = (self._key(name, message).replace("/", "§"), message.replace("/", "§"), qos)
        token = f"@/{self._session.zid()}/@ros2_lv/{kind}/{'/'.join(parts)}"
        self._tokens.append(self._session.liveliness().declare_token(token))
        return token

    def _attached(self, token: str) -> Callable[[float], bytes | None]:  # noqa: ARG002  a bridge wants none
        return lambda _time: None
