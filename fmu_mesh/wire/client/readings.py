"""Values of variables as a tool receives them: which variable, and at which point."""

from __future__ import annotations

import queue
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

import msgspec
import zenoh

from ...errors import MessageRefused
from ...variables.model_description import PlainValue
from ..messages import decode_json
from ..values import Stamp
from ..views import VariableView

__all__ = ["Reading", "Target", "latecomers", "reading_among", "reading_of"]

_LOOKS = 5
# Five times this without a sample is the end. Each is a turn of this process, so one that had no processor for a while
# does not take its own pause for the end.
_LATE_SAMPLE_S = 0.05

Item = TypeVar("Item")


class Target(msgspec.Struct, frozen=True):
    """One variable of the mesh, and the key of its value."""

    instance: str
    key: str
    variable: VariableView

    @property
    def name(self) -> str:
        """`instance.variable`."""
        return f"{self.instance}.{self.variable.name}"

    @property
    def root(self) -> str:
        """What the keys of the variables of its kind begin with."""
        return self.key.rpartition("/")[0]


class Reading(msgspec.Struct, frozen=True, omit_defaults=True):
    """One value that was received, with its communication point and the time of that point in s."""

    key: str
    instance: str
    variable: str
    value: PlainValue
    point: int
    time: float
    unit: str | None = None


def reading_of(target: Target, sample: zenoh.Sample) -> Reading | None:
    """The value of a sample; None if it has no point, as values that others put on the key of an input."""
    if sample.attachment is None:
        return None
    try:
        stamp = decode_json(sample.attachment.to_bytes(), Stamp)
        value: Any = decode_json(sample.payload.to_bytes(), object)
    except MessageRefused:
        return None
    view = target.variable
    return Reading(target.key, target.instance, view.name, value, stamp.point, stamp.time, view.unit)


def reading_among(targets: Mapping[str, Target], sample: zenoh.Sample) -> Reading | None:
    """As `reading_of`, for the target with the key of the sample; None if there is none."""
    target = targets.get(str(sample.key_expr))
    return reading_of(target, sample) if target is not None else None


def latecomers(arrived: queue.SimpleQueue[Item]) -> Iterator[Item]:
    """The samples that arrive after the master's token has gone, until none has arrived for a quarter of a second.

    The loss of the token can overtake samples that were sent earlier: it has a higher priority on the network, and a
    thread of its own here. This counts looks into the queue instead of time, because this process may have
    had no processor for a while.
    """
    looks = 0
    while looks < _LOOKS:
        try:
            item = arrived.get(timeout=_LATE_SAMPLE_S)
        except queue.Empty:
            looks += 1
        else:
            looks = 0
            yield item
