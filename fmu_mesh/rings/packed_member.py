"""The state of one instance with its rows, as it is in a state file and in a message: any engine can go on from it.

Owns the form, and how rows of a ring get into it and out of it. Each engine knows which of its rows are needed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Self

import msgspec

from ..errors import FmuError
from ..system.layout import Layout
from ..variables.value_types import Value
from .ring import Ring, Rows

__all__ = ["PackedMember", "columns_of", "put_columns"]

Columns = dict[str, list[list[Any]]]
"""By column, the elements of the newest rows, the oldest of these first."""


class PackedMember(msgspec.Struct, frozen=True, forbid_unknown_fields=True, array_like=True):
    """The state of an instance between two own steps.

    Attributes:
        state: that of the model.
        step: own steps done.
        set_at: own step at which something was last set; -1: never.
        outputs: the rows that a step may still read; the last one is row ``step``.
        inputs: its row of inputs.
        sent: see `fmu_mesh.system.input_timeouts.LastValues`.
        over_time: what a node knows of values that follow times; empty: nothing.
        waits: the variables with values that no step has used yet.
    """

    state: bytes
    step: Annotated[int, msgspec.Meta(ge=0)]
    set_at: int
    outputs: Columns
    inputs: Columns
    sent: dict[str, list[int]]
    over_time: bytes = b""
    waits: tuple[str, ...] = ()

    def encoded(self) -> bytes:
        """It as bytes."""
        return msgspec.msgpack.encode(self)

    @classmethod
    def decoded(cls, data: bytes, instance: str) -> Self:
        """What `encoded` returned.

        Raises:
            FmuError: these bytes are no state of an instance.
        """
        try:
            return msgspec.msgpack.decode(data, type=cls)
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            raise FmuError(f"this is no state of an instance: {error}", instance=instance) from error

    def last_row(self, layout: Layout, instance: str) -> dict[str, Value]:
        """The outputs of this layout that its newest row has.

        Raises:
            FmuError: the values are none of these columns.
        """
        ring = Ring(layout, 1)
        missing = put_columns(ring, ring.parts, [self.step], self.outputs, instance)
        return {name: ring.value(self.step, name) for name in layout.names if name not in missing}


def columns_of(ring: Ring, parts: Rows, rows: Sequence[int]) -> Columns:
    """The columns of these rows, in arrays that are as those of the ring."""
    slots, found = [row & ring.mask for row in rows], Columns()
    for name in ring.layout.names:
        place = ring.layout.place(name)
        found[name] = parts[place.part][slots, place.first : place.first + place.size].tolist()
    return found


def put_columns(
    ring: Ring, parts: Rows, rows: Sequence[int], columns: Mapping[str, Iterable[list[Any]]], instance: str
) -> list[str]:
    """Write columns into the newest of these rows, as many as there are; returns the columns that are not there.

    Raises:
        FmuError: the values are none of these columns.
    """
    missing = []
    for name in ring.layout.names:
        if name not in columns:
            missing.append(name)
            continue
        place = ring.layout.place(name)
        given = [*columns[name]][-len(rows) :]
        slots = [row & ring.mask for row in rows][-len(given) :]
        try:
            parts[place.part][slots, place.first : place.first + place.size] = given
        except (ValueError, TypeError, OverflowError) as error:
            raise FmuError(f"these rows are not its own: {error}", instance=instance) from error
    return missing
