"""The messages of the synchronization, as bytes.

Every message starts with 24 bytes, little endian: kind (u8), three spare bytes, number of the link (u32), count (u32),
four spare bytes, point (i64). In a frame the rows follow (`fmu_mesh.wire.frames`), and in these as JSON: in an ABORT an
`ErrorReport`, in a RESET a `NewStart`, and for the recorder (`FOR_METADATA`) in a SET a `SetValue`, in a NOTED a
`Noted`, in a KEYS values that have come by keys, and for the audit in a REFUSED an `AuditEntry`. LAST says that no more
rows of a link come, because the run has ended early. SAVE asks the nodes for their states at a point, and a STATE has
that of one instance, as MessagePack (`InstanceState`). Every decoder checks sizes before it reads anything, and raises
only `MessageRefused`.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Sequence
from typing import Final, TypeVar

import msgspec

from ..errors import ErrorReport, MessageRefused
from ..files import decoded_json
from ..system.input_timeouts import InputTimeout
from ..system.live_keys import KeyValue
from ..variables.value_types import PlainValue
from .time_profile import NodeProfile
from .views import AuditEntry

__all__ = [
    "ABORT",
    "ALIVE",
    "FINISH",
    "FOR_METADATA",
    "FRAME",
    "GRANT",
    "HEADER",
    "INITIAL",
    "KEYS",
    "LAST",
    "MAX_MESSAGE_SIZE",
    "MAX_STATE_SIZE",
    "PROGRESS",
    "REFUSED",
    "RESET",
    "SAVE",
    "SET",
    "STATE",
    "InstanceState",
    "NewStart",
    "NodeReport",
    "SetValue",
    "decode_json",
    "decode_state",
    "encode_json",
    "encode_news",
    "encode_state",
    "sealed",
]

HEADER: Final = struct.Struct("<BxxxIIxxxxq")
FRAME: Final = 1
INITIAL: Final = 2
GRANT: Final = 3
PROGRESS: Final = 4
FINISH: Final = 5
ABORT: Final = 6
LAST: Final = 8
SET: Final = 9
ALIVE: Final = 10
"""Only in a row stream: its sender lives."""

RESET: Final = 11
KEYS: Final = 12
NOTED: Final = 13
REFUSED: Final = 14
SAVE: Final = 15
STATE: Final = 16
FOR_METADATA: Final = (SET, KEYS, NOTED)

MAX_MESSAGE_SIZE: Final = 64 * 2**20
MAX_STATE_SIZE: Final = MAX_MESSAGE_SIZE - 2**16
"""Of the state of an instance in a message, with room for the rest."""

T = TypeVar("T")


class NodeReport(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a node ended.

    Attributes:
        error: why, if it is a failure, or if an FMU asked for it.
        profile: what it has measured, if the master asked for it.
        secret: `Membership.report` adds it; see `fmu_mesh.wire.membership.Registration`.
    """

    node: str
    point: int
    error: ErrorReport | None = None
    profile: NodeProfile | None = None
    secret: str = ""


class SetValue(msgspec.Struct, frozen=True, omit_defaults=True):
    """A value that another program gave to an input or a parameter while the mesh ran.

    Attributes:
        point: the communication point at which the instance took it: the step from there is the first that may use it.
        time: simulation time in s from which on it holds; None: from `point` on.
        key: the Zenoh key under which it was sent.
        who: who sent it, as the sender says: user, host, program and process id, or `ros` and the topic.
        by: in a mesh with security, the name of who sent it; nobody can send with another one.
    """

    instance: str
    variable: str
    value: PlainValue
    point: int
    time: float | None
    key: str
    who: str
    by: str = ""


class InstanceState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The state of an instance for a checkpoint; an error in its place: it cannot be written."""

    instance: str
    state: bytes = b""
    error: ErrorReport | None = None


class Noted(msgspec.Struct, frozen=True):
    """What has turned out in the step from a point, see `LogMessage.noted` and `Initialization.noted`, in words."""

    what: str
    instance: str
    point: int
    message: str


class NewStart(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a node needs to begin again at the first point, beside its plan.

    Attributes:
        resets: how often the mesh was reset.
        digest: that of the plan with these start values.
        start_values: all of them, of each instance that has others than in the first run.
        timeouts: of these instances; an input may fall back to its start value.
    """

    resets: int
    digest: str
    start_values: dict[str, dict[str, PlainValue]]
    timeouts: dict[str, tuple[InputTimeout, ...]] = {}


def sealed(secret: str) -> str:
    """What tells nobody a secret, and shows who knows it."""
    return hashlib.sha256(secret.encode()).hexdigest()


def encode_json(
    kind: int, content: ErrorReport | NewStart | SetValue | AuditEntry | Noted | Sequence[KeyValue], point: int = 0
) -> bytes:
    """An ABORT, RESET, SET, REFUSED, NOTED or KEYS message."""
    return HEADER.pack(kind, 0, 0, point) + msgspec.json.encode(content)


def encode_news(news: SetValue | AuditEntry | Noted | Sequence[KeyValue]) -> bytes:
    """What has happened at a node, for the metadata of results and the audit: a SET, REFUSED, NOTED or KEYS message."""
    match news:
        case SetValue():
            return encode_json(SET, news, news.point)
        case AuditEntry():
            return encode_json(REFUSED, news, news.point)
        case Noted():
            return encode_json(NOTED, news, news.point)
    return encode_json(KEYS, news, news[-1][1])


def encode_state(state: InstanceState, point: int) -> bytes:
    """A STATE message of the communication point of the state."""
    return HEADER.pack(STATE, 0, 0, point) + msgspec.msgpack.encode(state)


def decode_state(data: bytes) -> InstanceState:
    """What a STATE message has.

    Raises:
        MessageRefused: it is none, or too large.
    """
    if len(data) > MAX_MESSAGE_SIZE:
        raise MessageRefused(f"it has {len(data)} bytes; the limit is {MAX_MESSAGE_SIZE}")
    try:
        return msgspec.msgpack.decode(data[HEADER.size :], type=InstanceState)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise MessageRefused(str(error)) from error


def decode_json(data: bytes, type_: type[T], most: int = MAX_MESSAGE_SIZE) -> T:
    """JSON of at most ``most`` bytes that came over the wire.

    Raises:
        MessageRefused: it is not JSON of that type, or larger.
    """
    if len(data) > most:
        raise MessageRefused(f"it has {len(data)} bytes; the limit is {most}")
    try:
        return decoded_json(data, type_)
    except ValueError as error:
        raise MessageRefused(str(error)) from error
