"""The profile of rmw_zenoh: the mesh is one ROS node with publishers, subscribers and services, without a bridge.

Keys are `<domain>/<name>/<type in DDS>/<hash>`. Tokens are
`@ros2_lv/<domain>/<zid>/<node>/<entity>/<kind>/<enclave>/<namespace>/<node name>/<name>/<type>/<hash>/<qos>` with `%`
for every slash within a part. Every sample, request and response has an attachment: sequence number, time in ns, and
the 16 bytes that identify its sender (rmw_zenoh, docs/design.md).
"""

# Threads: Zenoh calls `changed` and, of a server, `answer` on the thread that reads the link, so a request comes after
# all samples that its sender has published before (`profile`). Neither waits: a service passes its work on. `call`
# waits on the thread of its caller, and reads `here`, which `changed` replaces (ADR 78).

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable

import zenoh
from zenoh.handlers import Callback

from ..config.mesh import Qos
from ..errors import MeshLost
from ..installing import importing
from ..wire.session import Question, ask
from .cdr import CdrError, Codec, Message
from .profile import ZenohProfile
from .ros_names import dds_type
from .stamp import nanoseconds
from .topics import RosPlan

__all__ = ["Call", "RmwZenoh", "Service", "decode_attachment"]

_ATTACHMENT = struct.Struct("<qqB16s")
_SHORT_ATTACHMENT = struct.Struct("<qq16s")
_GID_SIZE = 16
_RELIABILITY, _DURABILITY, _KEEP_LAST = {"reliable": 1, "best_effort": 2}, {"volatile": 2, "transient_local": 1}, 1
_NO_HASH = "TypeHashNotSupported"

Service = Callable[[Message, Callable[[Message], None]], None]
"""Called on a thread of Zenoh with a request and a function that sends the response, now or later, on any thread."""

Call = Callable[[Message, float], Message]
"""Sends a request and waits for its response, for so long in s. What the request does not say is 0 or empty.

Raises:
    DeadlineExceeded: it has not come in time, or there is no such server.
    MeshLost: the server is gone, or has refused the request.
"""


class RmwZenoh(ZenohProfile):
    """One ROS node on Zenoh; the source time of a sample is its simulation time."""

    def __init__(self, session: zenoh.Session, plan: RosPlan, domain: int) -> None:
        super().__init__(session, plan.types)
        self._domain = domain
        self._entities = itertools.count(1)
        self._node = f"%/{_mangled(plan.namespace)}/{plan.node}"
        node = f"@ros2_lv/{domain}/{session.zid()}/0/0/NN/{self._node}"
        self._tokens.append(session.liveliness().declare_token(node))

    def serve(self, name: str, kind: str, service: Service) -> None:
        """Declare the server of the service ``name``; its type ``kind`` has to be defined in the message types."""
        key = self._key(name, kind)
        request_codec = Codec(self._types, f"{kind}_Request")
        response_codec = Codec(self._types, f"{kind}_Response")

        def answer(query: zenoh.Query) -> None:
            try:
                sequence, time_ns, gid = decode_attachment(query.attachment)
                request = request_codec.decode(query.payload.to_bytes() if query.payload is not None else b"")
            except CdrError as error:
                query.reply_err(f"'{name}': {error}")
                query.drop()
                return

            def reply(response: Message) -> None:
                own = _ATTACHMENT.pack(sequence, time_ns, _GID_SIZE, gid)
                query.reply(key, response_codec.encode(response), attachment=own)
                query.drop()

            service(request, reply)

        self._others.append(self._session.declare_queryable(key, Callback(answer, indirect=False), complete=True))
        self._announce("SS", name, kind, Qos())

    def client(self, name: str, kind: str) -> Call:
        """Declare a client of the service ``name``; a request is sent once, when there is a server."""
        here = set[str]()
        key = self._session.declare_keyexpr(self._key(name, kind))  # as `Question` wants it
        request_codec = Codec(self._types, f"{kind}_Request")
        response_codec = Codec(self._types, f"{kind}_Response")
        attached = self._attached(self._announce("SC", name, kind, Qos()))
        was_here = False

        def changed(sample: zenoh.Sample) -> None:
            nonlocal was_here
            was_here = True
            (here.add if sample.kind == zenoh.SampleKind.PUT else here.discard)(str(sample.key_expr))

        servers = f"@ros2_lv/{self._domain}/*/*/*/SS/*/*/*/{_mangled(name)}/**"
        directly = Callback(changed, indirect=False)
        self._others.append(self._session.liveliness().declare_subscriber(servers, directly, history=True))

        def over() -> bool:
            if was_here and not here:
                raise MeshLost(f"the server of '{name}' is gone")
            return False

        def call(request: Message, deadline_s: float) -> Message:
            payload = request_codec.encode(request_codec.empty() | request)
            question = Question(key, f"'{name}'", deadline_s, payload, attachment=attached(0.0), once=True)
            try:
                return response_codec.decode(ask(self._session, question, over))
            except CdrError as error:
                raise MeshLost(f"the response of '{name}' is not understood: {error}") from error

        return call

    def _key(self, name: str, message: str) -> str:
        return f"{self._domain}/{name.strip('/')}/{dds_type(message)}/{self._hash(message)}"

    def _token(self, kind: str, name: str, message: str, qos: Qos) -> str:
        deadline = "{},{}".format(*divmod(nanoseconds(qos.deadline), 10**9)) if qos.deadline is not None else ","
        words = (
            f"{_RELIABILITY[qos.reliability]}:{_DURABILITY[qos.durability]}:{_KEEP_LAST},{qos.depth}:{deadline}:,:,,"
        )
        own = f"{_mangled(name)}/{dds_type(message)}/{self._hash(message)}/{words}"
        return f"@ros2_lv/{self._domain}/{self._session.zid()}/0/{next(self._entities)}/{kind}/{self._node}/{own}"

    def _attached(self, token: str) -> Callable[[float], bytes | None]:
        with importing("xxhash"):
            import xxhash  # noqa: PLC0415  an optional dependency

        number = xxhash.xxh3_128_intdigest(token.encode())
        gid = struct.pack("<QQ", number & (1 << 64) - 1, number >> 64)
        sequence = itertools.count(1)
        return lambda time: _ATTACHMENT.pack(next(sequence), nanoseconds(time), _GID_SIZE, gid)

    def _hash(self, message: str) -> str:
        return _NO_HASH if self._types.distribution == "humble" else self._types.type_hash(message)


def decode_attachment(attachment: zenoh.ZBytes | None) -> tuple[int, int, bytes]:
    """Sequence number, time in ns and sender of an attachment, with or without the length of the sender.

    Raises:
        CdrError: it is not an attachment of rmw_zenoh.
    """
    data = attachment.to_bytes() if attachment is not None else b""
    if len(data) == _ATTACHMENT.size and data[_ATTACHMENT.size - _GID_SIZE - 1] == _GID_SIZE:
        sequence, time_ns, _size, gid = _ATTACHMENT.unpack(data)
    elif len(data) == _SHORT_ATTACHMENT.size:
        sequence, time_ns, gid = _SHORT_ATTACHMENT.unpack(data)
    else:
        raise CdrError(f"an attachment of {len(data)} bytes where sequence number, time and sender should be")
    return sequence, time_ns, gid


def _mangled(name: str) -> str:
    return name.replace("/", "%")
