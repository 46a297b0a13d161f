"""What `MasterStates` decides: values that say what its master is to do, and what a command has changed."""

from __future__ import annotations

import msgspec

from ..errors import FmuMeshError
from ..wire.ways import Ways

__all__ = ["Action", "AnswerAll", "Commanded", "EndAll", "FollowClock", "RaiseGrant", "RaiseSent", "SendToAll"]


class AnswerAll(msgspec.Struct, frozen=True):
    """All nodes are ready and wait for an answer: how rows go."""

    ways: Ways


class FollowClock(msgspec.Struct, frozen=True):
    """The point is due now by the wall clock, which does not limit the grant unless the run is ``paced``."""

    point: int
    paced: bool = True


class RaiseGrant(msgspec.Struct, frozen=True):
    """Write the grant into the memory of the host."""

    point: int


class RaiseSent(msgspec.Struct, frozen=True):
    """Write into the memory of the host what the row streams grant to others."""

    point: int


class SendToAll(msgspec.Struct, frozen=True):
    """Send a message to all nodes."""

    kind: int
    point: int


class EndAll(msgspec.Struct, frozen=True):
    """Tell all nodes why the run has failed."""

    error: FmuMeshError


Action = AnswerAll | FollowClock | RaiseGrant | RaiseSent | SendToAll | EndAll


class Commanded(msgspec.Struct, frozen=True):
    """What a command has changed, for the journal: where the mesh pauses, or the point at which it is stopped."""

    command: str
    hold: int | None
    stopped_at: int | None = None
